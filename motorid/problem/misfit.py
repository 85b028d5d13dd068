"""How far a problem's answer is from its records, beside noise and integration error."""

from __future__ import annotations

import numpy as np

from motorid.errors import SimulationError
from motorid.integrate.engine import Array
from motorid.problem.problem import Problem

LEAST_FACTOR = 0.02  # a quick channel with few samples per time constant passes for noisy
EXPLAINED = 0.25  # NRMSE above which a channel counts as hardly explained


def misfit_over_noise(problem: Problem, q: Array) -> dict[str, float]:
    """Return the RMS of the residual over the noise per channel; far below 1 where the noise was overestimated."""
    sums = {c: [0.0, 0] for c in problem.outputs}
    for k, run in enumerate(problem.runs):
        y = problem.simulate(q, k, derivatives=False).y
        for j, c in enumerate(problem.outputs):
            if c in run.sigma:
                e = (run.experiment.outputs[c] - y[:, j]) / run.sigma[c]
                e = e[np.isfinite(e)]
                sums[c][0] += float(e @ e)
                sums[c][1] += e.size
    return {c: max(float(np.sqrt(s / max(n, 1))), LEAST_FACTOR) for c, (s, n) in sums.items()}


def hardly_explained(problem: Problem, q: Array) -> bool:
    """Tell whether some channel is far above its noise and not followed at all."""
    for c, factor in misfit_over_noise(problem, q).items():
        runs = [r for r in problem.runs if c in r.sigma]
        rms = np.sqrt(np.mean([np.nanmean((r.experiment.outputs[c] / r.sigma[c]) ** 2) for r in runs]))
        if factor > max(3.0, EXPLAINED * rms):
            return True
    return False


def integration_error(problem: Problem, q: Array) -> float:
    """Return the largest change of an output when every step is halved, in units of the noise."""
    worst = 0.0
    for k, run in enumerate(problem.runs):
        if not hasattr(problem._engine, "compiled"):
            return 0.0
        try:
            coarse = problem.simulate(q, k, derivatives=False).y
            fine = problem.with_finer_steps(2).simulate(q, k, derivatives=False).y
        except SimulationError:
            return float("inf")
        sigma = np.array([run.sigma.get(c, np.inf) for c in problem.outputs])
        worst = max(worst, float(np.max(np.abs(fine - coarse) / sigma)))
    return worst


__all__ = ["hardly_explained", "integration_error", "misfit_over_noise"]
