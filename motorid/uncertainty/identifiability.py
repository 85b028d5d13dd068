"""Which parameters do the data determine? Singular values of the sensitivities, weak directions in words.

A record determines a direction in parameter space when a step along it changes the outputs by more than the noise.
The Jacobian of the fit says so without a fit: its columns scaled to relative changes, its rows by the noise, its
singular values are the signal-to-noise ratios of such steps (Golub & Van Loan, Matrix Computations; Miao et al., "On
identifiability of nonlinear ODE models", SIAM Review 53, 2011). It works on planned experiments too."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations, islice, product
from typing import Any

import numpy as np

from motorid.channels import NAMES
from motorid.display.cards import Card, Flag, Printed, Table
from motorid.display.numbers import number, percent, quantity
from motorid.errors import MotoridError, SimulationError, UsageError, at_least
from motorid.estimation.covariance import UNDETERMINED
from motorid.estimation.result import Fit
from motorid.estimation.start_values import with_start_values
from motorid.numerics.parallel import one_thread
from motorid.numerics.signals import Array
from motorid.problem.problem import Problem
from motorid.problem.sensitivity import relative_jacobian, relative_sensitivities
from motorid.problem.simulate import with_channels

STRUCTURAL = 1e-7  # of the largest singular value, columns of equal length: less is no influence
LEVEL = 1.0 / UNDETERMINED  # singular value below which a factor of e is no more than twice the noise
SHOWN = 0.05  # relative to the largest: smaller parts of a direction do not make it another one
SPOKEN = 0.005  # smaller parts are not worth a word
UNMOVED = 1e-6  # standard deviations of the noise that count as nothing
ALIKE = 0.1  # change of a product, per factor of e along a weak direction, that still counts as determined
STEP = 0.1  # relative change that is spoken of
MOST = 300  # pivots tried
EASY = ("R", "K", "g", "L", "b", "J")  # in the order in which they are usually known beforehand


@dataclass(frozen=True)
class WeakDirection:
    """A change of parameters that shows little in the data."""

    parameters: Mapping[str, float]  # relative changes (of the natural size where one may be zero), the largest being 1
    seen: float  # what a step of 10 % does to all outputs together, in units of the noise
    text: str


@dataclass(frozen=True, eq=False, repr=False)
class Identifiability(Printed):
    """What records can tell about parameters, at one point."""

    names: tuple[str, ...]
    values: Array  # (k,), and what a relative change of one means: the value, the natural size where it may be zero
    sizes: Array
    units: tuple[str, ...]
    t: tuple[Array, ...]  # per run, s
    sensitivities: tuple[Mapping[str, Array], ...]  # per run and channel, (N, k): over its RMS per relative change
    singular_values: Array  # (k,), of the stacked matrix, whitened by the noise, initial states projected out
    directions: Array  # (k, k), rows: right singular vectors
    structural_rank: int  # largest rank at random points: what any such experiment without noise determines
    weak: tuple[WeakDirection, ...]
    combinations: tuple[str, ...]  # products that are determined although their factors are not, e.g. "R·J"
    remedies: tuple[str, ...]  # what to fix or to measure for full rank
    fitted_std: Mapping[str, float | None] | None = None

    @property
    def rank(self) -> int:
        """Number of directions in which a change by 100 % (a factor of e) is more than twice the noise."""
        return int(np.sum(self.singular_values > LEVEL))

    @property
    def condition_number(self) -> float:
        """Largest over smallest singular value; infinite where one is zero."""
        s = self.singular_values
        return float(s[0] / s[-1]) if s.size and s[-1] > 0 else float("inf")

    @property
    def std(self) -> dict[str, float | None]:
        """One standard deviation per parameter: of the fit, else what noise alone will leave; None: not determined."""
        return self.noise_std if self.fitted_std is None else {n: self.fitted_std[n] for n in self.names}

    @property
    def noise_std(self) -> dict[str, float | None]:
        """Standard deviation if the model were exact and the noise white; None where it is not determined."""
        weak = self.singular_values <= LEVEL
        parts = np.where(weak, 0.0, 1.0 / np.maximum(self.singular_values, 1e-300))
        relative = np.sqrt((self.directions.T**2) @ parts**2)
        lost = (self.directions[weak] ** 2).sum(axis=0) > 1e-4
        return {n: None if lost[j] or relative[j] > UNDETERMINED else float(relative[j] * self.sizes[j])
                for j, n in enumerate(self.names)}

    @property
    def full(self) -> bool:
        """Whether every parameter is determined."""
        return self.rank == len(self.names)

    @property
    def text(self) -> str:
        """The verdict in words."""
        k = len(self.names)
        if self.full:
            return (f"These records determine all {k} parameters ({', '.join(self.names)}): full rank, "
                    f"condition number {self.condition_number:.3g}.")
        said = [f"These records determine {self.rank} combinations of the {k} parameters "
                f"{', '.join(self.names)}, not each of them."]
        if self.structural_rank <= self.rank:
            said.append("That is so for any input and without noise: it is in the equations and channels.")
        elif self.structural_rank == k:
            said.append("The equations would allow all; these records excite too little, or are too noisy.")
        if self.combinations:
            said.append(f"They determine approximately {', '.join(self.combinations)}.")
        return " ".join([*said, *(w.text for w in self.weak), *self.remedies])

    def to_dict(self) -> dict[str, Any]:
        """Return the contents of ``identifiability --json``."""
        condition = self.condition_number if np.isfinite(self.condition_number) else None
        return {"singular_values": self.singular_values.tolist(), "condition_number": condition, "rank": self.rank,
                "structural_rank": self.structural_rank, "parameters": list(self.names),
                "weak_directions": [{"parameters": dict(w.parameters), "text": w.text} for w in self.weak],
                "combinations": list(self.combinations), "remedies": list(self.remedies), "std": self.std,
                "noise_std": self.noise_std, "text": self.text}

    def card(self) -> Card:
        """Return the verdict, and what a fit would know of each parameter."""
        rows = []
        for (n, sd), value, unit in zip(self.std.items(), map(float, self.values), self.units, strict=True):
            share = Flag("not determined", "note") if sd is None else percent(sd / abs(value) if value else None, 2)
            rows.append([n, "–" if sd is None else quantity(value, unit), quantity(sd, unit, 2), share])
        k = len(self.names)
        partly = Flag(f"{self.rank} of {k} directions determined", "note")
        values = ", ".join(number(s, 3) for s in self.singular_values)
        return Card("What the data determine", (Flag("all determined", "good") if self.full else partly,),
                    (self.text, f"Singular values {values}; condition number {number(self.condition_number, 3)}; "
                                f"rank {self.rank} of {k}, structural rank {self.structural_rank}."),
                    (Table(["parameter", "value", "std" if self.fitted_std else "expected std", "relative"], rows),),
                    (("mi.plot_singular_values(result)", "see it"),), "plot_singular_values")


@one_thread
def identifiability(problem_or_fit: Problem | Fit, *, points: int = 5, seed: int = 0) -> Identifiability:
    """Say which parameters, and which combinations of them, records determine.

    Parameters
    ----------
    problem_or_fit : Problem or Fit
        A fit is judged at its values; a problem at its model's values, or at the automatic first guess
        where none were given. For an experiment not yet made, see `planned`.
    points : int
        Random points at which the structural rank is sought.
    seed : int

    Raises
    ------
    SimulationError
        If the model cannot be simulated there.

    Examples
    --------
    >>> mi.identifiability(better).rank
    6
    """
    at_least(1, points=points)
    at_least(0, seed=seed)
    if isinstance(problem_or_fit, Fit):
        problem, q = problem_or_fit.problem, problem_or_fit.q
    else:
        given = any(p.given for p in problem_or_fit.model.parameters.values())
        begun = problem_or_fit if given else with_start_values(problem_or_fit)
        problem, q = begun.refined(begun.start), begun.start
    if not (names := problem.model.free_names):
        raise UsageError("the model has no free parameter; free some with model.free(…).")
    k = len(names)
    matrix = relative_jacobian(problem, q)
    _, s, v = np.linalg.svd(np.asarray(np.linalg.qr(matrix, mode="r")), full_matrices=True)
    s = np.concatenate([s, np.zeros(k - len(s))])
    weak = v[s <= LEVEL]
    return Identifiability(
        names, problem.scaling.physical(q)[:k], problem.scaling.slope(q)[:k],
        tuple(p.unit for p in problem.unknown[:k]), tuple(r.grid.t for r in problem.runs),
        relative_sensitivities(problem, q), s, v, _structural_rank(problem, q, points, seed),
        basis_in_words(names, weak, matrix), tuple(monomials(names, weak)) if len(weak) else (),
        tuple(suggestions(problem, q, matrix, len(weak))) if len(weak) else (),
        problem_or_fit.std if isinstance(problem_or_fit, Fit) else None)


def _structural_rank(problem: Problem, q: Array, points: int, seed: int) -> int:
    """Return the largest rank at `q` and at random points within a factor of three, noise not counting."""
    rng, k, best = np.random.default_rng(seed), len(problem.model.free_names), 0
    for trial in range(points + 1):
        at = q.copy()
        at[:k] += np.where(problem.scaling.log[:k], np.log(3.0), 0.5) * rng.uniform(-1, 1, k) * (trial > 0)
        with suppress(SimulationError, np.linalg.LinAlgError), np.errstate(over="ignore", invalid="ignore"):
            jac = relative_jacobian(problem.refined(at), at)
            norms = np.linalg.norm(jac, axis=0)
            s = np.linalg.svd(jac / np.where(norms > 0, norms, 1.0), compute_uv=False)
            best = max(best, int(np.sum(s > STRUCTURAL * max(s[0], 1e-300))))
        if best == k:
            break
    return best


def basis_in_words(names: Sequence[str], weak: Array, matrix: Array) -> tuple[WeakDirection, ...]:
    """Return weak directions (d, k) with as few parts as possible, and what a step of 10 % along each does."""
    found = []
    for row in sparse_basis(weak):
        row = row / row[np.argmax(np.abs(row))]
        parts = {n: float(w) for n, w in zip(names, row, strict=True) if abs(w) >= SPOKEN}
        seen = float(np.linalg.norm(matrix @ (STEP * row)))
        moves = ", ".join(f"{n} by {100 * STEP * w:+.2g} %".replace("-", "−") for n, w in parts.items())
        effect = f"moves all outputs by {seen:.1g} standard deviations of their noise"
        effect = "does not move the outputs at all" if seen < UNMOVED else effect
        found.append(WeakDirection(parts, seen, f"Changing {moves}{' together' * (len(parts) > 1)} {effect}."))
    return tuple(found)


def sparse_basis(weak: Array) -> Array:
    """Return a basis of the same space with as few entries as possible."""
    d, k = weak.shape
    if d == 0:
        return weak
    best, fewest = weak, np.inf
    for pivots in islice(combinations(range(k), d), MOST):
        block = weak[:, list(pivots)]
        if abs(np.linalg.det(block)) < 1e-3:
            continue
        rows = np.linalg.solve(block, weak)
        rows /= np.max(np.abs(rows), axis=1, keepdims=True)
        shown = np.where(np.abs(rows) >= SHOWN, rows, 0.0)
        if np.linalg.svd(shown, compute_uv=False)[-1] < 0.2:  # the same words twice
            continue
        entries = float(np.sum(np.abs(rows) >= SHOWN)) - 1e-3 * abs(np.linalg.det(block))
        if entries < fewest:
            best, fewest = rows, entries
    return best


def monomials(names: Sequence[str], weak: Array) -> list[str]:
    """Return simple products of powers that stay the same along all weak directions, e.g. ``"R·J/K²"``. Only parameters
    that are not determined themselves take part; an independent set, the simplest first."""
    involved = [j for j in range(len(names)) if np.linalg.norm(weak[:, j]) > 0.01]
    wanted = len(involved) - np.linalg.matrix_rank(weak[:, involved], tol=0.3)
    if wanted <= 0 or len(involved) > 7:
        return []
    found: list[Array] = []
    tried = sorted(product(range(-2, 3), repeat=len(involved)), key=lambda a: (sum(map(abs, a)), sum(p < 0 for p in a)))
    for powers in tried:
        a = np.array(powers, float)
        if not a.any() or a[a != 0][0] < 0 or np.count_nonzero(a) > 4 or np.linalg.norm(weak[:, involved] @ a) > ALIKE:
            continue
        if np.linalg.matrix_rank(np.array([*found, a])) > len(found):
            found.append(a)
        if len(found) == wanted:
            break
    return [_product([names[j] for j in involved], a) for a in found]


def _product(names: Sequence[str], powers: Array) -> str:
    factors = [(f"{n}²" if abs(p) == 2 else n, p) for n, p in zip(names, powers, strict=True)]
    above, below = "·".join(f for f, p in factors if p > 0) or "1", [f for f, p in factors if p < 0]
    return above if not below else f"{above}/{below[0]}" if len(below) == 1 else f"{above}/({'·'.join(below)})"


def suggestions(problem: Problem, q: Array, matrix: Array, missing: int) -> list[str]:
    """Return sentences on what to fix or to measure so that every singular value exceeds `LEVEL`."""
    said = []
    if sets := fixable(problem.model.free_names, matrix, missing):
        other = f" (or {' and '.join(sets[1])})" if len(sets) > 1 else ""
        said.append(f"Fix {' and '.join(sets[0])}{other} where known, model.fix(…), and the rest is determined.")
    return said + [f"Measure the {NAMES[channel]} as well: with 1 % of noise all of them are determined."
                   for channel in ("i", "omega") if _would_do(problem, q, channel)]


def fixable(names: Sequence[str], matrix: Array, missing: int) -> list[tuple[str, ...]]:
    """Return the sets of `missing` parameters that, once fixed, leave the others determined; the best set first."""
    found, triangle = [], np.asarray(np.linalg.qr(matrix, mode="r"))
    for fixed in combinations(range(len(names)), missing):
        s = np.linalg.svd(np.delete(triangle, fixed, axis=1), compute_uv=False)
        if s.size and s[-1] > LEVEL:
            ease = sum(EASY.index(names[j]) if names[j] in EASY else len(EASY) for j in fixed)
            found.append((-round(np.log10(s[-1])), ease, tuple(names[j] for j in fixed)))
    return [f[2] for f in sorted(found)]


def _would_do(problem: Problem, q: Array, channel: str) -> bool:
    """Tell whether one more channel, with little noise, would determine everything."""
    if channel in problem.outputs or (channel == "i" and problem.model.base != "dc_motor"):
        return False
    model = problem.model.start_at(problem.values(q))
    try:
        runs = [with_channels(model, r.experiment.with_(sigma=r.sigma), [channel]) for r in problem.runs]
        more = problem.with_(model=model, experiments=tuple(runs))
        matrix = relative_jacobian(more.refined(more.start), more.start)
    except MotoridError:
        return False
    return bool(np.linalg.svd(matrix, compute_uv=False)[-1] > LEVEL)
