"""What residuals are worth: effective samples, held-out errors, and the evidence of one model over another.

Samples of a coloured residual repeat one another: n of them are worth n/(1+2Σρ) independent ones (Bayley &
Hammersley, J. R. Stat. Soc. Suppl. 8(2), 1946), the sum ending at the first negative pair of autocorrelations
(Geyer, Stat. Sci. 7(4), 1992). With the channels' variances unknown the log likelihood is −½ Σ n·ln(SSR).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.fft

from motorid.integrate.engine import Array
from motorid.problem.simulate import Simulation
from motorid.records.experiment import Experiment

ASTRAY = 1.0  # NRMSE: zero is nearer to the channel than the model is
CLIP = 6.0  # robust standard deviations beyond which a residual counts as an outlier


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


def despiked(r: Array) -> Array:
    """Return `r` (N,) without NaN, samples that stand alone far from both neighbours replaced by the middle of three.

    A few large samples in a row are no outliers: there the model fails.
    """
    r = r[np.isfinite(r)]
    if len(r) < 3:
        return r
    before, after = np.concatenate([r[1:2], r[:-1]]), np.concatenate([r[1:], r[-2:-1]])
    middle = np.maximum(np.minimum(before, r), np.minimum(np.maximum(before, r), after))
    limit = CLIP * 1.4826 * float(np.median(np.abs(r)))
    return np.where(np.abs(r - middle) > limit, middle, r)


@dataclass(frozen=True, eq=False)
class Errors:
    """Residuals of a model on records, per channel.

    Attributes
    ----------
    residuals : dict of str to list of ndarray
        Measured minus model, NaN where missing or not judged.
    measured : dict of str to float
        RMS of the measured samples that are judged.
    """

    residuals: Mapping[str, Sequence[Array]]
    measured: Mapping[str, float]

    @staticmethod
    def of(simulations: Sequence[Simulation], judged: Sequence[Experiment] | None = None) -> Errors:
        """Return the errors of `simulations`; `judged` gives other measurements on the same samples (a fold)."""
        runs = judged if judged is not None else [s.experiment for s in simulations]
        residuals: dict[str, list[Array]] = {}
        squares: dict[str, list[Array]] = {}
        for s, run in zip(simulations, runs, strict=True):
            for c, y in run.outputs.items():
                if c in s.outputs and np.isfinite(y).any():
                    residuals.setdefault(c, []).append(y - s.outputs[c])
                    squares.setdefault(c, []).append(y[np.isfinite(y)] ** 2)
        return Errors(residuals, {c: float(np.sqrt(np.mean(np.concatenate(v)))) for c, v in squares.items()})

    def limits(self) -> dict[str, float]:
        """Size per channel beyond which a residual is far from what is usual for this model."""
        return {
            c: CLIP * 1.4826 * float(np.nanmedian(np.abs(np.concatenate(list(rs))))) + 1e-300
            for c, rs in self.residuals.items()
        }

    def squares(self, quiet: bool = False, limits: Mapping[str, float] | None = None) -> dict[str, tuple[float, int]]:
        """Return (sum of squares, count) per channel, lone samples left aside if `quiet`, residuals cut at `limits`."""
        found = {}
        for c, rs in self.residuals.items():
            r = np.concatenate([despiked(r) if quiet else r[np.isfinite(r)] for r in rs])
            r = r if limits is None else np.clip(r, -limits[c], limits[c])
            found[c] = (float(r @ r), len(r))
        return found

    def effective(self) -> dict[str, float]:
        """Effective samples per channel."""
        return {c: sum(effective_samples(r) for r in rs) for c, rs in self.residuals.items()}

    def nrmse(self) -> dict[str, float]:
        """RMSE over the RMS of the measured channel."""
        return {
            c: float(np.sqrt(ss / max(n, 1))) / max(self.measured[c], 1e-300) for c, (ss, n) in self.squares().items()
        }


def astray(before: Mapping[str, float], after: Mapping[str, float]) -> tuple[str, ...]:
    """Return the channels that two models, with these NRMSE, both lose: which loses more says nothing."""
    return tuple(c for c, e in before.items() if min(e, after.get(c, 0.0)) > ASTRAY)


@dataclass(frozen=True)
class Gain:
    """One model against another on the same samples.

    Attributes
    ----------
    log_ratio : float
        ½ Σ n_eff·ln(SSR_old/SSR_new): log likelihood ratio on effective samples.
    fall : float
        Relative fall of the error, geometric mean over channels.
    worst : float
        Fall of the channel that gained least (negative: it became worse).
    effective : float
        Effective samples.
    """

    log_ratio: float
    fall: float
    worst: float
    effective: float


def compare_errors(old: Errors, new: Errors, floor: Mapping[str, float] | None = None) -> Gain:
    """Return what `new` gains over `old`; `floor` is the noise per channel, below which nothing is gained.

    What is gained must be gained whether or not large errors are cut: a few of them must not make an effect, and an
    effect must not hide what it spoils in them.
    """
    effective, limits = new.effective(), old.limits()
    whole = _gain(old.squares(quiet=True), new.squares(quiet=True), effective, floor or {})
    cut = _gain(old.squares(limits=limits), new.squares(limits=limits), effective, floor or {})
    return Gain(
        min(whole.log_ratio, cut.log_ratio), min(whole.fall, cut.fall), min(whole.worst, cut.worst), whole.effective
    )


Squares = Mapping[str, tuple[float, int]]


def _gain(before: Squares, after: Squares, effective: Mapping[str, float], floor: Mapping[str, float]) -> Gain:
    logs, weights = [], []
    for c in (c for c in before if c in after):
        # A tenth of the noise is as good as none: ratios of tiny numbers must not decide.
        small = max(before[c][1], 1) * (0.1 * floor.get(c, 0.0)) ** 2 + 1e-300
        logs.append(np.log((before[c][0] + small) / (after[c][0] + small)))
        weights.append(effective[c])
    if not logs:
        return Gain(0.0, 0.0, 0.0, 0.0)
    return Gain(
        0.5 * float(np.dot(weights, logs)),
        1 - float(np.exp(-0.5 * np.mean(logs))),
        1 - float(np.exp(-0.5 * min(logs))),
        float(np.sum(weights)),
    )
