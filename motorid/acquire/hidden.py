"""What may be hidden in the virtual motor: names, and sizes that matter without stopping it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from motorid.errors import UsageError, one_of
from motorid.records.datasets import load_plant

__all__ = ["SIZES", "Truth", "hide"]

Draw = Callable[[float, float], float]  # a number between two, evenly on a log scale


def _stall(m: Any) -> float:
    return m.K * m.v_max / m.R  # N·m at v_max with the shaft held


def _friction(m: Any, draw: Draw) -> dict[str, float]:
    return {"tau_c": _stall(m) * draw(0.02, 0.06)}


def _stribeck(m: Any, draw: Draw) -> dict[str, float]:
    tau_c = _stall(m) * draw(0.02, 0.04)
    return {"tau_c": tau_c, "tau_s": tau_c * draw(1.6, 2.2), "omega_s": m.no_load_speed * draw(0.02, 0.05)}


def _asymmetric(m: Any, draw: Draw) -> dict[str, float]:
    tau = _stall(m) * draw(0.02, 0.05)
    return {"tau_cp": tau, "tau_cn": tau * draw(1.6, 2.5)}


def _cogging(m: Any, draw: Draw) -> dict[str, float]:
    return {"A": _stall(m) * draw(0.03, 0.06), "N": float(round(draw(3.6, 12.4))), "phi": 0.5}


# Sizes by effect, from the motor's own scales. An effect that is not here needs its numbers spelt out.
SIZES: Mapping[str, Callable[[Any, Draw], dict[str, float]]] = {
    "coulomb": _friction,
    "coulomb_asymmetric": _asymmetric,
    "stribeck": _stribeck,
    "quadratic_drag": lambda m, draw: {"c_2": _stall(m) * draw(0.05, 0.15) / (0.6 * m.no_load_speed) ** 2},
    "constant_load": lambda m, draw: {"tau_0": _stall(m) * draw(0.03, 0.08)},
    "gravity": lambda m, draw: {"mgl": _stall(m) * draw(0.04, 0.1)},
    "cogging": _cogging,
    "load_friction": lambda m, draw: {"mu": draw(0.06, 0.15)},
    "brush_drop": lambda m, draw: {"V_b": m.v_max * draw(0.04, 0.08), "i_b": m.v_max / m.R * 0.01},
    "driver_dead_band": lambda m, draw: {"V_d": m.v_max * draw(0.03, 0.07)},
    "voltage_offset": lambda m, draw: {"V_0": m.v_max * draw(0.02, 0.05)},
    "magnetic_saturation": lambda m, draw: {"i_K": m.v_max / m.R * draw(0.6, 1.0)},
    "current_offset": lambda m, draw: {"i_0": m.v_max / m.R * draw(0.02, 0.05)},
    "speed_lag": lambda m, draw: {"T_w": m.J * m.R / m.K**2 * draw(0.1, 0.25)},
    "speed_delay": lambda m, draw: {"T_d": m.J * m.R / m.K**2 * draw(0.1, 0.2)},
}


@dataclass(frozen=True, eq=False)
class Truth:
    """The motor and what is hidden in it."""

    motor: Any
    effects: dict[str, dict[str, float]]
    seed: int

    def __str__(self) -> str:
        m = self.motor
        hidden = [f"{name} ({', '.join(f'{k} = {v:.4g}' for k, v in values.items())})"
                  for name, values in self.effects.items()]
        return (f"hidden: {'; '.join(hidden) or 'nothing'}\n"
                f"motor '{m.name}', seed {self.seed}: R = {m.R:.5g} Ω, L = {m.L:.5g} H, "
                f"K = {m.K:.5g} V·s/rad, b = {m.b:.5g} N·m·s/rad, J = {m.J:.5g} kg·m²")


def hide(words: str = "random", motor: str = "lab", seed: int = 0) -> Truth:
    """Choose a motor and what is hidden in it.

    Parameters
    ----------
    words : str
        ``none``, ``random``, or effects joined by commas, each bare (its size is drawn) or with its numbers:
        ``coulomb:tau_c=0.01,brush_drop``.
    motor : str
        One of the plant's motors. Its constants are drawn within 10 % of the nominal ones.
    seed : int

    Raises
    ------
    UsageError
        For a name or a number that is not known.
    """
    plant = load_plant()
    if motor not in plant.MOTORS:
        raise UsageError(one_of(motor, plant.MOTORS, "motor"))
    rng = np.random.default_rng(seed)
    nominal = plant.MOTORS[motor]
    real = replace(nominal, **{k: getattr(nominal, k) * float(rng.uniform(0.9, 1.1)) for k in "RLKbJ"})

    def draw(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    if words == "random":
        words = str(rng.choice(list(SIZES)))
    effects = dict(_effect(word, real, draw) for word in words.split(",") if word and word != "none")
    try:
        plant.Plant(real, effects)
    except ValueError as error:
        raise UsageError(str(error)) from None
    return Truth(real, effects, seed)


def _effect(word: str, motor: Any, draw: Draw) -> tuple[str, dict[str, float]]:
    name, *numbers = word.strip().split(":")
    plant = load_plant()
    known = {**plant.LIBRARY, **plant.BEYOND}
    if name not in known:
        raise UsageError(one_of(name, ["none", "random", *known], "effect"))
    if numbers:
        try:
            return name, {k: float(v) for k, v in (n.split("=") for n in numbers)}
        except ValueError:
            raise UsageError(f"'{word}': numbers are given as {name}:name=value:name=value.") from None
    if name not in SIZES:
        raise UsageError(f"no size is drawn for '{name}'; spell its numbers out, as in {name}:name=value. "
                         f"Drawn are: {', '.join(SIZES)}.")
    return name, SIZES[name](motor, draw)
