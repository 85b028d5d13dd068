"""A fitted model as plain CasADi functions, and what travels with it: values, uncertainty, data, versions."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from motorid.channels import CHANNELS
from motorid.errors import UsageError
from motorid.estimation.result import Fit
from motorid.exporters.json_file import fit_dict
from motorid.integrate.engine import Grid
from motorid.integrate.rodas3 import step_functions
from motorid.model.equations import System
from motorid.model.model import Model
from motorid.numerics.signals import Array
from motorid.problem.problem import Problem
from motorid.problem.runs import Run
from motorid.records.experiment import Experiment

FORMAT = 1
MOST_RUNS = 20  # of a fit, that travel along as whole simulations


def model_of(found: Fit | Model) -> Model:
    """Return the model at its values.

    Raises
    ------
    UsageError
        If `found` is neither a fit nor a model.
    """
    if isinstance(found, Fit):
        return found.model
    if isinstance(found, Model):
        return found
    raise UsageError(f"a fit or a model can be exported, not {type(found).__name__}: mi.export(fit, path).")


def system_of(found: Fit | Model) -> System:
    """Return the model's functions for the channels of the fit; of a model, for all that it can show."""
    if isinstance(found, Fit):
        return found.problem.system
    return found.system(CHANNELS if found.base == "dc_motor" else ("omega", "theta"))


def values_of(found: Fit | Model, system: System) -> Array:
    """Return p (np,) in the order of the system."""
    values = model_of(found).values
    return np.array([values[n] for n in system.parameters])


def description(found: Fit | Model) -> dict[str, Any]:
    """Return all that is known of the model as plain data: the contents of ``fit --json``, and what it takes to
    build it again: limits, covariance, fingerprints of the records, versions."""
    from importlib.metadata import version

    model = model_of(found)
    contents: dict[str, Any] = fit_dict(found) if isinstance(found, Fit) else _model_dict(model)
    for name, p in model.parameters.items():
        limits = {"lower": p.lower, "upper": p.upper}
        contents["parameters"][name] |= {k: v for k, v in limits.items() if np.isfinite(v)}
    contents["model"]["angle_input"] = model.angle_input
    contents["model"]["own_effects"] = _own(model)
    if isinstance(found, Fit):
        contents["covariance"] = {"unknowns": [p.name for p in found.problem.unknown],
                                  "matrix": found.covariance.tolist()}
    contents["data"] = [fingerprint(r) for r in found.problem.experiments] if isinstance(found, Fit) else []
    contents["versions"] = {"motorid": version("motorid"), "casadi": ca.__version__, "numpy": np.__version__,
                            "python": platform.python_version()}
    contents["export"] = FORMAT
    return contents


def _model_dict(model: Model) -> dict[str, Any]:
    return {"model": {"base": model.base, "axis": model.axis, "effects": list(model.effect_names)},
            "parameters": {n: {"value": p.value, "std": None, "unit": p.unit, "fixed": not p.vary}
                           for n, p in model.parameters.items()}}


def _own(model: Model) -> dict[str, Any]:
    """Describe effects that are not in the library: where they were defined and what they take."""
    from motorid.effects import LIBRARY

    own = [e for e in model.effects if e.name not in LIBRARY or LIBRARY[e.name].law is not e.law]
    return {e.name: {"balance": e.balance, "parameters": [p.name for p in e.parameters],
                     "defined_in": getattr(e.law, "__module__", None), "doc": e.doc} for e in own}


def fingerprint(run: Experiment) -> dict[str, Any]:
    """Return what identifies a record: name, samples, channels, SHA-256 of its numbers."""
    mark = hashlib.sha256(run.t.tobytes())
    for channels in (run.inputs, run.outputs):
        for name in sorted(channels):
            mark.update(name.encode())
            mark.update(np.ascontiguousarray(channels[name]).tobytes())
    return {"name": run.name, "samples": run.n, "channels": list(run.channels), "sha256": mark.hexdigest()}


def functions_of(found: Fit | Model) -> list[ca.Function]:
    """Return the model as CasADi functions that need nothing but CasADi.

    ``rhs(x, u, p)``, ``outputs(x, u, p)``, ``initial(s, p)`` with s = (i, omega, theta) at the start,
    ``step(x, u0, u1, h, p)`` (the input runs from u0 to u1 over h), ``parameters()``; of a fit also, per record,
    ``record_k()`` (t, s, u) and ``simulate_k(s, u, p)`` with the very steps of the fit. Columns are samples.
    """
    system = system_of(found)
    p = values_of(found, system)
    light = step_functions(system).light
    args = light.sx_in()
    step = ca.Function("step", args, light.call(args), light.name_in(), light.name_out())
    functions = [_named(system.rhs, "rhs"), _named(system.out, "outputs"), _named(system.initial, "initial"), step,
                 ca.Function("parameters", [], [ca.DM(p)], [], ["p"])]
    if isinstance(found, Fit):
        for k, (run, start) in enumerate(runs_of(found)[:MOST_RUNS]):
            functions.append(ca.Function(f"record_{k}", [], [ca.DM(run.grid.t).T, ca.DM(start), ca.DM(run.grid.u.T)],
                                         [], ["t", "s", "u"]))
            functions.append(simulation(f"simulate_{k}", system, step, run))
    return functions


def _named(f: ca.Function, name: str) -> ca.Function:
    args = f.sx_in()
    return ca.Function(name, args, f.call(args), f.name_in(), f.name_out())


def runs_of(fit: Fit) -> list[tuple[Run, Array]]:
    """Return the records with the steps of the fit, and (i, omega, theta) at their start, (3,)."""
    problem: Problem = fit.problem
    if getattr(problem.integrator, "name", "") != "rosenbrock":
        # Another engine chose its own steps: take those that suit ours.
        problem = replace(problem, engine="rosenbrock").refined(fit.q)
    found = []
    for k, run in enumerate(problem.runs):
        start = run.start.copy()
        for c in CHANNELS:
            start[CHANNELS.index(c)] = fit.initial.get(f"{c}_0[{k}]", start[CHANNELS.index(c)])
        found.append((run, start))
    return found


def simulation(name: str, system: System, step: ca.Function, run: Run) -> ca.Function:
    """Return ``(s, u, p) -> (y, x)`` on the samples and sub-steps of `run`: s (3,), u (nu, N), y (ny, N)."""
    _, nu, np_, _ = system.sizes
    grid: Grid = run.grid
    m = grid.substeps
    interval = np.repeat(np.arange(len(m)), m)
    first = np.concatenate([[0], np.cumsum(m)])
    part = np.arange(len(interval)) - first[:-1][interval]
    share = 1.0 / m[interval]
    held = zoh_inputs(system.inputs, run.experiment)
    s, u, p = ca.MX.sym("s", 3), ca.MX.sym("u", nu, len(grid.t)), ca.MX.sym("p", np_)
    before = u[:, interval.tolist()]
    after = ca.vertcat(*[u[j, (interval if hold else interval + 1).tolist()] for j, hold in enumerate(held)])
    slope = after - before
    u0 = before + slope * ca.repmat(ca.DM(part * share).T, nu, 1)
    u1 = u0 + slope * ca.repmat(ca.DM(share).T, nu, 1)
    h = ca.DM(grid.dt[interval] * share).T
    x0 = system.initial(s, p)
    walked = step.mapaccum("walk", len(interval), 1)(x0, u0, u1, h, ca.repmat(p, 1, len(interval)))[0]
    x = ca.horzcat(x0, walked[:, (first[1:] - 1).tolist()])
    y = system.out.map(len(grid.t))(x, u, ca.repmat(p, 1, len(grid.t)))
    return ca.Function(name, [s, u, p], [y, x], ["s", "u", "p"], ["y", "x"])


def zoh_inputs(inputs: Sequence[str], run: Experiment) -> list[bool]:
    """Tell which inputs stay constant between samples."""
    return [run.hold == "zoh" and n != "theta_in" for n in inputs]


def words(contents: Mapping[str, Any]) -> list[str]:
    """Return the description as lines of text, for the head of a source file."""
    model = contents["model"]
    lines = [" + ".join([model["base"], *model["effects"]]), ""]
    for name, p in contents["parameters"].items():
        spread = f" ± {p['std']:.3g}" if p["std"] else ""
        lines.append(f"{name} = {p['value']:.17g}{spread} {p['unit']}" + (" (fixed)" if p["fixed"] else ""))
    lines += ["", *(f"fitted to {d['name']}: {d['samples']} samples, SHA-256 {d['sha256']}" for d in contents["data"])]
    lines.append("written by " + ", ".join(f"{k} {v}" for k, v in contents["versions"].items()))
    return lines
