"""Where models are judged: on blocks of the fitted records left out in turn, and on held-out runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from motorid.diagnosis.predictive_score import Errors, Predictions, errors_of, held_out_errors, predictions_left_out
from motorid.estimation.continuation import by_continuation
from motorid.estimation.least_squares import FAILURES
from motorid.estimation.result import Fit
from motorid.numerics.least_squares import LevenbergMarquardt
from motorid.problem.problem import Problem
from motorid.problem.simulate import at, cut_alike
from motorid.records.experiment import Experiment

QUICK = LevenbergMarquardt(max_iterations=25, ftol=1e-4, xtol=1e-5, looks=0)
FOLD = 10  # contiguous parts of each run, every other one held out, where slopes cannot tell what a block left out does
ROUGH = 1e-4  # accuracy of the integration while starts are compared


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Where models are judged."""

    validation: Problem | None  # held-out runs, of the model to begin with
    noise: Mapping[str, float]  # of each channel's sensor, SI

    @staticmethod
    def of(fit: Fit, validate: Sequence[Experiment] | Experiment | None) -> HeldOut:
        """Prepare the judgement for models of `fit`'s records."""
        noise = {c: s for run in fit.problem.runs for c, s in run.sigma.items()}
        if validate is None:
            return HeldOut(None, noise)
        runs = tuple(cut_alike(fit.problem.experiments, validate))
        problem = fit.problem.with_(experiments=runs, model=fit.model, priors={}, penalties=(), noise_factors={})
        return HeldOut(problem, noise)

    def predictions(self, fit: Fit) -> Predictions:
        """Return what `fit` predicts of data that it was not fitted to; SimulationError if it cannot be simulated on
        the held-out runs."""
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
