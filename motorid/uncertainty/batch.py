"""One model fitted to the records of many motors: a table with failures and outliers, kept in a checkpoint file."""

from __future__ import annotations

import hashlib
import inspect
import json
import pickle
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from motorid.channels import CHANNELS
from motorid.display.cards import Table
from motorid.display.numbers import number, quantity
from motorid.errors import DataError, FitError, MissingDependency, OutputError, UsageError, otherwise, printable
from motorid.estimation.fit import fit
from motorid.estimation.result import Fit
from motorid.model.model import SHOWN, Model
from motorid.numerics.parallel import Map, interruption, map_items, one_thread
from motorid.numerics.signals import Array, robust_std
from motorid.records.experiment import Experiment
from motorid.records.files import package_version, read_bytes, write_files
from motorid.records.reading import find_records, read_runs
from motorid.uncertainty.covariance import covariance

Records = Sequence[Experiment] | Experiment | str | Path | Sequence[str | Path]
POOR = 3.0  # misfit over noise from which a row is flagged
FEWEST = 5  # motors among which one can stand out
LEVEL = 0.01  # chance of any false alarm in a whole batch of equal scatter


@dataclass(frozen=True)
class Outlier:
    """One parameter of one motor that stands out: value, the batch's median, z, and a sentence."""

    motor: str
    parameter: str
    value: float
    median: float
    z: float
    text: str

    def to_dict(self) -> dict[str, Any]:
        """Return plain data."""
        return {k: v for k, v in vars(self).items() if k != "text"}


@dataclass(frozen=True, eq=False)
class Batch:
    """What came of many motors.

    A row holds ``motor``, ``status`` (``"converged"``, … or ``"failed"``), ``message``, ``flags``, ``seconds``, per
    parameter its value and ``<name>_std`` (None: not determined), ``nrmse_<channel>``, ``chi2`` and ``dof``."""

    rows: tuple[dict[str, Any], ...]  # one per motor, in the order given
    parameters: tuple[str, ...]  # the free ones
    positive: frozenset[str]  # those compared on the logarithmic scale
    interrupted: str = ""  # or how far it came
    units: Mapping[str, str] = field(default_factory=dict)  # of the parameters

    @cached_property
    def table(self) -> Any:
        """The rows as a `pandas.DataFrame`, one line per motor."""
        import pandas as pd

        return pd.DataFrame([r | {"flags": "; ".join(r["flags"])} for r in self.rows]).set_index("motor")

    @property
    def failed(self) -> dict[str, str]:
        """Motors without a result, and why."""
        return {r["motor"]: r["message"] for r in self.rows if r["status"] == "failed"}

    @cached_property
    def outliers(self) -> tuple[Outlier, ...]:
        """Motors that differ from the others by more than scatter and own uncertainty explain."""
        return outliers([r for r in self.rows if r["status"] != "failed"], self.parameters, self.positive)

    def save(self, path: str | Path, force: bool = False) -> Path:
        """Write the table; the ending says how: ``.csv``, ``.parquet`` or ``.json``; see `write_files`."""
        target, table = Path(path), self.table
        as_json = partial(table.reset_index().to_json, orient="records", indent=1, force_ascii=False)
        ways = {".csv": table.to_csv, ".json": as_json, ".parquet": table.to_parquet, ".pq": table.to_parquet}
        if target.suffix not in ways:
            raise UsageError(f"a table is saved as .csv, .parquet or .json; got '{target.name}'.")
        try:
            return write_files({target: ways[target.suffix]()}, force)[0]
        except ImportError as error:
            raise MissingDependency("writing Parquet needs pyarrow: pip install 'motorid[parquet]', or "
                                    "save the table as .csv.") from error

    def to_dict(self) -> dict[str, Any]:
        """Return plain data: rows, outliers, counts."""
        return {"motors": len(self.rows), "failed": len(self.failed), "rows": [dict(r) for r in self.rows],
                "outliers": [o.to_dict() for o in self.outliers], "interrupted": self.interrupted or None}

    def __str__(self) -> str:
        good = [r for r in self.rows if r["status"] != "failed"]
        rows = []
        for n in self.parameters:
            v = np.array([r[n] for r in good if r.get(f"{n}_std") is not None], float)
            if v.size:
                low, middle, high = np.percentile(v, [5, 50, 95])
                unit = self.units.get(n, "")
                rows.append((n, quantity(middle, unit), f"{number(low)} … {number(high)}", str(v.size)))
        table = Table(("parameter", "median", "5 % … 95 % of the motors", "determined in"), rows,
                      f"{len(good)} of {len(self.rows)} motors fitted", left=(0, 2))
        poor = [r["motor"] for r in good if any(f.startswith("misfit") for f in r["flags"])]
        shown = ", ".join(poor[:5]) + (" …" if len(poor) > 5 else "")
        first = [f"{len(poor)} of {len(good)} motors fit poorly, errors over {POOR:g} times the noise: {shown}. "
                 "Next: diagnose the records of one of them."] if poor else []
        said = [*first, str(table), *(f"{name}: failed. {why}" for name, why in self.failed.items())]
        return "\n".join([*said, *(o.text for o in self.outliers), *([self.interrupted] if self.interrupted else [])])

    __repr__ = __str__


@one_thread
def fit_many(model: Model, motors: Mapping[str, Records], *, journal: str | Path | None = None, map: Map | None = None,
             reading: Mapping[str, Any] | None = None, quiet: bool = False, **options: Any) -> Batch:
    """Fit one model to the records of many motors. A motor that fails is a row that says why.

    Parameters
    ----------
    model : Model
    motors : mapping of str to records
        Per motor its runs, or where they are: a path, a pattern, several of these; read by the worker. UsageError for
        none.
    journal : path, optional
        Results go to this file as they come; what it holds for the same model, options and records is not done again.
    map : callable, optional
        Anything with the signature of `map`; a task is one motor, or a few of many.
    reading : mapping, optional
        Keyword arguments of `read_runs`.
    quiet : bool
        No progress bar.
    **options
        As in `fit`.

    Examples
    --------
    >>> batch = mi.fit_many(mi.dc_motor(), {"m1": runs[:1], "m2": runs[1:]}, quiet=True)
    >>> batch.table.loc["m1", "status"]
    'converged'
    """
    if not motors:
        raise UsageError("fit_many takes a mapping {name: runs}; it is empty. See motors_in(folder).")
    inspect.signature(fit).bind(model, motors, **options)  # a wrong option is no failure of every motor
    inspect.signature(read_runs).bind("", **(reading or {}))
    if any(e.__reduce__()[1][0] is None for e in model.effects):  # another process cannot import the law: functions now
        for outputs in (c for n in (1, 2, 3) for c in combinations(CHANNELS, n)):
            with suppress(Exception):  # a channel that this model does not have
                model.system(outputs)
    done = Checkpoint(Path(journal)) if journal is not None else None
    marks = {n: checkpoint_key(model, options, reading, runs) for n, runs in motors.items()} if done else {}
    known = {n: {**done.rows[m], "motor": n} for n, m in marks.items() if m in done.rows} if done else {}
    todo = [(n, runs) for n, runs in motors.items() if n not in known]
    found = map_items(_fit_one, (model, options, dict(reading or {})), todo, map, "Fitting motors", quiet=quiet,
                      each=None if done is None else lambda row: done.add(marks[row["motor"]], row))
    rows = known | {row["motor"]: row for row in found.results}
    said = f"Interrupted after {len(rows)} of {len(motors)} motors." if found.interrupted else ""
    return Batch(tuple(rows[name] for name in motors if name in rows), model.free_names,
                 frozenset(n for n, p in model.parameters.items() if p.positive), said,
                 {n: p.unit for n, p in model.parameters.items()})


def _fit_one(task: tuple[Model, Mapping[str, Any], Mapping[str, Any]], motor: tuple[str, Records]) -> dict[str, Any]:
    (model, options, reading), (name, records), began = task, motor, time.perf_counter()
    try:
        every = [records] if isinstance(records, Experiment | str | Path) else records
        paths = [r for r in every if not isinstance(r, Experiment)]
        runs = [r for r in every if isinstance(r, Experiment)] + (read_runs(paths, **reading) if paths else [])
        row = _row(fit(model, runs, **options))
    except Exception as error:  # one motor's trouble, whatever it is, must not end the batch
        if interruption.asked:
            raise KeyboardInterrupt from None
        row = {"status": "failed", "message": f"{type(error).__name__}: {error}", "flags": ["failed"]}
    return {"motor": name, **row, "seconds": time.perf_counter() - began}


def _row(found: Fit) -> dict[str, Any]:
    if found.status == "failed":
        raise FitError(found.message)
    certain = covariance(found)
    free = found.problem.model.free_names
    values = {f"{n}{what}": of[n] for n in free for what, of in (("", found.values), ("_std", certain.std))}
    flags = [] if found.status == "converged" else [found.status]
    flags += [f"{n} {certain.status[n]}" for n in free if certain.status[n] != "determined"]
    if (misfit := float(np.sqrt(found.chi2 / found.dof))) > POOR:
        flags.append(f"misfit {misfit:.2g} times the noise")
    return {"status": found.status, "message": found.message, "flags": flags, **values,
            **{f"nrmse_{c}": e for c, e in found.nrmse.items()}, "chi2": found.chi2, "dof": found.dof}


def motors_in(folder: str | Path) -> dict[str, list[Path]]:
    """Return the records in a folder by motor: each subfolder, each file beside them; DataError where there is none.

    Examples
    --------
    >>> list(mi.motors_in(mi.data_path("hidden_friction")))
    ['check1', 'run1', 'run2']
    """
    if not (place := Path(folder)).is_dir():
        raise DataError(f"'{place}' is not a folder; fit-many takes one with a folder, or a file, per motor.")
    found: dict[str, list[Path]] = {}
    for entry in sorted(place.iterdir()):
        if entry.name.startswith("."):
            continue
        name = entry.name if entry.is_dir() or entry.stem in found else entry.stem
        with suppress(DataError):
            found[printable(name)] = find_records(entry)
    if not found:
        raise DataError(f"'{place}' holds no records: expected a folder, or a file, per motor.")
    return found


def outliers(rows: Sequence[Mapping[str, Any]], names: Sequence[str], positive: frozenset[str]) -> tuple[Outlier, ...]:
    """Return outliers of a batch, the most extreme first: ``motor``, `names` and ``<name>_std`` per row."""
    found = []
    for n in names:
        known = [r for r in rows if r.get(f"{n}_std") is not None]
        if len(known) < FEWEST:
            continue
        value = np.array([r[n] for r in known], float)
        std = np.array([r[f"{n}_std"] for r in known], float)
        z = scores(np.log(value), std / value) if n in positive else scores(value, std)
        limit = float(scipy.special.stdtrit(max(len(known) - 2, 1), 1 - LEVEL / (2 * len(known) * len(names))))
        for j in np.flatnonzero(np.abs(z) > limit):
            middle = float(np.median(value))
            side = "above" if z[j] > 0 else "below"
            share = f"{abs(value[j] / middle - 1):.1%} {side}" if middle else side
            found.append(Outlier(known[j]["motor"], n, float(value[j]), middle, float(z[j]),
                                 f"{known[j]['motor']}: {n} = {value[j]:.4g} is {share} the batch's median "
                                 f"{middle:.4g} (z = {z[j]:.1f})."))
    return tuple(sorted(found, key=lambda o: -abs(o.z)))


def scores(x: Array, std: Array) -> Array:
    """Return robust z of values (n,): distance from the median over scatter and own uncertainty together."""
    middle = np.median(x)
    between = np.sqrt(max(robust_std(x - middle) ** 2 - np.median(std) ** 2, 0.0))
    return (x - middle) / np.maximum(np.hypot(between, std), 1e-12 * max(abs(middle), 1e-300))


class Checkpoint:
    """A file of JSON lines, one result each; a line cut off by a crash is ignored. `rows`: results by fingerprint."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: dict[str, dict[str, Any]] = {}
        text = read_bytes(path).decode("utf-8", "replace") if path.exists() else ""
        for line in text.splitlines():
            with suppress(ValueError, KeyError, TypeError, RecursionError):
                entry = json.loads(line)
                row = {"motor": entry["row"]["motor"], **entry["row"]}
                kinds = {"motor": str, "status": str, "message": str, "flags": list}
                if all(isinstance(value, kinds.get(name, int | float | None)) for name, value in row.items()):
                    self.rows[entry["fingerprint"]] = row
        if text.strip() and not self.rows and '{"fingerprint"' not in text:
            raise UsageError(f"'{path}' is not a journal of motorid, so nothing is added to it; name another file.")
        self._append("" if text.endswith("\n") or not text else "\n")

    def add(self, mark: str, row: Mapping[str, Any]) -> None:
        """Write a result under its fingerprint, at once."""
        self._append(json.dumps({"fingerprint": mark, "row": dict(row)}, ensure_ascii=False) + "\n")

    def _append(self, text: str) -> None:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a", encoding="utf-8", errors="backslashreplace") as file:
                file.write(text)
        except OSError as error:
            kind = UsageError if not text.strip() else OutputError
            raise kind(f"cannot write the journal {self.path}: {error.strerror}.") from None


def checkpoint_key(model: Model, options: Mapping[str, Any], reading: Mapping[str, Any] | None, records: Any) -> str:
    """Return a hash of all that a result depends on: versions, equations, values, options, contents of the records."""
    mark = hashlib.sha256(repr([package_version(p) for p in ("motorid", "casadi", "numpy", "scipy")]).encode())
    try:  # the equations as traced, whatever names, globals or files a law took them from
        system = model.system(SHOWN[model.base])
        mark.update("".join(f.serialize() for f in (system.rhs, system.out, system.initial)).encode())
    except Exception as error:  # of the user's law; then no motor can be fitted
        mark.update(repr(error).encode())
    mark.update(repr((model.base, model.axis, model.effect_names, sorted(model.parameters.items()))).encode())
    told = sorted(options.items()), sorted((reading or {}).items())
    text = repr(told)
    mark.update(pickle.dumps(told) if "..." in text or " at 0x" in text else text.encode())
    for part in _contents(records):
        mark.update(part)
    return mark.hexdigest()


def _contents(records: Any) -> list[bytes]:
    if isinstance(records, Experiment):
        return [pickle.dumps((records.hold, dict(records.sigma), dict(records.units))),
                *(a.tobytes() for a in (records.t, *records.inputs.values())),
                *(c.encode() + a.tobytes() for c, a in records.outputs.items())]
    if isinstance(records, str | Path):
        return otherwise([str(records).encode()], (DataError, OSError),
                         lambda: [Path(f).read_bytes() for f in find_records(records)])
    return [part for r in records for part in _contents(r)]
