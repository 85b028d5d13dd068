"""Sensitivities in units that people compare, and `check_derivatives`: the exact Jacobian beside finite differences."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from motorid.errors import UsageError, positive
from motorid.numerics.parallel import one_thread
from motorid.numerics.signals import Array
from motorid.problem.problem import Problem

if TYPE_CHECKING:
    from pandas import DataFrame

SMALL = 1e-3  # of an unknown's largest slope: a channel with smaller slopes is compared on this scale


@dataclass(frozen=True, eq=False)
class DerivativeCheck:
    """Exact derivatives against central finite differences, per unknown and channel, (unknowns, channels)."""

    unknowns: tuple[str, ...]  # free parameters, then estimated initial states
    channels: tuple[str, ...]  # measured, then "others": priors and penalties, where there are any
    difference: Array  # largest over the samples, relative to the largest exact slope in that channel
    slope: Array  # largest exact one of the whitened residuals with respect to the solver's coordinate
    tolerance: float  # what counts as agreement

    @property
    def worst(self) -> float:
        """Largest relative difference; infinite where a derivative is not a number."""
        return float(np.nan_to_num(self.difference, nan=np.inf).max(initial=0.0))

    @property
    def ok(self) -> bool:
        """Whether all derivatives agree within the tolerance."""
        return self.worst <= self.tolerance

    def table(self) -> "DataFrame":
        """Return the relative differences as a table, unknowns down and channels across."""
        from pandas import DataFrame

        return DataFrame(self.difference, index=list(self.unknowns), columns=list(self.channels))

    def __repr__(self) -> str:
        wide = max(map(len, self.unknowns), default=0)
        lines = [" " * wide + "".join(f"{c:>11} " for c in self.channels)]
        for name, row in zip(self.unknowns, self.difference, strict=True):
            cells = (f"{d:>11.1e}{' ' if d <= self.tolerance else '!'}" for d in row)
            lines.append(f"{name:<{wide}}" + "".join(cells))
        verdict = "agree" if self.ok else "DISAGREE"
        lines.append(f"derivatives {verdict}: worst {self.worst:.1e}, tolerance {self.tolerance:.0e}")
        return "\n".join(lines)


@one_thread
def check_derivatives(problem: Problem, q: Array | None = None, *, steps: Sequence[float] = (5e-3, 3e-4, 2e-5),
                      tolerance: float = 1e-3) -> DerivativeCheck:
    """Compare the exact Jacobian with central finite differences of order four.

    Parameters
    ----------
    problem : Problem
        E.g. ``fit.problem``, or ``mi.Problem(model, runs)``.
    q : ndarray, shape (n,), optional
        Solver coordinates; by default the model's present values.
    steps : sequence of float
        Changes of a coordinate, relative on a logarithmic scale, otherwise in natural sizes of the records.
        The best one counts, unknown by unknown: friction needs short ones, CVODES and IDAS long ones.
    tolerance : float
        CVODES and IDAS reach it at their default accuracy, `Rosenbrock` 1e-7.

    Raises
    ------
    UsageError, SimulationError
        If there is nothing to differentiate, `q` has the wrong length, or the model cannot be simulated there.

    Examples
    --------
    >>> mi.check_derivatives(better.problem).ok
    True
    """
    positive(tolerance=tolerance, **{f"steps[{k}]": h for k, h in enumerate(steps)})
    if not len(steps):
        raise UsageError("check_derivatives() needs a step at least; got none in steps.")
    q = np.array(problem.start if q is None else q, float)
    if not len(q) or q.shape != problem.start.shape:
        raise UsageError("check_derivatives() needs one value in q per free parameter, and at least one; the "
                         f"problem has {len(problem.start)}, q has {q.size}.")
    fine = problem.refined(q)
    _, jac = fine.residual_and_jacobian(q)
    names, group = fine.outputs, np.concatenate([np.nonzero(np.isfinite(m.y))[1] for m in fine.measured])  # per row
    if len(group) < len(jac):
        group, names = np.append(group, np.full(len(jac) - len(group), len(names))), (*names, "others")
    slope = _largest(jac, group, len(names))
    numeric = (np.column_stack([_slope(fine, q, j, h) for j in range(len(q))]) for h in steps)
    difference = np.min([_largest(jac - n, group, len(names)) for n in numeric], axis=0)
    most = slope.max(axis=1, keepdims=True)
    size = np.where(slope > 0, np.maximum(slope, SMALL * most), most)
    relative = np.divide(difference, size, out=np.where(difference > 0, np.inf, 0.0), where=size > 0)
    return DerivativeCheck(tuple(p.name for p in fine.unknown), names, relative, slope, tolerance)


def _largest(rows: Array, group: NDArray[np.intp], n: int) -> Array:
    """Return the largest size in each group of rows, shape (columns, n)."""
    return np.column_stack([np.abs(rows[group == g]).max(axis=0, initial=0.0) for g in range(n)])


def _slope(problem: Problem, q: Array, j: int, h: float) -> Array:
    step = h * np.eye(len(q))[j]
    near, far = (problem.residual(q + n * step) - problem.residual(q - n * step) for n in (1, 2))
    return (8 * near - far) / (12 * h)


def relative_jacobian(problem: Problem, q: Array) -> Array:
    """Return d(outputs over noise)/d(relative parameters), shape (n, k), initial states projected out. A relative
    change of one is a factor of e for positive parameters, the natural size of the unit for others."""
    k = len(problem.model.free_names)
    slopes: list[Any] = [problem.simulate(q, j).dy for j in range(len(problem.runs))]
    jac = np.concatenate([m.stack(dy / m.noise[:, None]) for m, dy in zip(problem.measured, slopes, strict=True)])
    nuisance = jac[:, k:]
    basis = np.linalg.qr(nuisance[:, np.linalg.norm(nuisance, axis=0) > 0])[0]
    return jac[:, :k] - basis @ (basis.T @ jac[:, :k])


def relative_sensitivities(problem: Problem, q: Array) -> tuple[dict[str, Array], ...]:
    """Return per run and channel (N, k): change over the channel's RMS per relative change of a parameter."""
    k, found = len(problem.model.free_names), []
    for j, run in enumerate(problem.runs):
        dy = problem.simulate(q, j).dy
        assert dy is not None
        rms = {c: float(np.sqrt(np.nanmean(y**2))) or 1.0 for c, y in run.experiment.outputs.items()}
        found.append({c: dy[:, m, :k] / rms[c] for m, c in enumerate(problem.outputs) if c in rms})
    return tuple(found)
