"""Refits of a short list: the favourite is finished, the others go a few steps and are finished unless beaten.

Where one effect explains all but noise, one that is left many times as far has nothing to say any more, nor has one
that contains it and gains less than its parameters cost.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from motorid.diagnosis.model_comparison import EVIDENCE
from motorid.diagnosis.refit import Raced, finished, promised, raced
from motorid.diagnosis.remainders import far
from motorid.estimation.fit import Fit
from motorid.estimation.start_values import ABOVE, sizes_like
from motorid.model.model import Effect, Model
from motorid.problem.runs import natural_sizes

BEHIND = 10.0  # times the cost of a model that explains all but noise
HARDLY = 1.01  # times: near enough that a slope tells what more would do
FAR_LESS = 0.3  # of the promise that was kept
FAR_BEHIND = "far behind the best, which leaves only noise"
NEARLY = 0.9  # of the best promise: a smaller model with that is the favourite


@dataclass(frozen=True)
class Task:
    """A model to be refitted on the records of `fit`, for an effect, from several starts.

    `promise` is the share of the squared misfit that a score says it takes away, None without a score.
    """

    fit: Fit
    model: Model
    effect: Effect
    starts: Sequence[Mapping[str, float]]
    promise: float | None = None

    @property
    def price(self) -> float:
        """What the free parameters must gain, in units of the cost (half of chi²)."""
        return EVIDENCE + 0.5 * len(self.model.free_names) * float(np.log(len(self.fit.residuals)))


@dataclass(frozen=True)
class GivenUp:
    """A refit that was not finished: why, and which share of the squared misfit it had taken away, if it was begun."""

    why: str
    drop: float | None = None


def refits(tasks: Sequence[Task], map_: Callable[..., Iterable[Any]]) -> list[Fit | GivenUp | None]:
    """Return the refit of each task; None where none can be simulated.

    Parameters
    ----------
    tasks : sequence of Task
        All on the same records.
    map_ : callable
        Anything with the signature of `map`.
    """
    found: dict[int, Fit | GivenUp | None] = {}
    races: dict[int, Raced] = {}
    leader, alone = _favourite(tasks), False
    if leader is not None and (race := _race((tasks[leader], alone))) is not None:
        races[leader], found[leader] = race, _finish((tasks[leader], race))
        if (best := _quiet(found[leader])) is not None:
            alone = True
            found |= _unpromising(tasks, leader) | _needless(tasks, leader, best, map_)
    entered = [k for k in range(len(tasks)) if k not in races and k not in found]
    done = map_(_race, [(tasks[k], alone) for k in entered])
    races |= {k: race for k, race in zip(entered, done, strict=True) if race is not None}
    if races:
        first = min(races, key=lambda k: races[k].cost + tasks[k].price)
        if first not in found:
            found[first] = _finish((tasks[first], races[first]))
        if _quiet(found[first]) is not None:
            found = _beaten(tasks, {k: race.cost for k, race in races.items()}, first) | found
    rest = [k for k in races if k not in found]
    found |= zip(rest, map_(_finish, [(tasks[k], races[k]) for k in rest]), strict=True)
    return [found.get(k) for k in range(len(tasks))]


def _favourite(tasks: Sequence[Task]) -> int | None:
    """Return which task promises most, the smallest of those that promise nearly as much; None if none does."""
    promises = {k: task.promise for k, task in enumerate(tasks) if task.promise is not None}
    near = [k for k, promise in promises.items() if promise > NEARLY * max(promises.values())]
    return min(near, key=lambda k: (len(tasks[k].model.free_names), -promises[k]), default=None)


def _quiet(fit: Fit | GivenUp | None) -> Fit | None:
    """Return a fit that leaves hardly more than noise, or None."""
    return fit if isinstance(fit, Fit) and not far(fit) else None


def _unpromising(tasks: Sequence[Task], leader: int) -> dict[int, GivenUp]:
    """Return the tasks of which far less is promised than of an effect that leaves only noise."""
    promises = {k: task.promise for k, task in enumerate(tasks) if task.promise is not None}
    return {k: GivenUp(FAR_BEHIND) for k, p in promises.items() if p < FAR_LESS * promises[leader]}


def _needless(tasks: Sequence[Task], leader: int, best: Fit, map_: Callable[..., Iterable[Any]]) -> dict[int, GivenUp]:
    """Return the tasks that contain an effect that leaves only noise, and from there promise too little."""
    winner = tasks[leader]
    wider = {
        k: widened(best, task.effect, HARDLY)
        for k, task in enumerate(tasks)
        if winner.effect.name in task.effect.includes
    }
    gains = dict(zip(wider, map_(_gain, wider.values()), strict=True))
    why = f"does no more than {winner.effect.name}, which it contains"
    return {
        k: GivenUp(why)
        for k, task in wider.items()
        if gains[k]
        < task.price - winner.price + float(np.log(len(task.starts)))  # the search over starts has its price
    }


def _given_up(task: Task, cost: float, why: str) -> GivenUp:
    before = 0.5 * float(np.sum(task.fit.residuals**2))
    return GivenUp(why, 1 - cost / max(before, 1e-300))


def _beaten(tasks: Sequence[Task], costs: Mapping[int, float], first: int) -> dict[int, GivenUp]:
    """Return which tasks need not be finished beside the one that explains all but noise, and why."""
    winner, given_up = tasks[first], {}
    for k, cost in costs.items():
        if k == first:
            continue
        if cost > BEHIND * costs[first]:
            given_up[k] = _given_up(winner, cost, FAR_BEHIND)
        elif winner.effect.name in tasks[k].effect.includes and cost > costs[first] - (tasks[k].price - winner.price):
            given_up[k] = _given_up(winner, cost, f"does no more than {winner.effect.name}, which it contains")
    return given_up


def _race(entry: tuple[Task, bool]) -> Raced | None:
    """Race a task; its best start alone, where only what comes near a winner matters."""
    task, alone = entry
    return raced(task.fit, task.model, task.starts[:1] if alone else task.starts)


def _finish(begun: tuple[Task, Raced]) -> Fit | None:
    return finished(begun[0].fit, begun[1])


def _gain(task: Task) -> float:
    """Return by how much one step promises to lower the cost, not less than nothing."""
    return max(task.fit.cost - promised(task.fit, task.model, task.starts), 0.0)


def _sizes(fit: Fit, effect: Effect) -> list[float]:
    """Sizes of an effect, those that vanish with it."""
    return [fit.values[p.name] for p in effect.parameters if p.null == 0]


def widened(fit: Fit, effect: Effect, above: float = ABOVE) -> Task:
    """Return the refit with `effect` in the place of those that it includes, from where they were.

    Sizes that are at least another start at `above` times that.
    """
    model, level = fit.model, 0.0
    for e in model.effects:
        if e.name in effect.includes:
            level = max([level, *_sizes(fit, e)])
            model = model.without(e.name)
    model = model + effect
    natural = natural_sizes(fit.problem.experiments, fit.values)
    sizes = sizes_like(effect, level, above)
    shapes = [
        [(p.name, g * natural.get(p.unit, 1.0)) for g in p.grid] for p in effect.parameters if p.null is None and p.grid
    ]
    starts = [{**sizes, **dict(point)} for point in itertools.product(*shapes)][:6]
    return Task(fit, model, effect, starts)
