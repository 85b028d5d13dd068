"""What mixtures of slopes and free forms leave of a residual, on the data they are fitted to and on others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from motorid.diagnosis.adequacy import LARGER
from motorid.diagnosis.form_regression import Linear
from motorid.diagnosis.free_forms import Form
from motorid.diagnosis.residual_analysis import despiked
from motorid.estimation.fit import Fit
from motorid.integrate.engine import Array

RIDGE = 1e-7  # of the largest singular value; smaller ones are left out


def far(fit: Fit) -> list[int]:
    """Return which channels' errors are plainly larger than their noise."""
    found = []
    for j, c in enumerate(fit.problem.outputs):
        pairs = zip(fit.simulations, fit.problem.runs, strict=True)
        parts = [despiked(s.residual(c)) / run.sigma[c] for s, run in pairs if c in run.sigma]
        if float(np.sqrt(np.mean(np.concatenate(parts) ** 2))) > LARGER:
            found.append(j)
    return found


def by_channel(residual: Array, part: Linear) -> Array:
    """Return the sum of squares per channel."""
    squares: Array = np.bincount(part.channel.astype(int), residual**2).astype(float)
    return squares


def fraction(after: Array, before: Array, channels: Sequence[int]) -> float:
    """Return what is left of squared misfits, geometric mean over the channels that are not yet down to noise."""
    return float(np.exp(np.mean([np.log((after[c] + 1e-300) / (before[c] + 1e-300)) for c in channels])))


def fraction_of(form: Form, parts: Sequence[tuple[Linear, Linear]], channels: Sequence[int]) -> float:
    """Return what a form leaves of what else is left, learnt on the first and judged on the second of each pair."""
    before = np.sum([by_channel(left(judge.residual, judge.own), judge) for _, judge in parts], axis=0)
    after = np.sum([by_channel(_predicted(form, learn, judge), judge) for learn, judge in parts], axis=0)
    return fraction(after, before, channels)


def _predicted(form: Form, learn: Linear, judge: Linear) -> Array:
    """Return the residual on `judge` of what `learn` tells; only initial states are fitted there."""
    moved = _solved(np.concatenate([learn.forms[form], learn.slopes, learn.own], axis=1), learn.residual)
    columns = np.concatenate([judge.forms[form], judge.slopes], axis=1)
    return left(judge.residual - columns @ moved[: columns.shape[1]], judge.own)


def left(residual: Array, *columns: Array) -> Array:
    """Return what the best mixture of `columns` leaves."""
    together = np.concatenate(columns, axis=1)
    return residual - together @ _solved(together, residual) if together.shape[1] else residual


def _solved(columns: Array, residual: Array) -> Array:
    """Return the least-squares coefficients, directions that hardly show left out."""
    norms = np.linalg.norm(columns, axis=0)
    norms = np.where(norms > 0, norms, 1.0)
    return np.linalg.lstsq(columns / norms, residual, rcond=RIDGE)[0] / norms
