"""The default engine: fixed Rosenbrock sub-steps per sample, compiled where a C compiler is there."""

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any
from weakref import WeakValueDictionary

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from motorid.errors import SimulationError, at_least
from motorid.integrate import compiled as cc
from motorid.integrate.engine import Grid, Tolerance, Trajectory, address
from motorid.integrate.rodas3 import ORDER, StepFunctions
from motorid.model.equations import System
from motorid.numerics.parallel import check_time
from motorid.numerics.signals import Array

PATIENCE = 1.5e7  # instructions of the virtual machine (0.05 s) before a step is worth compiling
CHUNK = 256  # steps in one call of the virtual machine
MOST_SUBSTEPS = 256
MOST_PASSES = 6
PLACES = 8  # of a record, from which a small change is followed
LOST_ERROR = 0.3  # error estimate, relative to the state so far, at which a step is lost
LOST_GROWTH = 1e3  # growth of a state that shows it


@dataclass(frozen=True)
class Rosenbrock:
    """RODAS3, sub-steps chosen by halving them; the exact derivative of the discrete step goes along.

    Attributes
    ----------
    compiled : bool or None
        None: compile once a model has used the virtual machine for a moment; True: at once; False: never.
    most_steps : int or None
        Sub-steps of a record at most: `prepare` fails where accuracy asks for more. None: no limit.

    Examples
    --------
    >>> fit = mi.fit(mi.dc_motor(), runs, engine=mi.Rosenbrock(compiled=False))
    """

    compiled: bool | None = None
    name: str = "rosenbrock"
    most_steps: int | None = None

    def __post_init__(self) -> None:
        at_least(1, most_steps=self.most_steps)

    def run(self, system: System, grid: Grid, x0: Array, p: Array, dx0: Array | None = None,
            dp: Array | None = None, local_error: bool = False) -> Trajectory:
        """See `Engine.run`; on request with the error estimate of each state."""
        return stepper(system).run(grid, x0, p, dx0, dp, local_error, self.compiled)

    def prepare(self, system: System, grid: Grid, x0: Array, p: Array, tolerance: Tolerance) -> Grid:
        """See `Engine.prepare`. Errors are relative to the largest size of each state on the record.

        Where the error estimate of a step is too large, what half the steps change at the end of its interval decides
        (Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, 1993, II.4): a current that settles
        before the next sample needs no steps of its own. A step that goes astray, or leaves the finite numbers, spoils
        all after it, which is then neither refined for nor a measure of size. It has not where half the steps end
        alike; where no more are to be had, every later run on this grid fails, too."""
        passes, right, shown = float(MOST_PASSES), 0, None
        while passes > 0:
            try:
                traj = self.run(system, grid, x0, p, local_error=True)
            except SimulationError as failed:
                if not failed.sample:
                    raise
                traj = self._as_far(system, grid, x0, p, failed.sample)
            level, loose, asked = tolerance(traj) if callable(tolerance) else (tolerance, tolerance, None)
            assert traj.error is not None
            size, error = np.abs(np.ascontiguousarray(traj.x.T)), np.ascontiguousarray(traj.error.T)
            np.maximum.accumulate(size, axis=1, out=size)  # so far; NumPy reduces long rows faster
            if (astray := _first_inaccurate(size, error, right)) is not None:
                traj = traj._replace(x=traj.x[:astray + 2], y=traj.y[:astray + 2])
                size, error[:, astray + 1:] = size[:, :astray + 2], 0.0
            gone = np.isinf(error).any(axis=0)
            sizes = np.maximum(np.maximum(size[:, -1], stepper(system).shown_sizes(grid, traj, p)), 1e-12)[:, None]
            relative = (error / sizes).max(axis=0)
            rows = np.flatnonzero(relative > level)
            if len(rows):
                error[:, rows] = stepper(system).halved(grid, rows, traj.x, p, self.compiled)
                error[:, gone] = np.inf
                relative[rows] = (error[:, rows] / sizes).max(axis=0)
            if asked is not None and min(loose, np.max(relative, initial=0.0)) > 2 * level:
                shown = stepper(system).shown_ever(grid, traj, p, self.compiled) if shown is None else shown
                few = np.isfinite(asked)
                own = np.min(asked[few, None] / np.maximum(shown[few], 1e-300), axis=0)[:, None]
                relative = (error / np.clip(own / level, sizes, loose / level * sizes)).max(axis=0)
            passes -= 1 if astray is None and not gone.any() else 1 / 128  # a record has hundreds
            if passes % 1:
                check_time()  # which take long
            finer = grid.substeps
            if np.max(relative, initial=0.0) > 2 * level:  # not where it is no number
                factor = np.ceil(1.1 * (np.maximum(relative, 1e-300) / level) ** (1 / ORDER))
                finer = np.clip(finer * np.clip(factor, 1, 16), 1, MOST_SUBSTEPS).astype(np.int64)
            if np.array_equal(finer, grid.substeps):
                if astray is None or gone.any():
                    break
                right = astray + 1
                continue
            if self.most_steps is not None and finer.sum() > self.most_steps:
                raise SimulationError(f"the model is too stiff: it takes more than {self.most_steps} steps.")
            grid = grid.with_substeps(finer)
        return grid

    def _as_far(self, system: System, grid: Grid, x0: Array, p: Array, sample: int) -> Trajectory:
        """Return the trajectory to where it leaves the finite numbers, and as it was there from `sample` on; the error
        of the interval before that is infinite. SimulationError where even the finest steps leave them at once."""
        near = grid.part(0, max(sample - 1, 1))
        near = self.run(system, near if sample > 1 else near.with_substeps(np.array([MOST_SUBSTEPS])), x0, p,
                        local_error=True)
        y, x = (np.concatenate([a[:sample], np.repeat(a[sample - 1:sample], len(grid.t) - sample, axis=0)])
                for a in (near.y, near.x))
        error = np.zeros((len(x) - 1, x.shape[1]))
        error[:sample - 1] = 0.0 if near.error is None else near.error[:sample - 1]
        error[sample - 1] = np.inf
        return Trajectory(y, None, x, None, error)


def _first_inaccurate(size: Array, error: Array, begin: int) -> int | None:
    """Return the first interval from `begin` on whose error is as large as the state, if that leaves its size there."""
    lost = np.flatnonzero((error[:, begin:] > LOST_ERROR * np.maximum(size[:, begin + 1:], 1e-12)).any(axis=0))
    if not len(lost):
        return None
    k = begin + int(lost[0])
    before, after = np.maximum(size[:, k], 1e-12), np.maximum(size[:, k + 1], 1e-12)
    jumped = (after / LOST_GROWTH > before) & (before > 1e-12)
    return k if np.any(jumped | (size[:, -1] / LOST_GROWTH > after)) else None


class Stepper:
    """One system's step, in the virtual machine first and compiled when it pays."""

    def __init__(self, system: System, key: str) -> None:
        self.system, self.key = system, key
        self.functions = StepFunctions(system)
        self.machine = Machine(self.functions)
        self.nx, _, _, self.ny = system.sizes
        self._library: Any = None
        self._refused, self._spent, self._next_look = False, 0, 0

    def run(self, grid: Grid, x0: Array, p: Array, dx0: Array | None, dp: Array | None, local_error: bool,
            compiled: bool | None) -> Trajectory:
        """Walk over the record; see `Engine.run`."""
        x0, p = np.ascontiguousarray(x0, float), np.ascontiguousarray(p, float)
        if dp is not None and dx0 is not None:
            dx0, dp = np.ascontiguousarray(dx0, float), np.ascontiguousarray(dp, float)
        if (library := self._load(compiled)) is not None:
            n, nq = len(grid.t), 0 if dp is None else dp.shape[1]
            y, x = np.empty((n, self.ny)), np.empty((n, self.nx))
            dy, dx = (np.empty((n, self.ny, nq)), np.empty((n, self.nx, nq))) if nq else (None, None)
            error = np.empty((n - 1, self.nx)) if local_error else None
            more = map(address, (dx0, dp, y, dy, x, dx, error))
            bad = library[0](n, *grid.addresses, address(x0), address(p), nq, *more)
            traj = Trajectory(y, dy, x, dx, error)
        else:
            traj = self.machine.run(grid, x0, p, dx0, dp, local_error)
            finite = np.isfinite(traj.x).all(axis=1)
            bad = -1 if finite.all() else int(np.argmin(finite))
            step = self.functions.light if dp is None else self.functions.full
            self._spent += step.n_instructions() * int(grid.substeps.sum())
        if bad >= 0:
            error = SimulationError(f"the simulation left the finite numbers at t = {grid.t[bad]:.6g} s; the "
                                    "parameters make the model unstable or stiff beyond the step.")
            error.sample = bad
            raise error
        return traj

    def halved(self, grid: Grid, rows: NDArray[np.int64], x: Array, p: Array, compiled: bool | None) -> Array:
        """Return by how much half the steps change where the intervals `rows` of a trajectory x end, (nx, n)."""
        x, p = np.ascontiguousarray(x, float), np.ascontiguousarray(p, float)
        if (library := self._load(compiled)) is not None:
            ends = np.empty((len(rows), self.nx))
            library[1](len(rows), *map(address, (rows, grid.substeps, grid.dt, grid.u0, grid.u1, x, p, ends)))
        else:
            ends = self.machine.halved(grid, rows, x, p)
            self._spent += self.functions.light.n_instructions() * 2 * int(grid.substeps[rows].sum())
        return np.where(np.isfinite(ends), np.abs(x[rows + 1] - ends), np.inf).T

    def shown_sizes(self, grid: Grid, traj: Trajectory, p: Array) -> Array:
        """Size (nx,) that the largest output lends the states it shows: a small part need not be exact."""
        middle, slopes = len(traj.x) // 2, np.empty((self.nx, self.ny))  # column-major, as CasADi has it
        p = np.ascontiguousarray(p, float)
        given, skip = (traj.x[middle], np.ascontiguousarray(grid.u[middle]), p), np.empty(self.ny * (len(p) + 1))
        call, trigger = self.functions.out.buffer()  # a new one, as another thread may ask, too
        _called(call, trigger, given, (skip, slopes, skip[self.ny:]))
        slopes = np.abs(slopes.T)
        tops = np.abs(np.ascontiguousarray(traj.y.T)).max(axis=1)  # long rows are quicker
        with np.errstate(over="ignore"):  # a model that runs away
            return np.where(slopes > 1e-6, tops[:, None] / np.maximum(slopes, 1e-6), 0.0).max(axis=0)

    def shown_ever(self, grid: Grid, traj: Trajectory, p: Array, compiled: bool | None) -> Array:
        """Largest change (ny, nx) of each output, at any time, per change of a state, as the linearised model goes on
        from a few places of a trajectory; infinite of an output of states that do more than sum up others."""
        n, one, none = len(traj.x), np.eye(self.nx), np.zeros((len(p), self.nx))
        near = [self.run(grid.part(k, k + 1), traj.x[k], p, one, none, False, compiled)
                for k in np.unique(np.linspace(0, n - 2, PLACES).astype(int))]
        shown, step = np.array([r.dy[0] for r in near if r.dy is not None]), np.array([r.dx for r in near])[:, 1]
        more = np.diff(self.system.rhs.jac_sparsity(0, 0).colind()) > 0  # than that: a detent holds the motor
        largest = np.where((shown[:, :, more] != 0).any(axis=(0, 2))[:, None], np.inf, np.abs(shown).max(axis=0))
        with np.errstate(all="ignore"):
            for _ in range(int(np.log2(n)) + 1):
                largest, step = np.maximum(largest, np.abs(shown @ step).max(axis=0)), step @ step
        return np.nan_to_num(largest, nan=np.inf, posinf=np.inf)

    def _load(self, compiled: bool | None) -> Any:
        """Return the compiled driver if it is there, or worth making now; else None."""
        if compiled is False or self._refused:
            return None
        if self._library is None and (compiled or self._spent >= self._next_look):
            self._next_look = min(2 * self._spent + 1, PATIENCE + 1)  # another process may have made it meanwhile
            if (mark := cc.mark_of(self.key)) is None:
                self._refused = True
                cc.say_once("motorid: no C compiler found; using CasADi's virtual machine, same results, slower.")
                return None
            if (path := cc.find(mark)) is None and (compiled or self._spent > PATIENCE):
                path = cc.build(cc.generate(self.functions), mark)
                self._refused = path is None
            if path is not None:
                self._library = cc.load(path, self.system.sizes)
                self._refused = self._library is None
        return self._library


_known: WeakValueDictionary[str, Stepper] = WeakValueDictionary()  # by content, as long as one of `stepper` is


@lru_cache(maxsize=1024)
def stepper(system: System) -> Stepper:
    """Return the stepper of `system`, one per content in this process."""
    text = "\0".join([system.rhs.serialize(), system.out.serialize(), str(system.stored)])
    key = hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()
    _known[key] = found = _known.get(key) or Stepper(system, key)
    return found


class Machine:
    """Walks and observations of one system, over `CHUNK` steps at a time, made when first needed."""

    def __init__(self, functions: StepFunctions) -> None:
        self.functions = functions
        self.nx, _, self.np, self.ny = functions.system.sizes
        self.walk_of = lru_cache(maxsize=32)(self._walk)
        self.observation_of = lru_cache(maxsize=2)(self._observation)

    def _walk(self, nq: int, nonzeros: tuple[int, ...]) -> ca.Function:
        """Return CHUNK steps in a row; sensitivities go transposed, so that time comes first in memory."""
        if not nq:
            return self.functions.light.mapaccum("walk", CHUNK)
        x, u0, u1, h, p = self.functions.full.sx_in()
        places = ca.Sparsity.triplet(nq, self.np, [k % nq for k in nonzeros], [k // nq for k in nonzeros])
        s, dp = ca.SX.sym("S", nq, self.nx), ca.SX.sym("dp", places)  # a product with zeros costs as much as another
        x_next, a, b = self.functions.full(x, u0, u1, h, p)
        one = ca.Function("one", [x, s, u0, u1, h, p, dp], [x_next, ca.densify(s @ a.T + dp @ b.T)])
        return one.mapaccum("walk", CHUNK, 2, {})

    def _observation(self, derivatives: bool) -> ca.Function:
        given = self.functions.out.sx_in()
        y, c, d = self.functions.out(*given)
        return ca.Function("seen", given, [y, c.T, d.T] if derivatives else [y]).map(CHUNK)

    def run(self, grid: Grid, x0: Array, p: Array, dx0: Array | None, dp: Array | None,
            local_error: bool) -> Trajectory:
        """Return the trajectory; see `Engine.run`."""
        nq = 0 if dp is None or dx0 is None else dp.shape[1]
        ua, ub, h, ends = _laid_out(grid, grid.dt)
        n = len(h)
        x, s, e = np.empty((n + 1, self.nx)), np.empty((n + 1, self.nx, nq)), np.empty((n, self.nx))
        x[0] = x0
        steady, nonzeros = [_repeated(p)], np.flatnonzero(0 if dp is None else dp)
        if dp is not None:
            s[0] = dx0
            steady.append(_repeated(dp.ravel()[nonzeros]))  # column-major (nq, np) is dp itself
        moving, results = ([x, s, ua, ub, h], [x[1:], s[1:]]) if nq else ([x, ua, ub, h], [x[1:], e])
        _in_chunks(self.walk_of(nq, tuple(nonzeros.tolist())), n, moving, steady, results)
        y, dy = self.observe(grid, x[ends], s[ends] if nq else None, p, dp)
        error = np.maximum.reduceat(np.abs(e[:ends[-1]]), ends[:-1]) if local_error else None
        return Trajectory(y, dy, x[ends], s[ends] if nq else None, error)

    def halved(self, grid: Grid, rows: NDArray[np.int64], x: Array, p: Array) -> Array:
        """Return where the intervals `rows` end from the states x (N, nx) in half the steps, (n, nx)."""
        some = Grid(grid.t, grid.u, grid.u0[rows], grid.u1[rows], 2 * grid.substeps[rows])
        ua, ub, h, ends = _laid_out(some, grid.dt[rows])
        first = np.zeros((len(h), 1 + self.nx))  # whether an interval begins here, and its state
        first[ends[:-1]] = np.column_stack([np.ones(len(rows)), x[rows]])
        end, p = np.zeros((len(h) + 1, self.nx)), _repeated(p)
        _in_chunks(self._restarted, len(h), [end, first, ua, ub, h], [p], [end[1:]])
        return end[ends[1:]]

    @cached_property
    def _restarted(self) -> ca.Function:
        """CHUNK steps in a row, some of them from another state."""
        (x, *rest), first = self.functions.light.sx_in(), ca.SX.sym("first", 1 + self.nx)
        begin = ca.if_else(first[0], first[1:], x)
        return ca.Function("one", [x, first, *rest], [self.functions.light(begin, *rest)[0]]).mapaccum("walk", CHUNK)

    def observe(self, grid: Grid, x: Array, dx: Array | None, p: Array, dp: Array | None) -> tuple[Array, Array | None]:
        """Return what the sensors show along a state trajectory, y (N, ny) and dy/dq (N, ny, nq)."""
        n = len(x)
        full = -(-n // CHUNK) * CHUNK
        shapes = [(self.ny,), (self.ny, self.nx), (self.ny, self.np)][:1 if dx is None else 3]
        results = [np.empty((full, *shape)) for shape in shapes]
        moving = [_padded(x, full), _padded(grid.u, full)]
        _in_chunks(self.observation_of(dx is not None), full, moving, [_repeated(p)], results)
        if dx is None or dp is None:
            return results[0][:n], None
        y, c, d = (r[:n] for r in results)
        dy = np.zeros((n, self.ny, dp.shape[1]))
        with np.errstate(all="ignore"):  # a run that left the finite numbers is reported by its states
            for j in range(self.nx):  # NumPy's product of many small matrices is slower by far
                dy += c[:, :, j, None] * dx[:, None, j, :]
            dy += (d.reshape(-1, self.np) @ dp).reshape(dy.shape)
        return y, dy


def _laid_out(grid: Grid, dt: Array) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Return the input at both ends and the length of each sub-step, in whole chunks; and samples' places."""
    m = grid.substeps
    ends = np.concatenate([[0], np.cumsum(m)])
    steps = int(ends[-1])
    part, share = np.arange(steps) - np.repeat(ends[:-1], m), 1.0 / np.repeat(m, m)
    slope = np.repeat(grid.u1 - grid.u0, m, axis=0) * share[:, None]
    ua = np.repeat(grid.u0, m, axis=0) + slope * part[:, None]
    full = -(-steps // CHUNK) * CHUNK
    return _padded(ua, full), _padded(ua + slope, full), _padded(np.repeat(dt, m) * share, full), ends


def _padded(a: Array, n: int) -> Array:
    """Return `a` with its last row repeated up to `n` rows; results for those are not used."""
    return np.ascontiguousarray(np.concatenate([a, np.repeat(a[-1:], n - len(a), axis=0)]))


def _in_chunks(f: Any, n: int, moving: Sequence[Array], steady: Sequence[Array], results: Sequence[Array]) -> None:
    """Fill `results` by calls of `f` over `CHUNK` rows each; of a chunk of `moving` a call reads what it takes."""
    call, trigger = f.buffer()
    for first in range(0, n, CHUNK):
        rows = slice(first, first + CHUNK)
        _called(call, trigger, (*(a[rows] for a in moving), *steady), [a[rows] for a in results])


def _called(call: Any, trigger: Callable[[], object], given: Iterable[Any], results: Iterable[Any]) -> None:
    """Evaluate CasADi's `call` on contiguous arrays in place: a tenth of the time that a call with NumPy's takes."""
    for k, a in enumerate(given):
        call.set_arg(k, memoryview(a.reshape(-1)))
    for k, a in enumerate(results):
        call.set_res(k, memoryview(a.reshape(-1)))
    trigger()


def _repeated(a: Array) -> Array:
    return np.tile(a.reshape(-1), CHUNK)
