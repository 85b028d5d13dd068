"""Sensitivities of the outputs to relative changes of parameters, over the noise or the channel's RMS."""

from __future__ import annotations

import numpy as np

from motorid.integrate.engine import Array
from motorid.problem.problem import Problem


def relative_jacobian(problem: Problem, q: Array) -> Array:
    """Return d(outputs over noise)/d(relative parameters), shape (n, k), initial states projected out.

    A relative change of one is a factor of e for positive parameters, the natural size of the unit for
    others.
    """
    k = len(problem.model.free_names)
    parts = []
    for j, run in enumerate(problem.runs):
        dy = problem.simulate(q, j).dy
        assert dy is not None
        for m, c in enumerate(problem.outputs):
            if c in run.sigma:
                parts.append(dy[np.isfinite(run.experiment.outputs[c]), m] / run.sigma[c])
    jac = np.concatenate(parts)
    nuisance = jac[:, k:]
    if not nuisance.any():
        return jac[:, :k]
    basis = np.linalg.qr(nuisance[:, np.linalg.norm(nuisance, axis=0) > 0])[0]
    return jac[:, :k] - basis @ (basis.T @ jac[:, :k])


def relative_sensitivities(problem: Problem, q: Array) -> tuple[dict[str, Array], ...]:
    """Return per run and channel (N, k): change over the channel's RMS per relative change of a parameter."""
    k, found = len(problem.model.free_names), []
    for j, run in enumerate(problem.runs):
        dy = problem.simulate(q, j).dy
        assert dy is not None
        rms = {c: float(np.sqrt(np.nanmean(y**2))) or 1.0 for c, y in run.experiment.outputs.items()}
        found.append({c: dy[:, m, :k] / rms[c] for m, c in enumerate(problem.outputs) if c in rms})
    return tuple(found)
