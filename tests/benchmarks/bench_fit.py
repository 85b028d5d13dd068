"""Time a whole fit beside SciPy's: same two noisy records, same start, same stopping accuracy, in one process.

    python tests/benchmarks/bench_fit.py [--repeat 7] [--emps PATH/run.csv]

SciPy integrates with `solve_ivp(method="LSODA")`, restarted at each step of the voltage, and estimates with
`least_squares` on the same logarithmic coordinates, from motorid's automatic start, which it gets for nothing.
Its tolerances and difference step are tried out and the fastest choice that reaches the optimum is the rival.
Times are process times, the least of several rounds in which everybody takes a turn. With ``--emps`` the long
record (24,841 samples) is fitted at a quarter, half and full length.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import motorid as mi

NAMES = ("R", "L", "K", "b", "J")
CHOICES = [(rtol, step, how) for rtol in (1e-6, 1e-7, 1e-8, 1e-9) for step in (1e-5, 1e-4, 1e-3)
           for how in ("lm", "trf")]
AIMS = {"compiled": 40, "virtual machine": 5, "cvodes": 4}


def simulate(values: np.ndarray, run: mi.Experiment, rtol: float) -> np.ndarray:
    """(i, omega) at the samples, (N, 2), by SciPy."""
    r, inductance, k, b, j = values
    v, t = run.inputs["v"], run.t
    cuts = np.unique([0, *(np.flatnonzero(np.diff(v)) + 1), len(t) - 1])
    x, out = np.zeros(2), np.zeros((len(t), 2))
    for a, e in zip(cuts[:-1], cuts[1:], strict=True):
        done = solve_ivp(
            lambda _, x, va=v[a]: ((va - r * x[0] - k * x[1]) / inductance, (k * x[0] - b * x[1]) / j),
            (t[a], t[e]), x, method="LSODA", t_eval=t[a:e + 1], rtol=rtol, atol=rtol * 1e-2)
        out[a:e + 1], x = done.y.T, done.y[:, -1]
    return out


def scipy_fit(runs: list[mi.Experiment], start: np.ndarray, sigma: np.ndarray, choice: tuple) -> tuple[float, int]:
    """χ² reached and number of simulations."""
    rtol, step, how = choice
    measured = [np.column_stack([r.outputs["i"], r.outputs["omega"]]) for r in runs]
    count = 0

    def residual(q: np.ndarray) -> np.ndarray:
        nonlocal count
        count += 1
        with np.errstate(all="ignore"):
            return np.concatenate([((simulate(start * np.exp(q), r, rtol) - y) / sigma).ravel()
                                   for r, y in zip(runs, measured, strict=True)])

    done = least_squares(residual, np.zeros(5), diff_step=step, method=how, ftol=1e-9, xtol=1e-9, gtol=1e-12)
    return 2 * done.cost, count


def seconds(work: Callable[[], object]) -> float:
    """Process time of one call."""
    began = time.process_time()
    work()
    return time.process_time() - began


def rival(runs: list[mi.Experiment], start: np.ndarray, sigma: np.ndarray, chi2: float) -> tuple:
    """The fastest choice of SciPy's that comes within 0.01 of the χ² at the optimum."""
    best, least = None, np.inf
    for choice in CHOICES:
        began = time.process_time()
        reached, _ = scipy_fit(runs, start, sigma, choice)
        took = time.process_time() - began
        if reached < chi2 + 0.01 and took < least:
            best, least = choice, took
    assert best is not None
    return best


def compare(repeat: int) -> list[str]:
    """Side by side; return lines of a table."""
    runs = mi.read_runs(sorted(mi.data_path("two_step_noisy").glob("*.csv")))
    model = mi.dc_motor()
    engines = {"compiled": mi.Rosenbrock(compiled=True), "virtual machine": mi.Rosenbrock(compiled=False),
               "cvodes": mi.Cvodes(), "idas": mi.Idas()}
    fits = {n: mi.fit(model, runs, engine=e) for n, e in engines.items()}
    fit = fits["compiled"]
    start = np.array([fit.problem.model.values[n] for n in NAMES])
    sigma = np.array([fit.problem.runs[0].sigma[c] for c in ("i", "omega")])
    choice = rival(runs, start, sigma, min(f.chi2 for f in fits.values()))
    work: dict[str, Callable[[], object]] = {"scipy": lambda: scipy_fit(runs, start, sigma, choice)}
    work |= {n: lambda e=e: mi.fit(model, runs, engine=e) for n, e in engines.items()}
    least = {n: min(seconds(w) for _ in range(1 if n == "scipy" else 3)) for n, w in work.items()}
    for _ in range(repeat):
        for n, w in work.items():
            least[n] = min(least[n], seconds(w))
    reached, count = scipy_fit(runs, start, sigma, choice)
    rtol, step, how = choice
    lines = [f"{'':<16}{'ms':>9}{'times faster':>14}{'asked':>7}{'chi2':>12}",
             f"{'scipy':<16}{1e3 * least['scipy']:>9.1f}{'':>14}{'':>7}{reached:>12.3f}   "
             f"LSODA rtol {rtol:g}, {how}, difference step {step:g}, {count} simulations"]
    for n, f in fits.items():
        asked = f"{AIMS[n]}" if n in AIMS else ""
        lines.append(f"{n:<16}{1e3 * least[n]:>9.1f}{least['scipy'] / least[n]:>14.1f}{asked:>7}{f.chi2:>12.3f}   "
                     f"{f.iterations} iterations")
    return lines


def long_record(path: Path, repeat: int) -> list[str]:
    """Time against length."""
    run = mi.read_runs([path], columns={"t": "t_s", "v": "u_V", "theta": "q_m"})[0]
    model = mi.torque_driven("linear", g=35.15) + mi.effects.coulomb + mi.effects.constant_load
    lines = [f"{'samples':>9}{'s':>9}{'µs/sample':>12}{'steps':>9}{'iterations':>12}"]
    for share in (0.25, 0.5, 1.0):
        part = run.select(slice(0, round(run.n * share)))
        fit = mi.fit(model, part)
        took = min(seconds(lambda part=part: mi.fit(model, part)) for _ in range(repeat))
        steps = int(fit.problem.runs[0].grid.substeps.sum())
        lines.append(f"{part.n:>9}{took:>9.3f}{1e6 * took / part.n:>12.2f}{steps:>9}{fit.iterations:>12}")
    return lines


def main() -> None:
    """Print the tables."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--repeat", type=int, default=7)
    options.add_argument("--emps", type=Path)
    given = options.parse_args()
    print("\n".join(compare(given.repeat)))
    if given.emps:
        print("\n".join(long_record(given.emps, 2)))


if __name__ == "__main__":
    main()
