"""What an estimation found: `Fit`, and `Failure` where it did not come through."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from motorid.display.display import Shown
from motorid.errors import UsageError
from motorid.model.model import Model
from motorid.numerics.least_squares import gauss_newton_covariance
from motorid.numerics.signals import Array
from motorid.problem.problem import Problem
from motorid.problem.simulate import Evaluation, Simulation, at, evaluate, judge, steady_errors
from motorid.records.experiment import Experiment

UNDETERMINED = 1.0  # relative standard deviation above which a value is not shown as determined


@dataclass(frozen=True, eq=False)
class Fit(Shown):
    """What an estimation found.

    Attributes
    ----------
    problem : Problem
        As solved; its model holds the starting values.
    values : dict of str to float
        All parameters of the model, SI.
    residuals : ndarray, shape (n,)
        Whitened: outputs run by run, then priors and penalties.
    jacobian : ndarray, shape (n, k)
        d residuals / d unknowns in physical units; unknowns are the free parameters, then initial states.
    q : ndarray, shape (k,)
        Solver coordinates of the solution.
    status : str
        ``"converged"``, ``"stalled"``, ``"limit"`` or ``"failed"``.
    message : str
        Why it ended, and what to try where it did not go well.
    history : tuple of float
        Cost after each iteration, cost = ½ rᵀr.
    seconds : float
    integration_error : float
        Largest error of the integration, in units of the noise.
    extra : dict
        What a particular solver adds (multipliers, continuity gaps).
    """

    problem: Problem
    values: Mapping[str, float]
    residuals: Array
    jacobian: Array
    q: Array
    status: str
    message: str
    history: tuple[float, ...]
    seconds: float = 0.0
    integration_error: float = float("nan")
    formulation: str = "plain"
    extra: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def model(self) -> Model:
        """The model with the fitted values: to add an effect to, to simulate, to export."""
        return self.problem.model.start_at(self.values)

    @property
    def cost(self) -> float:
        """½ rᵀr, with priors, penalties and the robust loss."""
        return 0.5 * float(self.residuals @ self.residuals)

    @property
    def chi2(self) -> float:
        """Σ of the squared output residuals over the noise."""
        return float(sum(np.nansum((s.residual(c) / run.sigma[c]) ** 2)
                         for s, run in zip(self.simulations, self.problem.runs, strict=True) for c in run.sigma))

    @property
    def dof(self) -> int:
        """Number of output samples minus number of unknowns."""
        return max(self.problem.n_outputs - len(self.problem.unknown), 1)

    @property
    def iterations(self) -> int:
        """Accepted steps."""
        return len(self.history) - 1

    @cached_property
    def _covariance(self) -> tuple[Array, np.ndarray]:
        # The noise was estimated beforehand; a model that does not reach it is less certain by that much.
        r = self.residuals[:self.problem.n_outputs]
        variance = float(r @ r) / self.dof
        variance = max(variance, 1.0) if self.problem.weights == "noise" else variance
        free = self.extra.get("free")  # directions that active constraints leave, (k, m)
        if free is None:
            return gauss_newton_covariance(self.jacobian, variance)
        covariance, determined = gauss_newton_covariance(self.jacobian @ free, variance)
        return free @ covariance @ free.T, ~np.any(np.abs(free[:, ~determined]) > 0, axis=1)

    @property
    def covariance(self) -> Array:
        """Gauss-Newton covariance of the unknowns, physical units, white residuals assumed; see `covariance()`."""
        return self._covariance[0]

    @cached_property
    def std(self) -> dict[str, float | None]:
        """One standard deviation per parameter, in its unit: 0 where held, None where the data do not determine it."""
        covariance, determined = self._covariance
        found: dict[str, float | None] = dict.fromkeys(self.values, 0.0)
        at_bound = self._at_bound
        for j, p in enumerate(self.problem.unknown):
            if p.name in found:
                sd = float(np.sqrt(max(covariance[j, j], 0.0)))
                vague = p.positive and sd > UNDETERMINED * abs(self.values[p.name])
                found[p.name] = None if not determined[j] or vague or p.name in at_bound else sd
        return found

    @cached_property
    def _at_bound(self) -> set[str]:
        names = set()
        for p in self.problem.unknown:
            value = self.values.get(p.name)
            if value is not None and (value <= p.lower or value >= p.upper) and np.isfinite(value):
                names.add(p.name)
        return names

    @property
    def initial(self) -> dict[str, float]:
        """Estimated initial states, as ``omega_0[run]``."""
        physical = self.problem.scaling.physical(self.q)
        return {p.name: float(physical[j]) for j, p in enumerate(self.problem.unknown) if p.name not in self.values}

    @cached_property
    def simulations(self) -> tuple[Simulation, ...]:
        """The fitted model on the records of the fit."""
        return at(self.problem, self.q)

    @cached_property
    def evaluation(self) -> Evaluation:
        """Errors on the records of the fit, over all runs and run by run."""
        return judge(self.simulations)

    @cached_property
    def steady_state_error(self) -> dict[str, float]:
        """RMS difference of measured and simulated means over the steady parts of the records, SI, per channel."""
        return steady_errors(self.simulations, [run.sigma for run in self.problem.runs])

    @property
    def nrmse(self) -> Mapping[str, float]:
        """RMSE over RMS of the measured channel, per channel."""
        return self.evaluation.nrmse

    @property
    def rmse(self) -> Mapping[str, float]:
        """Root mean square error per channel, SI."""
        return self.evaluation.rmse

    @property
    def tau_e(self) -> float | None:
        """Electrical time constant L/R, s."""
        v = self.values
        return v["L"] / v["R"] if "L" in v else None

    @property
    def tau_m(self) -> float | None:
        """Mechanical time constant R·J/(K² + R·b), s; J/b for a torque-driven model."""
        v = self.values
        if "K" in v:
            return v["R"] * v["J"] / (v["K"] ** 2 + v["R"] * v["b"])
        return v["J"] / v["b"] if v["b"] > 0 else None

    @property
    def damping(self) -> float | None:
        """Damping ratio of the linear motor's two poles."""
        v = self.values
        if "K" not in v or v["L"] <= 0:
            return None
        natural = np.sqrt((v["K"] ** 2 + v["R"] * v["b"]) / (v["L"] * v["J"]))
        return float((v["R"] / v["L"] + v["b"] / v["J"]) / (2 * natural))

    def __repr__(self) -> str:
        errors = ", ".join(f"{c} {100 * e:.2f} %" for c, e in self.nrmse.items())
        name = " + ".join([self.problem.model.base, *self.problem.model.effect_names])
        return f"<fit {self.status}: {name}, NRMSE {errors}>"


@dataclass(frozen=True, repr=False)
class Failure(Shown):
    """A run that failed, kept as a value: where it started, its status and why."""

    start: Mapping[str, float]
    status: str
    message: str


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Shown):
    """Fits side by side: errors on their records, held-out errors, how the parameters moved.

    Attributes
    ----------
    fits : tuple of Fit
    names : tuple of str
        ``base + effects`` of each.
    nrmse : tuple of dict of str to float
    validation_nrmse : tuple of (dict of str to float or None)
    parameters : dict of str to tuple of (value, std) or None
        Per parameter, one entry per fit; None where a model lacks it.
    """

    fits: tuple[Fit, ...]
    names: tuple[str, ...]
    nrmse: tuple[Mapping[str, float], ...]
    validation_nrmse: tuple[Mapping[str, float] | None, ...]
    parameters: Mapping[str, tuple[tuple[float, float | None] | None, ...]]


def compare(fits: Sequence[Fit], validate: Sequence[Experiment] | Experiment | None = None) -> Comparison:
    """Put fits side by side.

    Parameters
    ----------
    fits : sequence of Fit
    validate : Experiment or sequence of Experiment, optional
        Held-out runs to judge each fit on.

    Raises
    ------
    UsageError
        If no fit is given.
    """
    if not fits:
        raise UsageError("compare() takes a list of fits: mi.compare([fit, better]).")
    held = tuple(None if validate is None else dict(evaluate(f, validate).nrmse) for f in fits)
    names = list(dict.fromkeys(n for f in fits for n in f.values if n != "sgn_width"))
    parameters = {n: tuple((f.values[n], f.std[n]) if n in f.values else None for f in fits) for n in names}
    titles = tuple(" + ".join([f.problem.model.base, *f.problem.model.effect_names]) for f in fits)
    return Comparison(tuple(fits), titles, tuple(dict(f.nrmse) for f in fits), held, parameters)
