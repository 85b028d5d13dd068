"""The one statistic behind every decision: how well a model predicts blocks of data that it was not fitted to.

Each run is cut into contiguous blocks (Racine, J. Econometrics 99, 2000). What a fit would have predicted without one
follows without a refit: ``r_b⁽⁻ᵇ⁾ = (I − H_bb)⁻¹ r_b``, ``H = J(JᵀJ + s²I)⁻¹Jᵀ`` (PRESS by blocks: Allen, Technometrics
16(1), 1974), J in solver coordinates, s the scale of the residual: a prior of one unit keeps open directions finite.

Two models are compared by the difference of their log predictive densities, summed over blocks, and its standard error
from their scatter (Vehtari, Gelman & Gabry, Stat. Comput. 27, 2017; Sivula et al., arXiv 2008.10296). The density is
Student's t, with each model's own scale per channel from the other blocks: the discrepancy of a model, not the noise of
the sensor, sets what counts. Coloured errors repeat themselves; a channel counts by the effective share of its samples.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from motorid.diagnosis import thresholds
from motorid.errors import otherwise
from motorid.estimation.continuation import by_continuation
from motorid.estimation.least_squares import FAILURES
from motorid.estimation.result import Fit
from motorid.numerics.autoregression import effective_samples
from motorid.numerics.least_squares import LevenbergMarquardt
from motorid.numerics.signals import Array, despiked
from motorid.problem.problem import Problem
from motorid.problem.simulate import Simulation, at, cut_alike, normalised, settled
from motorid.records.experiment import Experiment

SETTLED = 1e-6  # relative change of the scale at which its iteration stops
QUICK = LevenbergMarquardt(max_iterations=25, ftol=1e-4, xtol=1e-5, looks=0)
FOLD = 10  # contiguous parts of each run, every other one held out, where slopes cannot tell what a block left out does
ROUGH = 1e-4  # accuracy of the integration while starts are compared
ROUNDS = 50
CELLS = 10  # per block, between whose means changes are told


@dataclass(frozen=True, eq=False)
class Errors:
    """Prediction errors of one channel, SI, with the block that each belongs to."""

    values: tuple[Array, ...]  # one per run, (N,), NaN where nothing was measured
    blocks: tuple[NDArray[np.intp], ...]  # number of the block of each sample, counted over all runs
    measured: float  # RMS of the measured samples
    noise: float  # standard deviation of the sensor's noise
    fine: bool = False  # an angle followed as closely as can be asked

    @property
    def misfit(self) -> float:
        """RMS of the errors over the noise, samples that stand alone left aside."""
        r = np.concatenate([despiked(v) for v in self.values])
        return float(np.sqrt(np.mean(r**2))) / max(self.noise, 1e-300)

    @property
    def nrmse(self) -> float:
        """RMS of the errors over that of the measured samples; NaN where these do not move."""
        return normalised(float(np.sqrt(np.nanmean(np.concatenate(self.values) ** 2))), self.measured)


Channels = Mapping[str, Errors]


@dataclass(frozen=True, eq=False)
class Predictions:
    """What a model predicts of data that it was not fitted to."""

    blocks: Channels  # per channel, on blocks of the fitted runs left out in turn
    held_out: Channels  # per channel, on held-out runs; empty without


@dataclass(frozen=True)
class Evidence:
    """One model against another."""

    gain: float  # difference of the log predictive densities (nats), positive for the new one
    se: float  # its standard error
    fall: float  # of the prediction error, geometric mean over channels: where held-out runs say something, of theirs
    held_out_fall: float | None = None  # the same on held-out runs; None without any, or where both models lose them
    worse_there: bool = False  # the new model surely predicts the held-out runs worse, by the score or by their error
    everywhere: float | None = None  # fall over blocks and held-out runs together, each by its samples
    plain: bool = False  # where the score is not sure: the held-out error falls by `PLAIN`, and that is no chance

    @property
    def sure(self) -> bool:
        """Tell whether the difference is more than chance: `STANDARD_ERRORS` of it and at least `NATS`."""
        return is_sure(self.gain, self.se)

    @property
    def worth_it(self) -> bool:
        """Tell whether the new model is surely better, by an amount that matters, and not worse there. That is over all
        samples; held-out runs may rise by as much as blocks fall by chance."""
        fall = self.fall if self.everywhere is None else self.everywhere
        return self.sure and fall > thresholds.MATERIAL and not self.worse_there


def compare(old: Predictions, new: Predictions) -> Evidence:
    """Return what `new` predicts better than `old` on the same data."""
    gone = {*lost_channels(old.held_out, new.held_out), *_fine_enough(old.held_out, new.held_out)}
    unseen = [_without(model.held_out, gone) for model in (old, new)]
    seen = [_without(model.blocks, _fine_enough(old.blocks, new.blocks)) for model in (old, new)]
    here, here_se = _summed(_differences(*seen))
    there, there_se = _summed(_differences(*unseen))
    blocks = _fall(*seen) or 0.0
    held_out = _fall(*unseen)
    worse = held_out is not None and (held_out < -thresholds.MATERIAL or is_sure(-there, there_se))
    gain, se = here + there, float(np.hypot(here_se, there_se))
    if held_out is None:
        return Evidence(gain, se, blocks, None, worse)
    weights = [sum(np.isfinite(r).sum() for e in c.values() for r in e.values) for c in (new.blocks, new.held_out)]
    logs = np.log1p([-min(f, 1 - 1e-12) for f in (blocks, held_out)])
    everywhere = 1 - float(np.exp(np.average(logs, weights=weights if any(weights) else None)))
    open_ = held_out > thresholds.PLAIN and not worse and not is_sure(abs(gain), se)
    plain = open_ and bool(-np.log1p(-held_out) > thresholds.STANDARD_ERRORS * _fall_error(*unseen))
    return Evidence(gain, se, max(blocks, held_out), held_out, worse, everywhere, plain)


def is_sure(gain: float, se: float) -> bool:
    """Tell whether a gain is more than chance."""
    return gain > max(thresholds.STANDARD_ERRORS * se, thresholds.NATS)


def _summed(differences: Array) -> tuple[float, float]:
    """Return the sum over blocks and its standard error."""
    n = len(differences)
    return float(differences.sum()), float(np.sqrt(n * differences.var(ddof=1))) if n > 1 else 0.0


def lost_channels(old: Channels, new: Channels) -> tuple[str, ...]:
    """Return the channels that both models lose: zero is nearer to what was measured than either."""
    return tuple(c for c in old if c in new and min(old[c].nrmse, new[c].nrmse) > thresholds.LOST)


def _fine_enough(old: Channels, new: Channels) -> tuple[str, ...]:
    """Return the angle, where both models follow it so closely that its error is asked no more."""
    return tuple(c for c in old if c in new and old[c].fine and new[c].fine)


def _without(channels: Channels, gone: Collection[str]) -> Channels:
    return {c: e for c, e in channels.items() if c not in gone}


def _fall(old: Channels, new: Channels) -> float | None:
    """Return the relative fall of the error, lone samples left aside, geometric mean over channels and samples. Each
    run counts by its length, not by its size: what a wide swing misses must not hide all others."""
    both = [c for c in old if c in new]
    return 1 - float(np.exp(np.mean([_log_rms(new[c]) - _log_rms(old[c]) for c in both]))) if both else None


def _fall_error(old: Channels, new: Channels) -> float:
    """Return the standard error of the logarithm of `_fall`: jackknife (Efron & Stein, Ann. Statist. 9(3), 1981)."""
    both = [c for c in old if c in new]
    count = 1 + max(int(b.max()) for c in both for b in old[c].blocks)
    without = np.mean([[_log_rms(new[c], k) - _log_rms(old[c], k) for c in both] for k in range(count)], axis=1)
    return float(np.sqrt((count - 1) * without.var()))


def _log_rms(errors: Errors, left_out: int = -1) -> float:
    """Return the logarithm of the RMS of errors, mean over runs, a tenth of the noise at least; not of `left_out`."""
    each = [despiked(v)[b[np.isfinite(v)] != left_out] for v, b in zip(errors.values, errors.blocks, strict=True)]
    runs = [r for r in each if len(r)]
    logs = [0.5 * np.log(np.mean(r**2) + (0.1 * errors.noise) ** 2 + 1e-300) for r in runs]
    return float(np.average(logs, weights=[len(r) for r in runs])) if runs else 0.0


def _differences(old: Channels, new: Channels) -> Array:
    """Return the difference of log densities per block, summed over channels."""
    if not (both := [c for c in old if c in new]):
        return np.zeros(0)
    count = 1 + max(int(b.max()) for c in both for b in old[c].blocks)
    total, seen = np.zeros(count), np.zeros(count, bool)
    for c in both:
        better = min((old[c], new[c]), key=lambda e: e.nrmse).values
        share = sum(effective_samples(r) for r in better) / max(int(np.isfinite(np.concatenate(better)).sum()), 1)
        labels = np.concatenate(old[c].blocks)
        was, now = np.concatenate(old[c].values), np.concatenate(new[c].values)
        known = np.isfinite(was) & np.isfinite(now)
        labels, was, now = labels[known], was[known], now[known]
        each = [_log_densities(r, labels, count, 0.1 * old[c].noise) for r in (was, now)]
        total += share * (each[1] - each[0])
        seen |= np.bincount(labels, minlength=count) > 0
    return total[seen]


def _log_densities(r: Array, labels: NDArray[np.intp], count: int, floor: float) -> Array:
    """Return the log density of each block of `r` under Student's t, its scale from the other blocks, (count,). A tenth
    of the sensor's noise (`floor`) is as good as none: ratios of tiny numbers must not decide."""
    nu = thresholds.DEGREES_OF_FREEDOM
    scale2 = float(np.median(r**2)) + 1e-300
    for _ in range(ROUNDS):  # expectation maximisation of the scale
        before, scale2 = scale2, float(np.mean((nu + 1) / (nu + r**2 / scale2) * r**2)) + 1e-300
        if abs(scale2 - before) < SETTLED * before:
            break
    sizes = np.bincount(labels, minlength=count)
    sums = np.bincount(labels, (nu + 1) / (nu + r**2 / scale2) * r**2, count)
    apart = np.where(sizes < len(r), (sums.sum() - sums) / np.maximum(len(r) - sizes, 1), scale2) + floor**2 + 1e-300
    own = apart[labels]
    return np.bincount(labels, -0.5 * np.log(own) - 0.5 * (nu + 1) * np.log1p(r**2 / (nu * own)), count).astype(float)


def left_out(residual: Array, columns: Array, labels: NDArray[np.intp]) -> Array:
    """Return what `residual` (n,) would be in each block, left out of the fit of `columns` (n, k)."""
    scale2 = float(residual @ residual) / max(len(residual), 1)
    order = np.argsort(labels, kind="stable")
    edges = np.flatnonzero(np.diff(labels[order])) + 1
    blocks = np.split(columns[order], edges)
    products = np.array([[j.T @ r] for j, r in zip(blocks, np.split(residual[order], edges), strict=True)])
    own = np.array([j.T @ j for j in blocks])
    normal = own.sum(axis=0) + scale2 * np.eye(columns.shape[1])
    sizes = np.linalg.solve(normal - own, np.swapaxes(products, 1, 2))[..., 0]
    moved = np.concatenate([j @ by for j, by in zip(blocks, sizes, strict=True)])
    return residual + moved[np.argsort(order, kind="stable")]


def blocks_of(runs: Sequence[Experiment], evenly: bool = False) -> list[NDArray[np.intp]]:
    """Return the block of each sample, `BLOCKS` a run: equal shares of its time (`evenly`: of that alone) and of what
    its outputs do, or all of one step would lie in one or two. A free curve is only extended over a short block."""
    found, first = [], 0
    for run in runs:
        parts = max(min(thresholds.BLOCKS, run.n // 2), 1)
        place = np.arange(run.n) * parts / run.n  # in blocks
        place = place if evenly else (place + parts * _changed(run, min(CELLS * parts, run.n))) / 2
        found.append(first + np.minimum(place.astype(np.intp), parts - 1))
        first += parts
    return found


def _changed(run: Experiment, cells: int) -> Array:
    """Return which share of all changes of the outputs, between means over so many cells, each sample has behind it."""
    edges, shares = np.arange(cells + 1) * run.n // cells, []
    for c, y in run.outputs.items():
        if (known := np.isfinite(y)).any() and cells > 1:
            filled = np.interp(np.arange(run.n), np.flatnonzero(known), y[known])
            change = np.gradient(np.add.reduceat(filled, edges[:-1]) / np.diff(edges))
            path = np.cumsum(np.abs(np.gradient(change) if c == "theta" else change))
            shares += [np.append(0.0, path / path[-1])] if path[-1] > 0 else []
    return np.interp(np.arange(run.n), edges, np.mean(shares, axis=0) if shares else edges / run.n)


def finer(fit: Fit, channel: str) -> bool:
    """Tell whether a channel is an angle followed as closely as can be asked: it sums up every trifle of a run. What
    its noise, white as the jumps of an encoder's counts are, makes of the rate of its error is not the model's."""
    if channel != "theta" or not fit.nrmse.get(channel, np.inf) < thresholds.FINER:
        return False
    squares = list[Array]()
    for s, run in zip(fit.simulations, fit.problem.runs, strict=True):
        if channel in s.experiment.outputs:
            dt, r = np.diff(s.experiment.t), s.residual(channel)
            white = min((thresholds.LARGER * run.sigma[channel]) ** 2, float(np.nanmean(np.diff(r, 2) ** 2)) / 6)
            rates = (np.diff(y) / dt for y in (r, s.experiment.outputs[channel]))
            squares.append(np.array([*(rate**2 for rate in rates), 2 * white / dt**2]))
    error, speed, noise = np.nanmean(every := np.concatenate(squares, axis=1), axis=1)
    sure = 1 + thresholds.STANDARD_ERRORS * np.sqrt(3 / every.shape[1])  # of a mean square of differences of noise
    return bool(error - sure * noise < thresholds.FINER_RATE**2 * speed)


def undecided(fit: Fit) -> set[str]:
    """Return the angle, where it decides nothing: followed so closely."""
    return {c for c in fit.problem.outputs if finer(fit, c)}


@lru_cache(maxsize=4)
def deciding(fit: Fit) -> Fit:
    """Return the fit as effects are to be scored on it: a channel that decides nothing counts by what can be asked."""
    if not (idle := undecided(fit)) or len(idle) == len(fit.problem.outputs):
        return fit
    asked = {c: thresholds.FINER * fit.misfit[c] / max(fit.nrmse[c], 1e-300) for c in idle}
    problem = fit.problem.tuned(noise_factors={**fit.problem.noise_factors, **asked})
    return replace(fit, problem=problem, **dict(zip(("residuals", "jacobian"), problem.residual_and_jacobian(fit.q),
                                                    strict=True)))


def predictions_left_out(fit: Fit, evenly: bool = False) -> Channels | None:
    """Return the errors of `fit` on blocks of its records, each left out in turn; None where slopes lead nowhere
    (cogging far from its phase). Initial states, and parameters at a limit, stay as they were fitted."""
    problem, n = fit.problem, fit.problem.n_outputs
    at_start = {p.name for *_, p in problem.unknowns.initial}
    free = [j for j, p in enumerate(problem.unknown) if p.name not in at_start | fit.at_bound]
    columns = (fit.jacobian[:n] * problem.scaling.slope(fit.q))[:, free]
    blocks = blocks_of(problem.experiments, evenly)
    residual = fit.residuals[:n]
    labels = stacked_labels(problem, blocks)
    moved = otherwise(np.array([np.inf]), np.linalg.LinAlgError, lambda: left_out(residual, columns, labels))
    if not np.isfinite(moved).all() or moved @ moved > thresholds.UNRELIABLE**2 * (residual @ residual):
        return None
    return {c: replace(e, fine=finer(fit, c)) for c, e in by_channel(problem, moved, blocks).items()}


def stacked_labels(problem: Problem, blocks: Sequence[NDArray[np.intp]]) -> NDArray[np.intp]:
    """Return the block of each output residual of a problem, (n,)."""
    each = zip(problem.measured, blocks, strict=True)
    stacked = [m.stack(np.repeat(block[:, None], m.y.shape[1], axis=1).astype(float)) for m, block in each]
    return np.concatenate(stacked).astype(np.intp)


def by_channel(problem: Problem, residual: Array, blocks: Sequence[NDArray[np.intp]]) -> Channels:
    """Return a whitened output residual (n,) of a problem as errors per channel, SI."""
    parts, weights = problem.unstack(residual), [m.weights for m in problem.measured]
    found = {}
    for j, c in enumerate(problem.outputs):
        if runs := [k for k, run in enumerate(problem.runs) if c in run.sigma]:
            measured = np.concatenate([problem.experiments[k].moved(c) for k in runs])
            found[c] = Errors(tuple(parts[k][:, j] / weights[k][j] for k in runs), tuple(blocks[k] for k in runs),
                              float(np.sqrt(np.nanmean(measured**2))),
                              float(np.sqrt(np.mean([problem.runs[k].sigma[c] ** 2 for k in runs]))))
    return found


def held_out_errors(problem: Problem, noise: Mapping[str, float]) -> Channels:
    """Return the errors of a problem's model on runs not fitted; what a run has for itself, as other blocks tell."""
    problem, q = settled(problem)
    errors = errors_of(at(problem, q), noise)
    if problem.unknowns.apart:
        r, jac = problem.residual_and_jacobian(q)
        blocks = blocks_of(problem.experiments)
        own = left_out(r, jac[:, len(problem.unknowns.initial) :], stacked_labels(problem, blocks))
        errors = {c: replace(errors[c], values=e.values) for c, e in by_channel(problem, own, blocks).items()}
    return {c: replace(e, fine=c == "theta" and e.nrmse < thresholds.FINER) for c, e in errors.items()}


def errors_of(simulations: Sequence[Simulation], noise: Mapping[str, float],
              judged: Sequence[Experiment] | None = None) -> Channels:
    """Return the errors of `simulations` in blocks of each run; `judged` gives other measurements there (a fold)."""
    runs = judged if judged is not None else [s.experiment for s in simulations]
    parts: dict[str, list[tuple[Array, NDArray[np.intp], Array]]] = {}
    for sim, run, block in zip(simulations, runs, blocks_of(runs), strict=True):
        for c, y in run.outputs.items():
            if c in sim.outputs and np.isfinite(y).any():
                parts.setdefault(c, []).append((y - sim.outputs[c], block, run.moved(c)[np.isfinite(y)]))
    return {c: Errors(tuple(r for r, _, _ in found), tuple(b for _, b, _ in found),
                      float(np.sqrt(np.mean(np.concatenate([y for _, _, y in found]) ** 2))), noise.get(c, 0.0))
            for c, found in parts.items()}


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Where models are judged."""

    validation: Problem | None  # held-out runs, of the model to begin with
    noise: Mapping[str, float]  # of each channel's sensor, SI

    @staticmethod
    def of(fit: Fit, validate: Sequence[Experiment] | Experiment | None) -> "HeldOut":
        """Prepare the judgement for models of `fit`'s records."""
        noise = {c: s for run in fit.problem.runs for c, s in run.sigma.items()}
        if validate is None:
            return HeldOut(None, noise)
        runs = tuple(cut_alike(fit.problem.experiments, validate))
        problem = fit.problem.with_(experiments=runs, model=fit.model, priors={}, penalties=(), noise_factors={})
        return HeldOut(problem, noise)

    def predictions(self, fit: Fit) -> Predictions:
        """Return what `fit` predicts of data it was not fitted to; SimulationError where held-out runs allow none."""
        held_out: Mapping[str, Errors] = {}
        if self.validation is not None:
            # As finely and sharply as it was fitted: a tiny noise asks for many sub-steps that change nothing here.
            fitted = {"accuracy": fit.problem.accuracy, "width": fit.values.get("sgn_width")}
            held_out = held_out_errors(self.validation.for_model(fit.model).tuned(**fitted), self.noise)
        if (blocks := predictions_left_out(fit)) is None and not held_out:
            blocks = self._refitted(fit)
        return Predictions(blocks or {}, held_out)

    def _refitted(self, fit: Fit) -> Mapping[str, Errors]:
        """Return the errors on every other part of each run, the model refitted to the rest, both ways round."""
        found: dict[str, list[Errors]] = {}
        for odd in (0, 1):
            try:
                problem, test = _fold(fit.problem.for_model(fit.model), odd)
                q = problem.scaling.scaled([fit.initial.get(p.name, p.value) for p in problem.unknown])
                done = by_continuation(problem.begun_at(q), QUICK, wide=False, narrow=False)
                for c, e in errors_of(at(done.problem, done.solution.q), self.noise, test).items():
                    found.setdefault(c, []).append(e)
            except FAILURES:
                return {}
        return {c: self._joined(*both) for c, both in found.items() if len(both) == 2}

    @staticmethod
    def _joined(first: Errors, second: Errors) -> Errors:
        """Return the errors on both halves as one, in the blocks of the runs: comparable with blocks left out."""
        values = tuple(np.where(np.isfinite(a), a, b) for a, b in zip(first.values, second.values, strict=True))
        return Errors(values, first.blocks, float(np.hypot(first.measured, second.measured) / np.sqrt(2)), first.noise)


def _fold(problem: Problem, odd: int) -> tuple[Problem, tuple[Experiment, ...]]:
    """Return the problem without every other part of its records, and those parts."""
    train, test = zip(*(_parted(r, odd) for r in problem.experiments), strict=True)
    runs = tuple(replace(run, experiment=e) for run, e in zip(problem.runs, train, strict=True))
    other = problem.with_(experiments=train, priors={}, penalties=())
    return replace(other, _runs=runs).tuned(noise_factors=problem.noise_factors, accuracy=ROUGH), test


def _parted(run: Experiment, odd: int) -> tuple[Experiment, Experiment]:
    """Return the run with every other part missing, and with the others missing."""
    part = np.minimum(np.arange(run.n) * FOLD // run.n, FOLD - 1) % 2 == odd
    hidden = {c: np.where(part, np.nan, y) for c, y in run.outputs.items()}
    judged = {c: np.where(part, y, np.nan) for c, y in run.outputs.items()}
    keep = {c: y for c, y in hidden.items() if np.isfinite(y).any()}
    return run.with_(outputs=keep or run.outputs), run.with_(outputs=judged)
