"""Time one simulation and one Jacobian with each engine, and say how exact they are.

    python tests/benchmarks/bench_engines.py [--repeat 20]

Two noisy records of 1200 samples, five parameters; then the same with more physics. Exactness is the largest
difference of an output from CVODES at a relative tolerance of 1e-11, over the noise; compile times are for an
empty cache. Times are process times.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from functools import partial

import numpy as np

import motorid as mi
from motorid.integrate import compiled as cc
from motorid.integrate.rosenbrock import stepper
from motorid.problem.problem import Problem

VALUES = {"R": 1.38, "L": 1.72e-3, "K": 0.0462, "b": 6.5e-5, "J": 2.35e-5}
MODELS = {
    "dc_motor": (),
    "+ coulomb": ("coulomb",),
    "+ heating + coulomb": ("winding_heating", "coulomb"),
    "+ compliance": ("compliance",),
}


def milliseconds(work: Callable[[], object], repeat: int) -> float:
    """Least process time of several calls."""
    work()
    least = np.inf
    for _ in range(repeat):
        began = time.process_time()
        work()
        least = min(least, time.process_time() - began)
    return 1e3 * least


def compile_seconds(problem: Problem) -> float:
    """Wall time of generating and compiling the step, cache aside."""
    s = stepper(problem.system)
    mark = cc.mark_of(s.key)
    if mark is None:
        return float("nan")
    kept = os.environ.get("MOTORID_CACHE")
    with tempfile.TemporaryDirectory() as folder:
        os.environ["MOTORID_CACHE"] = folder
        began = time.perf_counter()
        cc.build(s.functions, mark)
        took = time.perf_counter() - began
    if kept is None:
        del os.environ["MOTORID_CACHE"]
    else:
        os.environ["MOTORID_CACHE"] = kept
    return took


def table(name: str, effects: tuple[str, ...], runs: list[mi.Experiment], repeat: int) -> list[str]:
    """Lines for one model."""
    model = mi.dc_motor(**VALUES)
    for e in effects:
        model = model + mi.effects.get(e)
    engines = {"compiled": mi.Rosenbrock(compiled=True), "virtual machine": mi.Rosenbrock(compiled=False),
               "cvodes": mi.Cvodes(), "idas": mi.Idas()}
    exact = Problem(model, tuple(runs), engine=mi.Cvodes(1e-11, 1e-13))
    reference = exact.residual(exact.start)
    lines = [f"{name}: {len(exact.system.states)} states, {len(exact.unknown)} unknowns, "
             f"compiled in {compile_seconds(exact):.2f} s",
             f"  {'engine':<18}{'simulation ms':>15}{'with Jacobian ms':>18}{'steps':>8}{'error/noise':>13}"]
    for label, engine in engines.items():
        problem = Problem(model, tuple(runs), engine=engine).refined(exact.start)
        q = problem.start

        def anew(work, problem=problem, q=q):
            problem.forget()
            return work(q)

        light = milliseconds(partial(anew, problem.residual), repeat)
        full = milliseconds(partial(anew, problem.residual_and_jacobian), repeat)
        error = np.abs(problem.residual(q) - reference).max()
        steps = sum(int(r.grid.substeps.sum()) for r in problem.runs) if "compiled" in vars(engine) else 0
        lines.append(f"  {label:<18}{light:>15.2f}{full:>18.2f}{steps or '':>8}{error:>13.1e}")
    return lines


def main() -> None:
    """Print the tables."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--repeat", type=int, default=20)
    given = options.parse_args()
    runs = mi.read_runs(sorted(mi.data_path("two_step_noisy").glob("*.csv")))
    for name, effects in MODELS.items():
        print("\n".join(table(name, effects, runs, given.repeat)))


if __name__ == "__main__":
    main()
