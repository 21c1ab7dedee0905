"""Kernels on disk: what is damaged or not the user's own is compiled again, and never loaded."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

PROGRAM = """
import sys, pathlib
sys.path.insert(0, sys.argv[1])
import tiny
from ehadiag.compile import libraries
make, compiled, made = libraries._made, [], pathlib.Path(sys.argv[1], "made")

def make_once(*given):
    compiled.append(given)
    if not made.exists():
        made.write_bytes(make(*given))
    return made.read_bytes()

libraries._made = make_once
print(tiny.twice(21.0), len(compiled), "numba" in sys.modules)
"""
KERNEL = """
from ehadiag.compile.jit import kernel

@kernel
def twice(x: float) -> float:
    return x * 2.0
"""


class Process:
    """A program with one kernel, run in a process of its own with its cache in a folder.

    What the compiler made is beside it, and stands for a second compilation.
    """

    def __init__(self, home: Path, cache: Path) -> None:
        self.home, self.cache = home, cache
        (home / "tiny.py").write_text(KERNEL)

    def run(self, **environment: str) -> tuple[str, str]:
        """Return whether the kernel was loaded or compiled, and what was said."""
        gone = ("EHADIAG_CACHE_DIR", "XDG_CACHE_HOME", "HOME")
        kept = {key: value for key, value in os.environ.items() if key not in gone}
        kept |= environment or {"EHADIAG_CACHE_DIR": str(self.cache)}
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM, str(self.home)],
            env=kept,
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        value, compiled, numba = done.stdout.split()
        assert (value, numba) == ("42.0", "False")
        return {"0": "loaded", "1": "compiled"}[compiled], done.stderr

    @property
    def entry(self) -> Path:
        (found,) = self.cache.glob("kernels/*.kernel")
        return found


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the kernel in it."""
    place = tmp_path_factory.mktemp("compiled")
    process = Process(place, place / "cache")
    assert process.run() == ("compiled", "")
    assert process.run() == ("loaded", "")
    assert process.entry.stat().st_mode & 0o777 == 0o600
    return process.cache


@pytest.fixture
def process(compiled: Path, tmp_path: Path) -> Process:
    """A program that finds its kernel."""
    shutil.copytree(compiled, tmp_path / "cache")
    shutil.copy(compiled.parent / "made", tmp_path)
    return Process(tmp_path, tmp_path / "cache")


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda _: b"",
    "halved": lambda content: content[: len(content) // 2],
    "random": lambda content: bytes(os.urandom(len(content))),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_thrown_away_and_compiled_again(damage: str, process: Process) -> None:
    process.entry.write_bytes(DAMAGES[damage](process.entry.read_bytes()))
    how, said = process.run()
    assert how == "compiled"
    (line,) = said.splitlines()
    assert line.startswith(f"ehadiag: cache folder {process.entry.parent}: a compiled kernel is ")
    assert line.endswith("; thrown away")
    if damage == "halved":
        assert process.run() == ("loaded", "")


@pytest.mark.skipif(os.name != "posix", reason="links")
def test_a_planted_link_is_not_followed(process: Process, tmp_path: Path) -> None:
    planted, entry = tmp_path / "planted", process.entry
    planted.write_bytes(hashlib.sha256(b"").digest())
    entry.unlink()
    entry.symlink_to(planted)
    how, said = process.run()
    assert how == "compiled"
    assert "thrown away" in said
    assert planted.exists()
    assert not entry.is_symlink()


@pytest.mark.skipif(os.name != "posix", reason="owners and permissions")
@pytest.mark.parametrize("how", ["others may write", "another user's", "a link"])
def test_nothing_is_loaded_from_a_folder_that_others_could_write_to(
    how: str, process: Process, tmp_path: Path
) -> None:
    """A file with a sound digest, which no loader would take, where the kernel would be."""
    process.entry.write_bytes(hashlib.sha256(b"planted").digest() + b"planted")
    folder = process.entry.parent
    if how == "others may write":
        folder.chmod(0o777)
    elif how == "another user's":
        if os.geteuid() != 0:
            pytest.skip("only root gives a folder to another user")
        os.chown(folder, 12345, -1)
    else:
        folder.rename(tmp_path / "elsewhere")
        folder.symlink_to(tmp_path / "elsewhere")
    came, said = process.run()
    assert came == "compiled"
    (line,) = said.splitlines()
    assert "nothing is kept for the next run" in line


@pytest.mark.skipif(os.name != "posix", reason="POSIX users")
def test_without_a_home_the_shared_folder_is_left_alone(process: Process, tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    shared.mkdir(mode=0o1777)
    victim = tmp_path / "victim"
    victim.mkdir()
    (shared / f"ehadiag-{os.getuid()}").symlink_to(victim)
    for _ in range(2):
        how, said = process.run(TMPDIR=str(shared))
        assert how == "compiled"
        (line,) = said.splitlines()
        assert line == (
            "ehadiag: no home folder is known, so that nothing is kept for the next run: "
            "name a folder of your own by EHADIAG_CACHE_DIR"
        )
    assert list(victim.iterdir()) == []
    assert len(list(shared.iterdir())) == 1


def test_a_full_disk_keeps_nothing_and_goes_on(process: Process, tiny_disk: Path) -> None:
    (tiny_disk / "filler").write_bytes(b"x" * (63 << 10))
    how, said = process.run(EHADIAG_CACHE_DIR=str(tiny_disk))
    assert how == "compiled"
    (line,) = said.splitlines()
    assert "No space left on device" in line
    assert not list(tiny_disk.glob("kernels/*.kernel"))


def test_only_an_edit_of_code_that_a_kernel_uses_compiles_it_anew(process: Process) -> None:
    """The kernel's module imports another one: its docstrings and comments do not count."""
    package = process.home / "tiny"
    package.mkdir()
    (process.home / "made").unlink()
    kernel, factor = package / "__init__.py", package / "factor.py"
    text = KERNEL.replace("2.0", "FACTOR").replace("\n@", "\nfrom tiny.factor import FACTOR\n\n@")
    kernel.write_text(text)
    factor.write_text('"""A number."""\nFACTOR = 2.0\n"""Of what."""\n')
    assert process.run()[0] == "compiled"
    kernel.write_text("# A comment.\n" + text)
    factor.write_text('"""Another text."""\n\nFACTOR = 2.0  # and a comment\n')
    (package / "stranger.py").write_text("NUMBER = 1.0\n")
    assert process.run()[0] == "loaded"
    factor.write_text("FACTOR = 1.0 + 1.0\n")
    assert process.run()[0] == "compiled"
