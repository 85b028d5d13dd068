"""Orders of angle-periodic effects (cogging, ripple of torque or sensor) from the model's response to every order.

The answer of the outputs to sin(Nθ) and cos(Nθ) torques along the measured angle, for all N at once, projected off the
tangent space of the fit like any other score, both without their colour (`whitening`). Each order is looked for where
less than a quarter of a period passes per sample: there no alias and no delay of a sensor can pose as it."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from motorid.errors import ModelError
from motorid.estimation.linearisation import Response, Tangent, column_space, responses
from motorid.estimation.result import Fit
from motorid.model.definition import Effect, Parameter
from motorid.model.model import Model, dc_motor, torque_driven
from motorid.numerics.autoregression import ORDER, Whitening
from motorid.numerics.signals import Array
from motorid.problem.problem import Problem
from motorid.problem.runs import angle_signal

WIDEST = 4e6  # numbers in the answers to all orders that are looked at together
HIGHEST = 240
PERIODS = 3  # within the travel
SLOW_PART = 0.2  # of the motion that must be slow enough to show an order
LESS_THAN_A_PERIOD = 1.8 * np.pi  # per sample
QUARTER = np.pi / 2  # of a period per sample: slow enough to be sure
SURE_PART = 0.02  # of the motion that must be slower than that, or faster parts are used too
SAMPLES = 50  # and so many samples
NEAR = 0.6  # of the best line: another order that may be the true one
STANDS_OUT = 6.0  # times the usual order: a line
ALIKE = 1e-7  # below one, the correlation at which the answers to sine and cosine are one
SAMPLED = 8  # orders whose answers are worked out to know about how strong all are
LOOKED_AT = 12  # of the best then
STILL = 1e-9  # rad per sample: no motion
# What an order modulates: K both torque and back-EMF, an encoder both speed and angle as they are read.
WAYS = {"torque": ("motor's torque", "K"), "sensor": ("speed", "encoder")}
READ = {"speed": "omega", "encoder": "theta"}  # the channel without which there is nothing to modulate
SURE = 30.0  # chi² of two degrees of freedom: the highest of 240 orders of noise reaches about 11


@dataclass(frozen=True)
class Line:
    """One order in the spectrum of the misfit: torque −A·sin(Nθ+φ), or what is modulated by 1+a·sin(Nθ+φ)."""

    order: float
    share: float  # of the squared residual without its colour
    amplitude: float
    phase: float
    choice: Mapping[str, float] = field(default_factory=dict)  # what it modulates, by the effect's fixed parameter

    def values(self, parameters: Iterable[Parameter]) -> dict[str, float]:
        """Return the values of an effect's parameters that it stands for."""
        return {p.name: self.order if p.order else self.phase if p.periodic else self.amplitude
                for p in parameters if p.order or p.periodic or p.null == 0} | dict(self.choice)


@dataclass(frozen=True)
class Spectrum:
    """Lines, the strongest first, and whether it is far stronger than orders usually are."""

    lines: tuple[Line, ...]
    stands_out: bool


def highest_order(tangent: Tangent) -> int:
    """Highest order that the samples can show: less than a period per sample for a part of the motion. Beyond half a
    period the samples alias, but along a measured angle each order still has its own pattern."""
    moving = _moving(tangent.fit)
    return int(np.clip(LESS_THAN_A_PERIOD / np.quantile(moving, SLOW_PART), 0, HIGHEST)) if moving.size else 0


def shows_turns(fit: Fit) -> bool:
    """Tell whether a part of the motion, if known, is so slow that samples show what comes once a turn."""
    return bool(np.quantile(moving, SLOW_PART) < LESS_THAN_A_PERIOD) if (moving := _moving(fit)).size else True


def _moving(fit: Fit) -> Array:
    """Changes of the angle per sample, where there are any."""
    steps = np.concatenate([np.abs(np.diff(angle_signal(r))) for r in fit.problem.experiments])
    return steps[steps > 1e-6 * max(steps.max(initial=0.0), 1e-300)]


@lru_cache(maxsize=256)
def uses_angle(effect: Effect) -> bool:
    """Tell whether the effect reads the angle."""
    for base in (dc_motor(), torque_driven()):
        with suppress(ModelError):
            return "theta" in (base + effect).write().states
    return False


def likely_lines(tangent: Tangent, effect: Effect, most: int) -> list[Line]:
    """Return the strongest lines, best first, those that come near the best."""
    lines = spectrum(tangent, effect).lines[:most]
    return [line for line in lines if line.share > NEAR * lines[0].share]


def effects_of_unknown_order(model: Model) -> list[Effect]:
    """Return the effects with an order that nobody has set."""
    pairs = {e: [(p, model.parameters[p.name]) for p in e.parameters] for e in model.effects}
    return [e for e in pairs if any(p.order and not now.given and now.value == p.value for p, now in pairs[e])]


def strongest_order(fit: Fit, effects: Sequence[Effect]) -> tuple[Effect, dict[str, float]] | None:
    """Return which of `effects` has the strongest line in the misfit, with its order, size and phase; None for none."""
    lines = [(e, line) for e in effects for line in likely_lines(Tangent.of(fit), e, 1)]
    best = max(lines, key=lambda pair: pair[1].share, default=None)
    return best and (best[0], best[1].values(best[0].parameters))


def spectrum(tangent: Tangent, effect: Effect) -> Spectrum:
    """Return what each order explains of the misfit. `effect` tells what is modulated: the torque itself (N·m), or that
    made by the current or the speed as read (relative), by a fixed parameter of it the back-EMF or the angle too."""
    if all(p.null != 0 or p.unit for p in effect.parameters):
        return _spectrum(tangent, "torque")
    both = next((p.name for p in effect.parameters if not p.vary and p.grid), None)
    choices: list[dict[str, float]] = [{both: 0.0}, {both: 1.0}] if both else [{}]
    ways = [(_spectrum(tangent, k), choice) for k, choice in zip(WAYS[effect.balance], choices, strict=False)]
    lines = [replace(line, choice=choice) for found, choice in ways for line in found.lines]
    return Spectrum(tuple(sorted(lines, key=lambda line: -line.share)), any(found.stands_out for found, _ in ways))


@lru_cache(maxsize=64)
def _spectrum(tangent: Tangent, kind: str) -> Spectrum:
    fit, top, relative = tangent.fit, highest_order(tangent), kind != "torque"
    # A torque that repeats once per turn is gravity's, and what is to repeat must do so within the travel. A disc off
    # centre is an encoder's commonest fault: that once per turn needs no proof.
    travel = max(float(np.ptp(angle_signal(r))) for r in fit.problem.experiments)
    lowest = 1 if kind in READ else max(1 if relative else 2, int(np.ceil(PERIODS * 2 * np.pi / max(travel, 1e-9))))
    if top < lowest or kind not in _kinds(fit.problem) or max(r.n for r in fit.problem.experiments) <= ORDER:
        return Spectrum((), False)
    with np.errstate(over="ignore", invalid="ignore"):  # of a motor that runs away no order explains anything
        shares, lines = _order_search(tangent).shares(lowest, kind)
    best = max((line.share for line in lines), default=0.0)
    sure = best * tangent.residual.size > SURE and best > STANDS_OUT * float(np.median(shares))
    return Spectrum(tuple(sorted(lines, key=lambda line: -line.share)), sure)


def _kinds(problem: Problem) -> list[str]:
    """What an order may modulate in these records."""
    return ["torque", *(WAYS["torque"] if "i" in problem.system.states else ()),
            *(kind for kind, channel in READ.items() if channel in problem.outputs)]


class Moments(NamedTuple):
    """Of exp(jNθ) put in, per order: the product with the residual of what it answers, and the sums Σ|z|² and Σz²."""

    pulls: Array
    sizes: Array
    squares: Array

    def count(self, j: int, pull: complex, put: Array) -> None:
        """Add what is put in at order `j`, and its product with the residual."""
        self.pulls[j] += pull
        self.sizes[j] += np.vdot(put, put)
        self.squares[j] += put @ put


@dataclass(frozen=True, eq=False)
class _OrderSearch:
    """What is looked into for orders: a residual without its colour, off the tangent space, and the model's answers."""

    fit: Fit
    white: Whitening
    basis: Array
    residual: Array
    answers: Sequence[Response]
    orders: Array
    slow: Array

    def shares(self, lowest: int, kind: str) -> tuple[Array, list[Line]]:
        """Return about what each order explains, and exactly the lines of those that explain most."""
        orders = self.orders[lowest - 1 :]
        few = np.unique(np.geomspace(1, len(orders), SAMPLED).round().astype(int) - 1)
        lines, sizes = self.exact(orders[few], kind)
        if len(few) == len(orders) or not (sizes > 0).any():
            return np.array([line.share for line in lines]), lines
        pulls, put_in, squares = (m[lowest - 1 :] for m in self.moments[kind])
        put_in = put_in.real
        seen = few[sizes > 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            answer = np.interp(np.log(orders), np.log(orders[seen]), np.log(sizes[sizes > 0] / put_in[seen]))
            # The normal equations of sine and cosine, as alike in the outputs as they are in what is put in.
            alike = squares / put_in
            turned = np.real(np.conj(alike) * pulls**2)
            shares = (np.abs(pulls) ** 2 - turned) / np.maximum(1 - np.abs(alike) ** 2, ALIKE)
            shares /= np.exp(answer) * put_in * float(self.residual @ self.residual)
        shares = np.where(put_in > 0, shares, 0.0)
        lines += self.exact(orders[[k for k in np.argsort(-shares)[:LOOKED_AT] if k not in few]], kind)[0]
        for line in lines:
            shares[int(line.order) - lowest] = line.share
        return shares[shares > 0], lines

    def exact(self, orders: Array, kind: str) -> tuple[list[Line], Array]:
        """Return the lines at `orders`, and the mean square of the answers to sine and cosine, 0 for none."""
        lines: list[Line] = []
        sizes = np.zeros(len(orders))
        # The residual is model less measurement: what is fitted to it counts against the motor's torque.
        residual = self.residual if kind == "torque" else -self.residual
        chunk = int(np.clip(WIDEST / (2 * len(residual)), 10, HIGHEST))
        for first in range(0, len(orders), chunk):
            part = slice(first, first + chunk)
            columns = self.white([self._columns(k, orders[part], kind) for k in range(len(self.answers))])
            columns -= self.basis @ (self.basis.T @ columns)
            sines, cosines = np.split(columns, 2, axis=1)
            sizes[part] = (np.einsum("ij,ij->j", sines, sines) + np.einsum("ij,ij->j", cosines, cosines)) / 2
            lines += _lines(orders[part], sines, cosines, residual)
        return [line for line in lines if line.share > 0], sizes

    @cached_property
    def moments(self) -> dict[str, Moments]:
        """The moments of all orders, by what they modulate."""
        found = {kind: Moments(*np.zeros((3, len(self.orders)), complex)) for kind in _kinds(self.fit.problem)}
        residuals = self.white.transposed(self.residual, [len(a.c) for a in self.answers])
        for k, answer in enumerate(self.answers):
            angle, seen = angle_signal(self.fit.problem.runs[k].experiment), self._measured(k, residuals[k])
            pull = answer.pulled(seen)
            forces = {kind: ((pull * self._pushes(k, kind)).sum(axis=1), self._size(k, kind))
                      for kind in found if kind not in READ}
            once, step = np.exp(1j * angle), np.diff(angle)
            still = np.abs(step) < STILL
            per_step = 1 / np.where(still, 1.0, 1j * step)
            wave = np.ones_like(once)
            for j, order in enumerate(self.orders):
                wave = wave * once
                slow = np.abs(step) <= self.slow[j]
                mean = slow * np.where(still, wave[1:], np.diff(wave) * (per_step / order))  # of exp(jNθ) per sample
                for kind, (pulls, sizes) in forces.items():
                    found[kind].count(j, pulls @ mean, sizes * mean)
                for kind in found.keys() & READ.keys():
                    put = (slow[:, None] * self._read(k, kind, wave[:, None], order)[1:, :, 0]).ravel()
                    found[kind].count(j, seen[1:].ravel() @ put, put)
        return found

    def _columns(self, k: int, orders: Array, kind: str) -> Array:
        """Whitened outputs of run `k` to unit sine and cosine of all `orders`, (N, ny, 2 len(orders))."""
        angle = angle_signal(self.fit.problem.runs[k].experiment)
        slow = self.slow[orders.astype(int) - 1]
        middle, step = (angle[1:] + angle[:-1]) / 2, np.diff(angle)
        if kind in READ:
            near = np.abs(np.diff(angle, prepend=angle[0]))[:, None] <= slow
            put = self._read(k, kind, np.exp(1j * np.outer(angle, orders)), orders) * near[:, None]
            return self._measured(k, np.concatenate([put.imag, put.real], axis=2))
        # Averaged over the sample, so that orders too fast for the sampling fade instead of posing as slower ones.
        fade = np.sinc(np.outer(orders, step) / (2 * np.pi)) * (np.abs(step) <= slow[:, None])
        turning = np.outer(orders, middle)
        drive = np.concatenate([np.sin(turning) * fade, np.cos(turning) * fade])
        return self._measured(k, self.answers[k].driven(drive[:, :, None] * self._pushes(k, kind)))

    def _pushes(self, k: int, kind: str) -> Array:
        """Return what moves the states at the end of each sample, (N-1, nx), if it is not modulated."""
        return np.einsum("nxd,dn->nx", self.answers[k].b, self._forces(k, kind))

    def _read(self, k: int, kind: str, waves: Array, orders: Array) -> Array:
        """Return what `waves` (N, m) of `orders` (m,) in a sensor put into the channels, (N, ny, m), over noise."""
        outputs, weights = self.fit.problem.outputs, self.fit.problem.measured[k].weights
        put = {"omega": waves * self.answers[k].states["omega"][:, None]}
        put |= {"theta": (waves - waves[0]) / (1j * orders)} if kind == "encoder" else {}
        return np.stack([put.get(c, 0 * waves) * w for c, w in zip(outputs, weights, strict=True)], 1)

    def _size(self, k: int, kind: str) -> Array:
        """Return how much is modulated, (N-1,), N·m, a voltage as the torque that it makes at standstill."""
        voltage, torque = self._forces(k, kind)
        return np.hypot(torque, voltage * self.fit.values.get("K", 0.0) / self.fit.values.get("R", 1.0))

    def _forces(self, k: int, kind: str) -> Array:
        """Return the voltage and the torque, (2, N-1), that `kind` modulates."""
        states = self.answers[k].states
        ones, K = np.ones(len(self.answers[k].a)), self.fit.values.get("K", 0.0)
        torque = ones if kind == "torque" or "i" not in states else K * states["i"][:-1]
        return np.stack([-K * states["omega"][:-1] if kind == "K" else 0 * ones, torque])

    def _measured(self, k: int, outputs: Array) -> Array:
        """Return outputs (N, ny, …) with nothing where nothing was measured."""
        outputs[~np.isfinite(self.fit.problem.measured[k].y)] = 0.0
        return outputs


@lru_cache(maxsize=8)  # of the whole, and of every run
def _order_search(tangent: Tangent) -> _OrderSearch:
    """Return what is there to be looked into; outputs count in units of their noise."""
    unstack = tangent.fit.problem.unstack
    white = Whitening.of(unstack(tangent.residual))
    basis, residual = column_space(white(unstack(tangent.basis))), white(unstack(tangent.residual))
    residual = residual - basis @ (basis.T @ residual)
    answers = [replace(answer, c=answer.c * run.weights[None, :, None])
               for answer, run in zip(responses(tangent.fit), tangent.fit.problem.measured, strict=True)]
    # Up to which change of the angle per sample each order is looked for; 0 where it would be an alias.
    orders, counted = np.arange(1.0, highest_order(tangent) + 1), np.sort(_moving(tangent.fit))
    sure, some = (np.searchsorted(counted, part / orders, side="right") for part in (QUARTER, np.pi))
    slow = np.where(some > SLOW_PART * counted.size, np.pi / orders, 0.0)
    slow = np.where(sure > max(SAMPLES, SURE_PART * counted.size), QUARTER / orders, slow)
    return _OrderSearch(tangent.fit, white, basis, residual, answers, orders, slow)


def _lines(orders: Array, sines: Array, cosines: Array, residual: Array) -> list[Line]:
    """Fit A·sin(Nθ+φ) to the residual at each order, from the answers (n, orders) to either; no line without both."""
    sizes = np.linalg.norm(sines, axis=0), np.linalg.norm(cosines, axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        overlap = np.einsum("ij,ij->j", sines, cosines) / (sizes[0] * sizes[1])
        seen = (np.minimum(*sizes) > 1e-12) & (np.abs(overlap) < 1 - ALIKE)
        on_sine, on_cosine = residual @ sines / sizes[0], residual @ cosines / sizes[1]
        a, b = (on_sine - overlap * on_cosine) / (1 - overlap**2), (on_cosine - overlap * on_sine) / (1 - overlap**2)
        share = (a * on_sine + b * on_cosine) / max(float(residual @ residual), 1e-300)
        a, b = a / sizes[0], b / sizes[1]
    return [Line(float(n), float(share[j]), float(np.hypot(a[j], b[j])), float(np.arctan2(b[j], a[j])))
            for j, n in enumerate(orders) if seen[j]]
