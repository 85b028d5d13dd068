"""Every effect of the library, added to a motor, is found again from its own data by one plain fit.

Nothing is told to the fit but the effect (and the order of cogging and ripple): no start, no size, no shape.
"""

from __future__ import annotations

import numpy as np
import pytest
from lab_records import VALUES, noisy, simulated

import motorid as mi
from motorid.effects import LIBRARY

TRUTH = {
    "brush_drop": {"V_b": 0.6, "i_b": 0.15},
    "winding_heating": {"R_th": 20.0, "C_th": 0.3},
    "inductance_saturation": {"i_L": 3.0},
    "magnetic_saturation": {"i_K": 8.0},
    "driver_dead_band": {"V_d": 0.3},
    "voltage_offset": {"V_0": 0.1},
    "coulomb": {"tau_c": 5e-3},
    "coulomb_asymmetric": {"tau_cp": 6e-3, "tau_cn": 3e-3},
    "stribeck": {"tau_c": 4e-3, "tau_s": 9e-3, "omega_s": 8.0},
    "quadratic_drag": {"c_2": 6e-7},
    "constant_load": {"tau_0": 4e-3},
    "gravity": {"mgl": 5e-3, "phi_g": 3.0},
    "cogging": {"A": 3e-3, "phi": -2.0},
    "torque_ripple": {"a_r": 0.1, "phi_r": 3.0},
    "load_friction": {"mu": 0.08},
    "viscous_asymmetric": {"b_a": 2e-5},
    "lugre": {"tau_c": 5e-3, "s_b": 1.6, "omega_s": 8.0, "theta_s": 0.02},
    "compliance": {"r_load": 0.4, "omega_r": 250.0, "zeta_r": 0.05},
    "compliance_load_side": {"T_far": 4e-3, "r_far": 0.4, "zeta_far": 0.05},
    "backlash": {"r_gap": 0.5, "gap": 0.05, "omega_c": 400.0, "zeta_c": 0.3},
    "speed_lag": {"T_w": 4e-3},
    "speed_filter": {"T_f": 5e-3, "zeta_f": 0.4},
    "angle_lag": {"T_pos": 4e-3},
    "current_lag": {"T_i": 8e-4},
    "current_average": {"T_m": 6e-3},
    "speed_delay": {"T_d": 5e-3},
    "current_offset": {"i_0": 0.05},
    "speed_gain": {"k_w": 0.04},
    "driver_coast": {"R_c": 9.0},
    "driver_one_quadrant": {"R_q": 9.0},
    "pwm_coast": {"s_c": 0.6, "V_s": 8.0},
    "pwm_fast_decay": {"a_p": 1.5, "V_s": 8.0},
    "slip_clutch": {"r_slip": 0.5, "tau_slip": 0.03, "omega_slip": 2.0, "b_slip": 2e-5},
    "freewheel": {"r_free": 0.5, "g_free": 500.0, "b_free": 2e-5, "side": 1.0},
    "driver_current_limit": {"I_lim": 2.5},
    "driver_voltage_limit": {"V_lim": 5.0},
    "driver_lag": {"T_v": 6e-3},
    "driver_slew": {"T_r": 0.04, "V_s": 8.0, "V_w": 0.3},
    "supply_sag": {"R_s": 0.4, "V_s": 8.0},
    "magnet_heating": {"R_thm": 20.0, "C_thm": 0.3},
    "eddy_brake": {"c_e": 3e-4, "omega_b": 30.0},
    "angular_friction": {"tau_m": 5e-3, "a_f": 0.5, "phi_f": 2.0},
    "gear_efficiency": {"mu_d": 0.1, "mu_b": 0.25},
    "spring": {"k_s": 4e-3, "theta_0": 1.5},
    "end_stop": {"k_stop": 0.5, "theta_lo": -2.0, "theta_hi": 5.0, "d_stop": 5e-3},
    "speed_average": {"T_a": 9e-3},
    "speed_offset": {"w_0": 3.0},
    "speed_ripple": {"a_w": 0.06, "N_w": 4, "phi_w": 1.0},
    "current_gain": {"k_i": 0.05},
    "supply_side_current": {"V_dc": 9.0},
}
KNOWN = {  # what the records leave open
    "driver_lag": {"L": VALUES["L"]},
    "supply_sag": {"V_s": 8.0},
    "driver_slew": {"V_s": 8.0},
    "pwm_coast": {"V_s": 8.0},
    "supply_side_current": {"V_dc": 9.0},
    "current_gain": {"R": VALUES["R"]},
    "gear_efficiency": {"J": VALUES["J"]},
}
NOISE = {"i": 5e-3, "omega": 0.2, "theta": 1e-3}
LEVELS = np.array([0, 3, 6, 0, -4, -8, 2, 8, -2, 0.5, 1, -1, -6, 6, 0], float)


def volts(t: np.ndarray, kind: int) -> np.ndarray:
    """A staircase with reversals and standstills, or random steps over a slow wave."""
    if kind == 0:
        return LEVELS[np.minimum((t / t[-1] * len(LEVELS)).astype(int), len(LEVELS) - 1)]
    steps = np.random.default_rng(5).choice([-3.5, -1.4, 0.7, 2.1, 4.2, 6.3], size=200)
    return np.where(t < 0.02, 0, steps[np.minimum((t / 0.06).astype(int), 199)] + 2 * np.sin(4.4 * t))


def records(effect, rng, n=1500, **other):
    t = np.arange(n) * 1e-3
    model = (mi.dc_motor(**VALUES) + effect).replace(**TRUTH[effect.name] | other)
    channels = tuple(NOISE)
    clean = [simulated(t, volts(t, k), channels, model) for k in (0, 1)]
    if "sgn_width" in model.parameters:  # the width that a fit of these records will choose
        width = mi.Problem(mi.dc_motor() + effect, tuple(noisy(c, rng, NOISE) for c in clean)).model.values[
            "sgn_width"
        ]
        clean = [simulated(t, volts(t, k), channels, model.replace(sgn_width=width)) for k in (0, 1)]
    return [noisy(c, rng, NOISE) for c in clean]


def test_every_effect_of_the_library_is_tried():
    assert set(TRUTH) == set(LIBRARY)


@pytest.mark.slow
@pytest.mark.parametrize("name", TRUTH)
def test_is_found_again_from_its_own_data(name, rng):
    effect = LIBRARY[name]
    runs = records(effect, rng)
    known = KNOWN.get(name, {})
    fit = mi.fit((mi.dc_motor() + effect).fix(**known), runs)
    assert fit.chi2 / fit.dof < 1.1
    assert fit.integration_error < 0.2
    for n, value in TRUTH[name].items():
        if n in known:
            continue
        std = fit.std[n]
        assert std is not None, n
        # The smooth sgn of data and fit differs a little, which noise as small as this shows: 2 %.
        assert abs(fit.values[n] - value) < max(4.5 * std, 0.02 * abs(value)), n
    for n, value in VALUES.items():
        assert fit.values[n] == pytest.approx(value, rel=0.01), n
    plain = mi.fit(mi.dc_motor().fix(**{n: v for n, v in known.items() if n in VALUES}), runs)
    assert plain.chi2 > 1.05 * fit.chi2  # the effect was there to be found


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 8])
def test_a_gap_of_radians_is_found(seed):
    """At the shaft of a geared motor the play of its gear is as many times as large.

    Its rebounds make the cost rugged: of the noise of one record in three a refit alone stops far from the end.
    """
    runs = records(LIBRARY["backlash"], np.random.default_rng(seed), n=2400, gap=2.5)
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs), effects=["backlash", "compliance"])
    assert found.effects == ("backlash",)
    assert found.after.values["gap"] == pytest.approx(2.5, rel=0.02)
    assert found.after.fits == "noise"


@pytest.mark.parametrize("R_q", [3.0, 365.0, 1e4])
def test_a_drive_that_carries_no_current_back_is_simulated_however_firmly(R_q):
    """Where the current ends within a sub-step, steps that began before it grew without bound: sizes were "open"."""
    t = 4e-3 * np.arange(600)
    v = np.repeat(np.random.default_rng(0).uniform(0, 24, 12), 50)
    run = mi.Experiment(t, {"v": v}, {"i": 0 * t, "omega": 0 * t})
    motor = mi.dc_motor(R=0.474, L=3.3e-4, K=0.043, b=2.7e-4, J=3.5e-4) + mi.effects.driver_one_quadrant(R_q=R_q)
    (y,) = mi.simulate(motor, run, initial="rest")
    assert y.outputs["i"].min() > -0.1 or R_q < 100
    problem = mi.Problem(motor, [run.with_(outputs={c: y.outputs[c] + 0.1 for c in ("i", "omega")})])
    assert mi.check_derivatives(problem.refined(problem.start), problem.start, tolerance=1e-3).ok
