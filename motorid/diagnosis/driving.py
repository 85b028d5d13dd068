"""How the records are read: what was measured is right, but the voltage or single samples may not be what they seem.

A logger writes the voltage of an instant: of a digital controller it is held until the next sample, of an amplifier
it goes on. A commanded voltage is exact, a measured one carries noise that the motor never saw. Either may act later
than the sample beside which it stands. Read wrongly, any of these leaves a misfit that a lag or a loss of voltage
seems to explain. A few spikes of a sensor hide everything else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motorid.diagnosis.evidence import compare_errors
from motorid.diagnosis.held import train_errors
from motorid.diagnosis.judging import worth_it
from motorid.diagnosis.response import responses
from motorid.diagnosis.revival import revived
from motorid.diagnosis.tangent import Tangent
from motorid.diagnosis.trial import FAILURES
from motorid.experiment import Experiment
from motorid.fit import Fit, solve
from motorid.formatting import number, percent
from motorid.integrate.grid import Array
from motorid.misfit import misfit_over_noise

CHANGING = 0.5  # of the samples at which the voltage must change for its reading to matter
NOISY = -0.25  # correlation of successive changes: noise has -0.5, a smooth course +1
WINDOWS = (5, 15, 45)  # samples of a running median
DELAYS = (-1.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0)  # samples
NEARBY = (-1.0, -0.5, -0.25, -0.1, -0.05, 0.05, 0.1, 0.25, 0.5, 1.0)  # samples beside the best of these
ROUNDS = 5  # of looking nearby
NOISE = (0.9, 1.05)  # times what fast changes tell of the noise: errors that are all noise
PLAIN = 0.1  # fall of the error with another reading
HALF = 0.5  # of that by the answer to small changes, or it is not tried
OTHER = {"zoh": "linear", "linear": "zoh"}


@dataclass(frozen=True)
class Reading:
    """Another reading of the records: what it says, the option for it, and what it makes of a run.

    `late`: it can stand in for an effect, and is tried only where effects leave more than noise.
    """

    says: str
    option: str
    of: Callable[[Experiment], Experiment]
    late: bool = False

    def fitted(self, fit: Fit) -> Fit:
        """Return the fit of the same model to records read so.

        Raises
        ------
        FitError, SimulationError
        """
        runs = tuple(self.of(r) for r in fit.problem.experiments)
        model = revived(fit, fit.model)  # an inductance that a wrong reading had emptied
        return solve(fit.problem.with_(experiments=runs, model=model, balance={}), start="model")

    def remark(self, before: Fit, after: Fit) -> str:
        """Say what was done to the records and what that did to the errors."""
        falls = ", ".join(f"{c} from {percent(e, 3)} to {percent(after.nrmse[c], 3)}" for c, e in before.nrmse.items())
        return f"{self.says}: so read ({self.option}), the error falls, {falls}, and so it is read here."


def without_spikes(fit: Fit) -> Reading | None:
    """Return the reading that leaves out the spikes of a sensor; None without any, or if the loss forgives them."""
    if fit.problem.loss is not None:
        return None
    runs = fit.problem.experiments
    count = sum(
        int(np.isfinite(y).sum() - np.isfinite(quiet.outputs[c]).sum())
        for run, quiet in zip(runs, [r.without_spikes() for r in runs], strict=True)
        for c, y in run.outputs.items()
    )
    if not count:
        return None
    says = f"{count} single samples stand far from both neighbours, as no motor moves, and are left out"
    return Reading(says, "--no-spikes", Experiment.without_spikes)


def better_reading(fit: Fit, late: bool = False) -> Reading | None:
    """Return the reading of the voltage that the records ask for; None if it is the one they have.

    It must make the error of `fit` plainly smaller, and that of no channel larger; errors that are all noise cannot
    become so.

    Parameters
    ----------
    fit : Fit
    late : bool
        All effects that help are in: try what could stand in for one, too.
    """
    if all(NOISE[0] < ratio < NOISE[1] for ratio in misfit_over_noise(fit.problem, fit.q).values()):
        return None
    chosen, fall = None, PLAIN
    for reading in _promising(fit, late):
        try:
            gain = compare_errors(train_errors(fit), train_errors(reading.fitted(fit)))
        except FAILURES:
            continue
        if gain.fall > fall and gain.worst > -PLAIN and worth_it(1, gain):
            chosen, fall = reading, gain.fall
    return chosen


def _promising(fit: Fit, late: bool) -> list[Reading]:
    """Return the readings that are worth a fit by the model's answer to small changes of the voltage, best first."""
    readings = list(_readings(fit.problem.experiments))
    if late and _tells_delays(fit):
        readings.append(_best_delay(fit))
    falls = _falls(fit, readings)
    order = sorted(range(len(readings)), key=lambda k: -falls[k])
    return [readings[k] for k in order if falls[k] > HALF * PLAIN]


def _tells_delays(fit: Fit) -> bool:
    """Tell whether a late voltage can be told from a late sensor: current and motion both follow it."""
    return len({"i", "omega", "theta"} & set(fit.problem.outputs)) > 1 and "i" in fit.problem.outputs


def _best_delay(fit: Fit) -> Reading:
    """Return the delay that lowers the error most: by the answer to small changes, again where that leads.

    Whole samples around it are fitted too: so most loggers are late, and the answer to small changes is not exact.
    """
    tried: dict[float, Fit] = {0.0: fit}
    best, moves = 0.0, DELAYS
    for _ in range(ROUNDS):
        falls = _falls(tried[best], [_delay(fit, n) for n in moves])
        if max(falls) <= 0 or not _try(tried, fit, best + moves[int(np.argmax(falls))]):
            break
        best, moves = next(reversed(tried)), NEARBY
    for whole in (np.floor(best), np.ceil(best)):
        _try(tried, fit, float(whole))
    return _delay(fit, min((n for n in tried if n), key=lambda n: tried[n].chi2, default=best))


def _try(tried: dict[float, Fit], fit: Fit, samples: float) -> bool:
    """Fit the records with the voltage late by so many samples; tell whether that is new and works."""
    samples = round(samples, 6)
    if samples in tried:
        return False
    try:
        tried[samples] = _delay(fit, samples).fitted(fit)
    except FAILURES:
        return False
    return True


def _delay(fit: Fit, samples: float) -> Reading:
    seconds = samples * float(np.median(np.concatenate([np.diff(r.t) for r in fit.problem.experiments])))
    how = f"acts {number(abs(seconds) * 1e3, 3)} ms {'later' if seconds > 0 else 'earlier'} than it was logged"
    return Reading(f"The voltage {how}", f"--delay {seconds:.3g}", lambda r: r.delayed(seconds), late=True)


def _falls(fit: Fit, readings: Sequence[Reading]) -> list[float]:
    """Return about how much each reading lowers the error, geometric mean over the channels.

    The changes of the voltage go through the model's linear answer; what the parameters make up is left aside.
    """
    if not readings:
        return []
    problem, tangent, parts = fit.problem, Tangent.of(fit), []
    for run, (_, weights, index), answer in zip(problem.runs, problem._weights, responses(fit), strict=True):
        now = _mean(run.experiment)
        changes = np.stack([_mean(r.of(run.experiment)) - now for r in readings])
        out = answer.driven(changes[:, :, None] * answer.b[:, :, 0]) * weights[None, :, None]
        out = out.reshape(-1, len(readings))
        parts.append(out if index is None else out[index])
    left = tangent.residual[:, None] + tangent.off(np.concatenate(parts))
    channel = np.concatenate([_channels(w.size, y.size, index) for y, w, index in problem._weights])
    before = np.bincount(channel, tangent.residual**2)
    after = np.stack([np.bincount(channel, column**2) for column in left.T])
    with np.errstate(divide="ignore", invalid="ignore"):
        falls = 1 - np.exp(0.5 * np.nanmean(np.log(after / before), axis=1))
    return [float(f) if np.isfinite(f) else 0.0 for f in falls]


def _mean(run: Experiment) -> Array:
    """Return the mean voltage over each sample, (N-1,)."""
    v = run.inputs["v"]
    return (v[:-1] + v[1:]) / 2 if run.hold == "linear" else v[:-1]


def _channels(ny: int, size: int, index: NDArray[np.int64] | None) -> NDArray[np.int64]:
    """Return which output each residual of a run belongs to."""
    all_ = np.arange(size) % ny
    return all_ if index is None else all_[index]


def _readings(runs: Sequence[Experiment]) -> Iterator[Reading]:
    """Yield the readings that could make a difference."""
    moving = [r for r in runs if _changes(r)]
    if not moving:
        return
    hold = OTHER[moving[0].hold]
    how = "goes on straight from sample to sample" if hold == "linear" else "is held from sample to sample"
    yield Reading(f"The voltage {how}", f"--hold {hold}", lambda r: r.with_(hold=hold) if _changes(r) else r)
    if any(_noisy(r) for r in moving):
        noise = "The voltage was measured with noise that the motor did not see"
        yield Reading(f"{noise}, and is constant between its steps", "--levels", Experiment.levelled)
        for n in WINDOWS:
            yield Reading(noise, f"--median {n}", lambda r, n=n: r.running_median(n))


def _changes(run: Experiment) -> bool:
    return bool(np.count_nonzero(np.diff(run.inputs["v"])) > CHANGING * run.n)


def _noisy(run: Experiment) -> bool:
    """Tell whether the usual changes of the voltage, steps left aside, take back one another."""
    d = np.diff(run.inputs["v"])
    d = np.clip(d, -(limit := 4 * float(np.median(np.abs(d)))), limit)
    return limit > 0 and float(d[1:] @ d[:-1]) < NOISY * float(d @ d)
