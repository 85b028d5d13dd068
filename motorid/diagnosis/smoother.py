"""The unknown voltage and torque that would make the model match, as functions of time.

A batch smoother: states and unknown inputs d = (voltage, torque) at every sample minimise the misfit of the
measurements, of the model's own step, and of the steps of d, a random walk (Rauch, Tung & Striebel, AIAA J. 3(8),
1965, in the least-squares form of Aravkin, Burke & Pillonetto, Automatica 86, 2017). Gauss-Newton; the normal
equations are banded, so the work is proportional to the length of the record.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, solveh_banded

from motorid.estimation.fit import Fit
from motorid.estimation.linearisation import linear_steps, parameter_vector, shown
from motorid.integrate.engine import Array

STEPS = 4  # Gauss-Newton iterations
MODEL_ERROR = 1e-5  # of a state's size: how exactly one step of the model must hold


class Smoothed(NamedTuple):
    """Unknown inputs (N, 2), states (N, nx), chi² of the measurements per sample."""

    d: Array
    x: Array
    chi2: float


class Linear(NamedTuple):
    """One step from every sample, x⁺ (N-1, nx) with its slopes A and B, and the outputs (N, ny) with theirs."""

    x_next: Array
    a: Array
    b: Array
    out: Array
    c: Array


class Begun(NamedTuple):
    """States (N, nx) to begin at, and the model linearised there."""

    x: Array
    linear: Linear


def smooth(fit: Fit, k: int, walk: Array, begun: Begun) -> Smoothed:
    """Return the smoothed run `k`.

    Parameters
    ----------
    fit : Fit
    k : int
    walk : ndarray, shape (2,)
        Step size of the random walk, V/√s and N·m/√s; 0 holds it at zero.
    begun : Begun
        Where to begin, see `begin`; the same for every walk.
    """
    run, system = fit.problem.runs[k], fit.problem.system
    p = parameter_vector(fit)
    y, _, _ = fit.problem._weights[k]
    weights = np.array([1.0 / run.sigma[c] if c in run.sigma else 0.0 for c in fit.problem.outputs])
    x, linear = begun
    n, nx = x.shape
    d = np.zeros((n, 2))
    size = np.maximum(np.abs(x).max(axis=0), 1e-9)
    hold = np.where(walk > 0, 1.0 / np.maximum(walk, 1e-300), 0.0)
    for again in range(STEPS):
        if again:
            linear = _linear(fit, k, x, d)
        step = _banded_step(
            n,
            nx,
            (y - linear.out) * weights,
            linear.c * weights[None, :, None],
            linear.x_next - x[1:],
            linear.a,
            linear.b,
            MODEL_ERROR * size * np.sqrt(np.median(run.grid.dt) / run.grid.dt.sum() * 100),
            d,
            hold,
            run.grid.dt,
            walk > 0,
        )
        x, d = x + step[:, :nx], d + step[:, nx:]
        if np.max(np.abs(step[:, :nx]) / size) < 1e-4:
            break
    out, _ = shown(system, run.grid, x, p)
    e = (y - out) * weights
    return Smoothed(d, x, float(np.nanmean(e[:, weights > 0] ** 2)))


def begin(fit: Fit, k: int) -> Begun:
    """Return where to begin, (N, nx), what was measured where it was, and the model linearised about that."""
    run, sim = fit.problem.runs[k], fit.simulations[k]
    x = np.column_stack([sim.states[s] for s in fit.problem.system.states])
    for j, s in enumerate(fit.problem.system.states):
        if s in run.experiment.outputs:
            seen = run.experiment.outputs[s]
            good = np.isfinite(seen)
            x[:, j] = np.interp(run.experiment.t, run.experiment.t[good], seen[good])
    return Begun(x, _linear(fit, k, x, np.zeros((len(x), 2))))


def _linear(fit: Fit, k: int, x: Array, d: Array) -> Linear:
    """Return the model linearised at the states `x` and the inputs `d`."""
    grid, system, p = fit.problem.runs[k].grid, fit.problem.system, parameter_vector(fit)
    return Linear(*linear_steps(system, grid, x, p, d[:-1]), *shown(system, grid, x, p))


def _banded_step(n, nx, misfit, c, defect, a, b, model, d, hold, dt, free) -> Array:
    """Solve one Gauss-Newton step for (δx, δd), (n, nx+2), by a banded Cholesky factorisation."""
    m = nx + 2
    diagonal, below = np.zeros((n, m, m)), np.zeros((n - 1, m, m))
    rhs = np.zeros((n, m))
    e = np.where(np.isfinite(misfit), misfit, 0.0)
    cc = np.where(np.isfinite(misfit)[:, :, None], c, 0.0)
    diagonal[:, :nx, :nx] += np.einsum("nyi,nyj->nij", cc, cc)
    rhs[:, :nx] += np.einsum("nyi,ny->ni", cc, e)
    # defect_k = Φ(x_k, d_k) - x_{k+1}:  A δx_k + B δd_k - δx_{k+1} + defect = 0, weighed by 1/model
    g = np.concatenate([a, b * free], axis=2) / model[None, :, None]
    back = np.zeros((nx, m))
    back[:, :nx] = -np.diag(1.0 / model)
    w = defect / model
    diagonal[:-1] += np.einsum("nki,nkj->nij", g, g)
    diagonal[1:] += back.T @ back
    below += np.einsum("ki,nkj->nij", back, g)
    rhs[:-1] -= np.einsum("nki,nk->ni", g, w)
    rhs[1:] -= w @ back
    # (d_{k+1} - d_k)·hold/√dt
    h = hold[None, :] ** 2 / dt[:, None]
    j = np.arange(nx, m)
    diagonal[:-1, j, j] += h
    diagonal[1:, j, j] += h
    below[:, j, j] -= h
    jump = d[1:] - d[:-1]
    rhs[:-1, nx:] += h * jump
    rhs[1:, nx:] -= h * jump
    diagonal[:, j, j] += np.where(free, 1e-12 * hold**2, 1.0)
    return _solve_blocks(diagonal, below, rhs)


def _solve_blocks(diagonal: Array, below: Array, rhs: Array) -> Array:
    n, m, _ = diagonal.shape
    scale = 1.0 / np.sqrt(np.maximum(np.einsum("nii->ni", diagonal), 1e-300))
    diagonal = diagonal * scale[:, :, None] * scale[:, None, :]
    below = below * scale[1:, :, None] * scale[:-1, None, :]
    band = np.zeros((2 * m, n * m))  # lower form: band[i - j, j]
    for r in range(m):
        for c in range(m):
            if r >= c:
                band[r - c, c::m] = diagonal[:, r, c]
            band[m + r - c, c : (n - 1) * m : m] = below[:, r, c]
    band[0] += 1e-12
    try:
        z = solveh_banded(band, (rhs * scale).ravel(), lower=True, check_finite=False)
    except LinAlgError:
        band[0] += 1e-6
        z = solveh_banded(band, (rhs * scale).ravel(), lower=True, check_finite=False)
    return z.reshape(n, m) * scale
