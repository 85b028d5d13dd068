"""A file that only ever grows by whole lines, is never written over unasked, and reaches the disk soon."""

from __future__ import annotations

import errno
import os
import threading
from pathlib import Path

from motorid.errors import UsageError

__all__ = ["Appender"]

SYNC_EVERY = 0.5  # s between two calls of fsync: what is older than that survives a power cut


class Appender:
    """Appends lines. A thread carries them to the disk, so that a slow one does not hold up the recording.

    Parameters
    ----------
    path : Path
    mode : {"new", "replace", "resume"}
        A new file must not exist; one to resume is cut back to its last whole line.

    Raises
    ------
    UsageError
        If the file may not be written, has appeared meanwhile, or another recorder has it.
    """

    def __init__(self, path: Path, mode: str) -> None:
        self.lines = 0  # handed to the operating system by this object
        self._fd = _open(path, mode)
        self._size = os.fstat(self._fd).st_size
        self._synced = self._size
        self._trouble: OSError | None = None
        self._over = threading.Event()
        if mode == "resume":
            self._cut_back(path)
        self._thread = threading.Thread(target=self._keep_syncing, name=f"syncing {path}", daemon=True)
        self._thread.start()

    def append(self, data: bytes) -> None:
        """Hand whole lines to the operating system.

        If it refuses (the disk is full, say), the file is cut back to the last whole line that fitted, and
        the OSError passed on; so is trouble that the disk had with earlier lines.
        """
        if self._trouble:
            raise self._trouble
        written = 0
        try:
            while written < len(data):
                written += os.write(self._fd, data[written:])
        finally:
            whole = data.rfind(b"\n", 0, written) + 1
            self._size += whole
            self.lines += data.count(b"\n", 0, whole)
            if whole < written:
                os.ftruncate(self._fd, self._size)

    def close(self, sync: bool = True) -> None:
        """Carry the rest to the disk and close the file; a second time, do nothing."""
        if self._over.is_set():
            return
        self._over.set()
        self._thread.join()
        try:
            if sync:
                self._sync()
        finally:
            os.close(self._fd)

    def _keep_syncing(self) -> None:
        while not self._over.wait(SYNC_EVERY):
            try:
                self._sync()
            except OSError as error:
                self._trouble = error
                return

    def _sync(self) -> None:
        size = self._size
        if size != self._synced:
            os.fsync(self._fd)
            self._synced = size

    def _cut_back(self, path: Path) -> None:
        with open(path, "rb") as file:
            file.seek(max(0, self._size - 4096))
            end = file.read()
        cut = len(end) - (end.rfind(b"\n") + 1)
        if cut:
            self._size -= cut
            os.ftruncate(self._fd, self._size)


def _open(path: Path, mode: str) -> int:
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | getattr(os, "O_BINARY", 0)
    try:
        fd = os.open(path, flags | (os.O_EXCL if mode == "new" else 0), 0o644)
    except FileExistsError:
        raise UsageError(f"{path} has appeared meanwhile and is left alone; choose another name.") from None
    except OSError as error:
        raise UsageError(f"{path} cannot be written: {error.strerror}.") from None
    try:
        _lock(fd, path)
        if mode == "replace":
            os.ftruncate(fd, 0)
    except BaseException:
        os.close(fd)
        raise
    return fd


def _lock(fd: int, path: Path) -> None:
    try:
        import fcntl
    except ImportError:  # no such locks on this system; the port itself is exclusive there
        return
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
            return  # a file system without locks
        raise UsageError(f"another recorder is writing {path}; choose another name.") from None
