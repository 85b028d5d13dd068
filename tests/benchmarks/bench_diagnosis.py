"""How many plain fits' time a full diagnosis takes: ``python tests/benchmarks/bench_diagnosis.py``.

Three runs of 2,400 samples with hidden friction and one held out, the whole library. Both are warm, and take turns;
processor time, so that other work on the machine matters less.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

import motorid as mi
from motorid.records.datasets import load_plant

PLANT = load_plant()
N, DT, FITS, TURNS = 2400, 1e-3, 8, 5


def recorded(v: np.ndarray, name: str, rng: np.random.Generator) -> mi.Experiment:
    """A run of the shipped motor with Coulomb friction, white noise on current and speed."""
    t = DT * np.arange(N)
    s = PLANT.simulate(PLANT.MOTORS["lab"], {"coulomb": {"tau_c": 8e-3}}, t, v)
    noisy = {"i": s["i"] + rng.normal(0, 0.01, N), "omega": s["omega"] + rng.normal(0, 0.2, N)}
    return mi.Experiment(t, {"v": v}, noisy, name=name)


def took(work: Callable[[], object], times: int = 1) -> float:
    """Processor time of one call, s."""
    began = time.process_time()
    for _ in range(times):
        work()
    return (time.process_time() - began) / times


def main() -> None:
    """Print both times, and how often one goes into the other."""
    rng, t = np.random.default_rng(5), DT * np.arange(N)
    square = [a * np.sign(np.sin(2 * np.pi * f * t + 1e-9)) for f, a in ((1, 4.0), (2, 6.0))]
    runs = [recorded(v, f"run{k}", rng) for k, v in enumerate((*square, 5 * np.sin(3 * np.pi * t)))]
    check = recorded(np.where(t < N * DT / 2, 5 * t, -4.0), "check", rng)
    first = mi.fit(mi.dc_motor(), runs)
    found = mi.diagnose(first, check)
    turns = []
    for _ in range(TURNS):
        plain = took(lambda: mi.fit(mi.dc_motor(), runs), FITS)
        fit = mi.fit(mi.dc_motor(), runs)
        turns.append((plain, took(lambda fit=fit: mi.diagnose(fit, check))))
    fits, whole = np.median(turns, axis=0)
    print(f"{found.verdict}: {' + '.join(found.effects)}")
    print(f"plain fit {1e3 * fits:.1f} ms, diagnosis {whole:.2f} s: {np.median([w / f for f, w in turns]):.1f} fits")


if __name__ == "__main__":
    main()
