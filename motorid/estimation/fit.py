"""fit(): from a model and records to parameter values, and `Fit`, what came out."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from motorid.errors import FitError, UsageError, one_of
from motorid.estimation.continuation import Descent
from motorid.estimation.restarts import descend_balanced
from motorid.estimation.result import Fit
from motorid.estimation.start_values import started
from motorid.integrate.engine import Engine
from motorid.model.model import Model
from motorid.numerics.least_squares import LevenbergMarquardt, Solution, levenberg_marquardt
from motorid.numerics.signals import Array
from motorid.problem.problem import Problem, as_problem
from motorid.problem.simulate import integration_error, misfit_over_noise
from motorid.records.experiment import Experiment

NOISE = 1.2  # RMS of the residual over the noise that may be called noise
ERROR_SHARE = 0.2  # integration error accepted beside noise or misfit
MOST_FINER = 4  # times as many steps, where that is not kept
POLISH = 20  # iterations with them


def fit(
    model: Model,
    runs: Sequence[Experiment] | Experiment,
    *,
    solver: Any = None,
    start: str = "auto",
    engine: str | Engine = "rosenbrock",
    formulation: str = "plain",
    priors: Mapping[str, tuple[float, float]] | None = None,
    penalties: Sequence[Any] = (),
    constraints: Sequence[Any] = (),
    loss: Any = None,
    weights: str | None = None,
    initial: str = "auto",
    callback: Callable[[int, float, Array], object] | None = None,
) -> Fit:
    """Estimate the free parameters of `model` from `runs`; no first guess is asked for.

    Parameters
    ----------
    model : Model
        E.g. ``mi.dc_motor() + mi.effects.coulomb``. Values set by ``replace`` are the start, held ones stay.
    runs : Experiment or sequence of Experiment
    solver : LevenbergMarquardt or MultipleShooting, optional
    start : {"auto", "model"}
        ``"auto"``: the better of the integral-equation guess and the model's present values.
    engine : {"rosenbrock", "cvodes", "idas"} or Engine
    formulation : {"plain", "penalty"}
        ``"penalty"``: the source paper's composite residual; errors over the RMS of each channel, with
        `constraints` (by default the steady state) as penalties. True constraints: ``solver=MultipleShooting()``.
    priors : mapping of str to (mean, std), optional
    penalties, constraints : sequence, optional
        See `CurrentLimit` and `SteadyState`.
    loss : Huber, optional
    weights : {"noise", "rms"}, optional
    initial : {"auto", "rest", "measured", "estimate"}
    callback : callable, optional
        ``callback(iteration, cost, q)``.

    Returns
    -------
    Fit

    Raises
    ------
    UsageError, ModelError, DataError
        The words or the data were wrong.
    FitError
        The model cannot be simulated at any starting point.
    """
    if formulation not in ("plain", "penalty"):
        raise UsageError(one_of(formulation, ("plain", "penalty"), "formulation") + " For hard constraints use "
                         "solver=mi.MultipleShooting().")
    if constraints and formulation == "plain" and not hasattr(solver, "solve"):
        raise UsageError("constraints need a solver that honours them: solver=mi.MultipleShooting(), or "
                         "formulation='penalty' to weigh them.")
    penalties = tuple(penalties)
    if formulation == "penalty":
        from motorid.problem.constraints import SteadyState

        penalties += tuple(constraints) or (SteadyState(),)
        constraints = ()
    problem = as_problem(model, runs, engine=engine, priors=dict(priors or {}), penalties=penalties, loss=loss,
                         constraints=tuple(constraints), initial=initial,
                         weights=weights or ("rms" if formulation == "penalty" else "noise"))
    found = solve(problem, solver, start=start, callback=callback, formulation=formulation)
    _ = found.evaluation, found.std  # kept with the fit: showing it then computes nothing
    return found


def solve(problem: Problem, solver: Any = None, *, start: str = "auto",
          callback: Callable[[int, float, Array], object] | None = None, formulation: str = "plain") -> Fit:
    """Solve a `Problem`; `fit` is this with the problem made on the way. See there."""
    began = time.perf_counter()
    if start not in ("auto", "model"):
        raise UsageError(one_of(start, ("auto", "model"), "start"))
    if not problem.unknown:
        raise UsageError("every parameter is held, there is nothing to fit. Free one, model.free('R'), or judge "
                         "the model as it is: mi.evaluate(model, runs).")
    if start == "auto":
        from motorid.estimation.start_values import numbered  # it fits smaller models first, by this very function

        problem = started(numbered(problem, solve))
    if hasattr(solver, "solve"):
        return solver.solve(problem)
    if problem.constraints:
        raise UsageError("LevenbergMarquardt has no true constraints; use solver=mi.MultipleShooting().")
    options = solver or LevenbergMarquardt()
    if start == "auto":  # a guess from the data needs no looks from elsewhere; a misfit then is the model's
        options = replace(options, looks=min(options.looks, 1))
    return _least_squares(problem, options, callback, formulation, start == "auto", began)


def _least_squares(problem: Problem, options: LevenbergMarquardt, callback, formulation: str, stages: bool,
                   began: float) -> Fit:
    done = descend_balanced(problem, options, callback, stages=stages)
    done, error = _exact_enough(done, options, callback)
    problem, found = done.problem, done.solution
    found = _at_noise(found, problem)
    q = problem.unknowns.principal(found.q)
    fit = Fit(problem, problem.values(q), found.residual, found.jac / problem.scaling.slope(q), q, found.status,
              _advice(found, error, problem.n_outputs), done.history, time.perf_counter() - began,
              error, formulation)
    _ = fit.simulations  # nothing is computed for them now
    problem.forget()
    return fit


def _exact_enough(done: Descent, options: LevenbergMarquardt, callback) -> tuple[Descent, float]:
    """Return the descent and its integration error; with finer steps all over where small errors added up."""
    problem, q = done.problem, done.solution.q
    error = integration_error(problem, q)
    allowed = ERROR_SHARE * max(_misfit(done.solution, problem.n_outputs), 1.0)
    finer = np.ceil((2 * error / allowed) ** (1 / 3)) if np.isfinite(error) else np.inf
    if error <= allowed or finer > MOST_FINER or done.solution.status != "converged":
        return done, error
    problem, options = problem.with_finer_steps(int(finer)), replace(options, max_iterations=POLISH)
    try:
        found = levenberg_marquardt(problem.residual, problem.residual_and_jacobian, q, problem.scaling.bounds, options,
                                    callback, problem.scaling.log)
    except FitError:
        return done, error
    if found.status == "limit":
        found = replace(found, status="converged", message=done.solution.message)
    return Descent(problem, found, done.history + found.history), integration_error(problem, found.q)


def _misfit(found: Solution, n: int) -> float:
    return float(np.sqrt(np.mean(found.residual[:n] ** 2)))


def _at_noise(found: Solution, problem: Problem) -> Solution:
    """Return the solution, as converged where the misfit is noise: friction makes the cost too rugged to go lower."""
    if found.status != "stalled" or problem.weights != "noise":
        return found
    if max(misfit_over_noise(problem, found.q).values(), default=np.inf) > NOISE:
        return found
    return replace(found, status="converged", message="converged: no step lowers a misfit that is noise")


def _advice(found: Solution, error: float, n: int) -> str:
    """Return the solver's message, with what to try where the integration error matters beside noise and misfit."""
    if found.status == "converged" and error > max(1.0, ERROR_SHARE * _misfit(found, n)):
        return (f"{found.message}; but the integration error is {error:.2g} times the noise: try engine='cvodes' or "
                "a finer record.")
    return f"{found.message}."
