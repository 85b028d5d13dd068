"""Faults on the wire, on demand and from a seed, with an account of what came through."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

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


@dataclass
class Wire:
    """Carries frames to the computer, not always whole.

    Attributes
    ----------
    delivered : list of bytes
        The lines that came through whole, in order, without their newline and without repetitions.
    damaged : int
        Lines that did not.
    """

    faults: Faults
    rng: np.random.Generator
    delivered: list[bytes] = field(default_factory=list)
    damaged: int = 0
    keep: bool = True  # the account, too; a bench that runs for days does not

    def carry(self, frames: list[bytes]) -> bytes:
        """Return the bytes that arrive of these frames; only sample lines are harmed."""
        if not any(vars(self.faults).values()) and not self.keep:
            return b"".join(frames)
        return b"".join([self._one(f) if f.startswith(b"$D") else f for f in frames])

    def _one(self, line: bytes) -> bytes:
        f, hit = self.faults, self.rng.random(7)
        before = self.rng.bytes(int(self.rng.integers(1, 41))) if hit[0] < f.garbage else b""
        if hit[1] < f.drop:
            line = b""
        elif hit[2] < f.cut:
            line = self._cut(line)
        elif hit[3] < f.flip:
            line = self._flip(line)
        else:
            old = self.delivered[-1 - int(self.rng.integers(min(5, len(self.delivered))))] + b"\n" \
                if hit[4] < f.swap and self.delivered else b""
            if self.keep or f.swap:
                self.delivered.append(line[:-1])
                del self.delivered[:0 if self.keep else -5]
            line = line[:-1] if hit[5] < f.glue else line
            return before + line + (line if hit[6] < f.repeat else b"") + old
        self.damaged += 1
        return before + line

    def _cut(self, line: bytes) -> bytes:
        at = int(self.rng.integers(1, len(line) - 2))  # the CRC's last digit or the $ goes
        return line[:at] if self.rng.random() < 0.5 else line[at:]

    def _flip(self, line: bytes) -> bytes:
        altered = bytearray(line)
        for at in self.rng.choice(len(line) - 1, size=int(self.rng.integers(1, 4)), replace=False):
            altered[at] ^= int(self.rng.integers(1, 256))
        return bytes(altered)
