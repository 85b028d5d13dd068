"""Voltages to drive a motor with: (t, v) with abs(v) within the given level, rounded to 0.1 mV.

Rounding here means that a record written with four decimals holds exactly the voltage the plant was given.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil

import numpy as np

Excitation = tuple[np.ndarray, np.ndarray]


def _time(duration: float, dt: float) -> np.ndarray:
    return np.arange(round(duration / dt)) * dt


def _level(v: np.ndarray) -> np.ndarray:
    return np.round(v, 4) + 0.0


def step(level: float, duration: float = 1.2, onset: float = 0.02, dt: float = 1e-3) -> Excitation:
    """Zero, then `level` from `onset` on."""
    t = _time(duration, dt)
    return t, _level(np.where(t >= onset - 1e-9, level, 0.0))


def staircase(levels: Sequence[float], hold: float, onset: float = 0.02, dt: float = 1e-3) -> Excitation:
    """Zero, then every level for `hold` seconds; levels of both signs make reversals."""
    t = _time(onset + hold * len(levels), dt)
    k = np.clip(np.floor((t - onset) / hold + 1e-9), -1, len(levels) - 1).astype(int)
    return t, _level(np.array([0.0, *levels])[k + 1])


def triangle(level: float, duration: float, period: float, dt: float = 1e-3) -> Excitation:
    """Ramps 0, +level, −level, 0 with the given period."""
    t = _time(duration, dt)
    phase = (t / period) % 1.0
    return t, _level(level * (1 - 4 * np.abs((phase + 0.25) % 1.0 - 0.5)))


def chirp(level: float, duration: float, f0: float, f1: float, dt: float = 1e-3) -> Excitation:
    """Sine whose frequency goes from f0 to f1 (Hz) geometrically."""
    t = _time(duration, dt)
    rate = np.log(f1 / f0) / duration
    return t, _level(level * np.sin(2 * np.pi * f0 * np.expm1(rate * t) / rate))


def prbs(
    level: float, duration: float, hold: float, rng: np.random.Generator, dt: float = 1e-3
) -> Excitation:
    """Random ±level, drawn anew every `hold` seconds."""
    t = _time(duration, dt)
    signs = rng.integers(0, 2, ceil(duration / hold) + 1) * 2 - 1
    return t, _level(level * signs[np.floor(t / hold + 1e-9).astype(int)])


def random_steps(
    level: float, duration: float, hold: float, rng: np.random.Generator, dt: float = 1e-3
) -> Excitation:
    """Random level within ±level, drawn anew every `hold` seconds."""
    t = _time(duration, dt)
    draws = rng.uniform(-level, level, ceil(duration / hold) + 1)
    return t, _level(draws[np.floor(t / hold + 1e-9).astype(int)])


def multisine(
    level: float, duration: float, frequencies: Sequence[float], rng: np.random.Generator, dt: float = 1e-3
) -> Excitation:
    """Sum of sines of equal size and random phase, scaled so that its largest value is `level`."""
    t = _time(duration, dt)
    v = sum(np.sin(2 * np.pi * f * t + rng.uniform(0, 2 * np.pi)) for f in frequencies)
    return t, _level(level * v / np.max(np.abs(v)))


def coast_down(level: float, spin: float, duration: float, dt: float = 1e-3) -> Excitation:
    """`level` for `spin` seconds, then zero volts (short circuit): the motor brakes to rest."""
    t = _time(duration, dt)
    return t, _level(np.where(t < spin - 1e-9, level, 0.0))


def warm_up(
    level: float, duration: float, dt: float = 5e-3, period: float = 10.0, duty: float = 0.8
) -> Excitation:
    """Long run in heavy use: in every period the sign alternates each second, then a rest while it cools."""
    t = _time(duration, dt)
    busy = (t % period) < duty * period - 1e-9
    return t, _level(np.where(busy, level * (1 - 2 * (np.floor(t + 1e-9) % 2)), 0.0))
