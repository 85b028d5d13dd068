"""Serve a virtual device in real time: the loop, its transport (pseudo-terminal or socket), and faults on the wire."""

import contextlib
import os
import select
import socket
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from motorid.acquire.protocol import SILENCE
from motorid.acquire.virtual import VirtualDevice
from motorid.errors import UsageError, otherwise

BUFFER = 65_536  # bytes a device keeps for a computer that does not read; what is more is lost, as in reality
STALLED = 0.5  # s without a byte taken after which the computer counts as one that does not read
TICK = 0.002  # s
LOOPBACK = "127.0.0.1"


@dataclass(frozen=True)
class Pace:
    """How a virtual bench behaves in time."""

    speed: float = 1.0  # times real time; 0 is as fast as the other end reads
    unplug_after: float | None = None  # seconds of a run after which the line dies
    plug_after: float | None = None  # and after which it comes back; None: never
    once: bool = False  # whether to end when the first run is over and the recorder has gone


def serve(make: Callable[[], VirtualDevice], transport: "Transport", wire: "Wire", pace: Pace,
          stop: Callable[[], bool] = lambda: False) -> VirtualDevice:
    """Serve devices made by `make` until `stop()` says so; return the last one."""
    bench = _Bench(make, transport, wire, pace)
    try:
        while not stop() and not bench.over:
            bench.turn()
    finally:
        if bench.plugged:
            transport.unplug()
    return bench.device


class _Bench:
    """One turn after the other: hear, run, speak."""

    def __init__(self, make: Callable[[], VirtualDevice], transport: "Transport", wire: "Wire", pace: Pace) -> None:
        self.make, self.transport, self.wire, self.pace = make, transport, wire, pace
        self.device = make()
        self.plugged, self.over = True, False
        self.unplug_at = pace.unplug_after
        self.out = b""
        self.began, self.sent, self.ran = 0.0, 0, False
        self.read_at = 0.0  # when the other end last took something

    def turn(self) -> None:
        """Do what is due."""
        was_running = self.device.running
        self.transport.wait(bool(self.out), TICK if was_running and self.pace.speed else 0.05 * (not was_running))
        now = time.monotonic()
        self.out += self.device.receive(self.transport.read(), now) + self.device.watch(now)
        if self.device.running and not was_running:
            self.began, self.sent, self.ran = now, 0, True
        if self.device.running:
            self._run(now)
        taken = self.transport.write(self.out) if self.out else 0
        if taken or not self.out:
            self.read_at = now
        self.out = self.out[taken:]
        self.over |= not self.device.running and self.ran and self.pace.once and now - self.device.heard > SILENCE

    def _run(self, now: float) -> None:
        # A bench that was kept from running makes up for it as fast as it is read: late is not lost.
        rate, behind = self.device.header.rate, len(self.out) > BUFFER // 2 and now - self.read_at <= STALLED
        due = min(int((now - self.began) * rate * self.pace.speed) - self.sent, int(0.05 * rate) + 1)
        n = (0 if behind else due) if self.pace.speed else (0 if self.out else 100)
        if self.unplug_at is not None:
            n = min(n, int(self.unplug_at * rate) - self.sent)
        data = self.wire.carry(self.device.run(n))
        self.sent += n
        if len(self.out) + len(data) <= BUFFER or not self.pace.speed:
            self.out += data
        if self.unplug_at is not None and self.sent >= int(self.unplug_at * rate):
            self._unplug()

    def _unplug(self) -> None:
        """Say what is in the buffer, vanish, and come back as a device that was just switched on."""
        end = time.monotonic() + 1.0
        while self.out and time.monotonic() < end:
            self.transport.wait(True, 0.05)
            self.out = self.out[self.transport.write(self.out):]
        time.sleep(0.05)  # a pseudo-terminal forgets what was not yet read when it closes
        self.transport.unplug()
        self.plugged, self.out, self.unplug_at = False, b"", None
        if self.pace.plug_after is None:
            self.over = True
            return
        time.sleep(self.pace.plug_after)
        self.device, self.ran = self.make(), False
        self.transport.plug()
        self.plugged = True


class Pty:
    """A pseudo-terminal; `link` is a symbolic link that follows it from one plugging to the next."""

    def __init__(self, link: Path | None = None) -> None:
        self.link = link
        if link and link.exists() and not (link.is_symlink() and link.is_char_device()):
            raise UsageError(f"{link} exists and is no link to a port; choose another name for the port.")
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
        return otherwise(b"", OSError, lambda: os.read(self._master, 4096))

    def write(self, data: bytes) -> int:
        """Return how many bytes were taken."""
        return otherwise(0, BlockingIOError, lambda: os.write(self._master, data))


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
                knocking, _ = self._server.accept()
                if self._peer is None:
                    knocking.setblocking(False)
                    self._peer = knocking
                else:
                    knocking.close()

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

    def _hang_up(self) -> None:
        if self._peer:
            self._peer.close()
            self._peer = None


Transport = Pty | Socket  # the device's end of a wire; `name` is what the recorder is told as --port


def open_transport(link: Path | None = None, port: int | None = None) -> Transport:
    """Open a pseudo-terminal, or a loopback socket where `port` is given or the system has no terminals."""
    try:
        return Pty(link) if port is None and hasattr(os, "openpty") else Socket(port or 0)
    except OSError as error:
        raise UsageError(f"cannot serve {port if link is None else link}: {error.strerror or error}. Choose another "
                         "name or number for the port.") from None


@dataclass(frozen=True)
class Faults:
    """Probability of each fault per sample line."""

    drop: float = 0.0  # the line never comes
    garbage: float = 0.0  # 1 to 40 random bytes before it
    cut: float = 0.0  # only its beginning or only its end comes
    flip: float = 0.0  # one to three of its bytes are altered
    repeat: float = 0.0  # it comes twice
    swap: float = 0.0  # an older line comes once more, late
    glue: float = 0.0  # its newline is missing

    def __post_init__(self) -> None:
        for f in fields(self):
            if not 0 <= getattr(self, f.name) <= 1:
                raise UsageError(f"--{f.name} is a probability from 0 to 1; got {getattr(self, f.name)}.")


class Wire:
    """Carries frames to the computer, not always whole; only sample lines are harmed."""

    def __init__(self, faults: Faults, rng: np.random.Generator) -> None:
        self.faults, self.rng = faults, rng
        self._lately: deque[bytes] = deque(maxlen=5)

    def carry(self, frames: list[bytes]) -> bytes:
        """Return the bytes that arrive of these frames."""
        return b"".join([self._one(f) if f.startswith(b"$D") else f for f in frames])

    def _one(self, line: bytes) -> bytes:
        f, hit = self.faults, self.rng.random(7)
        before = self.rng.bytes(int(self.rng.integers(1, 41))) if hit[0] < f.garbage else b""
        if hit[1] < f.drop:
            return before
        if hit[2] < f.cut:
            at = int(self.rng.integers(1, len(line) - 2))
            return before + (line[:at] if self.rng.random() < 0.5 else line[at:])
        if hit[3] < f.flip:
            altered = bytearray(line)
            for at in self.rng.choice(len(line) - 1, size=int(self.rng.integers(1, 4)), replace=False):
                altered[at] ^= int(self.rng.integers(1, 256))
            return before + bytes(altered)
        late = self._lately[self.rng.integers(len(self._lately))] if hit[4] < f.swap and self._lately else b""
        self._lately.append(line)
        came = line[:-1] if hit[5] < f.glue else line
        return before + came + (came if hit[6] < f.repeat else b"") + late
