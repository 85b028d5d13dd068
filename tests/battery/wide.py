"""Each effect of benches (driver, supply, gear, sensors) alone, in three motors under three drives; and none at all.

``python tests/battery/run.py --wide --out DIR``. Sizes go with the motor: u is the voltage of the drive.
"""

from __future__ import annotations

from collections.abc import Callable

from battery.cases import ANGLE, Case
from battery.excite import DT, P, level, time_constant

DRIVES = {
    "a": (("stairs", "prbs 0.8"), "steps"),
    "b": (("ramps", "multisine"), "steps"),
    "c": (("chirp", "steps"), "stairs"),
}
COASTING = {
    "a": (("pulses", "ternary"), "ternary 0.8"),
    "b": (("ternary", "ternary 0.6"), "pulses"),
    "c": (("coast", "pulses 0.5"), "ternary 0.8"),
}
SIZES: dict[str, Callable[[P.Motor, float], dict[str, float]]] = {
    "driver_coast": lambda m, u: {"V_c": m.v_max + 1.4},
    "pwm_coast": lambda m, u: {"s_c": 0.7, "V_s": 1.05 * u},
    "pwm_fast_decay": lambda m, u: {"a_p": 1.5, "V_s": 1.05 * u},
    "driver_current_limit": lambda m, u: {"I_lim": 0.2 * m.i_max},
    "driver_voltage_limit": lambda m, u: {"V_lim": 0.6 * u},
    "driver_lag": lambda m, u: {"T_v": max(0.2 * time_constant(m), 2 * DT[m.name])},
    "driver_slew": lambda m, u: {"T_r": max(1.5 * time_constant(m), 10 * DT[m.name]), "V_s": 1.0 * u},
    "supply_sag": lambda m, u: {"R_s": 0.3 * m.R, "V_s": 1.05 * u},
    "magnet_heating": lambda m, u: {"R_thm": 240 * m.R / u**2, "C_thm": u**2 / m.R * DT[m.name] / 0.6},
    "eddy_brake": lambda m, u: {"c_e": 0.96 * m.K**2 / m.R, "omega_b": 0.25 * u / m.K},
    "spring": lambda m, u: {
        "k_s": 0.15 * m.J / time_constant(m) ** 2,
        "theta_0": 0.6 * u / m.K * time_constant(m),
    },
    "end_stop": lambda m, u: {
        "k_stop": 10 * m.J / time_constant(m) ** 2,
        "theta_lo": -0.5 * u / m.K * time_constant(m),
        "theta_hi": 1.5 * u / m.K * time_constant(m),
        "d_stop": 0.5 * m.K / u,
    },
    "angular_friction": lambda m, u: {"tau_m": 0.08 * m.K * u / m.R, "a_f": 0.7, "phi_f": 1.0},
    "slip_clutch": lambda m, u: {"tau_slip": 0.15 * m.K * u / m.R, "omega_slip": 0.005 * u / m.K, "b_slip": 0.1 * m.b,
                                 "J_l": m.J},
    "freewheel": lambda m, u: {"c_g": m.J / DT[m.name], "b_free": 0.5 * m.K**2 / m.R, "J_l": m.J},
    "gear_efficiency": lambda m, u: {"mu_d": 0.1, "mu_b": 0.35},
    "speed_filter": lambda m, u: {"T_f": max(0.2 * time_constant(m), 3 * DT[m.name]), "zeta_f": 0.5},
    "speed_average": lambda m, u: {"T_a": max(0.5 * time_constant(m), 4 * DT[m.name])},
    "speed_offset": lambda m, u: {"w_0": 0.05 * u / m.K},
    "speed_ripple": lambda m, u: {"a_w": 0.06, "N_w": 3.0, "phi_w": 1.0},
    "current_gain": lambda m, u: {"k_i": 0.08},
    "supply_side_current": lambda m, u: {"V_dc": 1.0 * u},
}
KNOWN = {"driver_lag": ("L",), "gear_efficiency": ("J",), "current_gain": ("R",)}
SEES_ANGLE = ("spring", "end_stop", "angular_friction", "speed_offset", "speed_ripple")


def _case(effect: str, motor: str, drive: str) -> Case:
    train, check = (COASTING if effect == "driver_coast" else DRIVES)[drive]
    m = P.MOTORS[motor]
    return Case(
        f"{effect}.{motor}.{drive}",
        "single",
        motor,
        {effect: SIZES[effect](m, level(m))},
        train,
        check,
        channels=ANGLE if effect in SEES_ANGLE else ("i", "omega"),
        known=KNOWN.get(effect, ()),
    )


MOTORS = ("lab", "servo", "wheel")
NOTHING = 6  # records of each motor and drive without any effect


def _nothing(motor: str, drive: str, k: int) -> Case:
    train, check = DRIVES[drive]
    return Case(f"none.{motor}.{drive}.{k}", "none", motor, {}, train, check, channels=(ANGLE, ("i", "omega"))[k % 2])


WIDE = {c.name: c for c in (_case(e, m, d) for e in SIZES for m in MOTORS for d in DRIVES)}
WIDE |= {c.name: c for c in (_nothing(m, d, k) for m in MOTORS for d in DRIVES for k in range(NOTHING))}
