"""Fit both shipped motors with noise from many random starts and say how many end in the optimum.

    python tests/benchmarks/bench_starts.py [--starts 1000] [--spreads 10 100] [--processes 2]

Without and with the automatic first guess. Wall-clock time depends on what else runs; CPU time does not.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor

import motorid as mi


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--starts", type=int, default=1000)
    parser.add_argument("--spreads", type=float, nargs="+", default=[10.0, 100.0])
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    print(f"{'motor':16} {'spread':>6} {'guess':>6} {'good':>6} {'poor':>5} {'failed':>6} {'wall s':>7} "
          f"{'fit s':>6} {'steps':>6}")
    with ProcessPoolExecutor(chosen.processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        for name in ("two_step_noisy", "two_step_small"):
            fit = mi.fit(mi.dc_motor(), mi.read_runs(f"{mi.data_path(name)}/run*.csv"))
            for spread in chosen.spreads:
                for guess in (False, True):
                    began = time.perf_counter()
                    found = mi.multistart(fit, starts=chosen.starts, spread=spread, guess=guess,
                                          seed=chosen.seed, map=pool.map)
                    wall, table = time.perf_counter() - began, found.table
                    print(f"{name:16} {spread:6g} {guess!s:>6} {found.good:6d} {found.poor:5d} "
                          f"{found.failed:6d} {wall:7.1f} {table['seconds'].sum():6.1f} "
                          f"{table['iterations'].median():6.0f}", flush=True)


if __name__ == "__main__":
    main()
