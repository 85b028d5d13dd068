"""Trying an effect for real: refit with it, judge it on data that it never saw, refuse what is not identifiable."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from motorid.diagnosis.cross_validation import QUICK, ROUGH, restarted
from motorid.diagnosis.parts import worth_its_steps
from motorid.diagnosis.score_test import uses_angle
from motorid.errors import FitError, ModelError, SimulationError
from motorid.estimation.continuation import Descent, descend
from motorid.estimation.first_guess import first_guess
from motorid.estimation.fit import Fit
from motorid.estimation.revival import let_go, revived
from motorid.integrate.engine import Array
from motorid.model.model import Model
from motorid.numerics.least_squares import LevenbergMarquardt
from motorid.problem.misfit import misfit_over_noise
from motorid.problem.problem import Problem
from motorid.problem.runs import natural_sizes

RACE = LevenbergMarquardt(max_iterations=6, ftol=1e-3, xtol=1e-4)
POLISH = LevenbergMarquardt(max_iterations=60, ftol=1e-7, xtol=1e-7)
GOING_ON = 4  # times, where the last descent ends at its limit
LOST = 0.2  # NRMSE of a channel
ROOM = 10.0  # factor beyond its grid that a shape parameter may run to
FAILURES = (FitError, SimulationError, ModelError, np.linalg.LinAlgError)
WORSE = 1.02  # of the cost along the measured angle: the model's own angle must do as well


@dataclass(frozen=True, eq=False)
class Raced:
    """The best of several starts of one model after a few steps, and the cost it has reached."""

    problem: Problem
    cost: float
    angular: bool


def raced(fit: Fit, model: Model, starts: Sequence[Mapping[str, float]]) -> Raced | None:
    """Go a few steps from each start with `model` on the records of `fit`; None if none can be simulated.

    Effects of the angle start along the measured angle, which the model's own angle, still wrong, would lead astray.
    """
    model = _bounded(fit, model)
    alive = revived(fit, model)
    angular = any(uses_angle(e) for e in model.effects) and not any(uses_angle(e) for e in fit.model.effects)
    found = []
    for start in (*(starts or ({},)), *_own_starts(fit, model)):
        # As it is where a parameter put back (an inductance that no sample shows) makes the model too stiff.
        for each in (alive,) if alive is model else (alive, model):
            done = _race(_started(fit, each, start, angular))
            if done is not None:
                problem, cost = restarted(done.problem, done.solution.q), float(done.solution.history[-1])
                found.append(Raced(problem, cost, angular))
                break
    return min(found, key=lambda r: r.cost, default=None)


def promised(fit: Fit, model: Model, starts: Sequence[Mapping[str, float]]) -> float:
    """Return the lowest cost that one undamped step from any of the starts promises `model`; infinite for none."""
    lowest, like = np.inf, None
    for start in starts:
        with contextlib.suppress(*FAILURES):
            problem = _started(fit, _bounded(fit, model), start, angular=False)
            problem = problem.refined(problem.start) if like is None else replace(problem, _runs=like.runs)
            like = problem
            r, jac = problem.residual_and_jacobian(problem.start)
            triangle: Array = np.asarray(np.linalg.qr(np.column_stack([jac, r]), mode="r"))
            lowest = min(lowest, 0.5 * float(np.sum(triangle[jac.shape[1] :, -1] ** 2)))
    return lowest


def finished(fit: Fit, best: Raced) -> Fit | None:
    """Return the refit that a race began, converged; None if it fails.

    Where it went along the measured angle the model's own takes over, unless it drifts too far (periods of the
    angle pass).
    """
    stages = "sgn_width" in best.problem.model.parameters and not fit.model.effects
    try:
        done = _released(best.problem) if best.angular else descend(best.problem, QUICK, stages=stages)
    except FAILURES:
        return None
    return _polished(fit, let_go(restarted(done.problem, done.solution.q), fit))


def refit(fit: Fit, model: Model, starts: Sequence[Mapping[str, float]]) -> Fit | None:
    """Return the best refit of `model` on the records of `fit` from several starts; None if none can be simulated."""
    best = raced(fit, model, starts)
    return None if best is None else finished(fit, best)


def _released(measured: Problem) -> Descent:
    """Let the model's own angle take the place of the measured one, if it is good enough.

    Raises
    ------
    FitError, SimulationError
    """
    own = measured.for_model(replace(measured.model, angle_input=False, _systems={}))
    if not all("theta" in run.outputs for run in measured.experiments):
        return descend(own, QUICK, stages=False)
    along = descend(measured, QUICK, stages=False)
    values = along.problem.values(along.solution.q)
    own = restarted(along.problem, along.solution.q).for_model(own.model.start_at(values))
    try:
        free = descend(own, QUICK, stages=False)
    except FAILURES:
        return along
    return free if free.solution.history[-1] < WORSE * along.solution.history[-1] else along


def lost(fit: Fit) -> bool:
    """Tell whether a fit is so far from its records that neither its values nor slopes there lead anywhere."""
    return max(fit.nrmse.values(), default=0.0) > LOST


def _own_starts(fit: Fit, model: Model) -> list[dict[str, float]]:
    """Return the larger model's own first guess, where the smaller one's fit is no place to begin.

    An arm without its weight is fitted by a motor that hardly moves; from there nothing leads back.
    """
    if not lost(fit):
        return []
    return [first_guess(model, fit.problem.experiments, loaded=True)]


def _started(fit: Fit, model: Model, start: Mapping[str, float], angular: bool) -> Problem:
    """Return the problem of a refit, at its start."""
    names = [n for n in start if n in model.parameters]
    problem = fit.problem.for_model(_within(model, {n: start[n] for n in names})).tuned(accuracy=ROUGH)
    problem = restarted(problem, problem.scaling.scaled([fit.initial.get(p.name, p.value) for p in problem.unknown]))
    return problem.for_model(replace(problem.model, angle_input=True, _systems={})) if angular else problem


def _race(problem: Problem) -> Descent | None:
    """Go a few steps; None where that fails or needs more sub-steps than the samples are worth."""
    try:
        done = descend(problem, RACE, stages=False)
    except FAILURES:
        return None
    return done if worth_its_steps(done.problem) else None


def _bounded(fit: Fit, model: Model) -> Model:
    """Return the model with the shapes of its effects kept within what these records could show."""
    natural = natural_sizes(fit.problem.experiments, fit.values)
    limits = {}
    for e in model.effects:
        for p in (model.parameters[q.name] for q in e.parameters):
            if p.grid and p.null is None and p.vary and not p.given:
                size = natural.get(p.unit, 1.0)
                limits[p.name] = (
                    max(p.lower, min(p.grid) * size / ROOM),
                    min(p.upper, max(p.grid) * size * ROOM),
                )
    inside = {n: float(np.clip(model.parameters[n].value, *limits[n])) for n in limits}
    pars = {n: replace(model.parameters[n], value=inside[n], lower=lo, upper=hi) for n, (lo, hi) in limits.items()}
    return model._with(parameters={**model.parameters, **pars})


def _polished(fit: Fit, problem: Problem) -> Fit | None:
    """Converge from a good start, channels weighed anew where the misfit has changed.

    Where that takes more sub-steps than the samples are worth, it is done as roughly as the race.
    """
    try:
        exact = problem.tuned(accuracy=fit.problem.accuracy)
        problem = exact if worth_its_steps(exact.refined(exact.start)) else problem.tuned(accuracy=ROUGH)
        done = _converged(problem)
        if problem.balance:
            factors = misfit_over_noise(done.problem, done.solution.q)
            if max(abs(np.log(factors[c] / problem.balance.get(c, 1.0))) for c in factors) > 0.1:
                done = _converged(restarted(done.problem, done.solution.q).tuned(balance=factors))
    except FAILURES:
        return None
    found, problem = done.solution, done.problem
    if not np.isfinite(found.jac).all():
        return None
    return Fit(
        problem,
        problem.values(found.q),
        found.residual,
        found.jac / problem.scaling.slope(found.q),
        found.q,
        found.status,
        found.message,
        done.history,
    )


def _converged(problem: Problem) -> Descent:
    """Descend, and go on where that ends at its limit: what is unfinished would be judged worse than it is.

    Raises
    ------
    FitError, SimulationError
    """
    done = descend(problem, POLISH, stages=False)
    for _ in range(GOING_ON):
        if done.solution.status != "limit":
            break
        again = descend(restarted(done.problem, done.solution.q), POLISH, stages=False)
        done = replace(again, history=done.history + again.history)
    return done


def _within(model: Model, values: Mapping[str, float]) -> Model:
    """Return the model started at `values`, kept inside the limits of each parameter."""
    inside = {}
    for n, v in values.items():
        p = model.parameters[n]
        v = float(np.clip(v, p.lower, p.upper))
        inside[n] = max(v, 1e-12) if p.positive else v
    return model.start_at(inside)
