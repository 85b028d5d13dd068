"""Weak directions in words: a sparse basis, the products of parameters that they leave alone, and what would help."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, product

import numpy as np

from motorid.channels import NAMES
from motorid.errors import MotoridError
from motorid.numerics.signals import Array
from motorid.problem.problem import Problem
from motorid.problem.sensitivity import relative_jacobian
from motorid.problem.simulate import with_channels

SHOWN = 0.05  # relative to the largest: smaller parts of a direction do not make it another one
SPOKEN = 0.005  # smaller parts are not worth a word
UNMOVED = 1e-6  # standard deviations of the noise that count as nothing
ALIKE = 0.1  # change of a product, per factor of e along a weak direction, that still counts as determined
STEP = 0.1  # relative change that is spoken of
MOST = 300  # pivots tried
EASY = ("R", "K", "g", "L", "b", "J")  # in the order in which they are usually known beforehand


def basis_in_words(names: Sequence[str], weak: Array, matrix: Array) -> list[tuple[dict[str, float], float, str]]:
    """Return per weak direction its parts (largest 1), what a step of 10 % does in units of noise, and words.

    Parameters
    ----------
    names : sequence of str, length k
    weak : ndarray, shape (d, k)
        Orthonormal rows.
    matrix : ndarray, shape (n, k)
        Whitened outputs per relative change.
    """
    found = []
    for row in sparse_basis(weak):
        row = row / row[np.argmax(np.abs(row))]
        parts = {n: float(w) for n, w in zip(names, row, strict=True) if abs(w) >= SPOKEN}
        seen = float(np.linalg.norm(matrix @ (STEP * row)))
        moves = ", ".join(f"{n} by {100 * STEP * w:+.2g} %".replace("-", "−") for n, w in parts.items())
        effect = f"moves all outputs by {seen:.1g} standard deviations of their noise"
        effect = "does not move the outputs at all" if seen < UNMOVED else effect
        found.append((parts, seen, f"Changing {moves}{' together' if len(parts) > 1 else ''} {effect}."))
    return found


def sparse_basis(weak: Array) -> Array:
    """Return a basis of the same space with as few entries as possible."""
    d, k = weak.shape
    if d == 0:
        return weak
    best, fewest = weak, np.inf
    for pivots in _some(combinations(range(k), d)):
        block = weak[:, pivots]
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


def _some(choices: Iterator[tuple[int, ...]]) -> Iterator[list[int]]:
    for _, choice in zip(range(MOST), choices, strict=False):
        yield list(choice)


def monomials(names: Sequence[str], weak: Array) -> list[str]:
    """Return simple products of powers that stay the same along all weak directions, e.g. ``"R·J/K²"``.

    Only parameters that are not determined themselves take part; an independent set, the simplest first.
    """
    involved = [j for j in range(len(names)) if np.linalg.norm(weak[:, j]) > 0.01]
    wanted = len(involved) - np.linalg.matrix_rank(weak[:, involved], tol=0.3)
    if wanted <= 0 or len(involved) > 7:
        return []
    found: list[Array] = []
    for powers in sorted(product(range(-2, 3), repeat=len(involved)), key=_complexity):
        a = np.array(powers, float)
        if not a.any() or a[a != 0][0] < 0 or np.count_nonzero(a) > 4:
            continue
        if np.linalg.norm(weak[:, involved] @ a) > ALIKE:
            continue
        if np.linalg.matrix_rank(np.array([*found, a])) > len(found):
            found.append(a)
        if len(found) == wanted:
            break
    return [_product([names[j] for j in involved], a) for a in found]


def _complexity(powers: Sequence[int]) -> tuple[int, int]:
    return sum(abs(p) for p in powers), sum(p < 0 for p in powers)


def _product(names: Sequence[str], powers: Array) -> str:
    def factor(name: str, power: float) -> str:
        return f"{name}²" if abs(power) == 2 else name

    above = "·".join(factor(n, p) for n, p in zip(names, powers, strict=True) if p > 0) or "1"
    below = [factor(n, p) for n, p in zip(names, powers, strict=True) if p < 0]
    if not below:
        return above
    return f"{above}/{below[0]}" if len(below) == 1 else f"{above}/({'·'.join(below)})"


def suggestions(problem: Problem, q: Array, matrix: Array, missing: int, level: float) -> list[str]:
    """Return sentences on what to fix or to measure so that every singular value exceeds `level`."""
    names = problem.model.free_names
    said = []
    sets = fixable(names, matrix, missing, level)
    if sets:
        first = " and ".join(sets[0])
        other = f" (or {' and '.join(sets[1])})" if len(sets) > 1 else ""
        said.append(f"Fix {first}{other} where known, model.fix(…), and the rest is determined.")
    for channel in ("i", "omega"):
        if _would_do(problem, q, channel, level):
            said.append(f"Measure the {NAMES[channel]} as well: with 1 % of noise all of them are determined.")
    return said


def fixable(names: Sequence[str], matrix: Array, missing: int, level: float) -> list[tuple[str, ...]]:
    """Return the sets of `missing` parameters that, once fixed, leave the others determined; the best set first."""
    found = []
    triangle = np.asarray(np.linalg.qr(matrix, mode="r"))
    for fixed in combinations(range(len(names)), missing):
        s = np.linalg.svd(np.delete(triangle, fixed, axis=1), compute_uv=False)
        if s.size and s[-1] > level:
            ease = sum(EASY.index(names[j]) if names[j] in EASY else len(EASY) for j in fixed)
            found.append((-round(np.log10(s[-1])), ease, tuple(names[j] for j in fixed)))
    return [f[2] for f in sorted(found)]


def _would_do(problem: Problem, q: Array, channel: str, level: float) -> bool:
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
    return bool(np.linalg.svd(matrix, compute_uv=False)[-1] > level)
