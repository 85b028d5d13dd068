"""A first guess of the motor, and of the loads on it, from the data alone.

The balances are integrated over time, so nothing is differentiated, and solved as non-negative linear least squares:
``∫v dt = L Δi + R ∫i dt + K ∫ω dt`` and ``K ∫i dt = J Δω + b ∫ω dt`` (Garnier & Wang, Identification of Continuous-time
Models from Sampled Data, 2008, ch. 1). A current or a speed that was not measured is eliminated; what no record tells
is taken as given, or round. Torques of the model's effects are further columns."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motorid.channels import CHANNELS, COMPUTED_INPUTS
from motorid.model.model import Model, dc_motor
from motorid.numerics.signals import Array, bridged, integral, slope
from motorid.problem.runs import time_since
from motorid.records.experiment import Experiment

BASE = ("R", "L", "K", "b", "J", "g")
BACK_EMF = 0.9
FLOOR = 1e-3  # share of its natural size given to a parameter that comes out as zero
FASTEST = 0.2  # samples, L/R at least: of a current alone, from below the inductance has a valley of its own


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


WIDE = 0.02  # width of sgn over the highest speed: a measured speed is noise around standstill


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
