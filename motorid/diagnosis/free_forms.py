"""Which free forms there are, and what functions they are made of.

Cosines over the range of a time or an angle, waves of a turn, powers with jumps and kinks at zero for what has a sign.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from motorid.diagnosis.thresholds import CONTAINED
from motorid.effects import LIBRARY
from motorid.errors import SimulationError
from motorid.estimation.angle_orders import likely_orders
from motorid.estimation.linearisation import Response, Tangent, parameter_vector, responses_of
from motorid.estimation.result import Fit
from motorid.numerics.signals import Array
from motorid.problem.problem import Problem
from motorid.problem.runs import angle_signal
from motorid.problem.simulate import Simulation, simulated

KNOTS = 9  # cosines over the range of a quantity
HARMONICS = 8  # of a turn
LINES = 2  # of the spectrum of the misfit over the angle
SHARP = 1e-3  # of the highest speed: below it a direction is not known
CHANGES = {"t": "changes with the time", "turn": "changes with the angle within a turn",
           "theta": "changes with the angle", "omega": "changes with the speed", "i": "changes with the current",
           "v": "changes with the voltage", "run": "differs from run to run"}


@dataclass(frozen=True)
class Form:
    """A free function of the quantity `on` times `carrier`, in one balance; `words` says what that is.

    In the balance ``"sensor"`` it is added to the output `channel`; ``"both"`` is the motor constant, which makes
    torque of current and voltage of speed.
    """

    words: str
    balance: str
    on: str
    carrier: str = ""
    channel: str = ""

    @property
    def text(self) -> str:
        """What it is, in words."""
        return f"{self.words} that {CHANGES[self.on]}"

    @property
    def local(self) -> bool:
        """Tell whether what is learnt of it on some runs says nothing of others."""
        return self.on in ("theta", "run")


FORMS = (Form("a friction", "torque", "turn", "direction"), Form("a friction", "torque", "theta", "direction"),
         Form("a friction", "torque", "t", "direction"), Form("a load", "torque", "turn"),
         Form("a load", "torque", "theta"), Form("a load", "torque", "t"), Form("a drag", "torque", "t", "omega"),
         Form("a drag", "torque", "turn", "omega"), Form("a torque", "torque", "omega"),
         Form("a loss of voltage", "voltage", "omega"), Form("a loss of voltage", "voltage", "v"),
         Form("a loss of voltage", "voltage", "i"), Form("a loss of voltage", "voltage", "t"),
         Form("a resistance", "voltage", "t", "i"), Form("a motor constant", "both", "t"),
         Form("a friction", "torque", "run", "direction"), Form("a load", "torque", "run"),
         Form("a drag", "torque", "run", "omega"), Form("an inertia", "torque", "run", "acceleration"),
         Form("a loss of voltage", "voltage", "run"), Form("a resistance", "voltage", "run", "i"),
         Form("a motor constant", "both", "run"),
         Form("a gain of the speed sensor", "sensor", "turn", "omega", "omega"),
         Form("an error of the angle sensor", "sensor", "turn", "", "theta"))


def ranges_of(signals: Sequence[Mapping[str, Array]]) -> dict[str, tuple[float, float]]:
    """Return the smallest and the largest value of every quantity known in all runs."""
    names = set.intersection(*(set(s) for s in signals))
    return {n: (min(float(s[n].min()) for s in signals), max(float(s[n].max()) for s in signals)) for n in names}


def shown(form: Form, fit: Fit, ranges: Mapping[str, tuple[float, float]]) -> bool:
    """Tell whether the records can show a form: its quantity is known, its balance is in the model."""
    if form.channel and not {"omega", "theta"} <= set(fit.problem.outputs):
        return False  # one measure of the motion needs the other to be told wrong
    if form.on not in ranges or ranges[form.on][0] == ranges[form.on][1]:
        return False
    if form.balance in ("voltage", "both") and "i" not in fit.problem.outputs:
        return False  # there a torque says the same
    return form.on != "turn" or fit.problem.model.axis != "linear"


def orders_of(fit: Fit) -> list[float]:
    """Return orders of a turn: the lowest, the harmonics of those in the model, and what stands out of the misfit."""
    known = [fit.values[p.name] for e in fit.model.effects for p in e.parameters if p.order]
    seen = likely_orders(Tangent.of(fit), LIBRARY["cogging"], LINES) if "theta" in fit.problem.outputs else []
    return sorted({*range(1, HARMONICS + 1), *(round(k * n) for n in known for k in range(1, 5)), *map(round, seen)})


def basis_of(
    form: Form, signal: Mapping[str, Array], ranges: Mapping[str, tuple[float, float]], orders: Sequence[float]
) -> Array:
    """Return the form's functions along one run, (N, m)."""
    low, high = ranges[form.on]
    z = signal[form.on]
    if form.on not in ("turn", "run"):
        z = np.clip(z, low, high)  # nothing is known beyond
    if form.on == "run":
        functions = (signal["run"][:, None] == np.arange(int(high) + 1)).astype(float)
    elif form.on == "turn":
        waves = [f(k * z) for k in orders for f in (np.sin, np.cos)]
        functions = np.column_stack([np.ones_like(z), *waves])
    elif form.on in ("omega", "i", "v"):
        functions = _through_zero(z, max(abs(low), abs(high)))
    else:
        count = KNOTS if form.on == "t" else 2 * KNOTS
        functions = np.column_stack([np.cos(np.pi * k * (z - low) / (high - low)) for k in range(count)])
    if form.carrier == "direction" and "direction" in signal:
        return functions * signal["direction"][:, None]
    if form.carrier == "direction":
        top = max(abs(x) for x in ranges["omega"])
        return functions * np.clip(signal["omega"] / (SHARP * top), -1, 1)[:, None]
    return functions * signal[form.carrier][:, None] if form.carrier else functions


def _through_zero(z: Array, top: float) -> Array:
    """Return odd and even functions of a quantity with a sign, kinks and jumps at zero included."""
    size, side = np.abs(z) / top, np.clip(z / (SHARP * top), -1, 1)
    powers = np.column_stack([size**p for p in (0.0, 0.5, 1.0, 2.0, 3.0, 4.0)])
    return np.column_stack([powers * side[:, None], powers])


START = 0.01  # of the natural torque
BALANCES = ("voltage", "torque")
STATES = {"torque": "omega", "voltage": "i"}  # whose rate a balance is
NUDGE = 1e-3  # of a size
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
        return Linear(self.residual[rows], self.slopes[rows], self.own[rows],
                      {f: c[rows] for f, c in self.forms.items()}, self.place[rows], self.channel[rows])


def linearised(fit: Fit, validation: Problem | None, balance: Mapping[str, float] | None = None) -> list[Linear]:
    """Return the model of `fit` on its own records and, if given, on held-out ones, the same forms over both.

    `balance` gives other weights of the channels than the fit's own.

    Raises
    ------
    SimulationError
    """
    problem = fit.problem.tuned(noise_factors=fit.problem.noise_factors if balance is None else balance)
    known = [_on(problem, fit, fit.simulations)]
    if validation is not None:
        other = validation.for_model(fit.model).tuned(noise_factors=problem.noise_factors)
        known.append(_on(other, fit, simulated(other)))
    signals = [[signals_of(fit, p, s, k) for k, s in enumerate(sims)] for p, sims, _, _ in known]
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


def signals_of(fit: Fit, problem: Problem, sim: Simulation, k: int) -> dict[str, Array]:
    """Return what a form may be a function of, along run `k`, (N,) each; the direction as smooth as the model's own."""
    run = problem.experiments[k]
    found = {"t": run.t - run.t[0], "v": run.inputs["v"], "run": np.full(run.n, float(k))}
    found |= {c: np.asarray(sim.states[c]) for c in ("i", "omega") if c in sim.states}
    if "omega" in found:
        if (width := fit.values.get("sgn_width")) is not None:
            found["direction"] = np.tanh(found["omega"] / width)
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


def form_coefficients(fit: Fit, linear: Linear, form: Form) -> Array:
    """Return the coefficients of a free form's functions that beside `fit` explain its records best."""
    columns, sizes = form_columns(fit, linear, form)
    together = np.column_stack([columns, linear.own])
    found = ridge(together, linear.residual)
    first = linear.slopes.shape[1]
    return found[first : first + len(sizes)] * sizes


def form_columns(fit: Fit, linear: Linear, form: Form) -> tuple[Array, Array]:
    """Return the slopes in solver coordinates with the form's answers, and the sizes by which these were scaled.

    A unit of each coefficient makes an answer as large as what was measured.
    """
    problem, n, answers = fit.problem, len(linear.residual), linear.forms[form]
    measured = [(m.y * m.weights)[:, m.weights > 0] ** 2 for m in problem.measured]
    size = np.sqrt(n) * float(np.sqrt(np.mean([np.nanmean(y2) for y2 in measured])))
    norms = np.linalg.norm(answers, axis=0)
    sizes = np.where(norms > 0, size / np.where(norms > 0, norms, 1.0), 0.0)
    free = problem.scaling.slope(fit.q)[: linear.slopes.shape[1]]
    return np.column_stack([linear.slopes * free, answers * sizes]), sizes


def ridge(columns: Array, residual: Array) -> Array:
    """Return least-squares coefficients with a prior of one unit at the scale of what is left."""
    norms = np.linalg.norm(columns, axis=0)
    norms = np.where(norms > 0, norms, 1.0)
    rough = residual - columns @ (np.linalg.lstsq(columns / norms, residual, rcond=1e-7)[0] / norms)
    scale2 = float(rough @ rough) / len(residual)
    normal = columns.T @ columns + scale2 * np.eye(columns.shape[1])
    return np.asarray(np.linalg.solve(normal, columns.T @ residual), float)


def contains(fit: Fit, form: Form, size: str) -> bool:
    """Tell whether a form in the balance of an effect can be the effect whose size is the parameter `size`.

    What the size puts into the balance along the model's trajectory is compared with the form's functions there.
    """
    if STATES.get(form.balance) not in fit.problem.system.states or size not in fit.problem.system.parameters:
        return False
    signals = [signals_of(fit, fit.problem, s, k) for k, s in enumerate(fit.simulations)]
    ranges, orders = ranges_of(signals), orders_of(fit)
    if not shown(form, fit, ranges):
        return False
    push = pushes_of(fit, size)
    whole, own = float(np.sum(push**2)), push[:, fit.problem.system.states.index(STATES[form.balance])]
    basis = np.concatenate([basis_of(form, s, ranges, orders) for s in signals])
    left = own - basis @ np.linalg.lstsq(basis, own, rcond=1e-9)[0]
    return float(left @ left) + whole - float(own @ own) < CONTAINED**2 * whole


def pushes_of(fit: Fit, name: str) -> Array:
    """Return what a small change of a parameter adds to the rate of each state along all runs, (N, nx)."""
    system, values = fit.problem.system, parameter_vector(fit)
    nudged = values.copy()
    nudged[system.parameters.index(name)] += NUDGE * (abs(fit.values[name]) or 1.0)
    found = []
    for run, sim in zip(fit.problem.runs, fit.simulations, strict=True):
        x, u = np.column_stack([sim.states[s] for s in system.states]).T, run.grid.u.T
        was, now = (np.asarray(system.rhs.map(x.shape[1])(x, u, np.tile(p[:, None], (1, x.shape[1]))))
                    for p in (values, nudged))
        found.append((now - was).T)
    return np.concatenate(found)


def force_of(fit: Fit, form: Form) -> float:
    """Return the torque or voltage of a free form that beside `fit` explains its records best, RMS along all runs."""
    signals = [signals_of(fit, fit.problem, s, k) for k, s in enumerate(fit.simulations)]
    ranges, orders = ranges_of(signals), orders_of(fit)
    basis = np.concatenate([basis_of(form, s, ranges, orders) for s in signals])
    force = basis @ form_coefficients(fit, linearised(fit, None)[0], form)
    return float(np.sqrt(np.mean(force**2)))


def effect_force(fit: Fit, form: Form, size: str) -> float:
    """Return the torque or voltage of the effect of that size in the balance of a form, RMS along all runs."""
    state = STATES[form.balance]
    rate = pushes_of(fit, size)[:, fit.problem.system.states.index(state)] / NUDGE
    return float(np.sqrt(np.mean(rate**2))) * fit.values["J" if state == "omega" else "L"]
