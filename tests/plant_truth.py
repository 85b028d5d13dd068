"""Sizes of the plant's effects on the lab motor, and the plain motor by the matrix exponential."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import linalg

NUMBERS = {  # one plausible size of every effect
    "brush_drop": {"V_b": 0.6, "i_b": 0.1},
    "winding_heating": {"R_th": 5.0, "C_th": 8.0},
    "inductance_saturation": {"i_L": 3.0},
    "magnetic_saturation": {"i_K": 6.0},
    "driver_dead_band": {"V_d": 0.3},
    "voltage_offset": {"V_0": 0.1},
    "coulomb": {"tau_c": 5e-3},
    "coulomb_asymmetric": {"tau_cp": 4e-3, "tau_cn": 7e-3},
    "stribeck": {"tau_c": 4e-3, "tau_s": 7e-3, "omega_s": 4.0},
    "quadratic_drag": {"c_2": 2e-6},
    "constant_load": {"tau_0": 3e-3},
    "gravity": {"mgl": 2e-2, "phi_g": 0.3},
    "cogging": {"A": 4e-3, "N": 12, "phi": 0.5},
    "torque_ripple": {"a_r": 0.1, "N_r": 12, "phi_r": 0.2},
    "load_friction": {"mu": 0.15},
    "viscous_asymmetric": {"b_a": 2e-5},
    "lugre": {"sigma_0": 0.5, "sigma_1": 1e-3, "tau_c": 4e-3, "tau_s": 6e-3, "omega_s": 4.0},
    "compliance": {"k_s": 2.0, "c_s": 1e-3, "J_l": 2e-5},
    "compliance_load_side": {"k_s": 2.0, "c_s": 1e-3, "J_l": 2e-5},
    "backlash": {"gap": 0.03, "k_s": 5.0, "c_s": 2e-3, "J_l": 2e-5},
    "slip_clutch": {"tau_slip": 3e-3, "omega_slip": 0.5, "b_slip": 1e-6, "J_l": 2e-5},
    "freewheel": {"c_g": 0.05, "b_free": 2e-6, "J_l": 2e-5, "side": 1.0},
    "speed_lag": {"T_w": 5e-3},
    "speed_filter": {"T_f": 5e-3, "zeta_f": 0.4},
    "angle_lag": {"T_pos": 6e-3},
    "current_lag": {"T_i": 2e-3},
    "current_average": {"T_m": 6e-3},
    "speed_delay": {"T_d": 8e-3},
    "current_offset": {"i_0": 0.03},
    "speed_gain": {"k_w": 0.05},
    "driver_coast": {"V_c": 12.0},
    "driver_one_quadrant": {"V_c": 12.0},
    "pwm_coast": {"s_c": 0.8, "V_s": 3.0},
    "pwm_fast_decay": {"a_p": 1.5, "V_s": 3.0},
    "driver_current_limit": {"I_lim": 1.0},
    "driver_voltage_limit": {"V_lim": 1.5},
    "driver_lag": {"T_v": 0.02},
    "driver_slew": {"T_r": 0.03, "V_s": 3.0},
    "supply_sag": {"R_s": 0.5, "V_s": 3.0},
    "magnet_heating": {"R_thm": 5.0, "C_thm": 4.0},
    "eddy_brake": {"c_e": 4e-4, "omega_b": 20.0},
    "spring": {"k_s": 3e-3, "theta_0": 0.4},
    "end_stop": {"k_stop": 0.2, "theta_lo": -0.2, "theta_hi": 0.5, "d_stop": 2e-3},
    "angular_friction": {"tau_m": 5e-3, "a_f": 0.6, "phi_f": 0.3},
    "gear_efficiency": {"mu_d": 0.1, "mu_b": 0.3},
    "speed_average": {"T_a": 8e-3},
    "speed_offset": {"w_0": 2.0},
    "speed_ripple": {"a_w": 0.05, "N_w": 3, "phi_w": 0.6, "e_w": 0.0},
    "current_gain": {"k_i": 0.05},
    "supply_side_current": {"V_dc": 6.0},
    "tight_spot": {"tau_c": 5e-3, "c": 2.0},
    "cam": {"A": 2e-2},
    "grease_warm_up": {"tau_c": 4e-3, "extra": 1.0, "t_g": 1.0},
    "bridge_loss": {"s": 0.2},
    "root_drag": {"c_r": 5e-4},
    "belt_splice": {"tau": 4e-3, "width": 1.5, "ratio": 0.4},
}


def state_space(m):
    A = np.array([[-m.R / m.L, -m.K / m.L, 0], [m.K / m.J, -m.b / m.J, 0], [0, 1, 0]])
    return A, np.array([[1 / m.L], [0], [0]])


def by_expm(m, t, v):
    A, B = state_space(m)
    E = linalg.expm(np.block([[A, B], [np.zeros((1, 4))]]) * (t[1] - t[0]))
    x = np.zeros((len(t), 3))
    for k in range(len(t) - 1):
        x[k + 1] = E[:3, :3] @ x[k] + E[:3, 3] * v[k]
    return x


def largest(error, reference):
    return np.max(np.abs(error)) / np.max(np.abs(reference))


def in_library_words(name, numbers, motor):
    """Numbers of the plant's effect as the library's parameters, and the total inertia."""
    n, J = dict(numbers), motor.J
    if name in ("compliance", "compliance_load_side", "backlash"):
        J_l, k_s, c_s = n.pop("J_l"), n.pop("k_s"), n.pop("c_s")
        J = motor.J + J_l
        resonance = np.sqrt(k_s / motor.J + k_s / J_l)
        share, zeta = J_l / J, c_s * resonance / (2 * k_s)
        n |= {"compliance": {"r_load": share, "omega_r": resonance, "zeta_r": zeta},
              "compliance_load_side": {"r_far": share, "T_far": 1 / resonance, "zeta_far": zeta},
              "backlash": {"r_gap": share, "omega_c": resonance, "zeta_c": zeta}}[name]
    if name == "driver_slew":  # so near that it does not matter
        n["V_w"] = 2e-3
    if name in ("slip_clutch", "freewheel"):
        J_l = n.pop("J_l")
        J = motor.J + J_l
        n["r_slip" if name == "slip_clutch" else "r_free"] = J_l / J
    if name == "freewheel":
        n["g_free"] = n.pop("c_g") * (1 / motor.J + 1 / J_l)
    if name in ("driver_coast", "driver_one_quadrant"):  # so soon that it does not matter how
        n = {"R_c" if name == "driver_coast" else "R_q": 1e4 * motor.R}
    if name == "lugre":
        theta_s = n["tau_c"] / n.pop("sigma_0")
        n |= {"s_b": n.pop("tau_s") / n["tau_c"], "theta_s": theta_s}
        assert n.pop("sigma_1") * n["omega_s"] == pytest.approx(n["tau_c"])  # the library's bristle damping
    return n, J
