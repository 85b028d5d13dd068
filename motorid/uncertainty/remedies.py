"""What would make parameters identifiable: something fixed, one more channel, another experiment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from motorid.errors import MotoridError
from motorid.integrate.engine import Array
from motorid.model.model import Model
from motorid.problem.problem import Problem
from motorid.problem.sensitivity_part import relative_jacobian
from motorid.problem.simulate import simulate
from motorid.records.experiment import Experiment

ASSUMED_NOISE = 0.01  # of a channel's RMS, where a plan does not say
EASY = ("R", "K", "g", "L", "b", "J")  # in the order in which they are usually known beforehand
CHANNELS = {"i": "the current", "omega": "the speed"}


def remedies(problem: Problem, q: Array, matrix: Array, missing: int, level: float) -> list[str]:
    """Return sentences on what to fix or to measure so that every singular value exceeds `level`."""
    names = problem.model.free_names
    said = []
    sets = fixable(names, matrix, missing, level)
    if sets:
        first = " and ".join(sets[0])
        other = f" (or {' and '.join(sets[1])})" if len(sets) > 1 else ""
        said.append(f"Hold {first}{other} where known, model.fix(…), and the rest is determined.")
    for channel, title in CHANNELS.items():
        if _would_do(problem, q, channel, level):
            said.append(f"Measure {title} as well: with 1 % of noise all of them are determined.")
    return said


def fixable(names: Sequence[str], matrix: Array, missing: int, level: float) -> list[tuple[str, ...]]:
    """Return the sets of `missing` parameters that, held, leave the others determined; the best set first."""
    found = []
    triangle = np.asarray(np.linalg.qr(matrix, mode="r"))
    for held in combinations(range(len(names)), missing):
        s = np.linalg.svd(np.delete(triangle, held, axis=1), compute_uv=False)
        if s.size and s[-1] > level:
            ease = sum(EASY.index(names[j]) if names[j] in EASY else len(EASY) for j in held)
            found.append((-round(np.log10(s[-1])), ease, tuple(names[j] for j in held)))
    return [f[2] for f in sorted(found)]


def _would_do(problem: Problem, q: Array, channel: str, level: float) -> bool:
    """Tell whether one more channel, with little noise, would determine everything."""
    if channel in problem.outputs or (channel == "i" and problem.model.base != "dc_motor"):
        return False
    model = problem.model.start_at(problem.values(q))
    try:
        runs = [with_channels(model, r.experiment.with_(sigma=r.sigma), [channel]) for r in problem.runs]
        more = problem.with_(model=model, experiments=tuple(runs))
        matrix = relative_jacobian(more.refined(more.start), more.start)
    except MotoridError:
        return False
    return bool(np.linalg.svd(matrix, compute_uv=False)[-1] > level)


def with_channels(model: Model, run: Experiment, channels: Sequence[str],
                  sigma: Mapping[str, float] | None = None) -> Experiment:
    """Return the run with `channels` filled in from the model, with their noise (default 1 % of the RMS)."""
    blank = run.with_(outputs={**run.outputs, **{c: np.zeros(run.n) for c in channels}},
                      sigma={**run.sigma, **dict.fromkeys(channels, 1.0)})
    shown = simulate(model, [blank], initial="rest", estimate_initial=False)[0].outputs
    noise = {c: (sigma or {}).get(c) or ASSUMED_NOISE * float(np.sqrt(np.mean(shown[c] ** 2))) or 1.0
             for c in channels}
    filled = {c: shown[c] for c in channels}
    return blank.with_(outputs={**run.outputs, **filled}, sigma={**run.sigma, **noise})


def planned(model: Model, t: Sequence[float] | Array, v: Sequence[float] | Array, *,
            channels: Sequence[str] = ("i", "omega"), sigma: Mapping[str, float] | None = None,
            hold: Any = "zoh", name: str = "plan") -> Experiment:
    """Return an experiment that was not made: what `model`, at its values, would show.

    Parameters
    ----------
    model : Model
    t, v : array (N,)
        Time (s) and voltage (V) as they would be applied, from rest.
    channels : sequence of str
        What would be measured.
    sigma : mapping of str to float, optional
        Noise per channel, SI; default one per cent of the channel's RMS.
    hold : {"zoh", "linear"}
    name : str

    Examples
    --------
    >>> plan = planned(dc_motor(R=1.4, L=2e-3, K=0.046, b=6e-5, J=2e-5), t, v, channels=["omega"])
    >>> identifiability(Problem(model, [plan]))
    """
    t = np.asarray(t, float)
    blank = Experiment(t, {"v": np.asarray(v, float)}, {c: np.zeros(len(t)) for c in channels}, hold=hold,
                       name=name)
    return with_channels(model, blank, channels, sigma)
