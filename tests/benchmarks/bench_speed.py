"""All figures on speed in one run: a fit beside SciPy's, and how time and memory grow.

    python tests/benchmarks/bench_speed.py [--repeat 7] [--samples 1000000] [--dask]

Times are processor times, medians over repeats on fresh noise in which everybody takes a turn: read the ratios. SciPy
gets a guess within a factor of two and the noise, motorid neither. Memory is the peak of a process of its own, with all
that it imports. With ``--dask`` `bench_batch.py` follows: serial, one and two workers.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
from bench_fit import GUESS, NAMES, USUAL, scipy_fit
from scipy.integrate import odeint
from scipy.optimize import least_squares

import motorid as mi

TRUE = dict(zip(NAMES, (1.2, 2e-3, 0.055, 1.5e-5, 2.5e-5), strict=True))
SIGMA = np.array([0.02, 1.0])


def records(n: int, runs: int = 2, channels: tuple[str, ...] = ("i", "omega"), seed: int = 0) -> list[mi.Experiment]:
    """Steps of the voltage at 1 kHz, every one held for 0.6 s, with noise."""
    rng, t, found = np.random.default_rng(seed), np.arange(n) * 1e-3, []
    for k in range(runs):
        levels = np.resize([6.0, -6.0, 3.0, -3.0], n // 600 + 1).repeat(600)[:n]
        v = np.where(t < 0.02, 0.0, (1 + 0.1 * k / runs) * levels)
        shown = mi.simulate(mi.dc_motor(**TRUE), mi.Experiment(t, {"v": v}, {c: np.zeros(n) for c in channels}),
                            initial="rest")[0].outputs
        noise = dict(zip(("i", "omega", "theta"), (*SIGMA, 0.001), strict=True))
        found.append(mi.Experiment(t, {"v": v}, {c: y + noise[c] * rng.standard_normal(n) for c, y in shown.items()}))
    return found


def with_sensitivities(runs: list[mi.Experiment]) -> np.ndarray:
    """Fit by odeint on the sensitivity equations, written by hand, and least_squares; the parameters."""
    def rates(x: np.ndarray, _: float, v: float, p: np.ndarray) -> np.ndarray:
        r, inductance, k, b, j = p
        di, dw = (v - r * x[0] - k * x[1]) / inductance, (k * x[0] - b * x[1]) / j
        a = np.array([[-r / inductance, -k / inductance], [k / j, -b / j]])
        own = np.array([[-r * x[0] / inductance, -di, -k * x[1] / inductance, 0, 0],
                        [0, 0, k * x[0] / j, -b * x[1] / j, -dw]])
        return np.concatenate([[di, dw], (a @ x[2:].reshape(2, 5) + own).ravel()])

    def both(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        res, jac = [], []
        for run in runs:
            v, x = run.inputs["v"], np.zeros((run.n, 12))
            cuts = np.unique([0, *(np.flatnonzero(np.diff(v)) + 1), run.n - 1])
            for a, e in pairwise(cuts):
                x[a:e + 1] = odeint(rates, x[a], run.t[a:e + 1], (v[a], GUESS * np.exp(q)), rtol=1e-7, atol=1e-9)
            y = np.column_stack([run.outputs["i"], run.outputs["omega"]])
            res.append(((x[:, :2] - y) / SIGMA).ravel())
            jac.append((x[:, 2:].reshape(-1, 2, 5) / SIGMA[:, None]).reshape(-1, 5))
        return np.concatenate(res), np.concatenate(jac)

    return GUESS * np.exp(least_squares(lambda q: both(q)[0], np.zeros(5), lambda q: both(q)[1], method="lm").x)


def beside_scipy(repeat: int) -> None:
    """Print the table of a fresh fit of two records of 1,200 samples."""
    ways = {"motorid": lambda runs: mi.fit(mi.dc_motor(), runs),
            "SciPy odeint, hand-derived sensitivities": with_sensitivities,
            "SciPy LSODA, finite differences": lambda runs: scipy_fit(runs, GUESS, SIGMA, USUAL)}
    took: dict[str, list[float]] = {n: [] for n in ways}
    for k in range(repeat + 1):
        runs = records(1200, seed=k)
        for name, way in ways.items():
            began = time.process_time()
            way(runs)
            took[name].append(time.process_time() - began)
    middle = {n: float(np.median(t[1:])) for n, t in took.items()}
    for name, each in middle.items():
        print(f"{name:<42}{1e3 * each:>9.1f} ms{each / middle['motorid']:>7.1f} times motorid's")


def one_fit(n: int, runs: int, channels: int) -> None:
    """Print processor time and peak memory of one fit, the second of two in this process."""
    given = records(n, runs, ("i", "omega", "theta")[:channels])
    for _ in range(2):
        began = time.process_time()
        mi.fit(mi.dc_motor(), given)
    took = time.process_time() - began
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{n:>9}{runs:>6}{channels:>10}{took:>10.3f}{1e6 * took / n / runs:>17.2f}{peak:>10.0f}", flush=True)


def main() -> None:
    """Print the tables."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--repeat", type=int, default=7)
    options.add_argument("--samples", type=int, default=1_000_000, help="of the longest record")
    options.add_argument("--dask", action="store_true")
    options.add_argument("--one", type=int, nargs=3, help=argparse.SUPPRESS)
    given = options.parse_args()
    if given.one:
        one_fit(*given.one)
        return
    beside_scipy(given.repeat)
    print(f"\n{'samples':>9}{'runs':>6}{'channels':>10}{'s':>10}{'µs per sample':>17}{'peak MB':>10}")
    lengths = [(n, 1, 2) for n in (1000, 10_000, 100_000, 1_000_000) if n <= given.samples]
    for shape in [*lengths, (1200, 2, 2), (1200, 8, 2), (1200, 32, 2), (10_000, 1, 1), (10_000, 1, 3)]:
        subprocess.run([sys.executable, __file__, "--one", *map(str, shape)], check=True)
    if given.dask:
        subprocess.run([sys.executable, str(Path(__file__).with_name("bench_batch.py"))], check=True)


if __name__ == "__main__":
    main()
