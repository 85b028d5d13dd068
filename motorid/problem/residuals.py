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
NOISE_SHARE = 0.01  # error of an interval over the noise
MISFIT_SHARE = 0.1  # of the misfit, where it is what the noise would be
TIGHTEST, LOOSEST = 1e-7, 3e-5  # and over the largest state


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
            size = np.maximum(np.sqrt(squares), noise)  # of a stuck motor's speed
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

    def tolerance(self, slack: float = 1.0) -> float | Callable[[Trajectory], float]:
        """Return the error of an interval allowed, relative to the largest state; see `Engine.prepare`."""
        finite = np.isfinite(self.y)
        count = np.maximum(finite.sum(axis=0), 1)
        top = np.maximum(np.abs(np.where(finite, self.y, 0.0)).max(axis=0), 1e-300)
        noise = self.noise / top
        if NOISE_SHARE * noise.min() >= LOOSEST:
            return slack * LOOSEST

        def beside_misfit(traj: Trajectory) -> float:
            e = np.where(finite, traj.y - self.y, 0.0)
            rms = np.sqrt(np.einsum("ij,ij->j", e, e) / count) / top
            share = float(np.maximum(noise, MISFIT_SHARE * rms).min())
            return slack * min(max(NOISE_SHARE * share, TIGHTEST), LOOSEST)

        return beside_misfit


def prior_residual(priors: Mapping[str, tuple[float, float]], unknowns: Unknowns, at: Point) -> tuple[Array, Array]:
    """Return (value − mean)/std of each free parameter with a prior, and the derivatives with respect to q."""
    names = [p.name for p in unknowns.all]
    columns = [names.index(n) for n in priors if n in names]
    mean, std = np.array([priors[names[j]] for j in columns]).reshape(-1, 2).T
    jac = np.zeros((len(columns), len(names)))
    jac[np.arange(len(columns)), columns] = at.slope[columns] / std
    return (at.physical[columns] - mean) / std, jac
