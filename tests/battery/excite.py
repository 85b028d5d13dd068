"""What the cases of the battery share: how a motor is driven, and what its sensors make of it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from motorid.records.datasets import load_plant
from motorid.records.experiment import Experiment

P = load_plant()
DT = {"micro": 1e-3, "lab": 1e-3, "servo": 2e-3, "wheel": 2e-3, "big": 1e-3}
STAIRS = np.array([0.5, 1, 0.25, -0.4, -1, -0.2, 0.3, 0.12, -0.12, 0.7])
PULSES = np.array([0.6, 0, 1, 0, -0.5, 0, 0.25, 0, -1, 0])
FORWARD = np.array([0.5, 1, 0.35, 0.7, 0.3, 0.9, 0.4, 0.6])


def level(motor) -> float:
    """Voltage at which a reversal just reaches the largest current, V, with four decimals."""
    return round(motor.i_max * motor.R / 2, 4)


def time_constant(motor) -> float:
    """Mechanical time constant, s."""
    return motor.R * motor.J / motor.K**2


def voltages(words: str, motor, n: int, dt: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Time (n,) and voltage (n,) for words such as ``"stairs"`` or ``"prbs 0.8"`` (share of the level)."""
    name, *share = words.split()
    u, T, tau = level(motor) * float((share or ["1"])[0]), n * dt, time_constant(motor)
    onset = 0.02 * T
    make: dict[str, Callable] = {
        "stairs": lambda: P.staircase(u * STAIRS, (T - onset) / len(STAIRS), onset, dt),
        "forward": lambda: P.staircase(u * FORWARD, T / len(FORWARD), 0.0, dt),
        "prbs": lambda: P.prbs(u, T, 3 * tau, rng, dt),
        "hard": lambda: P.prbs(u, T, 1.2 * tau, rng, dt),
        "steps": lambda: P.random_steps(u, T, T / 14, rng, dt),
        "chirp": lambda: P.chirp(u, T, 1.5 / T, min(1 / (np.pi * tau), 0.1 / dt), dt),
        "ramps": lambda: P.triangle(u, T, T / 2.5, dt),
        "multisine": lambda: P.multisine(u, T, np.array([1.3, 2.9, 4.7, 7.9, 12.1]) / T, rng, dt),
        "slow": lambda: P.multisine(u, T, np.array([0.7, 1.3, 2.1]) / T, rng, dt),
        "ternary": lambda: _thirds(P.random_steps(u, T, T / 25, rng, dt), u),
        "pulses": lambda: P.staircase(u * PULSES, (T - onset) / len(PULSES), onset, dt),
        "coast": lambda: P.coast_down(u, 0.4 * T, T, dt),
        "gentle": lambda: _raised(P.multisine(u / 3, T, np.array([0.7, 1.3, 2.1]) / T, rng, dt), 2 * u / 3),
        "waves": lambda: _raised(P.multisine(u / 3, T, np.array([1.3, 2.9, 4.7]) / T, rng, dt), 2 * u / 3),
    }
    t, v = make[name]()
    return t[:n], v[:n]


def _raised(excitation, middle):
    t, v = excitation
    return t, np.round(v + middle, 4)


def _thirds(excitation, u):
    t, v = excitation
    return t, np.round(np.clip(np.round(1.5 * v / u), -1, 1) * u, 4)


MOVING = ("forward", "waves", "gentle")  # never at rest: recorded from when the motor runs


def driven(motor, effects, words: str, n: int, dt: float, rng: np.random.Generator, jitter: float = 0.0) -> dict:
    """What the plant does: open loop, or following random speeds under a PI controller (``"loop"``).

    The controller sees a noisy speed, and what it saw is what was logged.
    """
    if words.split()[0] in MOVING:
        lead = n // 4
        t, v = voltages(words, motor, n, dt, rng)
        t, v = np.arange(n + lead) * dt, np.concatenate([np.full(lead, v[0]), v])
        r = P.simulate(motor, effects, t, v, substep=None)
        return {c: y[lead:] - (y[lead] if c in ("t", "theta") else 0) for c, y in r.items()}
    if not words.startswith("loop"):
        t, v = voltages(words, motor, n, dt, rng)
        return P.simulate(motor, effects, P.uneven(t, jitter, rng) if jitter else t, v, substep=None)
    top = 0.6 * level(motor) / motor.K
    _, reference = P.random_steps(top, n * dt, n * dt / 10, rng, dt)
    gains = {"kp": 1.5 * motor.K, "ki": 1.5 * motor.K / time_constant(motor)}
    noise = {"i": 0.004 * motor.i_max, "omega": 0.006 * top, "theta": 0.0}
    return P.closed_loop(Noisy(motor, effects, noise, rng), reference, gains, dt) | {"noisy": np.ones(1)}


class Noisy(P.Plant):
    """A plant whose sensors are noisy, for whatever listens to them."""

    def __init__(self, motor, effects, noise: dict[str, float], rng: np.random.Generator) -> None:
        super().__init__(motor, effects)
        self.noise, self.rng = noise, rng

    def measured(self) -> dict[str, float]:
        return {c: y + self.noise[c] * self.rng.standard_normal() for c, y in super().measured().items()}


def _rms(x) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


COUNTS = {"coarse": 240}


def count_of(chain: str) -> float:
    """One count of the encoder, rad."""
    return 2 * np.pi / COUNTS.get(chain, 4096)


def sensed(r: dict, chain: str, motor, rng: np.random.Generator, noise: float = 0.01) -> dict[str, np.ndarray]:
    """Current, speed and angle as written by the logger.

    Chains: ``logger`` white noise and a 12-bit converter; ``coloured`` noise of correlation 0.85;
    ``encoder`` of 2000 counts, speed by differences; ``coarse`` the same with 240 counts; ``spikes``.
    """
    if "noisy" in r:
        return {c: r[c] for c in ("i", "omega")} | {"theta": P.encoder(r["theta"], 4096)}
    s = {c: noise * (2 if c == "i" else 1) * _rms(r[c]) for c in ("i", "omega")}
    if chain == "coloured":
        return {c: P.coloured(r[c], s[c], 0.85, rng) for c in s} | {"theta": P.encoder(r["theta"], 4096)}
    counts = COUNTS.get(chain, 4096)
    y = {
        "i": P.adc(P.white(r["i"], s["i"], rng), motor.i_max),
        "omega": P.white(r["omega"], s["omega"], rng),
        "theta": P.encoder(r["theta"], counts),
    }
    if chain in ("encoder", "coarse"):
        y["omega"] = P.encoder_speed(r["theta"], r["t"], counts)
    if chain == "spikes":
        y |= {c: P.outliers(y[c], 0.01, 20 * s[c], rng) for c in s}
    return y


def record(
    r: dict, chain: str, channels, motor, rng: np.random.Generator, name: str, noise: float = 0.01
) -> Experiment:
    """The record of one run with the `channels` that were logged."""
    y = sensed(r, chain, motor, rng, noise)
    return Experiment(r["t"], {"v": r["v"]}, {c: y[c] for c in channels}, name=name)
