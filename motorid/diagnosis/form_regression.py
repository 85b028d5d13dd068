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

from motorid.diagnosis.free_forms import FORMS, KNOTS, Form, basis_of, orders_of, ranges_of, shown
from motorid.errors import SimulationError
from motorid.estimation.linearisation import Response, responses_of
from motorid.estimation.result import Fit
from motorid.model.definition import Effect, P
from motorid.model.equations import Equations
from motorid.numerics.signals import Array
from motorid.problem.problem import Problem
from motorid.problem.runs import angle_signal, natural_sizes
from motorid.problem.simulate import Simulation, simulated

START = 0.01  # of the natural torque
BALANCES = ("voltage", "torque")
UNBOUNDED = 1e9  # in units of the noise, per unit of a form


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
    ranges, orders = ranges_of(signals[0]), orders_of(fit)
    forms = [f for f in FORMS if shown(f, fit, ranges)]
    free, p = len(fit.problem.model.free_names), np.array([fit.values[p] for p in problem.system.parameters])
    found = []
    for (problem, sims, residual, jac), signal in zip(known, signals, strict=True):
        n, runs = problem.n_outputs, range(len(sims))
        answers = responses_of(problem, p, sims)
        bases = [{f: basis_of(f, s, ranges, orders) for f in forms} for s in signal]
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
    found = {"t": run.t - run.t[0], "v": run.inputs["v"], "run": np.full(run.n, float(k))}
    found |= {c: np.asarray(sim.states[c]) for c in ("i", "omega") if c in sim.states}
    if "omega" in found:
        found["acceleration"] = np.gradient(found["omega"], run.t)
    if "theta" in run.outputs or "omega" in run.outputs:
        found["theta"] = found["turn"] = angle_signal(run)
    return found


def _answers(problem: Problem, k: int, answer: Response, bases: Mapping[Form, Array]) -> dict[Form, Array]:
    """Return the whitened outputs of run `k` to every function of every form."""
    if not bases:
        return {}
    _, weights, index = problem.measured[k][:3]
    answer = replace(answer, c=answer.c * weights[None, :, None])
    inside = {f: b for f, b in bases.items() if f.balance != "sensor"}
    flat = np.concatenate(
        [_driven(answer, inside), *(_read(problem, f, b, weights) for f, b in bases.items() if f not in inside)],
        axis=1,
    )
    flat = flat if index is None else flat[index]
    order = [*inside, *(f for f in bases if f not in inside)]
    ends = np.cumsum([bases[f].shape[1] for f in order])[:-1]
    return dict(zip(order, np.split(flat, ends, axis=1), strict=True))


def _driven(answer: Response, bases: Mapping[Form, Array]) -> Array:
    """Return the outputs, (N·ny, m), to functions in the balances."""
    n, ny, _ = answer.c.shape
    if not bases:
        return np.zeros((n * ny, 0))
    forces = [np.stack([_share(f, b, answer, on)[:-1] for on in BALANCES], axis=2) for f, b in bases.items()]
    with np.errstate(over="ignore", invalid="ignore"):
        out = answer.driven(np.einsum("nxf,nmf->mnx", answer.b, np.concatenate(forces, axis=1), optimize=True))
    if not np.all(np.abs(out) < UNBOUNDED):  # or not a number
        raise SimulationError("the model's answer to small changes grows without bound along these records.")
    return out.reshape(n * ny, -1)


def _share(form: Form, basis: Array, answer: Response, balance: str) -> Array:
    """Return what a form puts in a balance, (N, m)."""
    if form.balance == "both":
        return basis * (answer.states["i"] if balance == "torque" else -answer.states["omega"])[:, None]
    return basis if form.balance == balance else np.zeros_like(basis)


def _read(problem: Problem, form: Form, basis: Array, weights: Array) -> Array:
    """Return the outputs, (N·ny, m), to functions added to one output."""
    out = np.zeros((len(basis), len(problem.outputs), basis.shape[1]))
    j = problem.outputs.index(form.channel)
    out[:, j] = basis * weights[j]
    return out.reshape(-1, basis.shape[1])


def _labels(problem: Problem, k: int) -> Array:
    """Return place in the run and channel of every residual of run `k`, (2, n)."""
    y, _, index = problem.measured[k][:3]
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
    low, high = ranges_of([_signals(fit.problem, s, k) for k, s in enumerate(fit.simulations)])[form.on]
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


RIDGE = 1e-7  # of the largest singular value; smaller ones are left out


def by_channel(residual: Array, part: Linear) -> Array:
    """Return the sum of squares per channel."""
    squares: Array = np.bincount(part.channel.astype(int), residual**2).astype(float)
    return squares


def fraction(after: Array, before: Array, channels: Sequence[int]) -> float:
    """Return what is left of squared misfits, geometric mean over the channels that are not yet down to noise."""
    return float(np.exp(np.mean([np.log((after[c] + 1e-300) / (before[c] + 1e-300)) for c in channels])))


def fraction_of(form: Form, parts: Sequence[tuple[Linear, Linear]], channels: Sequence[int]) -> float:
    """Return what a form leaves of what else is left, learnt on the first and judged on the second of each pair."""
    before = np.sum([by_channel(left(judge.residual, judge.own), judge) for _, judge in parts], axis=0)
    after = np.sum([by_channel(_predicted(form, learn, judge), judge) for learn, judge in parts], axis=0)
    return fraction(after, before, channels)


def _predicted(form: Form, learn: Linear, judge: Linear) -> Array:
    """Return the residual on `judge` of what `learn` tells; only initial states are fitted there."""
    moved = _solved(np.concatenate([learn.forms[form], learn.slopes, learn.own], axis=1), learn.residual)
    columns = np.concatenate([judge.forms[form], judge.slopes], axis=1)
    return left(judge.residual - columns @ moved[: columns.shape[1]], judge.own)


def left(residual: Array, *columns: Array) -> Array:
    """Return what the best mixture of `columns` leaves."""
    together = np.concatenate(columns, axis=1)
    return residual - together @ _solved(together, residual) if together.shape[1] else residual


def _solved(columns: Array, residual: Array) -> Array:
    """Return the least-squares coefficients, directions that hardly show left out."""
    norms = np.linalg.norm(columns, axis=0)
    norms = np.where(norms > 0, norms, 1.0)
    return np.linalg.lstsq(columns / norms, residual, rcond=RIDGE)[0] / norms
