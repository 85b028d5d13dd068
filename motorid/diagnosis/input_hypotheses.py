"""How the records are read: what was measured is right, but the voltage or single samples may not be what they seem.

A logger writes the voltage of an instant: a digital controller holds it until the next sample, that of an amplifier
goes on. A commanded one is exact, a measured one carries noise that the motor never saw, either may act later. Read
wrongly it leaves a misfit that a lag or a loss of voltage seems to explain. A few spikes hide everything else.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from motorid.channels import channel_name
from motorid.diagnosis.cross_validation import ROUGH
from motorid.diagnosis.predictive_score import Predictions, compare, predictions_left_out
from motorid.diagnosis.refit import RACE
from motorid.diagnosis.thresholds import MATERIAL
from motorid.display.numbers import arrow, number
from motorid.estimation.continuation import by_continuation
from motorid.estimation.fit import solve
from motorid.estimation.least_squares import FAILURES
from motorid.estimation.result import Fit
from motorid.numerics.least_squares import LevenbergMarquardt
from motorid.problem.problem import Problem
from motorid.problem.simulate import at, judge, misfit_over_noise, moving
from motorid.records.checks import dead_times, span, unresolved
from motorid.records.experiment import Experiment

CHANGING = 0.5  # of the samples at which the voltage must change for its reading to matter
NOISY = -0.25  # correlation of successive changes: noise has -0.5, a smooth course +1
WINDOWS = (5, 15, 45)  # samples of a running median
# Samples by which the voltage may be late; then, beside the best, whole ones and parts of one.
DELAYS = ((-1.0, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0), (-1.0, -0.5, 0.5, 1.0), (-0.25, 0.25), (-0.1, 0.1))
NOISE = (0.9, 1.05)  # times what fast changes tell of the noise: errors that are all noise
PLAIN, PROMISING = 0.1, 0.05  # fall of the error with another reading, and after a few steps with it
AS_IT_IS = LevenbergMarquardt(looks=0)  # beside a fit whose end was looked into


@dataclass(frozen=True)
class Reading:
    """Another reading of the records: what it says, the option for it, and what it makes of a run."""

    says: str
    option: str
    of: Callable[[Experiment], Experiment]
    start: str = "model"  # where the fit begins; "auto" where records alone say so

    def problem(self, fit: Fit) -> Problem:
        """Return the problem of the same model on records read so."""
        runs = tuple(self.of(r) for r in fit.problem.experiments)
        return fit.problem.with_(experiments=runs, model=fit.model, noise_factors={})

    def fitted(self, fit: Fit, solver: LevenbergMarquardt | None = None) -> Fit:
        """Return the fit of the same model to records read so; FitError or SimulationError where there is none."""
        return solve(self.problem(fit), solver, start=self.start)

    def remark(self, before: Fit, after: Fit) -> str:
        """Say what was done to the records and what that did to the errors."""
        both = {c: (e, after.nrmse[c]) for c, e in moving(before.nrmse).items()}
        how = "falls" if all(now < (1 - MATERIAL) * was for was, now in both.values()) else "becomes"
        said = ", ".join(f"{channel_name(c)} {arrow(*pair)}" for c, pair in both.items())
        return f"{self.says}: with {self.option} the error {how} ({said}), and this diagnosis uses it."


def without_spikes(fit: Fit) -> Reading | None:
    """Return the reading that leaves out the spikes of a sensor; None without any, or if the loss forgives them."""
    if fit.problem.loss is not None:
        return None
    runs = fit.problem.experiments
    gone = [np.isfinite(y) & ~np.isfinite(quiet.outputs[c])
            for run, quiet in ((r, r.without_spikes()) for r in runs) for c, y in run.outputs.items()]
    count, in_a_row = sum(map(np.count_nonzero, gone)), any((g[1:] & g[:-1]).any() for g in gone)
    says = (f"{count} {'samples, some of them in a row,' if in_a_row else 'single samples'} stand far from both "
            "neighbours, which no motor can do, and are left out")
    return Reading(says, "--no-spikes", Experiment.without_spikes, "auto") if count else None


def better_reading(fit: Fit, late: bool = False, earlier: bool = False) -> Reading | None:
    """Return the reading of the voltage that the records ask for; None if it is the one they have.

    It must make the error of `fit` plainly smaller, and that of no channel larger; errors that are all noise cannot
    become so. Dead times that show at the steps come first: friction and inductance would adapt to them. `late`: all
    effects that help are in, and what could stand in for one is tried too. `earlier`: only a voltage that acts earlier
    is, whatever is missing; no motor answers before it is asked.
    """
    chosen, fall, runs = None, PLAIN, fit.problem.experiments
    calm = all(NOISE[0] < ratio < NOISE[1] for ratio in misfit_over_noise(fit.problem, fit.q).values())
    lost = sum(run.n for run in runs if unresolved(run))
    if calm or 2 * lost >= sum(run.n for run in runs):  # what acted between samples, no reading of them tells
        return None
    readings = [r for r in _readings(runs) if not earlier and _fall(fit, r) > PROMISING]
    seen = {"i", "omega", "theta"} & set(fit.problem.outputs)
    if late and "i" in seen and len(seen) > 1:  # current and motion both follow a late voltage, not a late sensor
        readings += _best_delay(fit)
    elif not late:
        readings += [_delay(min(d), span(d))] if not earlier and (d := dead_times(runs)) else _best_delay(fit, True)
    for reading in readings:
        try:
            after = reading.fitted(fit, AS_IT_IS)
            found = compare(*(Predictions(predictions_left_out(f) or {}, {}) for f in (fit, after)))
        except FAILURES:
            continue
        rises = max(e / max(fit.rmse[c], 1e-300) for c, e in after.rmse.items()) > 1 + MATERIAL
        if found.fall > fall and (found.worth_it or reading.start == "auto") and not rises:
            chosen, fall = reading, found.fall
    return chosen


def _best_delay(fit: Fit, earlier: bool = False) -> list[Reading]:
    """Return the delay that lowers the error most after a few steps, tried ever more closely; nothing for little."""
    falls, best = {0.0: 0.0}, 0.0
    dt = float(np.median(np.concatenate([np.diff(r.t) for r in fit.problem.experiments])))
    for moves in DELAYS:
        samples = [n for move in moves if (n := round(best + move, 6)) < 0 or not earlier]
        falls |= {n: _fall(fit, _delay(n * dt)) for n in samples if n not in falls}
        best = max(falls, key=lambda n: falls[n])
    return [_delay(best * dt)] if falls[best] > PROMISING else []


def _fall(fit: Fit, reading: Reading) -> float:
    """Return about how much a reading lowers the error: after a few steps from where the fit is."""
    try:
        done = by_continuation(reading.problem(fit).tuned(accuracy=ROUGH), RACE, wide=False, narrow=False)
        after = judge(at(done.problem, done.solution.q)).rmse
        return 1 - float(np.exp(np.mean([np.log(max(after[c], 1e-300) / max(e, 1e-300)) for c, e in fit.rmse.items()])))
    except FAILURES:
        return -np.inf


def _delay(seconds: float, seen: str = "") -> Reading:
    how = f"{seen or f'{number(abs(seconds) * 1e3, 3)} ms'} {'later' if seconds > 0 else 'earlier'} than it was logged"
    option = f"--delay{' ' if seconds > 0 else '='}{seconds:.3g}"
    return Reading(f"The voltage acts {how}", option, lambda r: r.delayed(seconds), "auto" if seen else "model")


def _readings(runs: Sequence[Experiment]) -> Iterator[Reading]:
    """Yield the readings that could make a difference."""
    if not (moving := [r for r in runs if _changes(r)]):
        return
    hold = "linear" if moving[0].hold == "zoh" else "zoh"
    how = f"is {'linear' if hold == 'linear' else 'constant'} between samples"
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
