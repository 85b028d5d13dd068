"""Multiple shooting measured: time of a fit, poor starts. Run: python tests/benchmarks/bench_shooting.py [STARTS]"""

from __future__ import annotations

import sys
import time

import numpy as np

import motorid as mi
from motorid.errors import FitError
from motorid.records.datasets import truth

SHIPPED = ("two_step_noisy", "two_step_small")


def timed(name: str, constraints: list) -> tuple[float, mi.Fit]:
    """Best of three warm fits."""
    runs, times = mi.read_runs(str(mi.data_path(name) / "run*.csv")), []
    for _ in range(4):
        began = time.perf_counter()
        fit = mi.fit(mi.dc_motor(), runs, solver=mi.MultipleShooting(), constraints=constraints)
        times.append(time.perf_counter() - began)
    return min(times[1:]), fit


def poor_starts(name: str, n: int, seed: int) -> tuple[int, int, int, float]:
    """Numbers of starts that end in the least-squares optimum, are reported as failures, are silently wrong."""
    runs, true = mi.read_runs(str(mi.data_path(name) / "run*.csv")), truth(name)["parameters"]
    best = mi.fit(mi.dc_motor(), runs, solver=mi.LevenbergMarquardt(ftol=1e-14))
    rng, good, failed, began = np.random.default_rng(seed), 0, 0, time.perf_counter()
    for _ in range(n):
        start = {k: v * 10 ** rng.uniform(-1, 1) for k, v in true.items()}
        try:
            fit = mi.fit(mi.dc_motor().replace(**start), runs, solver=mi.MultipleShooting(), start="model")
        except FitError:
            failed += 1
            continue
        off = max(abs(fit.values[k] - best.values[k]) / best.std[k] for k in true)
        good += fit.status == "converged" and off < 0.02
        failed += fit.status != "converged"
    return good, failed, n - good - failed, time.perf_counter() - began


def main(n: int) -> None:
    """Print the figures."""
    for name, limit in zip(SHIPPED, (4.0, 0.4), strict=True):
        for words, constraints in (("none", []), ("inactive", [mi.CurrentLimit(50.0), mi.SteadyState(0.1)]),
                                   ("active", [mi.CurrentLimit(limit), mi.SteadyState()])):
            seconds, fit = timed(name, constraints)
            print(f"{name}, constraints {words}: {seconds:.2f} s, {fit.iterations} iterations, {fit.status}")
    for name in SHIPPED:
        good, failed, wrong, seconds = poor_starts(name, n, 7)
        print(f"{name}: {n} starts, {good} reach the optimum, {failed} reported failures, {wrong} silently wrong, "
              f"{seconds / n:.2f} s each")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
