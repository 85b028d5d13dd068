"""Fit 200 simulated motors serially and on a Dask cluster of one and two workers, then with a worker killed.

    python tests/benchmarks/bench_batch.py [--motors 200]

Wall times are of the machine as it is: what else it does counts. Processor times are of client, scheduler and workers
together; serial over them is the share of the work that is fits, and the most that workers can reach on busy cores.
What 10,000 motors would take is the slope between half and all of the motors, not a run. Dask has its workers return
memory to the system at once (MALLOC_TRIM_THRESHOLD_), which small fits pay for: the last workers do without.
"""

from __future__ import annotations

import argparse
import os
import signal
import threading
import time

import dask
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


def spent(client: Client) -> np.ndarray:
    """Wall time and the processor time of client, scheduler and workers, s."""
    return np.array([time.perf_counter(), time.process_time() + sum(client.run(time.process_time).values())])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--motors", type=int, default=200)
    motors = simulated(parser.parse_args().motors)
    half = dict(list(motors.items())[:len(motors) // 2])
    mi.fit_many(mi.dc_motor(), dict(list(motors.items())[:1]))  # imports
    began = np.array([time.perf_counter(), time.process_time()])
    serial = mi.fit_many(mi.dc_motor(), motors)
    alone = np.array([time.perf_counter(), time.process_time()]) - began
    print(f"{'':<14}{'wall s':>8}{'processor s':>13}\n{'serial':<14}{alone[0]:>8.2f}{alone[1]:>13.2f}   "
          f"{len(serial.failed)} failed", flush=True)
    for workers, trims in ((1, True), (2, True), (2, False)):
        as_set = dask.config.get("distributed.nanny.pre-spawn-environ") if trims else {}
        with (dask.config.set({"distributed.nanny.pre-spawn-environ": as_set}),
              LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as farm,
              Client(farm) as client):
            way = client.get_executor(pure=False).map  # unique tasks: no need to hash the records

            def fitted(which: dict[str, list[mi.Experiment]], way=way, client=client):
                began = spent(client)
                found = mi.fit_many(mi.dc_motor(), which, map=way)
                return found, spent(client) - began

            fitted(dict(list(motors.items())[:4 * workers]))  # imports
            found, took = fitted(motors)
            wall, share = alone / took / (workers, 1)
            print(f"{f'{workers} worker(s)':<14}{took[0]:>8.2f}{took[1]:>13.2f}   same table: "
                  f"{rows(found) == rows(serial)}, {100 * wall:.0f} % of {workers} times serial, "
                  f"{100 * share:.0f} % of the processor time is fits"
                  f"{'' if trims else '; without MALLOC_TRIM_THRESHOLD_'}", flush=True)
            if not trims:
                each = (took - fitted(half)[1]) / (len(motors) - len(half))
                victim = next(iter(client.run(os.getpid).values()))
                threading.Timer(0.4 * took[0], os.kill, (victim, signal.SIGKILL)).start()
                began = time.perf_counter()
                found = mi.fit_many(mi.dc_motor(), motors, map=way)
                killed = victim not in client.run(os.getpid).values()
                print(f"{'one killed':<14}{time.perf_counter() - began:>8.2f}{'':>13}   same table: "
                      f"{rows(found) == rows(serial)}, killed: {killed}")
                print(f"{1e3 * each[0]:.1f} ms per motor on two workers ({1e3 * each[1]:.1f} ms of processor time): "
                      f"10,000 motors would take {1e4 * each[0] / 60:.1f} min", flush=True)


if __name__ == "__main__":
    main()
