"""A folder held open: files in it are read and written whole, and no link in it is followed.

Every file that the package writes, and every file that it reads back and trusts, goes through here.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, Self

__all__ = [
    "BY_DESCRIPTOR",
    "CACHE_MODE",
    "OPEN_FOLDER",
    "RESULT_MODE",
    "Folder",
    "append_to_file",
    "create_file",
    "refuse_foreign",
    "reopen_file",
]

RESULT_MODE = 0o644
"""Results and recordings, less the caller's umask."""
CACHE_MODE = 0o600
"""What is trusted when it is read back."""

BY_DESCRIPTOR = {os.open, os.rename, os.unlink, os.stat} <= os.supports_dir_fd
"""Not on Windows: there the folder's path stands for it, and folders have access lists."""
NO_LINK = getattr(os, "O_NOFOLLOW", 0)
OPEN_FOLDER = os.O_RDONLY | getattr(os, "O_DIRECTORY", 0) | NO_LINK
# A FIFO in the place of a file must not make anybody wait.
READ = os.O_RDONLY | NO_LINK | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
CHANGE = os.O_RDWR | NO_LINK | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
APPEND = (CHANGE & ~os.O_RDWR) | os.O_WRONLY | os.O_APPEND | os.O_CREAT
CREATE = os.O_RDWR | os.O_CREAT | os.O_EXCL | NO_LINK | getattr(os, "O_BINARY", 0)


class Folder:
    """One folder, named by a descriptor: what is put in its place later is not followed.

    Every method takes the plain name of a file and raises OSError.

    Parameters
    ----------
    path : Path
        Of the folder, for messages (and for the work where there are no descriptors of folders).
    descriptor : int | None
        Of the open folder, which this object closes; None where there is none.
    mode : int
        Of the files that are created.
    """

    def __init__(self, path: Path, descriptor: int | None, mode: int) -> None:
        self.path = path
        self._descriptor = descriptor
        self._mode = mode

    @classmethod
    def at(cls, path: Path, mode: int, *, follow: bool = False) -> Self:
        """Open a folder; the last part of its path may be a link only if `follow` is true."""
        if BY_DESCRIPTOR:
            flags = OPEN_FOLDER & ~NO_LINK if follow else OPEN_FOLDER
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
        with open(self._open(name, READ), "rb") as file:
            refuse_foreign(os.fstat(file.fileno()), stat.S_ISREG)
            return file.read(most)

    def create(self, name: str) -> int:
        """Create a file that grows; FileExistsError if there is one, or a link.

        Returns a descriptor for reading and writing, to be closed by the caller.
        """
        return self._open(name, CREATE)

    def append(self, name: str) -> int:
        """Open a file to be appended to, or create it; PermissionError for what is no file.

        Returns a descriptor for writing, to be closed by the caller.
        """
        return self._open_regular(name, APPEND)

    def reopen(self, name: str) -> int:
        """Open a file that is there to go on with it; PermissionError for what is no file.

        Returns a descriptor for reading and writing, to be closed by the caller.
        """
        return self._open_regular(name, CHANGE)

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
        return name if BY_DESCRIPTOR else str(self.path / name)

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


def refuse_foreign(info: os.stat_result, right_kind: Callable[[int], bool]) -> None:
    """Raise PermissionError unless this is the caller's own and nobody else may write to it."""
    if not right_kind(info.st_mode):
        raise PermissionError("is of another kind")
    if hasattr(os, "getuid"):
        if info.st_uid != os.getuid():
            raise PermissionError("belongs to another user")
        if info.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            raise PermissionError("others may write to it")
