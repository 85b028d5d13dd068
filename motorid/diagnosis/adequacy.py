"""Is anything missing at all? Residuals against the noise and against what the motor was doing.

Coloured noise, quantisation and outliers make residuals large or smooth without anything missing. What tells is whether
they depend on the motion: they are binned over speed, current, voltage and angle, and the share of variance that bins
explain is compared with the same after a shift in time against the motion, which keeps the colour of both and breaks
every real dependence (a circular-shift surrogate test, Theiler et al., Physica D 58, 1992). The library's scores, on
effective samples, see what bins cannot. Where both are silent but the errors exceed the noise, `judgement` asks whether
a free form predicts them on data that it was not fitted to: coloured noise cannot be predicted."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from motorid.channels import channel_name
from motorid.diagnosis.free_forms import signals_along
from motorid.diagnosis.misspecification import better_forms, hum_of
from motorid.diagnosis.model_comparison import Node, far
from motorid.diagnosis.predictive_score import finer, undecided
from motorid.diagnosis.results import Adequacy
from motorid.diagnosis.score_test import Score
from motorid.diagnosis.thresholds import FINER, LARGER, SEARCHED
from motorid.display.numbers import factor, listed, percent
from motorid.estimation.result import Fit
from motorid.numerics.autoregression import autocorrelation
from motorid.numerics.signals import Array, despiked, quantum, winsorised
from motorid.problem.simulate import largest
from motorid.records.experiment import Experiment

FALSE_ALARM = 0.02
SHIFTS = 60
BINS = 8
LARGEST_RATIO = 10.0  # of residual to noise: coloured noise with a correlation of 0.99 between neighbours
MATERIAL = 0.03  # share of the residual's variance below which a dependence is not worth a word
ROUNDED = 0.15  # the same where errors are no larger than rounding: that repeats itself at a steady speed
AT_ROUNDING = 1.2  # times the noise of rounding, step/√12
EXACT = 1e-6  # NRMSE of noise-free records: no sensor is that good, and the integration's own error is of this size
NAMES = {"v": "the voltage", "i": "the current", "omega": "the speed", "theta": "the angle within a turn",
         "acceleration": "the acceleration"}


def adequacy(fit: Fit, scores: Sequence[Score] = (), level: float = FALSE_ALARM) -> Adequacy:
    """Judge whether the residuals of `fit` are noise, by `scores` of effects that might be added (see `rank`) too.

    `FALSE_ALARM` is the probability of calling an adequate model inadequate; `level` the p-value that does so. Fast
    changes understate coloured noise by 1/√(1−ρ): 3 times at a correlation of 0.9 between neighbours. Residuals beyond
    ten times the noise (five for an angle) are not noise of any colour."""
    channels = {c: _channel(fit, c) for c in fit.problem.outputs}
    asked = [c for c in channels if c not in (idle := undecided(fit))]
    tests = [*(t for c in asked for t in _dependences(fit, c)), *(_score_tests(scores) if asked else ())]
    least: dict[str | None, float] = {
        c: MATERIAL + (ROUNDED - MATERIAL) * f["rounded"] for c, f in channels.items()}
    # An effect that takes up what is asked no more says nothing: so much of the error that is, as effects are scored.
    sizes = {c: fit.misfit[c] / fit.problem.noise_factors.get(c, 1.0) for c in channels}
    squares = {c: (fit.nrmse[c] / FINER if c in idle else size) ** 2 for c, size in sizes.items()}
    least[None] = float(np.mean([*least.values()])) + sum(squares[c] for c in idle) / max(sum(squares.values()), 1e-300)
    material = [t for t in tests if t["share"] > least[t["channel"]]]
    p_value = min([1.0, *(t["p"] * len(tests) for t in material)])
    far = [c for c, facts in channels.items()
           if facts["ratio"] > LARGEST_RATIO / (2 if c == "theta" else 1) and c in asked]
    exact = largest(fit.nrmse) < EXACT
    adequate = exact or (p_value > level and not far)
    for c, facts in channels.items():
        facts["p_value"] = min([1.0, *(t["p"] for t in tests if t["channel"] == c)])
    text = "The errors are below a millionth of what was measured." if exact else _text(adequate, channels, material)
    return Adequacy(adequate, float(p_value), FALSE_ALARM, channels, f"{text} {fine_angle_remark(fit)}".rstrip())


def fine_angle_remark(fit: Fit) -> str:
    """Say so where the angle is followed less closely than its encoder shows, but as closely as can be asked."""
    if not any(fit.misfit[c] > LARGER and finer(fit, c) for c in fit.problem.outputs):
        return ""
    share, times = percent(fit.nrmse["theta"], 2), factor(fit.misfit["theta"])
    return f"The angle's error, {share}, is {times} times what its encoder shows, but no model is asked for less."


def following(judged: Adequacy, what: str) -> Adequacy:
    """Return a judgement that knows what the errors follow, e.g. "a load that changes with the time"."""
    text = (f"Something is missing: the errors ({_sizes(judged.channels)}) follow {what}." if judged.adequate else
            f"{judged.text} They follow {what}.")
    return judged if what in judged.text else replace(judged, adequate=False, text=text)


def within_noise(judged: Adequacy) -> Adequacy:
    """Return a judgement that knows that nothing predicts how errors no larger than the noise follow the motion."""
    text = (f"The errors ({_sizes(judged.channels)}) are within the noise; what of them depends on the motion no "
            "effect and no free curve predicts on data left out.")
    return replace(judged, adequate=True, text=text)


def _sizes(channels: Mapping[str, Mapping[str, float]]) -> str:
    return ", ".join(f"{channel_name(c)} {factor(f['ratio'])}" for c, f in channels.items()) + " times the noise"


def _residuals(fit: Fit, channel: str) -> list[tuple[int, Array]]:
    return [(k, s.residual(channel)) for k, s in enumerate(fit.simulations)
            if channel in s.experiment.outputs and channel in s.outputs]


def _channel(fit: Fit, channel: str) -> dict[str, float]:
    parts = _residuals(fit, channel)
    noise = float(np.sqrt(np.mean([fit.problem.runs[k].sigma[channel] ** 2 for k, _ in parts])))
    r = np.concatenate([p for _, p in parts])
    r = r[np.isfinite(r)]
    alone = np.concatenate([despiked(p) for _, p in parts])
    ratio = float(np.sqrt(np.mean(alone**2))) / noise if alone.size else 0.0
    return {"noise": noise, "rms": float(np.sqrt(np.mean(r**2))) if r.size else 0.0, "ratio": ratio,
            "rounded": float(ratio < AT_ROUNDING and noise < AT_ROUNDING * _rounding(fit.problem.experiments, channel)),
            "autocorrelation": float(np.mean([autocorrelation(p, 1)[-1] for _, p in parts]))}


@lru_cache(maxsize=8)
def _rounding(runs: tuple[Experiment, ...], channel: str) -> float:
    steps = [quantum(run.outputs[channel]) for run in runs if channel in run.outputs]
    return float(np.sqrt(np.mean(np.square(steps)) / 12))


def _dependences(fit: Fit, channel: str) -> list[dict[str, Any]]:
    """Test the residual of `channel` against every signal of the motion."""
    parts = _residuals(fit, channel)
    every = signals_along(fit)
    motions = [every[k] for k, _ in parts]
    residuals = [winsorised(r) for _, r in parts]
    found = []
    for name in (n for n in NAMES if all(n in m for m in motions)):
        signals, bins = [m[name] for m in motions], BINS
        if name == "theta":
            signals, bins = [np.mod(s, 2 * np.pi) for s in signals], 2 * BINS
        if (edges := np.unique(np.quantile(np.concatenate(signals), np.linspace(0, 1, bins + 1)[1:-1]))).size:
            share, p = _shift_test([np.searchsorted(edges, s, side="right") for s in signals], residuals)
            found.append({"channel": channel, "on": NAMES[name], "share": share, "p": p})
    return found


def _shift_test(labels: Sequence[NDArray[np.intp]], residuals: Sequence[Array]) -> tuple[float, float]:
    """Return the share of variance that bins explain beyond chance, and its p-value against shifted residuals."""
    count = int(max(lab.max() for lab in labels)) + 1
    if (total := sum(float(r @ r) for r in residuals)) <= 0:
        return 0.0, 1.0
    sizes = sum(np.bincount(lab, minlength=count) for lab in labels)
    sums = sum(_sums(lab, r, count) for lab, r in zip(labels, residuals, strict=True))
    actual, *shares = np.sum(sums**2 / np.maximum(sizes, 1), axis=1) / total
    surrogate = np.log(np.array(shares) + 1e-6)
    # Shares of surrogates are nearly log-normal; a tail beyond their number is read from that, Student's t.
    z = (np.log(actual + 1e-6) - surrogate.mean()) / max(float(surrogate.std(ddof=1)), 0.1)
    return max(actual - float(np.exp(surrogate.mean())), 0.0), float(scipy.special.stdtr(8, -z))


def _sums(labels: NDArray[np.intp], r: Array, count: int) -> Array:
    """Return the sums of `r` in each bin, as it is and shifted round by parts of its length, (1 + SHIFTS, count)."""
    n = len(r)
    shifts = np.array([0, *(int(part * n) for part in np.linspace(0.05, 0.95, SHIFTS))])
    inside = np.fft.rfft(labels == np.arange(count)[:, None], axis=1)
    return np.fft.irfft(inside * np.conj(np.fft.rfft(r)), n, axis=1)[:, shifts].T


def _score_tests(scores: Sequence[Score]) -> list[dict[str, Any]]:
    """Turn predicted drops into p-values on effective samples, the search over shapes paid for."""
    found = []
    for s in scores:
        pars = s.effect.parameters
        searched = SEARCHED if any(p.order for p in pars) else 1 + 3 * sum(bool(p.grid) for p in pars)
        chance = scipy.special.chdtrc(len(pars), -s.effective * np.log1p(-min(s.drop, 1 - 1e-12)))
        found.append({"channel": None, "on": s.effect.name, "share": s.drop, "p": min(1.0, searched * float(chance))})
    return found


def _text(adequate: bool, channels: Mapping[str, Mapping[str, float]], material: Sequence[Mapping[str, Any]]) -> str:
    sizes = _sizes(channels)
    if adequate:
        coloured = [channel_name(c) for c, f in channels.items() if f["autocorrelation"] > 0.3 or f["ratio"] > LARGER]
        colour = f" The noise of {listed(coloured)} is coloured." if coloured else ""
        return f"The errors ({sizes}) do not depend on the motion (false-alarm rate {100 * FALSE_ALARM:g} %).{colour}"
    if not material:
        return f"Something is missing: the errors ({sizes}) are too large for noise, even coloured noise."
    if (worst := min(material, key=lambda t: (t["p"], -t["share"])))["channel"] is None:
        why = f"'{worst['on']}' is predicted to explain {100 * worst['share']:.0f} % of them"
    else:
        error = f"{channel_name(worst['channel'])} error"
        why = f"{worst['on']} explains {100 * worst['share']:.0f} % of the variance of the {error}"
    if all(f["ratio"] < 1 for f in channels.values()):
        return (f"Something is missing: the errors are small ({sizes}, exaggerated by fast motion), but they depend on "
                f"the motion: {why}.")
    return f"Something is missing: the errors ({sizes}) are not noise; {why}."


CLEAR = 1e-3  # p-value of errors larger than the noise that needs no second test: few coloured samples tell little


def judge_adequacy(node: Node, scores: Sequence[Score] = ()) -> Adequacy:
    """Judge whether residuals are noise; larger ones are if no form predicts them, unless they surely follow one."""
    judged = adequacy(node.fit, scores)
    if not far(node.fit) or not (doubtful := adequacy(node.fit, scores, level=CLEAR)).adequate:
        return judged
    found = better_forms(node.fit, node.fit, far(node.fit))  # a form that helps the others explains nothing here
    if hum := hum_of(node.fit, found):
        return replace(doubtful, hum=hum, text=f"{doubtful.text} What can be predicted of them is {hum}.")
    if found:
        return following(judged, found[0].form.text)
    names = " and ".join(channel_name(c) for c, f in doubtful.channels.items() if f["ratio"] > LARGER)
    return replace(doubtful, text=f"{doubtful.text} Those of {names} are larger than the fast noise, but no smooth "
                                  "function of time, angle, speed, current or voltage predicts them on data left out.")
