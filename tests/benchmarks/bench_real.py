"""What a diagnosis says of the real records, what it costs, and how far it is from the best that can be reached.

    python tests/benchmarks/bench_real.py [--records a,b] [--out FILE]
    python tests/benchmarks/bench_real.py --brute [--records a,b] [--journal FILE]

Per case (`real_cases.CASES`): what was named, the errors along the ladder on fitted and held-out runs, processor
time, and the *regret*: the held-out error where the ladder ends over the least that brute force reaches over single
effects, pairs and triples of the library, both judged by ``mi.evaluate`` on the held-out runs as they were recorded
(where the diagnosis reads a record otherwise, say late, its own figure stands in). The error of several channels is
the geometric mean of their NRMSE. The best by held-out data is a bound that no choice without these data can reach
every time; *fair* is the regret of the model that BIC takes from all that brute force tried.

``--brute`` makes the table of brute force, `real_best.json`, anew for these records (see `brute_force`); with a
journal it can be interrupted and taken up again.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from brute_force import WIDTHS, OutOfTime, figure, grown, judged, processor_time, search_all, within
from real_cases import CASES, Case, Parts, real_folder

import motorid as mi
from motorid.effects import LIBRARY
from motorid.errors import MotoridError

TABLE = Path(__file__).with_name("real_best.json")
LIMIT = 600.0  # processor time after which a diagnosis is given up, s
DIFFERS = 0.02  # relative difference between two figures of one held-out error that is said
Row = dict[str, Any]


def diagnosed(case: Case, parts: Parts) -> Row:
    """Return what a diagnosis of a case finds and costs; a failure is a row that says so."""
    fitted, held = parts
    row: Row = {"case": case.name, "about": case.about, "samples": [sum(r.n for r in runs) for runs in parts]}
    first: list[float] = []
    began, wall = processor_time(), time.perf_counter()

    def said(word: str) -> None:
        if not first and word.startswith("first answer"):
            first.append(processor_time() - began)

    try:
        found = within(LIMIT, lambda: mi.diagnose(mi.fit(case.model, fitted), held, progress=said))
    except OutOfTime:
        return {**row, "failed": f"given up after {LIMIT:.0f} s of processor time"}
    except (MotoridError, ValueError, ArithmeticError, RuntimeError, np.linalg.LinAlgError) as error:
        return {**row, "failed": f"{type(error).__name__}: {error}", "processor_s": processor_time() - began}
    row |= {"processor_s": processor_time() - began, "wall_s": time.perf_counter() - wall,
            "first_answer_s": first[0] if first else None}
    row |= {"verdict": found.verdict, "effects": list(found.effects), "groups": [list(g) for g in found.groups]}
    row["text"] = found.text
    row["ladder"] = [
        {"added": r.added, "removed": list(r.removed), "nrmse": dict(r.nrmse),
         "held_out": dict(r.validation_nrmse or {})}
        for r in found.ladder.rungs
    ]
    row["as_recorded"] = recorded(found.after, held)
    return row


def recorded(fit: mi.Fit, held: Sequence[mi.Experiment]) -> Row | None:
    """Return the held-out errors of a fit on the runs as they are, None where they cannot be simulated."""
    try:
        return dict(mi.evaluate(fit, held).nrmse)
    except MotoridError:
        return None


def end_error(row: Row) -> tuple[float, bool]:
    """Return the held-out error where the ladder ends, and whether the diagnosis reads the records otherwise."""
    own, plainly = row["ladder"][-1]["held_out"], row["as_recorded"]
    if not plainly or not own:
        return figure(own or plainly), True
    other = abs(figure(own) / figure(plainly) - 1) > DIFFERS
    return figure(own if other else plainly), other


def with_regret(row: Row, case: Case, parts: Parts, table: Mapping[str, Row]) -> Row:
    """Return the row with its regret, the brute-force models judged anew by today's ``mi.evaluate``."""
    if "failed" in row or case.name not in table:
        return row
    entry = table[case.name]
    best, fair = (reached(case, entry[kind], parts[1]) for kind in ("best", "fair"))
    error, other = end_error(row)
    return {
        **row,
        "end": error,
        "read_otherwise": other,
        "best": {"effects": entry["best"]["effects"], "error": best, "width": entry["width"]},
        "regret": error / best,
        "fair": {"effects": entry["fair"]["effects"], "regret": fair / best},
        "not_in_table": sorted(set(LIBRARY) - set(entry["library"]) - set(case.model.effect_names)),
    }


def reached(case: Case, entry: Row, held: Sequence[mi.Experiment]) -> float:
    """Return the held-out error of a stored model, as today's package judges it, else as it was stored."""
    try:
        return figure(judged(grown(case.model, entry["effects"]), entry["values"], held))
    except MotoridError:
        return entry["figure"]


def percent(errors: Mapping[str, float]) -> str:
    """Return the pooled error (quadratic mean) and that of each channel in per cent."""
    pooled = np.sqrt(np.mean(np.square(list(errors.values()))))
    each = ", ".join(f"{c} {100 * e:.3g}" for c, e in errors.items())
    return f"{100 * pooled:.3g} %" + (f" ({each})" if len(errors) > 1 else "")


def lines(row: Row) -> list[str]:
    """Return what is printed of one case."""
    title = f"{row['case']}: {row['about']}; {row['samples'][0]} samples fitted, {row['samples'][1]} held out"
    if "failed" in row:
        return [title, f"  failed: {row['failed']}"]
    named = " + ".join(row["effects"]) or "nothing"
    groups = "; ".join("one of " + ", ".join(g) for g in row["groups"])
    first = row["first_answer_s"]
    found = [title, f"  {row['verdict']}: {named}" + (f" ({groups})" if groups else "")]
    for rung in row["ladder"]:
        added = "plain" if rung["added"] is None else f"+ {rung['added']}" + "".join(f" − {n}" for n in rung["removed"])
        found.append(f"    {added:<32} fitted {percent(rung['nrmse'])}, held out {percent(rung['held_out'])}")
    found.append(f"  processor time {row['processor_s']:.1f} s, first answer "
                 + (f"{first:.1f} s" if first is not None else "none"))
    if "regret" in row:
        best, fair = row["best"], row["fair"]
        what = " + ".join(best["effects"]) or "plain"
        otherwise = " (read otherwise than recorded)" if row["read_otherwise"] else ""
        found.append(f"  regret {row['regret']:.3f}{otherwise}"
                     f"; best of brute force {100 * best['error']:.4g} %: {what}"
                     + ("" if best["width"] == "full" else f" (search so far: {best['width']})")
                     + f"; fair {fair['regret']:.3f}: {' + '.join(fair['effects']) or 'plain'}")
        if row["not_in_table"]:
            found.append(f"  brute force has not tried {', '.join(row['not_in_table'])}")
    return found


def totals(rows: Sequence[Row]) -> list[str]:
    """Return the summary: regret, time, and cases that failed."""
    regrets = [r["regret"] for r in rows if "regret" in r]
    times = [r["processor_s"] for r in rows if "processor_s" in r]
    found = [f"{len(rows)} cases, {sum('failed' in r for r in rows)} failed"]
    if regrets:
        found.append(f"regret: median {np.median(regrets):.3f}, largest {max(regrets):.3f}, "
                     f"{sum(r <= 1.1 for r in regrets)} of {len(regrets)} at most 1.10")
    if times:
        found.append(f"processor time: median {np.median(times):.1f} s, largest {max(times):.1f} s")
    return found


def chosen(names: str | None) -> list[Case]:
    """Return the cases by their names, all by default."""
    wanted = names.split(",") if names else list(CASES)
    unknown = [n for n in wanted if n not in CASES]
    if unknown:
        raise SystemExit(f"no case called {', '.join(unknown)}; there are {', '.join(CASES)}")
    return [CASES[n] for n in wanted]


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--records", help="names of cases, joined by commas; all by default")
    options.add_argument("--out", type=Path, help="JSON file for the rows, written after each case")
    options.add_argument("--brute", action="store_true", help="make the table of brute force")
    options.add_argument("--table", type=Path, default=TABLE, help="table of brute force")
    options.add_argument("--journal", type=Path, default=Path("real_brute.jsonl"), help="fits of brute force so far")
    options.add_argument("--width", choices=[w.name for w in WIDTHS],
                         help="how far brute force goes (default: to the end)")
    options.add_argument("--found", type=Path, help="an --out file: brute force tries the models of its ladders, too")
    given = options.parse_args()
    folder = real_folder()
    if folder is None:
        raise SystemExit("the real records are not on this machine: set MOTORID_REAL_DATA to their folder")
    cases = chosen(given.records)
    parts = {case.name: case.parts(folder) for case in cases}
    if given.brute:
        found = json.loads(given.found.read_text()) if given.found else ()
        return search_all(cases, parts, given.journal, given.table, given.width, found)
    table = json.loads(given.table.read_text()) if given.table.exists() else {}
    rows = []
    for case in cases:
        rows.append(with_regret(diagnosed(case, parts[case.name]), case, parts[case.name], table))
        print("\n".join(lines(rows[-1])), flush=True)
        if given.out:
            given.out.write_text(json.dumps(rows, indent=1) + "\n")
    print("\n".join(totals(rows)))
    return None


if __name__ == "__main__":
    main()
