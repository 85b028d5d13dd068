"""Start values: a first guess of the motor, natural sizes of its effects, and a race where these leave a choice.

The first guess, of the motor and the loads on it, comes from the data alone. The balances are integrated over time, so
nothing is differentiated, and solved as non-negative linear least squares: ``∫v dt = L Δi + R ∫i dt + K ∫ω dt`` and
``K ∫i dt = J Δω + b ∫ω dt`` (Garnier & Wang, Identification of Continuous-time Models from Sampled Data, 2008, ch. 1).
A current or a speed that was not measured is eliminated; what none tells is given, or round; effects add columns."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motorid.channels import CHANNELS, COMPUTED_INPUTS
from motorid.effects import LIBRARY
from motorid.errors import ModelError
from motorid.estimation.continuation import by_continuation
from motorid.estimation.least_squares import LOOK, RACE, Estimate, cost_at, race
from motorid.model.definition import Effect, Parameter
from motorid.model.model import BASES, Model, dc_motor
from motorid.numerics.signals import Array, bridged, integral, slope
from motorid.problem.problem import Problem
from motorid.problem.runs import combined, natural_sizes, shapes_of, suited, time_since
from motorid.records.experiment import Experiment

BASE = ("R", "L", "K", "b", "J", "g")
BACK_EMF = 0.9
FLOOR = 1e-3  # share of its natural size given to a parameter that comes out as zero
FASTEST = 0.2  # samples, L/R at least: of a current alone, from below the inductance has a valley of its own
ABOVE = 1.3  # times: where a size starts that is at least another
RESONANCE = "1/s"
STOPPED = 100.0  # times the friction and the back-EMF, where friction leaves a hundredth of the motion
LEFT = 0.1  # of an inductance or inertia, where another lag takes the rest
BACK_EMF_SHARES = (0.3, 0.03)
PHASES = tuple(np.arange(4) * np.pi / 2)
WIDE = 0.02  # width of sgn over the highest speed: a measured speed is noise around standstill


def first_guess(model: Model, runs: Sequence[Experiment], *, loaded: bool = False,
                back_emf: float = BACK_EMF) -> dict[str, float]:
    """Return base parameters, SI, that suit `runs`, given and fixed ones as they are; if `loaded` sizes of torque
    effects too. `back_emf` is its share of the voltage per speed where no current tells it from viscous friction."""
    held = {n: p.value for n, p in model.parameters.items() if p.given or not p.vary}
    signals = [_signals(_read_plainly(r, model), loaded) for r in runs]
    loads = _Loads(model, loads_of(model) if loaded else ())
    turning = [s for s in signals if "omega" in s]
    both = [s for s in turning if "i" in s]
    if model.base == "torque_driven":
        found = _torque_driven(signals, held, loads)
    elif not turning:
        found = _without_speed([s for s in signals if "i" in s], held)
    elif not both or _rings(found := _full(both, held, loads), signals):  # with a current that is not the motor's
        found = _without_current(turning, held, loads, back_emf)
    base = {n: held.get(n, v) for n, v in found.items() if n in model.parameters and np.isfinite(v)}
    return {n: v for n, v in base.items() if v > 0 or n not in BASE}


def _read_plainly(run: Experiment, model: Model) -> Experiment:
    """Return the run without a current that is not the motor's, as an effect without a free parameter says."""
    fixed = [e for e in model.effects if e.balance == "sensor" and not any(p.vary for p in e.parameters)]
    beside = "i" in run.outputs and len(run.outputs) > 1
    return run.without("i") if beside and any("i" in (dc_motor() + e).write().sensors for e in fixed) else run


def _signals(run: Experiment, loaded: bool) -> dict[str, Array]:
    """Return t, v, on all samples what was measured of i, omega (or its slope) and theta, and integrals, as `v_dt`."""
    t = run.t
    measured = (c for c in CHANNELS if c in run.outputs and np.isfinite(run.outputs[c]).any())
    found: dict[str, Array] = {"t": t, **run.inputs, **{c: bridged(t, run.outputs[c]) for c in measured}}
    if "omega" not in found and "theta" in found:
        found["omega"] = slope(t, found["theta"], max(2, min(10, len(t) // 200)))
    found |= {c: time_since(run, c) for c in COMPUTED_INPUTS if loaded}
    found |= {f"{c}_dt": integral(t, found[c]) for c in ("i", "omega") if c in found}
    return found | {"v_dt": integral(t, run.inputs["v"], run.hold == "zoh")}


def _windowed(columns: Sequence[Array], target: Array, windows: int = 20) -> tuple[Array, Array]:
    """Take differences over a window, so that slow drift of the integrals does not outweigh the transients."""
    w = max(len(target) // windows, 1)
    return np.column_stack([c[w:] - c[:-w] for c in columns]), target[w:] - target[:-w]


def _solve(rows: list[tuple[Array, Array]], names: "list[str | Load]", held: Mapping[Any, float]) -> dict[Any, float]:
    """Non-negative least squares with some coefficients known; zeros of the motor become small positive numbers."""
    a, b = np.vstack([r[0] for r in rows]), np.concatenate([r[1] for r in rows])
    known = {n: held[n] for n in names if n in held}
    if not (free := [n for n in names if n not in held]):
        return known
    b = b - a[:, [n in held for n in names]] @ np.array([*known.values()])
    a = a[:, [n not in held for n in names]]
    norms = np.where((norms := np.linalg.norm(a, axis=0)) > 0, norms, 1.0)
    triangle: Array = np.asarray(np.linalg.qr(np.column_stack([a / norms, b]), mode="r"))
    z = _nonnegative(triangle[:, :-1], triangle[:, -1], np.array([isinstance(n, Load) and n.signed for n in free]))
    # A coefficient that comes out as zero starts where its term would carry a thousandth of the right-hand side.
    z = np.where([isinstance(n, str) for n in free], np.maximum(z, FLOOR * np.linalg.norm(b)), z) / norms
    return known | dict(zip(free, z.tolist(), strict=True))


def _nonnegative(a: Array, b: Array, signed: NDArray[np.bool_]) -> Array:
    """Return the z (n,) of least ‖a z − b‖ of which only the `signed` may be negative (`nnls` imports slowly)."""
    bound = np.flatnonzero(~signed)
    for zero in (list(c) for k in range(len(bound) + 1) for c in combinations(bound, k)):
        z, rest = np.zeros(len(signed)), np.delete(np.arange(len(signed)), zero)
        z[rest] = np.linalg.lstsq(a[:, rest], b, rcond=None)[0]
        if np.all(z[bound] >= 0) and np.all(a[:, zero].T @ (b - a @ z) <= 1e-9 * np.linalg.norm(b)):
            return z
    return np.zeros(len(signed))


def _full(signals: list[dict], held: Mapping[str, float], loads: "_Loads") -> dict[str, float]:
    electrical = [_windowed([s["i"], s["i_dt"], s["omega_dt"]], s["v_dt"], 200) for s in signals]
    found = _solve(electrical, ["L", "R", "K"], held)
    mechanical = [_windowed([s["omega"], s["omega_dt"], *loads.integrals(s, {**found, "b": 0.0, "J": 1.0})],
                            found["K"] * s["i_dt"]) for s in signals]
    return found | loads.split(_solve(mechanical, ["J", "b", *loads.loads], held))


def _rings(motor: Mapping[str, float], signals: list[dict]) -> bool:
    """Tell whether a motor rings more than once per sample, and on beyond it."""
    dt, (r, k, b, j) = min(float(np.median(np.diff(s["t"]))) for s in signals), (motor[n] for n in "RKbJ")
    return (k * dt / np.pi) ** 2 > (lj := motor["L"] * j) and (r * j + b * motor["L"]) * dt < 2 * lj


def _torque_driven(signals: list[dict], held: Mapping[str, float], loads: "_Loads") -> dict[str, float]:
    g = held.get("g", 1.0)
    rows = [_windowed([s["omega"], s["omega_dt"], *loads.integrals(s, {"g": g, "b": 0.0, "J": 1.0})], g * s["v_dt"])
            for s in signals]
    return {"g": g} | loads.split(_solve(rows, ["J", "b", *loads.loads], held))


def _without_current(signals: list[dict], held: Mapping[str, float], loads: "_Loads",
                     back_emf: float) -> dict[str, float]:
    """``∫v = (RJ/K) Δω + (K + Rb/K) ∫ω + (R/K) ∫load``: two numbers and the loads; the rest is assumed."""
    unit = {"R": 1.0, "L": 1.0, "K": 1.0, "b": 0.0, "J": 1.0}
    rows = [_windowed([s["omega"], s["omega_dt"], *loads.integrals({**s, "i": s["v"]}, unit)], s["v_dt"])
            for s in signals]
    two = _solve(rows, ["slope", "gain", *loads.loads], {})
    r = held.get("R", 1.0)
    k = held.get("K", back_emf * two["gain"])
    b = held.get("b", max(two["gain"] - k, 0.05 * two["gain"]) * k / r)
    dt = float(np.median(np.diff(signals[0]["t"])))
    return loads.split(two, k / r) | {"R": r, "L": r * dt, "K": k, "b": b, "J": held.get("J", two["slope"] * k / r)}


def _without_speed(signals: list[dict], held: Mapping[str, float]) -> dict[str, float]:
    """``∫v = L i + (R + Lb/J)∫i + (K² + Rb)/J ∬i − (b/J) ∬v``: K alone is assumed."""
    rows = [_windowed([s["i"], s["i_dt"], integral(s["t"], s["i_dt"]), -integral(s["t"], s["v_dt"])], s["v_dt"])
            for s in signals]
    z = _solve(rows, ["L", "R", "stiff", "rate"], {})
    k = held.get("K", 0.05)
    j = k**2 / max(z["stiff"] - z["R"] * z["rate"], 0.1 * z["stiff"])
    least = FASTEST * z["R"] * min(float(np.median(np.diff(s["t"]))) for s in signals)
    return {"R": z["R"], "L": max(z["L"], least), "K": k, "J": j, "b": z["rate"] * j}


class Load(NamedTuple):
    """One size to be found: a parameter, or with `phase` its part at that phase angle."""

    name: str
    phase: str = ""
    angle: float = 0.0
    signed: bool = False  # it may be negative
    ratio: bool = False  # a share of the motor's torque, not a torque


def loads_of(model: Model) -> tuple[Load, ...]:
    """Return what can be found: sizes of torque effects that vanish at zero and were not given."""
    found = []
    for e in model.effects:
        pars = [model.parameters[p.name] for p in e.parameters]
        if e.balance != "torque" or any(p.order and not p.given for p in pars):
            continue
        phases = [p.name for p in pars if p.periodic and p.vary and not p.given]
        for p in (p for p in pars if p.null == 0 and p.vary and not p.given):
            parts = [(phases[0], 0.0), (phases[0], np.pi / 2)] if len(phases) == 1 else [("", 0.0)]
            found += [Load(p.name, *part, len(phases) == 1 or p.lower < 0, p.unit == "") for part in parts]
    return tuple(found)


class _Loads(NamedTuple):
    """The model's torques to be found along with the motor."""

    model: Model
    loads: tuple[Load, ...]

    def integrals(self, s: Mapping[str, Array], base: Mapping[str, float]) -> list[Array]:
        """Return the integral over time of the torque against the motion per unit of each load, along the signals `s`.
        `base` are the values of the base parameters; those of effects are taken at their null, shapes as they are."""
        if not self.loads:
            return []
        system, zero = self.model.system(("omega",)), np.zeros(len(s["v"]))
        along = {**s, "theta": s.get("theta", s["omega_dt"])}
        x = np.vstack([along.get(n, zero) for n in system.states])
        u = np.vstack([along["theta" if n == "theta_in" else n] for n in system.inputs])
        quiet = {n: base.get(n, p.value if p.null is None else p.null) for n, p in self.model.parameters.items()}
        quiet["sgn_width"] = WIDE * float(np.max(np.abs(s["omega"]), initial=0.0)) or 1.0

        def torque(changes: Mapping[str, float]) -> Array:
            return np.asarray(system.balances(x, u, np.array([{**quiet, **changes}[n] for n in system.parameters])))[1]

        silence = torque({})
        acts = [silence - torque({load.name: 1.0} | ({load.phase: load.angle} if load.phase else {}))
                for load in self.loads]  # a unit of what divides by it may be no motor
        return [integral(s["t"], act if np.isfinite(act).all() else zero) for act in acts]

    def split(self, sizes: Mapping[Any, float], per_ratio: float = 1.0) -> dict[str, float]:
        """Return the motor's values, and the parameters of the loads; `per_ratio` turns their sizes into torques."""
        found: dict[str, float] = {}
        for load in self.loads:
            unit = 1.0 if load.ratio else per_ratio
            if not load.phase:
                found[load.name] = sizes[load] * unit
            elif load.angle == 0.0:
                size, other = sizes[load] * unit, sizes[load._replace(angle=np.pi / 2)] * unit
                found |= {load.name: float(np.hypot(size, other)), load.phase: float(np.arctan2(other, size))}
        phases = {load.phase for load in self.loads}
        found = {n: v for n, v in found.items() if v != 0.0 or n in phases}
        return found | {n: v for n, v in sizes.items() if isinstance(n, str)}


def with_start_values(problem: Problem) -> Problem:
    """Return the problem with values that suit the data. From a guess that takes all friction for viscous, bristles or
    a Stribeck curve find no way; Coulomb does: what contains simpler ones races against where the simpler one leads."""
    begin, simpler, inner = _guessed(problem), problem.model, _contained(problem.model)
    try:
        for effect, simple in inner.items():
            simpler = simpler.without(effect.name) + simple
    except ModelError:  # two of them contain the same
        inner = {}
    if not inner:
        return _shared_out(begin, problem.model)
    found = race([_shared_out(_guessed(problem.for_model(simpler)), simpler)], RACE, solve=by_continuation)
    if found is None:
        return begin
    values = found.values
    for effect, simple in inner.items():
        values |= sizes_like(effect, max(found.values[p.name] for p in simple.parameters))
    return _led(begin, race([begin, begin.start_at(values)], LOOK))


def _guessed(problem: Problem) -> Problem:
    """Return the problem at the best of a few guesses, and of the shapes of its effects."""
    model, runs = problem.model, problem.experiments
    candidates = [model.start_at(first_guess(model, runs))]
    if any(p.given for p in model.parameters.values()) or _was_fitted(model):
        candidates.append(model)
    if any(e.balance == "torque" for e in model.effects):
        candidates.append(model.start_at(first_guess(model, runs, loaded=True)))
    problems = [problem.for_model(with_suited_effects(m, runs)) for m in candidates]
    best = problems[0] if len(problems) == 1 else min(problems, key=lambda p: cost_at(p, refine=False))
    asked = candidates[problems.index(best)]
    return _shaped(_along_measured_angle(_better_than_still(best), asked), asked)


def _better_than_still(guess: Problem) -> Problem:
    """Return the problem at its guess, or where that costs more than to predict nothing (an arm without its weight
    swings where the real one hangs) at the better of what it and a motor that friction all but stops lead to."""
    values, b = guess.model.values, guess.model.parameters["b"]
    nothing = 0.5 * sum(float(np.nansum((m.y * m.weights) ** 2)) for m in guess.measured)
    if b.given or not b.vary or cost_at(guess, refine=False) < nothing:
        return guess
    still = guess.start_at({"b": STOPPED * (b.value + values.get("K", 0.0) ** 2 / values.get("R", 1.0))})
    return _led(guess, race([p.within_worth() for p in (guess, still)], LOOK))


def _was_fitted(model: Model) -> bool:
    return any((now := model.parameters[p.name]).value != p.value and not now.given for p in BASES[model.base])


def with_suited_effects(model: Model, runs: Sequence[Experiment]) -> Model:
    """Return the model with starting values of its effects' parameters that suit the data."""
    sizes = natural_sizes(runs, model.values)
    untouched = (p for e in model.effects for p in _untouched(model, e))
    return model.start_at({p.name: suited(p, sizes).value for p in untouched})


def _untouched(model: Model, effect: Effect) -> list[Parameter]:
    """Parameters of an effect that still have the value they were declared with."""
    return [now for p in effect.parameters if (now := model.parameters[p.name]).value == p.value and not now.given]


def _along_measured_angle(problem: Problem, asked: Model) -> Problem:
    """Return the problem started where the measured angle, or the integral of the speed, leads an effect of the turn.
    While the model's own angle is still wrong by a period, its cogging pushes the wrong way."""
    orders = any(p.order for e in problem.model.effects for p in e.parameters)
    if not orders or not all({"theta", "omega"} & set(r.outputs) for r in problem.experiments):
        return problem
    led = _shaped(problem.for_model(problem.model.with_(angle_input=True)), asked)
    if (found := race([led], RACE, solve=by_continuation)) is None:
        return problem
    other = problem.start_at(found.values)
    if all("theta" in r.outputs for r in problem.experiments):
        return min(other, problem, key=lambda p: cost_at(p, refine=False))
    # An integral drifts: where either leads decides.
    return _led(problem, race([other, problem], RACE, solve=by_continuation))


def _shaped(problem: Problem, asked: Model) -> Problem:
    """Return the problem started at the best shapes of each effect in turn: phases and resonances have side valleys."""
    for effect in problem.model.effects:
        sizes, axes = natural_sizes(problem.experiments, problem.model.values), {}
        for p in _untouched(asked, effect):
            if (not p.vary and len(p.grid) > 1) or (p.vary and (p.periodic or p.place or p.unit == RESONANCE)):
                axes[p.name] = np.clip(PHASES if p.periodic else shapes_of(p, sizes), p.lower, p.upper).tolist()
        if len(shapes := combined(axes)) > 1:
            problem = _led(problem, race([problem.start_at(s) for s in shapes], LOOK))
    return problem


def _led(problem: Problem, best: Estimate | None) -> Problem:
    """Return the problem begun where a race ended, unless it got there only by steps too coarse to see it diverge."""
    led = problem if best is None else problem.start_at(best.values)
    return led if np.isfinite(cost_at(led)) else problem


def exchanged_poles(model: Model, effect: Effect) -> list[dict[str, float]]:
    """Return the starts at which a lag of an effect has changed places with the winding's own, L/R, or the motor's, and
    is nearly as long as that: half as long it would be where the one valley ends and the other begins."""
    free = {n for n, p in model.parameters.items() if p.vary and not p.given}
    lags = [p.name for p in effect.parameters if p.pole and p.name in free]
    at = {n: p.value for n, p in model.parameters.items()}
    coupling = at["K"] ** 2 / at["R"] if {"K", "R"} <= at.keys() else 0.0
    own = {n: at[n] / by for n, by in (("L", at.get("R", 0.0)), ("J", coupling + at.get("b", 0.0))) if n in free and by}
    return [{lag: (1 - LEFT) * time, n: LEFT * at[n]} for lag in lags for n, time in own.items()]


def _contained(model: Model) -> dict[Effect, Effect]:
    """Return the simplest effect that each of the model's effects contains, where it does and has nothing set."""
    found: dict[Effect, Effect] = {}
    for effect in model.effects:
        inside = (LIBRARY[n] for n in effect.includes if n in LIBRARY)  # a user's effect may contain another of theirs
        simple = next((e for e in inside if all(p.null == 0 for p in e.parameters)), None)
        taken = {*model.effect_names, *(e.name for e in found.values())}
        if simple and simple.name not in taken and len(_untouched(model, effect)) == len(effect.parameters):
            found[effect] = simple
    return found


def sizes_like(effect: Effect, level: float, above: float = ABOVE) -> dict[str, float]:
    """Return the sizes of an effect in the place of one of size `level`; those at least another start `above` it."""
    return {p.name: level * (above if p.at_least else 1.0) for p in effect.parameters if p.null == 0 and p.vary}


def _shared_out(problem: Problem, asked: Model) -> Problem:
    """Return the problem with back-EMF and viscous friction shared out as suits the data best. Without a current a
    linear motor leaves this open; a loss that is a share of the motor's torque does not."""
    model, runs = problem.model, problem.experiments
    open_ = model.base == "dc_motor" and "i" not in problem.outputs and not _was_fitted(asked)
    if not open_ or asked.parameters["K"].given or not any(load.ratio for load in loads_of(asked)):
        return problem
    others = [problem.start_at(first_guess(asked, runs, loaded=True, back_emf=share)) for share in BACK_EMF_SHARES]
    return _led(problem, race([p.for_model(p.model.fix("R")) for p in (problem, *others)], RACE, solve=by_continuation))
