"""From wrapped counters to a continuous record: where every sample belongs, and what is missing."""

import math
from collections import Counter
from typing import NamedTuple

from motorid.acquire.protocol import Header, Sample


class Row(NamedTuple):
    """One sample in its place: index since the start of the run, device time in s, values in SI."""

    index: int
    time: float
    values: tuple[float, ...]


class _Mark(NamedTuple):
    index: int
    micros: int  # since the first sample, unwrapped
    host: float  # clock of the computer, s


class Timeline:
    """Places samples on the time axis of a run and counts what is lost.

    A gap is a step of the counter; where that may have wrapped more than once the timer decides, and where the timer
    may have, too, the computer's clock. A sample whose counter and time contradict each other is believed only when the
    next one agrees: a damaged frame may have a valid CRC. `counter`, `time` and `host` (clock, s): at the first sample.
    """

    def __init__(self, header: Header, counter: int, time: int, host: float = 0.0) -> None:
        self.header = header
        self.bad: Counter[str] = Counter()
        self.clipped: Counter[str] = Counter()
        self.received = 0
        self._wrap = 1 << header.counter_bits, 1 << header.timer_bits
        self._first = counter, time
        self._last = _Mark(-1, -round(1e6 / header.rate), host)
        self._doubtful: tuple[_Mark, Sample] | None = None
        self._unwrappers = {k: _Unwrapper(c.span) for k, c in enumerate(header.channels) if c.wraps}

    @property
    def next_index(self) -> int:
        """Index of the sample that is due next."""
        return self._last.index + 1

    @property
    def lost(self) -> int:
        """Number of samples that were made up to the last one received, and never came."""
        return self.next_index - self.received

    def accept(self, sample: Sample, host: float = 0.0) -> list[Row]:
        """Return the rows that this sample makes certain: none, itself, or itself and the one held back."""
        if (len(sample.raw) != len(self.header.channels) or sample.counter >= self._wrap[0]
                or sample.time >= self._wrap[1]):
            self.bad["not understood"] += 1
            return []
        mark = self._follow(self._last, sample, host)
        if isinstance(mark, str):
            self.bad[mark] += 1
            return []
        held, self._doubtful = self._doubtful, None
        if self._agree(self._last, mark):
            if held:
                self.bad["implausible"] += 1
            return [self._row(mark, sample)]
        if held:
            later = self._follow(held[0], sample, host)
            if not isinstance(later, str) and self._agree(held[0], later):
                return [self._row(*held), self._row(later, sample)]
            self.bad["implausible"] += 1
        self._doubtful = (mark, sample)
        return []

    def finish(self, made: int | None = None) -> list[Row]:
        """End the run of `made` samples (None: nobody knows) and return the last row if it was held back."""
        held, self._doubtful = self._doubtful, None
        if held and made is not None and held[0].index >= made:
            self.bad["implausible"] += 1
            return []
        return [self._row(*held)] if held else []

    def _follow(self, last: _Mark, sample: Sample, host: float) -> _Mark | str:
        """Where `sample` is, coming after `last`, or why it cannot come after it."""
        step = (sample.counter - self._first[0] - last.index) % self._wrap[0]
        micros = (sample.time - self._first[1] - last.micros) % self._wrap[1]
        elapsed = (host - last.host) * 1e6
        if step == 0 and micros == 0 and elapsed < self._wrap[1] / 2:
            return "repeated"
        if micros >= self._wrap[1] / 2 and elapsed < self._wrap[1] / 4:
            return "out of order"
        micros += self._wrap[1] * max(0, round((elapsed - micros) / self._wrap[1]))
        step += self._wrap[0] * max(0, round((micros * 1e-6 * self.header.rate - step) / self._wrap[0]))
        return _Mark(last.index + step, last.micros + micros, host)

    def _agree(self, last: _Mark, mark: _Mark) -> bool:
        step = mark.index - last.index
        return step > 0 and abs((mark.micros - last.micros) * 1e-6 * self.header.rate - step) <= 5 + 0.2 * step

    def _row(self, mark: _Mark, sample: Sample) -> Row:
        step, self._last = mark.index - self._last.index, mark
        self.received += 1
        values = []
        for k, (channel, raw) in enumerate(zip(self.header.channels, sample.raw, strict=True)):
            if k in self._unwrappers:
                raw = self._unwrappers[k].unwrap(raw, step)
            elif channel.kind != "n" and not 0 < raw < channel.span - 1 and not math.isnan(raw):
                self.clipped[channel.name] += 1
            values.append(channel.scale * (raw - channel.offset))
        return Row(mark.index, mark.micros * 1e-6, tuple(values))


class _Unwrapper:
    """Unwraps one counter, carrying its last rate on across a gap."""

    def __init__(self, span: int) -> None:
        self.span, self.value, self.rate, self.since = span, math.nan, 0.0, 0

    def unwrap(self, raw: float, step: int) -> float:
        self.since += step
        if math.isnan(raw):
            return raw
        first = math.isnan(self.value)  # then it is the turn that is nearest to zero
        value = raw + self.span * round(((0.0 if first else self.value + self.rate * self.since) - raw) / self.span)
        self.rate = 0.0 if first else (value - self.value) / self.since
        self.value, self.since = value, 0
        return value
