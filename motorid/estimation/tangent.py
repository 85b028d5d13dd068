"""A fit seen from what may be added to it: its residual off the tangent space of the fitted parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from motorid.diagnosis.residual_analysis import effective_samples
from motorid.estimation.fit import Fit
from motorid.integrate.engine import Array
from motorid.numerics.whitening import unstacked
from motorid.problem.runs import natural_sizes

SHARED = 0.1  # of the largest share in a combination that is worth a name
INSEPARABLE = 1e-3  # share of an effect's answer that the fitted parameters do not make up together


class Explained(NamedTuple):
    """Share of chi² explained, the coefficients (k,), and what is left of the residual (n,)."""

    share: float
    coefficients: Array
    left: Array


@dataclass(frozen=True, eq=False)
class Tangent:
    """Residual of a fit off the tangent space of its unknowns."""

    fit: Fit
    basis: Array
    residual: Array
    sizes: Mapping[str, float]

    @staticmethod
    def of(fit: Fit) -> Tangent:
        """Return the tangent space of `fit`, singular directions left out."""
        n = fit.problem.n_outputs
        jac, r = fit.jacobian[:n], fit.residuals[:n]
        norms = np.linalg.norm(jac, axis=0)
        q, triangle = np.linalg.qr(jac / np.where(norms > 0, norms, 1.0))
        u, s, _ = np.linalg.svd(triangle)
        basis = q @ u[:, s > 1e-7 * max(s.max(initial=0.0), 1e-300)]
        return Tangent(fit, basis, r - basis @ (basis.T @ r), natural_sizes(fit.problem.experiments, fit.values))

    @property
    def chi2(self) -> float:
        """Sum of squares of the residuals of the outputs."""
        r = self.fit.residuals[: len(self.residual)]
        return float(r @ r)

    def effective(self, residual: Array) -> float:
        """Return how many independent samples a stacked residual is worth."""
        return sum(effective_samples(column) for part in unstacked(self.fit, residual) for column in part.T)

    def off(self, columns: Array) -> Array:
        """Return `columns` (n, k) projected off the tangent space."""
        return columns - self.basis @ (self.basis.T @ columns)

    def explained(self, columns: Array, nonnegative: Sequence[bool]) -> Explained:
        """Return what `columns` (n, k) explain of the residual, those coefficients not negative that must not be."""
        from scipy.optimize import nnls  # slow to import, and not needed before

        c = self.off(columns)
        norms = np.linalg.norm(c, axis=0)
        raw = np.linalg.norm(columns, axis=0)
        usable = norms > 1e-6 * np.maximum(raw, 1e-300)
        scale = np.where(usable, norms, 1.0)
        c = np.where(usable, c / scale, 0.0)
        signed = [j for j, positive in enumerate(nonnegative) if not positive]
        a = np.column_stack([c, -c[:, signed]])
        triangle = np.linalg.qr(np.column_stack([a, -self.residual]), mode="r")
        z, rest = nnls(np.asarray(triangle)[:, :-1], np.asarray(triangle)[:, -1])
        coefficients = z[: c.shape[1]].copy()
        coefficients[signed] -= z[c.shape[1] :]
        inside = float(self.residual @ self.residual)
        left = self.residual + c @ coefficients
        return Explained(max(inside - rest**2, 0.0) / max(self.chi2, 1e-300), coefficients / scale, left)

    def same_as(self, columns: Array) -> tuple[str, ...]:
        """Return the parameters that together make up all of `columns` (n, k); none if something is left of them."""
        size = np.linalg.norm(columns, axis=0)
        if np.any(np.linalg.norm(self.off(columns), axis=0) > INSEPARABLE * size) or not size.all():
            return ()
        names = [p.name for p in self.fit.problem.unknown]
        jac = self.fit.jacobian[: len(columns)]
        norms = np.linalg.norm(jac, axis=0)
        parts = np.linalg.lstsq(jac / np.where(norms > 0, norms, 1.0), columns / size, rcond=1e-7)[0]
        part = {n: float(np.abs(a).max()) for n, a in zip(names, parts, strict=True) if n in self.fit.values}
        return tuple(n for n, a in part.items() if a > SHARED * max(part.values()))
