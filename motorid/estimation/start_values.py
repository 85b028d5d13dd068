"""Where a fit begins: the motor from the records, its effects from natural sizes and a few shapes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from motorid.effects import LIBRARY
from motorid.errors import FitError, ModelError, SimulationError
from motorid.estimation.angle_orders import Line, likely_lines
from motorid.estimation.continuation import descend, without_width
from motorid.estimation.first_guess import first_guess, loads_of
from motorid.estimation.linearisation import Tangent
from motorid.estimation.result import Fit
from motorid.model.definition import Effect, Parameter
from motorid.model.model import BASES, Model
from motorid.numerics.least_squares import LevenbergMarquardt, levenberg_marquardt
from motorid.problem.problem import Problem
from motorid.problem.runs import natural_sizes, suited
from motorid.records.experiment import Experiment

THOROUGH = LevenbergMarquardt(ftol=1e-5, max_iterations=60)
ABOVE = 1.3  # times: where a size starts that is at least another
STEPS = 4  # that tell which of two starts is the nearer
FEW = 3  # shapes that are looked at more closely
RESONANCE = "1/s"
BACK_EMF_SHARES = (0.3, 0.03)
PHASES = tuple(np.arange(4) * np.pi / 2)


def started(problem: Problem) -> Problem:
    """Return the problem with starting values that suit the data: the best of a few candidates by cost."""
    model, runs = problem.model, problem.experiments
    candidates = [_at(model, first_guess(model, runs))]
    if any(p.given for p in model.parameters.values()) or _was_fitted(model):
        candidates.append(model)
    loaded = any(e.balance == "torque" for e in model.effects)
    if loaded:
        candidates.append(_at(model, first_guess(model, runs, loaded=True)))
    problems = [problem.for_model(with_suited_effects(m, runs)) for m in candidates]
    k = int(np.argmin([_cost_of(p) for p in problems])) if len(problems) > 1 else 0
    best = _along_measured_angle(problems[k], candidates[k])
    for effect in model.effects:
        best = _shaped(best, effect, candidates[k])
    best = _from_simpler(best, candidates[k])
    return _split(best, model) if loaded else best


def _along_measured_angle(problem: Problem, asked: Model) -> Problem:
    """Return the problem started where the measured angle, or the integral of the speed, leads an effect of the turn.

    While the model's own angle is still wrong by a period, its cogging pushes the wrong way.
    """
    orders = any(p.order for e in problem.model.effects for p in e.parameters)
    if not orders or not all({"theta", "omega"} & set(r.outputs) for r in problem.experiments):
        return problem
    led = problem.for_model(replace(problem.model, angle_input=True, _systems={}))
    for effect in problem.model.effects:
        led = _shaped(led, effect, asked)
    try:
        done = descend(led, THOROUGH)
    except FitError:
        return problem
    found = problem.for_model(problem.model.start_at(without_width(done.problem, done.solution.q)))
    if all("theta" in r.outputs for r in problem.experiments):
        return min(found, problem, key=_cost_of)
    return min(found, problem, key=_end_of)  # an integral drifts: where either leads decides


def _end_of(problem: Problem) -> float:
    """Return the cost to which a descent from here leads."""
    try:
        return descend(problem, THOROUGH).history[-1]
    except FitError:
        return np.inf


def _from_simpler(problem: Problem, asked: Model) -> Problem:
    """Return the problem started where a simpler effect leads that one of the model's contains, if that is nearer.

    From a first guess that takes all friction for viscous, bristles or a Stribeck curve find no way; Coulomb does.
    """
    for effect in asked.effects:
        simpler = next((LIBRARY[n] for n in effect.includes if all(p.null == 0 for p in LIBRARY[n].parameters)), None)
        if simpler is None or len(_untouched(asked, effect)) < len(effect.parameters):
            continue
        try:
            done = descend(started(problem.for_model(asked.without(effect.name) + simpler)), THOROUGH)
        except (FitError, ModelError):
            continue
        values = without_width(done.problem, done.solution.q)
        level = max(values[p.name] for p in simpler.parameters)
        other = problem.for_model(problem.model.start_at({**values, **sizes_like(effect, level)}))
        looks = [_look(begin.refined(begin.start), STEPS) for begin in (problem, other)]
        problem = min(looks, key=lambda look: look[0])[1]
    return problem


def sizes_like(effect: Effect, level: float, above: float = ABOVE) -> dict[str, float]:
    """Return the sizes of an effect in the place of a simpler one of size `level`.

    Sizes that are at least another start at `above` times that.
    """
    return {p.name: level * (above if p.at_least else 1.0) for p in effect.parameters if p.null == 0}


def _split(problem: Problem, asked: Model) -> Problem:
    """Return the problem with back-EMF and viscous friction shared out as suits the data best.

    Without a current a linear motor leaves this open; a loss that is a share of the motor's torque does not.
    """
    model, runs = problem.model, problem.experiments
    open_ = model.base == "dc_motor" and "i" not in problem.outputs and not _was_fitted(asked)
    if not open_ or asked.parameters["K"].given or not any(load.ratio for load in loads_of(asked)):
        return problem
    others = [problem.for_model(_at(model, first_guess(asked, runs, loaded=True, back_emf=share)))
              for share in BACK_EMF_SHARES]
    ends = []
    for begin in (problem, *others):
        try:
            ends.append(descend(begin.for_model(begin.model.fix("R")), THOROUGH))
        except FitError:
            continue
    if not ends:
        return problem
    best = min(ends, key=lambda done: done.history[-1])
    return problem.for_model(problem.model.start_at(without_width(best.problem, best.solution.q)))


def _at(model: Model, values: Mapping[str, float]) -> Model:
    limits = model.parameters
    return model.start_at({n: float(np.clip(v, limits[n].lower, limits[n].upper)) for n, v in values.items()})


def _was_fitted(model: Model) -> bool:
    present = ((model.parameters[p.name], p) for p in BASES[model.base])
    return any(now.value != declared.value and not now.given for now, declared in present)


def _cost_of(problem: Problem) -> float:
    try:
        r = problem.residual(problem.start)
    except SimulationError:
        return np.inf
    cost = float(r @ r)
    return cost if np.isfinite(cost) else np.inf


def with_suited_effects(model: Model, runs: Sequence[Experiment]) -> Model:
    """Return the model with starting values of its effects' parameters that suit the data."""
    if not model.effects:
        return model
    sizes = natural_sizes(runs, model.values)
    untouched = (p for e in model.effects for p in _untouched(model, e))
    return model.start_at({p.name: suited(p, sizes).value for p in untouched})


def _untouched(model: Model, effect: Effect) -> list[Parameter]:
    """Parameters of an effect that still have the value they were declared with."""
    here = ((model.parameters[p.name], p) for p in effect.parameters)
    return [now for now, declared in here if now.value == declared.value and not now.given]


def _shaped(problem: Problem, effect: Effect, asked: Model) -> Problem:
    """Return the problem started at the best of the shapes of `effect`: one step from each, more from a few.

    Phases and resonances have side valleys; a descent finds knees, lags and heat capacities by itself.
    """
    shapes = list(_shapes(problem, effect, asked))
    if len(shapes) < 2:
        return problem
    problem = problem.refined(problem.start)
    looks = [_look(problem.for_model(problem.model.start_at(s)), 1) for s in shapes]
    for iterations in (2, 4):
        looks = sorted(looks, key=lambda look: look[0])[:FEW]
        looks = [_look(here, iterations) for _, here in looks]
    return min(looks, key=lambda look: look[0])[1]


def _look(problem: Problem, iterations: int) -> tuple[float, Problem]:
    """Return the cost after a few steps, and the problem started there."""
    options = LevenbergMarquardt(max_iterations=iterations)
    try:
        found = levenberg_marquardt(problem.residual, problem.residual_and_jacobian, problem.start,
                                    problem.scaling.bounds, options, None, problem.scaling.log)
    except (FitError, SimulationError):
        return np.inf, problem
    return found.history[-1], problem.for_model(problem.model.start_at(problem.values(found.q)))


def _shapes(problem: Problem, effect: Effect, asked: Model) -> Iterator[dict[str, float]]:
    sizes = natural_sizes(problem.experiments, problem.model.values)
    axes = []
    for p in _untouched(asked, effect):
        if p.vary and (p.periodic or p.unit == RESONANCE):
            values = PHASES if p.periodic else [g * sizes[p.unit] for g in p.grid]
            axes.append([(p.name, float(np.clip(v, p.lower, p.upper))) for v in values])
    return (dict(choice) for choice in product(*axes)) if axes else iter(())


def numbered(problem: Problem, solve: Callable[[Problem], Fit]) -> Problem:
    """Return the problem with the orders that the records show, started at them.

    The model is solved without the effects of unknown order; the strongest line of what is left over the angle
    gives the order, size and phase of one of them, and so on with the next.

    Parameters
    ----------
    problem : Problem
    solve : callable
        How to fit a smaller problem.
    """
    model = problem.model
    waiting = [e for e in model.effects if _open(model, e)]
    if not waiting:
        return problem
    present = model
    for e in waiting:
        present = present.without(e.name)
    while waiting:
        smaller = problem.for_model(present).tuned(constraints=())  # an order shows without them
        if not smaller.unknown:
            break
        try:
            fit = solve(smaller)
        except FitError:
            break
        tangent = Tangent.of(fit)
        lines = [(e, line) for e in waiting for line in likely_lines(tangent, e, 1)]
        if not lines:
            break
        effect, line = max(lines, key=lambda pair: pair[1].share)
        found = _values(effect, line)
        model, present = model.start_at({**fit.values, **found}), (fit.model + effect).start_at(found)
        waiting.remove(effect)
    return problem.for_model(model)


def _open(model: Model, effect: Effect) -> bool:
    """Tell whether the effect has an order that nobody has set."""
    pairs = ((p, model.parameters[p.name]) for p in effect.parameters)
    return any(p.order and not now.given and now.value == p.value for p, now in pairs)


def _values(effect: Effect, line: Line) -> dict[str, float]:
    found = {}
    for p in effect.parameters:
        if p.order:
            found[p.name] = line.order
        elif p.periodic:
            found[p.name] = line.phase
        elif p.null == 0:
            found[p.name] = line.amplitude
    return found
