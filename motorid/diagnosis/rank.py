"""Which effect? Every effect is scored by its exact sensitivity at the point where it vanishes.

The column that an effect would add to the Jacobian is projected off the tangent space of the fitted parameters
(they would absorb that part anyway), and the residual is fitted with what remains, physical signs enforced: a
score test in the sense of Rao (1948), without refitting anything. Shape parameters run over a small grid; effects
that cannot be differentiated at their null are simulated at a few finite shapes instead.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from motorid.diagnosis.evidence import effective_samples
from motorid.diagnosis.orders import Line, likely_lines, spectrum
from motorid.diagnosis.whitening import unstacked
from motorid.errors import ModelError, SimulationError
from motorid.fit import Fit
from motorid.integrate.grid import Array
from motorid.model import Effect, Model, dc_motor, torque_driven
from motorid.parameters import Parameter
from motorid.prepared import natural_sizes
from motorid.problem import Problem

NUDGE = 1e-9  # of the natural size: where sizes start, so that fmax(tau_s - tau_c, 0) has a slope
ORDERS_TRIED = 3
SHARED = 0.1  # of the largest share in a combination that is worth a name
INSEPARABLE = 1e-3  # share of an effect's answer that the fitted parameters do not make up together


@dataclass(frozen=True, eq=False)
class Score:
    """One effect scored: share of chi² that it would take away, and starting values for a refit.

    `starts` are tried in turn, the most promising first. `effective` is how many independent samples the residual
    would be worth with the effect taken out: what a misfit makes smooth is no evidence of coloured noise.
    `stands_out` says that its order is a line in the spectrum of the misfit, however small beside the rest of it.
    `same_as` are the parameters that together do what the effect does, if these data cannot tell it from them.
    """

    effect: Effect
    drop: float
    starts: tuple[Mapping[str, float], ...]
    effective: float = 0.0
    same_as: tuple[str, ...] = ()
    stands_out: bool = False


@dataclass(frozen=True, eq=False)
class Tried:
    """One shape scored: share of chi² explained, values, what is left of the residual, what does the same."""

    drop: float
    values: dict[str, float]
    left: Array
    same_as: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Tangent:
    """Residual of a fit off the tangent space of its unknowns."""

    fit: Fit
    basis: Array
    residual: Array
    sizes: Mapping[str, float]

    @staticmethod
    def of(fit: Fit) -> Tangent:
        """Return the tangent space of `fit`, singular directions left out."""
        n = fit.problem.n_outputs
        jac, r = fit.jacobian[:n], fit.residuals[:n]
        norms = np.linalg.norm(jac, axis=0)
        q, triangle = np.linalg.qr(jac / np.where(norms > 0, norms, 1.0))
        u, s, _ = np.linalg.svd(triangle)
        basis = q @ u[:, s > 1e-7 * max(s.max(initial=0.0), 1e-300)]
        return Tangent(fit, basis, r - basis @ (basis.T @ r), natural_sizes(fit.problem.experiments, fit.values))

    def effective(self, residual: Array) -> float:
        """Return how many independent samples a stacked residual is worth."""
        return sum(effective_samples(column) for part in unstacked(self.fit, residual) for column in part.T)

    def off(self, columns: Array) -> Array:
        """Return `columns` (n, k) projected off the tangent space."""
        return columns - self.basis @ (self.basis.T @ columns)

    def same_as(self, columns: Array) -> tuple[str, ...]:
        """Return the parameters that together make up all of `columns` (n, k); none if something is left of them."""
        size = np.linalg.norm(columns, axis=0)
        if np.any(np.linalg.norm(self.off(columns), axis=0) > INSEPARABLE * size) or not size.all():
            return ()
        names = [p.name for p in self.fit.problem.unknown]
        jac = self.fit.jacobian[: len(columns)]
        norms = np.linalg.norm(jac, axis=0)
        parts = np.linalg.lstsq(jac / np.where(norms > 0, norms, 1.0), columns / size, rcond=1e-7)[0]
        part = {n: float(np.abs(a).max()) for n, a in zip(names, parts, strict=True) if n in self.fit.values}
        return tuple(n for n, a in part.items() if a > SHARED * max(part.values()))


@lru_cache(maxsize=256)
def uses_angle(effect: Effect) -> bool:
    """Tell whether the effect reads the angle."""
    for base in (dc_motor(), torque_driven()):
        try:
            return "theta" in (base + effect).write().states
        except ModelError:
            continue
    return False


def rank(fit: Fit, effects: Sequence[Effect], advance=lambda: None) -> list[Score]:
    """Score `effects` on `fit`, best first; effects that the model cannot take are left out."""
    tangent = Tangent.of(fit)
    scores = []
    for e in effects:
        with contextlib.suppress(ModelError, SimulationError):
            scores.append(score(tangent, e))
        advance()
    return sorted(scores, key=lambda s: -s.drop)


def score(tangent: Tangent, effect: Effect) -> Score:
    """Score one effect.

    Raises
    ------
    ModelError
        If the effect does not go with the model or the measured channels.
    """
    fit = tangent.fit
    model = fit.model + effect
    if uses_angle(effect) and not model.angle_input and not any(uses_angle(e) for e in fit.model.effects):
        model = replace(model, angle_input=True, _systems={})
    pars = [model.parameters[p.name] for p in effect.parameters]
    if any(p.order and not p.given for p in pars):
        return _score_orders(tangent, model, effect, pars)
    tried: list[Tried] = []
    for shape in _shapes(tangent, pars):
        tried += _score_shape(tangent, model, pars, shape)
    if not tried:
        return Score(effect, 0.0, ({},))
    tried.sort(key=lambda t: -t.drop)
    best = tried[0]
    same_as = best.same_as if all(t.same_as for t in tried) else ()
    starts = tuple(_distinct([t.values for t in tried]))
    return Score(effect, 0.0 if same_as else best.drop, starts, tangent.effective(best.left), same_as)


def _score_orders(tangent: Tangent, model: Model, effect: Effect, pars: Sequence[Parameter]) -> Score:
    """Score an effect of the angle at its likely orders, which the misfit without its colour tells."""
    lines = likely_lines(tangent, effect, ORDERS_TRIED)
    if not lines:
        return Score(effect, 0.0, ({},))
    order = next(p.name for p in pars if p.order)
    best = _score_shape(tangent, model, pars, {order: lines[0].order})[0]
    starts = tuple(_start(line, pars) for line in lines)
    out = spectrum(tangent, effect).stands_out
    return Score(effect, best.drop, starts, tangent.effective(best.left), best.same_as, out)


def _start(line: Line, pars: Sequence[Parameter]) -> dict[str, float]:
    """Return the values of an effect that a line stands for."""
    return {
        p.name: line.order if p.order else line.phase if p.periodic else line.amplitude
        for p in pars
        if p.order or p.periodic or p.null == 0
    }


def _distinct(starts: list[dict[str, float]], most: int = 4) -> list[dict[str, float]]:
    """Keep starts that differ in a shape by more than a third."""
    kept: list[dict[str, float]] = []
    for s in starts:
        if all(any(abs(np.log(max(abs(s[n]), 1e-300) / max(abs(k[n]), 1e-300))) > 0.3 for n in s) for k in kept):
            kept.append(s)
    return kept[:most]


def _kinds(pars: Sequence[Parameter]) -> tuple[list[Parameter], list[Parameter], list[Parameter]]:
    """Split parameters into linear sizes, finite sizes (positive, null at a limit) and shapes."""
    linear = [p for p in pars if p.null is not None and not p.positive]
    finite = [p for p in pars if p.null is not None and p.positive]
    return linear, finite, [p for p in pars if p.null is None]


def _shapes(tangent: Tangent, pars: Sequence[Parameter]) -> Iterator[dict[str, float]]:
    """Yield the shape values to try: grids."""
    axes: list[list[tuple[str, float]]] = []
    for p in pars:
        if p.grid and not p.given:
            axes.append([(p.name, g * tangent.sizes.get(p.unit, 1.0)) for g in p.grid])
    yield from (dict(point) for point in itertools.product(*axes))


def _score_shape(tangent: Tangent, model: Model, pars: Sequence[Parameter], shape: Mapping[str, float]) -> list[Tried]:
    linear, finite, _ = _kinds(pars)
    if finite or any(p.name in shape for p in linear):
        return _score_finite(tangent, model, pars, shape)
    phases = [p for p in pars if p.periodic and not p.given]
    sizes = linear
    columns = [_null_columns(tangent, model, sizes, shape)]
    if phases:
        quarter = {phases[0].name: np.pi / 2}
        columns.append(_null_columns(tangent, model, sizes, {**shape, **quarter}))
        drop, a, left = _project(tangent, np.column_stack(columns), [False] * 2)
        value = {sizes[0].name: float(np.hypot(*a)), phases[0].name: float(np.arctan2(a[1], a[0]))}
    else:
        drop, a, left = _project(tangent, columns[0], [p.lower == 0 for p in sizes])
        value = {p.name: float(v) for p, v in zip(sizes, a, strict=True)}
    held = {p.name: p.value for p in sizes if not p.vary}
    if held:  # e.g. copper's temperature coefficient: only near its physical value does the shape make sense
        ratio = min((v / h for (n, h) in held.items() if (v := value[n]) > 0 and h), default=0.0)
        drop *= float(np.exp(-0.1 * np.log(max(ratio, 1e-3)) ** 2))
        value |= held
    return [Tried(drop, {**shape, **value}, left, tangent.same_as(np.column_stack(columns)))]


def _null_columns(tangent: Tangent, model: Model, sizes: Sequence[Parameter], shape: Mapping[str, float]) -> Array:
    """Sensitivities of the whitened outputs to the sizes at their null, (n, len(sizes))."""
    null = {p.name: (p.null or 0.0) + NUDGE * (k + 1) * tangent.sizes.get(p.unit, 1.0) for k, p in enumerate(sizes)}
    names = [p.name for p in sizes]
    at = model.start_at({**shape, **null}).fix(*model.parameters).free(*names)
    problem = tangent.fit.problem.for_model(at)
    q = _coordinates(problem, tangent.fit)
    parts = []
    for k in range(len(problem.runs)):
        _, jac = problem.run_residual(k, problem.simulate(q, k))
        assert jac is not None
        parts.append(jac[:, : len(names)])
    slope = problem.scaling.slope(q)[: len(names)]
    order = [names.index(p.name) for p in problem.unknown[: len(names)]]
    columns = np.vstack(parts) / slope
    return columns[:, np.argsort(order)] if order != sorted(order) else columns


def _coordinates(problem: Problem, fit: Fit) -> Array:
    """Solver coordinates with the fit's initial states."""
    initial = fit.initial
    return problem.scaling.scaled([initial.get(p.name, p.value) for p in problem.unknown])


def _project(tangent: Tangent, columns: Array, nonnegative: Sequence[bool]) -> tuple[float, Array, Array]:
    """Return the share of chi² explained by `columns`, the coefficients, signs enforced, and what is left."""
    from scipy.optimize import nnls  # slow to import, and not needed before

    c = tangent.off(columns)
    norms = np.linalg.norm(c, axis=0)
    raw = np.linalg.norm(columns, axis=0)
    usable = norms > 1e-6 * np.maximum(raw, 1e-300)
    scale = np.where(usable, norms, 1.0)
    c = np.where(usable, c / scale, 0.0)
    signed = [j for j, positive in enumerate(nonnegative) if not positive]
    a = np.column_stack([c, -c[:, signed]])
    triangle = np.linalg.qr(np.column_stack([a, -tangent.residual]), mode="r")
    z, rest = nnls(np.asarray(triangle)[:, :-1], np.asarray(triangle)[:, -1])
    coefficients = z[: c.shape[1]].copy()
    coefficients[signed] -= z[c.shape[1] :]
    total = float(tangent.fit.residuals[: len(tangent.residual)] @ tangent.fit.residuals[: len(tangent.residual)])
    inside = float(tangent.residual @ tangent.residual)
    left = tangent.residual + c @ coefficients
    return max(inside - rest**2, 0.0) / max(total, 1e-300), coefficients / scale, left


def _score_finite(tangent: Tangent, model: Model, pars: Sequence[Parameter], shape: Mapping[str, float]) -> list[Tried]:
    """Score an effect at a finite shape: the difference that it makes, in a free amount."""
    at = model.start_at(dict(shape)).fix(*model.parameters)
    problem = tangent.fit.problem.for_model(at)
    q = _coordinates(problem, tangent.fit)
    n = tangent.fit.problem.n_outputs
    try:
        parts = [
            problem.run_residual(k, problem.simulate(q, k, derivatives=False))[0] for k in range(len(problem.runs))
        ]
    except SimulationError:
        return []
    change = np.concatenate(parts) - plain_residual(tangent.fit)[:n]
    if not np.any(change):
        return []
    drop, a, left = _project(tangent, change[:, None], [True])
    # An amount far from one means that the shape itself is wrong: the drop promises more than it can keep.
    keeps = 0.2 if a[0] < 0.05 else min(1.0, 3.0 / a[0])
    return [Tried(keeps * drop, dict(shape), left)]


def plain_residual(fit: Fit) -> Array:
    """Whitened output residuals of a fit without its robust loss."""
    if fit.problem.loss is None:
        return fit.residuals
    problem = fit.problem
    return np.concatenate(
        [problem.run_residual(k, problem.simulate(fit.q, k, derivatives=False))[0] for k in range(len(problem.runs))]
    )
