"""Fits by other means: SciPy, a C program for this motor alone, JAX. Each takes what motorid must find by itself.

``way(runs, start, sigma, width) -> parameters``: R, L, K, b, J and, where `start` has six values, dry friction, whose
sgn is smoothed over `width` (rad/s); `sigma` is the noise of current and speed. All runs begin at rest.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
from bench_fit import USUAL, scipy_fit
from scipy.integrate import odeint
from scipy.optimize import least_squares

import motorid as mi

Runs = list[mi.Experiment]
Way = Callable[[Runs, np.ndarray, np.ndarray, float], np.ndarray]


def measured(run: mi.Experiment) -> np.ndarray:
    """Current and speed, (N, 2)."""
    return np.column_stack([run.outputs["i"], run.outputs["omega"]])


def by_differences(runs: Runs, start: np.ndarray, sigma: np.ndarray, width: float) -> np.ndarray:
    """SciPy's LSODA and `least_squares` with finite differences."""
    return scipy_fit(runs, start, sigma, USUAL, width)[0]


def by_sensitivities(runs: Runs, start: np.ndarray, sigma: np.ndarray, width: float) -> np.ndarray:
    """SciPy's odeint on the sensitivity equations, written by hand, and `least_squares`."""
    n, a = len(start), np.zeros((2, 2))
    own = np.zeros((2, n))

    def rates(x: np.ndarray, _: float, v: float, p: np.ndarray) -> np.ndarray:
        r, inductance, k, b, j = p[:5]
        i, w, dry = x[0], x[1], p[5] if n > 5 else 0.0
        smooth = np.tanh(w / width) if n > 5 else 0.0
        di, dw = (v - r * i - k * w) / inductance, (k * i - b * w - dry * smooth) / j
        a[:] = ((-r / inductance, -k / inductance), (k / j, -(b + dry * (1 - smooth * smooth) / width) / j))
        own[0, :3] = -r * i / inductance, -di, -k * w / inductance
        own[1, 2:] = (k * i / j, -b * w / j, -dw, -dry * smooth / j)[:n - 2]
        return np.concatenate([[di, dw], (a @ x[2:].reshape(2, n) + own).ravel()])

    def both(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        res, jac = [], []
        for run in runs:
            v, x = run.inputs["v"], np.zeros((run.n, 2 + 2 * n))
            for b, e in pairwise(np.unique([0, *(np.flatnonzero(np.diff(v)) + 1), run.n - 1])):
                x[b:e + 1] = odeint(rates, x[b], run.t[b:e + 1], (v[b], start * np.exp(q)), rtol=1e-7, atol=1e-9)
            res.append(((x[:, :2] - measured(run)) / sigma).ravel())
            jac.append((x[:, 2:].reshape(-1, 2, n) / sigma[:, None]).reshape(-1, n))
        return np.concatenate(res), np.concatenate(jac)

    last = cache(lambda q: both(np.frombuffer(q)))  # least_squares asks for residual and Jacobian in turn
    done = least_squares(lambda q: last(q.tobytes())[0], np.zeros(n), lambda q: last(q.tobytes())[1], method="lm")
    return start * np.exp(done.x)


@cache
def compiled() -> Callable[..., int] | None:
    """The C program, or None without a compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        return None
    library, source = Path(mkdtemp(prefix="motor_fit")) / "motor_fit.so", Path(__file__).with_name("motor_fit.c")
    subprocess.run([compiler, "-O2", "-shared", "-fPIC", "-o", library, source, "-lm"], check=True)
    found = ctypes.CDLL(str(library))
    shutil.rmtree(library.parent, ignore_errors=True)
    array = np.ctypeslib.ndpointer(dtype=float, flags="C")
    found.fit.argtypes = [ctypes.c_int, np.ctypeslib.ndpointer(dtype=np.intc), array, array, ctypes.c_double, array,
                          ctypes.c_double, array]
    return found.fit


def by_c(runs: Runs, start: np.ndarray, sigma: np.ndarray, width: float) -> np.ndarray:
    """`motor_fit.c`: exact discretisation, exact sensitivities, Levenberg-Marquardt."""
    p, fit = np.append(start, 0.0)[:6], compiled()
    assert fit is not None
    fit(len(runs), np.array([r.n for r in runs], dtype=np.intc), np.concatenate([r.inputs["v"] for r in runs]),
        np.concatenate([measured(r) for r in runs]), runs[0].t[1] - runs[0].t[0], sigma, width, p)
    return p[:len(start)]


@cache
def jitted() -> tuple[Callable[..., np.ndarray], Callable[..., np.ndarray]]:
    """Residual and Jacobian of the motor without friction by JAX: an exact step, scanned over the samples."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)

    def residual(q: jax.Array, start: jax.Array, v: jax.Array, y: jax.Array, dt: float, sigma: jax.Array) -> jax.Array:
        r, inductance, k, b, j = start * jnp.exp(q)
        motor = jnp.array([[-r / inductance, -k / inductance, 1 / inductance], [k / j, -b / j, 0], [0, 0, 0]])
        e = jax.scipy.linalg.expm(motor * dt)

        def step(x: jax.Array, u: jax.Array) -> tuple[jax.Array, jax.Array]:
            return x @ e[:2, :2].T + u[:, None] * e[:2, 2], x

        x = jax.lax.scan(step, jnp.zeros((v.shape[1], 2)), v)[1]  # all runs at once: (N, runs, 2)
        return ((x - y) / sigma).ravel()

    return jax.jit(residual), jax.jit(jax.jacfwd(residual))


def by_jax(runs: Runs, start: np.ndarray, sigma: np.ndarray, width: float) -> np.ndarray:
    """JAX's scan with jit and jacfwd, and SciPy's `least_squares`."""
    residual, jacobian = jitted()
    given = (start, np.column_stack([r.inputs["v"] for r in runs]), np.stack([measured(r) for r in runs], 1),
             runs[0].t[1] - runs[0].t[0], sigma)
    done = least_squares(lambda q: np.asarray(residual(q, *given)), np.zeros(len(start)),
                         lambda q: np.asarray(jacobian(q, *given)), method="lm")
    return start * np.exp(done.x)


def ways(friction: bool) -> tuple[dict[str, Way], list[str]]:
    """What is there to compare with, by name, and a sentence for each that is not."""
    found: dict[str, Way] = {}
    absent = []
    if compiled():
        found["C program for this motor alone"] = by_c
    else:
        absent.append("No C compiler (cc, gcc, clang) was found: the C program is left out.")
    if friction:
        absent.append("JAX is left out with friction: a scan has no steps of varying length.")
    elif find_spec("jax"):
        found["JAX, scan and jacfwd"] = by_jax
    else:
        absent.append("JAX is not installed: it is left out (pip install jax).")
    found["SciPy odeint, hand-derived sensitivities"] = by_sensitivities
    found["SciPy LSODA, finite differences"] = by_differences
    return found, absent
