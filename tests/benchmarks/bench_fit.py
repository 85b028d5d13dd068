"""Time a whole fit beside SciPy's: same two noisy records, same stopping accuracy, in one process.

    python tests/benchmarks/bench_fit.py [--repeat 7] [--emps PATH/run.csv]

SciPy integrates with `solve_ivp(method="LSODA")`, restarted at each step of the voltage, and estimates with
`least_squares` on the same logarithmic coordinates, from a guess within a factor of two (as from a data sheet)
and once more from motorid's own start, which it gets for nothing. "scipy" takes a usual setting with a good
difference step; "tuned" the fastest of a few tolerances, steps and methods that reaches the optimum. Times are
process times, the least of several rounds in which everybody takes a turn. With ``--emps`` the long record
(24,841 samples) is fitted at a quarter, half and full length.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import motorid as mi

NAMES = ("R", "L", "K", "b", "J")
CHOICES = [(rtol, step, how) for rtol in (1e-7, 1e-8) for step in (1e-4, 1e-3) for how in ("lm", "trf")]
USUAL = (1e-7, 1e-4, "trf")
GUESS = np.array([2.0, 1e-3, 0.06, 1e-4, 4e-5])
AIMS = {"compiled": 40, "virtual machine": 5, "cvodes": 4}


def simulate(values: np.ndarray, run: mi.Experiment, rtol: float, width: float = 1.0) -> np.ndarray:
    """(i, omega) at the samples, (N, 2), by SciPy; a sixth value is dry friction, its sgn smoothed over `width`."""
    r, inductance, k, b, j = values[:5]
    dry = values[5] if len(values) > 5 else 0.0
    v, t = run.inputs["v"], run.t
    cuts = np.unique([0, *(np.flatnonzero(np.diff(v)) + 1), len(t) - 1])
    x, out = np.zeros(2), np.zeros((len(t), 2))
    for a, e in pairwise(cuts):

        def rates(_, x, volt=v[a]):
            return (volt - r * x[0] - k * x[1]) / inductance, (k * x[0] - b * x[1] - dry * np.tanh(x[1] / width)) / j

        done = solve_ivp(rates, (t[a], t[e]), x, method="LSODA", t_eval=t[a:e + 1], rtol=rtol, atol=rtol * 1e-2)
        out[a:e + 1], x = done.y.T, done.y[:, -1]
    return out


def scipy_fit(runs: list[mi.Experiment], start: np.ndarray, sigma: np.ndarray, choice: tuple,
              width: float = 1.0) -> tuple[np.ndarray, float, int]:
    """Parameters, χ² reached and number of simulations."""
    rtol, step, how = choice
    measured = [np.column_stack([r.outputs["i"], r.outputs["omega"]]) for r in runs]
    count = 0

    def residual(q: np.ndarray) -> np.ndarray:
        nonlocal count
        count += 1
        with np.errstate(all="ignore"):
            return np.concatenate([((simulate(start * np.exp(q), r, rtol, width) - y) / sigma).ravel()
                                   for r, y in zip(runs, measured, strict=True)])

    done = least_squares(residual, np.zeros(len(start)), diff_step=step, method=how, ftol=1e-9, xtol=1e-9, gtol=1e-12)
    return start * np.exp(done.x), 2 * done.cost, count


def seconds(work: Callable[[], object]) -> float:
    """Process time of one call."""
    began = time.process_time()
    work()
    return time.process_time() - began


def rival(runs: list[mi.Experiment], start: np.ndarray, sigma: np.ndarray, chi2: float) -> tuple:
    """The fastest choice of SciPy's that comes within 0.01 of the χ² at the optimum."""
    took = {}
    for choice in CHOICES:
        began = time.process_time()
        _, reached, _ = scipy_fit(runs, start, sigma, choice)
        if reached < chi2 + 0.01:
            took[choice] = time.process_time() - began
    return min(took, key=lambda c: took[c])


def compare(repeat: int) -> list[str]:
    """Side by side; return lines of a table."""
    runs = mi.read_runs(sorted(mi.data_path("two_step_noisy").glob("*.csv")))
    model = mi.dc_motor()
    engines = {"compiled": mi.Rosenbrock(compiled=True), "virtual machine": mi.Rosenbrock(compiled=False),
               "cvodes": mi.Cvodes(), "idas": mi.Idas()}
    fits = {n: mi.fit(model, runs, engine=e) for n, e in engines.items()}
    fit = fits["compiled"]
    sigma = np.array([fit.problem.runs[0].sigma[c] for c in ("i", "omega")])
    ours = np.array([fit.problem.model.values[n] for n in NAMES])
    starts = {"scipy": GUESS, "tuned": GUESS, "tuned, our start": ours}
    lowest = min(f.chi2 for f in fits.values())
    choices = {n: USUAL if n == "scipy" else rival(runs, start, sigma, lowest) for n, start in starts.items()}
    work: dict[str, Callable[[], object]] = {
        n: lambda n=n: scipy_fit(runs, starts[n], sigma, choices[n]) for n in starts}
    work |= {n: lambda e=e: mi.fit(model, runs, engine=e) for n, e in engines.items()}
    least = dict.fromkeys(work, np.inf)
    for _ in range(repeat):
        for n, w in work.items():
            w()  # warm: what another turn has left in the processor's caches is not what is compared
            least[n] = min(least[n], seconds(w))
    lines = [f"{'':<18}{'ms':>8}{'asked':>7}" + "".join(f"{'/ ' + n:>18}" for n in starts) + f"{'chi2':>11}"]
    for n, start in starts.items():
        _, reached, count = scipy_fit(runs, start, sigma, choices[n])
        rtol, step, how = choices[n]
        lines.append(f"{n:<18}{1e3 * least[n]:>8.1f}{'':>61}{reached:>11.3f}   LSODA rtol {rtol:g}, {how}, "
                     f"difference step {step:g}, {count} simulations of both")
    for n, f in fits.items():
        faster = "".join(f"{least[s] / least[n]:>18.1f}" for s in starts)
        lines.append(f"{n:<18}{1e3 * least[n]:>8.1f}{AIMS.get(n, ''):>7}{faster}{f.chi2:>11.3f}   "
                     f"{f.iterations} iterations")
    return lines


def long_record(path: Path, repeat: int) -> list[str]:
    """Time against length."""
    run = mi.read_runs([path], columns={"t": "t_s", "v": "voltage_V", "theta": "position_m"})[0]
    model = mi.torque_driven("linear", g=35.15) + mi.effects.coulomb + mi.effects.constant_load
    lines = [f"{'samples':>9}{'s':>9}{'iterations':>12}{'steps':>9}{'ns/(sample·iteration)':>24}"]
    for share in (0.25, 0.5, 1.0):
        part = run.select(slice(0, round(run.n * share)))
        fit = mi.fit(model, part)
        took = min(seconds(lambda part=part: mi.fit(model, part)) for _ in range(repeat))
        steps = int(fit.problem.runs[0].grid.substeps.sum())
        each = 1e9 * took / part.n / max(fit.iterations, 1)
        lines.append(f"{part.n:>9}{took:>9.3f}{fit.iterations:>12}{steps:>9}{each:>24.0f}")
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
