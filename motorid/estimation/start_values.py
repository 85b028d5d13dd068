"""Start values: a first guess of the motor, natural sizes of its effects, and a race where these leave a choice."""

from collections.abc import Sequence

import numpy as np

from motorid.effects import LIBRARY
from motorid.errors import ModelError
from motorid.estimation.continuation import by_continuation
from motorid.estimation.first_guess import first_guess, loads_of
from motorid.estimation.least_squares import LOOK, RACE, Estimate, cost_at, race
from motorid.model.definition import Effect, Parameter
from motorid.model.model import BASES, Model
from motorid.problem.problem import Problem
from motorid.problem.runs import combined, natural_sizes, shapes_of, suited
from motorid.records.experiment import Experiment

ABOVE = 1.3  # times: where a size starts that is at least another
RESONANCE = "1/s"
STOPPED = 100.0  # times the friction and the back-EMF, where friction leaves a hundredth of the motion
LEFT = 0.1  # of an inductance or inertia, where another lag takes the rest
BACK_EMF_SHARES = (0.3, 0.03)
PHASES = tuple(np.arange(4) * np.pi / 2)


def with_start_values(problem: Problem) -> Problem:
    """Return the problem with values that suit the data. From a guess that takes all friction for viscous, bristles or
    a Stribeck curve find no way; Coulomb does: what contains simpler ones races against where the simpler one leads."""
    begin, simpler, inner = _guessed(problem), problem.model, _contained(problem.model)
    try:
        for effect, simple in inner.items():
            simpler = simpler.without(effect.name) + simple
    except ModelError:  # two of them contain the same
        inner = {}
    if not inner:
        return _shared_out(begin, problem.model)
    found = race([_shared_out(_guessed(problem.for_model(simpler)), simpler)], RACE, solve=by_continuation)
    if found is None:
        return begin
    values = found.values
    for effect, simple in inner.items():
        values |= sizes_like(effect, max(found.values[p.name] for p in simple.parameters))
    return _led(begin, race([begin, begin.start_at(values)], LOOK))


def _guessed(problem: Problem) -> Problem:
    """Return the problem at the best of a few guesses, and of the shapes of its effects."""
    model, runs = problem.model, problem.experiments
    candidates = [model.start_at(first_guess(model, runs))]
    if any(p.given for p in model.parameters.values()) or _was_fitted(model):
        candidates.append(model)
    if any(e.balance == "torque" for e in model.effects):
        candidates.append(model.start_at(first_guess(model, runs, loaded=True)))
    problems = [problem.for_model(with_suited_effects(m, runs)) for m in candidates]
    best = problems[0] if len(problems) == 1 else min(problems, key=lambda p: cost_at(p, refine=False))
    asked = candidates[problems.index(best)]
    return _shaped(_along_measured_angle(_better_than_still(best), asked), asked)


def _better_than_still(guess: Problem) -> Problem:
    """Return the problem at its guess, or where that costs more than to predict nothing (an arm without its weight
    swings where the real one hangs) at the better of what it and a motor that friction all but stops lead to."""
    values, b = guess.model.values, guess.model.parameters["b"]
    nothing = 0.5 * sum(float(np.nansum((m.y * m.weights) ** 2)) for m in guess.measured)
    if b.given or not b.vary or cost_at(guess, refine=False) < nothing:
        return guess
    still = guess.start_at({"b": STOPPED * (b.value + values.get("K", 0.0) ** 2 / values.get("R", 1.0))})
    return _led(guess, race([p.within_worth() for p in (guess, still)], LOOK))


def _was_fitted(model: Model) -> bool:
    return any((now := model.parameters[p.name]).value != p.value and not now.given for p in BASES[model.base])


def with_suited_effects(model: Model, runs: Sequence[Experiment]) -> Model:
    """Return the model with starting values of its effects' parameters that suit the data."""
    sizes = natural_sizes(runs, model.values)
    untouched = (p for e in model.effects for p in _untouched(model, e))
    return model.start_at({p.name: suited(p, sizes).value for p in untouched})


def _untouched(model: Model, effect: Effect) -> list[Parameter]:
    """Parameters of an effect that still have the value they were declared with."""
    return [now for p in effect.parameters if (now := model.parameters[p.name]).value == p.value and not now.given]


def _along_measured_angle(problem: Problem, asked: Model) -> Problem:
    """Return the problem started where the measured angle, or the integral of the speed, leads an effect of the turn.
    While the model's own angle is still wrong by a period, its cogging pushes the wrong way."""
    orders = any(p.order for e in problem.model.effects for p in e.parameters)
    if not orders or not all({"theta", "omega"} & set(r.outputs) for r in problem.experiments):
        return problem
    led = _shaped(problem.for_model(problem.model.with_(angle_input=True)), asked)
    if (found := race([led], RACE, solve=by_continuation)) is None:
        return problem
    other = problem.start_at(found.values)
    if all("theta" in r.outputs for r in problem.experiments):
        return min(other, problem, key=lambda p: cost_at(p, refine=False))
    # An integral drifts: where either leads decides.
    return _led(problem, race([other, problem], RACE, solve=by_continuation))


def _shaped(problem: Problem, asked: Model) -> Problem:
    """Return the problem started at the best shapes of each effect in turn: phases and resonances have side valleys."""
    for effect in problem.model.effects:
        sizes, axes = natural_sizes(problem.experiments, problem.model.values), {}
        for p in _untouched(asked, effect):
            if (not p.vary and len(p.grid) > 1) or (p.vary and (p.periodic or p.place or p.unit == RESONANCE)):
                axes[p.name] = np.clip(PHASES if p.periodic else shapes_of(p, sizes), p.lower, p.upper).tolist()
        if len(shapes := combined(axes)) > 1:
            problem = _led(problem, race([problem.start_at(s) for s in shapes], LOOK))
    return problem


def _led(problem: Problem, best: Estimate | None) -> Problem:
    """Return the problem begun where a race ended, unless it got there only by steps too coarse to see it diverge."""
    led = problem if best is None else problem.start_at(best.values)
    return led if np.isfinite(cost_at(led)) else problem


def exchanged_poles(model: Model, effect: Effect) -> list[dict[str, float]]:
    """Return the starts at which a lag of an effect has changed places with the winding's own, L/R, or the motor's, and
    is nearly as long as that: half as long it would be where the one valley ends and the other begins."""
    free = {n for n, p in model.parameters.items() if p.vary and not p.given}
    lags = [p.name for p in effect.parameters if p.pole and p.name in free]
    at = {n: p.value for n, p in model.parameters.items()}
    coupling = at["K"] ** 2 / at["R"] if {"K", "R"} <= at.keys() else 0.0
    own = {n: at[n] / by for n, by in (("L", at.get("R", 0.0)), ("J", coupling + at.get("b", 0.0))) if n in free and by}
    return [{lag: (1 - LEFT) * time, n: LEFT * at[n]} for lag in lags for n, time in own.items()]


def _contained(model: Model) -> dict[Effect, Effect]:
    """Return the simplest effect that each of the model's effects contains, where it does and has nothing set."""
    found: dict[Effect, Effect] = {}
    for effect in model.effects:
        inside = (LIBRARY[n] for n in effect.includes if n in LIBRARY)  # a user's effect may contain another of theirs
        simple = next((e for e in inside if all(p.null == 0 for p in e.parameters)), None)
        taken = {*model.effect_names, *(e.name for e in found.values())}
        if simple and simple.name not in taken and len(_untouched(model, effect)) == len(effect.parameters):
            found[effect] = simple
    return found


def sizes_like(effect: Effect, level: float, above: float = ABOVE) -> dict[str, float]:
    """Return the sizes of an effect in the place of one of size `level`; those at least another start `above` it."""
    return {p.name: level * (above if p.at_least else 1.0) for p in effect.parameters if p.null == 0 and p.vary}


def _shared_out(problem: Problem, asked: Model) -> Problem:
    """Return the problem with back-EMF and viscous friction shared out as suits the data best. Without a current a
    linear motor leaves this open; a loss that is a share of the motor's torque does not."""
    model, runs = problem.model, problem.experiments
    open_ = model.base == "dc_motor" and "i" not in problem.outputs and not _was_fitted(asked)
    if not open_ or asked.parameters["K"].given or not any(load.ratio for load in loads_of(asked)):
        return problem
    others = [problem.start_at(first_guess(asked, runs, loaded=True, back_emf=share)) for share in BACK_EMF_SHARES]
    return _led(problem, race([p.for_model(p.model.fix("R")) for p in (problem, *others)], RACE, solve=by_continuation))
