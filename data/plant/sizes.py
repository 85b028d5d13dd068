"""Plausible sizes of what may be hidden in a motor, from its own scales; `draw` gives a number between two."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from .motors import Motor

Draw = Callable[[float, float], float]  # evenly on a log scale


def _stall(m: Motor) -> float:
    return m.K * m.v_max / m.R  # N·m at v_max with the shaft held


# Sizes by effect, from the motor's own scales. An effect that is not here needs its numbers spelt out.
SIZES: Mapping[str, Callable[[Motor, Draw], dict[str, float]]] = {
    "coulomb": lambda m, draw: {"tau_c": _stall(m) * draw(0.02, 0.06)},
    "coulomb_asymmetric": lambda m, draw: {"tau_cp": (tau := _stall(m) * draw(0.02, 0.05)),
                                           "tau_cn": tau * draw(1.6, 2.5)},
    "stribeck": lambda m, draw: {"tau_c": (tau_c := _stall(m) * draw(0.02, 0.04)), "tau_s": tau_c * draw(1.6, 2.2),
                                 "omega_s": m.no_load_speed * draw(0.02, 0.05)},
    "quadratic_drag": lambda m, draw: {"c_2": _stall(m) * draw(0.05, 0.15) / (0.6 * m.no_load_speed) ** 2},
    "constant_load": lambda m, draw: {"tau_0": _stall(m) * draw(0.03, 0.08)},
    "gravity": lambda m, draw: {"mgl": _stall(m) * draw(0.04, 0.1)},
    "cogging": lambda m, draw: {"A": _stall(m) * draw(0.03, 0.06), "N": float(round(draw(3.6, 12.4))), "phi": 0.5},
    "load_friction": lambda m, draw: {"mu": draw(0.06, 0.15)},
    "brush_drop": lambda m, draw: {"V_b": m.v_max * draw(0.04, 0.08), "i_b": m.v_max / m.R * 0.01},
    "driver_dead_band": lambda m, draw: {"V_d": m.v_max * draw(0.03, 0.07)},
    "voltage_offset": lambda m, draw: {"V_0": m.v_max * draw(0.02, 0.05)},
    "magnetic_saturation": lambda m, draw: {"i_K": m.v_max / m.R * draw(0.6, 1.0)},
    "current_offset": lambda m, draw: {"i_0": m.v_max / m.R * draw(0.02, 0.05)},
    "speed_lag": lambda m, draw: {"T_w": m.J * m.R / m.K**2 * draw(0.1, 0.25)},
    "speed_delay": lambda m, draw: {"T_d": m.J * m.R / m.K**2 * draw(0.1, 0.2)},
}
