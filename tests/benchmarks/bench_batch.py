"""Fit 200 simulated motors serially and on a Dask cluster of one and two workers, then with a worker killed.

    python tests/benchmarks/bench_batch.py [--motors 200]
"""

from __future__ import annotations

import argparse
import os
import signal
import threading
import time

import numpy as np
from distributed import Client, LocalCluster

import motorid as mi
from motorid.records.datasets import truth

NOISE = {"i": 0.02, "omega": 0.4}


def simulated(n: int) -> dict[str, list[mi.Experiment]]:
    rng, motor = np.random.default_rng(0), truth("two_step_noisy")["parameters"]
    runs = mi.read_runs(f"{mi.data_path('two_step_noisy')}/run*.csv")
    found = {}
    for k in range(n):
        values = {p: v * np.exp(0.03 * rng.standard_normal()) for p, v in motor.items()}
        shown = mi.simulate(mi.dc_motor(**values), runs, initial="rest")
        found[f"m{k:03d}"] = [s.experiment.with_(outputs={
            c: y + NOISE[c] * rng.standard_normal(len(y)) for c, y in s.outputs.items()}) for s in shown]
    return found


def rows(found) -> list[dict]:
    return [{k: v for k, v in r.items() if k != "seconds"} for r in found.rows]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--motors", type=int, default=200)
    motors = simulated(parser.parse_args().motors)
    began = time.perf_counter()
    serial = mi.fit_many(mi.dc_motor(), motors)
    print(f"serial      {time.perf_counter() - began:6.2f} s, {len(serial.failed)} failed")
    times = {}
    for workers in (1, 2):
        with (LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as farm,
              Client(farm) as client):
            way = client.get_executor(pure=False).map  # unique tasks: no need to hash the records
            mi.fit_many(mi.dc_motor(), dict(list(motors.items())[:4 * workers]), map=way)  # imports
            began = time.perf_counter()
            found = mi.fit_many(mi.dc_motor(), motors, map=way)
            times[workers] = time.perf_counter() - began
            print(f"{workers} worker(s) {times[workers]:6.2f} s, same table: {rows(found) == rows(serial)}")
            if workers == 2:
                victim = next(iter(client.run(os.getpid).values()))
                threading.Timer(0.4 * times[2], os.kill, (victim, signal.SIGKILL)).start()
                began = time.perf_counter()
                found = mi.fit_many(mi.dc_motor(), motors, map=way)
                killed = victim not in client.run(os.getpid).values()
                print(f"one killed  {time.perf_counter() - began:6.2f} s, killed: {killed}, "
                      f"same table: {rows(found) == rows(serial)}")
    print(f"two workers are {times[1] / times[2]:.2f} times as fast as one")


if __name__ == "__main__":
    main()
