"""The computer's end of the protocol: ask, wait, ask again if an answer got lost; and the serial link under it."""

import contextlib
import errno
import math
import os
import select
import threading
import time
from queue import Empty, SimpleQueue
from typing import Any, Protocol

from motorid.acquire.excitation import Program
from motorid.acquire.protocol import Decoder, Header, Message, Sample, frame
from motorid.errors import DeviceError, MissingDependency

BOOT = 4.0  # s: opening the port resets many boards
AGAIN = 0.4  # s after which an unanswered command is repeated
ANSWER = 3.0  # s after which it is given up
KEEP_ALIVE = 0.2  # s
BATCH = 0.004  # s between two reads: bytes are gathered, so that 5,000 lines do not cost 5,000 wake-ups


class Client:
    """Talks to a device over a link."""

    def __init__(self, link: "Link") -> None:
        self.link = link
        self.decoder = Decoder()
        self.inbox: list[Sample | Message] = []  # came while an answer was awaited, and is not it
        self._spoken = 0.0

    def receive(self, timeout: float) -> list[Sample | Message]:
        """Return what comes within `timeout` s, sooner if something does."""
        return self.decoder.feed(self.link.read(timeout))

    def keep_alive(self) -> None:
        """Tell the device, every 0.2 s, that somebody is listening."""
        if (now := time.monotonic()) - self._spoken > KEEP_ALIVE:
            self.link.write(frame("K"))
            self._spoken = now

    def hello(self) -> Header:
        """Return the header of the device, having stopped whatever it did; a DeviceError guesses why nobody answers."""
        try:
            header = Header.read(self.ask("?", "H", within=BOOT))
        except LinkLost as error:
            raise DeviceError(f"{error} Nobody had answered yet: is it in use by another recorder?") from None
        self.ask("X", "E,done")
        return header

    def prepare(self, header: Header, v_max: float, i_max: float, program: Program) -> tuple[float, float]:
        """Send limits and program; return the limits now in force, in V and A. DeviceError if the device refuses."""
        v, i = min(v_max, header.v_max), min(i_max, header.i_max)
        _, _, mv, ma = self.ask(f"L,{_milli(v)},{_milli(i)}", "A,L")
        if int(mv) > _milli(v) or int(ma) > _milli(i):
            raise DeviceError(f"the device was told to stay within {v:g} V and {i:g} A and answers with "
                              f"{int(mv) / 1e3:g} V and {int(ma) / 1e3:g} A. Nothing was applied to the motor.")
        for k, segment in enumerate(program.segments):
            self.ask(",".join(map(str, ("S", k, segment.shape, segment.ms, *segment.args))), f"A,S,{k}")
        return int(mv) / 1e3, int(ma) / 1e3

    def go(self, segments: int) -> tuple[int, int]:
        """Start the run; return counter and device time (µs) of its first sample."""
        self.inbox.clear()
        answer = self.ask(f"G,{segments}", "A,G")
        return int(answer[2]), int(answer[3])

    def ask(self, command: str, answer: str, within: float = ANSWER) -> list[str]:
        """Send a command until its answer comes; return its fields. DeviceError if the device refuses or is silent."""
        end, wanted = time.monotonic() + within, answer.split(",")
        while (now := time.monotonic()) < end:
            self.link.write(frame(command))
            while (left := now + AGAIN - time.monotonic()) > 0:
                got = self.receive(left)
                for k, item in enumerate(got):
                    if isinstance(item, Sample):
                        self.inbox.append(item)
                    elif item.fields[:len(wanted)] == wanted and _complete(item.fields):
                        self.inbox += got[k + 1:]
                        return item.fields
                    elif item.fields[:2] == ["E", "refused"]:
                        raise DeviceError(f"the device refuses '{command}': {','.join(item.fields[2:])}.")
        if command != "?":
            raise DeviceError(f"the device did not answer '{command}' within {within:g} s.")
        if not self.decoder.seen:
            raise DeviceError(f"nothing answered within {BOOT:g} s. Is it the right port, and does the board run the "
                              "motorid firmware?")
        bad = any(self.decoder.bad.values())
        why = "none of it in the protocol. Is the baud rate right?" if bad else "but no header came."
        raise DeviceError(f"no bench answered within {BOOT:g} s: {self.decoder.seen} bytes came, {why}")


def _complete(fields: list[str]) -> bool:
    """Whether an answer carries the whole numbers it has to."""
    numbers = {"L": 2, "S": 1, "G": 2, "done": 1}.get("".join(fields[1:2]), 0)
    found = fields[2:2 + numbers]
    return fields[0] == "H" or (len(found) == numbers and all(f.isdigit() for f in found))


def _milli(value: float) -> int:
    return min(2_000_000_000, math.floor(value * 1e3 + 1e-6)) if math.isfinite(value) else 2_000_000_000


class LinkLost(DeviceError):
    """The other end is gone: unplugged, or closed."""


class Link(Protocol):
    """What a recorder needs of a wire."""

    def read(self, timeout: float) -> bytes:
        """Return what has come, at the latest after `timeout` s (then perhaps nothing); LinkLost at the end."""
        ...

    def write(self, data: bytes) -> None:
        """Send; LinkLost if nobody is there."""

    def close(self) -> None:
        """Let go."""


class SerialLink:
    """An exclusively opened port: ``/dev/ttyACM0``, ``COM3``, ``socket://host:port``; `DeviceError` if it cannot be."""

    def __init__(self, port: str, baud: int = 115_200) -> None:
        self.port = port
        try:
            import serial
        except ImportError:
            raise MissingDependency("recording needs pyserial: pip install pyserial") from None
        own = {} if "://" in port else {"baudrate": baud, "exclusive": True}
        try:
            self._serial = serial.serial_for_url(port, timeout=0.05, write_timeout=1.0, **own)
        except (OSError, ValueError, TypeError) as error:  # TypeError: an address without its port
            raise DeviceError(_why_not(port, baud, error)) from None
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
            raise LinkLost(f"{self.port} cannot be written to ({error}).") from None

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
                if data := _read_once(self._serial):
                    self._queue.put(data)
                    time.sleep(BATCH)
        except (OSError, TypeError, ValueError) as error:  # the last two: closed under our feet
            self._queue.put(error)


def _read_once(serial: Any) -> bytes:
    """Return the bytes of one read, never throwing away what came just before an unplugging."""
    if os.name != "posix":
        return serial.read(max(1, min(serial.in_waiting, 65536)))
    # pyserial's own read() gathers in a loop and drops what it has gathered when the port dies.
    if not select.select([serial.fileno()], [], [], 0.05)[0]:
        return b""
    try:
        data = os.read(serial.fileno(), 65536)
    except BlockingIOError:
        return b""
    if not data:
        raise OSError(errno.EIO, "closed by the other end")
    return data


def _why_not(port: str, baud: int, error: Exception) -> str:
    number = getattr(error, "errno", None)
    if isinstance(error, ValueError):
        return f"{port} cannot be opened at {baud} baud: {error}."
    if port.startswith("socket://") and not port.rpartition(":")[2].isdigit():
        return f"{port} cannot be opened: it names no port; expected e.g. socket://127.0.0.1:7000."
    if "://" in port:
        return f"{port} cannot be opened: {str(error).removeprefix(f'Could not open port {port}: ')}."
    if number == errno.ENOENT or ("could not open port" in str(error).lower() and not number):
        from serial.tools import list_ports

        names = [p.device for p in list_ports.comports()]
        seen = f"Ports on this computer: {', '.join(names)}." if names else "This computer sees no serial port."
        return f"there is no port {port}. {seen}"
    if number in (errno.EACCES, errno.EPERM):
        return (f"you may not open {port}. On Linux, become a member of the group that owns it (often "
                "'dialout') and log in again.")
    if number in (errno.EAGAIN, errno.EBUSY) or "exclusively lock" in str(error):
        return f"{port} is in use, perhaps by another recorder or a serial monitor. Close that first."
    return f"{port} cannot be opened: {error}."
