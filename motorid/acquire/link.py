"""The wire: a serial port (or pyserial's ``socket://``), read by a thread so that a slow disk loses
nothing."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import threading
import time
from queue import Empty, SimpleQueue
from typing import Any, Protocol

from motorid.errors import DeviceError, MissingDependency

__all__ = ["Link", "LinkLost", "SerialLink"]

BATCH = 0.004  # s between two reads: bytes are gathered, so that 5,000 lines do not cost 5,000 wake-ups


class LinkLost(DeviceError):
    """The other end is gone: unplugged, or closed."""


class Link(Protocol):
    """What a recorder needs of a wire."""

    def read(self, timeout: float) -> bytes:
        """Return what has come, at the latest after `timeout` s (then perhaps nothing); LinkLost at the
        end."""
        ...

    def write(self, data: bytes) -> None:
        """Send; LinkLost if nobody is there."""
        ...

    def close(self) -> None:
        """Let go."""
        ...


class SerialLink:
    """An exclusively opened port.

    Parameters
    ----------
    port : str
        ``/dev/ttyACM0``, ``COM3``, or ``socket://127.0.0.1:7000``.
    baud : int
        Bits per second; USB devices do not care.

    Raises
    ------
    DeviceError
        If it cannot be opened: it is not there, somebody else has it, or the user may not.
    """

    def __init__(self, port: str, baud: int = 115_200) -> None:
        self.port = port
        self._serial = _open(port, baud)
        self._queue: SimpleQueue[bytes | Exception] = SimpleQueue()
        self._closing = False
        self._lost: LinkLost | None = None
        self._thread = threading.Thread(target=self._pump, name=f"reading {port}", daemon=True)
        self._thread.start()

    def read(self, timeout: float) -> bytes:
        """Return what has come; LinkLost once everything that came before the end has been returned."""
        pieces: list[bytes] = []
        with contextlib.suppress(Empty):
            while self._lost is None:
                piece = self._queue.get(timeout=timeout) if not pieces else self._queue.get_nowait()
                if isinstance(piece, Exception):
                    self._lost = LinkLost(f"{self.port} is gone ({piece}).")
                else:
                    pieces.append(piece)
        if self._lost and not pieces:
            raise self._lost
        return b"".join(pieces)

    def write(self, data: bytes) -> None:
        """Send; LinkLost if nobody is there."""
        try:
            self._serial.write(data)
        except OSError as error:  # pyserial's errors are OSErrors
            raise LinkLost(f"{self.port} does not take what is sent ({error}).") from None

    def close(self) -> None:
        """Stop the thread and let the port go."""
        self._closing = True
        self._thread.join(timeout=1.0)
        wire = getattr(self._serial, "_socket", None)  # pyserial leaves it open when the other end went first
        with contextlib.suppress(OSError):
            self._serial.close()
        if wire is not None:
            wire.close()

    def _pump(self) -> None:
        try:
            while not self._closing:
                data = _read_once(self._serial)
                if data:
                    self._queue.put(data)
                    time.sleep(BATCH)
        except (OSError, TypeError, ValueError) as error:  # the last two: closed under our feet
            self._queue.put(error)


def _read_once(serial: Any) -> bytes:
    """Return the bytes of one read, never throwing away what came just before an unplugging."""
    if os.name != "posix":
        return serial.read(max(1, min(serial.in_waiting, 65536)))
    # pyserial's own read() gathers in a loop and drops what it has gathered when the port dies.
    ready, _, _ = select.select([serial.fileno()], [], [], 0.05)
    if not ready:
        return b""
    try:
        data = os.read(serial.fileno(), 65536)
    except BlockingIOError:
        return b""
    if not data:
        raise OSError(errno.EIO, "closed by the other end")
    return data


def _open(port: str, baud: int) -> Any:
    try:
        import serial
    except ImportError:
        raise MissingDependency("recording needs pyserial: pip install pyserial") from None
    own = {} if "://" in port else {"baudrate": baud, "exclusive": True}
    try:
        return serial.serial_for_url(port, timeout=0.05, write_timeout=1.0, **own)
    except (OSError, ValueError) as error:
        raise DeviceError(_why_not(port, baud, error)) from None


def _why_not(port: str, baud: int, error: Exception) -> str:
    number = getattr(error, "errno", None)
    if isinstance(error, ValueError):
        return f"{port} cannot be opened at {baud} baud: {error}."
    if "://" in port:
        return f"{port} cannot be opened: {str(error).removeprefix(f'Could not open port {port}: ')}."
    if number == errno.ENOENT or ("could not open port" in str(error).lower() and not number):
        return f"there is no port {port}. {_known_ports()}"
    if number in (errno.EACCES, errno.EPERM):
        return (f"you may not open {port}. On Linux, become a member of the group that owns it (often "
                "'dialout') and log in again.")
    if number in (errno.EAGAIN, errno.EBUSY) or "exclusively lock" in str(error):
        return f"{port} is in use, perhaps by another recorder or a serial monitor. Close that first."
    return f"{port} cannot be opened: {error}."


def _known_ports() -> str:
    from serial.tools import list_ports

    names = [p.device for p in list_ports.comports()]
    return f"Ports on this computer: {', '.join(names)}." if names else "This computer sees no serial port."
