"""The plant of the fourth battery: lists of small functions, an explicit midpoint rule, friction as an impulse.

A law adds functions of the state `x` to the lists of a `Plant`: volts, torques, caps of dry friction, factors. Steps
are small and fixed. Dry friction is Moreau's time stepping: the impulse within ±F·h that brings the speed nearest to
zero, so that sticking is exact and friction never drives. Diodes, limits and ratchets act after each step, hard.
Sizes are relative: torques to the stall torque, speeds to the no-load speed, currents to the stall current.
"""

from __future__ import annotations

import math
import zlib
from types import SimpleNamespace

import numpy as np
from scipy.signal import lfilter

MOTORS = {  # R, L, K, b, J, largest voltage, tick, length of a run, fine step
    "coreless16": (3.6, 0.36e-3, 0.0114, 6e-7, 1.2e-7, 9.0, 1e-4, 0.2, 1e-5),
    "coreless35": (0.6, 0.12e-3, 0.030, 3e-6, 7e-6, 24.0, 2e-4, 0.36, 1e-5),
    "toy": (1.1, 0.6e-3, 0.0085, 3e-6, 1.6e-6, 6.0, 1e-3, 1.1, 5e-5),
    "window": (0.7, 1.0e-3, 0.022, 3e-5, 2e-5, 12.0, 1e-3, 1.5, 5e-5),
    "pump": (0.5, 0.5e-3, 0.033, 6e-5, 1e-4, 12.0, 1e-3, 2.2, 5e-5),
    "servo": (2.2, 1.6e-3, 1.1, 0.03, 6e-3, 12.0, 1e-3, 1.8, 5e-5),
    "planet": (0.35, 0.35e-3, 0.5, 0.025, 0.01, 24.0, 1e-3, 1.5, 5e-5),
    "disc": (0.8, 0.1e-3, 0.18, 6e-4, 4e-4, 48.0, 2.5e-4, 0.5, 1.25e-5),
    "industrial": (0.9, 4e-3, 0.28, 2e-3, 9e-4, 90.0, 5e-4, 0.9, 2.5e-5),
    "scooter": (0.18, 0.25e-3, 0.11, 1.5e-3, 2e-3, 36.0, 1e-3, 1.8, 5e-5),
    "reel": (1.0, 5e-3, 0.12, 1.2e-3, 8e-3, 24.0, 5e-3, 12.0, 5e-4),
    "belt": (1.2, 1.5e-3, 6.0, 3.0, 1.2, 24.0, 1e-3, 1.6, 5e-5),
    # a drive with a current loop of its own: the command is a torque
    "gimbal": (1.0, 1.0, 1.0, 6e-4, 1.5e-4, 0.06, 1e-3, 2.0, 1e-4),
}
TORQUE, LINEAR = {"gimbal"}, {"belt"}
TURN = 2 * math.pi


def seed(name: str) -> int:
    return zlib.crc32(("fourth " + name).encode())


def motor(name, rng, damped=1.0):
    """Return one of a kind: its values spread by a tenth or two; `damped`: on a bench with so many times its `b`."""
    m = dict(zip(("R", "L", "K", "b", "J", "V", "dt", "T", "h"), MOTORS[name], strict=True))
    m["torque"] = name in TORQUE
    for k in "bJ" if m["torque"] else "RLKbJ":
        m[k] *= float(rng.uniform(0.85, 1.18))
    m["b"] *= damped
    m["is"] = m["V"] / m["R"]
    m["ts"] = m["K"] * m["is"]
    m["ws"] = m["ts"] / m["b"] if m["torque"] else m["V"] / (m["K"] + m["b"] * m["R"] / m["K"])
    m["tm"] = 0.3 * m["J"] / m["b"] if m["torque"] else m["R"] * m["J"] / m["K"] ** 2
    return m


class Plant:
    """The functions that act: `drive(x, u)` gives the voltage, `limits(x)` correct x, `events(x, h)` end a step."""

    def __init__(self, m, eff):
        self.__dict__.update({k: m[k] for k in ("R", "L", "K", "b", "J", "V", "ts", "ws", "tm", "torque")})
        self.Is, self.T = m["is"], m["T"]
        self.drive, self.volts, self.torques, self.dry = [], [], [], []
        self.limits, self.events = [], []
        self.factors = {k: [] for k in ("R", "L", "K", "J")}
        self.rates, self.first = {}, {}
        for name, size in eff.items():
            if name not in SENSORS:
                LAW[name](self, *(size if isinstance(size, tuple) else (size,)))

    def state(self, name, rate, first=0.0):
        self.rates[name], self.first[name] = rate, first

    def start(self, th, **more):
        """Return the state at rest at the angle `th`; `more`: what the bench gives to every run."""
        return SimpleNamespace(t=0.0, v=0.0, i=0.0, w=0.0, th=th, u=0.0, **{**self.first, **more})

    def slopes(self, x):
        """Return di/dt, dω/dt without dry friction, and the dry friction's cap, with the inertia."""
        u, R, L, K, J = x.a, self.R, self.L, self.K, self.J
        for f in self.drive:
            u = f(x, u)
        for f in self.factors["R"]:
            R *= f(x)
        for f in self.factors["L"]:
            L *= f(x)
        for f in self.factors["K"]:
            K *= f(x)
        for f in self.factors["J"]:
            J *= f(x)
        x.u = u
        if self.torque:
            x.i, di = u, 0.0
        else:
            e = u - R * x.i - K * x.w
            for f in self.volts:
                e += f(x)
            di = e / L
        q = K * x.i - self.b * x.w
        for f in self.torques:
            q += f(x)
        F = 0.0
        for f in self.dry:
            F += f(x)
        return di, q / J, F / J

    def step(self, x, h):
        """Go on by `h`: explicit midpoint; dry friction as an impulse that cannot turn the speed around."""
        t, i, w, th = x.t, x.i, x.w, x.th
        old = [getattr(x, z) for z in self.rates]
        for part in (0.5 * h, h):
            di, dw, F = self.slopes(x)
            more, speed = [f(x) for f in self.rates.values()], x.w
            free = w + part * dw
            x.t, x.i, x.th = t + part, i + part * di, th + part * speed
            x.w = math.copysign(max(abs(free) - part * F, 0.0), free)
            for z, z0, dz in zip(self.rates, old, more, strict=True):
                setattr(x, z, z0 + part * dz)
            for f in self.limits:
                f(x)
        for f in self.events:
            f(x, h)


LAW = {}


def law(f):
    LAW[f.__name__] = f
    return f


def clip(a, low, high):
    return low if a < low else high if a > high else a


def within(a, width, edge=0.05):
    """Return 1 where the fraction of `a` is below `width`, 0 beyond, with short ramps (the width of a brush)."""
    a %= 1.0
    return clip(min(a, width - a) / edge, 0.0, 1.0)


def sgn(a):
    return (a > 0) - (a < 0)


# ---- the library's effects, hard. Voltage
@law
def brush_drop(p, f):
    p.volts.append(lambda x: -f * p.V * clip(x.i / (0.015 * p.Is), -1.0, 1.0))


@law
def winding_heating(p, rise, tau):  # R grows by the share `rise` under half the stall current for ever
    p.factors["R"].append(lambda x: 1 + x.hot)
    p.state("hot", lambda x: (rise * (1 + x.hot) * (2 * x.i / p.Is) ** 2 - x.hot) / tau)


@law
def winding_warm_start(p):  # the bench gives `hot` to the runs
    pass


@law
def magnet_heating(p, fall, tau):
    p.factors["K"].append(lambda x: 1 / (1 + x.warm))
    p.state("warm", lambda x: (fall * (2 * x.i / p.Is) ** 2 - x.warm) / tau)


@law
def inductance_saturation(p, f):
    p.factors["L"].append(lambda x: 1 / (1 + (x.i / (f * p.Is)) ** 2))


@law
def magnetic_saturation(p, f):
    p.factors["K"].append(lambda x: 1 / (1 + (x.i / (f * p.Is)) ** 2))


@law
def driver_dead_band(p, f):
    p.drive.append(lambda x, u: u - clip(u, -f * p.V, f * p.V))


@law
def driver_coast(p):  # diodes lead the current into the supply until it is gone
    def diodes(x, u):
        if u:
            return u
        return -1.05 * p.V * sgn(x.i) if x.i else p.K * x.w

    def ends(x, h):
        if not x.a and x.i * x.before <= 0:
            x.i = 0.0
        x.before = x.i
    p.drive.append(diodes)
    p.first["before"] = 0.0
    p.events.append(ends)


@law
def driver_current_limit(p, f):
    def chop(x):
        x.i = clip(x.i, -f * p.Is, f * p.Is)
    p.limits.append(chop)


@law
def supply_sag(p, f):
    p.drive.append(lambda x, u: u - f * p.R * (u / p.V) ** 2 * x.i)


@law
def voltage_offset(p, f):
    p.drive.append(lambda x, u: u + f * p.V)


@law
def measured_supply(p):  # the bench gives `bus`: the supply over time
    p.drive.append(lambda x, u: u * x.bus(x.t) / p.V)


@law
def supply_per_run(p):
    p.drive.append(lambda x, u: u * x.share)


# ---- torque
@law
def coulomb(p, f):
    p.dry.append(lambda x: f * p.ts)


@law
def coulomb_asymmetric(p, forward, backward):
    p.dry.append(lambda x: p.ts * (forward if x.w > 0 or (not x.w and p.K * x.i > 0) else backward))


@law
def stribeck(p, f, breakaway, speed):
    p.dry.append(lambda x: p.ts * (f + (breakaway - f) * math.exp(-((x.w / (speed * p.ws)) ** 2))))


@law
def lugre(p, f, ratio, speed, angle):  # bristles, bent by up to `angle` (rad)
    def rate(x):
        return x.w - abs(x.w) * x.bent / (angle * (1 + (ratio - 1) * math.exp(-((x.w / (speed * p.ws)) ** 2))))
    p.state("bent", rate)
    p.torques.append(lambda x: -f * p.ts * (x.bent / angle + rate(x) / (speed * p.ws)))


@law
def angular_friction(p, f, a, n, phi):
    p.dry.append(lambda x: f * p.ts * (1 + a * math.sin(n * x.th + phi)))


@law
def viscous_asymmetric(p, f):
    p.torques.append(lambda x: -f * p.ts / p.ws * abs(x.w))


@law
def quadratic_drag(p, f):
    p.torques.append(lambda x: -f * p.ts * x.w * abs(x.w) / p.ws**2)


@law
def eddy_brake(p, peak, at):
    p.torques.append(lambda x: -2 * peak * p.ts * (y := x.w / (at * p.ws)) / (1 + y * y))


@law
def load_friction(p, mu):
    p.dry.append(lambda x: mu * abs(p.K * x.i))


@law
def gear_efficiency(p, lost, lost_back):
    p.dry.append(lambda x: abs(p.K * x.i) * (lost if x.i * x.w >= 0 else lost_back))


@law
def constant_load(p, f):
    p.torques.append(lambda x: -f * p.ts)


@law
def measured_load(p):  # the bench gives `load`: a torque over time
    p.torques.append(lambda x: -x.load(x.t))


@law
def gravity(p, f, phi):
    p.torques.append(lambda x: -f * p.ts * math.sin(x.th + phi))


@law
def spring(p, f, at):  # `f` per rad
    p.torques.append(lambda x: -f * p.ts * (x.th - at))


@law
def cogging(p, f, n, phi):
    p.torques.append(lambda x: -f * p.ts * math.sin(n * x.th + phi))


@law
def torque_ripple(p, a, n, phi):
    p.torques.append(lambda x: a * p.K * x.i * math.sin(n * x.th + phi))


# ---- transmission: two inertias, the torque between them a function of the twist and the slip
def coupled(p, share, between, load=lambda x: 0.0):
    p.factors["J"].append(lambda x: 1 - share)
    p.state("w2", lambda x: (between(x) + load(x)) / (share * p.J))
    p.state("twist", lambda x: x.w - x.w2)
    p.torques.append(lambda x: -between(x))


@law
def compliance(p, r, omega, zeta):
    k, c = omega**2 * p.J * r * (1 - r), 2 * zeta * omega * p.J * r * (1 - r)
    coupled(p, r, lambda x: k * x.twist + c * (x.w - x.w2))


@law
def backlash(p, r, gap, omega, zeta):  # flanks press, they do not pull
    k, c = omega**2 * p.J * r * (1 - r), 2 * zeta * omega * p.J * r * (1 - r)

    def flanks(x):
        if abs(x.twist) <= gap / 2:
            return 0.0
        side = sgn(x.twist)
        return side * max(k * (abs(x.twist) - gap / 2) + side * c * (x.w - x.w2), 0.0)
    coupled(p, r, flanks)


@law
def speed_lag(p, tau):
    p.state("wm", lambda x: (x.w - x.wm) / tau)


@law
def current_lag(p, tau):
    p.state("im", lambda x: (x.i - x.im) / tau)


# ---- what the library lacks. Magnets and winding
@law
def x_notch(p, depth, n, width):  # no torque to speak of while brushes bridge two segments
    p.factors["K"].append(lambda x: 1 - depth * within(x.th * n / TURN, width))


@law
def x_flux_memory(p, f, width):  # iron keeps some of the flux that the last large current left
    def play(x, h):
        x.left = clip(x.left, x.i / p.Is - width, x.i / p.Is + width)
    p.first["left"] = 0.0
    p.events.append(play)
    p.factors["K"].append(lambda x: 1 + f * x.left)


@law
def x_one_way_flux(p, f):  # magnets not magnetised alike: another constant in each direction
    p.factors["K"].append(lambda x: 1 + f * sgn(x.w))


@law
def x_open_coil(p, f, n):  # burnt segments: resistance over a part of the turn
    p.factors["R"].append(lambda x: 1 + f * within(x.th * n / TURN, 0.3))


@law
def x_brush_noise(p, f):  # a contact whose resistance wanders
    p.factors["R"].append(lambda x: math.exp(f * x.wild(x.t)))


# ---- drives and supplies
@law
def x_chopper(p):  # one switch and a diode: the current never turns, and is zero in between when the duty is low
    def diode(x):
        x.i = max(x.i, 0.0)
    p.limits.append(diode)


@law
def x_ripple(p, f, hertz):  # a rectified supply, not logged, by the clock of the mains
    p.drive.append(lambda x, u: u * (1 - f * abs(math.sin(math.pi * hertz * x.t + x.phase))))


@law
def x_slew(p, tau):  # an output stage that cannot change faster
    def slewing(x, h):
        x.out += clip(x.a - x.out, -p.V * h / tau, p.V * h / tau)
    p.first["out"] = 0.0
    p.events.append(slewing)
    p.drive.append(lambda x, u: x.out)


@law
def x_bus_capacitor(p, f, tau):  # a capacitor behind a diode and a resistance: sags late, and recovers late
    Rs = f * p.R

    def rate(x):
        drawn = x.u * x.i / max(x.bus_v, 0.2 * p.V)
        return (max((p.V - x.bus_v) / Rs, 0.0) - drawn) * Rs / tau
    p.state("bus_v", rate, p.V)
    p.drive.append(lambda x, u: u * x.bus_v / p.V)


@law
def x_foldback(p, high, low, budget):  # I²t: the limit falls when the winding has had enough
    def warms(x, h):
        x.heat = max(x.heat + h * ((x.i / p.Is) ** 2 - low**2), 0.0)

    def limit(x):
        top = p.Is * (low if x.heat > budget else high)
        x.i = clip(x.i, -top, top)
    p.first["heat"] = 0.0
    p.events.append(warms)
    p.limits.append(limit)


@law
def x_gain_curve(p, f):  # an amplifier that gives less and less torque
    p.drive.append(lambda x, u: p.V / f * math.tanh(f * u / p.V))


# ---- friction and drag
@law
def x_warm_grease(p, f, tau):  # thick when cold, thin after work
    p.torques.append(lambda x: -f * p.ts / p.ws * x.w * math.exp(-x.worked))
    p.state("worked", lambda x: (x.w / p.ws) ** 2 / tau)


@law
def x_run_in(p, f, more, tau):  # a new bearing: friction falls as the run goes on
    p.dry.append(lambda x: f * p.ts * (1 + more * math.exp(-x.t / tau)))


@law
def x_thread(p, f, span):  # a screw that cuts its thread: friction grows with the deepest place reached
    def deepest(x, h):
        x.deep = max(x.deep, x.th)
    p.first["deep"] = 0.0
    p.events.append(deepest)
    p.dry.append(lambda x: f * p.ts * min(x.deep / span, 1.0))


@law
def x_dwell(p, f, more, tau):  # sticks the harder the longer it has stood
    def rest(x, h):
        x.stood = x.stood + h if abs(x.w) < 1e-3 * p.ws else x.stood * math.exp(-h / (0.05 * tau))
    p.first["stood"] = tau
    p.events.append(rest)
    p.dry.append(lambda x: f * p.ts * (1 + more * (1 - math.exp(-x.stood / tau))))


@law
def x_root_load(p, f):  # grows with the square root of the speed
    p.torques.append(lambda x: -f * p.ts * math.copysign(math.sqrt(abs(x.w) / p.ws), x.w))


@law
def x_damper(p, f, cap):  # a hydraulic damper: oil one way, vapour the other
    p.torques.append(lambda x: -f * p.ts * x.w / p.ws if x.w > 0 else min(-f * x.w / p.ws, cap * f) * p.ts)


@law
def x_fan_stall(p, f, at, left):  # blades stall above a speed, and recover well below it
    def switch(x, h):
        y = abs(x.w) / p.ws
        x.stalled = y > (0.75 * at if x.stalled else at)
    p.first["stalled"] = False
    p.events.append(switch)
    p.torques.append(lambda x: -(left if x.stalled else 1.0) * f * p.ts * x.w * abs(x.w) / p.ws**2)


@law
def x_entrained(p, f, tau):  # a mixer: the fluid starts to turn along
    def drag(x):
        return f * p.ts * (x.w - x.fluid) * abs(x.w - x.fluid) / p.ws**2
    p.torques.append(lambda x: -drag(x))
    p.state("fluid", lambda x: (0.7 * x.w - x.fluid) / tau)


# ---- loads
@law
def x_rope_layers(p, f, more, span):  # a drum: with each layer of rope the lever grows at once
    p.torques.append(lambda x: -f * p.ts * (1 + more * math.floor(abs(x.th) / span)))


@law
def x_cable_wrap(p, f, slack, span):  # loose, then tighter and tighter, both ways
    p.torques.append(lambda x: -f * p.ts * sgn(x.th) * (max(abs(x.th) - slack, 0.0) / span) ** 2)


@law
def x_ratchet(p, n):  # a pawl: backward only to the last tooth
    def pawl(x, h):
        x.tooth = max(x.tooth, math.floor(x.th * n / TURN))
        if x.th < x.tooth * TURN / n:
            x.th, x.w = x.tooth * TURN / n, max(x.w, 0.0)
    p.first["tooth"] = -math.inf
    p.events.append(pawl)


@law
def x_detent(p, f, n):  # magnets that saturate: cogging with flat tops
    p.torques.append(lambda x: -f * p.ts * clip(3 * math.sin(n * x.th), -1.0, 1.0))


@law
def x_tumbler(p, f, play):  # a loose weight in a drum, carried along late
    def carried(x, h):
        x.weight = clip(x.weight, x.th - play, x.th + play)
    p.first["weight"] = 0.0
    p.events.append(carried)
    p.torques.append(lambda x: -f * p.ts * math.sin(x.weight))


@law
def x_gust(p, f):  # wind on a rotor
    p.torques.append(lambda x: -f * p.ts * x.wild(x.t))


@law
def x_eccentric_gear(p, e):  # a ratio that varies over the turn, a load behind it: J(θ), with its own torque
    p.factors["J"].append(lambda x: (1 + e * math.sin(x.th)) ** 2)
    p.torques.append(lambda x: -p.J * (1 + e * math.sin(x.th)) * e * math.cos(x.th) * x.w**2)


@law
def x_governor(p, f):  # weights that fly out: the inertia grows with the speed
    p.factors["J"].append(lambda x: 1 + 3 * f * (x.w / p.ws) ** 2)  # of the momentum J·ω·(1 + f·(ω/ω_s)²)


@law
def x_slip_clutch(p, r, cap):  # carries up to a torque, then slips
    slip = 0.004 * p.ws
    coupled(p, r, lambda x: cap * p.ts * clip((x.w - x.w2) / slip, -1.0, 1.0), lambda x: -0.05 * p.ts * x.w2 / p.ws)


@law
def x_rubber(p, r, omega, zeta, angle):  # a coupling of rubber: the stiffer the more it is twisted
    k, c = omega**2 * p.J * r * (1 - r), 2 * zeta * omega * p.J * r * (1 - r)
    coupled(p, r, lambda x: k * x.twist * (1 + (x.twist / angle) ** 2) + c * (x.w - x.w2))


@law
def x_magnet_coupling(p, r, cap, n, zeta):  # poles that pull through a wall, and jump when it is too much
    c = 2 * zeta * math.sqrt(cap * p.ts * n * p.J * r)
    coupled(p, r, lambda x: cap * p.ts * math.sin(n * x.twist) + c * (x.w - x.w2))


@law
def x_tracking_loop(p, omega, zeta):  # a speed from a resolver's tracking loop: it overshoots
    p.state("wm", lambda x: x.wdd)
    p.state("wdd", lambda x: omega**2 * (x.w - x.wm) - 2 * zeta * omega * x.wdd)


# ---- sensors that only read, applied to the samples
SENSORS = {}


def sensor(f):
    SENSORS[f.__name__] = f
    return f


def late(a, q):
    """Return the samples `a`, `q` of them later."""
    return np.concatenate([np.full(q, a[0]), a[: len(a) - q]])


@sensor
def speed_delay(s, m, tau):
    s.w = late(s.w, round(tau / m["dt"]))


@sensor
def speed_average(s, m, tau):
    q = round(tau / m["dt"])
    s.w = (s.th - late(s.th, q)) / (q * m["dt"])


@sensor
def speed_gain(s, m, f):
    s.w = s.w * (1 + f)


@sensor
def speed_offset(s, m, f):
    s.w = s.w + f * m["ws"]


@sensor
def current_offset(s, m, f):
    s.i = s.i + f * m["is"]


@sensor
def current_gain(s, m, f):
    s.i = s.i * (1 + f)


@sensor
def supply_side_current(s, m, signed):
    s.i = s.i * (np.abs(s.v) if signed else s.v) / m["V"]


@sensor
def encoder_zero(s, m):
    s.th = s.th - s.th[0]


@sensor
def x_encoder_orders(s, m, e):  # a disc off its centre, oval, with marks unevenly printed; the speed comes from it
    off = e * (np.sin(s.th + 0.4) + 0.5 * np.sin(2 * s.th + 1.9) + 0.25 * np.sin(5 * s.th))
    s.w = s.w * (1 + e * (np.cos(s.th + 0.4) + np.cos(2 * s.th + 1.9) + 1.25 * np.cos(5 * s.th)))
    s.th = s.th + off


@sensor
def x_compressed(s, m, f):  # a sensor's core that saturates
    s.i = np.tanh(f * s.i / m["is"]) * m["is"] / f


@sensor
def x_drift(s, m, f, tau):  # a zero that wanders as the board warms up
    s.i = s.i + f * m["is"] * (1 - np.exp(-s.t / tau))


@sensor
def x_crosstalk(s, m, f):  # a shunt amplifier that lets some of the terminal voltage through
    s.i = s.i + f * s.v / m["R"]


@sensor
def x_clock(s, m, f):  # the speed comes from a logger whose clock is slow: later and later
    s.w = np.interp(s.t * (1 - f), s.t, s.w)


@sensor
def x_encoder_slips(s, m, at, angle):  # a grub screw: the disc slips at each hard jerk
    hard = np.abs(np.gradient(s.w, s.t)) > at * m["ws"] / m["tm"]
    jerks = np.flatnonzero(hard[1:] & ~hard[:-1])
    s.th = s.th.copy()
    for k in jerks:
        s.th[k + 1:] -= angle * np.sign(s.w[k + 2] - s.w[k] if k + 2 < len(s.w) else 1.0)


@sensor
def x_tacho_flat(s, m, f):  # a magnetic tacho that saturates: flat at speed
    s.w = np.tanh(f * s.w / m["ws"]) * m["ws"] / f


# ---- excitation: voltages (torques) of n ticks, or a controller f(k, ω, θ)
def steps_of(rng, n, dt, shortest, longest, level):
    """Return random levels, each for a random time."""
    out, k = np.empty(n), 0
    while k < n:
        q = max(round(rng.uniform(shortest, longest) / dt), 2)
        out[k:k + q] = level()
        k += q
    return out


def excitation(kind, rng, m, n, dt):
    name, _, size = kind.partition(":")
    T = n * dt
    tc = clip(m["tm"], T / 70, T / 14)
    t, A = np.arange(n) * dt, float(size or 1.0) * m["V"]
    if name in ("speed", "position"):
        return loop(name, rng, m, n, dt, tc, float(size or 1.0))
    if name == "stairs":
        ladder = np.concatenate([np.linspace(0.15, 1, 6), [0.5, 0.0], -np.linspace(0.2, 1, 5), [-0.5]])
        u = np.repeat(ladder, math.ceil(n / len(ladder)))[:n]
    elif name == "levels":
        u = steps_of(rng, n, dt, 2 * tc, 6 * tc, lambda: rng.uniform(-1, 1))
    elif name == "lift":
        u = steps_of(rng, n, dt, 2 * tc, 6 * tc, lambda: rng.uniform(0.0, 1))
    elif name == "coast":
        u = steps_of(rng, n, dt, 2 * tc, 5 * tc, lambda: rng.uniform(0.4, 1) * rng.choice([-1, 1]))
        u[np.isin(np.cumsum(np.diff(u, prepend=u[0]) != 0) % 2, [1])] = 0.0
    elif name == "prbs":
        u = steps_of(rng, n, dt, 0.7 * tc, 3 * tc, lambda: rng.choice([-1.0, 1.0])) + 0.1 * np.sin(TURN * t / T)
    elif name == "chirp":
        slow, fast = 1.5 / T, 0.8 / tc
        u = np.sin(TURN * T * slow / math.log(fast / slow) * ((fast / slow) ** (t / T) - 1))
    elif name == "tones":
        u = sum(np.sin(TURN * f / T * t + rng.uniform(0, TURN)) for f in (2.3, 5.1, 11.7)) * np.minimum(1, 5 * t / T)
    elif name == "ramp":
        u = 2 / np.pi * np.arcsin(np.sin(TURN * 1.5 * t / T))
    elif name == "moves":  # there, rest, further, rest, back
        q, rest = round(8 * tc / dt), round(5 * tc / dt)
        one = np.concatenate([np.interp(np.arange(q), [0, 0.3 * q, 0.7 * q, q], [0, 1, 1, 0]), np.zeros(rest)])
        u = np.concatenate([one * rng.uniform(0.4, 1) * rng.choice([1, -1, -1]) for _ in range(n // len(one) + 1)])[:n]
    else:
        raise ValueError(kind)
    return u * A / np.max(np.abs(u))


def loop(name, rng, m, n, dt, tc, size):
    """Return a PI speed controller or a position controller after an unknown reference, on what its encoder says."""
    noise, memory = rng.normal(size=n) * 0.003 * m["ws"], [0.0]
    if name == "speed":
        want = steps_of(rng, n, dt, 4 * tc, 9 * tc, lambda: rng.uniform(-0.7, 0.7) * size * m["ws"])
        kp = 6 * m["b"] if m["torque"] else 2 * m["K"]

        def speed(k, w, th):
            e = want[k] - w - noise[k]
            u = clip(kp * e + memory[0], -m["V"], m["V"])
            if abs(u) < m["V"]:
                memory[0] += kp / (2 * tc) * e * dt
            return u
        return speed
    span = 5 * size * m["ws"] * tc
    want = steps_of(rng, n, dt, 8 * tc, 14 * tc, lambda: rng.uniform(-1, 1) * span)
    kp, kd = (m["J"] / tc**2, m["J"] / tc) if m["torque"] else (0.4 * m["K"] / tc, 0.1 * m["K"])

    def position(k, w, th):
        return clip(kp * (want[k] - th) - kd * (w + noise[k]), -m["V"], m["V"])
    return position


# ---- the bench
def run(m, eff, kind, rng, o, halve=1, given=None):
    """Simulate one run: times, logged voltage, clean channels as the sensors have them, further columns, true angle."""
    p, dt, n = Plant(m, eff), m["dt"], round(o["T"] / m["dt"])
    sub = max(round(dt / m["h"]), 1) * halve
    wild = lfilter([math.sqrt(1 - (r := math.exp(-2 * dt / m["tm"])) ** 2)], [1, -r], rng.normal(size=n + 400))[400:]
    slow = np.interp(np.arange(n), np.linspace(0, n, 12), rng.normal(size=12))
    bus = m["V"] * np.clip(1 - 0.08 * np.abs(slow), 0.7, 1.0)
    load = 0.07 * m["ts"] * slow

    def over_time(a):
        return lambda t: float(a[min(int(t / dt + 1e-6), n - 1)])
    more = {"wild": over_time(wild), "bus": over_time(bus), "load": over_time(load), "phase": float(rng.uniform(0, 3)),
            "share": float(rng.uniform(0.8, 1.1))}
    if "winding_warm_start" in eff:
        more["hot"] = float(rng.uniform(0.0, 0.35))
    x = p.start(float(rng.uniform(0, TURN)) if o.get("anywhere") else 0.0, **more)
    u = excitation(kind, rng, m, n, dt) if given is None else given
    lsb = m["V"] / 2 ** o.get("vbits", 10)
    rows, v = [], np.empty(n)
    for k in range(n):
        rows.append((getattr(x, "im", x.i), getattr(x, "wm", x.w), x.th))
        x.v = float(round((u(k, x.w, x.th) if callable(u) else u[k]) / lsb) * lsb)
        v[k] = x.v
        for a in pulses(x.v, 1.1 * m["V"], sub, o["pwm"]) if o.get("pwm") else [x.v] * sub:
            x.a = a
            p.step(x, dt / sub)
    i, w, th = np.array(rows).T
    if p.torque:
        i = v.copy()
    s = SimpleNamespace(t=np.arange(n) * dt, v=v, i=i, w=w, th=th)
    for name, e in eff.items():
        if name in SENSORS:
            SENSORS[name](s, m, *(e if isinstance(e, tuple) else (e,)))
    columns = {"v_supply": bus, "tau_load": load, "temp": 22 + slow}
    return s.t, v, {"i": s.i, "omega": s.w, "theta": s.th}, columns, th


def pulses(v, top, sub, periods):
    """Return the bridge's voltage in `sub` steps: `periods` pulses, each in the middle of its period."""
    edges = np.linspace(0, periods, sub + 1)
    duty = abs(v) / top

    def passed(a):  # volt-seconds until then, in periods
        return np.floor(a) * duty + np.clip(a % 1.0 - (1 - duty) / 2, 0, duty)
    return (math.copysign(top, v) * np.diff(passed(edges)) / np.diff(edges)).tolist()


def measure(rng, o, scale, y, th, t, turn):
    """Return what is logged of the clean channels: noise, hum, converters, counts, dropped samples."""
    z, n = {}, len(t)
    for c, clean in y.items():
        if c == "theta":
            step = turn / o["cpr"]
            z[c] = np.floor(clean / step + rng.random()) * step
            if o.get("zero"):
                z[c] -= z[c][0]
        elif c == "omega" and o.get("counts"):
            k = np.floor(th * o["counts"] / turn + rng.random()) * turn / o["counts"]
            z[c] = np.diff(k, prepend=k[0]) / t[1] if o.get("backward") else np.gradient(k, t)
        else:
            rho = o.get("rho", 0.0)
            e = lfilter([math.sqrt(1 - rho * rho)], [1, -rho], rng.normal(size=n + 300))[300:]
            z[c] = clean + e * o["ni" if c == "i" else "nw"] * scale[c]
        if c == "i":
            z[c] = z[c] + o.get("hum", 0.0) * scale[c] * np.sin(TURN * 50.02 * t + rng.uniform(0, TURN))
            lsb = 8 * scale[c] / 2 ** o.get("bits", 12)
            z[c] = np.round(z[c] / lsb) * lsb
        if o.get("drop"):
            gone = rng.random(n) < o["drop"]
            gone[0] = False
            z[c] = np.where(gone, np.nan, z[c])
    return z


def logged(rng, o, t, v, y, z):
    """Return times, kept rows and clean channels as the log has them: rows lost, stamps that jitter."""
    keep = np.ones(len(t), bool)
    if o.get("lost"):  # a logger that now and then skips a row in which the command did not change
        keep = ~((rng.random(len(t)) < o["lost"]) & (np.diff(v, prepend=np.inf) == 0))
    stamps = t.copy()
    if o.get("jitter"):
        stamps[1:] += np.clip(rng.normal(size=len(t) - 1) * o["jitter"], -0.4, 0.4) * t[1]
        y = {c: np.interp(stamps, t, a) for c, a in y.items()}  # where a right model would be
    return stamps[keep], keep, {c: a[keep] for c, a in y.items()}, {c: a[keep] for c, a in z.items()}


def build(case, halve=1, without=(), given=None):
    """Return the records of `case`; for checks of size, `without` some effects under the voltages `given`."""
    rng = np.random.default_rng(seed(case.name))
    m = motor(case.motor, rng, case.options.get("damped", 1.0))
    usual = {"ni": float(np.exp(rng.uniform(-6.2, -4.2))), "nw": float(np.exp(rng.uniform(-6.2, -4.6))),
             "cpr": 20000, "drop": float(rng.choice([0, 0, 0.02]))}
    o = {"T": m["T"], **usual, **case.options}
    m.update({k: o[k] for k in ("dt", "h", "T") if k in o})
    turn = 1.0 if case.motor in LINEAR else TURN
    eff = {k: e for k, e in case.effects.items() if k not in without}
    kinds, n = case.train + case.check, len(case.train)
    raw = [run(m, eff, kind, np.random.default_rng([seed(case.name), j]), dict(o, T=o["T"] * (1, 0.8, 1.1, 0.9)[j % 4]),
               halve, None if given is None else given[j]) for j, kind in enumerate(kinds)]
    scale = {c: float(np.std(np.concatenate([r[2][c] for r in raw[:n]]))) for c in raw[0][2]}
    runs, noise = [], {c: [] for c in case.channels}
    error, power = dict.fromkeys(case.channels, 0.0), dict.fromkeys(case.channels, 0.0)
    for j, (t, v, y, columns, th) in enumerate(raw):
        noisy = np.random.default_rng([seed(case.name), 500 + j])
        if o.get("zero"):
            y["theta"] = y["theta"] - y["theta"][0]
        clean = {c: y[c] for c in case.channels}
        z = measure(noisy, o, scale, clean, th, t, turn)
        stamps, keep, clean, z = logged(noisy, o, t, v, clean, z)
        inputs = {"v": v[keep]}
        for c in o.get("log", "").split():
            level = {"v_supply": 0.003 * m["V"], "tau_load": 0.002 * m["ts"], "temp": 0.1}[c]
            inputs[c] = columns[c][keep] + noisy.normal(size=int(keep.sum())) * level
        if o.get("meter"):  # the voltage in the log was measured, not commanded
            inputs["v"] = inputs["v"] + noisy.normal(size=int(keep.sum())) * o["meter"] * m["V"]
        for c in case.channels:
            e = z[c] - clean[c]
            ok = np.isfinite(e)
            noise[c].append(e[ok])
            if j >= n:
                error[c] += float(np.sum(e[ok] ** 2))
                power[c] += float(np.sum(z[c][ok] ** 2))
        unit = {"omega": "m/s", "theta": "m"} if case.motor in LINEAR else {}
        runs.append({"name": f"{'run' if j < n else 'check'}{j}_{kinds[j].replace(':', '_')}", "t": stamps,
                     "outputs": z, "true": clean, "inputs": inputs, "hold": "zoh",
                     "units": {c: a for c, a in unit.items() if c in case.channels},
                     "start": (0.0, 0.0, float(y["theta"][0]))})
    return {"motor": m, "train": runs[:n], "check": runs[n:],
            "floor": {c: math.sqrt(error[c] / power[c]) for c in case.channels},
            "noise": {c: max(float(np.sqrt(np.mean(np.concatenate(a) ** 2))), 1e-9) for c, a in noise.items()}}
