"""Files are written whole or not at all, and no link in the folder is followed."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from firmware_iface import files as folder_module
from firmware_iface.files import CACHE_MODE, RESULT_MODE, Folder, create_file, reopen_file

pytestmark = pytest.mark.skipif(os.name != "posix", reason="links and permissions")

WRITES: tuple[Callable[[Folder], object], ...] = (
    lambda folder: folder.write("name", b"new"),
    lambda folder: folder.write("name", b"new", synced=False),
    lambda folder: folder.write_new("name", b"new"),
)


def mode_of(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    (tmp_path / "here").mkdir()
    with Folder.at(tmp_path / "here", RESULT_MODE) as opened:
        yield opened


@pytest.mark.parametrize("write", WRITES)
def test_a_file_is_there_whole_with_its_mode(write, folder: Folder) -> None:
    before = os.umask(0o027)
    try:
        write(folder)
    finally:
        os.umask(before)
    assert folder.names() == ["name"]
    assert folder.read("name", 100) == b"new"
    assert mode_of(folder.path / "name") == 0o640


def test_what_is_trusted_is_for_the_user_alone(tmp_path: Path) -> None:
    with Folder.at(tmp_path, CACHE_MODE) as folder:
        folder.write("name", b"")
    assert mode_of(tmp_path / "name") == 0o600


def test_a_planted_link_is_replaced_not_followed(folder: Folder, tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_bytes(b"precious")
    (folder.path / "name").symlink_to(victim)
    with pytest.raises(FileExistsError):
        folder.write_new("name", b"new")
    with pytest.raises(OSError, match="symbolic links"):
        folder.read("name", 100)
    with pytest.raises(FileExistsError):
        os.close(folder.create("name"))
    with pytest.raises(FileExistsError):
        os.close(create_file(folder.path / "name"))
    folder.write("name", b"new")
    assert victim.read_bytes() == b"precious"
    assert (folder.path / "name").read_bytes() == b"new"
    assert not (folder.path / "name").is_symlink()


def test_a_link_that_leads_nowhere_is_there(folder: Folder) -> None:
    (folder.path / "name").symlink_to("nowhere")
    assert folder.exists("name")
    folder.remove("name")
    assert not folder.exists("name")
    folder.remove("name")


def test_what_takes_the_folders_place_is_not_written_to(folder: Folder, tmp_path: Path) -> None:
    (tmp_path / "victim").mkdir()
    folder.path.rename(tmp_path / "moved")
    folder.path.symlink_to(tmp_path / "victim")
    folder.write("name", b"new")
    folder.write_new("other", b"new")
    assert list((tmp_path / "victim").iterdir()) == []
    assert sorted(folder.names()) == ["name", "other"]


def test_a_folder_that_is_a_link_is_not_opened(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    with pytest.raises(OSError, match=r"Not a directory|symbolic links"):
        Folder.at(tmp_path / "link", RESULT_MODE)
    with Folder.at(tmp_path / "link", RESULT_MODE, follow=True) as folder:
        assert folder.names() == []


@pytest.mark.parametrize("name", ["", ".", "..", "a/b", "/etc/passwd", "../up", "a\0b"])
def test_only_plain_names(name: str, folder: Folder) -> None:
    for use in (folder.create, folder.remove, folder.exists, lambda n: folder.write(n, b"")):
        with pytest.raises(ValueError, match="plain name"):
            use(name)


@pytest.mark.parametrize("write", WRITES)
@pytest.mark.parametrize("call", ["write", "fsync"])
def test_a_failed_write_leaves_what_was_there(
    call: str, write, folder: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a full disk the first, the second where the system writes later."""
    (folder.path / "old").write_bytes(b"old")

    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    class Full:
        """A file of which nothing can be written."""

        def __init__(self, file) -> None:
            self.file = file
            self.fileno = file.fileno
            self.flush = file.flush
            self.write = fail if call == "write" else file.write

        def __enter__(self):
            return self

        def __exit__(self, *_: object) -> None:
            self.file.close()

    monkeypatch.setattr(folder_module, "open", lambda *a: Full(os.fdopen(*a)), raising=False)
    monkeypatch.setattr(os, "fsync", fail)
    if call == "fsync" and write is WRITES[1]:
        write(folder)  # does not wait for the disk
        return
    with pytest.raises(OSError, match="No space"):
        write(folder)
    assert folder.names() == ["old"]


def test_a_file_system_without_hard_links(folder: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(os, "link", refuse)
    folder.write_new("name", b"first")
    with pytest.raises(FileExistsError):
        folder.write_new("name", b"second")
    assert folder.names() == ["name"]
    assert folder.read("name", 100) == b"first"


def test_what_others_may_write_to_is_not_read(folder: Folder) -> None:
    folder.write("name", b"new")
    (folder.path / "name").chmod(0o664)
    with pytest.raises(PermissionError, match="others may write"):
        folder.read("name", 100)


def test_what_is_another_users_is_not_read(folder: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    folder.write("name", b"new")
    monkeypatch.setattr(os, "getuid", lambda: os.geteuid() + 1)
    with pytest.raises(PermissionError, match="another user"):
        folder.read("name", 100)


def test_a_fifo_in_the_place_of_a_file_makes_nobody_wait(folder: Folder) -> None:
    os.mkfifo(folder.path / "name")
    with pytest.raises(PermissionError, match="another kind"):
        folder.read("name", 100)


@pytest.mark.parametrize("kind", ["link", "dangling link", "pipe", "folder", "nothing"])
def test_what_is_gone_on_with_is_a_file(kind: str, folder: Folder, tmp_path: Path) -> None:
    place, other = folder.path / "name", tmp_path / "other"
    if "link" in kind:
        place.symlink_to(other)
    if kind == "link":
        other.write_bytes(b"precious")
    if kind == "pipe":
        os.mkfifo(place)
    if kind == "folder":
        place.mkdir()
    with pytest.raises(OSError, match=r"symbolic|regular|directory|No such"):
        os.close(reopen_file(place))
    assert not other.exists() or other.read_bytes() == b"precious"


def test_a_file_is_gone_on_with(folder: Folder) -> None:
    folder.write("name", b"old")
    with os.fdopen(reopen_file(folder.path / "name"), "r+b") as file:
        assert file.read() == b"old"
        file.write(b"new")
    assert folder.read("name", 100) == b"oldnew"
