"""Where models are judged: on held-out runs, or on blocks of the fitted ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from motorid.diagnosis.residual_analysis import Errors
from motorid.estimation.continuation import descend
from motorid.estimation.fit import Fit
from motorid.numerics.least_squares import LevenbergMarquardt
from motorid.problem.problem import Problem
from motorid.problem.simulate import at, simulated
from motorid.records.experiment import Experiment

QUICK = LevenbergMarquardt(max_iterations=25, ftol=1e-4, xtol=1e-5)
BLOCKS = 10  # contiguous parts of each run; every other one is held out where there are no held-out runs
ROUGH = 1e-4  # accuracy of the integration while starts are compared
LEAST_FALL = 0.01  # of the held-out error that makes an effect worth having


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Where models are judged.

    Attributes
    ----------
    validation : Problem or None
        Held-out runs, of the model to begin with; None: blocks instead.
    folds : tuple of (training Problem, test Experiments)
        Every other block of the fitted records held out, and the others.
    noise : dict of str to float
    """

    validation: Problem | None
    folds: tuple[tuple[Problem, tuple[Experiment, ...]], ...]
    noise: Mapping[str, float]

    @staticmethod
    def of(fit: Fit, validate: Sequence[Experiment] | Experiment | None) -> HeldOut:
        """Prepare the judgement for models of `fit`'s records."""
        noise = {c: s for run in fit.problem.runs for c, s in run.sigma.items()}
        validation = None
        if validate is not None:
            runs = (validate,) if isinstance(validate, Experiment) else tuple(validate)
            validation = fit.problem.with_(experiments=runs, model=fit.model, priors={}, penalties=(), balance={})
        folds = []
        for odd in (0, 1):
            train, test = zip(*(_blocked(r, odd) for r in fit.problem.experiments), strict=True)
            prepared = tuple(replace(run, experiment=e) for run, e in zip(fit.problem.runs, train, strict=True))
            problem = fit.problem.with_(experiments=train, priors={}, penalties=())
            folds.append((replace(problem, _runs=prepared), test))
        return HeldOut(validation, tuple(folds), noise)

    def errors(self, fit: Fit) -> Errors:
        """Return the errors of `fit` on the held-out runs, or on blocks where there are none.

        Raises
        ------
        SimulationError
        """
        if self.validation is not None:
            return Errors.of(simulated(self.validation.for_model(fit.model)))
        return self.block_errors(fit)

    def block_errors(self, fit: Fit) -> Errors:
        """Return the errors of `fit` on every other block, refitted to the rest, and the other way round.

        Raises
        ------
        SimulationError
        """
        parts = []
        for problem, test in self.folds:
            start = problem.for_model(fit.model).tuned(balance=fit.problem.balance, accuracy=ROUGH)
            if fit.model.angle_input:  # the measured angle, where it is hidden from the judgement too
                runs = zip(fit.problem.runs, problem.runs, strict=True)
                start = replace(start, _runs=tuple(replace(whole, experiment=r.experiment) for whole, r in runs))
            q = start.scaling.scaled([fit.initial.get(p.name, p.value) for p in start.unknown])
            done = descend(restarted(start, q), QUICK, stages=False)
            parts.append(Errors.of(at(done.problem, done.solution.q), test))
        return Errors({c: [r for e in parts for r in e.residuals[c]] for c in parts[0].residuals}, parts[0].measured)


def restarted(problem: Problem, q) -> Problem:
    """Return the problem with the values at `q` as its start, initial states too."""
    values = problem.values(q)
    physical = dict(zip([p.name for p in problem.unknown], problem.scaling.physical(q), strict=True))
    runs = []
    for k, run in enumerate(problem.runs):
        start = run.start.copy()
        for j, c in enumerate(("i", "omega", "theta")):
            if f"{c}_0[{k}]" in physical:  # rounding must not put it outside its limits
                start[j] = np.clip(physical[f"{c}_0[{k}]"], *run.limits[c])
        runs.append(replace(run, start=start))
    return replace(problem, model=problem.model.start_at(values), _runs=tuple(runs))


def _blocked(run: Experiment, odd: int) -> tuple[Experiment, Experiment]:
    """Return the run with every other block missing, and with the others missing."""
    block = np.minimum(np.arange(run.n) * BLOCKS // run.n, BLOCKS - 1) % 2 == odd
    hidden = {c: np.where(block, np.nan, y) for c, y in run.outputs.items()}
    judged = {c: np.where(block, y, np.nan) for c, y in run.outputs.items()}
    keep = {c: y for c, y in hidden.items() if np.isfinite(y).any()}
    return run.with_(outputs=keep or run.outputs), run.with_(outputs=judged)


def train_errors(fit: Fit) -> Errors:
    """Return the errors of a fit on its own records."""
    return Errors.of(fit.simulations)
