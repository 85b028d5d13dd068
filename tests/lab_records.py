"""Records of a known motor, made by the models themselves: for what does not ask how good the physics is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

import motorid as mi

VALUES = {"R": 1.38, "L": 1.72e-3, "K": 0.0462, "b": 6.5e-5, "J": 2.35e-5}
NOISE = {"i": 0.02, "omega": 0.4, "theta": 2e-3}


def drive(t: np.ndarray, volt: float) -> np.ndarray:
    """Rest, a step, a reversal of half the size."""
    return np.where(t < 0.02, 0.0, np.where(t < 0.6 * t[-1], volt, -volt / 2))


def simulated(
    t: np.ndarray,
    v: np.ndarray,
    channels: Sequence[str] = ("i", "omega"),
    model: mi.Model | None = None,
    hold: str = "zoh",
) -> mi.Experiment:
    """A record without noise, from rest."""
    model = model or mi.dc_motor(**VALUES)
    bare = mi.Experiment(t, {"v": v}, {c: np.zeros(len(t)) for c in channels}, hold=hold)
    sim = mi.simulate(model, bare, initial="rest")[0]
    return bare.with_(outputs={c: sim.outputs[c] for c in channels})


def noisy(run: mi.Experiment, rng: np.random.Generator, noise: Mapping[str, float] = NOISE) -> mi.Experiment:
    """The record with white noise on every channel."""
    return run.with_(outputs={c: y + noise[c] * rng.normal(size=run.n) for c, y in run.outputs.items()})


def pair(rng: np.random.Generator, n: int = 500, **how) -> list[mi.Experiment]:
    """Two noisy records of `n` samples at 1 kHz."""
    t = np.arange(n) * 1e-3
    return [noisy(simulated(t, drive(t, volt), **how), rng) for volt in (6.0, -8.0)]
