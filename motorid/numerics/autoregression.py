"""Coloured residuals: their autocovariance from an autoregressive model, and sums of it over sensitivities.

An autoregression describes noise whose neighbours are alike with few numbers, and its covariance is always
that of some noise (positive definite), which a truncated sample autocovariance is not. Its order is chosen
by Akaike's criterion; order 0 is white noise. Percival & Walden, Spectral Analysis for Physical
Applications, 1993, ch. 9.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.fft
from scipy.linalg import LinAlgError, matmul_toeplitz, solve_toeplitz

from motorid.numerics.signals import Array

HIGHEST_ORDER = 30


@dataclass(frozen=True, eq=False)
class Colour:
    """An autoregression ``r_t = Σ a_k r_{t-k} + e_t``.

    Attributes
    ----------
    a : ndarray, shape (order,)
    variance : float
        Of r.
    innovation : float
        Variance of e.
    """

    a: Array
    variance: float
    innovation: float

    def autocovariance(self, n: int) -> Array:
        """Return the autocovariance at lags 0 … n-1."""
        if not self.a.size or self.innovation <= 0:
            return np.concatenate([[self.variance], np.zeros(n - 1)])
        # Long enough for what the periodic transform folds back to have died out.
        m = 1 << int(np.ceil(np.log2(max(4 * n, 4096))))
        response = np.fft.rfft(np.concatenate([[1.0], -self.a]), m)
        gamma = np.fft.irfft(self.innovation / np.abs(response) ** 2, m)[:n]
        return gamma * (self.variance / gamma[0])

    @property
    def effective_share(self) -> float:
        """Effective samples per sample for the mean, ``γ(0) / Σ γ(k)``; small where neighbours are alike."""
        gain = 1.0 / (1.0 - float(np.sum(self.a))) ** 2
        return float(np.clip(self.variance / max(self.innovation * gain, 1e-300), 0.0, 1.0))

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        """Return noise of this colour (n,), Gaussian."""
        if not self.a.size:
            return np.sqrt(self.variance) * rng.standard_normal(n)
        # Through the spectrum, on twice the length so that the ends are not alike.
        m = 1 << int(np.ceil(np.log2(max(2 * n, 4096))))
        response = np.fft.rfft(np.concatenate([[1.0], -self.a]), m)
        white = np.fft.rfft(np.sqrt(self.innovation) * rng.standard_normal(m))
        return np.fft.irfft(white / response, m)[:n]


def colour_of(parts: Sequence[Array], spent: float = 0.0) -> Colour:
    """Return the autoregression of residuals.

    Parameters
    ----------
    parts : sequence of ndarray
        One per run, NaN where missing.
    spent : float
        Degrees of freedom used up by the fit; they enlarge the variance.
    """
    present = [np.isfinite(p) for p in parts]
    filled = [np.where(ok, p, 0.0) for p, ok in zip(parts, present, strict=True)]
    n = int(sum(ok.sum() for ok in present))
    if n < 3:
        return Colour(np.zeros(0), float(sum(f @ f for f in filled) / max(n, 1)), 0.0)
    most = max(min(HIGHEST_ORDER, int(10 * np.log10(n)), n // 4, min(len(p) for p in parts) - 2), 0)
    gamma = _autocovariance(filled, most)
    a, variance = _levinson(gamma, n)
    inflation = n / max(n - spent, 1.0)
    return Colour(a, gamma[0] * inflation, variance * inflation)


def _autocovariance(filled: Sequence[Array], most: int) -> Array:
    """Sample autocovariance at lags 0 … most over all runs; its divisor keeps it positive definite."""
    total = np.zeros(most + 1)
    for r in filled:
        m = 1 << int(np.ceil(np.log2(len(r) + most + 1)))
        total += np.fft.irfft(np.abs(np.fft.rfft(r, m)) ** 2, m)[:most + 1]
    return total / max(sum(int(np.count_nonzero(r)) for r in filled), 1)


def _levinson(gamma: Array, n: int) -> tuple[Array, float]:
    """Levinson's recursion; return coefficients and innovation variance of the order that Akaike prefers."""
    a, variance = np.zeros(0), float(gamma[0])
    best = (n * np.log(max(variance, 1e-300)), a, variance)
    for k in range(1, len(gamma)):
        if variance <= 1e-12 * gamma[0]:
            break
        reflection = (gamma[k] - a @ gamma[k - 1:0:-1]) / variance if k > 1 else gamma[1] / variance
        a = np.concatenate([a - reflection * a[::-1], [reflection]])
        variance *= 1 - reflection**2
        criterion = n * np.log(max(variance, 1e-300)) + 2 * k
        if criterion < best[0]:
            best = (criterion, a, variance)
    return best[1], best[2]


def weighed(jac: Array, gamma: Array) -> Array:
    """Return ``Jᵀ Γ J`` (k, k) for J (N, k), zero in rows of missing samples, and autocovariance (N,)."""
    return jac.T @ np.asarray(matmul_toeplitz((gamma, gamma), jac)).real


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


def autocorrelation(r: Array, lags: int | None = None) -> Array:
    """Return the autocorrelation of `r` (N,) at lags 0, 1, …; missing samples count as zero."""
    r = np.where(np.isfinite(r), r, 0.0)
    n = len(r)
    lags = min(lags or n // 2, n - 1)
    size = scipy.fft.next_fast_len(2 * n, real=True)
    full: Array = np.fft.irfft(np.abs(np.fft.rfft(r, size)) ** 2, size)[: lags + 1]
    return full / full[0] if full[0] > 0 else np.eye(1, lags + 1)[0]


def effective_samples(r: Array) -> float:
    """Return how many independent samples `r` (N,) is worth."""
    n = int(np.isfinite(r).sum())
    if n < 8:
        return float(n)
    rho = autocorrelation(r)
    pairs = rho[1 : len(rho) - (len(rho) - 1) % 2].reshape(-1, 2).sum(axis=1)
    stop = int(np.argmax(pairs < 0)) if (pairs < 0).any() else len(pairs)
    return float(np.clip(n / (1 + 2 * pairs[:stop].sum()), 2.0, n))
