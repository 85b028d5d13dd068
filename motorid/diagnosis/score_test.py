"""Which effect? Every effect is scored by its exact sensitivity at the point where it vanishes.

The column that an effect would add to the Jacobian is projected off the tangent space of the fitted parameters
(they would absorb that part anyway), and the residual is fitted with what remains, physical signs enforced: a
score test in the sense of Rao (1948), without refitting anything. Shape parameters run over a small grid; effects
that cannot be differentiated at their null are simulated at a few finite shapes instead."""

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from motorid.errors import ModelError, SimulationError
from motorid.estimation.angle_orders import likely_lines, spectrum, uses_angle
from motorid.estimation.linearisation import Tangent, parameter_vector
from motorid.estimation.result import Fit
from motorid.integrate.engine import Trajectory
from motorid.model.definition import Effect, Parameter
from motorid.model.model import Model
from motorid.numerics.signals import Array
from motorid.problem.problem import Problem
from motorid.problem.runs import combined, shapes_of
from motorid.problem.unknowns import Point

ORDERS_TRIED = 8  # a race tells them apart: near friction and far from the optimum the highest line may be another
MORE = 0.1  # that a pair must promise beyond the better of the two
PER_RUN = 3  # orders that each run alone may tell
NOTHING = 6.0  # chi² that an effect takes away by the slopes of a smaller model: too little for a closer look


@dataclass(frozen=True, eq=False)
class Score:
    """One effect scored: share of chi² that it would take away, and starting values for a refit.

    `starts` are tried in turn, the most promising first. `effective` is how many independent samples the residual
    would be worth with the effect taken out: what a misfit makes smooth is no evidence of coloured noise; 0 where it
    does not matter, since the effect takes away less than one. `stands_out` says that its order is a line in the
    spectrum of the misfit, however small beside the rest of it. `same_as` are the parameters that together do what the
    effect does, if these data cannot tell it from them. `shapes` are what it was scored by, the best first."""

    effect: Effect
    drop: float
    starts: tuple[Mapping[str, float], ...]
    effective: float = 0.0
    same_as: tuple[str, ...] = ()
    stands_out: bool = False
    shapes: "tuple[Shape, ...]" = ()


class Tried(NamedTuple):
    """One shape scored: share of chi² explained, values, what is left of the residual, what does the same."""

    drop: float
    values: dict[str, float]
    left: Array
    same_as: tuple[str, ...] = ()


def rank(fit: Fit, effects: Sequence[Effect], known: Sequence[Score] = ()) -> list[Score]:
    """Score `effects` on `fit`, best first; those that the model cannot take are left out. `known` are scores on a
    smaller model's fit to the same records: near the noise they tell what adds nothing here."""
    tangent = Tangent.of(fit)
    before = {s.effect.name: s for s in known}
    scores = []
    for e in effects:
        with contextlib.suppress(ModelError, SimulationError):
            scores.append(_nothing(tangent, before.get(e.name)) or score(tangent, e))
    return sorted(scores, key=lambda s: -s.drop)


def pairs_of(fit: Fit, pairs: Iterable[tuple[Score, Score]], most: int) -> list[tuple[Score, Score]]:
    """Return the pairs of effects that together explain most, more than either alone, best first."""
    tangent, found = Tangent.of(fit), []
    for a, b in pairs:
        if a.shapes and b.shapes and not (a.same_as or b.same_as):
            columns = np.hstack([a.shapes[0].columns, b.shapes[0].columns])
            drop = tangent.explained(columns, [*a.shapes[0].nonnegative, *b.shapes[0].nonnegative]).share
            if drop > (1 + MORE) * max(a.drop, b.drop):
                found.append((drop, a, b))
    return [(a, b) for _, a, b in sorted(found, key=lambda pair: -pair[0])[:most]]


def with_phase_per_run(fit: Fit, scores: Sequence[Score], zero: Effect) -> list[Score]:
    """Return the effects over the angle that explain more with a phase in every run, and where each zero then is;
    `scores` are those of single effects, `zero` is that of the encoder, of one parameter per run."""
    tangent, runs = Tangent.of(fit), sorted(set(fit.problem.unknowns.firsts))
    apart = [f"{zero.parameters[0].name}[{k}]" for k in runs]
    found, parts = [], list[Tangent]()
    for s in scores if len(runs) > 1 else ():
        phase = next((p for p in s.effect.parameters if p.periodic and not p.grid), None)
        if phase is None or not uses_angle(s.effect):
            continue
        tried, added = [], Added.of(tangent, s.effect)
        order = next((p.name for p in added.pars if p.order and not p.given), "")
        parts = parts or [Tangent.of(alone(fit, k)) for k in runs if order]
        lines = (line for part in parts for line in likely_lines(part, s.effect, PER_RUN)) if order else ()
        tried_at = [{order: line.order, **line.choice} for line in lines] if order else [{}]
        for values in {tuple(at.items()): at for at in tried_at}.values():
            n, shape = values.get(order, 1.0), added.shape(values)
            if shape is None or not shape.sizes:
                continue
            drop, a, _ = tangent.explained(np.hstack(by_record(fit.problem, shape.columns)), [False] * 2 * len(runs))
            waves = a[::2] + 1j * a[1::2]
            zeros = np.angle(waves * np.conj(waves[0])) / n
            wave = {shape.sizes[0].name: float(np.median(np.abs(waves))), phase.name: float(np.angle(waves[0]))}
            tried.append((drop, {**shape.values, **wave, **dict(zip(apart, zeros.tolist(), strict=True))}))
        if (tried := sorted(tried, key=lambda t: -t[0])[:PER_RUN]) and tried[0][0] > (1 + MORE) * s.drop:
            found.append(replace(s, drop=tried[0][0], starts=tuple(values for _, values in tried)))
    return found


def with_warm_start(fit: Fit, scores: Sequence[Score], heated: Effect) -> list[Score]:
    """Return the score of a heating beside an R that is another in every run, if that explains more."""
    tangent, n, names = Tangent.of(fit), fit.problem.n_outputs, [p.name for p in fit.problem.unknown]
    for s in (s for s in scores if s.effect is heated and s.shapes and "R" in names):
        apart = by_record(fit.problem, fit.jacobian[:n, [names.index("R")]])[1:]
        signs = [False] * len(apart)
        both = [tangent.explained(np.hstack([shape.columns, *apart]), [*shape.nonnegative, *signs]).share
                for shape in s.shapes]
        if max(both) > (1 + MORE) * s.drop:
            starts = [{**s.shapes[k].values, **{p.name: p.value for p in s.effect.parameters if not p.vary}}
                      for k in np.argsort(both)[::-1]]
            return [replace(s, drop=max(both), starts=tuple(_distinct(starts)))]
    return []


def by_record(problem: Problem, columns: Array) -> list[Array]:
    """Return stacked columns (n, k) once for each record, zero elsewhere; parts of one record belong together."""
    records = np.repeat(problem.unknowns.firsts, [m.size for m in problem.measured])
    return [np.where((records == k)[:, None], columns, 0.0) for k in sorted(set(problem.unknowns.firsts))]


def alone(fit: Fit, first: int) -> Fit:
    """Return a fit, as it is, on the runs of one of its records, the one that begins with run `first`."""
    problem, mine = fit.problem, [k for k, f in enumerate(fit.problem.unknowns.firsts) if f == first]
    rows = np.isin(np.repeat(np.arange(len(problem.runs)), [m.size for m in problem.measured]), mine)
    own = dict(zip(problem.system.parameters, parameter_vector(fit, first).tolist(), strict=True))
    experiments, prepared = (tuple(what[k] for k in mine) for what in (problem.experiments, problem.runs))
    part = replace(problem, model=fit.model.start_at(own), experiments=experiments, _runs=prepared, priors={},
                   penalties=(), width=fit.values.get("sgn_width"))
    states = [fit.initial[f"{c}_0[{mine[k]}]"] for c, k, _ in part.unknowns.initial]
    q = part.scaling.scaled([own[n] for n in part.model.free_names] + states)
    n = problem.n_outputs
    return replace(fit, problem=part, values={**fit.values, **own}, q=q, residuals=fit.residuals[:n][rows],
                   jacobian=fit.jacobian[:n][rows])


def _nothing(tangent: Tangent, known: Score | None) -> Score | None:
    """Return the score by what an effect added to a smaller model, if that is next to nothing here."""
    if known is None or not known.shapes or any(p.order for p in known.effect.parameters):
        return None
    found = _scored(tangent, known.effect, tuple(s.weighed_like(tangent.fit) for s in known.shapes))
    return found if found.drop * tangent.chi2 < NOTHING else None


def score(tangent: Tangent, effect: Effect) -> Score:
    """Score one effect; ModelError if it does not go with the model or the measured channels."""
    added = Added.of(tangent, effect)
    if any(p.order and not p.given for p in added.pars):
        return _score_orders(tangent, added, effect)
    grid = combined({p.name: shapes_of(p, added.natural) for p in added.pars if p.grid and not p.given})
    return _scored(tangent, effect, tuple(s for values in grid if (s := added.shape(values)) is not None))


def _scored(tangent: Tangent, effect: Effect, shapes: "tuple[Shape, ...]") -> Score:
    """Score an effect by what it adds at several shapes."""
    if not (pairs := sorted(((_tried(tangent, s), s) for s in shapes), key=lambda pair: -pair[0].drop)):
        return Score(effect, 0.0, ({},))
    tried = [t for t, _ in pairs]
    best, shapes = tried[0], tuple(s for _, s in pairs)
    same_as = best.same_as if all(t.same_as for t in tried) else ()
    starts = tuple(_distinct([t.values for t in tried]))
    drop = 0.0 if same_as else best.drop
    effective = tangent.fit.problem.worth(best.left) if drop * tangent.chi2 > 1 else 0.0
    return Score(effect, drop, starts, effective, same_as, shapes=shapes)


def _score_orders(tangent: Tangent, added: "Added", effect: Effect) -> Score:
    """Score an effect of the angle at its likely orders, which the misfit without its colour tells."""
    lines = likely_lines(tangent, effect, ORDERS_TRIED)
    order = next(p.name for p in added.pars if p.order)
    if (shape := added.shape({order: lines[0].order, **lines[0].choice}) if lines else None) is None:
        return Score(effect, 0.0, ({},))
    best, starts = _tried(tangent, shape), tuple(line.values(added.pars) for line in lines)
    out = spectrum(tangent, effect).stands_out
    return Score(effect, best.drop, starts, tangent.fit.problem.worth(best.left), best.same_as, out, (shape,))


def _distinct(starts: list[dict[str, float]], most: int = 3) -> list[dict[str, float]]:
    """Keep starts that differ in a shape by more than a third."""
    kept: list[dict[str, float]] = []
    for s in starts:
        if all(any(abs(np.log(max(abs(s[n]), 1e-300) / max(abs(k[n]), 1e-300))) > 0.3 for n in s) for k in kept):
            kept.append(s)
    return kept[:most]


def _tried(tangent: Tangent, shape: "Shape") -> Tried:
    """Score one shape, physical signs enforced."""
    drop, amounts, left = tangent.explained(shape.columns, shape.nonnegative)
    if not shape.sizes:
        # An amount far from one means that the shape itself is wrong: the drop promises more than it can keep.
        return Tried((0.2 if amounts[0] < 0.05 else min(1.0, 3.0 / amounts[0])) * drop, dict(shape.values), left)
    if shape.phase is not None:
        cosine, sine = amounts
        found = {shape.sizes[0].name: float(np.hypot(cosine, sine)), shape.phase.name: float(np.arctan2(sine, cosine))}
    else:
        found = {p.name: float(v) for p, v in zip(shape.sizes, amounts, strict=True)}
    held = {p.name: p.value for p in shape.sizes if not p.vary}
    if held:  # e.g. copper's temperature coefficient: only near its physical value does the shape make sense
        ratio = min((v / h for (n, h) in held.items() if (v := found[n]) > 0 and h), default=0.0)
        drop *= float(np.exp(-0.1 * np.log(max(ratio, 1e-3)) ** 2))
        found |= held
    return Tried(drop, {**shape.values, **found}, left, tangent.same_as(shape.columns))


NUDGE = 1e-9  # of the natural size: where sizes start, so that fmax(tau_s - tau_c, 0) has a slope


@dataclass(frozen=True, eq=False)
class Shape:
    """What an effect adds at one shape to the whitened outputs of a fit: columns (n, k), the slopes to each of `sizes`,
    then those a quarter of a period later if there is a `phase`; without `sizes` the one change that it makes."""

    values: Mapping[str, float]  # of parameters that are no sizes
    columns: Array
    sizes: tuple[Parameter, ...]
    phase: Parameter | None
    weights: tuple[Array, ...]  # of the channels, per run

    @property
    def nonnegative(self) -> list[bool]:
        """Which columns may not count negatively."""
        return [False, False] if self.phase is not None else [p.lower == 0 for p in self.sizes] or [True]

    def weighed_like(self, fit: Fit) -> "Shape":
        """Return the shape with the channels weighed as in another fit of the same records."""
        new = tuple(m.weights for m in fit.problem.measured)
        if all(map(np.array_equal, new, self.weights)):
            return self
        rows = [m.stack(np.broadcast_to(np.divide(m.weights, old, out=np.zeros_like(old), where=old > 0), m.y.shape))
                for m, old in zip(fit.problem.measured, self.weights, strict=True)]
        return replace(self, columns=self.columns * np.concatenate(rows)[:, None], weights=new)


@dataclass(frozen=True, eq=False)
class Added:
    """A fit's model with an effect more, on the fit's records."""

    fit: Fit
    model: Model  # with the effect
    pars: Sequence[Parameter]  # the effect's, as in the model
    natural: Mapping[str, float]  # natural size per unit

    @staticmethod
    def of(tangent: Tangent, effect: Effect) -> "Added":
        """Return the fit's model with `effect`, a first one over the angle along that measured; ModelError if unfit."""
        fit, model = tangent.fit, tangent.fit.model + effect
        if uses_angle(effect) and not model.angle_input and not any(uses_angle(e) for e in fit.model.effects):
            model = replace(model, angle_input=True, _systems={})
        return Added(fit, model, [model.parameters[p.name] for p in effect.parameters], tangent.sizes)

    def shape(self, values: Mapping[str, float]) -> Shape | None:
        """Return what the effect adds at `values`, None if nothing or failing; SimulationError where it vanishes."""
        sizes = tuple(p for p in self.pars if p.null is not None and not p.positive)
        finite = any(p.null is not None and p.positive for p in self.pars)
        weights = tuple(m.weights for m in self._problem.measured)
        if finite or any(p.name in values for p in sizes):
            change = self._change(values)
            return None if change is None else Shape(values, change[:, None], (), None, weights)
        phase = next((p for p in self.pars if p.periodic and not p.given), None)
        columns = self._slopes(sizes, values)
        if any(p.per_run for p in sizes):  # in every run another, the first run's stand
            columns = np.hstack([columns[:, :0], *by_record(self._problem, columns)[1:]])
            others = sorted(set(self._problem.unknowns.firsts))[1:]
            sizes = tuple(replace(p, name=f"{p.name}[{k}]") for k in others for p in sizes)
        if phase is not None:
            columns = np.hstack([columns, self._slopes(sizes, {**values, phase.name: np.pi / 2})])
        return Shape(values, columns, sizes, phase, weights)

    def _slopes(self, sizes: Sequence[Parameter], values: Mapping[str, float]) -> Array:
        """Return the slopes of the whitened outputs to the sizes at their null, (n, len(sizes))."""
        null = {p.name: (p.null or 0.0) + NUDGE * (k + 1) * self.natural.get(p.unit, 1.0) for k, p in enumerate(sizes)}
        at = self._at({**values, **null})
        to = np.zeros((len(at.p), len(sizes)))
        to[[self._problem.system.parameters.index(p.name) for p in sizes], range(len(sizes))] = 1.0
        each = (self._run(k, at, self._problem.unknowns.first_slopes(at, k, to), to)
                for k in range(len(self._problem.runs)))
        slopes: list[Any] = [m.residual(traj)[1] for m, traj in zip(self._problem.measured, each, strict=True)]
        return np.vstack(slopes)

    def _change(self, values: Mapping[str, float]) -> Array | None:
        """Return the change (n,) that the effect makes at finite `values`."""
        at, fit = self._at(values), self.fit
        try:
            parts = [m.residual(self._run(k, at))[0] for k, m in enumerate(self._problem.measured)]
        except SimulationError:
            return None
        plain = fit.residuals if fit.problem.loss is None else fit.problem.tuned(loss=None).residual(fit.q)
        change = np.concatenate(parts) - plain[:fit.problem.n_outputs]
        return change if np.any(change) else None

    @cached_property
    def _problem(self) -> Problem:
        return self.fit.problem.for_model(self.model.fix(*self.model.shared_names))

    @cached_property
    def _point(self) -> Point:
        """The fit's values and initial states."""
        problem, initial = self._problem, self.fit.initial
        return problem.unknowns.point(problem.scaling.scaled([initial.get(p.name, p.value) for p in problem.unknown]))

    def _at(self, values: Mapping[str, float]) -> Point:
        p = self._point.p.copy()
        for n, value in values.items():
            limits = self.model.parameters[n]
            p[self._problem.system.parameters.index(n)] = np.clip(value, limits.lower, limits.upper)
        return self._point._replace(p=p)

    def _run(self, k: int, at: Point, *slopes: Array) -> Trajectory:
        problem = self._problem
        at = problem.unknowns.of_run(at, k)
        x0 = problem.unknowns.first_state(at, k)
        return problem.integrator.run(problem.system, problem.runs[k].grid, x0, at.p, *slopes)
