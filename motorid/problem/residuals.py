"""Residuals of one record and of priors, in standard deviations; how exact an integration they ask for."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from motorid.errors import SimulationError
from motorid.integrate.engine import Trajectory
from motorid.numerics.signals import Array
from motorid.problem.runs import Run
from motorid.problem.unknowns import Point, Unknowns

LARGEST_SLOPE = 1e100  # of an output; beyond it the numbers mean nothing


class Measured(NamedTuple):
    """One record as residuals see it.

    y (N, ny), NaN where missing; weights (ny,), 0 for channels not measured; `index` of the finite samples in
    the flattened y, None for all; noise (ny,), infinite for channels not measured.
    """

    y: Array
    weights: Array
    index: NDArray[np.int64] | None
    noise: Array
    name: str

    @staticmethod
    def of(run: Run, outputs: Sequence[str], weights: str, factors: Mapping[str, float]) -> Measured:
        """Return `run` with `weights` ``"noise"``, times the factor of each channel, or ``"rms"``."""
        out = run.experiment.outputs
        y = np.column_stack([out.get(c, np.full(run.experiment.n, np.nan)) for c in outputs])
        noise = np.array([run.sigma.get(c, np.inf) for c in outputs])
        if weights == "noise":
            size = noise * [factors.get(c, 1.0) for c in outputs]
        else:
            squares = [float(np.nanmean(out[c] ** 2)) if c in out else np.inf for c in outputs]
            size = np.sqrt(np.maximum(squares, 1e-300))
        finite = np.isfinite(y)
        index = None if finite.all() else np.flatnonzero(finite.ravel())
        return Measured(y, 1.0 / size, index, noise, run.experiment.name)

    @property
    def size(self) -> int:
        """Number of residuals."""
        return self.y.size if self.index is None else len(self.index)

    def residual(self, traj: Trajectory) -> tuple[Array, Array | None]:
        """Return the whitened residual (n,) and its Jacobian (n, nq), if the trajectory has one."""
        for numbers in (traj.y, traj.dy):
            if numbers is not None and not np.abs(numbers).max(initial=0.0) < LARGEST_SLOPE:
                raise SimulationError(f"{self.name}: the simulation grows without bound; the model is unstable with "
                                      "these parameters.")
        jac = None if traj.dy is None else self.stack(traj.dy * self.weights[:, None])
        return self.stack((traj.y - self.y) * self.weights), jac

    def stack(self, values: Array) -> Array:
        """Return (N, ny, …) as rows (n, …), without the missing samples."""
        rows = values.reshape(-1, *values.shape[2:])
        return rows if self.index is None else rows[self.index]

    def unstack(self, rows: Array, missing: float = np.nan) -> Array:
        """Return rows (n, …) as (N, ny, …), with `missing` where there was no sample."""
        full = np.full((self.y.size, *rows.shape[1:]), missing)
        full[slice(None) if self.index is None else self.index] = rows
        return full.reshape(*self.y.shape, *rows.shape[1:])


def prior_residual(priors: Mapping[str, tuple[float, float]], unknowns: Unknowns, at: Point) -> tuple[Array, Array]:
    """Return (value − mean)/std of each free parameter with a prior, and the derivatives with respect to q."""
    names = [p.name for p in unknowns.all]
    columns = [names.index(n) for n in priors if n in names]
    mean, std = np.array([priors[names[j]] for j in columns]).reshape(-1, 2).T
    jac = np.zeros((len(columns), len(names)))
    jac[np.arange(len(columns)), columns] = at.slope[columns] / std
    return (at.physical[columns] - mean) / std, jac


NOISE_SHARE = 0.01  # error of an interval over the noise
MISFIT_SHARE = 0.1  # of the misfit, where it is what the noise would be
TIGHTEST, LOOSEST = 1e-7, 3e-5  # and over the largest state


class Levels(NamedTuple):
    """What one record tells about the accuracy it needs."""

    y: Array  # (N, ny), measured
    missing: NDArray[np.bool_] | None  # (N, ny); None where nothing is
    top: Array  # (ny,), largest size
    noise: Array  # (ny,), over that
    count: Array  # (ny,), samples measured

    @staticmethod
    def of(measured: Measured) -> Levels:
        """Return the levels of a record."""
        y, finite = measured.y, np.isfinite(measured.y)
        missing = None if finite.all() else ~finite
        there = y if missing is None else np.where(missing, 0.0, y)
        top = np.maximum(np.maximum(there.max(axis=0), -there.min(axis=0)), 1e-300)
        count = np.full(y.shape[1], len(y)) if missing is None else np.maximum(finite.sum(axis=0), 1)
        return Levels(y, missing, top, measured.noise / top, count)

    def tolerance(self, slack: float = 1.0) -> float | Callable[[Trajectory], float]:
        """Return the error of an interval allowed, relative to the largest state; see `Engine.prepare`."""
        if NOISE_SHARE * self.noise.min() >= LOOSEST:
            return slack * LOOSEST
        return lambda traj: slack * self._beside(traj)

    def _beside(self, traj: Trajectory) -> float:
        e = traj.y - self.y
        if self.missing is not None:
            e[self.missing] = 0.0
        rms = np.sqrt(np.einsum("ij,ij->j", e, e) / self.count) / self.top
        share = float(np.maximum(self.noise, MISFIT_SHARE * rms).min())
        return min(max(NOISE_SHARE * share, TIGHTEST), LOOSEST)
