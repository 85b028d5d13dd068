"""Long records: a diagnosis refits dozens of models, so it looks at parts of what would take too long.

Parts are contiguous and spread evenly over each record; every part begins where the motor then is, so that an angle
drifts no longer than one part lasts. What takes longer than a part to show (heating) is seen between the parts only.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from motorid.errors import MotoridError
from motorid.experiment import Experiment
from motorid.fit import Fit, solve

AFFORDABLE = 150_000  # steps of integration per simulation of all records
WANTED = 36_000  # of what is longer
PART = 1000  # samples


def affordable(fit: Fit) -> Fit:
    """Return `fit`, or the fit of the same model to parts of its records if these are too long for many refits."""
    problem = fit.problem
    work = sum(int(r.grid.substeps.sum()) for r in problem.runs)
    if work <= AFFORDABLE or problem.initial != "auto":
        return fit
    parts = [p for run in problem.experiments for p in _parts(run, WANTED / work)]
    try:
        return solve(problem.with_(experiments=parts, model=fit.model, balance={}), start="model")
    except MotoridError:
        return fit


def _parts(run: Experiment, share: float) -> list[Experiment]:
    """Return parts of a run that together are about a `share` of it."""
    count = max(1, round(run.n * share / PART))
    if run.n < 2 * PART * count:
        return [run]
    starts = np.linspace(0, run.n - PART, count + 2)[1:-1].astype(int) if count > 1 else [0]
    return [run.select(slice(a, a + PART)).with_(name=f"{run.name}[{k + 1}]") for k, a in enumerate(starts)]


def parts_remark(whole: Fit, looked_at: Fit) -> str:
    """Say which part of the records was looked at, if not all."""
    if looked_at is whole:
        return ""
    used = looked_at.problem.experiments
    share = _samples(used) / _samples(whole.problem.experiments)
    return (
        f"The records are long: this rests on {len(used)} parts of {_seconds(used):.2g} s, {100 * share:.0f} % of the "
        "samples; fit the model to all of them."
    )


def _samples(runs: Sequence[Experiment]) -> int:
    return sum(r.n for r in runs)


def _seconds(runs: Sequence[Experiment]) -> float:
    return float(np.median([r.duration for r in runs]))
