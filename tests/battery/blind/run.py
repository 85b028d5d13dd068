"""Run a blind battery: ``python tests/battery/blind/run.py second --out DIR [--cases a,b] [--until 14:30]``.

Each case runs in a process of its own and leaves a JSON in DIR; the summary is printed and written to DIR/summary.txt.
`--shuffle SEED` runs in a random order, so that a part is a fair one; `--until` (UTC) starts no case later than that;
`--resume` leaves what has its JSON; `--summary` only sums up. Nothing here may be tuned to a result: the cases say what
is right, and were written down before.
"""

from __future__ import annotations

import argparse
import importlib
import json
import math
import os
import resource
import subprocess
import sys
import time
import traceback
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from battery.blind.build import Case, build
from battery.blind.judge import summary


def main() -> None:
    words = _words()
    battery = importlib.import_module(f"battery.blind.{words.battery}").B
    out = Path(words.out)
    if words.one:
        _write(out / f"{words.one}.json", trial(battery[words.one]))
        return
    out.mkdir(parents=True, exist_ok=True)
    names = [n for n in battery if not words.cases or any(w in n for w in words.cases.split(","))]
    if words.shuffle is not None:
        names = [names[k] for k in np.random.default_rng(words.shuffle).permutation(len(names))]
    if not words.summary:
        _write(out / "order.txt", names)
        for k, name in enumerate(names):
            if words.resume and (out / f"{name}.json").exists():
                continue
            if words.until and datetime.now(UTC).strftime("%H:%M") >= words.until:
                print(f"stopped at {words.until} after {k} of {len(names)} cases", flush=True)
                break
            print(f"{k + 1}/{len(names)} {name} {_one(battery[name], words, out):.0f} s", flush=True)
    results = [json.loads(f.read_text()) for n in names if (f := out / f"{n}.json").exists()]
    text = f"{len(results)} of {len(names)} cases ran\n" + summary(results)
    (out / "summary.txt").write_text(text + "\n")
    print(text)


def _words() -> argparse.Namespace:
    ap = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    ap.add_argument("battery", choices=("first", "second", "third", "fourth"))
    ap.add_argument("--out", required=True)
    ap.add_argument("--cases", default="", help="parts of names")
    ap.add_argument("--shuffle", type=int)
    ap.add_argument("--until", default="", help="HH:MM, UTC")
    ap.add_argument("--timeout", type=float, default=600, help="s of wall time per case")
    ap.add_argument("--resume", action="store_true")
    ap.add_argument("--summary", action="store_true")
    ap.add_argument("--one", help=argparse.SUPPRESS)
    return ap.parse_args()


def _one(case: Case, words: argparse.Namespace, out: Path) -> float:
    """Run one case in a process of its own; what dies or takes too long is a result too. Return the wall time."""
    file, start = out / f"{case.name}.json", time.time()
    file.unlink(missing_ok=True)
    command = [sys.executable, str(Path(__file__).resolve()), words.battery, "--out", str(out), "--one", case.name]
    with (out / f"{case.name}.log").open("w") as log:
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, start_new_session=True)
        try:
            code = process.wait(words.timeout)
            error = f"the process ended with {code}"
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, 9)
            process.wait()
            error = f"no end within {words.timeout:g} s"
    if not file.exists():
        _write(file, {"name": case.name, "kind": case.kind, "truth": case.truth, "error": error})
    return time.time() - start


def trial(case: Case) -> dict[str, Any]:
    """Fit, diagnose and evaluate one case; an exception is a result."""
    import motorid as mi

    built = build(case)
    d = {"name": case.name, "kind": case.kind, "truth": case.truth, "acceptable": case.acceptable,
         "alternatives": case.alternatives, "whole": case.whole, "floor": built["floor"]}

    def records(which: str) -> list[mi.Experiment]:
        wanted = ("t", "inputs", "outputs", "hold", "units", "name")
        return [mi.Experiment(**{k: r[k] for k in wanted}) for r in built[which]]

    def held_out(fit: mi.Fit) -> dict[str, float]:
        return dict(mi.evaluate(fit, check).nrmse)

    runs, check = records("train"), records("check")
    model = mi.torque_driven() if built["motor"]["torque"] else mi.dc_motor()
    if case.fixed:
        model = model.fix(**{p: built["motor"][p] for p in case.fixed})
    start = _cpu()
    try:
        fit = mi.fit(model, runs)
        d["cpu_fit"] = _cpu() - start
        found = mi.diagnose(fit, validate=check)
        d["cpu"] = _cpu() - start
        told = found.to_dict()
        rungs = [r for r in told["ladder"] if r["added"]]
        d["grades"] = {n: r["grade"] for r in rungs for n in _names(r["added"])}
        d["order"] = list(d["grades"])
        d["groups"] = [_names(g) for g in told["groups"]]
        d["held_before"], d["held_after"] = held_out(fit), held_out(found.after or fit)
        d |= {"verdict": told["verdict"], "effects": _names(told["effects"]), "told": told, "text": found.text}
        d["remainder"] = getattr(found.remainder, "kind", None)
        if d["remainder"] not in (None, "noise"):
            try:
                curve = found.remainder.as_effect()
            except mi.UsageError as e:
                d["no_curve"] = str(e)
            else:
                d["held_remainder"] = held_out(mi.fit(found.remainder.model + curve, runs))
        d["cpu_all"] = _cpu() - start
    except Exception as e:  # a result like any other
        d |= {"error": f"{type(e).__name__}: {e}", "trace": traceback.format_exc(), "cpu": d.get("cpu", _cpu() - start)}
    return d


def _names(x: Any) -> list[str]:
    """Return the effects' names in whatever the JSON holds: a name, several joined, a list of them."""
    if isinstance(x, str):
        return x.replace(" ", "").split("+")
    return [n for y in x for n in _names(y)]


def _cpu() -> float:
    use = (resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN))
    return sum(u.ru_utime + u.ru_stime for u in use)


def _write(file: Path, value: Any) -> None:
    part = file.with_suffix(".part")
    part.write_text(json.dumps(_plain(value), indent=1))
    part.replace(file)


def _plain(x: Any) -> Any:
    """Return `x` as JSON has it: lists, dicts, finite numbers."""
    if hasattr(x, "items"):
        return {str(k): _plain(v) for k, v in x.items()}
    if isinstance(x, (list, tuple, set, frozenset)):
        return [_plain(v) for v in (sorted(x) if isinstance(x, (set, frozenset)) else x)]
    if hasattr(x, "tolist"):
        return _plain(x.tolist())
    if isinstance(x, float):
        return x if math.isfinite(x) else None
    return x if isinstance(x, (int, str, bool)) or x is None else str(x)


if __name__ == "__main__":
    main()
