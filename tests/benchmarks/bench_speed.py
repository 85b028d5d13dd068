"""All figures on speed in one run: what the README says of speed comes from here.

    python tests/benchmarks/bench_speed.py [--repeat 7] [--samples 1000000] [--parts beside first growth effects dask]

- ``beside``: a fit of two records of 1,200 samples beside a C program for this motor alone (where there is a compiler),
  JAX (where it is installed) and SciPy; the plain motor with two steps, and dry friction with reversals. Medians over
  repeats on fresh noise in which everybody takes a turn, compiled before: read the ratios. The others get a guess
  within a factor of two, the noise, the rest at the beginning and the width of sgn; motorid gets none of these.
- ``first``: the first fit in a fresh process, with an empty and a filled cache of compiled steps. The package's own
  files are compiled, as pip leaves them, whatever this environment says of that.
- ``growth``: time and memory over samples, runs and channels; memory is the peak of a process of its own, with all that
  it imports.
- ``effects``: a diagnosis over the number of effects tried.
- ``dask``: `bench_batch.py`, a batch on one and two workers, and what 10,000 motors would take.

Times are processor times (user and system, all threads, children where a process is measured), but for ``dask``.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from bench_fit import GUESS, NAMES, simulate
from peers import Way, measured, ways

import motorid as mi

TRUE = dict(zip(NAMES, (1.2, 2e-3, 0.055, 1.5e-5, 2.5e-5), strict=True))
FRICTION, GUESSED_FRICTION = 6e-3, 0.01
SIGMA = np.array([0.02, 1.0])
FRESH = {"Python alone": "pass", "import motorid": "import motorid",
         "import, read two records": "import motorid as mi; runs = mi.read_runs({0!r})",
         "import, read, fit": "import motorid as mi; mi.fit(mi.dc_motor(), mi.read_runs({0!r}))",
         "import, read, fit with friction":
             "import motorid as mi; mi.fit(mi.dc_motor() + mi.effects.coulomb, mi.read_runs({0!r}))"}


def records(n: int, runs: int = 2, channels: tuple[str, ...] = ("i", "omega"), seed: int = 0, held: int = 600,
            friction: float = 0.0) -> list[mi.Experiment]:
    """Steps of the voltage at 1 kHz, every one held for `held` samples, with noise."""
    rng, t, found = np.random.default_rng(seed), np.arange(n) * 1e-3, []
    motor = mi.dc_motor(**TRUE) + mi.effects.coulomb(tau_c=friction) if friction else mi.dc_motor(**TRUE)
    for k in range(runs):
        levels = np.resize([6.0, -6.0, 3.0, -3.0], n // held + 1).repeat(held)[:n]
        v = np.where(t < 0.02, 0.0, (1 + 0.1 * k / runs) * levels)
        shown = mi.simulate(motor, mi.Experiment(t, {"v": v}, {c: np.zeros(n) for c in channels}),
                            initial="rest")[0].outputs
        noise = dict(zip(("i", "omega", "theta"), (*SIGMA, 0.001), strict=True))
        found.append(mi.Experiment(t, {"v": v}, {c: y + noise[c] * rng.standard_normal(n) for c, y in shown.items()}))
    return found


def timed(work: Callable[[], np.ndarray]) -> tuple[float, np.ndarray]:
    """Processor time of one call, and what it returned."""
    began = time.process_time()
    found = work()
    return time.process_time() - began, found


def one_job(title: str, model: mi.Model, start: np.ndarray, repeat: int, held: int, friction: float) -> None:
    """Print the table of one job."""
    rivals, absent = ways(friction > 0)
    names = [*NAMES, "tau_c"][:len(start)]
    width = mi.fit(model, records(1200, held=held, friction=friction)).values.get("sgn_width", 1.0)

    def ours(runs: list[mi.Experiment], *_: object) -> np.ndarray:
        values = mi.fit(model, runs).values
        return np.array([values[n] for n in names])

    took: dict[str, list[float]] = {n: [] for n in ("motorid", *rivals)}
    ended: dict[str, np.ndarray] = {}
    for k in range(repeat + 1):
        runs = records(1200, seed=k, held=held, friction=friction)
        turns: dict[str, Way] = {"motorid": ours, **rivals}
        for name, way in turns.items():
            each, ended[name] = timed(lambda way=way, runs=runs: way(runs, start, SIGMA, width))
            took[name].append(each)
    chi2 = {n: sum(float(np.sum(((simulate(p, r, 1e-9, width) - measured(r)) / SIGMA) ** 2)) for r in runs)
            for n, p in ended.items()}
    print(f"{title:<44}{'ms':>9}{'/ motorid':>12}{'/ C':>8}{'chi2 above the least':>23}")
    middle = {n: float(np.median(t[1:])) for n, t in took.items()}
    c = middle.get("C program for this motor alone", np.nan)
    for name, each in middle.items():
        print(f"  {name:<42}{1e3 * each:>9.1f}{each / middle['motorid']:>12.2f}{each / c:>8.1f}"
              f"{chi2[name] - min(chi2.values()):>23.3f}")
    print("\n".join(absent), flush=True)


def beside(repeat: int) -> None:
    """Print motorid beside others."""
    one_job("Plain motor, two steps", mi.dc_motor(), GUESS, repeat, 600, 0.0)
    one_job("Dry friction, reversals", mi.dc_motor() + mi.effects.coulomb, np.append(GUESS, GUESSED_FRICTION), repeat,
            150, FRICTION)


def first(repeat: int) -> None:
    """Print the times of a fresh process."""
    print(f"{'A fresh process, s':<36}{'cold: processor':>16}{'wall':>8}{'warm: processor':>18}{'wall':>8}")
    user = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    for name, code in FRESH.items():
        code = code.format(f"{mi.data_path('two_step_noisy')}/run*.csv")
        subprocess.run([sys.executable, "-c", code], check=True, env=user)
        took = []
        for _ in range(max(repeat, 1)):
            with tempfile.TemporaryDirectory() as empty:
                for _ in ("cold", "warm"):
                    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
                    subprocess.run([sys.executable, "-c", code], check=True, env={**user, "MOTORID_CACHE": empty})
                    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
                    took += [after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime, wall]
        cold, cold_wall, warm, warm_wall = np.median(np.reshape(took, (-1, 4)), axis=0)
        print(f"{name:<36}{cold:>16.2f}{cold_wall:>8.2f}{warm:>18.2f}{warm_wall:>8.2f}", flush=True)


def one_fit(n: int, runs: int, channels: int) -> None:
    """Print processor time and peak memory of one fit, the second of two in this process."""
    given = records(n, runs, ("i", "omega", "theta")[:channels])
    for _ in range(2):
        began = time.process_time()
        mi.fit(mi.dc_motor(), given)
    took = time.process_time() - began
    status = Path("/proc/self/status")  # where there is one: what getrusage says begins with the parent's peak
    peak = (int(status.read_text().split("VmHWM:")[1].split()[0]) if status.exists()
            else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) / 1024
    print(f"{n:>9}{runs:>6}{channels:>10}{took:>10.3f}{1e6 * took / n / runs:>17.2f}{peak:>10.0f}", flush=True)


def growth(longest: int) -> None:
    """Print how time and memory grow."""
    print(f"{'samples':>9}{'runs':>6}{'channels':>10}{'s':>10}{'µs per sample':>17}{'peak MB':>10}", flush=True)
    lengths = [(n, 1, 2) for n in (1000, 10_000, 100_000, 1_000_000) if n <= longest]
    for shape in [*lengths, (1200, 2, 2), (1200, 8, 2), (1200, 32, 2), (10_000, 1, 1), (10_000, 1, 3)]:
        subprocess.run([sys.executable, __file__, "--one", *map(str, shape)], check=True)


def effects() -> None:
    """Print what a diagnosis takes over the number of effects that it tries."""
    folder = mi.data_path("hidden_friction")
    fit, check = mi.fit(mi.dc_motor(), mi.read_runs(f"{folder}/run*.csv")), mi.read_runs(f"{folder}/check*.csv")
    library = sorted(mi.effects.LIBRARY, key=lambda name: name != "coulomb")  # what is missing is among the first
    mi.diagnose(fit, validate=check)  # compiles
    print(f"{'Diagnosis':<12}{'effects':>9}{'s':>8}{'ms per effect':>16}   found")
    for count in (8, 24, len(library)):
        began = time.process_time()
        found = mi.diagnose(fit, validate=check, effects=library[:count])
        took = time.process_time() - began
        print(f"{'':<12}{count:>9}{took:>8.2f}{1e3 * took / count:>16.0f}   {', '.join(found.effects)}", flush=True)


def main() -> None:
    """Print the tables."""
    batch = [sys.executable, str(Path(__file__).with_name("bench_batch.py"))]
    parts = {"beside": lambda: beside(given.repeat), "first": lambda: first(given.repeat),
             "growth": lambda: growth(given.samples), "effects": effects,
             "dask": lambda: subprocess.run(batch, check=True)}
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--repeat", type=int, default=7)
    options.add_argument("--samples", type=int, default=1_000_000, help="of the longest record")
    options.add_argument("--parts", nargs="+", choices=parts, default=list(parts))
    options.add_argument("--one", type=int, nargs=3, help=argparse.SUPPRESS)
    given = options.parse_args()
    if given.one:
        one_fit(*given.one)
        return
    for part in given.parts:
        if part == "dask" and not find_spec("distributed"):
            print("Dask is not installed: the batch on workers is left out (pip install distributed).")
            continue
        parts[part]()
        print(flush=True)


if __name__ == "__main__":
    main()
