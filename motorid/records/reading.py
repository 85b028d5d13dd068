"""Read and write records: text tables, MATLAB, Parquet; `read_runs` is the entry."""

import glob
import hashlib
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from motorid.errors import DataError, UsageError, one_of, positive
from motorid.records.cleaning import run_from_columns
from motorid.records.experiment import Experiment, between_pauses
from motorid.records.files import read_bytes, write_files
from motorid.records.headers import assign, classify, first_of_its_name, parse_pairs
from motorid.records.tables import FORMATS, TextTable, frame_table, mat_table, parse_table

Path_ = str | os.PathLike[str]
RECORDS = (".csv", ".txt", ".tsv", ".dat", ".log", *FORMATS)
_HEADERS = {("t", "s"): "time_s", ("v", "V"): "voltage_V", ("v", "A"): "command_A", ("v", "N·m"): "command_Nm",
            ("v", "N"): "command_N", ("v", "1"): "command (1)", ("i", "A"): "current_A",
            ("omega", "rad/s"): "speed_rad_s", ("omega", "m/s"): "speed_m_s", ("theta", "rad"): "angle_rad",
            ("theta", "m"): "position_m", ("v_supply", "V"): "supply_V", ("tau_load", "N·m"): "load_torque_Nm",
            ("tau_load", "N"): "load_force_N", ("temp", "°C"): "temperature_degC"}
_OWN = re.compile(r"#\s*motorid (columns|hold|sigma): (.*)")  # what write_csv says about its own file
_SECONDS = re.compile(r"(.*?)(?:s|secs?|seconds)", re.IGNORECASE)
_FRACTION = re.compile(r"(.*?)(n|nano|u|micro|m|milli)(?:s|secs?|seconds)", re.IGNORECASE)
_SIZES = {"n": 1e-9, "nano": 1e-9, "u": 1e-6, "micro": 1e-6, "m": 1e-3, "milli": 1e-3}
_PART = re.compile(r"#\s*part begins: (\d+\.?\d*)")  # what a resumed recording says, s


def read_runs(paths: Path_ | Iterable[Path_], *, columns: Mapping[str, object] | None = None,
              units: Mapping[str, object] | None = None, hold: str | None = None,
              dt: float | None = None) -> list[Experiment]:
    """Read records, one run per file; where one pauses (a resumed recording, a gap in time), one per part.

    Parameters
    ----------
    paths : str, path, pandas.DataFrame, or a list of these
        Files, directories, or patterns such as ``"data/run*.csv"``, each in natural order (run2, run10).
    columns : mapping, optional
        Channel (t, v, i, omega, theta, v_supply, tau_load, temp) to column, by name or by position counted from 1,
        where the header does not tell: ``{"v": "u_volt"}``; to None where it is to be left out.
    units : mapping, optional
        Channel or column to unit: ``{"omega": "rpm", "theta": "counts:2048", "i": "-1 A", "v": "us:1500"}``.
    hold : {"zoh", "linear"}, optional
        The input between samples (see `Experiment`); by default what the file says (see `write_csv`), else "zoh".
    dt : float, optional
        Time between samples, s, of records without a column of time.

    Returns
    -------
    list of Experiment
        In SI units. ``run.meta["notes"]`` says what was assumed, mended or left out;
        ``meta["extra"]`` holds the other numeric columns.

    Raises
    ------
    DataError
        If a file is missing or cannot be used; the message says why and what to do.

    Examples
    --------
    >>> runs = mi.read_runs(mi.data_path("hidden_friction") / "run*.csv")
    >>> len(runs)
    2
    """
    given = paths if isinstance(paths, list | tuple) else [paths]
    if any(hasattr(p, "reset_index") for p in given):
        runs = [_of_table(frame_table(p), columns, units, hold, dt, f"run{k}", {}) for k, p in enumerate(given, 1)]
    else:
        files = find_records(paths)
        stems = Counter(f.stem for f in files)
        runs = (_read(f, FORMATS.get(f.suffix.lower(), parse_table), columns, units, hold, dt,
                      f.stem if stems[f.stem] == 1 else f"{f.parent.name}/{f.name}") for f in files)
    return [part for run in runs for part in between_pauses(run)]


def read_csv(path: Path_, *, columns: Mapping[str, object] | None = None, units: Mapping[str, object] | None = None,
             hold: str | None = None, dt: float | None = None, name: str | None = None) -> Experiment:
    """Read one text file of any dialect (delimiter, decimal comma, comments, row of units, encoding).

    Parameters and errors are those of `read_runs`; `name` is used instead of the name of the file.

    Examples
    --------
    >>> run = mi.read_csv(mi.data_path("hidden_friction/run1.csv"))
    >>> run.channels
    ('i', 'omega')
    """
    return _read(path, parse_table, columns, units, hold, dt, name)


def read_mat(path: Path_, *, columns: Mapping[str, object] | None = None, units: Mapping[str, object] | None = None,
             hold: str | None = None, dt: float | None = None, name: str | None = None) -> Experiment:
    """Read one MATLAB file (up to version 7); otherwise like `read_csv`.

    Examples
    --------
    >>> run = mi.read_mat("bench.mat", columns={"v": "u"}, units={"omega": "rpm"})  # doctest: +SKIP
    """
    return _read(path, mat_table, columns, units, hold, dt, name)


def write_csv(experiment: Experiment, path: Path_, force: bool = False) -> Path:
    """Write a run as `csv_text` has it, so that `read_csv` gives the same run back."""
    return write_files({Path(os.path.expanduser(path)): csv_text(experiment)}, force)[0]


def csv_text(run: Experiment) -> str:
    """Return a run as CSV: time, channels, extra columns, hold, sigma."""
    import pandas as pd

    channels = {"t": run.t, **run.inputs, **run.outputs}
    headers = {c: _HEADERS[c, {"t": "s", **run.units}[c]] for c in channels}
    table = {headers[c]: a for c, a in channels.items()}
    table |= {f"{k} (extra)" if k in table else str(k): np.asarray(a)
              for k, a in run.meta.get("extra", {}).items() if np.shape(a) == run.t.shape}
    about = ["# motorid columns: " + ",".join(f"{c}={h}" for c, h in headers.items()), f"# motorid hold: {run.hold}"]
    about += ["# motorid sigma: " + ",".join(f"{c}={s!r}" for c, s in run.sigma.items())] if run.sigma else []
    return "\n".join([*about, pd.DataFrame(table).to_csv(index=False, na_rep="", lineterminator="\n")])


def find_records(paths: Path_ | Iterable[Path_]) -> list[Path]:
    """Return the files meant by names, directories and patterns, each once, in natural order."""
    paths = [paths] if isinstance(paths, str | os.PathLike) else paths
    if not isinstance(paths, Iterable):
        raise UsageError(f"expected a file, a directory, a pattern or a list of these; got {paths!r}.")
    files: dict[Path, None] = {}
    for path in paths:
        if not isinstance(path, str | os.PathLike) or isinstance(os.fspath(path), bytes):
            raise UsageError(f"expected the name of a file as text or path; got {path!r}.")
        if not os.fspath(path):
            raise UsageError("the name of a record is empty: a variable of the shell that was never set?")
        try:
            files |= dict.fromkeys(_expand(Path(os.path.expanduser(path))))
        except OSError as error:  # a name that is too long, a folder that may not be looked into
            raise DataError(f"cannot read {path}: {error.strerror}.") from error
    if not files:
        raise DataError("no record is given; name at least one file, directory or pattern.")
    return list(files)


def _expand(path: Path) -> list[Path]:
    if path.is_dir():
        if not (found := [f for f in path.iterdir() if _is_record(f)]):
            raise DataError(f"the directory {path} holds no records ({', '.join(RECORDS)}).")
        return sorted(found, key=_natural)
    if path.exists():
        return [path]
    if glob.has_magic(str(path)):
        if found := [f for f in map(Path, glob.glob(str(path), recursive=True)) if f.is_file()]:
            return sorted(found, key=_natural)
        raise DataError(f"nothing matches the pattern {path}. {_what_is_there(path.parent)}")
    raise DataError(f"there is no file {path}. {_what_is_there(path.parent, path.name)}")


def _what_is_there(folder: Path, wanted: str | None = None) -> str:
    try:
        os.getcwd()
    except OSError:
        return "The working directory does not exist any more."
    if not folder.is_dir():
        return f"Its folder {folder} does not exist, either; the working directory is {Path.cwd()}."
    if not (names := sorted((f.name for f in folder.iterdir() if f.is_dir() or _is_record(f)), key=str.lower)):
        return f"There are no records in {folder.absolute()}."
    if wanted:
        return one_of(wanted, names[:12], "file").removeprefix(f"unknown file '{wanted}'. ")
    return f"There is: {', '.join(names[:12])}{' ...' if len(names) > 12 else ''}."


def _is_record(path: Path) -> bool:
    return path.suffix.lower() in RECORDS and path.name[0] != "." and path.is_file()


def _natural(path: Path) -> list[tuple[int, int, str]]:
    return [(0, int(p), "") if p.isdecimal() else (1, 0, p) for p in re.split(r"(\d+)", str(path).lower()) if p]


def _read(path: Path_, to_table: Callable[[bytes], TextTable], columns: Mapping[str, object] | None,
          units: Mapping[str, object] | None, hold: str | None, dt: float | None, name: str | None) -> Experiment:
    path = Path(os.path.expanduser(path))
    data = read_bytes(path)
    try:
        meta = {"source": str(path), "sha256": hashlib.sha256(data).hexdigest()}
        return _of_table(to_table(data), columns, units, hold, dt, name or path.stem, meta)
    except (DataError, UsageError) as error:
        raise DataError(f"{path}: {error}") from None


def _is_copy(label: str, labels: Sequence[str], table: TextTable) -> bool:
    """Tell a column that repeats the one of the same name: loggers write the time beside each channel."""
    first = first_of_its_name(label, labels)
    a, b = table.columns.get(first), table.columns.get(label)
    return first != label and a is not None and b is not None and np.array_equal(a, b, equal_nan=True)


def _of_table(table: TextTable, columns: Mapping[str, object] | None, units: Mapping[str, object] | None,
              hold: str | None, dt: float | None, name: str, meta: Mapping[str, Any]) -> Experiment:
    own: dict[str, str] = {m[1]: m[2] for m in map(_OWN.fullmatch, table.comments) if m}
    labels = table.labels
    if "columns" in own and all(column is None for column in (columns or {}).values()):
        columns = {**parse_pairs(own["columns"], "columns"), **(columns or {})}
        labels = [c for c in labels if c in columns.values()]
    labels = [c for c in labels if not _is_copy(c, labels, table)]
    if dt is None:
        table, labels, columns = _with_whole_stamps(table, labels, columns or {})
    else:
        table, columns, units = _timed(table, columns or {}, units or {}, dt)
        labels = [*labels, columns["t"]]
    layout = assign(labels, columns=columns, units=units, unit_row=table.unit_row, values=table.columns)
    parts = tuple(float(m[1]) for m in map(_PART.fullmatch, table.comments) if m)
    try:
        sigma = {c: float(s) for c, s in parse_pairs(own["sigma"], "sigma").items()} if own.get("sigma") else {}
    except ValueError:
        raise DataError(f"cannot read the noise levels '{own['sigma']}' in its comments.") from None
    return run_from_columns(table.columns, table.texts, layout, name=name, hold=hold or own.get("hold", "zoh"),
                            sigma=sigma, meta={**meta, "parts": parts}, notes=table.notes)


def _with_whole_stamps(table: TextTable, labels: Sequence[str], columns: Mapping[str, object]
                       ) -> tuple[TextTable, list[str], Mapping[str, object]]:
    """Put time stamps together that come as seconds and a fraction (``stamp.sec``, ``stamp.nanosec``); the first of
    them is the time where neither the user nor a header names another."""
    sums, asked = dict[str, str](), {str(column) for column in columns.values()}
    wholes = {m[1]: c for c in labels if c in table.columns and (m := _SECONDS.fullmatch(c))}
    for fine in labels:
        if (m := _FRACTION.fullmatch(fine)) and m[1] in wholes and fine in table.columns and fine not in asked:
            s, part = table.columns[whole := wholes[m[1]]], table.columns[fine] * _SIZES[m[2].lower()]
            known = np.isfinite(s) & np.isfinite(part)
            if known.any() and np.all((part[known] >= 0) & (part[known] < 1) & (s[known] == np.floor(s[known]))):
                table = replace(table, columns={**table.columns, whole: s - s[known][0] + part})
                sums[whole] = fine
    if sums and "t" not in columns and not any(
            hit.channel == "t" and hit.score > 1 for c in labels if c not in sums and (hit := classify(c))):
        first = next(iter(sums))
        columns = {**columns, "t": first}
        table = replace(table, notes=[*table.notes, f"'{first}' and '{sums[first]}' together are the time."])
    return table, [c for c in labels if c not in sums.values()], columns


def _timed(table: TextTable, columns: Mapping[str, object], units: Mapping[str, object],
           dt: float) -> tuple[TextTable, dict[str, Any], dict[str, Any]]:
    """Return a table with a column of times `dt` apart, named as the time in the columns and units."""
    positive(" It is the time between samples, s.", dt=dt)
    if "t" in columns:
        raise UsageError(f"the time is either a column ('{columns['t']}') or given by dt; leave one of them out.")
    n = max(map(len, [*table.columns.values(), *table.texts.values()]), default=0)
    label = "sample times" + "'" * ("sample times" in table.labels)
    numbers = {**table.columns, label: dt * np.arange(n)}
    return replace(table, columns=numbers), {**columns, "t": label}, {**units, "t": "s"}
