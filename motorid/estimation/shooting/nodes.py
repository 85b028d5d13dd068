"""First guesses of the states at shooting nodes: from the measured channels, or from a simulation."""

from __future__ import annotations

import numpy as np

from motorid.errors import SimulationError
from motorid.estimation.shooting.mesh import Mesh
from motorid.integrate.engine import Array
from motorid.records.experiment import Experiment


def nodes_from_simulation(mesh: Mesh, q: Array) -> Array:
    """Return states (n_nodes, nx) on the model's own trajectory at `q`.

    Raises
    ------
    SimulationError
    """
    problem = mesh.problem
    states = [problem.simulate(q, k, derivatives=False).x for k in range(len(problem.runs))]
    return np.array([states[v.run][v.last] for v in mesh.intervals if v.next >= 0]).reshape(-1, mesh.nx)


def nodes_from_data(mesh: Mesh, q: Array) -> Array:
    """Return states (n_nodes, nx): measured ones from the data, the others carried on by the simulation."""
    problem = mesh.problem
    at = problem.unknowns.point(q)
    signals = [measured_states(run, problem.system.states) for run in problem.experiments]
    found = np.zeros((mesh.n_nodes, mesh.nx))
    x = np.zeros(mesh.nx)
    for v in mesh.intervals:
        if v.node < 0:
            x = problem.unknowns.first_state(at, v.run)
        if v.next < 0:
            continue
        try:
            end = problem._engine.run(problem.system, v.grid, x, at.p).x[-1]
        except SimulationError:
            end = x
        x = end.copy()
        for j, signal in signals[v.run].items():
            x[j] = signal[v.last]
        found[v.next] = x
    return found


def measured_states(run: Experiment, states: tuple[str, ...]) -> dict[int, Array]:
    """Return the measured states (N,) by index, gaps bridged; a speed not measured is the slope of the angle."""
    found = {}
    for j, name in enumerate(states):
        if name in run.outputs:
            found[j] = _bridged(run.t, run.outputs[name])
        elif name == "omega" and "theta" in run.outputs:
            found[j] = slope_of(run.t, _bridged(run.t, run.outputs["theta"]))
    return found


def slope_of(t: Array, y: Array, half: int = 5) -> Array:
    """Return dy/dt (N,) over windows of 2·half samples."""
    k = np.arange(len(t))
    a, b = np.maximum(k - half, 0), np.minimum(k + half, len(t) - 1)
    return (y[b] - y[a]) / (t[b] - t[a])


def _bridged(t: Array, y: Array) -> Array:
    good = np.isfinite(y)
    return y if good.all() else np.interp(t, t[good], y[good])


__all__ = ["measured_states", "nodes_from_data", "nodes_from_simulation", "slope_of"]
