"""What residuals are worth: effective samples, held-out errors, and the evidence of one model over another.

Samples of a coloured residual repeat one another: n of them are worth n/(1+2Σρ) independent ones (Bayley &
Hammersley, J. R. Stat. Soc. Suppl. 8(2), 1946), the sum ending at the first negative pair of autocorrelations
(Geyer, Stat. Sci. 7(4), 1992). With the channels' variances unknown the log likelihood is −½ Σ n·ln(SSR).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from motorid.estimation.result import Fit
from motorid.numerics.autoregression import effective_samples
from motorid.numerics.noise import despiked, outlier_limit
from motorid.numerics.signals import Array
from motorid.problem.simulate import Simulation
from motorid.records.experiment import Experiment

ASTRAY = 1.0  # NRMSE: zero is nearer to the channel than the model is


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
        return {c: outlier_limit(np.concatenate(list(rs))) + 1e-300 for c, rs in self.residuals.items()}

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
LARGER = 1.5  # of residual to noise: beyond it the noise must be coloured, or something is missing


def far(fit: Fit) -> list[int]:
    """Return which channels' errors are plainly larger than their noise."""
    found = []
    for j, c in enumerate(fit.problem.outputs):
        pairs = zip(fit.simulations, fit.problem.runs, strict=True)
        parts = [despiked(s.residual(c)) / run.sigma[c] for s, run in pairs if c in run.sigma]
        if float(np.sqrt(np.mean(np.concatenate(parts) ** 2))) > LARGER:
            found.append(j)
    return found
