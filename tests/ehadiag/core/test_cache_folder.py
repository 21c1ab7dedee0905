"""A cache is used only if nobody else could have put something into it."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from firmware_iface.files import private_folder

pytestmark = pytest.mark.skipif(os.name != "posix", reason="links, owners and permissions")
OTHER = 12345


@pytest.fixture
def base(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the cache is to be; it does not exist yet."""
    path = tmp_path / "user" / "cache"
    path.parent.mkdir()
    monkeypatch.setenv("EHADIAG_CACHE_DIR", str(path))
    return path


def refused(words: str, caplog: pytest.LogCaptureFixture) -> None:
    """Nothing is opened, and one line says why and what to do."""
    caplog.clear()
    assert private_folder("leaf") is None
    assert private_folder("leaf") is None
    (line,) = caplog.messages
    assert line.startswith("ehadiag: ")
    assert words in line
    assert line.endswith("name a folder of your own by EHADIAG_CACHE_DIR")


def test_a_folder_is_made_for_the_user_alone(base: Path) -> None:
    with private_folder("leaf") as folder:
        folder.write("name", b"kept")
    assert stat.S_IMODE((base / "leaf").stat().st_mode) == 0o700
    assert stat.S_IMODE(base.stat().st_mode) == 0o700
    assert stat.S_IMODE((base / "leaf" / "name").stat().st_mode) == 0o600
    with private_folder("leaf") as folder:
        assert folder.read("name", 100) == b"kept"


@pytest.mark.parametrize("place", ["user/cache/leaf", "user/cache", "user"])
def test_a_link_on_the_way(
    place: str, base: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / "cache" / "leaf").mkdir(parents=True, mode=0o700)
    link = tmp_path / place
    link.parent.mkdir(parents=True, exist_ok=True)
    if link.is_dir():
        link.rmdir()
    link.symlink_to(elsewhere)
    refused(f"{link} is a link", caplog)


@pytest.mark.parametrize("place", ["user/cache/leaf", "user/cache", "user"])
@pytest.mark.parametrize("mode", [0o770, 0o707, 0o777])
def test_a_folder_that_others_may_write_to(
    mode: int, place: str, base: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (base / "leaf").mkdir(parents=True)
    (tmp_path / place).chmod(mode)
    refused("others may write to", caplog)


@pytest.mark.parametrize("place", ["user/cache/leaf", "user/cache", "user"])
@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives a folder to another user")
def test_a_folder_of_another_user(
    place: str, base: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (base / "leaf").mkdir(parents=True)
    os.chown(tmp_path / place, OTHER, -1)
    refused("belongs to another user", caplog)


def test_above_it_a_shared_folder_will_do(base: Path, tmp_path: Path) -> None:
    (tmp_path / "user").chmod(0o1777)  # as /tmp: nobody may move what is another's
    assert private_folder("leaf") is not None


def test_the_folder_itself_must_not_be_shared(base: Path, caplog: pytest.LogCaptureFixture) -> None:
    (base / "leaf").mkdir(parents=True)
    (base / "leaf").chmod(0o1777)
    refused("others may write to it", caplog)


def test_a_file_in_its_place(base: Path, caplog: pytest.LogCaptureFixture) -> None:
    base.write_text("")
    refused("is a link, or no folder", caplog)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_made(base: Path, caplog: pytest.LogCaptureFixture) -> None:
    base.parent.chmod(0o500)
    refused("Permission denied", caplog)


def test_no_home_is_no_place_least_of_all_a_shared_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("EHADIAG_CACHE_DIR", "XDG_CACHE_HOME", "HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    private_folder("leaf")
    assert list(tmp_path.iterdir()) == []
    assert private_folder("leaf") is None


@pytest.mark.parametrize(
    ("set_to", "expected"),
    [
        ({"EHADIAG_CACHE_DIR": "a", "XDG_CACHE_HOME": "b", "HOME": "c"}, "a/leaf"),
        ({"XDG_CACHE_HOME": "b", "HOME": "c"}, "b/ehadiag/leaf"),
        ({"HOME": "c"}, "c/.cache/ehadiag/leaf"),
    ],
)
def test_where_it_is(
    set_to: dict[str, str], expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("EHADIAG_CACHE_DIR", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, place in set_to.items():
        monkeypatch.setenv(name, str(tmp_path / place))
    with private_folder("leaf") as folder:
        assert folder.path == tmp_path / expected
        assert folder.path.is_dir()
