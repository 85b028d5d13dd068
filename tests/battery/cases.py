"""The cases of the battery: what is hidden in which motor, how it is driven and measured, what would be right.

All records come from the independent plant (`data/plant`), which shares no code with the models.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from zlib import crc32

import numpy as np
from plant_truth import in_library_words

from battery.excite import DT, P, driven, record
from motorid.effects import LIBRARY
from motorid.model.model import Model, dc_motor
from motorid.records.experiment import Experiment

ANGLE = ("i", "omega", "theta")


@dataclass(frozen=True)
class Case:
    """One case; `twins` are answers that these data cannot tell from the truth, `known` is fixed at its true value."""

    name: str
    kind: str
    motor: str
    effects: Mapping[str, Mapping[str, float]]
    train: tuple[str, ...] = ("stairs", "prbs 0.8")
    check: str = "steps"
    chain: str = "logger"
    channels: tuple[str, ...] = ("i", "omega")
    n: int = 1000
    dt: float = 0.0
    jitter: float = 0.0
    noise: float = 0.01
    twins: tuple[str, ...] = field(default=())
    known: tuple[str, ...] = ()

    @property
    def sensor_effects(self) -> tuple[str, ...]:
        """Effects that the sensors really have: differences of counts are means over a sample."""
        return ("speed_delay", "speed_lag", "speed_average") if self.chain in ("encoder", "coarse") else ()

    def records(self) -> tuple[list[Experiment], list[Experiment]]:
        """Training runs and one held-out run of another kind."""
        rng = np.random.default_rng(crc32(self.name.encode()))
        motor, dt = P.MOTORS[self.motor], self.dt or DT[self.motor]
        runs = []
        for k, words in enumerate((*self.train, self.check)):
            r = driven(motor, self.effects, words, self.n, dt, rng, self.jitter)
            name = f"run{k + 1}" if k < len(self.train) else "check1"
            runs.append(record(r, self.chain, self.channels, motor, rng, name, self.noise))
        return runs[:-1], runs[-1:]

    def base(self) -> Model:
        """The motor without effects, `known` parameters fixed."""
        return dc_motor().fix(**{n: getattr(P.MOTORS[self.motor], n) for n in self.known})

    def true_model(self) -> Model | None:
        """The library's model with the true numbers; None where the library lacks the effect."""
        if not set(self.effects) <= set(LIBRARY):
            return None
        motor = P.MOTORS[self.motor]
        values = {n: getattr(motor, n) for n in ("R", "L", "K", "b", "J")}
        model = self.base()
        for name, numbers in self.effects.items():
            words, inertia = in_library_words(name, numbers, motor)
            values |= words
            values["J"] += inertia - motor.J
            model = model + LIBRARY[name]
        return model.replace(**values)


def _case(kind: str, name: str, motor: str, effects: Mapping[str, Mapping[str, float]], **more) -> Case:
    return Case(name, kind, motor, effects, **more)


def single(effect: str, motor: str, numbers: Mapping[str, float], **more) -> Case:
    return _case("single", more.pop("name", effect), motor, {effect: numbers}, **more)


SINGLES = [
    single("brush_drop", "micro", {"V_b": 0.45, "i_b": 0.05}, train=("stairs", "ramps")),
    single(
        "winding_heating",
        "wheel",
        {"R_th": 1.0, "C_th": 3.0},
        train=("hard", "hard 0.6"),
        check="stairs",
        n=2000,
        dt=4e-3,
    ),
    single("inductance_saturation", "big", {"i_L": 35.0}, train=("prbs", "stairs"), noise=0.005),
    single("magnetic_saturation", "wheel", {"i_K": 20.0}, train=("stairs", "prbs")),
    single("driver_dead_band", "lab", {"V_d": 0.35}, train=("stairs", "chirp")),
    single("voltage_offset", "lab", {"V_0": 0.15}, train=("stairs 0.6", "multisine")),
    single("coulomb", "lab", {"tau_c": 8e-3}, train=("stairs", "ramps")),
    single("coulomb_asymmetric", "wheel", {"tau_cp": 0.02, "tau_cn": 0.05}, train=("stairs", "ramps")),
    single(
        "stribeck",
        "servo",
        {"tau_c": 0.03, "tau_s": 0.07, "omega_s": 0.8},
        train=("stairs 0.6", "ramps 0.5"),
        check="multisine 0.6",
        n=1500,
    ),
    single("quadratic_drag", "wheel", {"c_2": 3e-6}, train=("stairs 1.5", "ramps 1.5"), channels=("omega",)),
    single("constant_load", "servo", {"tau_0": 0.04}, train=("stairs", "multisine")),
    single("gravity", "servo", {"mgl": 0.08, "phi_g": 0.4}, train=("stairs", "chirp"), channels=("i", "theta")),
    single(
        "cogging",
        "lab",
        {"A": 8e-3, "N": 12, "phi": 0.7},
        train=("stairs 0.4", "ramps 0.5"),
        check="steps 0.5",
        channels=ANGLE,
    ),
    single(
        "torque_ripple", "big", {"a_r": 0.12, "N_r": 6, "phi_r": 0.3}, train=("stairs 0.6", "chirp 0.7"), channels=ANGLE
    ),
    single("load_friction", "servo", {"mu": 0.15}, train=("stairs", "prbs")),
    single("viscous_asymmetric", "wheel", {"b_a": 1.2e-4}, train=("stairs", "chirp")),
    single(
        "lugre",
        "lab",
        {"sigma_0": 0.4, "sigma_1": 9e-3 / 6.0, "tau_c": 9e-3, "tau_s": 1.5e-2, "omega_s": 6.0},
        train=("stairs 0.4", "ramps 0.3"),
        check="multisine 0.4",
        channels=ANGLE,
    ),
    single("compliance", "lab", {"k_s": 0.9, "c_s": 4e-4, "J_l": 2.5e-5}, train=("prbs", "stairs")),
    single("compliance_load_side", "lab", {"k_s": 0.9, "c_s": 4e-4, "J_l": 2.5e-5}, train=("prbs", "stairs")),
    single(
        "backlash",
        "servo",
        {"gap": 0.05, "k_s": 60.0, "c_s": 0.08, "J_l": 1.5e-3},
        train=("prbs", "chirp"),
        channels=ANGLE,
    ),
    single("slip_clutch", "lab", {"tau_slip": 0.025, "omega_slip": 0.5, "b_slip": 5e-6, "J_l": 3e-5},
           train=("stairs", "steps 0.8"), check="prbs 0.8"),
    single("freewheel", "lab", {"c_g": 0.2, "b_free": 2e-5, "J_l": 3e-5}, train=("stairs", "prbs 0.8")),
    single("speed_lag", "wheel", {"T_w": 0.012}, train=("prbs", "stairs")),
    single("speed_filter", "lab", {"T_f": 4e-3, "zeta_f": 0.3}, train=("prbs", "stairs")),
    single("current_lag", "lab", {"T_i": 3e-3}, train=("prbs", "stairs")),
    single("current_average", "lab", {"T_m": 0.02}, train=("prbs", "stairs")),
    single("angle_lag", "lab", {"T_pos": 0.012}, train=("prbs", "stairs"), channels=("i", "theta")),
    single("speed_delay", "lab", {"T_d": 6e-3}, train=("prbs", "chirp")),
    single("current_offset", "micro", {"i_0": 0.02}, train=("stairs", "multisine")),
    single("speed_gain", "servo", {"k_w": 0.04}, train=("stairs", "multisine"), channels=ANGLE),
    single("driver_coast", "lab", {"V_c": 12.0}, train=("pulses", "pulses 0.7"), check="pulses 0.5"),
    single("driver_one_quadrant", "lab", {"V_c": 12.0}, train=("stairs", "prbs 0.8")),
    single("driver_current_limit", "lab", {"I_lim": 3.0}, train=("stairs", "prbs 0.8")),
    single("driver_voltage_limit", "lab", {"V_lim": 2.5}, train=("stairs", "prbs 0.8")),
    single("driver_lag", "servo", {"T_v": 8e-3}, train=("stairs", "prbs 0.8")),
    single("driver_slew", "lab", {"T_r": 0.05, "V_s": 12.0}, train=("stairs", "prbs 0.8")),
    single("pwm_coast", "servo", {"s_c": 0.8, "V_s": 7.6}, train=("stairs", "steps 0.7")),
    single("pwm_fast_decay", "lab", {"a_p": 1.5, "V_s": 6.0}, train=("stairs", "steps 0.7")),
    single("supply_sag", "wheel", {"R_s": 0.15, "V_s": 13.0}, train=("stairs", "ramps")),
    single(
        "magnet_heating",
        "wheel",
        {"R_thm": 1.0, "C_thm": 3.0},
        train=("hard", "hard 0.6"),
        check="stairs",
        n=2000,
        dt=4e-3,
    ),
    single("eddy_brake", "wheel", {"c_e": 2e-3, "omega_b": 40.0}, train=("stairs", "ramps")),
    single("spring", "servo", {"k_s": 0.06, "theta_0": 0.3}, train=("stairs", "chirp"), channels=ANGLE),
    single("end_stop", "servo", {"k_stop": 5.0, "theta_lo": -1.0, "theta_hi": 2.0, "d_stop": 0.05},
           train=("stairs", "chirp"), channels=ANGLE),
    single(
        "angular_friction",
        "servo",
        {"tau_m": 0.05, "a_f": 0.8, "phi_f": 0.4},
        train=("stairs", "ramps"),
        channels=ANGLE,
    ),
    single("gear_efficiency", "servo", {"mu_d": 0.1, "mu_b": 0.4}, train=("stairs", "prbs"), known=("J",)),
    single("speed_average", "lab", {"T_a": 0.02}, train=("prbs", "stairs")),
    single("speed_offset", "lab", {"w_0": 4.0}, train=("stairs", "chirp"), channels=ANGLE),
    single("speed_ripple", "lab", {"a_w": 0.05, "N_w": 4, "phi_w": 0.5}, train=("stairs", "chirp"), channels=ANGLE),
    single("speed_ripple", "servo", {"a_w": 0.1, "N_w": 1, "phi_w": 0.7, "e_w": 1.0}, train=("stairs", "chirp"),
           channels=ANGLE, name="encoder_ripple"),
    single("current_gain", "lab", {"k_i": 0.08}, train=("stairs", "multisine"), known=("R",)),
    single("supply_side_current", "lab", {"V_dc": 6.0}, train=("stairs", "multisine")),
    # The same effects in other motors, with other sensors, channels and drives.
    single("coulomb", "big", {"tau_c": 0.5}, name="coulomb_coloured", chain="coloured", train=("multisine", "ramps")),
    single(
        "coulomb", "servo", {"tau_c": 0.03}, name="coulomb_angle_only", channels=("theta",), train=("stairs", "ramps")
    ),
    single("coulomb", "wheel", {"tau_c": 0.05}, name="coulomb_closed_loop", train=("loop", "loop"), check="stairs"),
    single(
        "gravity",
        "big",
        {"mgl": 1.2, "phi_g": -0.8},
        name="gravity_encoder",
        chain="encoder",
        channels=ANGLE,
        train=("stairs 0.5", "multisine 0.5"),
    ),
]

PAIRS = [
    _case(
        "pair",
        "coulomb+gravity",
        "servo",
        {"coulomb": {"tau_c": 0.03}, "gravity": {"mgl": 0.08, "phi_g": 0.2}},
        train=("stairs", "ramps"),
        channels=ANGLE,
    ),
    _case(
        "pair",
        "brush_drop+coulomb",
        "micro",
        {"brush_drop": {"V_b": 0.5, "i_b": 0.02}, "coulomb": {"tau_c": 1.5e-4}},
        train=("stairs", "multisine"),
    ),
    _case(
        "pair",
        "coulomb+cogging",
        "lab",
        {"coulomb": {"tau_c": 6e-3}, "cogging": {"A": 8e-3, "N": 16, "phi": 0.1}},
        train=("stairs 0.5", "ramps 0.6"),
        check="steps 0.5",
        channels=ANGLE,
    ),
    _case(
        "pair",
        "coulomb+speed_lag",
        "wheel",
        {"coulomb": {"tau_c": 0.05}, "speed_lag": {"T_w": 0.015}},
        train=("stairs", "prbs"),
    ),
    _case(
        "pair",
        "coulomb+winding_heating",
        "wheel",
        {"coulomb": {"tau_c": 0.06}, "winding_heating": {"R_th": 1.0, "C_th": 3.0}},
        train=("hard", "stairs"),
        check="hard 0.7",
        n=2000,
        dt=4e-3,
    ),
    _case(
        "pair",
        "quadratic_drag+voltage_offset",
        "wheel",
        {"quadratic_drag": {"c_2": 4e-6}, "voltage_offset": {"V_0": 0.4}},
        train=("stairs 1.5", "ramps 1.5"),
    ),
    _case(
        "pair",
        "coulomb+compliance",
        "lab",
        {"coulomb": {"tau_c": 8e-3}, "compliance": {"k_s": 0.9, "c_s": 4e-4, "J_l": 2.5e-5}},
        train=("prbs", "stairs"),
    ),
    _case(
        "pair",
        "gravity+cogging",
        "big",
        {"gravity": {"mgl": 1.5, "phi_g": 0.5}, "cogging": {"A": 0.35, "N": 8, "phi": 1.0}},
        train=("stairs 0.4", "ramps 0.5"),
        check="steps 0.4",
        channels=ANGLE,
    ),
    _case(
        "pair",
        "driver_dead_band+magnetic_saturation",
        "lab",
        {"driver_dead_band": {"V_d": 0.4}, "magnetic_saturation": {"i_K": 6.0}},
        train=("stairs", "multisine"),
    ),
    _case(
        "pair",
        "load_friction+constant_load",
        "servo",
        {"load_friction": {"mu": 0.15}, "constant_load": {"tau_0": 0.04}},
        train=("stairs", "multisine"),
    ),
    _case(
        "pair",
        "coulomb+current_offset",
        "lab",
        {"coulomb": {"tau_c": 1e-2}, "current_offset": {"i_0": 0.06}},
        train=("stairs", "multisine"),
    ),
]

NONE = [
    _case("none", "none_white", "lab", {}, train=("stairs", "prbs 0.8")),
    _case("none", "none_coloured", "wheel", {}, chain="coloured", train=("stairs", "multisine")),
    _case("none", "none_coarse_encoder", "wheel", {}, chain="coarse", train=("stairs", "prbs"), channels=ANGLE),
    _case("none", "none_outliers", "big", {}, chain="spikes", train=("stairs", "chirp")),
    _case("none", "none_uneven", "servo", {}, jitter=0.4, train=("steps", "multisine")),
    _case("none", "none_closed_loop", "lab", {}, train=("loop", "loop"), check="steps"),
    _case("none", "none_no_current", "big", {}, chain="coloured", channels=("omega",), train=("stairs", "ramps")),
    _case("none", "none_angle_only", "servo", {}, channels=("theta",), train=("stairs", "prbs")),
    _case("none", "none_coloured_angle", "lab", {}, chain="coloured", channels=ANGLE, train=("ramps", "stairs 0.5")),
    _case("none", "none_micro", "micro", {}, train=("prbs", "ramps")),
]

OUTSIDE = [
    _case(
        "outside",
        "cam",
        "lab",
        {"cam": {"A": 2.5e-2, "kappa": 6.0, "phi": 0.5}},
        channels=ANGLE,
        train=("stairs 0.5", "ramps 0.6"),
        check="steps 0.5",
    ),
    _case(
        "outside",
        "tight_spot",
        "servo",
        {"tight_spot": {"tau_c": 0.03, "c": 2.5, "phi": 0.4}},
        channels=ANGLE,
        train=("stairs", "ramps"),
    ),
    _case(
        "outside",
        "belt_splice",
        "wheel",
        {"belt_splice": {"tau": 0.15, "width": 3.0, "ratio": 2.7}},
        channels=ANGLE,
        train=("stairs 0.5", "ramps 0.6"),
        check="steps 0.5",
    ),
    _case(
        "outside",
        "grease_warm_up",
        "lab",
        {"grease_warm_up": {"tau_c": 3e-3, "extra": 4.0, "t_g": 0.35}},
        train=("stairs", "ramps"),
    ),
]

TWINS = [
    _case(
        "twins",
        "load_or_coulomb_forward",
        "servo",
        {"constant_load": {"tau_0": 0.04}},
        train=("forward", "waves"),
        check="forward 0.9",
        twins=("coulomb", "coulomb_asymmetric"),
    ),
    _case(
        "twins",
        "lag_or_delay_slow",  # they agree to first order in frequency times T: 3 % here, the next order 0.1 %
        "lab",
        {"speed_delay": {"T_d": 3e-3}},
        train=("multisine 0.8", "slow"),
        check="slow 0.9",
        n=1500,
        noise=0.02,
        twins=("speed_lag",),
    ),
    _case(
        "twins",
        "lost_voltage_forward",  # voltage and current never come near zero, so that all of them are one voltage
        "servo",
        {"driver_dead_band": {"V_d": 0.3}},
        train=("gentle", "gentle"),
        check="gentle 0.9",
        dt=8e-3,
        twins=("voltage_offset", "brush_drop"),
    ),
]

CASES: dict[str, Case] = {c.name: c for c in (*SINGLES, *PAIRS, *NONE, *OUTSIDE, *TWINS)}
