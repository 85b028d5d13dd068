"""Results as plain data for JSON, written to a file; and remarks on a fit: what its numbers do not say."""

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from motorid.display.numbers import listed, number, quantity
from motorid.estimation.result import Fit
from motorid.estimation.shooting.outcome import violations
from motorid.problem.constraints import Relation
from motorid.problem.simulate import Evaluation
from motorid.records.files import json_text, write_files

QUICKEST = 8900 * 1.7e-8 / 2.0**2  # s, R·J/K² of copper alone (kg/m³, Ω·m) in iron that is saturated (T)
MOST_FLUX = 10.0  # of a winding over its magnets': motors have 0.02 to 2, and are demagnetised by a few
MOTOR = ("R", "L", "K", "b", "J")


def fit_dict(fit: Fit, held_out: Evaluation | None = None) -> dict[str, Any]:
    """Return the contents of ``fit --json``. Standard deviations: coloured, null if not determined, 0 if fixed."""
    model, problem, std = fit.problem.model, fit.problem, fit.std
    def known(*names: str) -> bool:
        return all(std.get(n) is not None for n in names if n in std)

    engine = problem.engine if isinstance(problem.engine, str) else problem.engine.name
    same = ("fits", "verdict", "chi2", "dof", "status", "message", "iterations", "seconds", "formulation",
            "integration_error", "per_run", "initial", "window", "steady_state_error")
    return {
        "model": {"base": model.base, "axis": model.axis, "effects": list(model.effect_names)},
        "parameters": {n: {"value": fit.values[n], "std": std[n] if p.vary else 0.0, "unit": p.unit,
                           "fixed": not p.vary} for n, p in model.parameters.items()},
        **{n: getattr(fit, n) for n in same}, "nrmse": dict(fit.nrmse), "rmse": dict(fit.rmse), "engine": engine,
        "determined": {n: {"value": d.value, "std": d.std, "unit": d.unit} for n, d in fit.determined.items()},
        **{f"validation_{n}": dict(getattr(held_out, n)) if held_out else None for n in ("nrmse", "rmse")},
        "derived": {"tau_e": fit.tau_e if known("R", "L") else None, "tau_m": fit.tau_m if known(*MOTOR) else None,
                    "damping": fit.damping if known(*MOTOR) else None},
        "violations": constraint_violations(fit),
        "multipliers": [{"constraint": m.name, "value": m.value, "unit": m.unit, "active": m.active}
                        for m in fit.extra.get("multipliers", ())],
        "runs": [run_dict(r) | {"nrmse": dict(e)}
                 for r, e in zip(problem.experiments, fit.evaluation.by_run, strict=True)],
        "remarks": remarks(fit)}


def constraint_violations(fit: Fit) -> dict[str, float]:
    """Return the largest violation of each constraint or weighted relation; empty for a plain fit."""
    problem = fit.problem
    relations = [r for r in (*problem.constraints, *problem.penalties) if isinstance(r, Relation)]
    return violations(problem, fit.q, relations) if relations else {}


def run_dict(run: Any) -> dict[str, Any]:
    """Return what identifies a record."""
    return {"name": run.name, "source": run.meta.get("source"), "sha256": run.meta.get("sha256"),
            "samples": run.n, "seconds": run.duration, "channels": list(run.channels)}


def remarks(fit: Fit) -> list[str]:
    """Say in words what the numbers of a fit cannot: what is not determined, and what would determine it."""
    model, measured, std = fit.problem.model, fit.problem.outputs, fit.std
    undetermined = {n: model.parameters[n] for n in model.free_names if std[n] is None}
    vague = [n for n, p in undetermined.items() if p.lower < fit.values[n] < p.upper]
    at_limit = [f"{n} ended at its limit, {quantity(fit.values[n], p.unit)}: these records show no sign of it, or ask "
                "for what lies beyond." for n, p in undetermined.items() if n not in vague]
    said = []
    motor = [n for n in vague if n in MOTOR]
    if model.base == "dc_motor" and motor and ("i" not in measured or not {"omega", "theta"} & set(measured)):
        said.append(f"The current was not measured, so {listed(motor)} are not determined one by one, only their "
                    "combinations. Measure the current, or fix R and K where they are known (--fix R=1.2,K=0.05)."
                    if "i" not in measured else
                    f"Neither speed nor angle was measured, so {listed(motor)} are not determined one by one. "
                    "Measure one of them, or fix K (--fix K=0.05).")
        vague = [n for n in vague if n not in MOTOR and "N" not in undetermined[n].unit]  # torques go with them
    if vague:
        said.append(f"The records do not determine {listed(vague)}: another value fits them as well. Fix "
                    f"{'it' if len(vague) == 1 else 'one of them'} (--fix {vague[0]}=…), or look at "
                    "`motorid identifiability`.")
    return [*said, *_of_no_motor(fit), *at_limit]


def _of_no_motor(fit: Fit) -> list[str]:
    """Say what no winding can be, whatever its size, turns or gear: a sign of a wrong unit. Copper of density D and
    resistivity ρ in a field B has J ≥ D·V·r² and K²/R ≤ B²·V·r²/ρ, so R·J/K² is at least D·ρ/B². The flux of the
    winding, L·v/R, over that of the magnets, K, is the angle turned without load in L/R."""
    model, std, p = fit.problem.model, fit.std, fit.values
    if model.base != "dc_motor" or any(std[n] is None for n in ("R", "K")):
        return []
    said, most = [], max(float(np.abs(run.inputs["v"]).max()) for run in fit.problem.experiments)
    if std["J"] is not None and p["R"] * p["J"] / p["K"] ** 2 < QUICKEST:
        said.append(f"R·J/K² is {quantity(p['R'] * p['J'] / p['K'] ** 2, 's', 2)}: not even bare copper in a field of "
                    "2 T starts so quickly. Look at the unit of the time.")
    if std["L"] is not None and (flux := p["L"] * most / (p["R"] * p["K"])) > MOST_FLUX:
        said.append(f"At {number(most, 3)} V the winding would have {number(flux, 2)} times the flux of the magnets "
                    "(L·v/R over K): no magnet stands that. Look at the units of time and speed.")
    return said


def write_json(contents: Mapping[str, Any], path: str | Path, force: bool = False) -> None:
    """Write a dictionary as JSON; ``-`` is standard output. For errors see `write_files`."""
    text = json_text(contents)
    if str(path) != "-":
        write_files({Path(path): text}, force)
    elif "utf" in (sys.stdout.encoding or "").lower():
        print(text, end="")
    else:
        print(json.dumps(json.loads(text), indent=1))
