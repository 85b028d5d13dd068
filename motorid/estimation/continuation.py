"""Continuation in the width of sgn, from wide, where the misfit is smooth, to what the records ask for; and restarts.

Friction makes the misfit rugged: a parameter moves the instant at which a speed passes through zero. A wide sgn smooths
this over, and its minimum leads to the right one (numerical continuation, Allgower & Georg, 1990). On the EMPS record
five starts within a factor of three ended at 2.61-3.01 mm with the final width alone, and all at 2.551 mm in stages.

Where an end is in doubt, it is tried from another start. Two valleys lead far starts astray: with the time constants
swapped the speed comes out right and the current not at all; with hardly any resistance inductance and inertia ring.
The first is left by errors over the RMS of each channel at first, the second by smaller first steps; what resists both
is begun nearby. So 3000 starts within a factor of ten of each shipped motor all ended in its optimum, and 97 % within a
factor of a hundred (bench_starts.py). A parameter that a run has driven to nothing has collapsed: on a logarithmic
scale the cost is flat there. Put back to where it would matter, it comes to its value, or goes away again."""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace

import numpy as np

from motorid.estimation.least_squares import FAILURES, RACE, ROUNDS, Callback, Estimate, cost_at, least_squares, race
from motorid.estimation.result import Fit
from motorid.model.definition import Parameter
from motorid.model.model import Model
from motorid.numerics.least_squares import LevenbergMarquardt, levenberg_marquardt
from motorid.numerics.signals import Array
from motorid.problem.problem import Problem
from motorid.problem.runs import SGN_WIDTH_SHARE, narrowest_width, suited_width, top_speed
from motorid.problem.simulate import misfit_over_noise, poorly_explained

# How to begin again: from where the other weights lead?, first damping, start moved by up to e to this power.
RESTARTS = (True, 0.1, 0.0), (False, 10.0, 0.0), (True, 10.0, 0.0), (False, 1.0, 1.5), (True, 1.0, 1.5)
FLAT = 0.03  # of the misfit: what a change by a factor of e does at least, if the data have a say in it
FAR = 1.0  # on the logarithmic scale: an end nearer to its start is in no doubt
MATTERS = 10.0  # standard deviations that a change by a factor of e makes
FURTHEST = 1e12  # times its value, that a collapsed parameter is put back
GAIN = 2.0  # of the cost, half of chi²: two standard deviations
MOST = 3  # parameters that are put back one by one
WIDEST = 0.03  # first width of sgn over the highest speed
STEP = 6.0  # factor from one width to the next, at most
NOISE = 1.1  # misfit over noise of an angle that has no creep left in it
WORTH_IT = 1.5  # factor between widths that is worth another run
LOWER = 0.99  # of the cost with a wider sgn: what creep is left lowers the error by half of what may be named at most


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


def by_continuation(problem: Problem, effort: LevenbergMarquardt, callback: Callback = None, *,
                    wide: bool = True, narrow: bool = True) -> Estimate:
    """Minimise the cost from the values of the model, and restart where the first width ends in doubt.

    One least-squares run where the model has no sgn, or one whose width was given. `wide` begins with a wide sgn,
    `narrow` ends with a narrower one where that lowers the cost, see `sharpened`; the `looks` of `effort` count the
    restarts at the first width. Raises `FitError` if the model cannot be simulated at the start."""
    widths = _widths(problem) if wide and smooths(problem) else (problem.width,)
    here, history, ends, last = problem, (), [], len(widths) - 1
    for k, width in enumerate(widths):
        # What one width likes a narrower one may refuse; then the start is better.
        stage = min((_at(p, width) for p in dict.fromkeys((here, problem))), key=cost_at) if k else _at(here, width)
        rough = effort if k == last else effort.at_most(RACE)
        try:
            done = least_squares(stage, rough, callback, rounds=ROUNDS if k in (0, last) else 1)
            ends.append(done if k else restarted_where_doubtful(done, stage, rough, callback))
        except FAILURES:
            if k < last:
                continue
            if not ends:
                raise
            # Slopes that grow beyond all bounds with a narrow sgn: it stays as wide as can be followed.
            ends.append(least_squares(ends[-1].problem, effort, callback, q=ends[-1].q))
        history += ends[-1].history
        if k < last:
            here = ends[-1].problem.start_at(ends[-1].values)
    found: Estimate = replace(ends[-1], history=history)
    return sharpened(past_ripples(found, effort, callback), effort, callback) if narrow else found


def past_ripples(found: Estimate, effort: LevenbergMarquardt, callback: Callback = None) -> Estimate:
    """Return the estimate led on from where it stalled by the slopes of a wider sgn, if that lowers the cost.

    With a narrow sgn the instants at which a motor sticks and breaks away ripple the cost, and its own slopes lead into
    the nearest ripple; those of a wider one follow the valley. What ends at the noise is left as it is."""
    problem = found.problem
    if found.solution.status == "converged" or not smooths(problem) or \
            max(misfit_over_noise(problem, found.q).values(), default=0.0) < NOISE:
        return found
    wider = problem.tuned(width=STEP * found.values["sgn_width"]).refined(found.q)
    with suppress(*FAILURES):
        led = levenberg_marquardt(problem.residual, lambda q: (problem.residual(q), wider.jacobian(q)), found.q,
                                  problem.scaling.bounds, effort.at_most(RACE), callback, problem.scaling.log)
        if led.history[-1] < LOWER * found.cost:
            other = least_squares(problem, effort, callback, q=led.q)
            if other.cost < LOWER * found.cost:
                return replace(other, history=found.history + led.history + other.history)
    return found


def sharpened(found: Estimate, effort: LevenbergMarquardt, callback: Callback = None) -> Estimate:
    """Return the estimate with a narrower sgn as long as that lowers the cost: more only makes the model stiff."""
    while (narrower := _narrower(found)) is not None:
        width, surely = narrower
        problem = found.problem.start_at(found.values).tuned(width=width)
        try:
            if not surely:  # then the slopes with the wider one must promise it
                r, jac = problem.refined(found.q).residual(found.q), found.solution.jac
                left = r - jac @ np.linalg.lstsq(jac, r, rcond=None)[0]
                if 0.5 * float(left @ left) >= LOWER * found.cost:
                    return found
            other = least_squares(problem, effort, callback)
        except FAILURES:  # so narrow that it cannot be followed
            return found
        history = found.history + other.history
        if other.cost > LOWER * found.cost:
            return replace(found, history=history)
        found = replace(other, history=history)
    return found


def smooths(problem: Problem) -> bool:
    """Tell whether the model has a sgn whose width was left to the records."""
    width = problem.model.parameters.get("sgn_width")
    return width is not None and not width.given and not width.vary


def _widths(problem: Problem) -> tuple[float, ...]:
    """Return the widths of sgn, wide to narrow; the last is the one that the speeds of the records ask for."""
    width = max(SGN_WIDTH_SHARE * top_speed(problem.experiments), _narrowest(problem))
    ratio = max(WIDEST * top_speed(problem.experiments) / width, 1.0)
    return (*(width * np.geomspace(ratio, 1.0, int(np.ceil(np.log(ratio) / np.log(STEP))) + 1)[:-1]), width)


def _at(problem: Problem, width: float | None) -> Problem:
    return problem if width == problem.width else problem.tuned(width=width)


def _narrowest(problem: Problem, noise: float = 1.0) -> float:
    """Return the width of sgn that the noise of the records asks for, `noise` times what was estimated."""
    return suited_width(problem.experiments, noise) or problem.model.values["sgn_width"]


def _narrower(found: Estimate) -> tuple[float, bool] | None:
    """Return a narrower width to try, or None, and whether the creep of a stuck motor surely asks for it."""
    problem = found.problem
    if problem.width is None or not smooths(problem) or problem.width > 1.01 * _widths(problem)[-1]:
        return None
    misfit = misfit_over_noise(problem, found.q).get("theta")
    asked = problem.width if misfit is None else _narrowest(problem, min(misfit, 1.0))
    creeps = asked * WORTH_IT < problem.width
    width = max(asked if creeps else narrowest_width(problem.experiments), problem.width / STEP)
    # Below its noise an angle says little: the noise may seem larger than it is.
    return (width, creeps and misfit is not None and misfit > NOISE) if width * WORTH_IT < problem.width else None
