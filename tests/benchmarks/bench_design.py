"""What designed records are worth on the independent plant: ``python tests/benchmarks/bench_design.py groups|sharpen``.

`groups`: motors with one hidden effect whose first, gentle record leaves a group of rivals. One designed record against
the best of the eight fixed candidates (as expected beforehand), scaled to the same limits, at equal duration: is the
true effect better than every rival of the group, by the predictive score on old and new records? Were limits broken on
the true plant, noise included?

`sharpen`: drawn motors, deviation of the asked parameters over repeated noise (Monte Carlo), designed and fixed.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

import motorid as mi
from motorid.diagnosis import experiment_design as ed
from motorid.diagnosis.model_comparison import beats, node_of
from motorid.diagnosis.predictive_score import HeldOut, predictions_left_out
from motorid.records.datasets import load_plant

PLANT = load_plant()
DT, DURATION, SUBSTEP = 1e-3, 2.0, 50e-6
TRUTHS: dict[str, Any] = {  # sizes from the motor's own scales: s stall torque, w no-load speed, V, tau_m
    "coulomb": lambda m, s, w: {"tau_c": 0.03 * s},
    "constant_load": lambda m, s, w: {"tau_0": 0.03 * s},
    "brush_drop": lambda m, s, w: {"V_b": 0.04 * m.v_max, "i_b": 0.02 * m.v_max / m.R},
    "driver_dead_band": lambda m, s, w: {"V_d": 0.04 * m.v_max},
    "voltage_offset": lambda m, s, w: {"V_0": 0.03 * m.v_max},
    "stribeck": lambda m, s, w: {"tau_c": 0.03 * s, "tau_s": 0.05 * s, "omega_s": 0.03 * w},
    "load_friction": lambda m, s, w: {"mu": 0.1},
    "quadratic_drag": lambda m, s, w: {"c_2": 0.1 * s / w**2},
    "magnetic_saturation": lambda m, s, w: {"i_K": 0.8 * m.v_max / m.R},
    "winding_heating": lambda m, s, w: {"R_th": 30 * m.R / m.v_max**2 * 4, "C_th": m.v_max**2 / m.R / 100},
    "speed_lag": lambda m, s, w: {"T_w": 0.15 * m.R * m.J / m.K**2},
    "speed_delay": lambda m, s, w: {"T_d": 0.15 * m.R * m.J / m.K**2},
    "current_offset": lambda m, s, w: {"i_0": 0.02 * m.v_max / m.R},
}
ASKED = (("R", "L", "K", "b", "J", "tau_c"), ("tau_c", "b"), ("R", "L"), ("J",), ("K",))
MOTORS = ("lab", "micro", "wheel", "servo")


def noises(motor: Any) -> dict[str, float]:
    """Noise of the sensors, SI: half a per cent of a bench's range."""
    return {"i": 0.005 * min(motor.i_max, motor.v_max / motor.R), "omega": 0.005 * motor.no_load_speed}


def played(motor: Any, effects: dict, t: np.ndarray, v: np.ndarray, rng: np.random.Generator, name: str) -> tuple:
    """The record that a bench would give of this voltage, and the truth behind it."""
    true = PLANT.simulate(motor, effects, t, v, substep=SUBSTEP)
    outputs = {c: true[c] + s * rng.standard_normal(len(t)) for c, s in noises(motor).items()}
    return mi.Experiment(t, {"v": v}, outputs, name=name), true


def first_record(motor: Any, effects: dict, rng: np.random.Generator) -> mi.Experiment:
    """A gentle run: smooth, one direction, from a third to half of the voltage."""
    t = DT * np.arange(1200)
    v = np.round(motor.v_max * (0.4 + 0.1 * np.sin(2 * np.pi * t / 0.6)) * np.minimum(t / 0.2, 1.0), 4)
    return played(motor, effects, t, v, rng, "first")[0]


def tied(fits: dict[str, mi.Fit], truth: str) -> list[str]:
    """The truth, and the effects that the records cannot tell from it by the predictive score."""
    nodes = {n: node_of(f, HeldOut.of(f, None)) for n, f in fits.items() if predictions_left_out(f) is not None}
    return [truth] + [n for n in nodes if n != truth and truth in nodes and truth not in mi.effects.get(n).includes
                      and not beats(nodes[truth], nodes[n])]


def case(name: str, truth: str, seed: int) -> dict[str, Any] | None:
    """One motor and hidden effect: which records distinguish it; None where the first one does already."""
    rng, motor = np.random.default_rng([seed, len(truth)]), PLANT.MOTORS[name]
    motor = replace(motor, **{k: getattr(motor, k) * float(rng.uniform(0.9, 1.1)) for k in "RLKbJ"})
    stall, speed = motor.K * motor.v_max / motor.R, motor.no_load_speed
    effects = {truth: TRUTHS[truth](motor, stall, speed)}
    first = first_record(motor, effects, rng)
    fits = {n: mi.fit(mi.dc_motor() + mi.effects.get(n), [first]) for n in TRUTHS}
    group = tied(fits, truth)[:ed.MOST_RIVALS]
    if len(group) < 2:
        return None
    limits = {"v_max": 0.8 * motor.v_max, "i_max": 0.6 * min(motor.i_max, motor.v_max / motor.R),
              "omega_max": 0.7 * speed}
    began = time.process_time()
    design = mi.design_experiment([fits[n] for n in group], duration=DURATION, dt=DT, **limits)
    seconds = time.process_time() - began
    voltages = {"designed": design.v, "fixed": design.v_fixed}
    found: dict[str, Any] = {"case": f"{name} {truth}", "group": group, "seconds": seconds, "fixed": design.fixed,
                             "resolved": {}}
    for record, v in voltages.items():
        t = DT * np.arange(len(v))
        run, true = played(motor, effects, t, v, rng, "next")
        both = {n: mi.fit(mi.dc_motor().start_at(fits[n].values) + mi.effects.get(n), [first, run]) for n in group}
        found["resolved"][record] = tied(both, truth) == [truth]
        if record == "designed":
            found["broken"] = [c for c, limit in (("i", limits["i_max"]), ("omega", limits["omega_max"]))
                               if max(np.abs(true[f"true_{c}"]).max(), np.abs(run.outputs[c]).max()) > limit]
            found["reach"] = {c: float(np.abs(true[f"true_{c}"]).max() / limits[f"{c}_max"]) for c in ("i", "omega")}
            found["nats"] = min(n for _, n in design.evidence.values())
    return found


def groups(motors: Sequence[str] = MOTORS, truths: Sequence[str] = tuple(TRUTHS), seed: int = 1) -> list[dict]:
    """Run all cases and print them."""
    found = []
    for name in motors:
        for truth in truths:
            one = case(name, truth, seed)
            if one is None:
                print(f"{name} {truth}: no group", flush=True)
                continue
            found.append(one)
            done, reach = one["resolved"], one["reach"]
            print(f"{one['case']}: group {', '.join(one['group'])}; designed {done['designed']} ({one['nats']:.3g} "
                  f"nats expected, {one['seconds']:.1f} s), {one['fixed']} {done['fixed']}; "
                  f"broken {one['broken'] or 'none'}, reach {reach['i']:.2f} {reach['omega']:.2f}", flush=True)
    names = sorted({k for f in found for k in f["resolved"]})
    for n in names:
        done = [f["resolved"].get(n, False) for f in found]
        print(f"{n}: resolved {sum(done)} of {len(done)}")
    print(f"limits broken in {sum(bool(f['broken']) for f in found)} of {len(found)}; "
          f"processor time median {np.median([f['seconds'] for f in found]):.1f} s, "
          f"largest {max(f['seconds'] for f in found):.1f} s")
    return found


def sharpened(name: str, seed: int, asked: Sequence[str], draws: int = 12) -> dict[str, Any]:
    """Deviation of the asked parameters after one more record, by Monte Carlo and as predicted; over their values."""
    rng, motor = np.random.default_rng([seed, 7]), PLANT.MOTORS[name]
    motor = replace(motor, **{k: getattr(motor, k) * float(rng.uniform(0.7, 1.4)) for k in "RLKbJ"})
    tau = 0.03 * motor.K * motor.v_max / motor.R
    effects, truth = {"coulomb": {"tau_c": tau}}, {k: getattr(motor, k) for k in "RLKbJ"} | {"tau_c": tau}
    model = mi.dc_motor() + mi.effects.coulomb
    first = first_record(motor, effects, rng)
    fit = mi.fit(model, [first])
    limits = {"v_max": 0.8 * motor.v_max, "i_max": 0.6 * min(motor.i_max, motor.v_max / motor.R),
              "omega_max": 0.7 * motor.no_load_speed}
    began = time.process_time()
    design = mi.design_experiment(fit, goal="sharpen", parameters=asked, duration=DURATION, dt=DT, **limits)
    found: dict[str, Any] = {"case": f"{name} {seed}", "fixed": design.fixed, "seconds": time.process_time() - began}
    predicted = next(iter(design.deviations.values()))
    for place, (record, v) in enumerate((("fixed", design.v_fixed), ("designed", design.v)), start=1):
        t = DT * np.arange(len(v))
        pair = [(run, PLANT.simulate(motor, effects, run.t, run.inputs["v"], substep=SUBSTEP))
                for run in (first, first.with_(t=t, inputs={"v": v}, outputs={"i": v, "omega": v}))]
        errors = []
        for _ in range(draws):
            both = [run.with_(outputs={c: true[c] + s * rng.standard_normal(run.n) for c, s in noises(motor).items()})
                    for run, true in pair]
            values = mi.fit(model.start_at(fit.values), both).values
            errors.append([values[p] / truth[p] - 1 for p in asked])
        found[record] = float(np.exp(np.mean(np.log(np.std(errors, axis=0) + 1e-12))))
        found[f"{record} predicted"] = float(np.exp(np.mean([np.log(predicted[p][place] / truth[p]) for p in asked])))
    return found


if __name__ == "__main__":
    if sys.argv[1:2] == ["groups"]:
        groups(*([sys.argv[2].split(",")] if len(sys.argv) > 2 else []))
    elif sys.argv[1:2] == ["sharpen"]:
        every = []
        for which in range(int(sys.argv[2]) if len(sys.argv) > 2 else 20):
            one = sharpened(MOTORS[which % 4], which, ASKED[which // 4 % len(ASKED)])
            every.append(one)
            print({k: v if isinstance(v, str) else float(f"{v:.3g}") for k, v in one.items()}, flush=True)
        for what, over, under in (("fixed over designed, achieved", "fixed", "designed"),
                                  ("fixed over designed, predicted", "fixed predicted", "designed predicted"),
                                  ("achieved over predicted, designed", "designed", "designed predicted"),
                                  ("achieved over predicted, fixed", "fixed", "fixed predicted")):
            q = np.quantile([one[over] / one[under] for one in every], [0.25, 0.5, 0.75])
            print(f"{what}: quartiles {q[0]:.2f} {q[1]:.2f} {q[2]:.2f}")
        print(f"processor time largest {max(one['seconds'] for one in every):.1f} s")
    else:
        print(__doc__)
