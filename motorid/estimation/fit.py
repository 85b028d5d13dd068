"""fit(): from a model and records to parameter values; the stages of a fit, in their order."""

import contextlib
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from motorid.display.numbers import listed
from motorid.errors import ModelError, UsageError, among, name_of, numbers_told, one_of, otherwise
from motorid.estimation.angle_orders import effects_of_unknown_order, strongest_order, uses_angle
from motorid.estimation.continuation import by_continuation, restore_collapsed
from motorid.estimation.least_squares import FAILURES, FINISH, Callback, Estimate, least_squares, race
from motorid.estimation.result import Fit
from motorid.estimation.start_values import exchanged_poles, with_start_values
from motorid.integrate.engine import Engine
from motorid.integrate.rodas3 import ORDER
from motorid.model.model import Model
from motorid.numerics.least_squares import LevenbergMarquardt
from motorid.numerics.parallel import one_thread, progress
from motorid.problem.constraints import SteadyState
from motorid.problem.problem import Problem, as_problem
from motorid.problem.runs import natural_sizes, suited
from motorid.problem.simulate import integration_bias, integration_error, largest, misfit_over_noise, with_angles_apart
from motorid.records.experiment import Experiment, windows

NOISE = 1.2  # RMS of the residual over the noise that may be called noise
IMBALANCE = 3.0  # between channels, in misfit over noise, above which the misfit decides the weights
REWEIGHTINGS = 3  # at most
ERROR_SHARE = 0.2  # integration error accepted beside noise or misfit
BIAS = 0.2  # deviations by which it may move the estimate
WINDOWS = (8, 32)  # of the longest record, where it is not followed as a whole
FEWEST = 50  # samples of a window
LOST = 0.2  # NRMSE of a channel
MOMENT, MIN_MOMENT, MOST_MOMENTS = 2.0, 16, 24  # time constants and samples of a short window, and how many at most
UNFOLLOWED = 0.25  # share of a channel's variance left unexplained
TOO_FAR = 100.0  # times that an error in the state grows: one of 1 % would be all of the motion
NEXT_TO_NOTHING = 0.01  # times the natural size of an effect
MOST_FINER = 4  # times as many steps at most, where that is not kept


@one_thread
@numbers_told()
def fit(model: Model, runs: Sequence[Experiment] | Experiment, *, solver: Any = None, start: str = "auto",
        engine: str | Engine = "rosenbrock", formulation: str = "plain",
        priors: Mapping[str, tuple[float, float]] | None = None, penalties: Sequence[Any] = (),
        constraints: Sequence[Any] = (), loss: Any = None, weights: str | None = None, initial: str = "auto",
        window: str | float | None = "auto", callback: Callback = None) -> Fit:
    """Estimate the free parameters of `model` from `runs`; no first guess is asked for.

    Parameters
    ----------
    model : Model
        E.g. ``mi.dc_motor() + mi.effects.coulomb``. Values set by ``replace`` are the start, fixed ones stay.
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
    window : {"auto"}, float or None
        Simulate the records in windows of so many seconds, each from an estimated state; None: as a whole.
        ``"auto"``: as a whole, unless the model does not follow them and would carry any small error too far, as
        a pendulum does that a controller holds upright (truncated simulation error: Forgione & Piga, IFAC-PapersOnLine
        54(7), 2021). `Fit.window` says what was done, `evaluate` and `diagnose` do the same.
    callback : callable, optional
        ``callback(iteration, cost, q)``.

    Raises
    ------
    UsageError, ModelError, DataError, FitError
        The words or the data were wrong, or the model cannot be simulated at any starting point.

    Notes
    -----
    A plain motor takes one least-squares run. A model with a smooth sgn (friction) takes one per width of it, usually
    three. An effect over the angle whose order is not given takes the fit without it, one along the measured angle, and
    its own: three, or nine with friction. An effect that contains a simpler one takes the fit with that, and a short
    run from either start. Where much more than noise is left the model is fitted without each of its effects, too, and
    begins again from there if that costs less; with a lag of the driver or of the current's sensor it begins again with
    that in the winding's place. Further runs come only where the first guess is worse than none, an end is in doubt, a
    parameter has collapsed, one channel is far further from its noise than another, or the sub-steps do not suit.

    Examples
    --------
    >>> fit = mi.fit(mi.dc_motor() + mi.effects.coulomb, runs)
    >>> fit
    <fit of dc_motor + coulomb: fits, NRMSE i 1.68 %, omega 0.82 %>
    """
    if formulation not in ("plain", "penalty"):
        raise UsageError(one_of(formulation, ("plain", "penalty"), "formulation") + " For hard constraints use "
                         "solver=mi.MultipleShooting().")
    if constraints and formulation == "plain" and not hasattr(solver, "solve"):
        raise UsageError("constraints need a solver that honours them: solver=mi.MultipleShooting(), or "
                         "formulation='penalty' to weigh them.")
    if not (window is None or isinstance(window, int | float) or str(window) == "auto"):
        raise UsageError(one_of(name_of(window), ("auto",), "window") + " Or give a time in seconds, or None.")
    if isinstance(window, int | float):
        runs = [part for run in ([runs] if isinstance(runs, Experiment) else runs) for part in windows(run, window)]
    penalties = tuple(penalties)
    if odd := [p for p in (*penalties, *constraints) if not hasattr(p, "evaluate") or isinstance(p, type)]:
        raise UsageError(f"penalties and constraints are like mi.CurrentLimit(8), mi.Constraint(…), not {odd[0]!r}.")
    if formulation == "penalty":
        penalties, constraints = penalties + (tuple(constraints) or (SteadyState(),)), ()
    problem = as_problem(model, runs, engine=engine, priors=dict(priors or {}), penalties=penalties, loss=loss,
                         constraints=tuple(constraints), initial=initial,
                         weights=weights or ("rms" if formulation == "penalty" else "noise"))
    if unset := problem.model.without_value:
        raise ModelError(f"{listed(unset)} {'is' if len(unset) == 1 else 'are'} to be fixed, but at which value? "
                         f"Give it, in SI units: model.fix({unset[0]}=…).")
    own = [n for n, p in problem.model.parameters.items() if p.vary and p.per_run]
    if own and len(problem.experiments) > 1 and not problem.unknowns.apart:
        warnings.warn(f"{listed(own)} differs between records; these are parts of one, and it stays.", stacklevel=3)
    with progress(text := f"Fitting {problem.model.title}", short=True) as advance:
        again = partial(solve, solver=solver, formulation=formulation, callback=lambda k, *rest: (
            advance(1, f"{text}: iteration {k}"), callback and callback(k, *rest)))
        found = again(problem, start=start)
        if window == "auto" and start == "auto" and not hasattr(solver, "solve"):
            found = in_windows(found, again) or found
    _ = found.evaluation, found.std  # kept with the fit: showing it then computes nothing
    return found


@one_thread
@numbers_told()
def solve(problem: Problem, solver: Any = None, *, start: str = "auto", callback: Callback = None,
          formulation: str = "plain") -> Fit:
    """Solve a `Problem`; `fit` is this with the problem made on the way. See there.

    Examples
    --------
    >>> fit = mi.solve(mi.Problem(mi.dc_motor(), runs, weights="rms"))
    """
    began = time.perf_counter()
    check_solver(solver)
    among(start, ("auto", "model"), "start")
    if not problem.unknown:
        raise UsageError("every parameter is fixed, there is nothing to fit. Free one, model.free('R'), or judge "
                         "the model as it is: mi.evaluate(model, runs).")
    auto = start == "auto"
    effort: Any = solver or FINISH
    if problem.unknowns.apart and hasattr(effort, "solve"):
        raise UsageError("multiple shooting knows no parameters per run: leave the solver out, or the effect.")
    if auto and any(p.unit == "rad" for *_, p in problem.unknowns.apart):
        alone = solve(problem.with_(experiments=problem.experiments[:1]))
        problem, auto = with_angles_apart(problem.start_at(alone.values)), False
    if auto:
        problem = _with_orders(problem)
    if hasattr(effort, "solve"):
        return effort.solve(with_start_values(problem) if auto else problem)
    if problem.constraints:
        raise UsageError("LevenbergMarquardt has no true constraints; use solver=mi.MultipleShooting().")
    return _fit(problem, effort, callback, auto=auto, formulation=formulation, began=began)


def check_solver(solver: Any) -> None:
    """Refuse what is no solver."""
    if isinstance(solver, type) or not (isinstance(solver, LevenbergMarquardt | None) or hasattr(solver, "solve")):
        raise UsageError("solver takes mi.LevenbergMarquardt() (the default) or mi.MultipleShooting(), not a name; "
                         f"got {name_of(solver)}.")


def _fit(problem: Problem, effort: LevenbergMarquardt, callback: Callback = None, *, auto: bool = True,
         formulation: str = "plain", began: float = 0.0) -> Fit:
    """Fit with the orders over the angle that the model has: start values, minimum, polish; covariance by slopes."""
    asked = problem
    if auto:
        problem = with_start_values(problem)  # first guess, race of starts
        effort = replace(effort, looks=min(effort.looks, 1))  # a misfit from there is the model's, not the start's
    descend = partial(minimise, callback=callback, wide=auto)  # continuation, restarts, reweighting
    found = race([problem.within_worth()], effort, solve=descend) or descend(problem, effort)  # best without ringing
    found = replace(found, problem=found.problem.tuned(engine=problem.engine))
    if auto:
        found = no_worse_than_smaller(found, asked, effort)
    found, error = _polished(found, effort, callback)  # finer sub-steps
    problem, q = found.problem, found.problem.unknowns.principal(found.q)
    status, message = _said(found, error)
    fit = Fit(problem, problem.values(q), found.solution.residual, found.solution.jac / problem.scaling.slope(q), q,
              status, message, found.history, time.perf_counter() - began, error, formulation)
    _ = fit.simulations  # nothing is computed for them now
    problem.forget()
    return fit


def _with_orders(problem: Problem) -> Problem:
    """Return the problem started at the orders over the angle that the records show: of what a fit without the effects
    of unknown order leaves, the strongest line gives order, size and phase of one of them, and so on with the next."""
    model = present = problem.model
    waiting = effects_of_unknown_order(model)
    zeros = [e for e in model.effects if e.name == "encoder_zero" and "theta" not in problem.outputs]
    for effect in (*waiting, *(zeros if waiting else ())):  # a zero is seen by what it shifts alone
        present = present.without(effect.name)
    while waiting:
        if not (smaller := problem.for_model(present).tuned(constraints=())).unknown:  # an order shows without them
            break
        fit = otherwise(None, FAILURES, partial(_fit, smaller, FINISH))
        if fit is None or (found := strongest_order(fit, waiting)) is None:
            break
        effect, values = found
        model, present = model.start_at({**fit.values, **values}), (fit.model + effect).start_at(values)
        waiting.remove(effect)
    return problem.for_model(model)


def minimise(problem: Problem, effort: LevenbergMarquardt, callback: Callback = None, *, wide: bool = True) -> Estimate:
    """Minimise the cost from the values of the model: continuation, restarts, reweighting; see `by_continuation`."""
    found = restore_collapsed(by_continuation(problem, effort, callback, wide=wide), effort)
    effort = replace(effort, looks=0)
    for k in range(REWEIGHTINGS):
        if (factors := _reweighted(found)) is None:
            break
        begin = found.problem.start_at(found.values) if k else problem
        again = by_continuation(begin.tuned(noise_factors=factors), effort, callback, wide=wide and k == 0)
        again = restore_collapsed(again, effort)
        found = replace(again, history=found.history + again.history)
    return found


def no_worse_than_smaller(found: Estimate, asked: Problem, effort: LevenbergMarquardt) -> Estimate:
    """Return an estimate that, where it leaves more than noise, costs no more than without one of its effects. A model
    contains the smaller one: where that, begun as `asked`, ends lower, this one is in a side valley, and begins again
    from there. The other side of a lag beside the winding's is tried as well."""
    begin, left = found.onward, max(misfit_over_noise(found.problem, found.q).values(), default=0.0)
    if left > NOISE and (poles := [s for e in begin.model.effects for s in exchanged_poles(begin.model, e)]):
        again = race(map(begin.start_at, poles), effort, solve=by_continuation)
        if again is not None and again.cost < found.cost:
            found = replace(again, history=found.history + again.history)
    problem, sizes = found.problem, natural_sizes(found.problem.experiments, found.values)
    if not max(misfit_over_noise(problem, found.q).values(), default=0.0) > IMBALANCE:
        return found
    for effect in problem.model.effects:
        with contextlib.suppress(*FAILURES):
            smaller = asked.for_model(asked.model.without(effect.name)).tuned(noise_factors=problem.noise_factors)
            smaller = smaller.within_worth() if problem.worth_its_steps else smaller
            end = restore_collapsed(by_continuation(with_start_values(smaller), effort), effort)  # in the same weights
            if end.cost > found.cost:
                continue
            fresh = {p.name: suited(p, sizes).value for p in effect.parameters if p.vary and not p.given}
            vanishing = [p.name for p in effect.parameters if p.null == 0]
            weak = {n: NEXT_TO_NOTHING * value for n, value in fresh.items() if n in vanishing}
            there = end.onward.tuned(width=problem.width, engine=problem.engine)
            starts = [there.for_model(problem.model.start_at(end.values | fresh | size)) for size in ({}, weak)]
            if (again := race(starts, effort, solve=by_continuation)) is not None and again.cost < found.cost:
                found = replace(again, history=found.history + again.history)
    return found


def _reweighted(found: Estimate) -> dict[str, float] | None:
    """Return factors on the noise of each channel where the model fails: their misfit; None where the weights suit.

    A model that cannot reach the noise would otherwise spend itself on the channel with the smallest noise
    (an encoder), at any price in the others. Noise and misfit together give the maximum of the likelihood
    with the channels' variances as unknowns, ``Σ n·ln(SSR)`` (Seber & Wild, Nonlinear Regression, 1989, ch.
    11); a model that reaches the noise keeps the weights of the noise."""
    if (problem := found.problem).weights != "noise" or problem.loss is not None or len(problem.outputs) < 2:
        return None
    factors = misfit_over_noise(problem, found.q)
    relative = [factors[c] / problem.noise_factors.get(c, 1.0) for c in factors]
    return factors if max(relative) >= IMBALANCE * min(relative) else None


def _polished(found: Estimate, effort: LevenbergMarquardt, callback: Callback) -> tuple[Estimate, float]:
    """Return the estimate and its integration error; with finer steps all over where small errors added up."""
    problem, misfit = found.problem, max(_misfit(found), 1.0)
    error, bias = integration_bias(problem, found.q, found.solution.jac)
    finer = np.ceil(max(2 * error / (ERROR_SHARE * misfit), bias / (BIAS * misfit)) ** (1 / ORDER))
    if not finer > 1 or found.solution.status != "converged":
        return found, error
    problem = problem.with_finer_steps(int(min(finer, MOST_FINER)))
    again = otherwise(None, FAILURES, lambda: least_squares(problem, effort, callback, q=found.q, refine=False))
    return (found, error) if again is None else (
        replace(again, history=found.history + again.history), integration_error(problem, again.q))


def _misfit(found: Estimate) -> float:
    return float(np.sqrt(np.mean(found.solution.residual[:found.problem.n_outputs] ** 2)))


def _said(found: Estimate, error: float) -> tuple[str, str]:
    """Return the status, and the message with what to try. Of a rugged cost (friction) noise is converged, too."""
    problem, status, message = found.problem, found.solution.status, found.solution.message
    if status == "stalled" and problem.weights == "noise" and \
            max(misfit_over_noise(problem, found.q).values(), default=np.inf) <= NOISE:
        status, message = "converged", "converged: the misfit is noise, and no step lowers it"
    if status == "converged" and error > max(1.0, ERROR_SHARE * _misfit(found)):
        message += f"; but the integration error is {error:.2g} times the noise: try engine='cvodes' or a finer record"
    return status, f"{message}."


def follows(fit: Fit) -> bool:
    """Tell whether a fit explains three quarters of the variance of each channel, or leaves noise alone there."""
    left, whole = dict.fromkeys(fit.nrmse, 0.0), dict.fromkeys(fit.nrmse, 0.0)
    for s in fit.simulations:
        for c in (c for c in left if c in s.experiment.outputs):
            y = s.experiment.outputs[c]
            left[c] += float(np.nansum(s.residual(c) ** 2))
            whole[c] += float(np.nansum((y - np.nanmean(y)) ** 2))
    return all(left[c] < UNFOLLOWED * whole[c] or fit.misfit.get(c, np.inf) < NOISE for c in left)


def lost(fit: Fit) -> bool:
    """Tell whether a fit is so far from its records that neither its values nor slopes there lead anywhere: from the
    motion, where that was measured. A current that no model comes near leaves slopes along the motion as they are."""
    return largest({c: error for c, error in fit.nrmse.items() if c != "i"} or fit.nrmse) > LOST


def in_windows(fit: Fit, solve: Callable[[Problem], Fit] = solve, drifts: bool = False) -> Fit | None:
    """Return the fit of the same model in the longest windows that it follows, if it amplifies errors; else None.

    Of records that it follows as a whole only where it leaves noise there, and more than that on the whole: a detent
    that catches the motor or not turns on what no sensor shows. `solve` fits a problem. What `drifts` sums up a small
    error of a force instead, and only windows that it follows are asked for."""
    problem, model = fit.problem, fit.model.with_(angle_input=False)
    whole = follows(fit) and not fit.model.angle_input and not drifts
    longest = max(r.duration for r in problem.experiments)
    if fit.window is not None or problem.initial != "auto" or any(map(uses_angle, model.effects)) is drifts:
        return None  # a torque that does not know the angle cannot drive a small error on; one that does holds an axis
    if whole and (leaves_noise(fit) or growth(fit) < TOO_FAR):
        return None
    for count in WINDOWS:
        enough = [r for r in problem.experiments if r.n > FEWEST * count]
        runs = tuple(p for r in enough for p in windows(r, longest / count))
        with contextlib.suppress(*FAILURES):
            part = solve(problem.with_(experiments=runs, model=model, noise_factors={})) if runs else None
            if part is not None and follows(part) and (not whole or leaves_noise(part)):
                return part if whole or drifts or growth(part) > TOO_FAR else None
    return None


def over_moments(fit: Fit, solve: Callable[[Problem], Fit] = solve) -> Fit | None:
    """Return the fit of the same model in windows of a few time constants, of long records here and there, where slopes
    lead (Ribeiro et al., Automatica 121, 2020, 109158); None for one that is not far off, or of too short records."""
    v, runs, model = {"R": 1.0, "K": 0.0, **fit.values}, fit.problem.experiments, fit.model.with_(angle_input=False)
    seconds = MOMENT * v["J"] * v["R"] / (v["b"] * v["R"] + v["K"] ** 2 or np.inf)  # none without friction
    shortest, longest = MIN_MOMENT * max(r.dt for r in runs), min(r.duration for r in runs)
    if lost(fit) and seconds > 0 and not shortest < seconds < longest / 2:  # its time constants are those of no motor
        seconds = longest / MIN_MOMENT
    if not shortest < seconds < longest / 2 or (follows(fit) and not lost(fit)):
        return None
    whole = (r.with_(meta={k: x for k, x in r.meta.items() if k != "window"}) for r in runs)
    parts = [p for r in whole for p in windows(r, seconds)]
    some = tuple(parts[k] for k in np.unique(np.linspace(0, len(parts) - 1, MOST_MOMENTS).round().astype(int)))
    problem = fit.problem.with_(experiments=some, model=model, initial="auto", noise_factors={})
    return otherwise(None, FAILURES, lambda: solve(problem))


def leaves_noise(fit: Fit) -> bool:
    """Tell whether the errors of a fit are no larger than the noise of the sensors."""
    return max(fit.misfit.values(), default=0.0) < NOISE


def growth(fit: Fit) -> float:
    """Return how many times a small error in the state, each in its RMS, grows at most along the records."""
    runs, model = fit.problem.experiments, fit.model.with_(angle_input=False)
    longest = max(r.duration for r in runs)
    parts = [windows(r, longest / max(WINDOWS)) if fit.window is None and r.n > FEWEST * max(WINDOWS) else [r]
             for r in runs]
    problem = fit.problem.with_(experiments=tuple(p for each in parts for p in each), model=model, priors={})
    ends = set(np.cumsum([len(each) for each in parts])) if fit.window is None else {
        k for k, (a, b) in enumerate(pairwise(runs), 1) if b.t[0] < a.t[-1]}
    problem = problem.refined(problem.start)
    at, one = problem.unknowns.point(problem.start), np.eye(len(problem.system.states))
    along = one, np.zeros((len(at.p), len(one)))  # derivatives by the first state, at fixed parameters
    starts = [problem.unknowns.first_state(at, k) for k in range(len(problem.runs))]
    walks: list[Any] = [problem.integrator.run(problem.system, run.grid, x0, at.p, *along)
                        for run, x0 in zip(problem.runs, starts, strict=True)]
    size = np.sqrt(np.mean(np.concatenate([walk.x for walk in walks]) ** 2, axis=0)) + 1e-300
    worst, through = 1.0, one
    for k, walk in enumerate(walks, 1):
        through = (walk.dx[-1] * size / size[:, None]) @ through
        worst = max(worst, float(np.linalg.norm(through, 2)))
        through = one if k in ends else through
    return worst
