"""The plant of the third battery: a brushed motor with hard physics, in small steps, independent of the tool.

Each law is a few lines of Python text, written from its definition; a case's laws are compiled into one right-hand
side. RK4 in fixed sub-steps; sticking is a state of its own that begins where the speed crosses zero (the step is
shortened to the crossing) and ends where the torque exceeds the breakaway. Currents stop at hard limits and diodes.
Sizes are relative: torques to the stall torque, speeds to the no-load speed, currents to the stall current.
"""

from __future__ import annotations

import math
import zlib

import numpy as np
from scipy.signal import lfilter

MOTORS = {  # R, L, K, b, J, largest voltage, tick, length of a run, fine step
    "coreless": (7.2, 2.2e-3, 0.0105, 6e-7, 8e-7, 6.0, 2.5e-4, 0.55, 5e-5),
    "can": (1.6, 1.4e-3, 0.022, 1.2e-5, 1.4e-5, 12.0, 5e-4, 0.9, 1e-4),
    "wheel": (2.1, 2.4e-3, 0.55, 0.012, 0.012, 12.0, 1e-3, 1.6, 1e-4),
    "geared": (4.5, 9e-3, 2.8, 0.25, 0.16, 24.0, 2e-3, 2.8, 2e-4),
    "spindle": (0.9, 1.6e-3, 0.055, 9e-5, 1.6e-4, 24.0, 1e-3, 1.5, 1e-4),
    "blower": (0.6, 0.9e-3, 0.03, 3e-5, 1.2e-4, 12.0, 1e-3, 1.8, 1e-4),
    "traction": (0.12, 0.9e-3, 0.6, 0.08, 1.1, 96.0, 4e-3, 8.0, 4e-4),
    "crane": (0.25, 3.5e-3, 2.2, 0.5, 9.0, 220.0, 5e-3, 10.0, 5e-4),
    "slide": (2.0, 3e-3, 20.0, 25.0, 6.0, 24.0, 1e-3, 1.3, 1e-4),
    # drives with a current loop of their own: the command is a torque (a force)
    "pivot": (1.0, 1.0, 1.0, 0.03, 0.012, 2.0, 1e-3, 2.2, 2e-4),
    "table": (1.0, 1.0, 1.0, 60.0, 15.0, 40.0, 2e-3, 3.0, 2e-4),
}
TORQUE = {"pivot", "table"}
LINEAR = {"slide", "table"}
TWO_PI = 2 * math.pi


def seed(name: str) -> int:
    return zlib.crc32(("third " + name).encode())


def motor(name, rng):
    """Return one of a kind: its values spread by a tenth or two."""
    m = dict(zip(("R", "L", "K", "b", "J", "V", "dt", "T", "h"), MOTORS[name], strict=True))
    m["torque"] = name in TORQUE
    for k in "RLKbJ" if not m["torque"] else "bJ":
        m[k] *= float(np.exp(rng.uniform(-0.18, 0.18)))
    m["is"] = m["V"] / m["R"]
    m["ts"] = m["K"] * m["is"]
    m["ws"] = m["ts"] / m["b"] if m["torque"] else m["V"] / (m["K"] + m["b"] * m["R"] / m["K"])
    m["tm"] = 0.3 * m["J"] / m["b"] if m["torque"] else m["R"] * m["J"] / m["K"] ** 2
    return m


class Laws:
    """What acts, as lines of a right-hand side in the order they are computed."""

    def __init__(self, m):
        self.m, self.ns = m, {"sin": math.sin, "cos": math.cos, "exp": math.exp, "pi2": TWO_PI}
        self.states = [("i", 0.0), ("w", 0.0), ("th", 0.0)]
        self.lines = {"drive": [], "el": [], "tm": [], "q": [], "F": [], "der": [], "after": []}
        self.Je, self.ib, self.hold_i = "J", "i", False
        self.put(**{k: m[k] for k in ("R", "L", "K", "b", "J", "V")}, Is=m["is"], ts=m["ts"], ws=m["ws"])

    def put(self, **values):
        self.ns.update({k: float(v) for k, v in values.items()})

    def state(self, name, start=0.0):
        self.states.append((name, start))

    def add(self, where, *text):
        self.lines[where] += text


def _laws(m, eff):
    """Return the laws of the effects `eff`: {name: size}."""
    g = Laws(m)
    for name, e in eff.items():
        if name in SENSORS:
            continue
        LAW[name](g, *(e if isinstance(e, tuple) else (e,)))
    return g


LAW = {}


def law(f):
    LAW[f.__name__] = f
    return f


# ---- the library's effects, hard. Voltage
@law
def brush_drop(g, f):
    g.put(Vb=f * g.m["V"], ib=0.02 * g.m["is"])
    g.add("el", "x = i/ib; ub += Vb*(1.0 if x > 1.0 else (-1.0 if x < -1.0 else x))")


@law
def winding_heating(g, rise, tau):  # R doubles by `rise`=1 when half the stall current flows for ever
    g.put(al=0.00393, Pw=g.m["R"] * (0.5 * g.m["is"]) ** 2, Tr=rise / 0.00393, tw=tau)
    g.state("T")
    g.add("el", "Rr = R*(1.0+al*T)")
    g.add("der", "dT = (Tr*Rr*i*i/Pw-T)/tw")


@law
def magnet_heating(g, fall, tau):
    g.put(Pm=g.m["R"] * (0.5 * g.m["is"]) ** 2, fm=fall, tmg=tau)
    g.state("Tm")
    g.add("el", "Kk = K*(1.0-fm*Tm)")
    g.add("der", "dTm = (R*i*i/Pm-Tm)/tmg")


@law
def inductance_saturation(g, f):
    g.put(iL=f * g.m["is"])
    g.add("el", "Ll = L/(1.0+(i/iL)**2)")


@law
def magnetic_saturation(g, f):
    g.put(iK=f * g.m["is"])
    g.add("el", "Kk = K/(1.0+(i/iK)**2)")


@law
def driver_dead_band(g, f):
    g.put(Vd=f * g.m["V"])
    g.add("drive", "u = u-Vd if u > Vd else (u+Vd if u < -Vd else 0.0)")


@law
def driver_coast(g):
    g.add("el", "if v == 0.0: u = -V if i > 0.0 else (V if i < 0.0 else Kk*w)")
    g.add("after", "if v == 0.0 and i*i_0 <= 0.0: i = 0.0")


@law
def driver_current_limit(g, f):
    g.put(il=f * g.m["is"])
    g.add("tm", "if (i >= il and di > 0.0) or (i <= -il and di < 0.0): di = 0.0")
    g.add("after", "i = il if i > il else (-il if i < -il else i)")


@law
def supply_sag(g, f):
    g.put(Rs=f * g.m["R"])
    g.add("drive", "u = u-Rs*i*(v/V)**2")


@law
def voltage_offset(g, f):
    g.put(V0=f * g.m["V"])
    g.add("drive", "u += V0")


# ---- torque
@law
def coulomb(g, f):
    g.put(tc=f * g.m["ts"])
    g.add("F", "F += tc")


@law
def coulomb_asymmetric(g, p, n):
    g.put(tcp=p * g.m["ts"], tcn=n * g.m["ts"])
    g.add("F", "F += tcp if s > 0 else tcn")


@law
def stribeck(g, c, s, ws):
    g.put(sc=c * g.m["ts"], sb=(s - c) * g.m["ts"], wst=ws * g.m["ws"])
    g.add("F", "F += sc+sb*exp(-(w/wst)**2)")


@law
def lugre(g, c, s, ws, ths):
    g.put(lc=c * g.m["ts"], lb=(s - c) * g.m["ts"], lw=ws * g.m["ws"], s0=s * g.m["ts"] / ths,
          s1=0.6 * s * g.m["ts"] / ths * ths / (ws * g.m["ws"]))
    g.state("z")
    g.add("q", "gg = lc+lb*exp(-(w/lw)**2); dz = w-s0*abs(w)*z/gg; q -= s0*z+s1*dz")


@law
def angular_friction(g, f, a, n, ph):
    g.put(af=f * g.m["ts"], aa=a, an=n, ap=ph)
    g.add("F", "F += af*(1.0+aa*sin(an*th+ap))")


@law
def viscous_asymmetric(g, f):
    g.put(ba=f * g.m["ts"] / g.m["ws"])
    g.add("q", "q -= ba*abs(w)")


@law
def quadratic_drag(g, f):
    g.put(c2=f * g.m["ts"] / g.m["ws"] ** 2)
    g.add("q", "q -= c2*w*abs(w)")


@law
def eddy_brake(g, f, wb):  # f: the torque at its top, at the speed wb
    g.put(ce=2 * f * g.m["ts"] / (wb * g.m["ws"]), we=wb * g.m["ws"])
    g.add("q", "q -= ce*w/(1.0+(w/we)**2)")


@law
def load_friction(g, mu):
    g.put(mu=mu)
    g.add("F", "F += mu*abs(tm)")


@law
def gear_efficiency(g, drive, back):
    g.put(e1=drive, e2=back)
    g.add("tm", "tm = tm*e1 if tm*w >= 0.0 else tm*e2")


@law
def constant_load(g, f):
    g.put(tl=f * g.m["ts"])
    g.add("q", "q -= tl")


@law
def gravity(g, f, ph):
    g.put(mgl=f * g.m["ts"], gp=ph)
    g.add("q", "q -= mgl*sin(th+gp)")


@law
def spring(g, f, th0):
    g.put(ks=f * g.m["ts"], th0=th0)
    g.add("q", "q -= ks*(th-th0)")


@law
def cogging(g, f, n, ph):
    g.put(ca=f * g.m["ts"], cn=n, cp=ph)
    g.add("q", "q -= ca*sin(cn*th+cp)")


@law
def torque_ripple(g, a, n, ph):
    g.put(ra=a, rn=n, rp=ph)
    g.add("tm", "tm = tm*(1.0+ra*sin(rn*th+rp))")


@law
def compliance(g, r, om, zeta):
    _shaft(g, r, om, zeta, 0.0)


@law
def backlash(g, r, gap, om, zeta):
    _shaft(g, r, om, zeta, gap)


def _shaft(g, r, om, zeta, gap):
    J1, J2 = (1 - r) * g.m["J"], r * g.m["J"]
    Jr = J1 * J2 / g.m["J"]
    g.put(J1=J1, J2=J2, kc=Jr * om**2, cc=2 * zeta * Jr * om, gap=gap / 2)
    g.state("w2")
    g.state("th2")
    g.Je = "J1"
    g.add("q", "twist = th-th2; sh = 0.0",
          "if twist > gap: sh = max(kc*(twist-gap)+cc*(w-w2), 0.0) if gap else kc*twist+cc*(w-w2)",
          "elif twist < -gap: sh = min(kc*(twist+gap)+cc*(w-w2), 0.0) if gap else kc*twist+cc*(w-w2)",
          "q -= sh")
    g.add("der", "dw2 = sh/J2; dth2 = w2")


# ---- lags of sensors are states
@law
def speed_lag(g, tau):
    g.put(Tw=tau)
    g.state("wm")
    g.add("der", "dwm = (w-wm)/Tw")


@law
def current_lag(g, tau):
    g.put(Ti=tau)
    g.state("im")
    g.add("der", "dim = (i-im)/Ti")


# ---- what the library lacks. Magnetics and winding
@law
def x_dead_pole(g, f, a, b):  # a cracked magnet: weaker over a sector of the turn
    g.put(dp=1 - f, da=a, db=b)
    g.add("el", "if da < th % pi2 < db: Kk = Kk*dp")


@law
def x_brush_lift(g, f):  # brushes dance: the contact's resistance rises with the speed
    g.put(bl=f / g.m["ws"] ** 2)
    g.add("el", "Rr = Rr*(1.0+bl*w*w)")


@law
def x_brush_shift(g, f):  # brushes off the neutral line: current weakens the field one way only
    g.put(bs=f / g.m["is"])
    g.add("el", "Kk = Kk*(1.0-bs*i)")


@law
def x_iron_loop(g, f):  # eddy currents in the core: a resistance across the inductance takes current, too
    g.put(lp=1 + 1 / f)
    g.add("el", "Ll = L*lp")


@law
def x_knee(g, at, f):  # flux up to a knee, then no more than a share of its slope
    g.put(kn=at * g.m["is"], kf=f)
    g.add("tm", "if abs(i) > kn: tm = K*((kn+kf*(abs(i)-kn)) if i > 0 else -(kn+kf*(abs(i)-kn)))")


# ---- drives
@law
def x_gain_kink(g, at, f):  # an amplifier whose slope falls above a level
    g.put(gk=at * g.m["V"], gf=f)
    g.add("drive", "if abs(u) > gk: u = (gk+gf*(abs(u)-gk))*(1.0 if u > 0 else -1.0)")


@law
def x_min_pulse(g, low, high):  # pulses too short are left out, gaps too short are filled
    g.put(pl=low * g.m["V"], phh=high * g.m["V"])
    g.add("drive", "u = 0.0 if abs(u) < pl else ((V if u > 0 else -V) if abs(u) > phh else u)")


@law
def x_brown_out(g, f, a, b):  # the supply breaks down for a moment of each run
    g.put(bo=1 - f, oa=a, ob=b)
    g.add("drive", "if oa < t < ob: u = u*bo")


@law
def x_pumped_bus(g, f):  # a capacitor behind diodes: braking pumps it up, a bleeder takes it down
    g.put(Cb=0.5 * g.m["J"] * g.m["ws"] ** 2 / (g.m["V"] ** 2 * f), tb=0.8 * g.m["tm"])
    g.state("vb", g.m["V"])
    g.add("drive", "u = u*vb/V")
    g.add("der", "pw = u*i; dvb = -(vb-V)/tb", "if pw < 0.0: dvb -= pw/(Cb*vb)",
          "elif vb > V: dvb -= pw/(Cb*vb)")


@law
def x_battery(g, f):  # a battery that the charge drawn from it weakens
    g.put(qb=g.m["is"] * g.m["T"] * 0.3 / f)
    g.state("Q")
    g.add("drive", "u = u*(1.0-Q/qb)")
    g.add("der", "dQ = abs(i)")


@law
def x_filter(g, om, zeta):  # a choke and a capacitor behind the bridge
    g.put(fo=om, fz=zeta)
    g.state("va")
    g.state("vda")
    g.add("drive", "ui = u; u = va")
    g.add("der", "dva = vda; dvda = fo*fo*(ui-va)-2.0*fz*fo*vda")


@law
def x_drive_lag(g, tau):  # the current loop of a drive takes its time
    g.put(Td=tau)
    g.state("ud")
    g.add("drive", "ui = u; u = ud")
    g.add("der", "dud = (ui-ud)/Td")


@law
def x_head_room(g, f):  # a torque drive that runs out of voltage as it turns
    g.put(h0=f * g.m["ts"], hw=f * g.m["ts"] / (0.9 * g.m["ws"]))
    g.add("drive", "top = max(h0-hw*w, 0.0); bot = min(-h0-hw*w, 0.0); u = top if u > top else (bot if u < bot else u)")


# ---- friction, drag, brakes
@law
def x_rub(g, f, a, b):  # rubs over a sector of the turn
    g.put(rf=f * g.m["ts"], rxa=a, rxb=b)
    g.add("F", "if rxa < th % pi2 < rxb: F += rf")


@law
def x_worn_rail(g, f, width):  # dry friction that grows towards the ends of the travel
    g.put(wr=f * g.m["ts"], wd=width)
    g.add("F", "F += wr*(1.0+(th/wd)**2)")


@law
def x_brake_at(g, f, at):  # a brake that drops in at a moment
    g.put(bf=f * g.m["ts"], bt=at)
    g.add("F", "if t > bt: F += bf")


@law
def x_holding_brake(g, f):  # a holding brake that falls in at command zero
    g.put(hb=f * g.m["ts"])
    g.add("F", "if v == 0.0: F += hb")


@law
def x_centrifugal_brake(g, f, at):  # shoes that fly out above a speed
    g.put(cb=f * g.m["ts"] / ((1 - at**2) * g.m["ws"] ** 2), cw=at * g.m["ws"])
    g.add("q", "if abs(w) > cw: q -= cb*(w*w-cw*cw)*(1.0 if w > 0 else -1.0)")


@law
def x_cavitation(g, f, at):  # a screw whose torque stays where the water breaks off
    g.put(cv=f * g.m["ts"] / (at * g.m["ws"]) ** 2, ck=at * g.m["ws"])
    g.add("q", "q -= cv*w*abs(w) if abs(w) < ck else cv*ck*ck*(1.0 if w > 0 else -1.0)")


@law
def x_hysteresis(g, f, span):  # a hysteresis brake: torque over angle in loops, four plays of different width
    g.put(**{f"hk{j}": f * g.m["ts"] / 4 / (span * j / 4) for j in (1, 2, 3, 4)}, hf=f * g.m["ts"] / 4)
    for j in (1, 2, 3, 4):
        g.state(f"p{j}")
        g.add("q", f"q -= hk{j}*p{j}")
        g.add("der", f"dp{j} = w if (abs(hk{j}*p{j}) < hf or p{j}*w < 0.0) else 0.0")


# ---- loads
@law
def x_stop(g, f, at):  # one soft stop
    g.put(sk=f * g.m["ts"], sa=at)
    g.add("q", "if th > sa: q -= sk*(th-sa)")


@law
def x_half_cam(g, f):  # a cam that lifts over half of the turn
    g.put(hc=f * g.m["ts"])
    g.add("q", "x = sin(th)", "if x > 0.0: q -= hc*x")


@law
def x_piston(g, f):  # a compressor: each turn pressure builds up, and a valve opens
    g.put(pf=f * g.m["ts"])
    g.add("q", "x = th % pi2", "if x < 3.0: q -= pf*(x/1.6 if x < 1.6 else 1.0)*sin(x)")


@law
def x_slider_crank(g, a):  # a piston's mass on a crank
    g.put(sa1=a)
    g.add("q", "x = sin(th)+0.15*sin(2.0*th); y = cos(th)+0.3*cos(2.0*th)",
          "Jv = J*(1.0+sa1*x*x); q -= J*sa1*x*y*w*w")
    g.Je = "Jv"


@law
def x_grab(g, f, at):  # a gripper takes a load: the inertia steps up, the momentum stays
    g.put(gj=1 + f, ga=at)
    g.add("q", "Jv = J*gj if t > ga else J")
    g.add("after", "if t0_ < ga <= t1_: w = w/gj")
    g.Je = "Jv"


@law
def x_freewheel(g, r):  # an overrunning clutch: the motor drives the load, never brakes it
    J1, J2 = (1 - r) * g.m["J"], r * g.m["J"]
    g.put(J1=J1, J2=J2, cf=J1 * J2 / g.m["J"] / 2e-3, fd=0.15 * g.m["ts"] / g.m["ws"])
    g.state("w2")
    g.add("q", "sh = cf*(w-w2) if w > w2 else 0.0; q -= sh")
    g.add("der", "dw2 = (sh-fd*w2)/J2")
    g.Je = "J1"


@law
def x_fluid_coupling(g, r, tau):  # an inertia carried along by a fluid, quadratic in the slip
    J1, J2 = (1 - r) * g.m["J"], r * g.m["J"]
    g.put(J1=J1, J2=J2, cq=J2 / tau / (0.3 * g.m["ws"]))
    g.state("w2")
    g.add("q", "sh = cq*(w-w2)*abs(w-w2); q -= sh")
    g.add("der", "dw2 = sh/J2")
    g.Je = "J1"


@law
def x_hammer(g, f, period):  # blows of a machine that runs by its own clock
    g.put(hm=f * g.m["ts"], hp=period)
    g.add("q", "x = (t % hp)/hp", "if x < 0.25: q -= hm*sin(pi2*2.0*x)")


# ---- sensors without memory in the plant, by name; applied to the clean channels in `_seen`
SENSORS = {"speed_delay", "speed_average", "speed_gain", "speed_offset", "current_offset", "current_gain",
           "supply_side_current", "x_cardan", "x_one_channel", "x_current_clip",
           "x_lost_counts", "x_loose_encoder", "x_remanence"}


def compile_plant(m, eff):
    """Return tick(t, length, n, v0, v1, s, X) -> (s, X) and the names and starts of the states."""
    g = _laws(m, eff)
    st = [n for n, _ in g.states]
    friction = bool(g.lines["F"])
    torque = m["torque"]
    rhs = [f"def rhs(t, v, s, {', '.join(st)}):", " u = v; ub = 0.0; Rr = R; Ll = L; Kk = K"]
    rhs += [" " + x for x in g.lines["drive"]]
    if torque:
        rhs += [" i = u; di = 0.0; tm = K*i"]
    else:
        rhs += [" " + x for x in g.lines["el"]]
        rhs += [" di = (u-Rr*i-Kk*w-ub)/Ll", " tm = Kk*i"]
    rhs += [" " + x for x in g.lines["tm"]] + [" q = tm-b*w"] + [" " + x for x in g.lines["q"]]
    rhs += [" F = 0.0"] + [" " + x for x in g.lines["F"]]
    rhs += [f" dw = (q-s*F)/{g.Je}" + (" if s else 0.0" if friction else ""), " dth = w"]
    rhs += [" " + x for x in g.lines["der"]]
    rhs += [f" return ({', '.join('d' + x for x in st)},), q, F"]
    a = ", ".join(st)
    step = [f"def step(t, h, v0, v1, s, {', '.join(x + '_0' for x in st)}):",
            " vm = 0.5*(v0+v1)"]
    names = {j: ", ".join(f"{x}_{j}" for x in st) for j in "0abcd"}

    def stage(k, at, v, frm, factor):
        args = names["0"] if frm is None else ", ".join(f"{x}_0+{factor}*h*{x}_{frm}" for x in st)
        return f" ({names[k]},), q, F = rhs(t+{at}*h, {v}, s, {args})"

    step += [stage("a", 0.0, "v0", None, 0), stage("b", 0.5, "vm", "a", 0.5), stage("c", 0.5, "vm", "b", 0.5),
             stage("d", 1.0, "v1", "c", 1.0)]
    step += [" " + "; ".join(f"{x} = {x}_0+h/6.0*({x}_a+2.0*({x}_b+{x}_c)+{x}_d)" for x in st)]
    step += [" v = v1; t0_ = t; t1_ = t+h"] + [" " + x for x in g.lines["after"]] + [f" return ({a},)"]
    text = "\n".join(rhs + step)
    exec(compile(text, "<third plant>", "exec"), g.ns)  # the case's own laws, written above
    rhs_, step_ = g.ns["rhs"], g.ns["step"]
    wi = st.index("w")

    def decide(t, v, X):
        _, q, F = rhs_(t, v, 1, *X)
        if q > F:
            return 1
        _, q, F = rhs_(t, v, -1, *X)
        return -1 if -q > F else 0

    def tick(t, length, n, v0, v1, s, X):
        h, slope = length / n, (v1 - v0) / length
        for k in range(n):
            done, tries = 0.0, 0
            while done < h * (1 - 1e-9):
                a = k * h + done
                if friction and s == 0:
                    s = decide(t + a, v0 + slope * a, X)
                left = h - done
                Y = step_(t + a, left, v0 + slope * a, v0 + slope * (a + left), s, *X)
                if friction and s and Y[wi] * s < 0.0:
                    if X[wi] * s > 0.0 and tries < 5:
                        left *= X[wi] / (X[wi] - Y[wi])
                        Y = step_(t + a, left, v0 + slope * a, v0 + slope * (a + left), s, *X)
                    Y = (*Y[:wi], 0.0, *Y[wi + 1:])
                    s, tries = 0, tries + 1
                X = Y
                done += left
        return s, X

    return tick, st, [x for _, x in g.states], (0 if friction else 1)


def excitation(kind, rng, m, n, dt):
    """Return the voltages (n,), or a controller f(k, w, th) -> v."""
    name, _, size = kind.partition(":")
    A = (float(size) if size else 1.0) * m["V"]
    t, T, tm = np.arange(n) * dt, n * dt, max(m["tm"], 3 * dt)

    def random_levels(lo, hi, draw, rest=True):
        v, k = np.zeros(n), (max(int(0.5 * tm / dt), 2) if rest else 0)
        while k < n:
            j = k + max(int(rng.uniform(lo, hi) * tm / dt), 2)
            v[k:j] = draw()
            k = j
        return v

    if name in ("steps", "onoff"):
        turn = [1.0, 0]

        def draw():
            turn[0] = -turn[0] if rng.random() < 0.8 else turn[0]
            turn[1] += 1
            return 0.0 if name == "onoff" and turn[1] % 2 == 0 else turn[0] * float(rng.uniform(0.25, 1.0)) * A
        return random_levels(2.5, 6, draw)
    if name == "levels":
        return random_levels(0.5, 4, lambda: float(rng.uniform(-A, A)))
    if name == "up":
        return random_levels(1.0, 6, lambda: float(rng.uniform(0.3, 1.0) * A))
    if name == "stair":
        level = np.array([0, 1, 2, 3, 4, 5, 3, 1, -1, -3, -5, -4, -2, 0]) / 5
        return A * level[np.minimum((t / T * 14).astype(int), 13)]
    if name == "tri":
        return A * np.interp((2.5 * t / T) % 1, [0, 0.25, 0.75, 1], [0, 1, -1, 0])
    if name == "slow":
        return A * np.interp(t / T, [0, 0.3, 0.8, 1], [0, 1, -1, -0.2])
    if name == "msine":
        v = sum(np.sin(TWO_PI * j * t / T + rng.uniform(0, TWO_PI)) for j in (1, 2, 4, 7, 11, 17))
        return A * v / np.max(np.abs(v))
    if name == "upsine":
        return A * np.minimum(t / (0.1 * T), 1) * (0.6 + 0.4 * np.sin(TWO_PI * 3.3 * t / T + rng.uniform(0, TWO_PI)))
    if name == "chirp":
        f0, f1 = 1.0 / T, 0.35 / tm
        return A * np.sin(TWO_PI * (f0 * t + 0.5 * (f1 - f0) * t * t / T))
    if name == "growing":
        return A * t / T * np.sin(TWO_PI * max(5 / T, 0.08 / tm) * t)
    if name == "sloop":  # a PI speed loop on what the sensor says, after an unknown reference
        want = random_levels(4, 9, lambda: float(rng.uniform(-0.75, 0.75))) / 1.0 * m["ws"] * A / m["V"]
        kp = 0.4 * m["b"] * 10 if m["torque"] else 2.5 * m["K"]
        ki, mem, noise = kp / tm, [0.0], rng.normal(size=n) * 0.004 * m["ws"]

        def speed(k, w, th):
            e = want[k] - w - noise[k]
            u = min(max(kp * e + mem[0], -m["V"]), m["V"])
            if abs(u) < m["V"]:
                mem[0] += ki * e * dt
            return round(u / m["V"] * 500) / 500 * m["V"]
        return speed
    if name == "ploop":
        span = m["ws"] * tm * 5 * A / m["V"]
        want = random_levels(6, 11, lambda: float(rng.uniform(-1, 1))) * span
        kp = 1.8 * m["V"] / span
        kd = 0.5 * math.sqrt(kp * m["J"]) if m["torque"] else 0.25 * m["K"]
        noise = rng.normal(size=n) * 0.001 * span

        def position(k, w, th):
            u = kp * (want[k] - th - noise[k]) - kd * w
            return round(min(max(u, -m["V"]), m["V"]) / m["V"] * 500) / 500 * m["V"]
        return position
    raise ValueError(kind)


def run(m, eff, kind, rng, o, halve=1, given=None):
    """Simulate one run: times, logged voltage, clean channels as the sensors see them, all states."""
    tick, st, start, s = compile_plant(m, eff)
    dt, h = o["dt"], o.get("h", m["h"])
    n = round(o["T"] / dt)
    base = round(dt / h)
    sub = np.full(n, base)
    if o.get("uneven"):
        sub = np.maximum(rng.integers(base // 2, 3 * base // 2 + 1, n), 1)
    t = np.concatenate([[0.0], np.cumsum(sub)[:-1]]) * h
    th0 = float(rng.uniform(0, TWO_PI)) if o.get("anywhere") else 0.0
    u = excitation(kind, rng, m, n, dt) if given is None else given
    X = list(start)
    for name in ("th", "th2"):
        if name in st:
            X[st.index(name)] = th0
    X, rows, v = tuple(X), np.empty((n, len(st))), np.empty(n)
    linear = o.get("hold") == "linear"
    for k in range(n):
        rows[k] = X
        v[k] = c = u(k, X[1], X[2]) if callable(u) else float(u[k])
        d = sub[k] * h
        if o.get("pwm"):
            top = 1.1 * m["V"]
            on = abs(c) / top * d / o["pwm"]
            off, at = (d / o["pwm"] - on) / 2, t[k]
            for _ in range(o["pwm"]):
                for length, value in ((off, 0.0), (on, math.copysign(top, c)), (off, 0.0)):
                    if length > 1e-9:
                        s, X = tick(at, length, 2 * halve, value, value, s, X)
                        at += length
        else:
            s, X = tick(t[k], d, int(sub[k]) * halve, c, float(u[min(k + 1, n - 1)]) if linear else c, s, X)
    states = {x: rows[:, j] for j, x in enumerate(st)}
    return t, v, _seen(m, eff, t, v, dict(states)), states


def _seen(m, eff, t, v, x):
    """Return i, omega, theta as the sensors have them, before noise."""
    dt = t[1] - t[0]
    i, w, th = x.get("im", x["i"]).copy(), x.get("wm", x["w"]).copy(), x["th"].copy()
    if "x_iron_loop" in eff:  # sampled just before the voltage changes
        f, before = eff["x_iron_loop"], np.concatenate([[0.0], v[:-1]])
        i = i + (before - m["R"] * x["i"] - m["K"] * x["w"]) / (1 + 1 / f) / (f * m["R"])
    if "x_cardan" in eff:  # tacho behind a cardan joint bent by an angle
        c = math.cos(eff["x_cardan"])
        w = w * c / (1 - (1 - c * c) * np.cos(th) ** 2)
    if "x_lost_counts" in eff:  # the counter misses edges above a speed
        f, at = eff["x_lost_counts"]
        miss = np.where(np.abs(w) > at * m["ws"], w - np.sign(w) * at * m["ws"], 0.0) * f
        w = w - miss
        th = th[0] + np.concatenate([[0], np.cumsum(0.5 * (w[1:] + w[:-1]) * np.diff(t))])
    if "x_loose_encoder" in eff:  # the encoder's own coupling has play
        half, y = eff["x_loose_encoder"] / 2, th[0]
        out = np.empty_like(th)
        for k, a in enumerate(th):
            y = min(max(y, a - half), a + half)
            out[k] = y
        th = out
    if "speed_average" in eff:
        q = round(eff["speed_average"] / dt)
        a = np.concatenate([np.full(q, x["th"][0]), x["th"]])
        w = (a[q:] - a[:-q]) / (q * dt)
    if "speed_delay" in eff:
        q = round(eff["speed_delay"] / dt)
        w = np.concatenate([np.full(q, w[0]), w[:-q]])
    if "x_one_channel" in eff:  # one channel of a counter: no direction
        w = np.abs(w)
    w = w * eff.get("speed_gain", 1.0) + eff.get("speed_offset", 0.0) * m["ws"]
    if "supply_side_current" in eff:
        i = i * np.abs(v) / m["V"] if eff["supply_side_current"] == "signed" else i * v / m["V"]
    if "x_current_clip" in eff:
        i = np.clip(i, -eff["x_current_clip"] * m["is"], eff["x_current_clip"] * m["is"])
    if "x_remanence" in eff:  # a Hall sensor's core: loops
        f, width = eff["x_remanence"]
        half, y, out = width * m["is"], 0.0, np.empty_like(i)
        for k, a in enumerate(i):
            y = min(max(y, a - half), a + half)
            out[k] = y
        i = i + f * (out - i)
    i = i * eff.get("current_gain", 1.0) + eff.get("current_offset", 0.0) * m["is"]
    return {"i": i, "omega": w, "theta": th}


def measure(rng, o, scale, t, y, turned, turn, phase):
    """Return what is logged of the clean channels: noise, counts, steps of a converter, hum, dropped samples."""
    z, n = {}, len(t)
    for c, clean in y.items():
        short = {"i": "i", "omega": "w", "theta": "th"}[c]
        lines = o.get("cpr")
        if c == "theta" and lines:
            k = np.floor(clean / (turn / lines) + phase)
            z[c] = (k - k[0] if o.get("zero") else k) * turn / lines
            continue
        if c == "omega" and o.get("counts"):
            k = np.floor(turned / (turn / o["counts"]) + phase) * turn / o["counts"]
            w = np.gradient(k, t) if o.get("central", True) else np.concatenate([[0.0], np.diff(k) / np.diff(t)])
            z[c] = w
        else:
            size = o.get("n" + short, {"i": 0.01, "w": 0.006, "th": 5e-4}[short]) * scale[c]
            e, rho = rng.normal(size=n + 200), o.get("rho", 0.0)
            z[c] = clean + size * lfilter([math.sqrt(1 - rho * rho)], [1, -rho], e)[200:]
        if c == "i" and o.get("hum"):
            z[c] = z[c] + o["hum"] * scale[c] * np.sin(TWO_PI * 49.97 * t + rng.uniform(0, TWO_PI))
        if c == "i" and o.get("bits"):
            lsb = 10 * scale[c] / 2 ** o["bits"]
            z[c] = np.round(z[c] / lsb) * lsb
        if o.get("drop"):
            gone = rng.random(n) < o["drop"]
            gone[0] = False
            z[c] = np.where(gone, np.nan, z[c])
    return z


def build(case, halve=1, without=(), given=None):
    """Return the records of `case`; for checks of size, `without` some effects under the voltages `given`."""
    rng = np.random.default_rng(seed(case.name))
    m = motor(case.motor, rng)
    o = {"dt": m["dt"], "T": m["T"], **case.options}
    turn = 1.0 if case.motor in LINEAR else TWO_PI
    eff = {k: e for k, e in case.effects.items() if k not in without}
    n, raw = len(case.train), []
    for j, kind in enumerate(case.train + case.check):
        length = o["T"] * (1.0, 1.15, 0.85)[j % 3]
        raw.append(run(m, eff, kind, np.random.default_rng([seed(case.name), j]), dict(o, T=length), halve,
                       None if given is None else given[j]))
    scale = {c: float(np.std(np.concatenate([r[2][c] for r in raw[:n]]))) for c in raw[0][2]}
    runs, noise = [], {c: [] for c in case.channels}
    floor = {}
    error, power = dict.fromkeys(case.channels, 0.0), dict.fromkeys(case.channels, 0.0)
    unit = {"omega": "m/s", "theta": "m"} if case.motor in LINEAR else {}
    for j, (t, v, y, states) in enumerate(raw):
        noisy = np.random.default_rng([seed(case.name), 1000 + j])
        if o.get("zero"):
            y["theta"] = y["theta"] - y["theta"][0]
        clean = {c: y[c] for c in case.channels}
        z = measure(noisy, o, scale, t, clean, states["th"], turn, float(rng.random()))
        for c in case.channels:
            e = z[c] - clean[c]
            ok = np.isfinite(e)
            if j < n:
                noise[c].append(e[ok])
            else:  # over the RMS of the channel, as the tool has it
                error[c] += float(np.sum(e[ok] ** 2))
                power[c] += float(np.sum(z[c][ok] ** 2))
        kind = (case.train + case.check)[j].replace(":", "_")
        runs.append({"name": f"{'run' if j < n else 'check'}{j}_{kind}", "t": t, "outputs": z, "true": clean,
                     "inputs": {"v": v}, "hold": o.get("hold", "zoh"),
                     "units": {c: x for c, x in unit.items() if c in case.channels},
                     "start": (states["i"][0], states["w"][0], y["theta"][0])})
    floor = {c: math.sqrt(error[c] / power[c]) for c in case.channels}
    return {"motor": m, "train": runs[:n], "check": runs[n:], "floor": floor,
            "noise": {c: max(float(np.sqrt(np.mean(np.concatenate(noise[c]) ** 2))), 1e-9) for c in case.channels}}
