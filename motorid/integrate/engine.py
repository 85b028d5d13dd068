"""The input of one record laid out for an engine, and what an engine gives back."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from motorid.model.equations import System
from motorid.numerics.signals import Array, going_on


@dataclass(frozen=True, eq=False)
class Grid:
    """Sample times and inputs of one record."""

    t: Array  # (N,), s
    u: Array  # (N, nu), inputs seen by the sensors at the samples
    u0: Array  # (N-1, nu), inputs at the beginning of each interval
    u1: Array  # (N-1, nu), and at its end; the same where the input is held
    substeps: NDArray[np.int64]  # (N-1,), Rosenbrock steps per interval

    @staticmethod
    def of(t: Array, u: Array, held: NDArray[np.bool_]) -> "Grid":
        """Lay out inputs `u` (N, nu); `held` (nu,) tells which stay constant between samples, if none is left out."""
        u = np.ascontiguousarray(u, float)
        ends = np.where(held, u[:-1] + going_on(t, u) * np.diff(u, axis=0), u[1:])
        return Grid(np.ascontiguousarray(t, float), u, np.ascontiguousarray(u[:-1]), np.ascontiguousarray(ends),
                    np.ones(len(t) - 1, np.int64))

    @cached_property
    def dt(self) -> Array:
        """Lengths of the intervals, s."""
        return np.ascontiguousarray(np.diff(self.t))

    @cached_property
    def addresses(self) -> tuple[int | None, ...]:
        """Where sub-steps, dt, u0, u1 and u are in memory, for compiled code."""
        return tuple(address(a) for a in (self.substeps, self.dt, self.u0, self.u1, self.u))

    def __getstate__(self) -> dict[str, Any]:
        return {f: getattr(self, f) for f in self.__dataclass_fields__}  # addresses mean nothing elsewhere

    def with_substeps(self, substeps: NDArray[np.int64]) -> "Grid":
        """Return the grid with other sub-steps."""
        return replace(self, substeps=np.ascontiguousarray(substeps, np.int64))

    @cached_property
    def way(self) -> Array:
        """Shares of their change to the next sample that the inputs do before that, evenly, (N-1, nu)."""
        change = np.diff(self.u, axis=0)
        return (self.u1 - self.u0) / np.where(change != 0, change, 1.0)

    def with_way(self, j: int, way: Array) -> "Grid":
        """Return the grid with input `j` doing shares `way` (N-1,) of its changes between samples, evenly."""
        ends = self.u1.copy()
        ends[:, j] = self.u0[:, j] + way * np.diff(self.u[:, j])
        return replace(self, u1=ends)

    def part(self, a: int, b: int) -> "Grid":
        """Return samples a to b, both included."""
        return Grid(self.t[a:b + 1], self.u[a:b + 1], self.u0[a:b], self.u1[a:b], self.substeps[a:b])


def address(a: NDArray | None) -> int | None:
    """Return where the contiguous array `a` begins in memory."""
    return None if a is None else a.__array_interface__["data"][0]


class Trajectory(NamedTuple):
    """What an engine returns: y (N, ny); dy (N, ny, nq) or None; x (N, nx); dx (N, nx, nq) or None. `error` (N-1, nx)
    is the largest error estimate of a step in each interval, where it was asked for."""

    y: Array
    dy: Array | None
    x: Array
    dx: Array | None
    error: Array | None


Tolerance = float | Callable[[Trajectory], tuple[float, float, Array | None]]


class Engine(Protocol):
    """Integrates a system over a grid, with exact forward sensitivities."""

    name: str

    def run(self, system: System, grid: Grid, x0: Array, p: Array, dx0: Array | None = None,
            dp: Array | None = None) -> Trajectory:
        """Return the trajectory from `x0` (nx,) with parameters `p` (np,).

        `dx0` (nx, nq), `dp` (np, nq): slopes by the unknowns q. SimulationError, with the time, where it fails."""
        ...

    def prepare(self, system: System, grid: Grid, x0: Array, p: Array, tolerance: Tolerance) -> Grid:
        """Return the grid with its sub-steps chosen for an error of `tolerance` per interval, relative to the states.

        It may depend on the trajectory reached so far: then it is a smaller and a larger one, and the error (ny,) of
        each output that decides between these for each state. An engine that chooses its own steps takes any grid."""
        return grid
