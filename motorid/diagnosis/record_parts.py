"""Long records: a diagnosis refits dozens of models, so it looks at less of what would take too long.

Samples that their neighbours predict as well as noise allows are left out; of what is still too long, it looks at
parts. Parts are contiguous and chosen so that together they show what the records show: both directions, slow and fast,
all voltages, early and late. Every part begins where the motor then is, so that an angle drifts no longer than one part
lasts. What takes longer than a part to show (heating) is seen between the parts only.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from motorid.diagnosis.cross_validation import ROUGH
from motorid.effects import LIBRARY
from motorid.errors import MotoridError
from motorid.estimation.fit import solve
from motorid.estimation.least_squares import FAILURES
from motorid.estimation.result import Fit
from motorid.estimation.start_values import with_suited_effects
from motorid.numerics.least_squares import LevenbergMarquardt
from motorid.numerics.signals import Array
from motorid.problem.runs import angle_signal
from motorid.records.experiment import Experiment, part_meta

ENOUGH = 4000  # samples: what is left at least of those that their neighbours predict
SMALL = 0.1  # of the error: a difference that changes no judgement
AFFORDABLE = 24_000  # steps of integration per simulation of all records
WANTED = 12_000  # of what is longer
PART = 1000  # samples
LONG = 20_000  # samples: a first fit of their parts tells whether all of them are affordable
FEW = 4 * PART  # samples of that first fit
NEARLY_ALL = 0.7  # of the samples: no reason to leave out the rest
LEVELS = 8  # of speed and of voltage that parts are to show
TIMES = 4  # and parts of the record


def affordable(fit: Fit) -> Fit:
    """Return `fit`, or the fit of the same model to less of its records if these are too long for many refits."""
    if fit.problem.initial != "auto":
        return fit
    k = 1  # a power of two: every k-th sample tells as much as all do, but for noise
    while _samples(fit.problem.experiments) >= 2 * k * ENOUGH and _predicted(fit, 2 * k):
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
    total = _samples(runs)
    if (parts := parts_of(runs, FEW / total) if total > LONG else None) is None:
        return fit(runs)
    few = fit(parts)
    if (work := _work(few) * total / _samples(parts)) <= AFFORDABLE or few.problem.initial != "auto":
        return fit(runs)
    wanted = parts_of(runs, WANTED / work)
    return few if wanted is None or len(wanted) == len(parts) else fit(wanted)


def parts_of(runs: Sequence[Experiment], share: float) -> list[Experiment] | None:
    """Return parts of records that together are about a `share` of them; None where that is nearly all."""
    parts = [p for run in runs for p in _parts(run, share)]
    return parts if _samples(parts) < NEARLY_ALL * _samples(runs) else None


def _parts(run: Experiment, share: float) -> list[Experiment]:
    """Return parts of a run that together are about a `share` of it."""
    count = max(1, round(run.n * share / PART))
    if run.n < 2 * PART * count:
        return [run]
    meta = {**part_meta(run), "part of": (run.name, run.n)}
    return [run.select(slice(a, a + PART)).with_(name=f"{run.name}[{k + 1}]", meta=meta)
            for k, a in enumerate(_telling(run, count))]


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
    share, seconds = _samples(used) / sum(whole.values()), float(np.median([r.duration for r in used]))
    return (f"The records are long: this rests on {len(used)} parts of {seconds:.2g} s, {100 * share:.0f} % of "
            "the samples, each from a state of its own, so that errors are smaller there than over whole runs; fit the "
            f"model to all of them. {thin}".rstrip())


def _samples(runs: Sequence[Experiment]) -> int:
    return sum(r.n for r in runs)
