"""Levenberg-Marquardt on whitened residuals with exact Jacobians.

The damped step solves ``min ‖J d + r‖² + λ‖D d‖²`` by a QR factorisation of J (never JᵀJ), D being the largest
column norms seen (Moré, "The Levenberg-Marquardt algorithm", 1978), λ following the gain ratio (Nielsen, report
IMM-REP-1999-05). λ = 0 is the Gauss-Newton step. Variables at a bound whose gradient points outward are held for
the step. A residual that cannot be computed counts as a bad step: it is shortened, and the fit goes on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from motorid.errors import FitError, SimulationError
from motorid.integrate.grid import Array


@dataclass(frozen=True)
class LevenbergMarquardt:
    """Options of the least-squares solver.

    Attributes
    ----------
    max_iterations : int
    ftol : float
        Stop when a full step lowers the cost by less than this share.
    xtol : float
        Stop when the scaled step is shorter than this.
    damping : float
        First λ relative to the scaled problem; 0 is Gauss-Newton.
    longest_step : float
        Largest change of one coordinate per iteration: e² on the logarithmic scale.
    """

    max_iterations: int = 200
    ftol: float = 1e-9
    xtol: float = 1e-9
    damping: float = 1e-3
    longest_step: float = 2.0


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the solver ended: q, residual, jac (in q), status, message, history of costs, evaluations.

    `status` is ``"converged"``, ``"stalled"`` (no step lowers the cost) or ``"limit"`` (of iterations).
    """

    q: Array
    residual: Array
    jac: Array
    status: str
    message: str
    history: tuple[float, ...]
    evaluations: int


MESSAGES = {
    "cost": "converged: a full step no longer lowers the cost",
    "step": "converged: the step is below the tolerance",
    "gradient": "converged: the gradient is zero within rounding",
}


def levenberg_marquardt(
    residual: Callable[[Array], Array],
    both: Callable[[Array], tuple[Array, Array]],
    q0: Array,
    bounds: tuple[Array, Array] | None = None,
    options: LevenbergMarquardt | None = None,
    callback: Callable[[int, float, Array], object] | None = None,
) -> Solution:
    """Minimise ½‖r(q)‖² from `q0`.

    Parameters
    ----------
    residual : callable
        ``q -> r`` (n,); may raise `SimulationError`.
    both : callable
        ``q -> (r, jac)`` with jac (n, nq).
    q0 : ndarray, shape (nq,)
    bounds : pair of ndarray, optional
    callback : callable, optional
        Called as ``callback(iteration, cost, q)`` after each accepted step.

    Raises
    ------
    FitError
        If the residual cannot be computed at the start.
    """
    o = options or LevenbergMarquardt()
    low, high = bounds if bounds is not None else (np.full(len(q0), -np.inf), np.full(len(q0), np.inf))
    q = np.clip(np.asarray(q0, float), low, high)
    try:
        r, jac = both(q)
    except SimulationError as error:
        raise FitError(f"the model cannot be simulated at the start: {error} Give other starting values with "
                       "model.replace(…), or leave them out.") from None
    cost, lam, nu = 0.5 * float(r @ r), o.damping, 2.0
    size = np.zeros(len(q))
    history, evaluations, status, message = [cost], 1, "limit", f"stopped after {o.max_iterations} iterations; raise max_iterations or look at identifiability()"
    for iteration in range(1, o.max_iterations + 1):
        held = ((q <= low) & (jac.T @ r > 0)) | ((q >= high) & (jac.T @ r < 0))
        free = ~held
        gradient, norms = jac.T @ r, np.sqrt(np.einsum("ij,ij->j", jac, jac))
        size = np.maximum(size, norms)
        d_scale = np.where(size > 0, size, 1.0)
        if not free.any() or np.max(np.abs(gradient[free]) / d_scale[free]) <= 1e-14 * np.sqrt(2 * cost) + 1e-300:
            status, message = "converged", MESSAGES["gradient"]
            break
        triangle, rotated = _reduce(jac[:, free], r)
        accepted = False
        while not accepted:
            step = np.zeros(len(q))
            step[free] = _inside(triangle, rotated, d_scale[free], lam, (low - q)[free], (high - q)[free])
            worst = np.max(np.abs(step))
            if worst > o.longest_step:
                step *= o.longest_step / worst
            trial = np.clip(q + step, low, high)
            step = trial - q
            predicted = -float(gradient @ step) - 0.5 * float(np.sum((triangle @ step[free]) ** 2))
            small = np.max(np.abs(step) / (np.abs(q) + 1.0)) < o.xtol
            new = _cost(residual, trial)
            evaluations += 1
            gain = (cost - new) / predicted if predicted > 0 else -1.0
            if new < cost and gain > 1e-4:
                accepted = True
                lam *= max(1 / 3, 1 - (2 * min(gain, 1.0) - 1) ** 3)
                lam, nu = max(lam, 1e-12) if o.damping else 0.0, 2.0
            elif small or predicted <= o.ftol * 1e-3 * cost:
                break
            else:
                lam, nu = (lam * nu if lam > 0 else 1e-3), nu * 2
                if lam > 1e16:
                    break
        if not accepted:
            status, message = ("converged", MESSAGES["step"]) if small or predicted <= o.ftol * cost else (
                "stalled", "stalled: no step lowers the cost; the model may be too stiff here. Try another start or engine")
            break
        drop, q = cost - new, trial
        r, jac = both(q)
        evaluations += 1
        cost = 0.5 * float(r @ r)
        history.append(cost)
        if callback is not None:
            callback(iteration, cost, q)
        if small or (drop <= o.ftol * cost and lam < 1.0):
            status, message = "converged", MESSAGES["step" if small else "cost"]
            break
    return Solution(q, r, jac, status, message, tuple(history), evaluations)


def _reduce(jac: Array, r: Array) -> tuple[Array, Array]:
    """Return R and Qᵀr of jac = QR, through the R of [J r], which needs no Q."""
    full = np.linalg.qr(np.column_stack([jac, r]), mode="r")
    n = jac.shape[1]
    if full.shape[0] < n:  # fewer residuals than unknowns
        full = np.vstack([full, np.zeros((n - full.shape[0], n + 1))])
    return full[:n, :n], full[:n, n]


def _inside(triangle: Array, rotated: Array, size: Array, lam: float, low: Array, high: Array) -> Array:
    """Damped step within the box: what would leave it is put on its bound, and the others are solved again."""
    step, loose = np.zeros(len(size)), np.ones(len(size), bool)
    while loose.any():
        rest = rotated + triangle[:, ~loose] @ step[~loose]
        step[loose] = _damped(triangle[:, loose], rest, size[loose], lam)
        out = loose & ((step < low) | (step > high))
        if not out.any():
            break
        step[out] = np.clip(step, low, high)[out]
        loose &= ~out
    return step


def _damped(triangle: Array, rotated: Array, size: Array, lam: float) -> Array:
    """Solve the damped problem by QR of the small stacked system, in scaled unknowns."""
    scaled = triangle / size
    if lam == 0:
        return -np.linalg.lstsq(scaled, rotated, rcond=None)[0] / size
    stacked = np.vstack([scaled, np.sqrt(lam) * np.eye(len(size))])
    q, small = np.linalg.qr(stacked)
    return -np.linalg.solve(small, q[:len(rotated)].T @ rotated) / size


def _cost(residual: Callable[[Array], Array], q: Array) -> float:
    try:
        r = residual(q)
    except SimulationError:
        return np.inf
    cost = 0.5 * float(r @ r)
    return cost if np.isfinite(cost) else np.inf


def gauss_newton_covariance(jac: Array, variance: float = 1.0) -> tuple[Array, Array]:
    """Return the covariance (JᵀJ)⁻¹·variance, and which coordinates the data determine.

    Columns are scaled to unit length first; directions with singular values below 1e-8 of the largest are left
    out, and a coordinate with a noticeable part in such a direction counts as not determined.

    Returns
    -------
    covariance : ndarray, shape (n, n)
    determined : ndarray of bool, shape (n,)
    """
    norms = np.sqrt(np.einsum("ij,ij->j", jac, jac))
    size = np.where(norms > 0, norms, 1.0)
    triangle = np.linalg.qr(jac / size, mode="r")
    _, s, vt = np.linalg.svd(triangle, full_matrices=True)
    s = np.concatenate([s, np.zeros(vt.shape[0] - len(s))])
    good = s > 1e-8 * max(s.max(initial=0.0), 1e-300)
    half = vt[good].T / s[good] / size[:, None]
    lost = np.sum(vt[~good] ** 2, axis=0) > 1e-6
    return variance * half @ half.T, (norms > 0) & ~lost


__all__ = ["LevenbergMarquardt", "Solution", "gauss_newton_covariance", "levenberg_marquardt"]
