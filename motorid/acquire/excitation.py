"""Excitation programs: what voltage the device applies, in words, as frames and as numbers.

A program is a list of segments that the device itself runs, sample by sample, so that its timing does not
hang on the computer. Words are joined by commas, numbers by colons, in V, s and Hz::

    rest:T                        nothing for T
    step:V:T                      V for T
    stairs:V1:V2:N:T              N levels from V1 to V2, T each
    ramp:V1:V2:T                  a straight line from V1 to V2
    chirp:A:F1:F2:T[:V0]          V0 ± A, frequency from F1 to F2
    prbs:A:BIT:T[:V0[:SEED]]      V0 ± A, by a 15-bit shift register clocked every BIT seconds
    coast:T                       coast-down: 0 V, the terminals joined, so that the input stays known
    standard                      steps, stairs, a ramp and a PRBS within 0.6 of the voltage limit, 8.2 s

On the line a segment is ``R,<ms>,<mV from>,<mV to>``, ``C,<ms>,<mV offset>,<mV amplitude>,<mHz from>,<mHz to>`` or
``P,<ms>,<mV offset>,<mV amplitude>,<µs per bit>,<seed>``, all whole, so device and computer mean the same program."""

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate

import numpy as np
import scipy
from numpy.typing import NDArray

from motorid.errors import UsageError, among, otherwise

LONGEST = 3600.0  # s of one segment
_SHAPES = {"R": 2, "C": 4, "P": 4}  # numbers after the duration


@dataclass(frozen=True)
class Segment:
    """One piece of a program, in the whole numbers of the protocol: ms, mV, mHz, µs."""

    shape: str
    ms: int
    args: tuple[int, ...]

    def __post_init__(self) -> None:
        if len(self.args) != _SHAPES.get(self.shape) or not 1 <= self.ms <= LONGEST * 1e3:
            raise UsageError(f"a segment lasts from 1 ms to an hour; got {self.ms} ms of {self.shape}. Join "
                             "several for a longer one.")
        if self.shape == "C" and min(self.args[2:]) < 0:
            raise UsageError("the frequencies of a chirp must not be negative.")
        if self.shape == "P" and not (self.args[2] >= 1 and 1 <= self.args[3] < 1 << 15):
            raise UsageError("a PRBS needs a positive bit time and a seed from 1 to 32767.")

    @property
    def peak(self) -> float:
        """Largest voltage of either sign, in V."""
        a, b = self.args[:2]
        return (max(abs(a), abs(b)) if self.shape == "R" else abs(a) + abs(b)) / 1e3

    def count(self, rate: float) -> int:
        """Number of samples it lasts."""
        return max(1, round(self.ms * rate / 1e3))

    def volts(self, rate: float) -> NDArray[np.float64]:
        """Voltage at each of its samples, in V."""
        t, T = np.arange(self.count(rate)) / rate, self.ms / 1e3
        a, b, *rest = self.args
        if self.shape == "R":
            return (a + (b - a) * np.minimum(t / T, 1.0)) / 1e3
        if self.shape == "C":
            f1, f2 = rest[0] / 1e3, rest[1] / 1e3
            return (a + b * np.sin(2 * np.pi * (f1 * t + (f2 - f1) * t * t / (2 * T)))) / 1e3
        which = (np.round(t * 1e6).astype(np.int64) // rest[0])
        return (a + np.where(lfsr_bits(rest[1], int(which[-1]) + 1)[which] > 0, b, -b)) / 1e3


def lfsr_bits(seed: int, n: int) -> NDArray[np.int64]:
    """Return n bits of the maximum-length sequence of x¹⁵ + x¹⁴ + 1 (period 32767)."""
    return scipy.signal.max_len_seq(15, [seed >> k & 1 for k in range(15)], n, [1])[0].astype(np.int64)


_volts = lru_cache(maxsize=4)(Segment.volts)


@dataclass(frozen=True)
class Program:
    """A checked sequence of segments; no segments at all means: record at 0 V until stopped."""

    segments: tuple[Segment, ...] = ()
    words: str = ""

    @property
    def duration(self) -> float:
        """Length in s."""
        return sum(s.ms for s in self.segments) / 1e3

    def count(self, rate: float) -> int:
        """Number of samples it lasts."""
        return sum(s.count(rate) for s in self.segments)

    def volts(self, rate: float) -> NDArray[np.float64]:
        """Voltage commanded at each sample, (N,) in V."""
        return np.concatenate([s.volts(rate) for s in self.segments]) if self.segments else np.zeros(0)

    def at(self, index: int, rate: float) -> float | None:
        """Return the voltage commanded at one sample, in V; None where there is no program."""
        for segment in self.segments:
            n = segment.count(rate)
            if index < n:
                return float(_volts(segment, rate)[index])
            index -= n
        return None

    def after(self, seconds: float) -> "Program":
        """What is left after that time; a segment that was interrupted is repeated from its start."""
        ends = accumulate(s.ms / 1e3 for s in self.segments)
        return Program(tuple(s for s, end in zip(self.segments, ends, strict=True) if end > seconds), self.words)

    def check(self, v_max: float, segments: int, whose: str = "the limit") -> None:
        """Refuse a program beyond `v_max` volts, naming the segment, or of more than `segments` segments."""
        for k, segment in enumerate(self.segments):
            if segment.peak > v_max * (1 + 1e-9):
                raise UsageError(f"segment {k + 1} of the excitation reaches {segment.peak:g} V, but {whose} "
                                 f"is {v_max:g} V. Nothing was applied to the motor; ask for less voltage.")
        if len(self.segments) > segments:
            raise UsageError(f"the excitation has {len(self.segments)} segments, the device takes at most "
                             f"{segments}; use fewer or longer ones.")


def program(words: str | Program | None, v_max: float = math.inf) -> Program:
    """Read an excitation in words (see the module), ``standard`` scaled to `v_max`, V; UsageError for wrong ones."""
    if isinstance(words, Program) or not words:
        return words or Program()
    segments: list[Segment] = []
    for word in words.replace(" ", "").strip(",").split(","):
        if word == "standard":
            segments += program(_standard(v_max)).segments
            continue
        name, *numbers = word.split(":")
        among(name, [*_WORDS, "standard"], "excitation")
        make, least, most = _WORDS[name]
        values = [_number(n, word) for n in numbers]
        if not least <= len(values) <= most:
            many = f"{least} to {most}" if most > least else f"{least}"
            raise UsageError(f"'{word}': {name} takes {many} numbers, as in '{_EXAMPLES[name]}'; got {len(values)}.")
        segments += make(*values)
    return Program(tuple(segments), words)


def _number(text: str, word: str) -> float:
    value = otherwise(math.nan, ValueError, lambda: float(text))
    if not abs(value) < 1e6:
        raise UsageError(f"'{text}' in the excitation '{word}' is not a usable number.")
    return value


def _standard(v_max: float) -> str:
    if not math.isfinite(v_max):
        raise UsageError("the excitation 'standard' is scaled to the voltage limit, and neither you nor the "
                         "device stated one; add --limit-voltage.")
    a, b = 0.6 * v_max, 0.3 * v_max
    return (f"rest:0.2,step:{a}:0.8,coast:0.6,step:{-a}:0.8,coast:0.4,stairs:{b / 2}:{a}:4:0.3,"
            f"stairs:{-b / 2}:{-a}:4:0.3,ramp:{-b}:{b}:1,prbs:{b}:0.04:1.6:0,coast:0.4")


def _milli(value: float) -> int:
    return round(value * 1e3)


def _ramp(first: float, last: float, seconds: float) -> list[Segment]:
    return [Segment("R", _milli(seconds), (_milli(first), _milli(last)))]


def _stairs(first: float, last: float, n: float, seconds: float) -> list[Segment]:
    if n != int(n) or not 2 <= n <= 1000:
        raise UsageError(f"stairs need a whole number of levels from 2 on; got {n:g}.")
    return [s for v in np.linspace(first, last, int(n)) for s in _ramp(float(v), float(v), seconds)]


_REST = (lambda seconds: _ramp(0.0, 0.0, seconds), 1, 1)
_WORDS = {"rest": _REST, "coast": _REST, "step": (lambda volts, seconds: _ramp(volts, volts, seconds), 2, 2),
          "stairs": (_stairs, 4, 4), "ramp": (_ramp, 3, 3),
          "prbs": (lambda amplitude, bit, seconds, offset=0.0, seed=1.0: [
              Segment("P", _milli(seconds), (*map(_milli, (offset, amplitude)), round(bit * 1e6), int(seed)))], 3, 5),
          "chirp": (lambda amplitude, low, high, seconds, offset=0.0: [
              Segment("C", _milli(seconds), tuple(map(_milli, (offset, amplitude, low, high))))], 4, 5)}
_EXAMPLES = {"rest": "rest:0.2", "coast": "coast:1", "step": "step:6:0.5", "stairs": "stairs:1:6:5:0.3",
             "ramp": "ramp:-3:3:2", "chirp": "chirp:4:0.5:50:5", "prbs": "prbs:6:0.05:5"}
