"""Robust losses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from motorid.integrate.engine import Array


@dataclass(frozen=True)
class Huber:
    """Robust loss: quadratic within `delta` sigma, linear beyond (Huber, Ann. Math. Stat. 35, 1964)."""

    delta: float = 1.345

    def pseudo(self, r: Array) -> tuple[Array, Array]:
        """Return r̃ with r̃² = 2ρ(r), and dr̃/dr, so that least squares of r̃ minimise the robust loss."""
        size = np.abs(r)
        far = size > self.delta
        root = np.sqrt(np.where(far, 2 * self.delta * size - self.delta**2, 1.0))
        return np.where(far, np.sign(r) * root, r), np.where(far, self.delta / root, 1.0)
