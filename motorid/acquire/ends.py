"""The device's end of a wire: a pseudo-terminal, or (where there is none) a socket on the loopback."""

from __future__ import annotations

import contextlib
import os
import select
import socket
from pathlib import Path
from typing import Protocol

from motorid.errors import UsageError

__all__ = ["End", "Pty", "Socket", "open_end"]

LOOPBACK = "127.0.0.1"


class End(Protocol):
    """The device's end of a wire."""

    name: str  # what the recorder is told as --port

    def wait(self, writing: bool, timeout: float) -> None:
        """Wait until there is something to read (or room to write)."""
        ...

    def read(self) -> bytes:
        """Return what the computer sent; nothing is an answer."""
        ...

    def write(self, data: bytes) -> int:
        """Return how many bytes were taken."""
        ...

    def unplug(self) -> None:
        """Vanish."""
        ...

    def plug(self) -> None:
        """Appear again."""
        ...


class Pty:
    """A pseudo-terminal; `link` is a symbolic link that follows it from one plugging to the next."""

    def __init__(self, link: Path | None = None) -> None:
        self.link = link
        if link and link.exists() and not link.is_symlink():
            raise UsageError(f"{link} exists and is not a link; choose another name for the port.")
        self.plug()

    def plug(self) -> None:
        """Open a new pseudo-terminal."""
        import tty

        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)  # no echo; holding this end open keeps the line up between users
        os.set_blocking(self._master, False)
        self.name = os.ttyname(self._slave)
        if self.link:
            self.link.unlink(missing_ok=True)
            self.link.symlink_to(self.name)
            self.name = str(self.link)

    def unplug(self) -> None:
        """Close it; whoever reads it gets an error, as from a device that was pulled out."""
        os.close(self._master)
        os.close(self._slave)
        if self.link:
            self.link.unlink(missing_ok=True)

    def wait(self, writing: bool, timeout: float) -> None:
        """Wait until there is something to read (or room to write)."""
        select.select([self._master], [self._master] if writing else [], [], timeout)

    def read(self) -> bytes:
        """Return what the computer sent."""
        try:
            return os.read(self._master, 4096)
        except OSError:
            return b""

    def write(self, data: bytes) -> int:
        """Return how many bytes were taken."""
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0


class Socket:
    """A socket on the loopback address, for one recorder at a time, as pyserial's ``socket://``."""

    def __init__(self, port: int = 0) -> None:
        self._port = port
        self._peer: socket.socket | None = None
        self.plug()

    def plug(self) -> None:
        """Listen, always on the same port."""
        self._server = socket.create_server((LOOPBACK, self._port))
        self._server.setblocking(False)
        self._port = self._server.getsockname()[1]
        self.name = f"socket://{LOOPBACK}:{self._port}"

    def unplug(self) -> None:
        """Hang up and listen no more."""
        self._hang_up()
        self._server.close()

    def wait(self, writing: bool, timeout: float) -> None:
        """Wait until somebody knocks, or there is something to read (or room to write)."""
        peer = [self._peer] if self._peer else []
        ready, _, _ = select.select([self._server, *peer], peer if writing else [], [], timeout)
        if self._server in ready:
            with contextlib.suppress(OSError):
                self._answer(self._server.accept()[0])

    def read(self) -> bytes:
        """Return what the computer sent."""
        if self._peer is None:
            return b""
        try:
            data = self._peer.recv(4096)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._hang_up()
        return data

    def write(self, data: bytes) -> int:
        """Return how many bytes were taken; all of them where nobody listens."""
        if self._peer is None:
            return len(data)
        try:
            return self._peer.send(data)
        except BlockingIOError:
            return 0
        except OSError:
            self._hang_up()
            return len(data)

    def _answer(self, peer: socket.socket) -> None:
        if self._peer is None:
            peer.setblocking(False)
            self._peer = peer
        else:
            peer.close()

    def _hang_up(self) -> None:
        if self._peer:
            self._peer.close()
            self._peer = None


def open_end(link: Path | None = None, port: int | None = None) -> End:
    """Open a pseudo-terminal, or a loopback socket where `port` is given or the system has no terminals."""
    return Pty(link) if port is None and hasattr(os, "openpty") else Socket(port or 0)
