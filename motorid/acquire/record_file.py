"""From wrapped counters to a continuous record, on disk a CSV file that grows by whole lines, never over another."""

import errno
import math
import os
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

from motorid.acquire.protocol import Channel, Header, Sample
from motorid.channels import CHANNELS
from motorid.errors import DataError, UsageError

FILL_UP_TO = 60.0  # s; a longer gap is marked by its first and last sample alone
MOST_FILLED = 200_000  # rows; likewise
SYNC_EVERY = 0.5  # s between two calls of fsync: what is older than that survives a power cut
_COLUMNS = {("v", "V"): "voltage_V", ("i", "A"): "current_A", ("omega", "rad/s"): "speed_rad_s",
            ("omega", "m/s"): "speed_m_s", ("theta", "rad"): "angle_rad", ("theta", "m"): "position_m"}

Commanded = Callable[[int], float | None]  # voltage (V) commanded at a sample, None where nobody knows


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


def column(channel: Channel) -> str:
    """Name of the channel's column, one that `read_runs` knows."""
    return _COLUMNS.get((channel.name, channel.unit), f"{channel.name}_{channel.unit}".replace("/", "_per_"))


class Tail(NamedTuple):
    """Where an existing record ends."""

    columns: str
    index: int
    time: float
    meta: dict[str, str]


def check_target(out: Path, resume: bool, force: bool) -> None:
    """Refuse, before anything moves, a file that exists without `resume` or `force`, or with both, or has no folder."""
    if resume and force:
        raise UsageError("--resume continues a record and --force replaces it; give one of them.")
    if out.exists() and not out.is_file():
        raise UsageError(f"{out} is not a file.")
    if not out.parent.is_dir():
        raise UsageError(f"the folder {out.parent} does not exist; make it first.")
    if out.exists() and not (resume or force):
        raise UsageError(f"{out} exists and is left alone. Choose another name, or continue it with "
                         "--resume, or replace it with --force.")


def read_tail(out: Path) -> Tail:
    """Read where a record ends, but for a last line cut off. DataError if motorid did not make it, or not its notes."""
    meta: dict[str, str] = {}
    columns, last = "", ""
    with open(out, encoding="utf-8", errors="replace", newline="") as file:
        for line in file:
            if line.startswith("#"):
                key, _, value = line[1:].partition(":")
                meta[key.strip()] = value.strip()
            elif not columns:
                columns = line.strip()
            elif line.endswith("\n"):
                last = line
    for key, read in (("started", datetime.fromisoformat), ("segments done", int), ("part begins", float)):
        try:
            read(meta[key]) if key in meta else None
        except ValueError:
            raise DataError(f"{out}, '# {key}: {meta[key]}' is damaged, so it cannot be continued. Mend that line, or "
                            "choose another name for --out.") from None
    try:
        cells = dict(zip(columns.split(","), last.split(","), strict=True))
        return Tail(columns, int(cells["sample"]), float(cells["time_s"]), meta)
    except (KeyError, ValueError):
        if columns.startswith("time_s,") and columns.endswith(",sample") and not last:
            return Tail(columns, -1, 0.0, meta)
        raise DataError(f"{out} is not a record that motorid made, so it cannot be continued. Choose another "
                        "name for --out.") from None


class Appender:
    """Appends lines, which a thread carries to the disk, so that a slow one does not hold up the recording. With `mode`
    ``new`` the file must not exist; one to ``resume`` is cut back to its last whole line; else ``replace``. Raises
    `UsageError` if the file may not be written, has appeared meanwhile, or another recorder has it."""

    def __init__(self, path: Path, mode: str) -> None:
        self.lines = 0  # handed to the operating system by this object
        self._fd = _open(path, mode)
        self._size = os.fstat(self._fd).st_size
        self._synced = self._size
        self._trouble: OSError | None = None
        self._over = threading.Event()
        if mode == "resume":
            with open(path, "rb") as file:
                file.seek(max(0, self._size - 4096))
                end = file.read()
            self._size -= len(end) - (end.rfind(b"\n") + 1)
            os.ftruncate(self._fd, self._size)
        self._thread = threading.Thread(target=self._keep_syncing, name=f"syncing {path}", daemon=True)
        self._thread.start()

    def append(self, data: bytes) -> None:
        """Hand whole lines to the operating system. If it refuses (the disk is full, say), the file is cut back to the
        last whole line that fitted, and the OSError passed on; so is trouble that the disk had with earlier lines."""
        if self._trouble:
            raise self._trouble
        written = 0
        try:
            while written < len(data):
                written += os.write(self._fd, data[written:])
        finally:
            whole = data.rfind(b"\n", 0, written) + 1
            self._size += whole
            self.lines += data.count(b"\n", 0, whole)
            if whole < written:
                os.ftruncate(self._fd, self._size)

    def close(self, sync: bool = True) -> None:
        """Carry the rest to the disk and close the file; a second time, do nothing."""
        if self._over.is_set():
            return
        self._over.set()
        self._thread.join()
        try:
            if sync:
                self._sync()
        finally:
            os.close(self._fd)

    def _keep_syncing(self) -> None:
        try:
            while not self._over.wait(SYNC_EVERY):
                self._sync()
        except OSError as error:
            self._trouble = error

    def _sync(self) -> None:
        if (size := self._size) != self._synced:
            os.fsync(self._fd)
            self._synced = size


class RecordFile(Appender):
    """Appends rows to a record; gaps become rows whose measured cells are empty. `meta` is written as comment lines
    ``# key: value`` at the head, or where a record is continued. What was not flushed before `close` is not written."""

    def __init__(self, out: Path, channels: tuple[Channel, ...], rate: float, meta: Mapping[str, object],
                 mode: str = "new") -> None:
        self.out, self.rate = out, rate
        known = [k for name in ("v", *CHANNELS) for k, c in enumerate(channels) if c.name == name]
        self._order = known + [k for k in range(len(channels)) if k not in known]
        self._v = next(k for k, c in enumerate(channels) if c.name == "v")
        self.columns = ",".join(["time_s", *(column(channels[k]) for k in self._order), "sample"])
        self._pending: list[str] = []
        self._next, self._index0, self._time0 = 0, 0, 0.0
        self._last = Row(-1, -1 / rate, (0.0,) * len(channels))  # at rest, before the first one
        tail = read_tail(out) if mode == "resume" and out.stat().st_size else None
        if tail and tail.columns != self.columns:
            raise DataError(f"{out} has the columns {tail.columns}, but the device now sends {self.columns}. "
                            "Record into another file.")
        super().__init__(out, mode)
        self.note(meta)
        self._pending += [] if tail else [self.columns + "\n"]
        try:
            self.flush()
        except OSError as error:
            self.close(sync=False)
            if mode == "new":
                out.unlink()
            raise UsageError(f"{out} cannot be written: {error.strerror}.") from None

    def pause(self, tail: Tail, until: float) -> None:
        """Mark the pause of a resumed record by one row at 0 V; what follows begins at `until` s."""
        if tail.index >= 0:
            self._index0, self._time0 = tail.index + 1, tail.time
            self._pending.append(self._line(0, 1 / self.rate, self._nothing_but(0.0)))
        self._index0, self._time0 = max(round(until * self.rate), tail.index + 2), until

    def add(self, rows: list[Row], commanded: Commanded = lambda _: None) -> None:
        """Append rows; `commanded` tells the voltage (V) of samples that were lost, where it is known."""
        for row in rows:
            if row.index > self._next:
                self._fill(row, commanded)
            self._pending.append(self._line(row.index, row.time, row.values))
            self._next, self._last = row.index + 1, row

    def mark_missing(self, until: int, commanded: Commanded = lambda _: None) -> None:
        """Mark as missing what was made up to sample `until` (not included) and never came."""
        if until > self._next:
            end = Row(until, self._last.time + (until - self._next + 1) / self.rate, (math.nan,) * len(self._order))
            self._fill(end, commanded)
            self._next = until

    def note(self, meta: Mapping[str, object]) -> None:
        """Append comment lines ``# key: value``."""
        self._pending += [f"# {k}: {' '.join(str(v).split())}\n" for k, v in meta.items()]

    def flush(self) -> None:
        """Hand everything to the operating system; OSError if it refuses."""
        data = "".join(self._pending).encode()
        self._pending.clear()
        self.append(data)

    def _line(self, index: int, time_s: float, values: tuple[float, ...]) -> str:
        measured = ("" if math.isnan(values[k]) else f"{values[k]:.9g}" for k in self._order)
        return ",".join([f"{self._time0 + time_s:.6f}", *measured, f"{self._index0 + index}\n"])

    def _nothing_but(self, v: float) -> tuple[float, ...]:
        """Return the values of a sample of which only the voltage is known."""
        return tuple(v if k == self._v else math.nan for k in range(len(self._order)))

    def _fill(self, end: Row, commanded: Commanded) -> None:
        """Mark the samples from the next one due up to `end` (not included) as missing."""
        first, n = self._next, end.index - self._next
        start, held = self._last.time, self._last.values[self._v]
        step = (end.time - start) / (n + 1)
        for k in range(n) if n <= min(FILL_UP_TO * self.rate, MOST_FILLED) else (0, n - 1):
            known = commanded(first + k)
            held = held if known is None else known
            self._pending.append(self._line(first + k, start + (k + 1) * step, self._nothing_but(held)))


def _open(path: Path, mode: str) -> int:
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | getattr(os, "O_BINARY", 0)
    try:
        fd = os.open(path, flags | (os.O_EXCL if mode == "new" else 0), 0o644)
    except FileExistsError:
        raise UsageError(f"{path} has appeared meanwhile and is left alone; choose another name.") from None
    except OSError as error:
        raise UsageError(f"{path} cannot be written: {error.strerror}.") from None
    try:
        _lock(fd, path)
        if mode == "replace":
            os.ftruncate(fd, 0)
    except BaseException:
        os.close(fd)
        raise
    return fd


def _lock(fd: int, path: Path) -> None:
    try:
        import fcntl
    except ImportError:  # no such locks on this system; the port itself is exclusive there
        return
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
            return  # a file system without locks
        raise UsageError(f"another recorder is writing {path}; choose another name.") from None
