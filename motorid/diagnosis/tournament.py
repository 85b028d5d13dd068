"""Refits of a short list: all go a few steps, the best is finished, then those that are not hopelessly behind it.

Where one effect explains all but noise, one that is left many times as far has nothing to say any more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from motorid.diagnosis.remainders import far
from motorid.diagnosis.trial import Raced, finished, raced
from motorid.fit import Fit
from motorid.model import Model

BEHIND = 10.0  # times the cost of a model that explains all but noise


@dataclass(frozen=True)
class Task:
    """A model to be refitted on the records of `fit`, for an effect, from several starts."""

    fit: Fit
    model: Model
    effect: str
    starts: Sequence[Mapping[str, float]]


@dataclass(frozen=True)
class Behind:
    """A refit that was given up: share of the squared misfit that it had taken away by then, and for which effect."""

    drop: float
    winner: str


def refits(tasks: Sequence[Task], map_: Callable[..., Iterable[Any]]) -> list[Fit | Behind | None]:
    """Return the refit of each task; None where none can be simulated.

    Parameters
    ----------
    tasks : sequence of Task
        All on the same records.
    map_ : callable
        Anything with the signature of `map`.
    """
    races: list[Raced | None] = list(map_(_race, tasks))
    begun = [k for k, race in enumerate(races) if race is not None]
    if not begun:
        return [None] * len(tasks)
    found: list[Fit | Behind | None] = [None] * len(tasks)
    first = min(begun, key=lambda k: _cost(races[k]))
    found[first] = best = _finish((tasks[first], races[first]))
    limit = BEHIND * _cost(races[first]) if best is not None and not far(best) else np.inf
    before = 0.5 * float(np.sum(tasks[0].fit.residuals ** 2))
    for k in begun:
        if _cost(races[k]) > limit:
            found[k] = Behind(1 - _cost(races[k]) / max(before, 1e-300), tasks[first].effect)
    open_ = [k for k in begun if k != first and found[k] is None]
    for k, fit in zip(open_, map_(_finish, [(tasks[k], races[k]) for k in open_]), strict=True):
        found[k] = fit
    return found


def _cost(race: Raced | None) -> float:
    return np.inf if race is None else race.cost


def _race(task: Task) -> Raced | None:
    return raced(task.fit, task.model, task.starts)


def _finish(begun: tuple[Task, Raced | None]) -> Fit | None:
    task, race = begun
    return None if race is None else finished(task.fit, race)
