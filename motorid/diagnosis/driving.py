"""How the motor was driven, where the voltage's column leaves that open.

Between samples a converter holds its voltage, an amplifier goes on; read the wrong way the voltage is half a sample
late, which inductance and lags then make up for. A voltage that was measured has noise that the motor never saw, and
the current answers to it all the same. Only the records can tell, and a fit with each other reading costs little.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from motorid.diagnosis.evidence import compare_errors
from motorid.diagnosis.held import train_errors
from motorid.diagnosis.judging import worth_it
from motorid.diagnosis.trial import FAILURES
from motorid.experiment import Experiment
from motorid.fit import Fit, solve
from motorid.formatting import percent
from motorid.misfit import misfit_over_noise

CHANGING = 0.5  # of the samples at which the voltage must change for its reading to matter
NOISY = -0.25  # correlation of successive changes: noise has -0.5, a smooth course +1
WINDOWS = (5, 15, 45)  # samples of a running median
NOISE = (0.9, 1.05)  # times what fast changes tell of the noise: errors that are all noise
PLAIN = 0.1  # fall of the error with another reading
OTHER = {"zoh": "linear", "linear": "zoh"}


@dataclass(frozen=True)
class Reading:
    """Another reading of the voltage: what it says, the option for it, and what it makes of a run."""

    says: str
    option: str
    of: Callable[[Experiment], Experiment]

    def fitted(self, fit: Fit) -> Fit:
        """Return the fit of the same model to records read so.

        Raises
        ------
        FitError, SimulationError
        """
        runs = tuple(self.of(r) for r in fit.problem.experiments)
        return solve(fit.problem.with_(experiments=runs, model=fit.model, balance={}), start="model")

    def remark(self, before: Fit, after: Fit) -> str:
        """Say what was done to the records and what that did to the errors."""
        falls = ", ".join(f"{c} from {percent(e, 3)} to {percent(after.nrmse[c], 3)}" for c, e in before.nrmse.items())
        return f"{self.says}: so read ({self.option}), the error falls, {falls}, and so it is read here."


def better_reading(fit: Fit) -> Reading | None:
    """Return the reading of the voltage that the records ask for; None if it is the one they have.

    It must make the error of `fit` plainly smaller, and that of no channel larger; errors that are all noise cannot
    become so.
    """
    chosen, fall = None, PLAIN
    if all(NOISE[0] < ratio < NOISE[1] for ratio in misfit_over_noise(fit.problem, fit.q).values()):
        return None
    for reading in _readings(fit.problem.experiments):
        try:
            gain = compare_errors(train_errors(fit), train_errors(reading.fitted(fit)))
        except FAILURES:
            continue
        if gain.fall > fall and gain.worst > -PLAIN and worth_it(1, gain):
            chosen, fall = reading, gain.fall
    return chosen


def _readings(runs: Sequence[Experiment]) -> Iterator[Reading]:
    """Yield the readings that could make a difference."""
    moving = [r for r in runs if _changes(r)]
    if not moving:
        return
    hold = OTHER[moving[0].hold]
    how = "goes on straight from sample to sample" if hold == "linear" else "is held from sample to sample"
    yield Reading(f"The voltage {how}", f"--hold {hold}", lambda r: r.with_(hold=hold) if _changes(r) else r)
    if any(_noisy(r) for r in moving):
        for n in WINDOWS:
            yield Reading(
                "The voltage was measured with noise that the motor did not see",
                f"--median {n}",
                lambda r, n=n: r.running_median(n),
            )


def _changes(run: Experiment) -> bool:
    return bool(np.count_nonzero(np.diff(run.inputs["v"])) > CHANGING * run.n)


def _noisy(run: Experiment) -> bool:
    """Tell whether the usual changes of the voltage, steps left aside, take back one another."""
    d = np.diff(run.inputs["v"])
    d = np.clip(d, -(limit := 4 * float(np.median(np.abs(d)))), limit)
    return limit > 0 and float(d[1:] @ d[:-1]) < NOISY * float(d @ d)
