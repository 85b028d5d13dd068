"""Taking the colour out of residuals before something narrow is looked for in them.

A residual that drifts (an angle integrates every error twice) is explained a little by anything that drifts. The
prediction error of an autoregressive model of each channel has no such colour; filtered alike, the answers to what
is looked for give the generalised least-squares score (Aitken 1935; Cochrane & Orcutt, JASA 44, 1949).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, solve_toeplitz

from motorid.estimation.fit import Fit
from motorid.integrate.engine import Array

ORDER = 8  # of the autoregressive models
CLIP = 6.0  # robust standard deviations beyond which a residual is an outlier


@dataclass(frozen=True, eq=False)
class Whitening:
    """One filter per channel, scaled so that each channel of the residual it was made from has unit variance."""

    filters: tuple[Array, ...]

    @staticmethod
    def of(residuals: Sequence[Array]) -> Whitening:
        """Return the filters for `residuals`, one (N, ny) per run, NaN where missing."""
        found = []
        for j in range(residuals[0].shape[1]):
            parts = [_filled(r[:, j]) for r in residuals]
            coefficients = _autoregression(parts)
            left = np.concatenate([_filtered(coefficients, x) for x in parts])
            found.append(coefficients / (float(np.sqrt(np.mean(left**2))) or 1.0))
        return Whitening(tuple(found))

    def __call__(self, stacks: Sequence[Array]) -> Array:
        """Return (N, ny, …) per run, filtered over time and stacked as rows; the first samples are left out."""
        parts = []
        for y in stacks:
            filled = np.nan_to_num(y)
            done = [_filtered(a, filled[:, j]) for j, a in enumerate(self.filters)]
            parts.append(np.stack(done, axis=1).reshape(-1, *y.shape[2:]))
        return np.concatenate(parts)

    def transposed(self, rows: Array, lengths: Sequence[int]) -> list[Array]:
        """Return the transposed filters on stacked `rows`, (N, ny) for each run of N samples in `lengths`."""
        found, first = [], 0
        for n in lengths:
            shape = max(n - ORDER, 0), len(self.filters)
            part = rows[first : first + shape[0] * shape[1]].reshape(shape)
            first += part.size
            out = np.zeros((n, shape[1]))
            for j, a in enumerate(self.filters):
                for k, c in enumerate(a):
                    out[ORDER - k : ORDER - k + shape[0], j] += c * part[:, j]
            found.append(out)
        return found


def _filtered(a: Array, x: Array) -> Array:
    """Return Σ a_k·x[n−k] along the first axis for n from ORDER on."""
    n = max(len(x) - ORDER, 0)
    return sum((c * x[ORDER - k : ORDER - k + n] for k, c in enumerate(a)), np.zeros((n, *x.shape[1:])))


def _filled(x: Array) -> Array:
    """Return `x` with zero for what is missing, outliers cut."""
    limit = CLIP * 1.4826 * float(np.nanmedian(np.abs(x))) if np.isfinite(x).any() else 0.0
    return np.clip(np.nan_to_num(x), -limit, limit) if limit > 0 else np.nan_to_num(x)


def _autoregression(parts: Sequence[Array]) -> Array:
    """Return 1, −a_1, …, −a_p of the Yule-Walker model of all `parts`."""
    moments = sum(np.array([x[k:] @ x[: len(x) - k] for k in range(ORDER + 1)]) for x in parts)
    moments = np.asarray(moments, dtype=float)
    if moments[0] <= 0:
        return np.eye(1, ORDER + 1)[0]
    moments[0] *= 1 + 1e-9
    try:
        return np.concatenate([[1.0], -solve_toeplitz(moments[:-1], moments[1:])])
    except LinAlgError:
        return np.eye(1, ORDER + 1)[0]


def unstacked(fit: Fit, residual: Array) -> list[Array]:
    """Return a stacked output residual as one (N, ny) per run, NaN where missing."""
    parts, first = [], 0
    for y, _, index in fit.problem._weights:
        n = y.size if index is None else len(index)
        full = np.full(y.size, np.nan)
        full[slice(None) if index is None else index] = residual[first : first + n]
        parts.append(full.reshape(y.shape))
        first += n
    return parts
