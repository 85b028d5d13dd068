"""Free forms: a torque, a voltage or a sensor's error that may be any smooth function of one quantity.

A load or a friction that changes with the angle or with time, a voltage lost at high speed, a tachometer that
ripples once per turn: whatever the library lacks follows one of them more or less. The answer of the outputs is
linear in the function's coefficients, through the model's own response along its trajectory; nothing is integrated
anew.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from motorid.diagnosis.response import Response, responses_of
from motorid.equations import Equations
from motorid.fit import Fit
from motorid.integrate.grid import Array
from motorid.model import Effect
from motorid.parameters import P
from motorid.prepared import angle_signal, natural_sizes
from motorid.problem import Problem
from motorid.simulate import Simulation, simulated

KNOTS = 9  # cosines over the range of a quantity
HARMONICS = 8  # of a turn
START = 0.01  # of the natural torque
SHARP = 1e-3  # of the highest speed: below it a direction is not known
WORDS = {
    "t": "the time",
    "turn": "the angle within a turn",
    "theta": "the angle",
    "omega": "the speed",
    "i": "the current",
    "v": "the voltage",
}


@dataclass(frozen=True)
class Form:
    """A free function of the quantity `on` times `carrier`, in one balance; `words` says what that is.

    In the balance ``"sensor"`` it is added to the output `channel`.
    """

    words: str
    balance: str
    on: str
    carrier: str = ""
    channel: str = ""

    @property
    def text(self) -> str:
        """What it is, in words."""
        return f"{self.words} that changes with {WORDS[self.on]}"


FORMS = (
    Form("a friction", "torque", "turn", "direction"),
    Form("a friction", "torque", "theta", "direction"),
    Form("a friction", "torque", "t", "direction"),
    Form("a load", "torque", "turn"),
    Form("a load", "torque", "theta"),
    Form("a load", "torque", "t"),
    Form("a drag", "torque", "t", "omega"),
    Form("a drag", "torque", "turn", "omega"),
    Form("a torque", "torque", "omega"),
    Form("a loss of voltage", "voltage", "omega"),
    Form("a loss of voltage", "voltage", "v"),
    Form("a loss of voltage", "voltage", "i"),
    Form("a loss of voltage", "voltage", "t"),
    Form("a resistance", "voltage", "t", "i"),
    Form("a gain of the speed sensor", "sensor", "turn", "omega", "omega"),
    Form("an error of the angle sensor", "sensor", "turn", "", "theta"),
)


@dataclass(frozen=True, eq=False)
class Linear:
    """A model on records: its whitened residual, and how that answers to everything that might change.

    Attributes
    ----------
    residual : ndarray, shape (n,)
    slopes : ndarray, shape (n, number of free parameters)
    own : ndarray, shape (n, number of estimated initial states)
    forms : dict of Form to ndarray, shape (n, number of coefficients)
    place, channel : ndarray, shape (n,)
        Of each residual: where in its run it is, from 0 to 1, and which output.
    """

    residual: Array
    slopes: Array
    own: Array
    forms: Mapping[Form, Array]
    place: Array
    channel: Array

    def part(self, rows: NDArray[np.bool_]) -> Linear:
        """Return the rows chosen by a mask."""
        return Linear(
            self.residual[rows],
            self.slopes[rows],
            self.own[rows],
            {f: c[rows] for f, c in self.forms.items()},
            self.place[rows],
            self.channel[rows],
        )


def linearised(fit: Fit, validation: Problem | None, balance: Mapping[str, float] | None = None) -> list[Linear]:
    """Return the model of `fit` on its own records and, if given, on held-out ones, the same forms over both.

    `balance` gives other weights of the channels than the fit's own.

    Raises
    ------
    SimulationError
    """
    problem = fit.problem.tuned(balance=fit.problem.balance if balance is None else balance)
    known = [_on(problem, fit, fit.simulations)]
    if validation is not None:
        other = validation.for_model(fit.model).tuned(balance=problem.balance)
        known.append(_on(other, fit, simulated(other)))
    signals = [[_signals(p, s, k) for k, s in enumerate(sims)] for p, sims, _, _ in known]
    ranges, orders = _ranges(signals[0]), _orders(fit)
    forms = [f for f in FORMS if _fits(f, fit, ranges)]
    free, p = len(fit.problem.model.free_names), np.array([fit.values[p] for p in problem.system.parameters])
    found = []
    for (problem, sims, residual, jac), signal in zip(known, signals, strict=True):
        n, runs = problem.n_outputs, range(len(sims))
        answers = responses_of(problem, p, sims)
        bases = [{f: _basis(f, s, ranges, orders) for f in forms} for s in signal]
        parts = [_answers(problem, k, answers[k], bases[k]) for k in runs]
        columns = {f: np.vstack([part[f] for part in parts]) for f in forms}
        place, channel = np.concatenate([_labels(problem, k) for k in runs], axis=1)
        found.append(Linear(residual[:n], jac[:n, :free], jac[:n, free:], columns, place, channel))
    return found


Judged = tuple[Problem, Sequence[Simulation], Array, Array]


def _on(problem: Problem, fit: Fit, sims: Sequence[Simulation]) -> Judged:
    """Return records, the fitted model's simulation of them, residual and slopes (SI)."""
    first = {f"{c}_0[{k}]": float(y[0]) for k, s in enumerate(sims) for c, y in s.states.items()}
    values = {**fit.values, **first}
    q = problem.scaling.scaled([values.get(p.name, p.value) for p in problem.unknown])
    runs = problem.refined(q).runs
    problem = replace(problem, loss=None, priors={}, penalties=(), _runs=runs)
    residual, jac = problem.residual_and_jacobian(q)
    return problem, sims, residual, jac / problem.scaling.slope(q)


def _signals(problem: Problem, sim: Simulation, k: int) -> dict[str, Array]:
    run = problem.experiments[k]
    found = {"t": run.t - run.t[0], "v": run.inputs["v"]}
    found |= {c: np.asarray(sim.states[c]) for c in ("i", "omega") if c in sim.states}
    if "theta" in run.outputs or "omega" in run.outputs:
        found["theta"] = found["turn"] = angle_signal(run)
    return found


def _ranges(signals: Sequence[Mapping[str, Array]]) -> dict[str, tuple[float, float]]:
    names = set.intersection(*(set(s) for s in signals))
    return {n: (min(float(s[n].min()) for s in signals), max(float(s[n].max()) for s in signals)) for n in names}


def _fits(form: Form, fit: Fit, ranges: Mapping[str, tuple[float, float]]) -> bool:
    """Tell whether the records can show a form: its quantity is known, its balance is in the model."""
    if form.channel and form.channel not in fit.problem.outputs:
        return False
    if form.on not in ranges or ranges[form.on][0] == ranges[form.on][1]:
        return False
    if form.balance == "voltage" and "i" not in fit.problem.outputs:
        return False  # there a torque says the same
    return form.on != "turn" or fit.problem.model.axis != "linear"


def _orders(fit: Fit) -> list[float]:
    """Return orders of a turn: the lowest, and the harmonics of those in the model."""
    known = [fit.values[p.name] for e in fit.model.effects for p in e.parameters if p.order]
    return sorted({*range(1, HARMONICS + 1), *(round(k * n) for n in known for k in range(1, 5))})


def _basis(
    form: Form, signal: Mapping[str, Array], ranges: Mapping[str, tuple[float, float]], orders: Sequence[float]
) -> Array:
    """Return the form's functions along one run, (N, m)."""
    low, high = ranges[form.on]
    z = signal[form.on] if form.on == "turn" else np.clip(signal[form.on], low, high)  # nothing is known beyond
    if form.on == "turn":
        waves = [f(k * z) for k in orders for f in (np.sin, np.cos)]
        functions = np.column_stack([np.ones_like(z), *waves])
    elif form.on in ("omega", "i", "v"):
        functions = _through_zero(z, max(abs(low), abs(high)))
    else:
        count = KNOTS if form.on == "t" else 2 * KNOTS
        functions = np.column_stack([np.cos(np.pi * k * (z - low) / (high - low)) for k in range(count)])
    if form.carrier == "direction":
        top = max(abs(x) for x in ranges["omega"])
        return functions * np.clip(signal["omega"] / (SHARP * top), -1, 1)[:, None]
    return functions * signal[form.carrier][:, None] if form.carrier else functions


def _through_zero(z: Array, top: float) -> Array:
    """Return odd and even functions of a quantity with a sign, kinks and jumps at zero included."""
    size, side = np.abs(z) / top, np.clip(z / (SHARP * top), -1, 1)
    powers = np.column_stack([size**p for p in (0.0, 0.5, 1.0, 2.0, 3.0, 4.0)])
    return np.column_stack([powers * side[:, None], powers])


def _answers(problem: Problem, k: int, answer: Response, bases: Mapping[Form, Array]) -> dict[Form, Array]:
    """Return the whitened outputs of run `k` to every function of every form."""
    if not bases:
        return {}
    _, weights, index = problem._weights[k]
    c = answer.c * weights[None, :, None]
    inside = {f: b for f, b in bases.items() if f.balance != "sensor"}
    flat = np.concatenate(
        [_driven(answer, c, inside), *(_read(problem, f, b, weights) for f, b in bases.items() if f not in inside)],
        axis=1,
    )
    flat = flat if index is None else flat[index]
    order = [*inside, *(f for f in bases if f not in inside)]
    ends = np.cumsum([bases[f].shape[1] for f in order])[:-1]
    return dict(zip(order, np.split(flat, ends, axis=1), strict=True))


def _driven(answer: Response, c: Array, bases: Mapping[Form, Array]) -> Array:
    """Return the outputs, (N·ny, m), to functions in the balances."""
    n, ny, nx = c.shape
    if not bases:
        return np.zeros((n * ny, 0))
    drive = np.concatenate([b[:-1] for b in bases.values()], axis=1)
    which = np.concatenate([np.full(b.shape[1], f.balance == "torque", int) for f, b in bases.items()])
    state, out = np.zeros((nx, drive.shape[1])), np.zeros((n, ny, drive.shape[1]))
    for j in range(n - 1):
        state = answer.a[j] @ state + answer.b[j][:, which] * drive[j]
        out[j + 1] = c[j + 1] @ state
    return out.reshape(n * ny, -1)


def _read(problem: Problem, form: Form, basis: Array, weights: Array) -> Array:
    """Return the outputs, (N·ny, m), to functions added to one output."""
    out = np.zeros((len(basis), len(problem.outputs), basis.shape[1]))
    j = problem.outputs.index(form.channel)
    out[:, j] = basis * weights[j]
    return out.reshape(-1, basis.shape[1])


def _labels(problem: Problem, k: int) -> Array:
    """Return place in the run and channel of every residual of run `k`, (2, n)."""
    y, _, index = problem._weights[k]
    place = np.repeat(np.arange(len(y)) / len(y), y.shape[1])
    both = np.stack([place, np.tile(np.arange(y.shape[1]), len(y))])
    return both if index is None else both[:, index]


def halves(linear: Linear, blocks: int) -> Iterator[tuple[Linear, Linear]]:
    """Yield every other block of the records and the rest, both ways round."""
    odd = (linear.place * blocks).astype(int) % 2 == 1
    for mask in (odd, ~odd):
        yield linear.part(mask), linear.part(~mask)


def as_effect(form: Form, fit: Fit) -> Effect | None:
    """Return a form of the angle or of time as an effect that can be fitted; None for the others."""
    if form.on not in ("turn", "theta", "t") or form.balance != "torque" or form.carrier == "omega":
        return None
    low, high = _ranges([_signals(fit.problem, s, k) for k, s in enumerate(fit.simulations)])[form.on]
    size = natural_sizes(fit.problem.experiments, fit.values)["N" if fit.model.axis == "linear" else "N·m"]
    names = [f"form_{k}" for k in range(KNOTS)]

    def law(m: Equations, **sizes: Any) -> None:
        if form.on == "t":
            z = m.state("clock")
            m.rate(z, 1.0)
        else:
            z = m.theta
        carrier = m.sign(m.omega) if form.carrier else 1.0
        m.torque -= carrier * sum(sizes[n] * wave for n, wave in zip(names, _waves(form, z, low, high), strict=True))

    return Effect("free_form", law, tuple(P(START * size, "N·m", null=0.0).named(n) for n in names), "torque")


def _waves(form: Form, z: ca.SX, low: float, high: float) -> list[Any]:
    if form.on == "turn":
        return [ca.sin((k + 1) // 2 * z) if k % 2 else ca.cos(k // 2 * z) for k in range(KNOTS)]
    return [ca.cos(k * np.pi * (z - low) / (high - low)) for k in range(KNOTS)]
