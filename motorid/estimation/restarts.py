"""Restarts: where an end is in doubt, from another start; where a parameter has collapsed, from where it matters.

Two valleys lead far starts astray: with the time constants swapped the speed comes out right and the current not at
all; with hardly any resistance inductance and inertia ring. The first is left by errors over the RMS of each channel at
first, the second by smaller first steps; what resists both is begun nearby. So 3000 starts within a factor of ten of
each shipped motor all ended in its optimum, and 97 % within a factor of a hundred (bench_starts.py).

A parameter that a run has driven to nothing has collapsed: on a logarithmic scale the cost is flat there. Put back to
where it would matter, it comes to its value, or goes away again."""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace

import numpy as np

from motorid.estimation.least_squares import FAILURES, RACE, Callback, Estimate, cost_at, least_squares, race
from motorid.estimation.result import Fit
from motorid.model.definition import Parameter
from motorid.model.model import Model
from motorid.numerics.least_squares import LevenbergMarquardt
from motorid.numerics.signals import Array
from motorid.problem.problem import Problem
from motorid.problem.simulate import poorly_explained

# How to begin again: from where the other weights lead?, first damping, start moved by up to e to this power.
RESTARTS = (True, 0.1, 0.0), (False, 10.0, 0.0), (True, 10.0, 0.0), (False, 1.0, 1.5), (True, 1.0, 1.5)
FLAT = 0.03  # of the misfit: what a change by a factor of e does at least, if the data have a say in it
FAR = 1.0  # on the logarithmic scale: an end nearer to its start is in no doubt
MATTERS = 10.0  # standard deviations that a change by a factor of e makes
FURTHEST = 1e12  # times its value, that a collapsed parameter is put back
GAIN = 2.0  # of the cost, half of chi²: two standard deviations
MOST = 3  # parameters that are put back one by one


def restarted_where_doubtful(found: Estimate, begin: Problem, effort: LevenbergMarquardt,
                             callback: Callback = None) -> Estimate:
    """Return the best of an estimate and up to `effort.looks` restarts, as long as it is in doubt."""
    for k, (other_weights, damping, shift) in enumerate(RESTARTS[:effort.looks]):
        if not doubtful(found, begin):
            break
        careful = replace(effort, damping=damping)
        with suppress(*FAILURES):
            start = _shifted(begin, shift, k) if shift else begin
            if other_weights:
                other = start.tuned(weights="noise" if start.weights == "rms" else "rms", noise_factors={})
                start = start.start_at(least_squares(other, careful.at_most(RACE)).values)
            again = least_squares(start, careful, callback)
            found = replace(min(found, again, key=lambda e: e.cost), history=found.history + again.history)
    return found


def doubtful(found: Estimate, begin: Problem) -> bool:
    """Tell whether an estimate went far from where it began and ended where it should not. That is: without
    convergence, with a channel poorly explained, or in a direction that the data do not ask for."""
    log, physical = begin.scaling.log, found.problem.scaling.physical(found.q)
    moved = np.log(physical[log] / begin.scaling.physical(begin.start)[log])
    if np.max(np.abs(moved), initial=0.0) < FAR:
        return False
    if found.solution.status != "converged" or poorly_explained(found.problem, found.q):
        return True
    s, directions = np.linalg.svd(np.linalg.qr(found.solution.jac[:, log], mode="r"))[1:]
    flat = directions[:len(s)][s < FLAT * np.linalg.norm(found.solution.residual)]
    return bool(np.max(np.abs(flat.T @ (flat @ moved)), initial=0.0) > FAR)


def _shifted(problem: Problem, shift: float, seed: int) -> Problem:
    rng, values = np.random.default_rng(seed), problem.model.values
    names = (p.name for p in problem.unknown if p.positive and p.vary and p.name in values)
    return problem.start_at({n: values[n] * float(np.exp(shift * rng.uniform(-1, 1))) for n in names})


def restore_collapsed(found: Estimate, effort: LevenbergMarquardt) -> Estimate:
    """Return an estimate that collapsed parameters, put back together or one by one, have led lower, or the same."""
    sd, influence = _deviation(found.problem, found.solution.residual), np.linalg.norm(found.solution.jac, axis=0)
    values = found.values
    parameters = [p for p in found.problem.model.start_at(values).parameters.values() if p.vary]  # inside their limits
    named = dict(zip((p.name for p in found.problem.unknown), influence, strict=True))
    back = {n: v for n, v in restored_values(parameters, named, sd).items() if v != values[n]}
    each = [{n: v} for n, v in back.items()][:MOST] if len(back) > 1 else []
    for changes in (back, *each) if back else ():
        again = race([found.problem.start_at({**values, **changes})], effort)
        if again is not None and again.cost < found.cost - GAIN * sd**2:
            return replace(again, history=found.history + again.history)
    return found


def _deviation(problem: Problem, residual: Array) -> float:
    """Return the standard deviation of the weighted residuals where all is explained: one, if the noise weighs them."""
    return float(np.sqrt(np.mean(residual**2))) or 1.0 if problem.weights == "rms" else 1.0


def restored_values(parameters: Iterable[Parameter], influence: Mapping[str, float],
                    deviation: float = 1.0) -> dict[str, float]:
    """Return the values at which collapsed parameters would matter, whose logarithms change the residual so much."""
    weak = (p for p in parameters if p.positive and p.vary and 0 < influence.get(p.name, 0.0) < MATTERS * deviation)
    return {p.name: float(np.clip(3 * MATTERS / influence[p.name] * p.value, p.lower, min(p.upper, FURTHEST * p.value)))
            for p in weak}


def restored(fit: Fit, model: Model) -> Model:
    """Return a larger model than that of `fit`, with the parameters that collapsed in `fit` where they would matter."""
    slopes = dict(zip((p.name for p in fit.problem.unknown), np.linalg.norm(fit.jacobian, axis=0), strict=True))
    known = [p for p in model.parameters.values() if p.name in slopes]
    sd = _deviation(fit.problem, fit.residuals)
    back = restored_values(known, {p.name: p.value * slopes[p.name] for p in known}, sd)
    return model.start_at(back) if back else model


def collapsed_again(problem: Problem, fit: Fit) -> Problem:
    """Return the problem with what `restored` put back where `fit` had it, each if that costs nothing."""
    model, gain = restored(fit, fit.model), GAIN * _deviation(fit.problem, fit.residuals) ** 2
    for name in (n for n, p in model.parameters.items() if p.value != fit.model.parameters[n].value):
        other = problem.start_at({name: fit.values[name]})
        if cost_at(other.within_worth()) < cost_at(problem.within_worth()) + gain:
            problem = other
    return problem
