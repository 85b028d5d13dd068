"""Record a run from a bench: check, connect, calibrate, start, write down, stop; see `record`."""

import contextlib
import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

from motorid.acquire.client import Client, Link, SerialLink
from motorid.acquire.excitation import Program, program
from motorid.acquire.protocol import VERSION, Header
from motorid.acquire.record_file import RecordFile, Tail, check_target, read_tail
from motorid.acquire.session import Progress, Recording, Session
from motorid.errors import DataError, UsageError, among, positive

_ENTRIES = ("scale", "offset", "gain", "zero", "sign")  # of a calibration, per channel


def record(port: str | Link, out: str | Path, *, baud: int = 115_200, excite: str | Program | None = None,
           duration: float | None = None, limit_voltage: float = math.inf, limit_current: float = math.inf,
           calibration: str | Path | Mapping[str, Any] | None = None, resume: bool = False, force: bool = False,
           timeout: float = 2.0, progress: Callable[[Progress], None] | None = None,
           meta: Mapping[str, object] | None = None) -> Recording:
    """Record one run from a bench that speaks `motorid.acquire.protocol`, into a CSV that `read_runs` opens.

    Every valid line is in the file within a tenth of a second and on the disk within one; lost samples are rows whose
    measured cells are empty. The device runs the excitation and enforces the limits, which are checked here as well
    before anything moves. **Keep clear of the shaft and have a switch at hand.**

    Parameters
    ----------
    port : str or Link
        ``/dev/ttyACM0``, ``COM3``, ``socket://127.0.0.1:7000``; opened for this recorder alone.
    out : str or Path
        The CSV to write.
    baud : int
        Bits per second; boards with native USB ignore it.
    excite : str or Program, optional
        E.g. ``"rest:0.2,step:6:0.5,coast:1"`` or ``"standard"``, see `motorid.acquire.excitation`; default: 0 V.
    duration : float, optional
        Stop after so many s.
    limit_voltage, limit_current : float
        In V and A; the device's own limits hold as well.
    calibration : path or mapping, optional
        See `read_calibration`.
    resume, force : bool
        Continue, or replace, a file that exists. Neither: it is left alone and an error raised.
    timeout : float
        Silence of the device, in s, that ends the recording.
    progress : callable, optional
        Called with a `Progress` a few times a second.
    meta : mapping, optional
        More to write at the head of the file.

    Returns
    -------
    Recording
        Also when the run was cut short: `Recording.complete` and `Recording.sentence` say how it ended.

    Raises
    ------
    UsageError, DataError, DeviceError
        Words, limits, files or calibration are wrong (nothing has moved); no port, no answer, or the device refuses.

    Examples
    --------
    >>> bench = mi.virtual_bench("coulomb")  # or a port, "/dev/ttyACM0"
    >>> done = mi.record(bench, "run1.csv", excite="step:6:0.2,coast:0.2", limit_voltage=8)
    >>> done.complete
    True
    """
    out = Path(out)
    check_target(out, resume, force)
    limits = {"limit_voltage": limit_voltage, "limit_current": limit_current}
    positive(duration=duration, timeout=timeout, **{c: x for c, x in limits.items() if x != math.inf})
    entries = (read_calibration(calibration) if isinstance(calibration, str | Path)
               else _checked(dict(calibration or {}), "the calibration"))
    tail = read_tail(out) if resume and out.exists() else None  # without an excitation, it goes on with its own
    excite = tail.meta.get("excitation") if tail and excite is None else excite
    if not (isinstance(excite, str) and "standard" in excite):  # that one asks the device for its limit
        program(excite).check(limit_voltage, 1 << 30, "the limit you gave")
    with contextlib.closing(SerialLink(port, baud) if isinstance(port, str) else port) as link:
        client = Client(link)
        device = client.hello()
        header = calibrate(device, entries)
        whole = program(excite, min(limit_voltage, device.v_max))
        todo = _left(whole, tail) if tail else whole
        todo.check(min(limit_voltage, device.v_max), device.segments,
                   "the limit you gave" if limit_voltage < device.v_max else "the device's own limit")
        limits = client.prepare(device, limit_voltage, limit_current, todo)
        head = _head(port, header, program(excite, limits[0]), limits, entries) | dict(meta or {})
        mode = "resume" if tail else "replace" if force else "new"
        file = RecordFile(out, header.channels, header.rate, head if not tail else {}, mode)
        try:
            told, kept = (next(c for c in h.channels if c.name == "v") for h in (device, header))

            def commanded(index: int) -> float | None:  # what the device applies, in the units of the record
                volts = todo.at(index, device.rate)
                return None if volts is None else kept.scale * (volts / told.scale + told.offset - kept.offset)

            beside = abs(told.scale * (told.offset - kept.offset))  # what may be reported, as a calibration makes it
            most = {"v": abs(kept.scale / told.scale) * (1.01 * limits[0] + beside), "i": limits[1]}
            if tail:
                _begin_part(file, tail, len(whole.segments) - len(todo.segments))  # before anything moves
            total = min((e for e in (todo.duration, duration) if e), default=None)
            return Session(client, header, file, len(todo.segments), commanded, most, total, duration,
                           max(timeout, 4 / header.rate), progress).run()
        finally:
            with contextlib.suppress(OSError):  # told already, where it matters
                file.close()


def _head(port: str | Link, header: Header, whole: Program, limits: tuple[float, float],
          entries: Mapping[str, Any]) -> dict[str, object]:
    return {"motorid record": f"protocol {VERSION}", "device": header.name,
            "port": port if isinstance(port, str) else type(port).__name__,
            "started": datetime.now().astimezone().isoformat(timespec="milliseconds"),
            "rate_Hz": f"{header.rate:g}", "limits": f"{limits[0]:g} V, {limits[1]:g} A", "excitation": whole.words,
            **{f"channel {c.name}": f"{c.scale:.9g} {c.unit} per count, zero at {c.offset:.9g}, kind {c.kind}"
               for c in header.channels}, **({"calibration": entries} if entries else {})}


def _left(whole: Program, tail: Tail) -> Program:
    """Return what a record lacks of a program, from the interrupted segment; UsageError if nothing."""
    left = Program(whole.segments[int(tail.meta.get("segments done", 0)):], whole.words).after(
        tail.time - float(tail.meta.get("part begins", 0)))
    if tail.meta.get("ended") == "done" or (whole.segments and not left.segments):
        raise UsageError("this record is complete; there is nothing to resume. Choose another name for --out.")
    return left


def _begin_part(file: RecordFile, tail: Tail, done: int) -> None:
    """Set the time axis of a resumed record, by the clock of this computer, and mark the pause."""
    now, at = datetime.now().astimezone(), tail.time + 2 / file.rate
    if "started" in tail.meta:
        at = max(at, (now - datetime.fromisoformat(tail.meta["started"]).astimezone()).total_seconds())
    at = math.ceil(at * file.rate) / file.rate
    file.pause(tail, at)
    file.note({"resumed": now.isoformat(timespec="milliseconds"), "part begins": f"{at:.6f}", "segments done": done,
               "pause": f"{at - tail.time:.3f} s, the motor taken to be off; the angle may count from another zero "
                        "after it"})


def read_calibration(path: str | Path) -> dict[str, dict[str, float]]:
    """Read the user's calibration of a bench, a TOML file: per channel scale, offset, gain, zero and sign."""
    try:
        if Path(path).exists() and not Path(path).is_file():
            raise DataError(f"the calibration {path} is no file but a folder, a device or a pipe.")
        tables = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"the calibration file {path} cannot be read: {error.strerror}.") from None
    except (ValueError, RecursionError) as error:
        raise DataError(f"the calibration file {path} is not TOML: {error}.") from None
    return _checked(tables, path)


def _checked(tables: dict[str, Any], path: str | Path) -> dict[str, dict[str, float]]:
    for channel, entries in tables.items():
        if not isinstance(entries, dict):
            raise DataError(f"{path}: expected a table [channel] with entries; '{channel}' is in none.")
        for name, value in entries.items():
            among(name, _ENTRIES, "entry", DataError, f"{path}, [{channel}]: ")
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
        among(name, names, "channel", DataError, "the calibration names a channel that the device does not send: ")
    channels = []
    for c in header.channels:
        entries = calibration.get(c.name, {})
        scale = entries.get("scale", c.scale) * entries.get("gain", 1.0) * entries.get("sign", 1)
        # zero + scale·(raw − offset) is scale·(raw − (offset − zero/scale)).
        offset = entries.get("offset", c.offset) - entries.get("zero", 0.0) / scale
        channels.append(replace(c, scale=scale, offset=offset))
    return replace(header, channels=tuple(channels))
