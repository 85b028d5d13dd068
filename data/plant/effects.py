"""What may be hidden in the plant: every effect in the form it has in reality, hard corners included.

An effect is a function of the motor and its own numbers that returns what it does:

    drive(v, w) -> v          the bridge: from the commanded voltage to the one at the terminals
    lag -> s                  time constant with which the driver's voltage follows the command
    slew -> V/s               how fast it changes at most
    bridge(v, i) -> v         the supply behind it: from the voltage of the bridge to the one at the terminals
    diodes -> V               the bridge opens at command 0; what then stands against the dying current
    limit -> A                the current that the bridge does not let grow any further
    drop(i) -> V              voltage lost in the winding circuit
    R(dT), L(i), K(i), Kt(th), Ke(th) -> factor on that constant (K in both balances, Kt in the torque, Ke in the EMF)
    torque(i, w, th, t) -> N·m on the shaft, continuous in its arguments
    dry(i, w, th, s, t) -> N·m, level of dry friction when sliding (or about to slide) in direction s = ±1
    heat(i, dT) -> K/s        rate of the temperature rise
    part(i, w, th, x) -> (torque, rates)   something with states x of its own, which start at `x0`
    flux(x) -> factor on K in both balances, of the states of the effect's part
    sensed                    the first two of these states are the speed and the angle that sensors see
    sensor -> (kind, number)  what happens between the shaft and the logger
    rate                      1/s, the fastest rate it adds, for the choice of the integration step
"""

from __future__ import annotations

from collections.abc import Callable
from math import cos, exp, log, pi, sin, sqrt, tanh
from typing import Any

from .motors import Motor

Hooks = dict[str, Any]
LIBRARY: dict[str, Callable[..., Hooks]] = {}  # what the library of models knows by the same name
BEYOND: dict[str, Callable[..., Hooks]] = {}  # what it does not know


def _known(build: Callable[..., Hooks]) -> Callable[..., Hooks]:
    LIBRARY[build.__name__] = build
    return build


def _unknown(build: Callable[..., Hooks]) -> Callable[..., Hooks]:
    BEYOND[build.__name__] = build
    return build


def build(motor: Motor, effects: dict[str, dict[str, float]]) -> list[Hooks]:
    """Hooks of the named effects; ValueError for a name or a number that is not known."""
    known = LIBRARY | BEYOND
    hooks = []
    for name, values in effects.items():
        if name not in known:
            raise ValueError(f"unknown effect '{name}'; the plant knows {', '.join(known)}")
        try:
            hooks.append(known[name](motor, **values))
        except TypeError as error:
            raise ValueError(f"effect '{name}': {error}") from None
    return hooks


# ---------------------------------------------------------------- voltage


@_known
def brush_drop(m: Motor, V_b: float, i_b: float) -> Hooks:
    return {"drop": lambda i: V_b * tanh(i / i_b), "rate": V_b / i_b / m.L}


@_known
def winding_heating(m: Motor, R_th: float, C_th: float, alpha: float = 0.00393) -> Hooks:
    def heat(i: float, dT: float) -> float:
        return (m.R * (1 + alpha * dT) * i * i - dT / R_th) / C_th

    return {"R": lambda dT: 1 + alpha * dT, "heat": heat}


@_known
def inductance_saturation(m: Motor, i_L: float) -> Hooks:
    return {"L": lambda i: 1 / (1 + (i / i_L) ** 2), "rate": m.R / m.L * (1 + (m.i_max / i_L) ** 2)}


@_known
def magnetic_saturation(m: Motor, i_K: float) -> Hooks:
    return {"K": lambda i: 1 / (1 + (i / i_K) ** 2)}


@_known
def driver_dead_band(m: Motor, V_d: float) -> Hooks:
    return {"drive": lambda v, w: v - V_d if v > V_d else v + V_d if v < -V_d else 0.0}


@_known
def driver_voltage_limit(m: Motor, V_lim: float) -> Hooks:
    return {"drive": lambda v, w: min(max(v, -V_lim), V_lim)}


@_known
def voltage_offset(m: Motor, V_0: float) -> Hooks:
    return {"drive": lambda v, w: v + V_0}


@_known
def driver_coast(m: Motor, V_c: float) -> Hooks:
    return {"diodes": V_c}


@_known
def driver_one_quadrant(m: Motor, V_c: float) -> Hooks:
    """Current flows along the command alone; against it, and at 0, diodes end it against V_c volts."""
    return {"diodes": V_c, "one way": True}


@_known
def pwm_coast(m: Motor, s_c: float, V_s: float) -> Hooks:
    return {"drive": lambda v, w: v + s_c * max(1 - abs(v) / V_s, 0.0) * m.K * w}


@_known
def pwm_fast_decay(m: Motor, a_p: float, V_s: float) -> Hooks:
    def mean(v: float, w: float) -> float:
        e = m.K * w if v >= 0 else -m.K * w
        on = min(abs(v) / V_s, 1.0)
        peak = (V_s - e) * (1 - exp(-a_p * on))  # times R: of the current that begins at nothing
        back = min(log((V_s + e + peak) / (V_s + e)) / a_p, 1 - on)
        u = on * V_s - back * V_s + (1 - on - back) * e
        return u if v >= 0 else -u

    return {"drive": mean}


@_known
def driver_current_limit(m: Motor, I_lim: float) -> Hooks:
    return {"limit": I_lim}


@_known
def driver_lag(m: Motor, T_v: float) -> Hooks:
    return {"lag": T_v}


@_known
def driver_slew(m: Motor, T_r: float, V_s: float) -> Hooks:
    return {"slew": V_s / T_r}


@_known
def supply_sag(m: Motor, R_s: float, V_s: float) -> Hooks:
    return {"bridge": lambda v, i: v / V_s * (V_s - R_s * v / V_s * i), "rate": (m.R + R_s) / m.L}


@_known
def magnet_heating(m: Motor, R_thm: float, C_thm: float, alpha_m: float = 0.002) -> Hooks:
    """Magnets of one temperature rise x, with the copper's heat."""

    def part(i: float, w: float, th: float, x: list[float]) -> tuple[float, tuple[float, ...]]:
        return 0.0, ((m.R * i * i - x[0] / R_thm) / C_thm,)

    return {"part": part, "x0": lambda w, th: (0.0,), "flux": lambda x: 1 / (1 + alpha_m * x[0])}


# ---------------------------------------------------------------- torque


@_known
def coulomb(m: Motor, tau_c: float) -> Hooks:
    return {"dry": lambda i, w, th, s, t: tau_c}


@_known
def coulomb_asymmetric(m: Motor, tau_cp: float, tau_cn: float) -> Hooks:
    return {"dry": lambda i, w, th, s, t: tau_cp if s > 0 else tau_cn}


@_known
def stribeck(m: Motor, tau_c: float, tau_s: float, omega_s: float) -> Hooks:
    return {"dry": lambda i, w, th, s, t: tau_c + (tau_s - tau_c) * exp(-((w / omega_s) ** 2))}


@_known
def quadratic_drag(m: Motor, c_2: float) -> Hooks:
    return {"torque": lambda i, w, th, t: -c_2 * w * abs(w)}


@_known
def constant_load(m: Motor, tau_0: float) -> Hooks:
    return {"torque": lambda i, w, th, t: -tau_0}


@_known
def gravity(m: Motor, mgl: float, phi_g: float = 0.0) -> Hooks:
    return {"torque": lambda i, w, th, t: -mgl * sin(th + phi_g)}


@_known
def cogging(m: Motor, A: float, N: float, phi: float = 0.0) -> Hooks:
    return {"torque": lambda i, w, th, t: -A * sin(N * th + phi), "rate": N * m.no_load_speed}


@_known
def torque_ripple(m: Motor, a_r: float, N_r: float, phi_r: float = 0.0, e_r: float = 0.0) -> Hooks:
    return {"Kt": lambda th: 1 + a_r * sin(N_r * th + phi_r), "Ke": lambda th: 1 + e_r * a_r * sin(N_r * th + phi_r),
            "rate": N_r * m.no_load_speed}


@_known
def load_friction(m: Motor, mu: float) -> Hooks:
    return {"dry": lambda i, w, th, s, t: mu * abs(m.K * i)}


@_known
def viscous_asymmetric(m: Motor, b_a: float) -> Hooks:
    """Viscous friction b + b_a forward and b − b_a backward."""
    return {"torque": lambda i, w, th, t: -b_a * abs(w)}


@_known
def eddy_brake(m: Motor, c_e: float, omega_b: float) -> Hooks:
    return {"torque": lambda i, w, th, t: -c_e * w / (1 + (w / omega_b) ** 2)}


@_known
def spring(m: Motor, k_s: float, theta_0: float = 0.0) -> Hooks:
    return {"torque": lambda i, w, th, t: -k_s * (th - theta_0)}


@_known
def end_stop(m: Motor, k_stop: float, theta_lo: float, theta_hi: float, d_stop: float) -> Hooks:
    """Two elastic stops that only push; what they give back is the less, the faster they are left."""

    def push(depth: float, speed: float) -> float:
        return k_stop * depth * max(0.0, 1 + d_stop * speed) if depth > 0 else 0.0

    return {"torque": lambda i, w, th, t: push(theta_lo - th, -w) - push(th - theta_hi, w)}


@_known
def angular_friction(m: Motor, tau_m: float, a_f: float, N_f: float = 1, phi_f: float = 0.0) -> Hooks:
    """A bent shaft or an oval bearing: dry friction that depends on the angle."""
    return {"dry": lambda i, w, th, s, t: tau_m * (1 + a_f * sin(N_f * th + phi_f))}


@_known
def gear_efficiency(m: Motor, mu_d: float, mu_b: float) -> Hooks:
    """Of the motor's torque a share is lost, another one when it brakes."""
    return {"dry": lambda i, w, th, s, t: (mu_d if i * s > 0 else mu_b) * abs(m.K * i)}


@_known
def lugre(m: Motor, sigma_0: float, sigma_1: float, tau_c: float, tau_s: float, omega_s: float) -> Hooks:
    """Bristles of mean deflection z: Canudas de Wit et al., IEEE Trans. Automatic Control 40(3), 1995."""

    def part(i: float, w: float, th: float, x: list[float]) -> tuple[float, tuple[float, ...]]:
        level = tau_c + (tau_s - tau_c) * exp(-((w / omega_s) ** 2))
        dz = w - sigma_0 * abs(w) / level * x[0]
        return -(sigma_0 * x[0] + sigma_1 * dz), (dz,)

    return {"part": part, "x0": lambda w, th: (0.0,), "rate": sigma_0 * m.no_load_speed / tau_c}


# ---------------------------------------------------------------- transmission


@_known
def compliance(m: Motor, k_s: float, c_s: float, J_l: float) -> Hooks:
    """A load of inertia J_l behind a shaft of stiffness k_s and damping c_s; sensors on the motor side."""

    def part(i: float, w: float, th: float, x: list[float]) -> tuple[float, tuple[float, ...]]:
        twist = k_s * (th - x[1]) + c_s * (w - x[0])
        return -twist, (twist / J_l, x[0])

    return {"part": part, "x0": lambda w, th: (w, th), "rate": sqrt(k_s / m.J + k_s / J_l)}


@_known
def compliance_load_side(m: Motor, k_s: float, c_s: float, J_l: float) -> Hooks:
    """The same shaft and load, whose speed and angle are sensed."""
    return {**compliance(m, k_s, c_s, J_l), "sensed": True}


@_known
def backlash(m: Motor, gap: float, k_s: float, c_s: float, J_l: float) -> Hooks:
    """The same load behind a free play of width `gap` (rad): it can be pushed, never pulled."""

    def part(i: float, w: float, th: float, x: list[float]) -> tuple[float, tuple[float, ...]]:
        twist = th - x[1]
        if abs(twist) <= gap / 2:
            push = 0.0
        elif twist > 0:
            push = max(0.0, k_s * (twist - gap / 2) + c_s * (w - x[0]))
        else:
            push = min(0.0, k_s * (twist + gap / 2) + c_s * (w - x[0]))
        return -push, (push / J_l, x[0])

    # The push jumps at contact and the step does not look for that instant: short steps keep it harmless.
    return {"part": part, "x0": lambda w, th: (w, th), "rate": 20 * sqrt(k_s / m.J + k_s / J_l)}


@_known
def slip_clutch(m: Motor, tau_slip: float, omega_slip: float, b_slip: float, J_l: float) -> Hooks:
    """A load of inertia J_l and friction b_slip, driven by at most tau_slip; just before it creeps by omega_slip."""

    def part(i: float, w: float, th: float, x: list[float]) -> tuple[float, tuple[float, ...]]:
        carried = tau_slip * max(-1.0, min(1.0, (w - x[0]) / omega_slip))
        return -carried, ((carried - b_slip * x[0]) / J_l,)

    return {"part": part, "x0": lambda w, th: (w,), "rate": tau_slip / omega_slip * (1 / m.J + 1 / J_l)}


@_known
def freewheel(m: Motor, c_g: float, b_free: float, J_l: float, side: float = 1.0) -> Hooks:
    """A load that is driven in one direction, by a grip c_g, and free to overrun."""

    def part(i: float, w: float, th: float, x: list[float]) -> tuple[float, tuple[float, ...]]:
        carried = side * c_g * max(0.0, side * (w - x[0]))
        return -carried, ((carried - b_free * x[0]) / J_l,)

    return {"part": part, "x0": lambda w, th: (w,), "rate": c_g * (1 / m.J + 1 / J_l)}


# ---------------------------------------------------------------- sensor


@_known
def speed_lag(m: Motor, T_w: float) -> Hooks:
    return {"sensor": ("speed_lag", T_w), "rate": 1 / T_w}


@_known
def speed_filter(m: Motor, T_f: float, zeta_f: float) -> Hooks:
    return {"sensor": ("speed_filter", (T_f, zeta_f)), "rate": max(1.0, zeta_f) / T_f}


@_known
def current_lag(m: Motor, T_i: float) -> Hooks:
    return {"sensor": ("current_lag", T_i), "rate": 1 / T_i}


@_known
def current_average(m: Motor, T_m: float) -> Hooks:
    """The charge of the last T_m seconds, over T_m."""
    return {"sensor": ("current_average", T_m)}


@_known
def angle_lag(m: Motor, T_pos: float) -> Hooks:
    return {"sensor": ("angle_lag", T_pos), "rate": 1 / T_pos}


@_known
def speed_delay(m: Motor, T_d: float) -> Hooks:
    return {"sensor": ("speed_delay", T_d)}


@_known
def current_offset(m: Motor, i_0: float) -> Hooks:
    return {"sensor": ("current_offset", i_0)}


@_known
def speed_gain(m: Motor, k_w: float) -> Hooks:
    """The speed scale is wrong by the fraction k_w."""
    return {"sensor": ("speed_gain", 1 + k_w)}


@_known
def speed_average(m: Motor, T_a: float) -> Hooks:
    """The angle now less that of T_a seconds ago, over T_a."""
    return {"sensor": ("speed_average", T_a)}


@_known
def speed_offset(m: Motor, w_0: float) -> Hooks:
    return {"sensor": ("speed_offset", w_0)}


@_known
def speed_ripple(m: Motor, a_w: float, N_w: float, phi_w: float = 0.0, e_w: float = 0.0) -> Hooks:
    """A tacho's ripple over the turn; with e_w = 1 of an encoder, whose angle shows the integral of it."""
    return {"sensor": ("speed_ripple", (a_w, N_w, phi_w, e_w))}


@_known
def current_gain(m: Motor, k_i: float) -> Hooks:
    return {"sensor": ("current_gain", 1 + k_i)}


@_known
def supply_side_current(m: Motor, V_dc: float, u_i: float = 0) -> Hooks:
    """Times the duty; the supply's current, without the motor's sign, if u_i is 1."""
    return {"sensor": ("duty", lambda v: (v if u_i else abs(v)) / V_dc)}


# ---------------------------------------------------------------- beyond the library


@_unknown
def tight_spot(m: Motor, tau_c: float, c: float, kappa: float = 8.0, phi: float = 0.0) -> Hooks:
    """A dent in the bearing: dry friction that is (1 + c) times as large in one narrow place."""
    return {"dry": lambda i, w, th, s, t: tau_c * (1 + c * exp(kappa * (cos(th + phi) - 1)))}


@_unknown
def cam(m: Motor, A: float, kappa: float = 6.0, phi: float = 0.0) -> Hooks:
    """A spring pressed down by a narrow lobe once per turn: many harmonics, and no energy lost."""
    return {"torque": lambda i, w, th, t: -A * sin(th + phi) * exp(kappa * (cos(th + phi) - 1))}


@_unknown
def grease_warm_up(m: Motor, tau_c: float, extra: float, t_g: float) -> Hooks:
    """Dry friction that is (1 + extra) times too large when cold and decays with the running time."""
    return {"dry": lambda i, w, th, s, t: tau_c * (1 + extra * exp(-t / t_g))}


@_unknown
def bridge_loss(m: Motor, s: float) -> Hooks:
    """The bridge loses the fraction s of its voltage at the no-load speed, and as speed³ below."""
    return {"drive": lambda v, w: v * (1 - s * abs(w / m.no_load_speed) ** 3)}


@_unknown
def root_drag(m: Motor, c_r: float) -> Hooks:
    """A seal whose drag grows as the square root of the speed."""
    return {"torque": lambda i, w, th, t: -c_r * (sqrt(w) if w > 0 else -sqrt(-w))}


@_unknown
def belt_splice(m: Motor, tau: float, width: float = 0.4, ratio: float = 3.7) -> Hooks:
    """A belt joint that adds dry friction while it runs over the pulley, once per belt turn."""
    period = 2 * pi * ratio
    return {"dry": lambda i, w, th, s, t: tau if th % period < width else 0.0}
