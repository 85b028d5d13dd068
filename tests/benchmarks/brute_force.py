"""What single effects, pairs and triples of the library reach on a case, by trying them.

A model is fitted from several starts by ``mi.fit`` and judged on the held-out runs by ``mi.evaluate``; a fit that
fails or takes too long is a row that says so. Every fit is written down at once, so that a search can be interrupted
and taken up again. All single effects are tried; of pairs and triples those of `WIDTHS`, a narrow search of all cases
first. Half of the best that are taken on are those with the least held-out error, half those with the least BIC on
the fitted runs.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any, TypeVar

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from real_cases import Case, Parts

import motorid as mi
from motorid.effects import LIBRARY
from motorid.errors import ModelError, MotoridError

LIMIT = 20.0  # processor time of one fit, s
KEPT = 3  # best of each size that are fitted to all samples in the end
TIED = 1e-3  # relative difference of two figures within which the smaller model is the better
STALLED = 1e-3  # relative fall of the criterion below which a larger model is started elsewhere too
Row = dict[str, Any]
T = TypeVar("T")


@dataclass(frozen=True)
class Width:
    """How far a search goes: pairs among the best `singles`, and of every effect with the best `with_all`; triples of
    the best `pairs` with the best `singles`."""

    name: str
    singles: int
    with_all: int
    pairs: int


WIDTHS = (Width("singles", 0, 0, 0), Width("narrow", 5, 0, 2), Width("pairs", 10, 2, 2), Width("full", 10, 2, 5))


class OutOfTime(BaseException):
    """The processor time of one piece of work is spent; not an Exception, which the work might catch."""


def within(seconds: float, work: Callable[[], T]) -> T:
    """Return what `work` returns, or raise OutOfTime after so much processor time of this process."""

    def stop(*_: object) -> None:
        raise OutOfTime

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        return work()
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def processor_time() -> float:
    """Return the processor time of this process and of those that it started, s."""
    t = os.times()
    return t.user + t.system + t.children_user + t.children_system


def figure(nrmse: Mapping[str, float]) -> float:
    """Return the geometric mean of the channels' NRMSE, by which models are compared."""
    return float(np.exp(np.mean(np.log([max(e, 1e-12) for e in nrmse.values()]))))


def grown(base: mi.Model, effects: Iterable[str], values: Mapping[str, float] | None = None) -> mi.Model:
    """Return `base` with effects, at given values as the result of another fit."""
    model = base
    for name in effects:
        model = model + LIBRARY[name]
    return model.start_at(values) if values else model


def judged(model: mi.Model, values: Mapping[str, float], runs: Sequence[mi.Experiment]) -> dict[str, float]:
    """Return the NRMSE of a stored model on `runs`; the width of sgn is part of what is judged."""
    model = model.start_at(values)
    if "sgn_width" in model.parameters:
        model = model.replace(sgn_width=model.values["sgn_width"])
    return dict(mi.evaluate(model, runs).nrmse)


def row_of(fit: mi.Fit, names: Sequence[str], held: Sequence[mi.Experiment]) -> Row:
    """Return the figures of a fit; ``bic`` has a scale per channel: Σ n·ln(MSE) + k·ln(Σ n)."""
    counts = {c: sum(int(np.isfinite(r.outputs[c]).sum()) for r in fit.problem.experiments if c in r.outputs)
              for c in fit.rmse}
    misfit = sum(n * 2 * np.log(max(fit.rmse[c], 1e-300)) for c, n in counts.items())
    n, k = sum(counts.values()), len(fit.problem.unknown)
    held_out = dict(mi.evaluate(fit, held).nrmse)
    numbers = [misfit, *held_out.values()]
    if not np.isfinite(numbers).all():
        raise MotoridError("not finite")
    return {"effects": list(names), "nrmse": dict(fit.nrmse), "held_out": held_out, "figure": figure(held_out),
            "misfit": misfit / n, "bic": misfit + k * float(np.log(n)), "values": dict(fit.values)}


def fitted(models: Sequence[mi.Model], names: Sequence[str], parts: Parts, enough: float = np.inf) -> Row:
    """Return the best by the fitted runs of fits from several starts, or why there is none.

    Further starts are left out once the criterion on the fitted runs is below `enough`.
    """
    best: Row | None = None
    why = ""
    began = processor_time()
    for model in models:
        try:
            row = within(LIMIT, lambda model=model: row_of(mi.fit(model, parts[0]), names, parts[1]))
        except OutOfTime:
            why = f"more than {LIMIT:.0f} s"
            continue
        except ModelError as error:
            why = f"refused: {error}"[:120]
            break
        except (MotoridError, ValueError, ArithmeticError, RuntimeError, np.linalg.LinAlgError) as error:
            why = f"{type(error).__name__}: {error}"[:120]
            continue
        best = row if best is None or row["misfit"] < best["misfit"] else best
        if best["misfit"] < enough:
            break
    seconds = round(processor_time() - began, 2)
    return {**best, "seconds": seconds} if best else {"effects": list(names), "failed": why, "seconds": seconds}


@dataclass
class Journal:
    """Rows of all fits so far, by case and set of effects, appended to a file of one JSON object per line."""

    path: Path
    rows: dict[tuple[str, frozenset[str]], Row] = field(default_factory=dict)

    @classmethod
    def at(cls, path: Path) -> Journal:
        journal = cls(path)
        for line in path.read_text().splitlines() if path.exists() else ():
            row = json.loads(line)
            journal.rows[row.pop("case"), frozenset(row["effects"])] = row
        return journal

    def add(self, case: str, row: Row) -> Row:
        self.rows[case, frozenset(row["effects"])] = row
        with self.path.open("a") as file:
            file.write(json.dumps({"case": case, **row}) + "\n")
        return row

    def of(self, case: str, size: int) -> list[Row]:
        """Return the successful rows of a case with `size` effects."""
        return [r for (c, key), r in self.rows.items() if c == case and len(key) == size and "failed" not in r]


@dataclass
class BruteForce:
    """The search on one case, on thinned records."""

    case: Case
    parts: Parts
    journal: Journal
    given: list[Row] = field(default_factory=list)  # of the models along ladders

    @classmethod
    def on(cls, case: Case, parts: Parts, journal: Journal) -> BruteForce:
        return cls(case, case.thinned(parts), journal)

    def go(self, width: Width) -> None:
        """Try what a width asks for and is not in the journal yet."""
        base = self.case.model
        library = [n for n in LIBRARY if n not in base.effect_names]
        plain = self._row((), lambda: [base])
        for name in library:
            self._row((name,), lambda name=name: [grown(base, (name,)), grown(base, (name,), plain.get("values"))])
        names = [r["effects"][0] for r in self.best(1, width.singles)]
        others = [n for n in library if n not in names]
        for pair in [*combinations(names, 2), *((n, b) for n in others for b in names[:width.with_all])]:
            self._row(pair, lambda pair=pair: self._starts(pair))
        for pair in [r["effects"] for r in self.best(2, width.pairs)]:
            for key in [(*pair, n) for n in names if n not in pair]:
                self._row(key, lambda key=key: self._starts(key))

    def ladders(self, rows: Iterable[Row]) -> None:
        """Try the models along the ladders of diagnoses, too."""
        for row in rows:
            names: list[str] = []
            for rung in row.get("ladder", ()) if row["case"] == self.case.name else ():
                kept = [n for n in names if n not in rung.get("removed", ())]
                names = [*kept, *(rung["added"].split(" + ") if rung["added"] else ())]
                self.given.append(self._row(names, lambda names=tuple(names): self._starts(names)))

    def best(self, size: int, count: int) -> list[Row]:
        """Return the best rows with `size` effects: by held-out error and by BIC, in turn."""
        rows = self.journal.of(self.case.name, size)
        orders = [sorted(rows, key=lambda r, by=by: r[by]) for by in ("figure", "bic")]
        found: list[Row] = []
        for row in (r for both in zip(*orders, strict=True) for r in both):
            if row not in found:
                found.append(row)
        return found[:count]

    def _row(self, names: Sequence[str], starts: Callable[[], Sequence[mi.Model]]) -> Row:
        key = self.case.name, frozenset(names)
        if key in self.journal.rows:
            return self.journal.rows[key]
        parents = self._parents(names)
        enough = parents[0]["misfit"] - STALLED if parents else np.inf
        try:
            models = starts()
        except ModelError as error:  # two that describe the same, or one that these channels cannot see
            return self.journal.add(self.case.name, {"effects": list(names), "failed": f"refused: {error}"[:120]})
        return self.journal.add(self.case.name, fitted(models, names, self.parts, enough))

    def _parents(self, names: Sequence[str]) -> list[Row]:
        """Return the rows with one effect less, best on the fitted runs first."""
        keys = [(self.case.name, frozenset(names) - {n}) for n in names]
        rows = [self.journal.rows[k] for k in keys if k in self.journal.rows]
        return sorted((r for r in rows if "failed" not in r), key=lambda r: r["misfit"])

    def _starts(self, names: Sequence[str]) -> list[mi.Model]:
        """Return the models to start from: where the parents ended, better first."""
        parents = self._parents(names)
        return [grown(self.case.model, names, p["values"]) for p in parents[:2]] or [grown(self.case.model, names)]


def summary(search: BruteForce, parts: Parts) -> Row:
    """Return the table of one case: the best of each size, and the best of them fitted to all samples."""
    case, journal = search.case, search.journal
    rows = {size: journal.of(case.name, size) for size in (1, 2, 3)}
    tried = {size: [r for (c, key), r in journal.rows.items() if c == case.name and len(key) == size] for size in rows}
    fair = min((r for size in (0, 1, 2, 3) for r in journal.of(case.name, size)), key=lambda r: r["bic"])
    kept = {size: sorted(found, key=lambda r: r["figure"])[:KEPT] for size, found in rows.items()}
    plain = journal.rows[case.name, frozenset()]
    asked = [r for r in search.given if "failed" not in r]
    finalists = {frozenset(r["effects"]): r for r in (plain, *(r for f in kept.values() for r in f), fair, *asked)}
    whole = {key: _on_all(search, r, parts) for key, r in finalists.items()}
    good = [r for r in whole.values() if "failed" not in r]
    least = min(r["figure"] for r in good)
    best = min((r for r in good if r["figure"] <= (1 + TIED) * least), key=lambda r: (len(r["effects"]), r["figure"]))
    return {
        "thin": case.thin,
        "tried": {str(size): len(t) for size, t in tried.items()},
        "failed": {str(size): sum("failed" in r and not r["failed"].startswith("refused") for r in t)
                   for size, t in tried.items()},
        "library": [n for n in LIBRARY if n not in case.model.effect_names],
        "processor_seconds": round(sum(r.get("seconds", 0) for t in tried.values() for r in t)),
        "best": best,
        "fair": whole[frozenset(fair["effects"])],
        "all_samples": sorted((_short(r) for r in whole.values()), key=lambda r: r.get("figure", np.inf)),
        "singles": [_short(r) for r in sorted(rows[1], key=lambda r: r["figure"])[:8]],
        "pairs": [_short(r) for r in sorted(rows[2], key=lambda r: r["figure"])[:8]],
        "triples": [_short(r) for r in sorted(rows[3], key=lambda r: r["figure"])[:8]],
    }


def _on_all(search: BruteForce, row: Row, parts: Parts) -> Row:
    """Return a row fitted to all samples, from where the thinned ones led."""
    if search.case.thin == 1:
        return row
    name = f"{search.case.name} whole"
    key = name, frozenset(row["effects"])
    if key not in search.journal.rows:
        model = grown(search.case.model, row["effects"], row["values"])
        search.journal.add(name, fitted([model], row["effects"], parts))
    return search.journal.rows[key]


def _short(row: Row) -> Row:
    """Return what a reader of the table wants of a row: errors in per cent."""
    if "failed" in row:
        return {"effects": row["effects"], "failed": row["failed"]}
    percent = {k: {c: float(f"{100 * e:.4g}") for c, e in row[k].items()} for k in ("nrmse", "held_out")}
    return {"effects": row["effects"], **percent, "figure": float(f"{row['figure']:.5g}"), "bic": round(row["bic"], 1)}


def text_of(table: Mapping[str, Row]) -> str:
    """Return the table as JSON with a line for each entry of a case, and for each row of its lists."""

    def entry(value: Any) -> str:
        if isinstance(value, list) and value and isinstance(value[0], dict):
            return "[\n   " + ",\n   ".join(json.dumps(row) for row in value) + "\n  ]"
        return json.dumps(value)

    cases = (f' "{name}": {{\n  ' + ",\n  ".join(f'"{k}": {entry(v)}' for k, v in row.items()) + "\n }"
             for name, row in table.items())
    return "{\n" + ",\n".join(cases) + "\n}\n"


def search_all(cases: Sequence[Case], parts: Mapping[str, Parts], journal: Path, table: Path,
               last: str | None = None, found: Sequence[Row] = ()) -> None:
    """Search every case, one width after the other up to the `last`; write the table after each.

    `found`: rows of `bench_real.py --out`, the models of whose ladders are tried too.
    """
    book = Journal.at(journal)
    searches = {c.name: BruteForce.on(c, parts[c.name], book) for c in cases}
    known = json.loads(table.read_text()) if table.exists() else {}
    order = [w.name for w in WIDTHS]
    for width in WIDTHS[:order.index(last) + 1 if last else None]:
        for name, search in searches.items():
            began = time.perf_counter()
            search.go(width)
            search.ladders(found)
            reached = max(width.name, known.get(name, {}).get("width", width.name), key=order.index)
            known[name] = {"width": reached, **summary(search, parts[name])}
            table.write_text(text_of(known))
            best = known[name]["best"]
            print(f"{name}, {width.name}: {time.perf_counter() - began:.0f} s; best "
                  f"{' + '.join(best['effects']) or 'plain'}, {100 * best['figure']:.4g} %", flush=True)
