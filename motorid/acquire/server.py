"""Serve a virtual device in real time, with the faults that were asked for."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from motorid.acquire.ends import End
from motorid.acquire.faults import Wire
from motorid.acquire.protocol import SILENCE
from motorid.acquire.virtual import VirtualDevice

__all__ = ["Pace", "serve"]

BUFFER = 65_536  # bytes a device keeps for a computer that does not read; what is more is lost, as in reality
STALLED = 0.5  # s without a byte taken after which the computer counts as one that does not read
TICK = 0.002  # s


@dataclass(frozen=True)
class Pace:
    """How a virtual bench behaves in time.

    Attributes
    ----------
    speed : float
        Times real time; 0 is as fast as the other end reads.
    unplug_after, plug_after : float or None
        Seconds of a run after which the line dies, and after which it comes back (None: never).
    once : bool
        Whether to end when the first run is over and the recorder has gone.
    """

    speed: float = 1.0
    unplug_after: float | None = None
    plug_after: float | None = None
    once: bool = False


def serve(make: Callable[[], VirtualDevice], end: End, wire: Wire, pace: Pace,
          stop: Callable[[], bool] = lambda: False) -> VirtualDevice:
    """Serve devices made by `make` until `stop()` says so; return the last one."""
    bench = _Bench(make, end, wire, pace)
    try:
        while not stop() and not bench.over:
            bench.turn()
    finally:
        if bench.plugged:
            end.unplug()
    return bench.device


class _Bench:
    """One turn after the other: hear, run, speak."""

    def __init__(self, make: Callable[[], VirtualDevice], end: End, wire: Wire, pace: Pace) -> None:
        self.make, self.end, self.wire, self.pace = make, end, wire, pace
        self.device = make()
        self.plugged, self.over = True, False
        self.unplug_at = pace.unplug_after
        self.out = b""
        self.began, self.sent, self.ran = 0.0, 0, False
        self.read_at = 0.0  # when the other end last took something

    def turn(self) -> None:
        """Do what is due."""
        was_running = self.device.running
        self.end.wait(bool(self.out), TICK if was_running and self.pace.speed else 0.05 * (not was_running))
        now = time.monotonic()
        self.out += self.device.receive(self.end.read(), now) + self.device.watch(now)
        if self.device.running and not was_running:
            self.began, self.sent, self.ran = now, 0, True
        if self.device.running:
            self._run(now)
        self._speak(now)
        if not self.device.running and self.ran and self.pace.once and now - self.device.heard > SILENCE:
            self.over = True

    def _speak(self, now: float) -> None:
        taken = self.end.write(self.out) if self.out else 0
        if taken or not self.out:
            self.read_at = now
        self.out = self.out[taken:]

    def _due(self, now: float) -> int:
        """Number of samples to make now.

        A bench that was kept from running makes up for it as fast as it is read: late is not lost.
        """
        rate, stalled = self.device.header.rate, now - self.read_at > STALLED
        if not self.pace.speed:
            return 0 if self.out else 100
        if len(self.out) > BUFFER // 2 and not stalled:
            return 0
        due = int((now - self.began) * rate * self.pace.speed)
        return min(due - self.sent, int(0.05 * rate) + 1)

    def _run(self, now: float) -> None:
        rate, n = self.device.header.rate, self._due(now)
        if self.unplug_at is not None:
            n = min(n, int(self.unplug_at * rate) - self.sent)
        frames = self.device.run(n)
        self.sent += n
        data = self.wire.carry(frames)
        if len(self.out) + len(data) <= BUFFER or not self.pace.speed:
            self.out += data
        if self.unplug_at is not None and self.sent >= int(self.unplug_at * rate):
            self._unplug()

    def _unplug(self) -> None:
        """Say what is in the buffer, vanish, and come back as a device that was just switched on."""
        end = time.monotonic() + 1.0
        while self.out and time.monotonic() < end:
            self.end.wait(True, 0.05)
            self.out = self.out[self.end.write(self.out):]
        time.sleep(0.05)  # a pseudo-terminal forgets what was not yet read when it closes
        self.end.unplug()
        self.plugged, self.out, self.unplug_at = False, b"", None
        if self.pace.plug_after is None:
            self.over = True
            return
        time.sleep(self.pace.plug_after)
        self.device, self.ran = self.make(), False
        self.end.plug()
        self.plugged = True
