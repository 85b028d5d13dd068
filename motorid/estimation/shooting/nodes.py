"""States at the shooting nodes: initialised from measured channels or a simulation; their gaps as process noise."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from motorid.errors import SimulationError, among
from motorid.estimation.shooting.mesh import Mesh, places
from motorid.numerics.signals import Array, bridged, slope
from motorid.records.experiment import Experiment

NEXT_TO_NONE = 1e-6  # of a state's size per √s: states that no unknown voltage or torque acts on
FIRST = 0.03  # of a state's size per √s
DISTURBED = ("i", "omega")  # an unknown voltage, an unknown torque


def nodes_from_simulation(mesh: Mesh, q: Array) -> Array:
    """Return states (n_nodes, nx) on the model's own trajectory at `q`; SimulationError if that fails."""
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
        with suppress(SimulationError):
            x = problem.integrator.run(problem.system, v.grid, x, at.p).x[-1]
        x = x.copy()
        for j, signal in signals[v.run].items():
            x[j] = signal[v.last]
        found[v.next] = x
    return found


def measured_states(run: Experiment, states: tuple[str, ...]) -> dict[int, Array]:
    """Return the measured states (N,) by index, gaps bridged; a speed not measured is the slope of the angle."""
    found = {}
    for j, name in enumerate(states):
        if name in run.outputs:
            found[j] = bridged(run.t, run.outputs[name])
        elif name == "omega" and "theta" in run.outputs:
            found[j] = slope(run.t, bridged(run.t, run.outputs["theta"]), half=5)
    return found


@dataclass(frozen=True, eq=False)
class Gaps:
    """What is missing at each of n nodes: the state there minus the end of the interval before.

    J·gap/span of the speed is the mean torque that was missing in an interval that is short beside the mechanical time
    constant.
    """

    run: np.ndarray  # (n,) of int
    t: Array  # (n,), s
    span: Array  # (n,), length of the interval before, s
    states: tuple[str, ...]
    values: Array  # (n, nx), SI


def gaps_of(mesh: Mesh, z: Array) -> Gaps:
    """Return the gaps at `z`."""
    before = [v for v in mesh.intervals if v.next >= 0]
    blocks = mesh.gaps(z, mesh.walk(z, False), weighed=False)
    values = np.array([b.values * mesh.scale for b in blocks]).reshape(-1, mesh.nx)
    return Gaps(np.array([v.run for v in before], int), np.array([v.grid.t[-1] for v in before]),
                np.array([v.grid.t[-1] - v.grid.t[0] for v in before]), mesh.problem.system.states, values)


def first_noise(given: Any, mesh: Mesh) -> Array:
    """Return process noise to begin with, (nx,): the user's by state, or ``"auto"``; next to none in other states."""
    sizes = dict(zip(mesh.problem.system.states, mesh.scale, strict=True))
    if given == "auto":
        given = {n: FIRST * s for n, s in sizes.items() if n in DISTURBED}
    for name in given:
        among(name, sizes, "state", where="process_noise: ")
    return np.array([given.get(n, NEXT_TO_NONE * s) for n, s in sizes.items()])


def noise_of_gaps(done: Any) -> Array:
    """Return the process noise that the gaps of a solved mesh show, (nx,); of undisturbed states as it was."""
    mesh: Mesh = done.mesh
    assert mesh.noise is not None
    gaps = gaps_of(mesh, done.result.z)
    shown = np.sqrt(np.mean(gaps.values**2 / gaps.span[:, None], axis=0))
    acted_on = np.array([n in DISTURBED for n in gaps.states])
    return np.where(acted_on, np.maximum(shown, NEXT_TO_NONE * mesh.scale), mesh.noise)


def reduced(mesh: Mesh, z: Array) -> tuple[Array, Array]:
    """Return residuals (n,) at `z`, and what of their Jacobian (n, nq) the nodes cannot take over.

    The columns of q are projected off those of the nodes, so that JᵀJ is the Schur complement and its inverse
    the covariance of q with the nodes unknown.
    """
    blocks = mesh.residual(z, mesh.walk(z, True))
    residual = np.concatenate([b.values for b in blocks])
    entries = np.concatenate([b.jac.ravel() for b in blocks])
    whole = scipy.sparse.csc_matrix((entries, places(blocks)), shape=(len(residual), len(z)))
    jac, nodes = whole[:, :mesh.nq].toarray(), whole[:, mesh.nq:]
    if not nodes.shape[1]:
        return residual, jac
    return residual, jac - nodes @ scipy.sparse.linalg.splu((nodes.T @ nodes).tocsc()).solve(nodes.T @ jac)
