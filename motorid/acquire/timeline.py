"""From wrapped counters to a continuous record: where every sample belongs, and what is missing."""

from __future__ import annotations

import math
import tomllib
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from motorid.acquire.protocol import Channel, Header, Sample
from motorid.errors import DataError, one_of


class Row(NamedTuple):
    """One sample in its place: index since the start of the run, device time in s, values in SI."""

    index: int
    time: float
    values: tuple[float, ...]


class _Mark(NamedTuple):
    counter: int
    time: int  # as it came, wrapped
    index: int
    micros: int  # since the first sample, unwrapped
    host: float  # clock of the computer, s


class Ledger:
    """Places samples on the axis of a run and keeps account of what is lost.

    A gap is the step of the counter. Where the counter may have wrapped more than once the timer decides, and
    where the timer may have wrapped too, the clock of the computer. A sample whose counter and time
    contradict each other is believed only when the next one agrees with it, so that a damaged frame that
    happens to have a valid CRC does not open a gap.

    Parameters
    ----------
    header : Header
        Of the device, channels calibrated.
    counter, time : int
        Of the first sample, as the device announced them.
    host : float
        Clock of the computer, in s, at that moment.
    """

    def __init__(self, header: Header, counter: int, time: int, host: float = 0.0) -> None:
        self.header = header
        self.bad: Counter[str] = Counter()
        self.clipped: Counter[str] = Counter()
        self.received = 0
        self.first = time
        self._wrap = 1 << header.counter_bits, 1 << header.timer_bits
        period = round(1e6 / header.rate)
        self._last = _Mark((counter - 1) % self._wrap[0], (time - period) % self._wrap[1], -1, -period, host)
        self._doubtful: tuple[_Mark, Sample] | None = None
        self._turns = {k: _Turns(c.span) for k, c in enumerate(header.channels) if c.wraps}

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
        if len(sample.raw) != len(self.header.channels) or not self._within(sample):
            self.bad["not understood"] += 1
            return []
        mark = self._follow(self._last, sample, host)
        if isinstance(mark, str):
            self.bad[mark] += 1
            return []
        if self._agree(self._last, mark):
            self._drop_doubtful()
            return [self._row(mark, sample)]
        held, self._doubtful = self._doubtful, None
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
        if held is None:
            return []
        if made is not None and held[0].index >= made:
            self.bad["implausible"] += 1
            return []
        return [self._row(*held)]

    def _within(self, sample: Sample) -> bool:
        return sample.counter < self._wrap[0] and sample.time < self._wrap[1]

    def _follow(self, last: _Mark, sample: Sample, host: float) -> _Mark | str:
        """Where `sample` is, coming after `last`, or why it cannot come after it."""
        step = (sample.counter - last.counter) % self._wrap[0]
        micros = (sample.time - last.time) % self._wrap[1]
        elapsed = (host - last.host) * 1e6
        if step == 0 and micros == 0 and elapsed < self._wrap[1] / 2:
            return "repeated"
        if micros >= self._wrap[1] / 2 and elapsed < self._wrap[1] / 4:
            return "out of order"
        micros += self._wrap[1] * max(0, round((elapsed - micros) / self._wrap[1]))
        step += self._wrap[0] * max(0, round((micros * 1e-6 * self.header.rate - step) / self._wrap[0]))
        return _Mark(sample.counter, sample.time, last.index + step, last.micros + micros, host)

    def _agree(self, last: _Mark, mark: _Mark) -> bool:
        step = mark.index - last.index
        by_time = (mark.micros - last.micros) * 1e-6 * self.header.rate
        return step > 0 and abs(by_time - step) <= 5 + 0.2 * step

    def _drop_doubtful(self) -> None:
        if self._doubtful:
            self.bad["implausible"] += 1
            self._doubtful = None

    def _row(self, mark: _Mark, sample: Sample) -> Row:
        step, self._last = mark.index - self._last.index, mark
        self.received += 1
        values = []
        for k, (channel, raw) in enumerate(zip(self.header.channels, sample.raw, strict=True)):
            if k in self._turns:
                raw = self._turns[k].unwrap(raw, step)
            elif channel.kind != "n" and not 0 < raw < channel.span - 1 and not math.isnan(raw):
                self.clipped[channel.name] += 1
            values.append(_si(channel, raw))
        return Row(mark.index, mark.micros * 1e-6, tuple(values))


class _Turns:
    """Unwraps one counter, carrying its last rate on across a gap."""

    def __init__(self, span: int) -> None:
        self.span, self.value, self.rate, self.since = span, math.nan, 0.0, 0

    def unwrap(self, raw: float, step: int) -> float:
        self.since += step
        if math.isnan(raw):
            return raw
        if math.isnan(self.value):  # the first one: the turn that is nearest to zero
            self.value, self.since = raw + self.span * round(-raw / self.span), 0
            return self.value
        expected = self.value + self.rate * self.since
        value = raw + self.span * round((expected - raw) / self.span)
        self.rate, self.value, self.since = (value - self.value) / self.since, value, 0
        return value


def _si(channel: Channel, raw: float) -> float:
    return channel.scale * (raw - channel.offset)


_ENTRIES = ("scale", "offset", "gain", "zero", "sign")


def read_calibration(path: str | Path) -> dict[str, dict[str, float]]:
    """Read a calibration file: entries by channel.

    Raises
    ------
    DataError
        If it cannot be read, or holds an entry that is not known or not a finite number.
    """
    try:
        tables = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"the calibration file {path} cannot be read: {error.strerror}.") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DataError(f"the calibration file {path} is not TOML: {error}.") from None
    for channel, entries in tables.items():
        if not isinstance(entries, dict):
            raise DataError(f"{path}: expected a table [channel] with entries; '{channel}' stands alone.")
        for name, value in entries.items():
            if name not in _ENTRIES:
                raise DataError(f"{path}, [{channel}]: {one_of(name, _ENTRIES, 'entry')}")
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise DataError(f"{path}, [{channel}]: {name} must be a number; got {value!r}.")
            if name == "sign" and value not in (1, -1):
                raise DataError(f"{path}, [{channel}]: sign is 1 or -1; got {value}.")
            if name in ("scale", "gain") and value == 0:
                raise DataError(f"{path}, [{channel}]: {name} must not be zero.")
    return tables


def calibrate(header: Header, calibration: dict[str, dict[str, float]]) -> Header:
    """Return the header with the channels' scales and offsets as the calibration wants them."""
    names = [c.name for c in header.channels]
    for name in calibration:
        if name not in names:
            raise DataError(f"the calibration speaks of a channel that the device does not send: "
                            f"{one_of(name, names, 'channel')}")
    channels = tuple(_calibrated(c, calibration.get(c.name, {})) for c in header.channels)
    return replace(header, channels=channels)


def _calibrated(channel: Channel, entries: dict[str, float]) -> Channel:
    offset = entries.get("offset", channel.offset)
    scale = entries.get("scale", channel.scale) * entries.get("gain", 1.0) * entries.get("sign", 1)
    # zero + scale·(raw − offset) is scale·(raw − (offset − zero/scale)).
    return replace(channel, scale=scale, offset=offset - entries.get("zero", 0.0) / scale)
