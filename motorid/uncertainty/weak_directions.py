"""Weak directions in words: a sparse basis of them, and the products of parameters that they leave alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, product

import numpy as np

from motorid.integrate.engine import Array

SHOWN = 0.05  # relative to the largest: smaller parts of a direction do not make it another one
SPOKEN = 0.005  # smaller parts are not worth a word
UNMOVED = 1e-6  # standard deviations of the noise that count as nothing
ALIKE = 0.1  # change of a product, per factor of e along a weak direction, that still counts as determined
STEP = 0.1  # relative change that is spoken of
MOST = 300  # pivots tried


def basis_in_words(names: Sequence[str], weak: Array,
                   matrix: Array) -> list[tuple[dict[str, float], float, str]]:
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
