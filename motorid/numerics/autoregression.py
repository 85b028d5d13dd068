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
from scipy.linalg import matmul_toeplitz

from motorid.integrate.engine import Array

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
