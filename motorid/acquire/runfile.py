"""The record on disk: a CSV file that only ever grows by whole lines, and never over something else."""

from __future__ import annotations

import errno
import math
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

from motorid.acquire.ledger import Row
from motorid.acquire.protocol import Channel
from motorid.errors import DataError, UsageError

__all__ = ["RunFile", "Tail", "check_target", "column", "read_tail"]

SYNC_EVERY = 0.5  # s between two calls of fsync: what is older than that survives a power cut
FILL_UP_TO = 60.0  # s; a longer gap is marked by its first and last sample alone
_COLUMNS = {("v", "V"): "voltage_V", ("i", "A"): "current_A", ("omega", "rad/s"): "speed_rad_s",
            ("omega", "m/s"): "speed_m_s", ("theta", "rad"): "angle_rad", ("theta", "m"): "position_m"}
_ORDER = ("v", "i", "omega", "theta")


Commanded = Callable[[int], float | None]  # voltage (V) commanded at a sample, None where nobody knows


def _unknown(index: int) -> None:
    return None


def column(channel: Channel) -> str:
    """Name of the channel's column, one that `read_runs` knows."""
    other = f"{channel.name}_{channel.unit}".replace("/", "_per_")
    return _COLUMNS.get((channel.name, channel.unit), other)


class Tail(NamedTuple):
    """Where an existing record ends."""

    columns: str
    index: int
    time: float
    meta: dict[str, str]


def check_target(out: Path, resume: bool, force: bool) -> None:
    """Refuse, before anything moves, a file that must not be written.

    Raises
    ------
    UsageError
        If it exists and neither `resume` nor `force` is given, or both are, or its folder does not exist.
    """
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
    """Read where a record ends; a last line that was cut off does not count.

    Raises
    ------
    DataError
        If the file is not a record made by motorid.
    """
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
    try:
        cells = dict(zip(columns.split(","), last.split(","), strict=True))
        return Tail(columns, int(cells["sample"]), float(cells["time_s"]), meta)
    except (KeyError, ValueError):
        if columns.startswith("time_s,") and columns.endswith(",sample") and not last:
            return Tail(columns, -1, 0.0, meta)
        raise DataError(f"{out} is not a record that motorid made, so it cannot be continued. Choose another "
                        "name for --out.") from None


class RunFile:
    """Appends rows to a record; gaps become rows whose measured cells are empty.

    Every call of `flush` hands whole lines to the operating system, and at least every 0.5 s to the disk. If
    the disk refuses (it is full, say), the file is cut back to its last whole line and the error passed on.

    Parameters
    ----------
    out : Path
    channels : of the device, calibrated
    rate : samples per second
    meta : written as comment lines ``# key: value`` at the head (of a new record), or where it goes on
    mode : {"new", "replace", "resume"}
    """

    def __init__(self, out: Path, channels: tuple[Channel, ...], rate: float, meta: Mapping[str, object],
                 mode: str = "new") -> None:
        self.out, self.rate, self.lines = out, rate, 0  # lines on disk
        known = [k for name in _ORDER for k, c in enumerate(channels) if c.name == name]
        self._order = known + [k for k in range(len(channels)) if k not in known]
        self._v = next(k for k, c in enumerate(channels) if c.name == "v")
        self.columns = ",".join(["time_s", *(column(channels[k]) for k in self._order), "sample"])
        self._pending: list[str] = []
        self._synced = time.monotonic()
        self._next, self._index0, self._time0 = 0, 0, 0.0
        self._last: Row | None = None
        self._fd = _open(out, mode)
        try:
            self._good = os.fstat(self._fd).st_size
            self._begin(meta, mode)
        except BaseException as error:
            os.close(self._fd)
            if mode == "new":
                out.unlink()
            if isinstance(error, OSError):
                raise UsageError(f"{out} cannot be written: {error.strerror}.") from None
            raise

    def _begin(self, meta: Mapping[str, object], mode: str) -> None:
        head = "".join(f"# {k}: {' '.join(str(v).split())}\n" for k, v in meta.items())
        if mode == "resume" and self._good:
            tail = read_tail(self.out)
            if tail.columns != self.columns:
                raise DataError(f"{self.out} has the columns {tail.columns}, but the device now sends "
                                f"{self.columns}. Record into another file.")
            self._cut_back_to_whole_lines()
            self._pending.append(head)
        else:
            self._pending += [head, self.columns + "\n"]
        self.flush()

    def pause(self, tail: Tail, until: float) -> None:
        """Mark the pause of a resumed record by one row at 0 V; what follows begins at `until` s."""
        if tail.index >= 0:
            nothing = tuple(0.0 if k == self._v else math.nan for k in range(len(self._order)))
            self._index0, self._time0 = tail.index + 1, tail.time
            self._pending.append(self._line(0, 1 / self.rate, nothing))
        self._index0, self._time0 = max(round(until * self.rate), tail.index + 2), until

    def add(self, rows: list[Row], commanded: Commanded = _unknown) -> None:
        """Append rows; `commanded` tells the voltage (V) of samples that were lost, where it is known."""
        for row in rows:
            if row.index > self._next:
                self._fill(row, commanded)
            self._pending.append(self._line(row.index, row.time, row.values))
            self._next, self._last = row.index + 1, row

    def mark_missing(self, until: int, commanded: Commanded = _unknown) -> None:
        """Mark as missing what was made up to sample `until` (not included) and never came."""
        if until > self._next:
            last = self._last.time if self._last else -1 / self.rate
            end = Row(until, last + (until - self._next + 1) / self.rate, (math.nan,) * len(self._order))
            self._fill(end, commanded)
            self._next = until

    def note(self, meta: Mapping[str, object]) -> None:
        """Append comment lines ``# key: value``."""
        self._pending += [f"# {k}: {' '.join(str(v).split())}\n" for k, v in meta.items()]

    def flush(self, sync: bool = False) -> None:
        """Hand everything to the operating system, and to the disk if that is due."""
        data = "".join(self._pending).encode()
        self._pending.clear()
        written = 0
        try:
            while written < len(data):
                written += os.write(self._fd, data[written:])
            if sync or time.monotonic() - self._synced > SYNC_EVERY:
                os.fsync(self._fd)
                self._synced = time.monotonic()
        finally:
            whole = data.rfind(b"\n", 0, written) + 1
            self._good += whole
            self.lines += data.count(b"\n", 0, whole)
            if whole < written:
                os.ftruncate(self._fd, self._good)

    def close(self) -> None:
        """Close the file; what was not flushed is not written."""
        os.close(self._fd)

    def _line(self, index: int, time_s: float, values: tuple[float, ...]) -> str:
        cells = [f"{self._time0 + time_s:.6f}"]
        for k in self._order:
            value = values[k]
            cells.append("" if value != value else f"{value:.9g}")
        cells.append(str(self._index0 + index))
        return ",".join(cells) + "\n"

    def _fill(self, end: Row, commanded: Commanded) -> None:
        """Mark the samples from the next one due up to `end` (not included) as missing."""
        first, n = self._next, end.index - self._next
        start = self._last.time if self._last else -1 / self.rate
        held = self._last.values[self._v] if self._last else 0.0
        step = (end.time - start) / (n + 1)
        which = range(n) if n <= FILL_UP_TO * self.rate else (0, n - 1)
        for k in which:
            known = commanded(first + k)
            held = held if known is None else known
            values = [math.nan] * len(self._order)
            values[self._v] = held
            self._pending.append(self._line(first + k, start + (k + 1) * step, tuple(values)))

    def _cut_back_to_whole_lines(self) -> None:
        with open(self.out, "rb") as file:
            file.seek(max(0, self._good - 4096))
            end = file.read()
        cut = len(end) - (end.rfind(b"\n") + 1)
        if cut:
            self._good -= cut
            os.ftruncate(self._fd, self._good)


def _open(out: Path, mode: str) -> int:
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | getattr(os, "O_BINARY", 0)
    try:
        fd = os.open(out, flags | (os.O_EXCL if mode == "new" else 0), 0o644)
    except FileExistsError:
        raise UsageError(f"{out} has appeared meanwhile and is left alone; choose another name.") from None
    except OSError as error:
        raise UsageError(f"{out} cannot be written: {error.strerror}.") from None
    try:
        _lock(fd, out)
        if mode == "replace":
            os.ftruncate(fd, 0)
    except BaseException:
        os.close(fd)
        raise
    return fd


def _lock(fd: int, out: Path) -> None:
    try:
        import fcntl
    except ImportError:  # no such locks on this system; the port itself is exclusive there
        return
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
            return  # a file system without locks
        raise UsageError(f"another recorder is writing {out}; choose another name.") from None
