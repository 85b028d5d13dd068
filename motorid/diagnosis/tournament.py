"""Refits of a short list: all go a few steps, the best is finished, then those that are not hopelessly behind it.

Where one effect explains all but noise, one that is left many times as far has nothing to say any more, nor has one
that contains it and gains less than its parameters cost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from motorid.diagnosis.judging import EVIDENCE
from motorid.diagnosis.remainders import far
from motorid.diagnosis.trial import Raced, finished, raced
from motorid.fit import Fit
from motorid.model import Effect, Model

BEHIND = 10.0  # times the cost of a model that explains all but noise


@dataclass(frozen=True)
class Task:
    """A model to be refitted on the records of `fit`, for an effect, from several starts."""

    fit: Fit
    model: Model
    effect: Effect
    starts: Sequence[Mapping[str, float]]

    @property
    def price(self) -> float:
        """What the free parameters must gain, in units of the cost (half of chi²)."""
        return EVIDENCE + 0.5 * len(self.model.free_names) * float(np.log(len(self.fit.residuals)))


@dataclass(frozen=True)
class GivenUp:
    """A refit that was not finished: share of the squared misfit that it had taken away by then, and why."""

    drop: float
    why: str


def refits(tasks: Sequence[Task], map_: Callable[..., Iterable[Any]]) -> list[Fit | GivenUp | None]:
    """Return the refit of each task; None where none can be simulated.

    Parameters
    ----------
    tasks : sequence of Task
        All on the same records.
    map_ : callable
        Anything with the signature of `map`.
    """
    races: list[Raced | None] = list(map_(_race, tasks))
    costs = np.array([np.inf if race is None else race.cost for race in races])
    found: list[Fit | GivenUp | None] = [None] * len(tasks)
    if not np.isfinite(costs).any():
        return found
    first = int(np.argmin(costs + [task.price for task in tasks]))
    found[first] = best = _finish((tasks[first], races[first]))
    if best is not None and not far(best):
        before = 0.5 * float(np.sum(tasks[0].fit.residuals ** 2))
        for k, why in _beaten(tasks, costs.tolist(), first).items():
            found[k] = GivenUp(1 - float(costs[k]) / max(before, 1e-300), why)
    rest = [k for k, race in enumerate(races) if race is not None and found[k] is None and k != first]
    for k, fit in zip(rest, map_(_finish, [(tasks[k], races[k]) for k in rest]), strict=True):
        found[k] = fit
    return found


def _beaten(tasks: Sequence[Task], costs: Sequence[float], first: int) -> dict[int, str]:
    """Return which tasks need not be finished beside the one that explains all but noise, and why."""
    winner, why = tasks[first], {}
    for k, task in enumerate(tasks):
        if k == first or not np.isfinite(costs[k]):
            continue
        if costs[k] > BEHIND * costs[first]:
            why[k] = "far behind the best, which leaves only noise"
        elif winner.effect.name in task.effect.includes and costs[k] > costs[first] - (task.price - winner.price):
            why[k] = f"does no more than {winner.effect.name}, which it contains"
    return why


def _race(task: Task) -> Raced | None:
    return raced(task.fit, task.model, task.starts)


def _finish(begun: tuple[Task, Raced | None]) -> Fit | None:
    task, race = begun
    return None if race is None else finished(task.fit, race)
