"""What came of a case: one row of the table, and the figures over all rows."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import motorid as mi
from battery.cases import Case
from battery.excite import count_of
from motorid.diagnosis.results import Diagnosis

Row = dict[str, Any]
TARGETS = {"first": 0.95, "pairs": 0.85, "false_alarms": 0.05, "forced": 0.0, "held_out": 1.10}


def run_case(case: Case) -> Row:
    """Fit, diagnose with the held-out run, and compare with what the true model reaches."""
    runs, check = case.records()
    began, cpu = time.perf_counter(), time.process_time()
    fit = mi.fit(case.base(), runs)
    fitted = time.perf_counter()
    found = mi.diagnose(fit, validate=check)
    ended, cpu = time.perf_counter(), time.process_time() - cpu
    plain = mi.evaluate(fit, check).nrmse
    return _row(case, found) | {
        "seconds": round(ended - began, 2),
        "cpu": round(cpu, 2),
        "fit_seconds": round(fitted - began, 3),
        **_held_out(case, runs, check, found, plain),
        "ranking": _ranking(found),
        "sizes": _sizes(case, found),
        "text": found.text,
    }


def _row(case: Case, found: Diagnosis) -> Row:
    truth, effects = set(case.effects), tuple(e for e in found.effects if e not in case.sensor_effects)
    group = sorted({n for g in found.groups for n in g})
    first = effects[0] if effects else None
    hits = truth | set(case.twins)
    return {
        "case": case.name,
        "kind": case.kind,
        "motor": case.motor,
        "truth": "+".join(case.effects),
        "verdict": found.verdict,
        "found": "+".join(found.effects),
        "forced": bool(effects),
        "group": "/".join(group),
        "first_right": bool(first in truth or (first and truth & set(group)) or (case.twins and first in hits)),
        "group_said": bool(len(group) > 1),
        "set_right": bool(set(effects) == truth or (truth <= set(effects) | set(group) and len(effects) == len(truth))),
        "alarm": (found.verdict == "missing" and bool(effects)) or found.verdict == "unexplained",
        "remaining": found.remaining.text,
    }


def _held_out(case: Case, runs, check, found: Diagnosis, plain: Mapping[str, float]) -> Row:
    reached = mi.evaluate(found.after, check).nrmse
    model = case.true_model()
    row: Row = {
        "plain": _words(plain),
        "reached": _words(reached),
        "true": "",
        "ratio": None,
        "worst": None,
        "visible": None,
    }
    if model is None:
        return row
    best = mi.evaluate(mi.fit(model, runs), check).nrmse
    gain = {c: plain[c] / best[c] for c in best}
    ratios = {c: reached[c] / best[c] for c in best}
    return row | {"true": _words(best), "ratio": _mean(ratios), "worst": max(ratios.values()), "visible": _mean(gain)}


def _mean(ratios: Mapping[str, float]) -> float:
    return float(np.exp(np.mean(np.log(list(ratios.values())))))


def _words(nrmse: Mapping[str, float]) -> str:
    return " ".join(f"{c} {100 * e:.3g}" for c, e in nrmse.items())


def _sizes(case: Case, found: Diagnosis) -> dict[str, tuple[float, float | None, float]]:
    """Value, standard deviation and truth of each free parameter of a true effect that was found."""
    truth, fit = case.true_model(), found.after
    if truth is None:
        return {}
    names = [p.name for e in truth.effects if e.name in found.effects for p in e.parameters if p.vary]
    true = dict(truth.values)
    if "R_s" in names:  # only R_s/V_s² acts: at the supply that the fit took
        true["R_s"] *= (fit.values["V_s"] / true["V_s"]) ** 2
    half = 0.5 * count_of(case.chain)  # an encoder counts down to whole counts: what it calls 0 is half a count further
    for e in truth.effects if "theta" in case.channels else ():
        order = next((true[p.name] for p in e.parameters if p.order or p.name == "N_f"), 1.0)
        true |= {p.name: true[p.name] + order * half for p in e.parameters if p.periodic}
        true |= {p.name: true[p.name] - half for p in e.parameters if p.name == "theta_0"}
    return {n: (fit.values[n], fit.std.get(n), true[n]) for n in names if n in fit.values}


def _ranking(found: Diagnosis) -> list[Row]:
    return [
        {
            "effect": c.effect,
            "predicted": c.predicted_drop,
            "refitted": c.refit_drop,
            "reason": c.reason,
            "parameters": dict(c.parameters),
        }
        for c in found.ranking
    ]


def figures(rows: Sequence[Row]) -> dict[str, str]:
    """The summary against the targets, in words."""
    done = [r for r in rows if "error" not in r]
    of = {k: [r for r in done if r["kind"] == k] for k in ("single", "pair", "none", "outside", "twins")}
    known = of["single"] + of["pair"] + of["twins"]
    judged = [r for r in known + of["none"] if r["ratio"] is not None]
    said = {
        "cases": f"{len(done)} of {len(rows)} ran",
        "first effect right": _share([r["first_right"] for r in known]) + " (at least 95 %)",
        "whole set right, pairs": _share([r["set_right"] for r in of["pair"]]) + " (at least 85 %)",
        "whole set right, singles": _share([r["set_right"] for r in of["single"]]),
        "false alarms": _share([r["alarm"] for r in of["none"]]) + " (at most 5 %)",
        "forced on outside cases": _share([r["forced"] for r in of["outside"]]) + " (none)",
        "group said on twins": _share([r["group_said"] for r in of["twins"]]),
        "held-out within 10 %": _share([r["ratio"] <= TARGETS["held_out"] for r in judged]),
    }
    sizes = [s for r in done for s in r.get("sizes", {}).values() if s[1]]
    said["sizes within 3 deviations"] = _share([abs(v - t) <= 3 * sd for v, sd, t in sizes])
    if judged:
        said["held-out over the true model's"] = (
            f"median {np.median([r['ratio'] for r in judged]):.3f}, worst {max(r['ratio'] for r in judged):.3f}"
        )
        said["CPU seconds per diagnosis"] = f"median {np.median([r['cpu'] for r in done]):.1f}"
    return said


def _share(flags: Sequence[bool]) -> str:
    return f"{sum(flags)}/{len(flags)} = {100 * sum(flags) / len(flags):.0f} %" if flags else "none run"


def scatter(rows: Sequence[Row]) -> list[tuple[str, str, float, float]]:
    """(case, effect, predicted, refitted drop) of every effect that was refitted."""
    return [
        (r["case"], c["effect"], c["predicted"], c["refitted"])
        for r in rows
        if "error" not in r
        for c in r["ranking"]
        if c["refitted"] is not None
    ]
