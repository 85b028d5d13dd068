"""Least squares in stages: sgn from wide to narrow, sub-steps refined where the solution goes.

Friction makes the misfit rugged: a parameter moves the instant at which a speed passes through zero. A wide
sgn smooths this over, and its minimum leads to the right one (numerical continuation, Allgower & Georg, 1990).
On the EMPS record five starts within a factor of three ended at 2.61-3.01 mm with the final width alone, and
all at 2.551 mm in stages.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from motorid.errors import FitError, SimulationError
from motorid.integrate.grid import Array
from motorid.least_squares import LevenbergMarquardt, Solution, levenberg_marquardt
from motorid.prepared import Run
from motorid.problem import Problem

WIDER = (30.0, 5.0)  # times the final width of sgn
ROUNDS = 4  # of refining the sub-steps
IMBALANCE = 3.0  # between channels, in misfit over noise, above which the misfit decides the weights

Callback = Callable[[int, float, Array], object] | None


@dataclass(frozen=True, eq=False)
class Descent:
    """Where a descent ended: the problem with its last grids, the solution, all costs on the way."""

    problem: Problem
    solution: Solution
    history: tuple[float, ...]


def descend(problem: Problem, options: LevenbergMarquardt, callback: Callback = None, *,
            stages: bool = True) -> Descent:
    """Solve `problem` from the values of its model.

    Parameters
    ----------
    problem : Problem
    options : LevenbergMarquardt
    callback : callable, optional
    stages : bool
        Begin with a wide sgn, where the model has one whose width was not given.

    Raises
    ------
    FitError
        If the model cannot be simulated at the start.
    """
    history: list[float] = []
    if stages:
        problem = _narrowing(problem, replace(options, ftol=max(options.ftol, 1e-7)), callback, history)
    q = problem.start
    for _ in range(ROUNDS):
        problem = problem.refined(q)
        found = levenberg_marquardt(problem.residual, problem.residual_and_jacobian, q, problem.scaling.bounds,
                                    options, callback, problem.scaling.log)
        history += found.history
        moved = np.max(np.abs(found.q - q), initial=0.0) > 1e-3
        q = found.q
        if found.status == "limit" or not moved or _same_grid(problem, problem.refined(q)):
            break
    return Descent(problem, found, tuple(history))


def descend_balanced(problem: Problem, options: LevenbergMarquardt, callback: Callback = None, *,
                     stages: bool = True) -> Descent:
    """Like `descend`, and where the model fails, weigh channels by their misfit instead of their noise.

    A model that cannot reach the noise would otherwise spend itself on the channel with the smallest noise (an
    encoder), at any price in the others. Noise and misfit together give the maximum of the likelihood with the
    channels' variances as unknowns, ``Σ n·ln(SSR)`` (Seber & Wild, Nonlinear Regression, 1989, ch. 11); a model
    that reaches the noise keeps the weights of the noise.
    """
    done = descend(problem, options, callback, stages=stages)
    if problem.weights != "noise" or problem.loss is not None or len(problem.outputs) < 2:
        return done
    begin = problem
    for _ in range(3):
        factors = misfit_over_noise(done.problem, done.solution.q)
        relative = [factors[c] / done.problem.balance.get(c, 1.0) for c in factors]
        if max(relative) < IMBALANCE * min(relative):
            break
        again = descend(begin.balanced(factors), options, callback, stages=stages)
        done = replace(again, history=done.history + again.history)
        begin = done.problem.for_model(done.problem.model.start_at(done.problem.values(done.solution.q)))
    return done


def misfit_over_noise(problem: Problem, q: Array) -> dict[str, float]:
    """Return the RMS of the residual over the noise per channel, at least 1."""
    sums = {c: [0.0, 0] for c in problem.outputs}
    for k, run in enumerate(problem.runs):
        y = problem.simulate(q, k, derivatives=False).y
        for j, c in enumerate(problem.outputs):
            if c in run.sigma:
                e = (run.experiment.outputs[c] - y[:, j]) / run.sigma[c]
                e = e[np.isfinite(e)]
                sums[c][0] += float(e @ e)
                sums[c][1] += e.size
    return {c: max(float(np.sqrt(s / max(n, 1))), 1.0) for c, (s, n) in sums.items()}


def _narrowing(problem: Problem, options: LevenbergMarquardt, callback: Callback, history: list[float]) -> Problem:
    """Return the problem with the values that wider and wider, then narrower, sgn leads to."""
    width = problem.model.parameters.get("sgn_width")
    if width is None or width.given or width.vary:
        return problem
    options = replace(options, max_iterations=min(options.max_iterations, 60))
    for factor in WIDER:
        wide = problem.for_model(problem.model.replace(sgn_width=factor * width.value))
        try:
            wide = wide.refined(wide.start)
            found = levenberg_marquardt(wide.residual, wide.residual_and_jacobian, wide.start, wide.scaling.bounds,
                                        options, callback, wide.scaling.log)
        except (FitError, SimulationError):
            continue
        history += found.history
        values = wide.values(found.q) | {"sgn_width": width.value}
        problem = problem.for_model(problem.model.start_at(values))
    return problem


def _same_grid(a: Problem, b: Problem) -> bool:
    return all(np.array_equal(x.grid.substeps, y.grid.substeps) for x, y in zip(a.runs, b.runs, strict=True))


def integration_error(problem: Problem, q: Array) -> float:
    """Return the largest change of an output when every step is halved, in units of the noise."""
    worst = 0.0
    for k, run in enumerate(problem.runs):
        if not hasattr(problem._engine, "compiled"):
            return 0.0
        try:
            coarse = problem.simulate(q, k, derivatives=False).y
            finer = problem._keeping(tuple(r if j != k else _halved(r) for j, r in enumerate(problem.runs)))
            fine = finer.simulate(q, k, derivatives=False).y
        except SimulationError:
            return float("inf")
        sigma = np.array([run.sigma.get(c, np.inf) for c in problem.outputs])
        worst = max(worst, float(np.max(np.abs(fine - coarse) / sigma)))
    return worst


def _halved(run: Run) -> Run:
    return replace(run, grid=run.grid.with_substeps(2 * run.grid.substeps))


__all__ = ["Descent", "descend", "descend_balanced", "integration_error", "misfit_over_noise"]
