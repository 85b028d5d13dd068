"""Does every start lead to the same place? Fits from many random starts.

The study of the source paper: starts drawn log-uniformly within a factor `spread` of the best fit, the error
and the parameters of every fit, and how many of them are good.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from motorid.errors import MotoridError, SimulationError, UsageError
from motorid.estimation.balancing import descend_balanced
from motorid.estimation.fit import Failure, Fit, solve, started
from motorid.integrate.engine import Array
from motorid.numerics.least_squares import LevenbergMarquardt
from motorid.numerics.parallel import Map, Parcel, in_chunks, run_tasks
from motorid.problem.problem import Problem
from motorid.problem.simulate import at, judge
from motorid.uncertainty.endings import Ending, Multistart


def multistart(
    problem_or_fit: Problem | Fit,
    *,
    starts: int = 100,
    spread: float = 10.0,
    seed: int = 0,
    guess: bool = False,
    solver: Any = None,
    map: Map | None = None,
    quiet: bool = False,
) -> Multistart:
    """Fit from many random starts and say where they end.

    Parameters
    ----------
    problem_or_fit : Problem or Fit
        The reference; a problem is solved first.
    starts : int
    spread : float
        Starts are log-uniform within this factor on either side of the reference, in every free parameter; a
        parameter that may be negative is moved by the same factors, and its sign is kept; a phase is drawn
        from the whole circle.
    seed : int
        The starts depend on it alone, not on the pool.
    guess : bool
        Let the automatic first guess compete with the start, as in `fit`. Default: the start stands alone.
    solver : optional
        As in `fit`; default `LevenbergMarquardt`.
    map : callable, optional
        Anything with the signature of `map`; see `motorid.tasks`.
    quiet : bool
        No progress bar.

    Raises
    ------
    UsageError
        If there is nothing to start from, or the spread is below 1.
    """
    if starts < 1 or not spread >= 1:
        raise UsageError("multistart takes at least one start and a spread of at least 1; "
                         f"got {starts} and {spread:g}.")
    began = time.perf_counter()
    reference = problem_or_fit if isinstance(problem_or_fit, Fit) else solve(problem_or_fit, solver)
    names = reference.problem.model.free_names
    if not names:
        raise UsageError("the model has no free parameter to start from; free some with model.free(…).")
    drawn = _draw(reference, names, starts, spread, seed)
    parcel = Parcel.of((reference.problem, dict(reference.values), solver, guess))
    chunks = in_chunks(drawn, map)
    done = run_tasks(_from_starts, [(parcel, c) for c in chunks], map, "Fitting from random starts",
                     quiet=quiet)
    endings = tuple(e for part in done.results for e in part)
    said = f"interrupted after {len(endings)} of {starts} starts" if done.interrupted else ""
    return Multistart(reference, endings, float(spread), guess, time.perf_counter() - began, said)


robustness = multistart  # the name of the study in the source paper and on the command line


def _draw(reference: Fit, names: Sequence[str], starts: int, spread: float,
          seed: int) -> list[dict[str, float]]:
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    factors = spread ** rng.uniform(-1, 1, (starts, len(names)))
    pars = reference.problem.model.parameters
    scale = reference.problem.scaling.scale
    sizes = np.array([reference.values[n] or 1e-3 * s for n, s in zip(names, scale, strict=False)])
    turning = np.array([pars[n].periodic for n in names], bool)
    phases = sizes + np.pi * np.log(factors) / max(np.log(spread), 1e-300)  # anywhere on the circle
    drawn = np.where(turning & (spread > 1), phases, factors * sizes)
    drawn = np.clip(drawn, [pars[n].lower for n in names], [pars[n].upper for n in names])
    return [dict(zip(names, row, strict=True)) for row in drawn.tolist()]


def _from_starts(task: tuple[Parcel, Sequence[dict[str, float]]]) -> list[Ending | Failure]:
    problem, values, solver, guess = task[0].open()
    return [_from_start(problem, values, solver, guess, start) for start in task[1]]


def _from_start(problem: Problem, values: dict[str, float], solver: Any, guess: bool,
                start: dict[str, float]) -> Ending | Failure:
    began = time.perf_counter()
    here = problem.for_model(problem.model.start_at(values | start))
    try:
        here = replace(started(here), _runs=here.runs) if guess else here
        if hasattr(solver, "solve"):
            fit = solver.solve(here)
            solved, q, status, message, history = fit.problem, fit.q, fit.status, fit.message, fit.history
        else:
            done = descend_balanced(here, solver or LevenbergMarquardt())
            solved, q, history = done.problem, done.solution.q, done.history
            status, message = done.solution.status, done.solution.message
    except (MotoridError, np.linalg.LinAlgError) as error:
        return Failure(start, "failed", str(error))
    physical = solved.scaling.physical(q)
    return Ending(start, solved.values(q), _cost_like(problem, physical), judge(at(solved, q)).nrmse, status,
                  message, len(history) - 1, time.perf_counter() - began)


def _cost_like(problem: Problem, physical: Array) -> float:
    """Cost with the weights and steps of the reference, so that different endings can be compared."""
    try:
        r = problem.residual(problem.scaling.scaled(physical))
    except SimulationError:
        return float("inf")
    return 0.5 * float(r @ r)
