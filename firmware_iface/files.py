"""Reads and writes files safely: untrusted configuration, results, the user's cache.

A small file or TOML of somebody else is read up to a limit and never quoted. A folder is held
open, and no link in it is followed. What is kept in the cache is trusted when it is read back
(compiled kernels are code), so its folder must be this user's alone, from the root on.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import re
import stat
import tomllib
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, Self, TypeVar

import msgspec

from firmware_iface.errors import ConfigurationError, InputOutputError, printable, reason_of


def read_small_file(path: Path, limit: int, what: str) -> bytes:
    """Read a whole file; `what` names it in errors, which never quote what is in it.

    A pipe or a device is refused at once, without waiting for its other end.

    limit: most bytes that it may have; what: its kind, for errors. InputOutputError: it cannot be
    read, or is no regular file; ConfigurationError: larger than `limit` bytes.
    """
    try:
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        handle = os.open(path, flags)
        try:
            regular = stat.S_ISREG(os.fstat(handle).st_mode)
            content = _read_up_to(handle, limit + 1) if regular else b""
        finally:
            os.close(handle)
    except (OSError, ValueError) as error:  # ValueError: a name with a null character
        reason = reason_of(error)
        raise InputOutputError(f"{what} {path}: {reason}") from None
    if not regular:
        raise InputOutputError(f"{what} {path}: not a regular file")
    if len(content) > limit:
        raise ConfigurationError(f"{what} {path}: larger than {limit} bytes")
    return content


def _read_up_to(handle: int, size: int) -> bytes:
    with os.fdopen(handle, "rb", closefd=False) as file:
        return file.read(size)


MAX_TOML_BYTES = 256 << 10
"""Largest configuration file that is read; configuration is untrusted input."""
MAX_DBC_BYTES = 2 << 20
"""Largest DBC file that is read, bytes."""
MAX_DOTS_PER_LINE = 50
"""In a line, besides those of numbers: the parser's work grows with the square of a key's parts."""
TOML_NUMBER = re.compile(rb"\d\.\d[\d_]*(?:[eE][+-]?\d+)?(?=[\s,\]}]|$)")
TOML_ERROR_PLACE = re.compile(r"\(at line (\d+), column (\d+)\)$")

T = TypeVar("T")


def read_toml(path: Path, kind: type[T], what: str) -> T:
    """Read a TOML file into a msgspec structure.

    path: file to read; kind: structure that it is checked against; what: name of the kind of file,
    for errors. Returns the content. InputOutputError: the file cannot be read, or is no regular
    file; ConfigurationError: too large, not TOML, or not what `kind` demands.
    """
    return decode_toml(read_small_file(path, MAX_TOML_BYTES, what), kind, f"{what} {path}")


def decode_toml(text: bytes, kind: type[T], where: str) -> T:
    """Decode TOML bytes into `kind`; `where` begins each error text."""
    if len(text) > MAX_TOML_BYTES:
        raise ConfigurationError(
            f"{where}: larger than {MAX_TOML_BYTES} bytes, not a configuration"
        )
    if any(
        line.count(b".") > MAX_DOTS_PER_LINE for line in TOML_NUMBER.sub(b"", text).split(b"\n")
    ):
        raise ConfigurationError(
            f"{where}: a line with more than {MAX_DOTS_PER_LINE} dots, besides numbers"
        )
    try:
        tree = tomllib.loads(text.decode("utf-8"))
        _refuse_non_finite(tree, where, "$")
        return msgspec.convert(tree, kind)
    except msgspec.ValidationError as error:
        raise ConfigurationError(f"{where}: {' '.join(str(error).split())}") from None
    except (ValueError, RecursionError) as error:  # a number may have too many digits
        raise ConfigurationError(f"{where}: not valid TOML{_error_place(error)}") from None


def _refuse_non_finite(node: Any, where: str, at: str) -> None:
    if isinstance(node, dict):
        for key, value in node.items():
            _refuse_non_finite(value, where, f"{at}.{key}")
    elif isinstance(node, list):
        for index, value in enumerate(node):
            _refuse_non_finite(value, where, f"{at}[{index}]")
    elif isinstance(node, float) and not math.isfinite(node):
        raise ConfigurationError(f"{where}: a finite number is needed at {at}, not {node}")


def _error_place(error: Exception) -> str:
    """Where the parser stumbled, without a word of what stands there: it may be any file."""
    found = TOML_ERROR_PLACE.search(str(error))
    return f" at line {found[1]}, column {found[2]}" if found else ""


RESULT_MODE = 0o644
"""Results and recordings, less the caller's umask."""
CACHE_MODE = 0o600
"""What is trusted when it is read back."""

HAS_FOLDER_DESCRIPTORS = {os.open, os.rename, os.unlink, os.stat} <= os.supports_dir_fd
"""Not on Windows: there the folder's path stands for it, and folders have access lists."""


def _flags(*names: str) -> int:
    """Flags of `os.open`, those that this system has."""
    return sum(getattr(os, name, 0) for name in names)


OPEN_NO_LINK = _flags("O_NOFOLLOW")
OPEN_FOLDER = OPEN_NO_LINK | _flags("O_RDONLY", "O_DIRECTORY")
# A FIFO in the place of a file must not make anybody wait.
OPEN_READ = OPEN_NO_LINK | _flags("O_RDONLY", "O_NONBLOCK", "O_BINARY")
OPEN_READ_WRITE = OPEN_NO_LINK | _flags("O_RDWR", "O_NONBLOCK", "O_BINARY")
OPEN_APPEND = OPEN_NO_LINK | _flags("O_WRONLY", "O_APPEND", "O_CREAT", "O_NONBLOCK", "O_BINARY")
OPEN_CREATE = OPEN_NO_LINK | _flags("O_RDWR", "O_CREAT", "O_EXCL", "O_BINARY")


class Folder:
    """One folder, named by a descriptor: what is put in its place later is not followed.

    Every method takes the plain name of a file and raises OSError.

    path: of the folder, for messages (and for the work where there are no descriptors of folders);
    descriptor: of the open folder, which this object closes; None where there is none; mode: of the
    files that are created.
    """

    def __init__(self, path: Path, descriptor: int | None, mode: int) -> None:
        self.path = path
        self._descriptor = descriptor
        self._mode = mode

    @classmethod
    def at(cls, path: Path, mode: int, *, follow: bool = False) -> Self:
        """Open a folder; the last part of its path may be a link only if `follow` is true."""
        if HAS_FOLDER_DESCRIPTORS:
            flags = OPEN_FOLDER & ~OPEN_NO_LINK if follow else OPEN_FOLDER
            return cls(path, os.open(path, flags), mode)
        if not path.is_dir():
            raise NotADirectoryError(f"not a folder: {path}")
        return cls(path, None, mode)

    def names(self) -> list[str]:
        """Names of what is in the folder."""
        return os.listdir(self.path if self._descriptor is None else self._descriptor)

    def exists(self, name: str) -> bool:
        """Whether there is something of this name, be it a link that leads nowhere."""
        with contextlib.suppress(FileNotFoundError):
            os.stat(self._place(name), dir_fd=self._descriptor, follow_symlinks=False)
            return True
        return False

    def changed_at(self, name: str) -> float:
        """Time of the last change of a file, s."""
        info = os.stat(self._place(name), dir_fd=self._descriptor, follow_symlinks=False)
        return info.st_mtime

    def read(self, name: str, most: int) -> bytes:
        """Read up to `most` bytes of a regular file that is the caller's own.

        PermissionError: the file is another user's, or others may write to it.
        """
        with open(self._open(name, OPEN_READ), "rb") as file:
            refuse_foreign(os.fstat(file.fileno()), stat.S_ISREG)
            return file.read(most)

    def create(self, name: str) -> int:
        """Create a file that grows; FileExistsError if there is one, or a link.

        Returns a descriptor for reading and writing, to be closed by the caller.
        """
        return self._open(name, OPEN_CREATE)

    def append(self, name: str) -> int:
        """Open a file to be appended to, or create it; PermissionError for what is no file.

        Returns a descriptor for writing, to be closed by the caller.
        """
        return self._open_regular(name, OPEN_APPEND)

    def reopen(self, name: str) -> int:
        """Open a file that is there to go on with it; PermissionError for what is no file.

        Returns a descriptor for reading and writing, to be closed by the caller.
        """
        return self._open_regular(name, OPEN_READ_WRITE)

    def write(self, name: str, content: bytes, *, synced: bool = True) -> None:
        """Write a file whole, or leave what was there.

        synced: wait until the content is on the disk.
        """
        draft = self._draft(content, synced)
        self._settle(draft, name, synced)

    @contextlib.contextmanager
    def drafted(self, name: str) -> Iterator[BinaryIO]:
        """Give a file to write that gets its name when the block ends; by an exception, never."""
        draft = self._draft_name()
        try:
            with open(self.create(draft), "wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
        except BaseException:
            self.remove(draft)
            raise
        self._settle(draft, name, synced=True)

    def write_new(self, name: str, content: bytes) -> None:
        """Write a file whole; FileExistsError if there is one of this name already."""
        draft = self._draft(content, synced=True)
        try:
            os.link(
                self._place(draft),
                self._place(name),
                src_dir_fd=self._descriptor,
                dst_dir_fd=self._descriptor,
                follow_symlinks=os.link not in os.supports_follow_symlinks,
            )
        except FileExistsError:
            self.remove(draft)
            raise
        except OSError:  # a file system without a second name for a file, such as FAT
            if self.exists(name):
                self.remove(draft)
                raise FileExistsError(name) from None
            self._settle(draft, name, synced=True)
        else:
            self.remove(draft)
            self._sync()

    def remove(self, name: str) -> None:
        """Remove a file, or a link; nothing happens if there is none."""
        with contextlib.suppress(FileNotFoundError):
            os.unlink(self._place(name), dir_fd=self._descriptor)

    def close(self) -> None:
        """Let the folder go; may be called twice."""
        if self._descriptor is not None:
            descriptor, self._descriptor = self._descriptor, None
            os.close(descriptor)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _place(self, name: str) -> str:
        if name in ("", ".", "..") or "/" in name or "\0" in name or os.sep in name:
            raise ValueError(f"not the plain name of a file: {name!r}")
        return name if HAS_FOLDER_DESCRIPTORS else str(self.path / name)

    def _open(self, name: str, flags: int) -> int:
        return os.open(self._place(name), flags, self._mode, dir_fd=self._descriptor)

    def _open_regular(self, name: str, flags: int) -> int:
        descriptor = self._open(name, flags)
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            os.close(descriptor)
            raise PermissionError(errno.EACCES, "not a regular file", name)
        return descriptor

    @staticmethod
    def _draft_name() -> str:
        return f".ehadiag-{os.urandom(8).hex()}.part"

    def _draft(self, content: bytes, synced: bool) -> str:
        """Write a temporary file beside the one that it will be."""
        name = self._draft_name()
        try:
            with open(self.create(name), "wb") as file:
                file.write(content)
                file.flush()
                if synced:
                    os.fsync(file.fileno())
        except BaseException:
            self.remove(name)
            raise
        return name

    def _settle(self, draft: str, name: str, synced: bool) -> None:
        """Give a draft its name."""
        try:
            os.replace(
                self._place(draft),
                self._place(name),
                src_dir_fd=self._descriptor,
                dst_dir_fd=self._descriptor,
            )
        except BaseException:
            self.remove(draft)
            raise
        if synced:
            self._sync()

    def _sync(self) -> None:
        """Bring the names to the disk, where the file system can."""
        if self._descriptor is not None:
            with contextlib.suppress(OSError):
                os.fsync(self._descriptor)


def create_file(path: Path) -> int:
    """Create a result that grows, such as a recording; OSError if it exists, or a link does.

    Returns a descriptor for reading and writing, to be closed by the caller.
    """
    with Folder.at(path.parent, RESULT_MODE, follow=True) as folder:
        return folder.create(path.name)


def append_to_file(path: Path) -> int:
    """Open a result that grows from call to call; OSError for a link and for what is no file.

    Returns a descriptor for writing, to be closed by the caller.
    """
    with Folder.at(path.parent, RESULT_MODE, follow=True) as folder:
        return folder.append(path.name)


def reopen_file(path: Path) -> int:
    """Open a result to go on with; OSError for a link, for what is no file, and for none.

    Returns a descriptor for reading and writing, to be closed by the caller.
    """
    with Folder.at(path.parent, RESULT_MODE, follow=True) as folder:
        return folder.reopen(path.name)


@contextlib.contextmanager
def write_errors(what: str) -> Iterator[None]:
    """Raise InputOutputError, in one line, where what the block writes cannot be written."""
    try:
        yield
    except (OSError, ValueError) as error:  # ValueError: a name with a null character
        raise InputOutputError(f"{what}: {reason_of(error)}") from None


def unused_path(folder: Path, stem: str, suffix: str) -> Path:
    """Return a path that no file has: the stem, numbered where it is taken."""
    path, number = folder / f"{stem}{suffix}", 1
    while os.path.lexists(path):
        number += 1
        path = folder / f"{stem}-{number}{suffix}"
    return path


def write_file(path: Path, content: bytes, kind: str) -> None:
    """Write a result in one piece; one that exists is replaced.

    path: file to write; content: all of it; kind: kind of file, for errors. InputOutputError: it
    cannot be written.
    """
    with (
        write_errors(f"{kind} {path}"),
        Folder.at(path.parent, RESULT_MODE, follow=True) as folder,
    ):
        folder.write(path.name, content)


def refuse_foreign(info: os.stat_result, right_kind: Callable[[int], bool]) -> None:
    """Raise PermissionError unless this is the caller's own and nobody else may write to it."""
    if not right_kind(info.st_mode):
        raise PermissionError("is of another kind")
    if hasattr(os, "getuid"):
        if info.st_uid != os.getuid():
            raise PermissionError("belongs to another user")
        if info.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            raise PermissionError("others may write to it")


CACHE_FOLDER_ADVICE = "name a folder of your own by EHADIAG_CACHE_DIR"


def private_folder(leaf: str) -> Folder | None:
    """Open the folder `leaf` in the cache, created if need be; None if it cannot be had.

    In `EHADIAG_CACHE_DIR`, else in the user's cache folder. What stands in the way is said once.
    """
    base = _cache_base()
    if base is None:
        warn_once(
            f"no home folder is known, so that nothing is kept for the next run: "
            f"{CACHE_FOLDER_ADVICE}"
        )
        return None
    try:
        return _open_cache_folder(base / leaf)
    except OSError as error:
        why = reason_of(error)
        warn_once(
            f"cache folder {base}: {why}; nothing is kept for the next run: {CACHE_FOLDER_ADVICE}"
        )
        return None


@cache
def warn_once(text: str) -> None:
    """Say once in this process that a cache does not do its work; nothing else changes."""
    import logging  # noqa: PLC0415 - loads much, and is seldom needed

    logging.getLogger("ehadiag").warning("ehadiag: %s", printable(text))


def _cache_base() -> Path | None:
    if named := os.environ.get("EHADIAG_CACHE_DIR"):
        return Path(os.path.abspath(named))
    if (xdg := os.environ.get("XDG_CACHE_HOME")) and os.path.isabs(xdg):
        return Path(os.path.normpath(xdg), "ehadiag")
    if home := os.environ.get("HOME"):
        return Path(os.path.abspath(home), ".cache", "ehadiag")
    if local := os.environ.get("LOCALAPPDATA"):  # Windows
        return Path(local, "ehadiag")
    return None


def _open_cache_folder(path: Path) -> Folder:
    """Walk to the folder from the root, and look at each folder on the way."""
    if not HAS_FOLDER_DESCRIPTORS:
        path.mkdir(parents=True, exist_ok=True)
        return Folder.at(path, CACHE_MODE)
    walked = Path(path.anchor)
    at = os.open(walked, OPEN_FOLDER)
    # Where root has no number of its own (in a container without rights) it still owns the root.
    trusted = {0, os.getuid(), os.fstat(at).st_uid}
    try:
        for part in path.parts[1:]:
            _refuse_shared(os.fstat(at), trusted, walked)
            walked /= part
            inside = _enter_folder(at, part, walked)
            os.close(at)
            at = inside
        refuse_foreign(os.fstat(at), stat.S_ISDIR)
    except BaseException:
        os.close(at)
        raise
    return Folder(path, at, CACHE_MODE)


def _enter_folder(at: int, name: str, path: Path) -> int:
    """Open a folder in another, created if need be."""
    try:
        try:
            return os.open(name, OPEN_FOLDER, dir_fd=at)
        except FileNotFoundError:
            with contextlib.suppress(FileExistsError):  # another process was quicker
                os.mkdir(name, 0o700, dir_fd=at)
            return os.open(name, OPEN_FOLDER, dir_fd=at)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.EMLINK, errno.ENOTDIR):
            raise PermissionError(f"{path} is a link, or no folder") from None
        raise


def _refuse_shared(info: os.stat_result, trusted: set[int], path: Path) -> None:
    """Raise PermissionError where another user could exchange what is in a folder on the way."""
    if info.st_uid not in trusted:
        raise PermissionError(f"{path} belongs to another user")
    if info.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and not info.st_mode & stat.S_ISVTX:
        raise PermissionError(f"others may write to {path}")
