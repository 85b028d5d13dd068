"""Coloured residuals: autocovariance, autoregressive models of them, filters that whiten them, effective samples.

An autoregression needs few numbers for noise whose neighbours are alike, and its covariance is positive definite; a
truncated sample autocovariance is not (Percival & Walden, Spectral Analysis for Physical Applications, 1993, ch. 9)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from motorid.numerics.signals import Array, winsorised

HIGHEST_ORDER = 30  # of a channel's model
ORDER = 8  # of the filters


@dataclass(frozen=True, eq=False)
class Colour:
    """An autoregression ``r_t = Σ a_k r_{t-k} + e_t``."""

    a: Array  # (order,)
    variance: float  # of r
    innovation: float  # variance of e
    effective_share: float = 1.0  # effective samples per sample; small where neighbours are alike

    def autocovariance(self, n: int) -> Array:
        """Return the autocovariance at lags 0 … n-1."""
        if not self.a.size or self.innovation <= 0:
            return np.concatenate([[self.variance], np.zeros(n - 1)])
        # Long enough for what the periodic transform folds back to have died out.
        m = 1 << int(np.ceil(np.log2(max(4 * n, 4096))))
        gamma = np.fft.irfft(self.innovation / np.abs(np.fft.rfft(np.concatenate([[1.0], -self.a]), m)) ** 2, m)[:n]
        return gamma * (self.variance / gamma[0])

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        """Return noise of this colour (n,), Gaussian."""
        if not self.a.size:
            return np.sqrt(self.variance) * rng.standard_normal(n)
        # Through the spectrum, on twice the length so that the ends are not alike.
        m = 1 << int(np.ceil(np.log2(max(2 * n, 4096))))
        response = np.fft.rfft(np.concatenate([[1.0], -self.a]), m)
        return np.fft.irfft(np.fft.rfft(np.sqrt(self.innovation) * rng.standard_normal(m)) / response, m)[:n]


def colour_of(parts: Sequence[Array], spent: float = 0.0) -> Colour:
    """Return the autoregression of residuals, one (N,) per run, NaN where missing, of the order that Akaike's criterion
    chooses, 0 for white noise. The degrees of freedom `spent` by the fit enlarge the variance."""
    counts = [int(np.isfinite(p).sum()) for p in parts]
    n = sum(counts)
    most = max(min(HIGHEST_ORDER, int(10 * np.log10(max(n, 1))), n // 4, min(len(p) for p in parts) - 2), 0)
    each = [autocovariance([p], max(most, len(p) // 2)) for p in parts]
    gamma = sum((c * g[: most + 1] for c, g in zip(counts, each, strict=True)), np.zeros(most + 1)) / max(n, 1)
    if n < 3:
        return Colour(np.zeros(0), float(gamma[0]), 0.0)
    a, innovation = min(_levinson(gamma), key=lambda m: n * np.log(max(m[1], 1e-300)) + 2 * len(m[0]))
    inflation = n / max(n - spent, 1.0)
    share = sum(_worth(c, g[: len(p) // 2 + 1]) for c, g, p in zip(counts, each, parts, strict=True)) / n
    return Colour(a, float(gamma[0]) * inflation, innovation * inflation, share)


def weighed(jac: Array, gamma: Array) -> Array:
    """Return ``Jᵀ Γ J`` (k, k) for J (N, k), zero in rows of missing samples, and autocovariance (N,)."""
    n = len(jac)
    if not gamma[1:].any():
        return gamma[0] * (jac.T @ jac)
    size = min(p << ((2 * n - 2) // p).bit_length() for p in (1, 3, 5, 9, 15, 25, 27))  # 2n − 1 may be prime
    spectrum = np.fft.rfft(np.concatenate([gamma, np.zeros(size - 2 * n + 1), gamma[:0:-1]])).real
    return jac.T @ np.fft.irfft(spectrum[:, None] * np.fft.rfft(jac, size, axis=0), size, axis=0)[:n]


@dataclass(frozen=True, eq=False)
class Whitening:
    """One filter per channel, scaled so that each channel of the residual it was made from has unit variance."""

    filters: tuple[Array, ...]

    @staticmethod
    def of(residuals: Sequence[Array]) -> "Whitening":
        """Return the filters for `residuals`, one (N, ny) per run, NaN where missing."""
        found = []
        for j in range(residuals[0].shape[1]):
            parts = [winsorised(r[:, j]) for r in residuals]
            *_, (a, _) = _levinson(autocovariance(parts, ORDER))
            coefficients = np.concatenate([[1.0], -a, np.zeros(ORDER - len(a))])
            left = np.concatenate([_filtered(coefficients, x) for x in parts])
            found.append(coefficients / (float(np.sqrt(np.mean(left**2))) or 1.0))
        return Whitening(tuple(found))

    def __call__(self, stacks: Sequence[Array]) -> Array:
        """Return (N, ny, …) per run, filtered over time and stacked as rows; the first samples are left out."""
        parts = (np.stack([_filtered(a, np.nan_to_num(y[:, j])) for j, a in enumerate(self.filters)], axis=1)
                 for y in stacks)
        return np.concatenate([part.reshape(part.shape[0] * part.shape[1], *part.shape[2:]) for part in parts])

    def transposed(self, rows: Array, lengths: Sequence[int]) -> list[Array]:
        """Return the transposed filters on stacked `rows`, (N, ny) for each run of N samples in `lengths`."""
        found, ny = [], len(self.filters)
        ends = np.cumsum([max(n - ORDER, 0) for n in lengths])
        for n, part in zip(lengths, np.split(rows.reshape(-1, ny), ends[:-1]), strict=True):
            out = np.zeros((n, ny))
            for j, a in enumerate(self.filters if part.size else ()):
                out[:, j] = np.convolve(part[:, j], a[::-1])
            found.append(out)
        return found


def _filtered(a: Array, x: Array) -> Array:
    """Return Σ a_k·x[n−k] along the first axis for n from ORDER on."""
    n = max(len(x) - ORDER, 0)
    return sum((c * x[ORDER - k : ORDER - k + n] for k, c in enumerate(a)), np.zeros((n, *x.shape[1:])))


def autocovariance(parts: Sequence[Array], lags: int) -> Array:
    """Return the sample autocovariance of residuals, one (N,) per run, at lags 0 … `lags`; missing ones are zero."""
    total = np.zeros(lags + 1)
    for r in parts:
        r = np.where(np.isfinite(r), r, 0.0)
        size = 1 << int(np.ceil(np.log2(len(r) + lags + 1)))
        total += np.fft.irfft(np.abs(np.fft.rfft(r, size)) ** 2, size)[: lags + 1]
    return total / max(sum(int(np.isfinite(r).sum()) for r in parts), 1)


def autocorrelation(r: Array | Sequence[Array], lags: int) -> Array:
    """Return the autocorrelation of a residual (N,), or of one per run, at lags 0 … `lags`; see `autocovariance`."""
    gamma = autocovariance([r] if isinstance(r, np.ndarray) else r, lags)
    return gamma / gamma[0] if gamma[0] > 0 else np.eye(1, lags + 1)[0]


def effective_samples(r: Array) -> float:
    """Return how many independent samples `r` (N,) is worth: n coloured ones n/(1+2Σρ) (Bayley & Hammersley, J. R.
    Stat. Soc. Suppl. 8(2), 1946), up to the first negative pair of autocorrelations (Geyer, Stat. Sci. 7(4), 1992)."""
    return _worth(int(np.isfinite(r).sum()), autocovariance([r], len(r) // 2))


def _worth(n: int, gamma: Array) -> float:
    """Return how many independent samples `n` of this autocovariance are worth."""
    if n < 8 or gamma[0] <= 0:
        return float(n)
    pairs = gamma[1 : len(gamma) - (len(gamma) - 1) % 2].reshape(-1, 2).sum(axis=1)
    stop = int(np.argmax(pairs < 0)) if (pairs < 0).any() else len(pairs)
    return float(np.clip(n / (1 + 2 * pairs[:stop].sum() / gamma[0]), 2.0, n))


def _levinson(gamma: Array) -> Iterator[tuple[Array, float]]:
    """Yield coefficients and innovation variance of the Yule-Walker models of order 0, 1, … (Levinson's recursion)."""
    a, variance = np.zeros(0), float(gamma[0])
    yield a, variance
    for k in range(1, len(gamma)):
        if variance <= 1e-12 * gamma[0]:
            return
        reflection = (gamma[k] - a @ gamma[k - 1 : 0 : -1]) / variance
        a = np.concatenate([a - reflection * a[::-1], [reflection]])
        variance *= 1 - reflection**2
        yield a, variance
