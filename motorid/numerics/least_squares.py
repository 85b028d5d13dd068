"""Levenberg-Marquardt on whitened residuals with exact Jacobians.

The damped step solves ``min ‖J d + r‖² + λ‖D d‖²`` by a QR factorisation of J (never JᵀJ); λ = 0 is Gauss-Newton's. A
residual that cannot be computed shortens the step. Variables at a bound with an outward gradient are held for the step.

On the logarithmic scale a parameter that runs to zero or to infinity loses its influence, and the plateau behind it
looks like a minimum. The usual D, column norms of J (Moré, 1978), hardly brakes it. Here D = ‖r‖: a change by a factor
of e costs λ times the present misfit, so a parameter that the misfit does not ask for stays until its turn comes.
Damping by ‖r‖² converges globally, and quadratically even where J is singular (Yamashita & Fukushima, Computing Suppl.
15, 2001; Fan & Yuan, Computing 74, 2005). λ follows the gain ratio (Nielsen, IMM-REP-1999-05). Of 100 starts within a
factor of ten 99 end in the optimum, 75 to 94 with the column norms; see `motorid.estimation.continuation`."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from motorid.errors import FitError, SimulationError, UsageError, positive
from motorid.numerics.parallel import check_time
from motorid.numerics.signals import Array


@dataclass(frozen=True)
class LevenbergMarquardt:
    """Options of the least-squares solver.

    Attributes
    ----------
    ftol : float
        Stop when a step lowers the cost by less than this share.
    xtol : float
        Stop when the step is shorter than this, relative to 1 + abs(q).
    damping : float
        First λ; 0 is Gauss-Newton.
    longest_step : float
        Largest change of one coordinate per iteration: e² on the logarithmic scale.
    looks : int
        How often a fit restarts where its end is in doubt; see `motorid.estimation.continuation`.
    patience, crawl : int, float
        Stop when `patience` steps lower the cost by less than `crawl` times ftol each.

    Examples
    --------
    >>> fit = mi.fit(mi.dc_motor(), runs, solver=mi.LevenbergMarquardt(max_iterations=50))
    """

    max_iterations: int = 200
    ftol: float = 1e-9
    xtol: float = 1e-9
    damping: float = 0.1
    longest_step: float = 2.0
    looks: int = 5
    patience: int = 30
    crawl: float = 1e4

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 <= value < np.inf:
                raise UsageError(f"LevenbergMarquardt takes numbers of at least zero; {name} is {value!r}.")

    def at_most(self, other: "LevenbergMarquardt") -> "LevenbergMarquardt":
        """Return these options, ending no later than `other`."""
        return replace(self, max_iterations=min(self.max_iterations, other.max_iterations),
                       ftol=max(self.ftol, other.ftol), xtol=max(self.xtol, other.xtol))


@dataclass(frozen=True)
class Huber:
    """Robust loss: quadratic within `delta` sigma, linear beyond (Huber, Ann. Math. Stat. 35, 1964).

    Examples
    --------
    >>> fit = mi.fit(mi.dc_motor(), runs, loss=mi.Huber(2.0))
    """

    delta: float = 1.345

    def __post_init__(self) -> None:
        positive(" It counts standard deviations.", delta=self.delta)

    def pseudo(self, r: Array) -> tuple[Array, Array]:
        """Return r̃ with r̃² = 2ρ(r), and dr̃/dr, so that least squares of r̃ minimise the robust loss."""
        size = np.abs(r)
        far = size > self.delta
        root = np.sqrt(np.where(far, 2 * self.delta * size - self.delta**2, 1.0))
        return np.where(far, np.sign(r) * root, r), np.where(far, self.delta / root, 1.0)


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the solver ended."""

    q: Array
    residual: Array
    jac: Array  # in q; that of the last step but one where the last one changed next to nothing
    status: str  # "converged", "stalled" (no step lowers the cost) or "limit" (of iterations)
    message: str
    history: tuple[float, ...]  # of costs


ENDS = {  # status and message
    "cost": ("converged", "converged: a full step no longer lowers the cost"),
    "step": ("converged", "converged: the step is below the tolerance"),
    "gradient": ("converged", "converged: the gradient is zero within rounding"),
    "valley": ("stalled", "stalled: the cost hardly falls any more, by less than {enough:.2g} % in {o.patience} "
                          "steps; identifiability() shows whether parameters are determined"),
    "stalled": ("stalled", "stalled: no step lowers the cost; the model may be too stiff here. Try another start or "
                           "engine"),
    "limit": ("limit", "stopped after {o.max_iterations} iterations; raise max_iterations or look at "
                       "identifiability()")}
PROMISED = 1e-3  # share of the cost that the undamped step may promise at an end without a step
SLACK = 1.0  # λ above which a small gain does not mean the end: the step was short, not the way
MANY = 24  # unknowns, of which some are likely to act on a few rows only: the first states of many runs
ROWS = 256  # that are reduced together then, to a triangle of the unknowns that act there


def levenberg_marquardt(residual: Callable[[Array], Array], both: Callable[[Array], tuple[Array, Array]], q0: Array,
                        bounds: tuple[Array, Array] | None = None, options: LevenbergMarquardt | None = None,
                        callback: Callable[[int, float, Array], object] | None = None,
                        log: np.ndarray | None = None) -> Solution:
    """Minimise ½‖r(q)‖² from `q0` (nq,); `log` (nq,) tells which coordinates are logarithms.

    `residual` is ``q -> r`` (n,) and may raise `SimulationError`; `both` is ``q -> (r, jac)``, jac (n, nq), called at
    the start and after every accepted step only, so that it may refine what `residual` does there; the callback
    (iteration, cost, q) is called then, too. FitError without a residual at the start, OutOfTime once time is up."""
    o = options or LevenbergMarquardt()
    search = _Search(residual, both, np.asarray(q0, float), bounds, o, log)
    history, end, enough = [search.cost], "limit", o.patience * o.crawl * o.ftol
    for iteration in range(1, o.max_iterations + 1):
        check_time()
        before, reason = search.q, search.step()
        if search.q is not before:
            history.append(search.cost)
            if callback is not None:
                callback(iteration, search.cost, search.q)
        crawls = len(history) > o.patience and 0 <= history[-1 - o.patience] - history[-1] < enough * history[-1]
        if reason or crawls:
            end = reason or "valley"
            break
    status, message = ENDS[end]
    return Solution(search.q, search.r, search.jac, status, message.format(o=o, enough=100 * enough), tuple(history))


class _Search:
    """The state of one descent: where it is, and how strongly it is damped."""

    def __init__(self, residual, both, q0: Array, bounds, options: LevenbergMarquardt, log) -> None:
        n = len(q0)
        self.residual, self.both, self.o = residual, both, options
        self.low, self.high = bounds if bounds is not None else (np.full(n, -np.inf), np.full(n, np.inf))
        self.log = np.zeros(n, bool) if log is None else np.asarray(log, bool)
        self.q = np.clip(q0, self.low, self.high)
        self.lam, self.growth = options.damping, 2.0
        self.size = np.zeros(n)
        try:
            self._move(self.q)
        except SimulationError as error:
            raise FitError(f"the model cannot be simulated at the start: {error} Give other starting values "
                           "with model.replace(…), or leave them out.") from None

    def _move(self, q: Array) -> None:
        self.r, self.jac = self.both(q)
        self.q, self.cost = q, 0.5 * float(self.r @ self.r)
        self.gradient = self.jac.T @ self.r
        self.size = np.maximum(self.size, np.sqrt(np.einsum("ij,ij->j", self.jac, self.jac)))

    def step(self) -> str:
        """Take one step that lowers the cost; return why the descent ends here, or an empty string."""
        g, o = self.gradient, self.o
        free = ~(((self.q <= self.low) & (g > 0)) | ((self.q >= self.high) & (g < 0)))
        size = np.where(self.size > 0, self.size, 1.0)
        misfit = np.sqrt(2 * self.cost)
        if not free.any() or np.max(np.abs(g[free]) / size[free]) <= 1e-14 * misfit + 1e-300:
            return "gradient"
        weight = np.where(self.log, misfit, np.minimum(size, misfit))[free]
        triangle, rotated = _reduce(self.jac[:, free], self.r)
        # The undamped step promises ½‖Qᵀr‖²: while that is much, a place without a better one is no minimum.
        end = "step" if 0.5 * float(rotated @ rotated) <= PROMISED * self.cost else "stalled"
        longest = o.longest_step * np.where(self.log, 1.0, np.maximum(np.abs(self.q), 1.0))
        while True:
            step = np.zeros(len(self.q))
            step[free] = _inside(triangle, rotated, weight, self.lam, (self.low - self.q)[free],
                                 (self.high - self.q)[free])
            step /= max(float(np.max(np.abs(step) / longest)), 1.0)  # no coordinate changes by more than is trusted
            step = np.clip(self.q + step, self.low, self.high) - self.q
            predicted = -float(g @ step) - 0.5 * float(np.sum((triangle @ step[free]) ** 2))
            small = bool(np.max(np.abs(step) / (np.abs(self.q) + 1.0)) < o.xtol)
            r, cost = _cost(self.residual, self.q + step)
            drop = self.cost - cost
            gain = drop / predicted if predicted > 0 else -1.0
            if drop > 0 and gain > 1e-4:
                break
            full = self.lam < SLACK  # hardly shortened: what it promises is what is left to gain
            if small or predicted <= (1.0 if full else 1e-3) * o.ftol * self.cost or self.lam > 1e16:
                return end
            self.lam, self.growth = (self.lam * self.growth if self.lam > 0 else 1e-3), self.growth * 2
        self.lam = max(self.lam * max(1 / 3, 1 - (2 * min(gain, 1.0) - 1) ** 3), 1e-12) if o.damping else 0.0
        self.growth = 2.0
        enough = drop <= o.ftol * self.cost and self.lam < SLACK
        if enough or small:  # so near that the Jacobian is still that of the solution
            self.q, self.r, self.cost = self.q + step, r, cost
            return end if small else "cost"
        try:
            self._move(self.q + step)
        except SimulationError:  # slopes may overflow where outputs do not
            self.lam = 100 * max(self.lam, 1e-3)
        return ""


def _reduce(jac: Array, r: Array) -> tuple[Array, Array]:
    """Return R and Qᵀr of jac = QR, through the R of [J r], which needs no Q."""
    full, n = np.column_stack([jac, r]), jac.shape[1]
    if n > MANY:
        lots, one = ((rows, rows.any(axis=0)) for rows in np.split(full, range(ROWS, len(full), ROWS))), np.eye(n + 1)
        full = np.concatenate([np.linalg.qr(rows[:, acts], mode="r") @ one[acts] for rows, acts in lots])
    if (full := np.asarray(np.linalg.qr(full, mode="r"))).shape[0] < n:  # fewer residuals than unknowns
        full = np.vstack([full, np.zeros((n - full.shape[0], n + 1))])
    return full[:n, :n], full[:n, n]


def _inside(triangle: Array, rotated: Array, size: Array, lam: float, low: Array, high: Array) -> Array:
    """Damped step within the box: what would leave it goes on its bound, and the others are solved again."""
    step, loose = np.zeros(len(size)), np.ones(len(size), bool)
    while loose.any():
        step[loose] = _damped(triangle[:, loose], rotated + triangle[:, ~loose] @ step[~loose], size[loose], lam)
        if not (out := loose & ((step < low) | (step > high))).any():
            break
        step[out] = np.clip(step, low, high)[out]
        loose &= ~out
    return step


def _damped(triangle: Array, rotated: Array, size: Array, lam: float) -> Array:
    """Solve the damped problem by QR of the small stacked system, in scaled unknowns."""
    scaled = triangle / size
    if lam == 0:
        return -np.linalg.lstsq(scaled, rotated, rcond=None)[0] / size
    q, small = np.linalg.qr(np.vstack([scaled, np.sqrt(lam) * np.eye(len(size))]))
    return -np.linalg.solve(small, q[:len(rotated)].T @ rotated) / size


def _cost(residual: Callable[[Array], Array], q: Array) -> tuple[Array, float]:
    try:
        r = residual(q)
    except SimulationError:
        return np.empty(0), np.inf
    with np.errstate(over="ignore", invalid="ignore"):
        cost = 0.5 * float(r @ r)
    return r, cost if np.isfinite(cost) else np.inf


def seen_directions(jac: Array) -> tuple[Array, Array]:
    """Return H (n, r) with (JᵀJ)⁻¹ = HHᵀ, columns scaled, and directions left out (m, n), below 1e-8 of the largest."""
    norms = np.sqrt(np.einsum("ij,ij->j", jac, jac))
    size = np.where(norms > 0, norms, 1.0)
    _, s, vt = np.linalg.svd(np.linalg.qr(jac / size, mode="r"), full_matrices=True)
    s = np.concatenate([s, np.zeros(vt.shape[0] - len(s))])
    good = s > 1e-8 * max(s.max(initial=0.0), 1e-300)
    return vt[good].T / s[good] / size[:, None], vt[~good] / size
