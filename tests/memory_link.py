"""A link that lives in memory: a virtual device behind a faulty wire, as fast as it is read."""

from __future__ import annotations

import time

import numpy as np

from motorid.acquire.client import LinkLost
from motorid.acquire.server import Faults, Wire
from motorid.acquire.virtual import VirtualDevice


class MemoryLink:
    """Also the fake of a port that can be unplugged after so many bytes, or lose what is sent to the
    device."""

    def __init__(self, device: VirtualDevice, wire: Wire | None = None, step: int = 50,
                 unplug_after: int | None = None, deaf: float = 0.0) -> None:
        self.device, self.step, self.left, self.deaf = device, step, unplug_after, deaf
        self.wire = wire or Wire(Faults(), np.random.default_rng(0))
        self.commands: list[bytes] = []
        self.made: list[bytes] = []  # sample lines, before anything happens to them
        self.out, self.passed, self.closed = b"", b"", False

    def write(self, data: bytes) -> None:
        self.commands.append(data)
        if not (self.deaf and self.wire.rng.random() < self.deaf):
            self.out += self.device.receive(data, time.monotonic())

    def read(self, timeout: float) -> bytes:
        frames = self.device.run(self.step)
        self.made += [f[:-1] for f in frames if f.startswith(b"$D")]
        self.out += self.wire.carry(frames)
        data, self.out = self.out, b""
        if self.left is not None:
            data, was = data[:self.left], self.left
            self.left -= len(data)
            if not was:
                raise LinkLost("the cable was pulled out.")
        self.passed += data
        if not data:
            time.sleep(min(timeout, 0.002))
        return data

    def close(self) -> None:
        self.closed = True
