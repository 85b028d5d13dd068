"""Faults on the wire, on demand and from a seed."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, fields

import numpy as np

from motorid.errors import UsageError

__all__ = ["Faults", "Wire"]


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
        self._faulty = any(vars(faults).values())
        self._lately: deque[bytes] = deque(maxlen=5)

    def carry(self, frames: list[bytes]) -> bytes:
        """Return the bytes that arrive of these frames."""
        if not self._faulty:
            return b"".join(frames)
        return b"".join([self._one(f) if f.startswith(b"$D") else f for f in frames])

    def _one(self, line: bytes) -> bytes:
        f, hit = self.faults, self.rng.random(7)
        before = self.rng.bytes(int(self.rng.integers(1, 41))) if hit[0] < f.garbage else b""
        if hit[1] < f.drop:
            return before
        if hit[2] < f.cut:
            return before + self._cut(line)
        if hit[3] < f.flip:
            return before + self._flip(line)
        late = self._lately[self.rng.integers(len(self._lately))] if hit[4] < f.swap and self._lately else b""
        self._lately.append(line)
        came = line[:-1] if hit[5] < f.glue else line
        return before + came + (came if hit[6] < f.repeat else b"") + late

    def _cut(self, line: bytes) -> bytes:
        at = int(self.rng.integers(1, len(line) - 2))
        return line[:at] if self.rng.random() < 0.5 else line[at:]

    def _flip(self, line: bytes) -> bytes:
        altered = bytearray(line)
        for at in self.rng.choice(len(line) - 1, size=int(self.rng.integers(1, 4)), replace=False):
            altered[at] ^= int(self.rng.integers(1, 256))
        return bytes(altered)
