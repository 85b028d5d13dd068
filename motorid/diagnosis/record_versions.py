"""What of the records a search looks at, and how it reads them.

Of long records, samples that their neighbours predict as well as noise allows are left out; of what is still too long a
diagnosis looks at parts, chosen so that together they show what the records show: both directions, slow and fast, all
voltages, early and late. Every part begins where the motor then is, so that an angle drifts no longer than one part
lasts, and runs in before it is judged: a lag remembers. What takes longer to show (heating) is seen between parts only.

The voltage or single samples may not be what they seem. A logger writes the voltage of an instant: a digital controller
holds it until the next sample, that of an amplifier goes on. A measured one carries noise that the motor never saw, any
may act later. Read wrongly it leaves a misfit that a lag or a loss of voltage seems to explain; spikes hide all else.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motorid.channels import channel_name
from motorid.diagnosis.predictive_score import ROUGH, Predictions, compare, predictions_left_out
from motorid.diagnosis.refit import RACE
from motorid.diagnosis.thresholds import MATERIAL
from motorid.display.numbers import arrow, counted, number
from motorid.effects import LIBRARY
from motorid.errors import MotoridError
from motorid.estimation.continuation import by_continuation
from motorid.estimation.fit import solve
from motorid.estimation.least_squares import FAILURES
from motorid.estimation.result import Fit
from motorid.estimation.start_values import with_suited_effects
from motorid.numerics.least_squares import LevenbergMarquardt
from motorid.numerics.signals import Array, gather
from motorid.problem.problem import Problem
from motorid.problem.runs import angle_signal
from motorid.problem.simulate import at, judge, misfit_over_noise, moving
from motorid.records.checks import dead_times, span, unresolved
from motorid.records.experiment import Experiment, part_meta

ENOUGH = 4000  # samples: what is left at least of those that their neighbours predict
SMALL = 0.1  # of the error: a difference that changes no judgement
AFFORDABLE = 24_000  # steps of integration per simulation of all records
WANTED = 12_000  # of what is longer
PART, RUN_IN = 1000, 100  # samples, and those before them that are not judged
LONG = 20_000  # samples: a first fit of their parts tells whether all of them are affordable
FEW = 4 * PART  # samples of that first fit
NEARLY_ALL = 0.7  # of the samples: no reason to leave out the rest
LEVELS = 8  # of speed and of voltage that parts are to show
TIMES = 4  # and parts of the record
WHOLE = 10  # times as long as of its parts: what is worth looking at on whole records, where memory counts


def affordable(fit: Fit) -> Fit:
    """Return `fit`, or the fit of the same model to less of its records if these are too long for many refits."""
    if fit.problem.initial != "auto":
        return fit
    k = 1  # a power of two: every k-th sample tells as much as all do, but for noise
    while samples_of(fit.problem.experiments) >= 2 * k * ENOUGH and _predicted(fit, 2 * k):
        k *= 2
    if k > 1:
        fit = fitted_to(fit, [r.decimate(k).with_(meta={**r.meta, "every": k}) for r in fit.problem.experiments])
    return fitted_to(fit, parts_of(fit.problem.experiments, WANTED / w)) if (w := _work(fit)) > AFFORDABLE else fit


def _work(fit: Fit) -> int:
    """Return the sub-steps of one simulation of all records, with dry friction, too: what is missing asks for more."""
    problems = [fit.problem]
    with suppress(*FAILURES):  # it rubs already
        rubbing = fit.problem.for_model(with_suited_effects(fit.model + LIBRARY["coulomb"], fit.problem.experiments))
        problems.append(rubbing.tuned(accuracy=ROUGH).refined(rubbing.start))
    return max(sum(int(run.grid.substeps.sum()) for run in problem.runs) for problem in problems)


def thinned_alike(fit: Fit, runs: Sequence[Experiment]) -> list[Experiment]:
    """Return as many samples of `runs` as of those that were fitted."""
    return [r.decimate(k) for r in runs] if (k := fit.problem.experiments[0].meta.get("every", 1)) > 1 else list(runs)


def whole_of(fit: Fit, records: Sequence[Experiment]) -> list[Experiment]:
    """Return whole `records`, as many samples of each, where a fit is of parts of them that are not much shorter."""
    parts, runs = fit.problem.experiments, thinned_alike(fit, records)
    return runs if any("part of" in r.meta for r in parts) and samples_of(runs) <= WHOLE * samples_of(parts) else []


def fitted_to(fit: Fit, runs: Sequence[Experiment] | None, effort: LevenbergMarquardt | None = None) -> Fit:
    """Return the fit of the same model to other runs, from where it is; `fit` itself for none, or where that fails."""
    try:
        return fit if runs is None else solve(
            fit.problem.with_(experiments=runs, model=fit.model, noise_factors={}), effort, start="model")
    except (MotoridError, *FAILURES):
        return fit


def _predicted(fit: Fit, k: int) -> bool:
    """Tell whether every k-th sample predicts those between: the model, in each run, by far; its error in all runs
    together, whose noise is one, as well as noise allows: counts dither in one run and not in another."""
    w, sums = np.arange(1, k) / k, dict[str, Array]()
    for s, run in zip(fit.simulations, fit.problem.runs, strict=True):
        for c, sigma in run.sigma.items():
            good = np.isfinite(error := s.residual(c))
            t, total2 = s.experiment.t[good], float(np.sum(error[good] ** 2))
            model2, error2 = (float(np.sum((y[good] - np.interp(t, t[::k], y[good][::k])) ** 2))
                              for y in (s.outputs[c], error))
            if not model2 < SMALL**2 * total2:
                return False
            noise2 = len(t) * sigma**2 * float(np.sum(1 + w**2 + (1 - w) ** 2)) / k  # linearly interpolated, if white
            sums[c] = sums.get(c, 0.0) + np.array([error2, noise2])
    return all(error2 < (1 + SMALL) ** 2 * noise2 for error2, noise2 in sums.values())


def fit_affordably(runs: Sequence[Experiment], fit: Callable[[Sequence[Experiment]], Fit]) -> Fit:
    """Return the fit of `runs` to begin a diagnosis with: of parts, where to fit all would take long."""
    total = samples_of(runs)
    if (parts := parts_of(runs, FEW / total) if total > LONG else None) is None:
        return fit(runs)
    few = fit(parts)
    if (work := _work(few) * total / samples_of(parts)) <= AFFORDABLE or few.problem.initial != "auto":
        return fit(runs)
    wanted = parts_of(runs, WANTED / work)
    return few if wanted is None or len(wanted) == len(parts) else fit(wanted)


def parts_of(runs: Sequence[Experiment], share: float) -> list[Experiment] | None:
    """Return parts of records that together are about a `share` of them; None where that is nearly all."""
    parts = [p for run in runs for p in _parts(run, share)]
    return parts if samples_of(parts) < NEARLY_ALL * samples_of(runs) else None


def _parts(run: Experiment, share: float) -> list[Experiment]:
    """Return parts of a run that together are about a `share` of it."""
    count = max(1, round(run.n * share / PART))
    if run.n < 2 * PART * count:
        return [run]
    quiet = run.without_spikes()  # a part shows less of what is usual
    spikes = {c: run.t[np.isfinite(y) & ~np.isfinite(quiet.outputs[c])] for c, y in run.outputs.items()}
    each = ((a, run.select(slice(max(a - RUN_IN, 0), a + PART))) for a in _telling(quiet, count))
    return [part.with_(name=f"{run.name}[{k}]", meta={**part_meta(run, part), "part of": (run.name, run.n),
                                                      "judged from": run.t[a], "spikes": spikes})
            for k, (a, part) in enumerate(each, 1)]


def _telling(run: Experiment, count: int) -> list[int]:
    """Return where `count` parts begin that show as much as they can of what the record shows, in order of time."""
    begins = np.unique(np.linspace(0, run.n - PART, 4 * (run.n // PART)).astype(int))
    flags = np.concatenate([np.eye(n)[k] for k, n in _kinds(run)], axis=1)  # (N, levels of all kinds)
    counted = np.concatenate([np.zeros((1, flags.shape[1])), np.cumsum(flags, axis=0)])
    shown = counted[begins + PART] - counted[begins]
    chosen: list[int] = []
    for _ in range(count):
        if not (free := [k for k, a in enumerate(begins) if all(abs(a - begins[c]) >= PART for c in chosen)]):
            break
        chosen.append(max(free, key=lambda k: float(np.sqrt(shown[[*chosen, k]].sum(axis=0)).sum())))
    return sorted(int(begins[k]) for k in chosen)


def _kinds(run: Experiment) -> list[tuple[NDArray[np.int_], int]]:
    """Return to which of n levels of speed, of voltage and of time each sample belongs, with n."""
    speed = np.gradient(angle_signal(run), run.t)
    if "omega" in run.outputs:
        speed = np.where(np.isfinite(run.outputs["omega"]), run.outputs["omega"], speed)
    return [(_level(speed), LEVELS), (_level(run.inputs["v"]), LEVELS), (TIMES * np.arange(run.n) // run.n, TIMES)]


def _level(y: Array) -> NDArray[np.int_]:
    """Return in which of `LEVELS` equal steps between its extremes each sample lies."""
    low, high = np.quantile(y, [0.005, 0.995])
    return np.clip(LEVELS * (y - low) / max(high - low, 1e-300), 0, LEVELS - 1).astype(int)


def parts_remark(fit: Fit) -> str:
    """Say which part of the records a fit looked at, if not all."""
    used = fit.problem.experiments
    k = used[0].meta.get("every", 1)
    thin = f"One sample of {k} was used: those between differ by noise alone." if k > 1 else ""
    whole = dict(r.meta.get("part of", (r.name, r.n)) for r in used)
    if not any("part of" in r.meta for r in used):
        return thin
    share = sum(r.n - r.run_in for r in used) / sum(whole.values())
    seconds = float(np.median([r.t[-1] - r.t[r.run_in] for r in used]))
    return (f"The records are long: this rests on {counted(len(used), 'part')} of {seconds:.2g} s, {100 * share:.0f} % "
            "of the samples, each from a state of its own, so that errors are smaller there than over whole runs; fit "
            f"the model to all of them. {thin}".rstrip())


def samples_of(runs: Sequence[Experiment]) -> int:
    """Return how many samples all runs have."""
    return sum(r.n for r in runs)


CHANGING = 0.5  # of the samples at which the voltage must change for its reading to matter
NOISY = -0.25  # correlation of successive changes: noise has -0.5, a smooth course +1
WINDOWS = (5, 15, 45)  # samples of a running median
# Samples that the voltage may be late, or early by one (a row holds what it led to); then near the best, and parts.
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
    delay: float = 0.0  # of the voltage, s

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
    """Return the reading that leaves out the spikes of a sensor; None without any, if the loss forgives them, or where
    they gather at angles of a turn: a wheel that lacks a tooth is no accident."""
    if fit.problem.loss is not None:
        return None
    runs = fit.problem.experiments
    every = [(run, np.isfinite(y) & ~np.isfinite(quiet.outputs[c]))
             for run, quiet in ((r, r.without_spikes()) for r in runs) for c, y in run.outputs.items()]
    gone = [g for _, g in every]
    if gather([(angle_signal(run), g) for run, g in every if "theta" in run.outputs and g.any()]):
        return None
    count, in_a_row = sum(map(np.count_nonzero, gone)), any((g[1:] & g[:-1]).any() for g in gone)
    says = (f"{count} {'samples, some of them in a row,' if in_a_row else 'single samples'} stand far from both "
            "neighbours, which no motor can do, and are left out")
    return Reading(says, "--no-spikes", Experiment.without_spikes, "auto") if count else None


def better_reading(fit: Fit, late: bool = False, earlier: bool = False) -> Reading | None:
    """Return the reading of the voltage that the records ask for; None if it is the one they have.

    It must make the error of `fit` plainly smaller, and that of no channel larger; what is all noise cannot be. Dead
    times that show at the steps come first: friction and inductance would adapt to them. `late`: all effects that help
    are in; what could stand in for one is tried too. `earlier`: only a voltage that acts so, as no motor can."""
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
        readings += [delay_of(min(d), span(d))] if not earlier and (d := dead_times(runs)) else _best_delay(fit, True)
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
    falls, best, every = {0.0: 0.0}, 0.0, fit.problem.experiments[0].meta.get("every", 1)
    dt = float(np.median(np.concatenate([np.diff(r.t) for r in fit.problem.experiments])))
    for moves in DELAYS:
        samples = [n for move in moves if -1 / every <= (n := round(best + move, 6)) < (0 if earlier else np.inf)]
        falls |= {n: _fall(fit, delay_of(n * dt)) for n in samples if n not in falls}
        best = max(falls, key=lambda n: falls[n])
    return [delay_of(best * dt)] if falls[best] > PROMISING else []


def _fall(fit: Fit, reading: Reading) -> float:
    """Return about how much a reading lowers the error: after a few steps from where the fit is."""
    try:
        done = by_continuation(reading.problem(fit).tuned(accuracy=ROUGH), RACE, wide=False, narrow=False)
        after = judge(at(done.problem, done.solution.q)).rmse
        return 1 - float(np.exp(np.mean([np.log(max(after[c], 1e-300) / max(e, 1e-300)) for c, e in fit.rmse.items()])))
    except (MotoridError, *FAILURES):  # a run shorter than the delay
        return -np.inf


def delay_of(delay: float, seen: str = "") -> Reading:
    """Return the reading of a voltage that acts later than logged, by `delay` (s) or as `seen`."""
    how = f"{seen or f'{number(abs(delay) * 1e3, 3)} ms'} {'later' if delay > 0 else 'earlier'} than it was logged"
    option = f"--delay{' ' if delay > 0 else '='}{delay:.3g}"
    return Reading(f"The voltage acts {how}", option, lambda r: r.delayed(delay), "auto" if seen else "model", delay)


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
