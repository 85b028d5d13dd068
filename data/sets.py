"""The shipped sets: what is driven how, what is hidden in it, what the logger writes."""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np
import plant as P

Files = dict[str, str]  # name of a run -> text of its file
RPM = 60 / (2 * np.pi)  # 1 rad/s
SETS: dict[str, Callable[[], tuple[Files, dict]]] = {}


def _set(make: Callable[[], tuple[Files, dict]]) -> Callable[[], tuple[Files, dict]]:
    SETS[make.__name__] = make
    return make


def table(columns: dict[str, tuple[np.ndarray, str]], comments: tuple[str, ...] = (), sep: str = ",") -> str:
    """Text of a table: header -> (values, format); NaN becomes an empty cell."""
    out = io.StringIO()
    for line in comments:
        out.write(f"# {line}\n")
    out.write(sep.join(columns) + "\n")
    for row in zip(*(values for values, _ in columns.values()), strict=True):
        cells = (_cell(x, form) for x, (_, form) in zip(row, columns.values(), strict=True))
        out.write(sep.join(cells) + "\n")
    return out.getvalue()


def _cell(x: float, form: str) -> str:
    return "" if np.isnan(x) else format(x + 0.0, form)


def record(r: dict, current: np.ndarray, speed: np.ndarray, **more: tuple[np.ndarray, str]) -> str:
    """Table of the usual four columns at 1 kHz, and `more`."""
    usual = {
        "time_s": (r["t"], ".3f"),
        "voltage_V": (r["v"], ".5g"),
        "current_A": (current, ".4f"),
        "speed_rad_s": (speed, ".3f"),
    }
    return table(usual | more)


def facts(motor: P.Motor, effects: dict, seed: int | None, sigma: dict[str, float], **more: object) -> dict:
    """What truth.json says of one set."""
    return {
        "motor": motor.name,
        "parameters": {k: getattr(motor, k) for k in ("R", "L", "K", "b", "J")},
        "effects": effects,
        "sigma": sigma,
        "seed": seed,
        **more,
    }


# ---------------------------------------------------------------- sets


@_set
def two_step() -> tuple[Files, dict]:
    """Two noise-free voltage steps of the plain motor, exact to twelve digits."""
    motor, files = P.MOTORS["lab"], {}
    for level in (6, 8):
        r = P.simulate_linear(motor, *P.step(level))
        files[f"step_{level}V"] = table({
            "t_s": (r["t"], ".3f"),
            "voltage_V": (r["v"], "g"),
            "current_A": (r["i"], ".12g"),
            "speed_rad_s": (r["omega"], ".12g"),
        })
    return files, facts(motor, {}, None, {})


@_set
def two_step_noisy() -> tuple[Files, dict]:
    """Two steps of the same plain motor through a real logger: noise, 12-bit current and speed."""
    seed, motor, sigma = 11, P.MOTORS["lab"], {"i": 0.02, "omega": 0.4}
    rng, files = np.random.default_rng(seed), {}
    for k, level in enumerate((6, 8), start=1):
        r = P.simulate(motor, {}, *P.step(level))
        header = {
            "time_s": (r["t"], ".3f"),
            "Voltage (V)": (r["v"], "g"),
            "Current (A)": (P.adc(P.white(r["i"], sigma["i"], rng), 10.0), ".4f"),
            "Speed (rad/s)": (P.adc(P.white(r["omega"], sigma["omega"], rng), 400.0), ".3f"),
        }
        files[f"run{k}"] = table(header, (f"teaching bench, step to {level} V", "logger at 1 kHz, 12 bit"))
    return files, facts(motor, {}, seed, sigma, adc={"bits": 12, "full_scale": {"i": 10.0, "omega": 400.0}})


@_set
def two_step_small() -> tuple[Files, dict]:
    """Two steps of a coreless motor 200 times lighter, in mA and rpm; noise and quantisation."""
    seed, motor, sigma = 12, P.MOTORS["micro"], {"i": 1.5e-3, "omega": 3.0}
    rng, files = np.random.default_rng(seed), {}
    for k, level in enumerate((3, 5), start=1):
        r = P.simulate(motor, {}, *P.step(level, duration=0.6))
        header = {
            "t_ms": (r["t"] * 1e3, ".0f"),
            "voltage_V": (r["v"], "g"),
            "current_mA": (P.adc(P.white(r["i"], sigma["i"], rng), 1.0) * 1e3, ".3f"),
            "speed_rpm": (P.white(r["omega"], sigma["omega"], rng) * RPM, ".0f"),
        }
        files[f"run{k}"] = table(header, (f"coreless motor, {level} V",))
    return files, facts(motor, {}, seed, sigma, adc={"bits": 12, "full_scale": {"i": 1.0}})


@_set
def clean() -> tuple[Files, dict]:
    """Nothing hidden: the plain motor with noise, the speed's noise coloured."""
    seed, motor, sigma = 13, P.MOTORS["lab"], {"i": 0.01, "omega": 0.2}
    rng = np.random.default_rng(seed)
    excitations = {
        "run1": P.staircase([4, -2, 2, -4, 1, 0], 0.25),
        "run2": P.prbs(3.0, 1.5, 0.04, rng),
        "check1": P.multisine(4.0, 1.5, [0.7, 2.1, 5.1, 9.7, 17.3], rng),
    }
    files = {}
    for name, (t, v) in excitations.items():
        r = P.simulate(motor, {}, t, v)
        speed = P.coloured(r["omega"], sigma["omega"], 0.8, rng)
        files[name] = record(r, P.white(r["i"], sigma["i"], rng), speed)
    return files, facts(motor, {}, seed, sigma, speed_noise_correlation=0.8)


@_set
def hidden_friction() -> tuple[Files, dict]:
    """Dry friction, seen in reversals and at low speed."""
    seed, motor, effects = 20, P.MOTORS["lab"], {"coulomb": {"tau_c": 8.0e-3}}
    rng, sigma = np.random.default_rng(seed), {"i": 0.004, "omega": 0.15}
    excitations = {
        "run1": P.staircase([2, -1, 1, -2, 0.6, 0], 0.3),
        "run2": P.triangle(1.5, 2.0, 1.0),
        "check1": P.multisine(2.2, 1.5, [0.7, 1.9, 3.1, 5.3, 8.7], rng),
    }
    files = {}
    for name, (t, v) in excitations.items():
        r = P.simulate(motor, effects, t, v)
        current = P.adc(P.white(r["i"], sigma["i"], rng), 8.0)
        files[name] = record(r, current, P.white(r["omega"], sigma["omega"], rng))
    return files, facts(motor, effects, seed, sigma, adc={"bits": 12, "full_scale": {"i": 8.0}})


@_set
def hidden_heating() -> tuple[Files, dict]:
    """A machine axis in heavy use for a minute: the winding gets warm; every run starts cold."""
    seed, motor, sigma = 21, P.MOTORS["big"], {"i": 0.1, "omega": 0.2}
    effects = {"winding_heating": {"R_th": 2.0, "C_th": 14.0, "alpha": 0.00393}}
    rng = np.random.default_rng(seed)
    excitations = {
        "run1": P.warm_up(20.0, 60.0, dt=0.01, period=30.0, duty=0.7),
        "run2": P.random_steps(36.0, 50.0, 0.5, rng, dt=0.01),
        "check1": P.prbs(18.0, 50.0, 0.35, rng, dt=0.01),
    }
    files = {}
    for name, (t, v) in excitations.items():
        r = P.simulate(motor, effects, t, v, substep=2e-4)
        header = {
            "time_s": (t, ".2f"),
            "voltage_V": (v, ".5g"),
            "current_A": (P.white(r["i"], sigma["i"], rng), ".2f"),
            "speed_rad_s": (P.white(r["omega"], sigma["omega"], rng), ".2f"),
        }
        files[name] = table(header, ("machine axis, cold start, 100 Hz",))
    return files, facts(motor, effects, seed, sigma)


@_set
def hidden_cogging() -> tuple[Files, dict]:
    """Twelve detents per turn, with an encoder of 4096 counts per turn."""
    seed, motor, sigma = 22, P.MOTORS["lab"], {"i": 0.006, "omega": 0.15}
    effects = {"cogging": {"A": 5.0e-3, "N": 12, "phi": 0.7}}
    rng = np.random.default_rng(seed)
    excitations = {
        "run1": P.staircase([1.2, 0.5, -0.5, -1.5, 2.5, 0], 0.3),
        "run2": P.triangle(2.0, 2.0, 1.6),
        "check1": P.random_steps(2.0, 1.5, 0.15, rng),
    }
    files = {}
    for name, (t, v) in excitations.items():
        r = P.simulate(motor, effects, t, v, theta0=-0.7 / 12)  # at rest in a detent
        current, speed = P.white(r["i"], sigma["i"], rng), P.white(r["omega"], sigma["omega"], rng)
        files[name] = record(r, current, speed, angle_deg=(np.degrees(P.encoder(r["theta"], 4096)), ".3f"))
    return files, facts(motor, effects, seed, sigma, encoder_counts=4096)


@_set
def hidden_brush() -> tuple[Files, dict]:
    """Carbon brushes on a small motor: a contact voltage that saturates; in mA and rpm."""
    seed, motor, sigma = 23, P.MOTORS["micro"], {"i": 1.0e-3, "omega": 2.0}
    effects = {"brush_drop": {"V_b": 0.5, "i_b": 0.025}}
    rng = np.random.default_rng(seed)
    excitations = {
        "run1": P.staircase([3, -1.5, 1.5, -3, 0.8, 0], 0.2),
        "run2": P.triangle(2.5, 1.2, 0.3),
        "check1": P.multisine(3.0, 1.2, [1.3, 3.1, 7.7, 13.1], rng),
    }
    files = {}
    for name, (t, v) in excitations.items():
        r = P.simulate(motor, effects, t, v)
        header = {
            "t_ms": (t * 1e3, ".0f"),
            "voltage_V": (v, ".5g"),
            "current_mA": (P.white(r["i"], sigma["i"], rng) * 1e3, ".2f"),
            "speed_rpm": (P.white(r["omega"], sigma["omega"], rng) * RPM, ".0f"),
        }
        files[name] = table(header, ("carbon brushes, shunt amplifier and tacho",))
    return files, facts(motor, effects, seed, sigma)


@_set
def hidden_coast() -> tuple[Files, dict]:
    """A hobby driver: at command 0 it opens its bridge, and the motor coasts instead of braking."""
    seed, motor, sigma = 26, P.MOTORS["lab"], {"i": 0.02, "omega": 0.3}
    effects = {"driver_coast": {"V_c": 8.4}}
    rng = np.random.default_rng(seed)
    excitations = {
        "run1": P.staircase([4, 0, 7, 0, -3, 0, -6, 0, 2, 0], 0.16),
        "run2": P.staircase([6, -4, 0, 5, 0, -7, 0, 3, -2, 0], 0.16),
        "check1": P.staircase([-5, 0, 2.5, 6, 0, -3, 0, 4.5, 0], 0.16),
    }
    files = {}
    for name, (t, v) in excitations.items():
        r = P.simulate(motor, effects, t, v)
        header = {
            "t_ms": (t * 1e3, ".0f"),
            "command_V": (v, ".5g"),
            "motor_current_mA": (P.white(r["i"], sigma["i"], rng) * 1e3, ".0f"),
            "speed_rpm": (P.white(r["omega"], sigma["omega"], rng) * RPM, ".0f"),
        }
        files[name] = table(header, ("toy car driver, 2 lithium cells; a command of 0 is 'stop'",))
    return files, facts(motor, effects, seed, sigma)


@_set
def hidden_sag() -> tuple[Files, dict]:
    """A cart on a tired battery: behind the bridge its voltage falls with the current it gives."""
    seed, motor, sigma = 27, P.MOTORS["wheel"], {"i": 0.1, "omega": 0.5}
    effects = {"supply_sag": {"R_s": 0.14, "V_s": 12.0}}
    rng = np.random.default_rng(seed)
    excitations = {
        "run1": P.staircase([6, 12, 3, -5, -12, -2, 9, 0], 0.35),
        "run2": P.triangle(12.0, 2.4, 1.2),
        "check1": P.random_steps(12.0, 2.4, 0.2, rng),
    }
    files = {}
    for name, (t, v) in excitations.items():
        r = P.simulate(motor, effects, t, v)
        files[name] = record(r, P.white(r["i"], sigma["i"], rng), P.white(r["omega"], sigma["omega"], rng))
    return files, facts(motor, effects, seed, sigma)


@_set
def hidden_two() -> tuple[Files, dict]:
    """An arm on a geared servo under position control: gravity and dry friction together."""
    seed, motor, sigma = 24, P.MOTORS["servo"], {"i": 0.008, "omega": 0.03}
    effects = {"gravity": {"mgl": 0.22, "phi_g": 0.0}, "coulomb": {"tau_c": 0.05}}
    rng = np.random.default_rng(seed)
    t, gains = np.arange(2400) * 1e-3, {"kp": 9.0, "kd": 0.25}
    references = {
        "run1": 2.0 * P.staircase([0.6, -0.5, 1.0, -1.0, 0.2, 0.7], 0.4)[1][:2400],
        "run2": P.triangle(2.2, 2.4, 2.0)[1],
        "check1": P.multisine(1.8, 2.4, [0.4, 0.9, 1.7, 2.9], rng)[1],
    }
    files = {}
    for name, reference in references.items():
        loop = P.closed_loop(P.Plant(motor, effects), reference, gains)
        r = P.simulate(motor, effects, t, np.round(loop["v"], 4))  # what these very voltages do
        current, speed = P.white(r["i"], sigma["i"], rng), P.white(r["omega"], sigma["omega"], rng)
        files[name] = record(r, current, speed, angle_rad=(P.encoder(r["theta"], 16384), ".5f"))
    return files, facts(motor, effects, seed, sigma, encoder_counts=16384, closed_loop=gains)


@_set
def hidden_unknown() -> tuple[Files, dict]:
    """A cam that presses a spring once per turn: outside the library of effects."""
    seed, motor, sigma = 25, P.MOTORS["lab"], {"i": 0.006, "omega": 0.15}
    effects = {"cam": {"A": 2.0e-2, "kappa": 6.0, "phi": -2.0}}
    rng = np.random.default_rng(seed)
    excitations = {
        "run1": P.staircase([1.5, 0.8, -1.2, -2, 2, 0], 0.3),
        "run2": P.triangle(2.0, 2.0, 1.6),
        "check1": P.random_steps(2.0, 1.5, 0.15, rng),
    }
    files = {}
    for name, (t, v) in excitations.items():
        r = P.simulate(motor, effects, t, v)
        current, speed = P.white(r["i"], sigma["i"], rng), P.white(r["omega"], sigma["omega"], rng)
        files[name] = record(r, current, speed, angle_rad=(P.encoder(r["theta"], 4096), ".5f"))
    return files, facts(motor, effects, seed, sigma, encoder_counts=4096)
