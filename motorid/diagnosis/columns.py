"""What an effect would add to the outputs of a fit: exact slopes where it vanishes, or a finite change.

The model with the effect is made once; its shapes differ in the values of parameters alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from motorid.errors import SimulationError
from motorid.estimation.fit import Fit
from motorid.integrate.engine import Array, Trajectory
from motorid.model.definition import Parameter
from motorid.model.model import Effect, Model
from motorid.problem.problem import Problem
from motorid.problem.unknowns import Point

NUDGE = 1e-9  # of the natural size: where sizes start, so that fmax(tau_s - tau_c, 0) has a slope


@dataclass(frozen=True, eq=False)
class Shape:
    """What an effect adds at one shape of it, to the whitened outputs of a fit.

    Attributes
    ----------
    values : dict of str to float
        Parameters that are no sizes.
    columns : ndarray, shape (n, k)
        Slopes to each of `sizes`, those at a quarter of a period later after them if there is a `phase`; or the one
        change that the effect as it is makes, where there are no `sizes`.
    sizes : tuple of Parameter
    phase : Parameter or None
    weights : tuple of ndarray
        Of the channels, per run.
    """

    values: Mapping[str, float]
    columns: Array
    sizes: tuple[Parameter, ...]
    phase: Parameter | None
    weights: tuple[Array, ...]

    @property
    def nonnegative(self) -> list[bool]:
        """Which columns may not count negatively."""
        if self.phase is not None:
            return [False, False]
        return [p.lower == 0 for p in self.sizes] if self.sizes else [True]

    def weighed_like(self, fit: Fit) -> Shape:
        """Return the shape with the channels weighed as in another fit of the same records."""
        new = weights_of(fit.problem)
        if all(map(np.array_equal, new, self.weights)):
            return self
        rows = []
        for k, (w, old) in enumerate(zip(new, self.weights, strict=True)):
            y, _, index = fit.problem._weights[k]
            ratio = np.broadcast_to(np.where(old > 0, w / np.where(old > 0, old, 1.0), 0.0), y.shape).ravel()
            rows.append(ratio if index is None else ratio[index])
        return replace(self, columns=self.columns * np.concatenate(rows)[:, None], weights=new)


def weights_of(problem: Problem) -> tuple[Array, ...]:
    """Return the weights of the channels, per run."""
    return tuple(w for _, w, _ in problem._weights)


@dataclass(frozen=True, eq=False)
class Added:
    """A fit's model with an effect more, on the fit's records.

    Attributes
    ----------
    fit : Fit
    model : Model
        With the effect.
    pars : sequence of Parameter
        The effect's, as in the model.
    natural : dict of str to float
        Natural size per unit.
    """

    fit: Fit
    model: Model
    pars: Sequence[Parameter]
    natural: Mapping[str, float]

    @staticmethod
    def of(fit: Fit, model: Model, effect: Effect, natural: Mapping[str, float]) -> Added:
        """Return the fit's model with `effect`."""
        return Added(fit, model, [model.parameters[p.name] for p in effect.parameters], natural)

    def grid(self) -> Iterator[dict[str, float]]:
        """Yield the values of the shape parameters to try."""
        axes = [
            [(p.name, g * self.natural.get(p.unit, 1.0)) for g in p.grid] for p in self.pars if p.grid and not p.given
        ]
        yield from (dict(point) for point in itertools.product(*axes))

    def shape(self, values: Mapping[str, float]) -> Shape | None:
        """Return what the effect adds at `values`; None where that cannot be simulated, or is nothing.

        Raises
        ------
        SimulationError
            Where it vanishes.
        """
        sizes = tuple(p for p in self.pars if p.null is not None and not p.positive)
        finite = any(p.null is not None and p.positive for p in self.pars)
        weights = weights_of(self._problem)
        if finite or any(p.name in values for p in sizes):
            change = self._change(values)
            return None if change is None else Shape(values, change[:, None], (), None, weights)
        phase = next((p for p in self.pars if p.periodic and not p.given), None)
        columns = self._slopes(sizes, values)
        if phase is not None:
            columns = np.hstack([columns, self._slopes(sizes, {**values, phase.name: np.pi / 2})])
        return Shape(values, columns, sizes, phase, weights)

    def _slopes(self, sizes: Sequence[Parameter], values: Mapping[str, float]) -> Array:
        """Return the slopes of the whitened outputs to the sizes at their null, (n, len(sizes))."""
        null = {p.name: (p.null or 0.0) + NUDGE * (k + 1) * self.natural.get(p.unit, 1.0) for k, p in enumerate(sizes)}
        at = self._at({**values, **null})
        to = np.zeros((len(at.p), len(sizes)))
        to[[self._place[p.name] for p in sizes], range(len(sizes))] = 1.0
        parts = []
        for k in range(len(self._problem.runs)):
            traj = self._run(k, at, self._problem.unknowns.first_slopes(at, k, to), to)
            parts.append(self._problem.run_residual(k, traj)[1])
        return np.vstack(parts)

    def _change(self, values: Mapping[str, float]) -> Array | None:
        """Return the change (n,) that the effect makes at finite `values`."""
        at = self._at(values)
        try:
            parts = [self._problem.run_residual(k, self._run(k, at))[0] for k in range(len(self._problem.runs))]
        except SimulationError:
            return None
        change = np.concatenate(parts) - plain_residual(self.fit)
        return change if np.any(change) else None

    @cached_property
    def _problem(self) -> Problem:
        return self.fit.problem.for_model(self.model.fix(*self.model.parameters))

    @cached_property
    def _point(self) -> Point:
        """The fit's values and initial states."""
        problem, initial = self._problem, self.fit.initial
        return problem.unknowns.point(problem.scaling.scaled([initial.get(p.name, p.value) for p in problem.unknown]))

    @cached_property
    def _place(self) -> dict[str, int]:
        return {n: j for j, n in enumerate(self._problem.system.parameters)}

    def _at(self, values: Mapping[str, float]) -> Point:
        p = self._point.p.copy()
        for n, value in values.items():
            limits = self.model.parameters[n]
            p[self._place[n]] = np.clip(value, limits.lower, limits.upper)
        return self._point._replace(p=p)

    def _run(self, k: int, at: Point, *slopes: Array) -> Trajectory:
        problem = self._problem
        x0 = problem.unknowns.first_state(at, k)
        return problem._engine.run(problem.system, problem.runs[k].grid, x0, at.p, *slopes)


def plain_residual(fit: Fit) -> Array:
    """Return the whitened output residuals (n,) of a fit without its robust loss."""
    problem = fit.problem
    if problem.loss is None:
        return fit.residuals[: problem.n_outputs]
    return np.concatenate(
        [problem.run_residual(k, problem.simulate(fit.q, k, derivatives=False))[0] for k in range(len(problem.runs))]
    )
