"""Run the battery: ``python tests/battery/run.py --out DIR [--cases a,b] [--jobs 2] [--again] [--scatter]``.

Every case runs in a process of its own, with a time limit; its result is a JSON file in DIR, so that an
interrupted battery goes on where it stopped. The table is DIR/battery.csv; the summary is printed.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
import traceback
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

HERE = Path(__file__).resolve()
sys.path[:0] = [str(HERE.parents[1])]

COLUMNS = (
    "case",
    "kind",
    "motor",
    "truth",
    "verdict",
    "found",
    "group",
    "first_right",
    "set_right",
    "alarm",
    "plain",
    "reached",
    "true",
    "ratio",
    "worst",
    "visible",
    "seconds",
    "cpu",
    "fit_seconds",
    "error",
)


def main() -> int:
    """Run what is asked for; 0 if every case ran."""
    words = _parser().parse_args()
    from battery.cases import CASES

    if words.wide:
        from battery.wide import WIDE as CASES
    names = (
        words.cases.split(",")
        if words.cases
        else [n for n, c in CASES.items() if not words.kind or c.kind == words.kind]
    )
    unknown = [n for n in names if n not in CASES]
    if unknown:
        raise SystemExit(f"unknown cases {', '.join(unknown)}; there are {', '.join(CASES)}")
    if words.one:
        return _one(CASES[names[0]], words.out)
    words.out.mkdir(parents=True, exist_ok=True)
    todo = [n for n in names if words.again or not (words.out / f"{n}.json").exists()]
    with ThreadPoolExecutor(words.jobs) as pool:
        for done in as_completed([pool.submit(_apart, n, words) for n in todo]):
            print(_line(done.result()), flush=True)
    rows = [json.loads((words.out / f"{n}.json").read_text()) for n in names if (words.out / f"{n}.json").exists()]
    _report(rows, words)
    return int(any("error" in r for r in rows))


def _parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("--out", type=Path, required=True, help="folder of the results")
    p.add_argument("--cases", help="names, separated by commas (default: all)")
    p.add_argument("--kind", choices=("single", "pair", "none", "outside", "twins"))
    p.add_argument("--wide", action="store_true", help="every effect of benches in three motors under three drives")
    p.add_argument("--jobs", type=int, default=1)
    p.add_argument("--limit", type=float, default=400, help="seconds per case")
    p.add_argument("--again", action="store_true", help="run cases again that have a result")
    p.add_argument("--scatter", action="store_true", help="predicted against refitted drop, CSV and PNG")
    p.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    return p


def _one(case, out: Path) -> int:
    from battery.score import run_case

    try:
        row = run_case(case)
    except Exception as error:  # a case that fails is a row, not the end of the battery
        row = {
            "case": case.name,
            "kind": case.kind,
            "truth": "+".join(case.effects),
            "error": f"{type(error).__name__}: {error}",
            "traceback": traceback.format_exc(),
        }
    (out / f"{case.name}.json").write_text(json.dumps(row, indent=1))
    return 0


def _apart(name: str, words: argparse.Namespace) -> dict:
    out, limit = words.out, words.limit
    path = out / f"{name}.json"
    path.unlink(missing_ok=True)
    command = [sys.executable, str(HERE), "--one", "--cases", name, "--out", str(out)] + ["--wide"] * words.wide
    error = "ended without a result"
    try:
        subprocess.run(command, timeout=limit, check=False)
    except subprocess.TimeoutExpired:
        error = f"took more than {limit:g} s"
    if path.exists():
        return json.loads(path.read_text())
    row = {"case": name, "kind": "", "truth": "", "error": error}
    path.write_text(json.dumps(row))
    return row


def _line(r: dict) -> str:
    if "error" in r:
        return f"ERROR {r['case']}: {r['error']}"
    good = {
        "single": r["first_right"] and r["set_right"],
        "pair": r["set_right"],
        "none": not r["alarm"],
        "outside": not r["forced"],
        "twins": r["first_right"] and r["group_said"],
    }[r["kind"]]
    ratio = "" if r["ratio"] is None else f" held-out ×{r['ratio']:.3f} of the true model's (plain ×{r['visible']:.2f})"
    return (
        f"{'ok   ' if good else 'WRONG'} {r['case']}: {r['verdict']} {r['found'] or '-'} [{r['group']}]{ratio}, "
        f"{r['cpu']:.1f} s CPU"
    )


def _report(rows: list[dict], words: argparse.Namespace) -> None:
    from battery.score import figures, scatter

    with open(words.out / "battery.csv", "w", newline="") as file:
        table = csv.DictWriter(file, COLUMNS, extrasaction="ignore")
        table.writeheader()
        table.writerows(rows)
    for name, value in figures(rows).items():
        print(f"{name:32s} {value}")
    if words.scatter:
        _scatter(scatter(rows), words.out)


def _scatter(points: list, out: Path) -> None:
    with open(out / "scatter.csv", "w", newline="") as file:
        csv.writer(file).writerows([("case", "effect", "predicted", "refitted"), *points])
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 5), layout="constrained")
    ax = figure.add_subplot()
    ax.plot([0, 1], [0, 1], lw=0.8, color="0.6")
    ax.plot([p[2] for p in points], [max(p[3], -0.1) for p in points], "o", ms=4, alpha=0.6)
    ax.set(
        xlabel="predicted drop of chi²", ylabel="drop of chi² after the refit", xlim=(-0.02, 1.02), ylim=(-0.12, 1.02)
    )
    figure.savefig(out / "scatter.png", dpi=120)


if __name__ == "__main__":
    sys.exit(main())
