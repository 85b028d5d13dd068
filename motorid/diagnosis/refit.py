"""Trying an effect for real: refit with it, judge it on data that it never saw, refuse what is not identifiable."""

import contextlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from typing import Any

import numpy as np

from motorid.diagnosis.model_comparison import far, size_of
from motorid.diagnosis.predictive_score import QUICK, ROUGH
from motorid.diagnosis.score_test import uses_angle
from motorid.diagnosis.thresholds import MATERIAL, NATS
from motorid.errors import OutOfTime, otherwise
from motorid.estimation.continuation import by_continuation, collapsed_again, past_ripples, restored, sharpened
from motorid.estimation.fit import LOST, lost
from motorid.estimation.least_squares import FAILURES, Estimate, cost_at
from motorid.estimation.linearisation import Tangent
from motorid.estimation.result import Fit
from motorid.estimation.start_values import ABOVE, exchanged_poles, first_guess, sizes_like
from motorid.model.definition import Effect
from motorid.model.model import Model
from motorid.numerics.least_squares import LevenbergMarquardt
from motorid.numerics.parallel import interruption
from motorid.numerics.signals import Array
from motorid.problem.problem import Problem
from motorid.problem.runs import combined, natural_sizes, shapes_of, with_inputs
from motorid.problem.simulate import largest, misfit_over_noise

BEGIN, RACE = (LevenbergMarquardt(max_iterations=n, ftol=1e-3, xtol=1e-4, looks=0) for n in (2, 6))
HALVING = 2  # of the starts go on after the first steps (successive halving: Karnin, Koren & Somekh, ICML 2013)
POLISH = LevenbergMarquardt(max_iterations=60, ftol=1e-3, xtol=1e-5, looks=0, patience=10, crawl=3.0)
TOLD = 0.1  # nats that a step must gain: less tells no two models apart
OPTIMUM = LevenbergMarquardt(max_iterations=60, ftol=1e-5, xtol=1e-5, looks=0)
GOING_ON = 4  # descents at most: the last one ended at its limit, or what it left asks for a finer end
ROOM = 10.0  # factor beyond its grid that a shape parameter may run to
EXCHANGED = 1.5  # times another value of a lag: fewer is the same valley
ALONE = 0.1  # of an answer: what is left of it without the others', if these do the same
QUICKLY = partial(by_continuation, effort=QUICK, wide=False, narrow=False)  # nearly to the end
WORSE = 1.02  # of the cost along the measured angle: the model's own angle must do as well
SHAKEN = 1e-3  # of the travel: a small change of the measured angle
SHAKES = 20  # places at which it is drawn


@dataclass(frozen=True, eq=False)
class Raced:
    """The best of several starts of one model after a few steps: its cost, and what an undamped step promises."""

    problem: Problem
    cost: float
    reach: float
    angular: bool


def raced(fit: Fit, model: Model, starts: Sequence[Mapping[str, float]]) -> Raced | None:
    """Go a few steps from each start with `model` on the records of `fit`; None if none can be simulated. Where no
    start can be (a friction that sticks at every turn), the values of `fit` are one: the smaller model could. Effects
    of the angle start along the measured angle, which the model's own, still wrong, would lead astray."""
    model = _bounded(fit, model)
    poles = [pole for e in model.effects if e.name not in fit.model.effect_names for pole in exchanged_poles(model, e)]
    alive, starts = restored(fit, model), starts or ({},)
    before = [e for e in fit.model.effects if e.name != "encoder_zero"]  # which alone moves nothing
    angular = any(map(uses_angle, model.effects)) and not any(map(uses_angle, before))
    # As it is where a parameter put back (an inductance that no sample shows) makes the model too stiff.
    models = (alive,) if alive is model else (alive, model)
    # A guess of the larger model's own, along the records, is no longer led astray.
    entries = [(start, angular) for start in (*starts, *poles)] + [
        (start, along) for start in _own_starts(fit, model, starts) for along in sorted({angular, False})]
    first = BEGIN if len(entries) > FINISHED else RACE
    each = ((_begun(fit, models, start, along, first), along) for start, along in entries)
    if not (begun := [(done, along) for done, along in each if done is not None]) and any(starts):
        return raced(fit, model, ())
    begun.sort(key=lambda entry: entry[0].cost)
    ahead = begun[: max(-(-len(begun) // HALVING), FINISHED)]
    found = begun if first is RACE else [(_race(done.onward, RACE) or done, along) for done, along in ahead]
    best, along = min(found, key=lambda entry: entry[0].cost, default=(None, False))
    return best and Raced(best.onward, float(best.cost), _undamped(best.solution.residual, best.solution.jac), along)


def _begun(fit: Fit, models: Iterable[Model], start: Mapping[str, float], along: bool,
           effort: LevenbergMarquardt) -> Estimate | None:
    """Go the first steps from a start with the first model that can take it; None if none can."""
    for model in models:
        with contextlib.suppress(*FAILURES):
            if (done := _race(_started(fit, model, start, along), effort)) is not None:
                return done
    return None


def _undamped(r: Array, jac: Array) -> float:
    """Return the cost that one undamped step promises."""
    triangle: Array = np.asarray(np.linalg.qr(np.column_stack([jac, r]), mode="r"))
    return 0.5 * float(np.sum(triangle[jac.shape[1] :, -1] ** 2))


def finished(fit: Fit, best: Raced, effort: LevenbergMarquardt) -> Fit | None:
    """Return the refit that a race began, converged with `effort`, along the model's own angle; None for none."""
    stages = "sgn_width" in best.problem.model.parameters and "sgn_width" not in fit.model.parameters
    along = partial(_released, best.problem) if best.angular else partial(QUICKLY, best.problem, wide=stages)
    done = otherwise(None, FAILURES, along)
    return done and _polished(fit, collapsed_again(done.onward, fit), effort)


def refit(fit: Fit, model: Model, starts: Sequence[Mapping[str, float]]) -> Fit | None:
    """Return the best refit of `model` on the records of `fit` from several starts, at or near its optimum, or None."""
    best = raced(fit, model, starts)
    return None if best is None else finished(fit, best, POLISH if fit.window else OPTIMUM)


def _released(measured: Problem) -> Estimate:
    """Let the model's own angle take the place of the measured one, if good enough, or copied; raises as a fit."""
    own = measured.model.with_(angle_input=False)
    if not all("theta" in run.outputs for run in measured.experiments):
        return QUICKLY(measured.for_model(own))
    along = QUICKLY(measured)
    if copies_the_angle(along.problem, along.q):
        first = {n: measured.model.parameters[n].value for n in measured.model.free_names}
        return QUICKLY(measured.for_model(own.start_at(first)))
    return _on_its_own(along, QUICKLY)


def _on_its_own(along: Estimate, descent: Callable[[Problem], Estimate]) -> Estimate:
    """Return the estimate along the model's own angle, if that does as well as along the measured one."""
    model = along.problem.model
    with contextlib.suppress(*FAILURES):
        own = along.onward.for_model(model.with_(angle_input=False).start_at(along.values))
        if model.angle_input and (free := descent(own)).cost < WORSE * along.cost:
            return free
    return along


def copies_the_angle(problem: Problem, q: Array) -> bool:
    """Tell whether the simulated angle copies the measured one that goes in: shaken a little, it does so, to half."""
    if not (problem.model.angle_input and all("theta" in run.experiment.outputs for run in problem.runs)):
        return False
    rng, runs, shakes = np.random.default_rng(0), [], []
    for run in problem.runs:
        theta = run.experiment.outputs["theta"]
        knots = np.linspace(run.experiment.t[0], run.experiment.t[-1], SHAKES)
        shakes.append(SHAKEN * np.nanstd(theta) * np.interp(run.experiment.t, knots, rng.standard_normal(SHAKES)))
        shaken = run.experiment.with_(outputs={**run.experiment.outputs, "theta": theta + shakes[-1]})
        runs.append(with_inputs(replace(run, experiment=shaken), problem.system.inputs))
    there, column = problem.with_runs(tuple(runs)), problem.outputs.index("theta")
    moved = [p.simulate(q, k, derivatives=False).y[:, column] for p in (problem, there) for k in range(len(runs))]
    answer, shake = np.concatenate(moved[len(runs):]) - np.concatenate(moved[:len(runs)]), np.concatenate(shakes)
    return bool(np.linalg.norm(answer - shake) < 0.5 * np.linalg.norm(shake))


def _own_starts(fit: Fit, model: Model, starts: Sequence[Mapping[str, float]]) -> list[dict[str, float]]:
    """Return `starts` with the larger model's own first guess, where the smaller one's fit is no place to begin (an arm
    without its weight is fitted by a motor that hardly moves): the best alone where only the current is far off."""
    if largest(fit.nrmse) > LOST:
        with contextlib.suppress(*FAILURES):
            guess = first_guess(model, fit.problem.experiments, loaded=True)
            return [{**start, **guess} for start in (starts if lost(fit) else starts[:1])]
    return []


def _started(fit: Fit, model: Model, start: Mapping[str, float], angular: bool) -> Problem:
    """Return the problem of a refit, at its start."""
    own = {n: max(v, 1e-12) if model.parameters[n].positive else v for n, v in start.items() if n in model.parameters}
    problem = fit.problem.for_model(model.start_at(own)).tuned(accuracy=ROUGH)
    apart = {**{n: v for n, v in start.items() if n not in model.parameters}, **fit.initial}
    problem = problem.begun_at(problem.scaling.scaled([apart.get(p.name, p.value) for p in problem.unknown]))
    return problem.for_model(replace(problem.model, angle_input=True, _systems={})) if angular else problem


def _race(problem: Problem, effort: LevenbergMarquardt) -> Estimate | None:
    """Go a few steps; None where that fails or needs more sub-steps than the samples are worth."""
    with contextlib.suppress(*FAILURES):
        done = by_continuation(problem.within_worth(), effort, wide=False, narrow=False)
        if done.problem.worth_its_steps:
            return replace(done, problem=done.problem.tuned(engine=problem.engine))
    return None


def _bounded(fit: Fit, model: Model) -> Model:
    """Return the model with the shapes of its effects kept within what these records could show."""
    natural = natural_sizes(fit.problem.experiments, fit.values)
    limits = {}
    for e in model.effects:
        for p in (model.parameters[q.name] for q in e.parameters):
            if p.grid and p.null is None and p.vary and not (p.given or p.periodic):
                few, many = (f(shapes_of(p, natural)) for f in (min, max))
                few, many = (2 * few - many, 2 * many - few) if p.place else (few / ROOM, many * ROOM)
                low, high = max(p.lower, few), min(p.upper, many)
                limits |= {p.name: (low, high)} if low < high else {}
    inside = {n: float(np.clip(model.parameters[n].value, *limits[n])) for n in limits}
    pars = {n: replace(model.parameters[n], value=inside[n], lower=lo, upper=hi) for n, (lo, hi) in limits.items()}
    return model.with_(parameters={**model.parameters, **pars})


def _polished(fit: Fit, problem: Problem, effort: LevenbergMarquardt) -> Fit | None:
    """Converge from a good start, channels weighed anew where the misfit has changed: to compare (`POLISH`), or past
    the ripples of a narrow sgn (`OPTIMUM`); roughly where else it takes more sub-steps than samples are worth."""
    with contextlib.suppress(*FAILURES):  # also where the optimum lies at the edge of what can be simulated
        exact = problem.tuned(accuracy=fit.problem.accuracy)
        problem = exact if exact.refined(exact.start).worth_its_steps else problem.tuned(accuracy=ROUGH)
        done = _converged(problem, effort)
        if problem.noise_factors:
            factors = misfit_over_noise(done.problem, done.solution.q)
            if max(abs(np.log(factors[c] / problem.noise_factors.get(c, 1.0))) for c in factors) > 0.1:
                done = _converged(done.onward.tuned(noise_factors=factors), effort)
        return _fit_of(done if effort is POLISH else sharpened(past_ripples(done, effort), effort))
    return None


def led_on(fit: Fit, larger: Fit | None = None) -> Fit | None:
    """Return a refit led on to its optimum, by its own angle if that drifts no more, or from a `larger` one's end."""
    descent, problem, q = partial(by_continuation, effort=OPTIMUM, wide=False), fit.problem, fit.q
    if larger is not None:
        there = {**larger.initial, **larger.values}
        q = problem.scaling.scaled([there.get(p.name, p.value) for p in problem.unknown])
    with contextlib.suppress(*FAILURES):
        if larger is None or cost_at(problem, q) < fit.cost - NATS:
            done = _on_its_own(along := descent(problem.begun_at(q)), descent)
            return _fit_of(done) if done is not along or done.cost < fit.cost else None
    return None


def with_lags_exchanged(fit: Fit) -> dict[str, Fit]:
    """Return, by names of lags, the fit where each has changed places with the winding's own, L/R, and does as well."""
    found, model = {}, fit.problem.model
    free = {n for n, p in model.parameters.items() if p.vary and not p.given}
    for name in (p.name for e in model.effects for p in e.parameters if p.pole and free >= {p.name, "L"}):
        start = {name: fit.values["L"] / fit.values["R"], "L": fit.values[name] * fit.values["R"]}
        with contextlib.suppress(*FAILURES):
            done = by_continuation(fit.problem.start_at(start), OPTIMUM, wide=False)
            other, ends = _fit_of(done), np.abs(np.log([done.values[name] / at[name] for at in (start, fit.values)]))
            if done.cost < fit.cost + NATS and ends[0] < np.log(EXCHANGED) < ends[1] and other and other.std[name]:
                found[name] = other
    return found


def _fit_of(done: Estimate) -> Fit | None:
    found, problem = done.solution, done.problem
    fit = Fit(problem, problem.values(found.q), found.residual, found.jac / problem.scaling.slope(found.q), found.q,
              found.status, found.message, done.history)
    return fit if np.isfinite(found.jac).all() and fit.simulations else None


def _converged(problem: Problem, effort: LevenbergMarquardt) -> Estimate:
    """Descend while a step gains `TOLD` by the samples that the residual is worth: what is unfinished looks worse."""
    history = ()
    for _ in range(GOING_ON):
        done = by_continuation(problem, effort, wide=False, narrow=False)
        done = replace(done, history=history + done.history)
        told = float(np.clip(TOLD / done.problem.worth(done.solution.residual), OPTIMUM.ftol, effort.ftol))
        if done.solution.status != "limit" and told > 0.5 * effort.ftol:
            break
        problem, effort, history = done.onward, replace(effort, ftol=told), done.history
    return done


LITTLE = 1 - (1 - MATERIAL) ** 2  # of the squared misfit; of 361 refits that promised less none was worth it
FINISHED = 2  # models of a race at least: slopes and a few steps do not tell the best two apart
OUTDONE = 1.5  # times the least cost of a race: 20 nats away from a tie at 100 effective samples
BEHIND = 10.0  # times the cost of a model that explains all but noise
FAR_LESS = 0.3  # of the promise that was kept
STOPPED = OUT_OF_TIME, INTERRUPTED = "the time is up", "interrupted"
LESS = "rejected: far behind others after the first steps of a refit"
NOTHING = "rejected: no gain after the first steps of a refit"
FAR_BEHIND = "rejected: {} alone already reaches the noise"
NEARLY = 0.9  # of the best promise: a smaller model with that is the favourite


@dataclass(frozen=True)
class Task:
    """A model to be refitted for an effect, from several starts; `promise` is its drop by a score, if any."""

    fit: Fit
    model: Model
    effect: Effect
    starts: Sequence[Mapping[str, float]]
    promise: float | None = None

    @property
    def added(self) -> tuple[Effect, ...]:
        """The effects that the fit has not."""
        return tuple(e for e in self.model.effects if e.name not in self.fit.model.effect_names)

    @property
    def name(self) -> str:
        """The names of what is added."""
        return " + ".join(e.name for e in self.added)

    @property
    def price(self) -> float:
        """What the free parameters must gain, in units of the cost (half of chi²)."""
        return NATS + 0.5 * size_of(self.model, self.fit.problem) * float(np.log(len(self.fit.residuals)))


@dataclass(frozen=True)
class GivenUp:
    """A refit that was not finished: why, its share of the squared misfit if begun, how to finish it if ever."""

    why: str
    drop: float | None = None
    begun: tuple[Task, Raced] | None = None


def refits(tasks: Sequence[Task], map_: Callable[..., Iterable[Any]]) -> list[Fit | GivenUp | None]:
    """Return the refit of each task on the same records, None where none can be; what time left undone is given up."""
    found: dict[int, Fit | GivenUp | None] = {}
    try:
        _refit_all(tasks, map_, found)
    except (OutOfTime, KeyboardInterrupt) as error:
        interruption.heard()
        why = GivenUp(OUT_OF_TIME if isinstance(error, OutOfTime) else INTERRUPTED)
        found = {k: found.get(k, why) for k in range(len(tasks))}
    return [found.get(k) for k in range(len(tasks))]


def _refit_all(tasks: Sequence[Task], map_: Callable[..., Iterable[Any]],
               found: dict[int, Fit | GivenUp | None]) -> None:
    """Put the refit of each task into `found` as it comes: the one that promises most first, then by their races."""
    races: dict[int, Raced] = {}
    leader, alone = _leader(tasks), False
    if leader is not None and (race := _race_tournament((tasks[leader], alone))) is not None:
        races[leader], found[leader] = race, _finish((tasks[leader], race))
        if alone := _quiet(found[leader]) is not None:
            why, least = GivenUp(FAR_BEHIND.format(tasks[leader].effect.name)), FAR_LESS * (tasks[leader].promise or 0)
            found.update({k: why for k, t in enumerate(tasks) if t.promise is not None and t.promise < least})
    entered = [k for k in range(len(tasks)) if k not in races and k not in found]
    done = map_(_race_tournament, [(tasks[k], alone) for k in entered])
    races |= {k: race for k, race in zip(entered, done, strict=True) if race is not None}
    if races:
        if (first := min(races, key=lambda k: races[k].cost + tasks[k].price)) not in found:
            found[first] = _finish((tasks[first], races[first]))
        if _quiet(found[first]) is not None:
            found.update(_beaten(tasks, {k: race.cost for k, race in races.items()}, first) | found)
        found.update(_outdone(tasks, races, found))
    rest = sorted((k for k in races if k not in found), key=lambda k: races[k].cost)
    found.update(zip(rest, map_(_finish, [(tasks[k], races[k]) for k in rest]), strict=True))


def completed(given_up: Sequence[GivenUp], map_: Callable[..., Iterable[Any]]) -> list[Fit | GivenUp | None]:
    """Return the refits that were only begun, finished; what cannot be stays given up."""
    done = iter(list(map_(_finish, [g.begun for g in given_up if g.begun is not None])))
    return [next(done) if g.begun is not None else g for g in given_up]


def _outdone(tasks: Sequence[Task], races: Mapping[int, Raced], found: Mapping[int, Any]) -> dict[int, GivenUp]:
    """Return the races that an undamped step from their end still leaves far behind, or with nothing gained. Gained is
    what the model without the effect would not reach by such a step itself: a stalled fit promises much."""
    fit, costs, given_up = tasks[0].fit, sorted(race.cost for race in races.values()), {}
    own = _undamped(fit.residuals, fit.jacobian * fit.problem.scaling.slope(fit.q))
    for k, race in races.items():
        nothing = race.reach > (1 - LITTLE) * own and race.cost > (1 - LITTLE) * fit.cost
        if k not in found and (nothing or (race.reach > OUTDONE * costs[0] and race.cost not in costs[:FINISHED])):
            given_up[k] = GivenUp(NOTHING if nothing else LESS, 1 - race.cost / max(fit.cost, 1e-300), (tasks[k], race))
    return given_up


def _leader(tasks: Sequence[Task]) -> int | None:
    """Return which task promises most, the smallest of those that promise nearly as much; None if none does."""
    promises = {k: task.promise for k, task in enumerate(tasks) if task.promise is not None}
    near = [k for k, promise in promises.items() if promise > NEARLY * max(promises.values())]
    return min(near, key=lambda k: (size_of(tasks[k].model, tasks[k].fit.problem), -promises[k]), default=None)


def _quiet(fit: Fit | GivenUp | None) -> Fit | None:
    """Return a fit that leaves hardly more than noise, or None."""
    return fit if isinstance(fit, Fit) and not far(fit) else None


def _beaten(tasks: Sequence[Task], costs: Mapping[int, float], first: int) -> dict[int, GivenUp]:
    """Return which tasks need not be finished beside the one that explains all but noise, and why."""
    winner, given_up = tasks[first], {}
    for k, cost in costs.items():
        drop = 1 - cost / max(winner.fit.cost, 1e-300)
        if cost > BEHIND * costs[first]:
            given_up[k] = GivenUp(FAR_BEHIND.format(winner.effect.name), drop)
        elif winner.effect.name in tasks[k].effect.includes and cost > costs[first] - (tasks[k].price - winner.price):
            given_up[k] = GivenUp(f"no better than {winner.effect.name}, its simpler special case", drop)
    return given_up


def _race_tournament(entry: tuple[Task, bool]) -> Raced | None:
    """Race a task; its best start alone, where only what comes near a winner matters."""
    task, alone = entry
    return raced(task.fit, task.model, task.starts[:1] if alone else task.starts)


def _finish(begun: tuple[Task, Raced]) -> Fit | None:
    return finished(begun[0].fit, begun[1], POLISH)


def widened(fit: Fit, effect: Effect, above: float = ABOVE) -> Task:
    """Return the refit with `effect` in the place of those that it includes, from where they were: sizes that are at
    least another start at `above` times that; a shape is that of the same unit, if there was one."""
    inside = [e for e in fit.model.effects if e.name in effect.includes]
    level = max((fit.values[p.name] for e in inside for p in e.parameters if p.null == 0), default=0.0)
    model = reduce(Model.without, (e.name for e in inside), fit.model) + effect
    natural = natural_sizes(fit.problem.experiments, fit.values)
    sizes = sizes_like(effect, level, above)
    shaped = {p.unit: fit.values[p.name] for e in inside for p in e.parameters if p.null is None and p.vary}
    shapes = {p.name: [shaped[p.unit]] if p.unit in shaped else shapes_of(p, natural)
              for p in effect.parameters if p.null is None and p.grid}
    return Task(fit, model, effect, [{**sizes, **point} for point in combined(shapes)][:8])


def hidden_in(fit: Fit, effect: Effect) -> tuple[str, ...]:
    """Return the parameters whose other values make up for `effect` in the place of those that it contains: for each of
    its sizes alone, where the fit has all equal; empty if nothing else does the same, or not all of them show."""
    task, tangent = widened(fit, effect, 1.0), Tangent.of(fit)
    problem = _started(fit, task.model, task.starts[0], angular=False)
    jac = problem.residual_and_jacobian(problem.start)[1] / problem.scaling.slope(problem.start)
    columns = jac[: problem.n_outputs, [p.name in task.starts[0] for p in problem.unknown]]
    if np.linalg.norm(tangent.off(columns), axis=0).max() * max(task.starts[0].values()) > 1:
        return ()
    own = {p.name for e in fit.model.effects if e.name in effect.includes for p in e.parameters}
    return tuple(n for n in tangent.same_as(columns, ALONE) if n not in own)
