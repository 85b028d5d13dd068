"""How exact the integration of a record must be: a small part of its noise, or of a far larger misfit."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from motorid.integrate.engine import Array, Trajectory
from motorid.problem.residuals import Measured

NOISE_SHARE = 0.03  # local integration error over the noise
MISFIT_SHARE = 0.1  # of the misfit, where it is what the noise would be
TIGHTEST, LOOSEST = 1e-7, 1e-4  # local integration error over the largest state


class Levels(NamedTuple):
    """What one record tells about the accuracy it needs.

    y (N, ny) measured, `missing` of them or None; by channel (ny,): largest size, noise over it, samples.
    """

    y: Array
    missing: NDArray[np.bool_] | None
    top: Array
    noise: Array
    count: Array

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
        """Return the local error allowed, relative to the largest state; see `Engine.prepare`."""
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
