"""A brushed DC motor with hard physics, independent of the package.

RK4 between events: stiction is exact (sticking is a state), gap, dead zone, diodes and current limit are hard. The step
is generated as plain Python text for each set of effects (numbers as literals), so it is quick without a compiler.
Sizes of effects are relative to the motor: torques to the stall torque, speeds to the no-load speed, currents to the
stall current, voltages to the largest one.
"""

from __future__ import annotations

import math
import zlib

import numpy as np
from scipy.signal import lfilter

MOTORS = {  # R, L, K, b, J, Vmax, tick, length, fine step
    "coreless": {"R": 5.0, "L": 1.5e-3, "K": 0.012, "b": 8e-7, "J": 1.2e-6, "V": 6.0, "dt": 5e-4, "T": 0.8, "h": 1e-4},
    "lab": {"R": 1.2, "L": 1.8e-3, "K": 0.06, "b": 8e-5, "J": 6e-5, "V": 12.0, "dt": 1e-3, "T": 1.5, "h": 1e-4},
    "gear": {"R": 2.5, "L": 2.5e-3, "K": 0.9, "b": 0.02, "J": 0.03, "V": 24.0, "dt": 2e-3, "T": 3.6, "h": 1e-4},
    "axis": {"R": 1.5, "L": 3e-3, "K": 25.0, "b": 30.0, "J": 12.0, "V": 24.0, "dt": 1e-3, "T": 1.8, "h": 1e-4},
    "fly": {"R": 0.8, "L": 2e-3, "K": 0.08, "b": 1.5e-4, "J": 6e-3, "V": 24.0, "dt": 5e-3, "T": 10.0, "h": 2.5e-4},
    "pump": {"R": 0.35, "L": 4e-4, "K": 0.025, "b": 2e-5, "J": 9e-5, "V": 12.0, "dt": 1e-3, "T": 1.5, "h": 1e-4},
    "micro": {"R": 12.0, "L": 1.5e-3, "K": 0.006, "b": 2e-7, "J": 2e-7, "V": 5.0, "dt": 1e-3, "T": 1.6, "h": 5e-5},
    "winch": {"R": 0.9, "L": 4e-3, "K": 1.6, "b": 0.06, "J": 0.2, "V": 36.0, "dt": 2e-3, "T": 3.2, "h": 1e-4},
    "arm": {"R": 3.0, "L": 3e-3, "K": 2.2, "b": 0.08, "J": 0.12, "V": 24.0, "dt": 2e-3, "T": 3.2, "h": 1e-4},
    "belt": {"R": 1.1, "L": 2e-3, "K": 18.0, "b": 12.0, "J": 3.5, "V": 24.0, "dt": 5e-4, "T": 0.8, "h": 1e-4},
    "reel": {"R": 0.5, "L": 1.2e-3, "K": 0.11, "b": 3e-4, "J": 4e-3, "V": 30.0, "dt": 4e-3, "T": 6.0, "h": 1e-4},
    # torque driven: R is only a scale (the command is v, the torque K v)
    "servo": {"R": 1.0, "L": 1.0, "K": 1.0, "b": 0.012, "J": 0.006, "V": 1.5, "dt": 1e-3, "T": 1.5, "h": 1e-4},
    "emps": {"R": 1.0, "L": 1.0, "K": 35.0, "b": 200.0, "J": 95.0, "V": 8.0, "dt": 2e-3, "T": 4.0, "h": 1e-4},
    "joint": {"R": 1.0, "L": 1.0, "K": 1.0, "b": 0.05, "J": 0.02, "V": 2.5, "dt": 2e-3, "T": 3.0, "h": 1e-4},
    "stage": {"R": 1.0, "L": 1.0, "K": 12.0, "b": 40.0, "J": 9.0, "V": 5.0, "dt": 2e-3, "T": 2.6, "h": 1e-4},
}
TORQUE = {"servo", "emps", "joint", "stage"}
LINEAR = {"axis", "emps", "belt", "stage"}


def seed(name):
    return zlib.crc32(name.encode())


def motor(name, rng):
    m = dict(MOTORS[name])
    for k in "RLKbJ":
        m[k] *= float(np.exp(rng.uniform(-0.2, 0.2)))
    if name in TORQUE:
        m["R"] = m["L"] = 1.0
    m["name"] = name
    m["torque"] = name in TORQUE
    m["ts"] = m["K"] * m["V"] / m["R"]  # stall torque
    m["is"] = m["V"] / m["R"]
    m["ws"] = m["V"] / m["K"] if not m["torque"] else m["ts"] / (m["b"] + 0.0)
    m["tm"] = m["R"] * m["J"] / m["K"] ** 2 if not m["torque"] else m["J"] / m["b"] * 0.25
    return m


def build(m, eff):
    """Return (advance, state names, x0) for a motor with effects {name: size}."""
    ts, ws, Is, V = m["ts"], m["ws"], m["is"], m["V"]
    R, L, K, b, J = (m[k] for k in "RLKbJ")
    st = ["i", "w", "th"]
    el, tq, fr, extra = [], [], None, []
    par = {}
    Rn, Ln, Kn, vn = "R", "L", "K", []
    Jn = "J"
    e = dict(eff)
    has = e.__contains__

    def P(**kw):
        par.update({k: float(v) for k, v in kw.items()})

    # --- voltage
    if has("driver_dead_band"):
        x = e["driver_dead_band"]
        f, form = x if isinstance(x, tuple) else (x, "shift")
        P(Vd=f * V)
        vn.append("vv = v-Vd if v > Vd else (v+Vd if v < -Vd else 0.0)" if form == "shift"
                  else "vv = v if (v > Vd or v < -Vd) else 0.0")
    if has("voltage_offset"):
        P(V0=e["voltage_offset"] * V)
        vn.append("vv = vv+V0")
    if has("x_sag"):  # supply with an inner resistance, the bridge takes d*i from it: v - Rs d^2 i, not logged
        P(Rs=e["x_sag"] * R, Vs=V * 1.05)
        vn.append("vv = vv-Rs*i*(v/Vs)**2")
    if has("supply_sag"):  # a supply behind a resistance, a capacitor before the bridge
        P(Rs=e["supply_sag"] * R, Vs=V, Cs=1e-3 / (e["supply_sag"] * R))
        st.append("vb")
        vn.append("du = v/Vs\nvv = du*vb")
        extra.append("dvb = ((Vs-vb)/Rs-du*i)/Cs")
    if has("x_ripple_duty"):  # the bridge's voltage ripples with the commutation
        a, N = e["x_ripple_duty"]
        P(ad=a, Nd=N)
        vn.append("vv = vv*(1.0+ad*sin(Nd*th))")
    if has("x_driver_soft"):  # a linear amplifier near its rails
        P(vsat=e["x_driver_soft"] * V)
        vn.append("vv = vv/(1.0+(vv/vsat)**4)**0.25")
    if has("x_driver_uneven"):  # half bridges of different gain
        P(gp=1 + e["x_driver_uneven"])
        vn.append("vv = vv*gp if vv > 0 else vv")
    if has("x_derate"):  # a driver that gives less when it is warm
        f, tau = e["x_derate"]
        P(fd=f, td=tau, Pn=(0.4 * Is) ** 2)
        st.append("T")
        vn.append("vv = vv*(1.0-fd*min(max((T-0.4)/0.2, 0.0), 1.0))")
        extra.append("dT = (i*i/Pn-T)/td")
    if has("x_slew"):  # a voltage that rises only so fast
        st.append("va")
        P(Ta=2e-3, sl=e["x_slew"] * V)
        extra.append("dva = max(min((vv-va)/Ta, sl), -sl)")
        vn_post = ["vx = va"]
    elif has("x_driver_lag"):
        st.append("va")
        P(Ta=e["x_driver_lag"])
        extra.append("dva = (vv-va)/Ta")
        vn_post = ["vx = va"]
    else:
        vn_post = ["vx = vv"]
    if has("winding_heating"):
        dT, tau = e["winding_heating"]  # final rise at 0.5 of the stall current, thermal time constant
        Rth = dT / (R * (0.5 * Is) ** 2)
        P(al=0.0039, Rth=Rth, Cth=tau / Rth)
        st.append("T")
        el.append("Rr = R*(1.0+al*T)")
        extra.append("dT = (Rr*i*i - T/Rth)/Cth")
        Rn = "Rr"
    if has("x_commutator"):
        f, width = e["x_commutator"]
        P(fR=1 + f, wd=width)
        el.append("Rr = R*fR if (th % 6.283185307179586) < wd else R")
        Rn = "Rr"
    if has("magnetic_saturation"):
        P(iK=e["magnetic_saturation"] * Is)
        el.append("Kk = K/(1.0+(i/iK)**2)")
        Kn = "Kk"
    if has("x_demag"):  # magnets weaken as they warm up with the copper loss
        f, tau = e["x_demag"]
        P(fm=f, tmag=tau, Pn=R * (0.4 * Is) ** 2)
        st.append("T")
        el.append("Kk = K*(1.0-fm*T)")
        extra.append("dT = (R*i*i/Pn - T)/tmag")
        Kn = "Kk"
    if has("magnet_heating"):
        dT, tau = e["magnet_heating"]  # final rise at 0.5 of the stall current, thermal time constant
        Rth = dT / (R * (0.5 * Is) ** 2)
        P(al=0.002, Rth=Rth, Cth=tau / Rth)
        st.append("T")
        el.append("Kk = K*(1.0-al*T)")
        extra.append("dT = (R*i*i-T/Rth)/Cth")
        Kn = "Kk"
    if has("x_flux_speed"):  # brushes off the neutral line: the flux falls with the speed
        P(fs=e["x_flux_speed"] / ws**2)
        el.append("Kk = K*(1.0-fs*w*w)")
        Kn = "Kk"
    if has("inductance_saturation"):
        P(iL=e["inductance_saturation"] * Is)
        el.append("Ll = L/(1.0+(i/iL)**2)")
        Ln = "Ll"
    br = ""
    if has("brush_drop"):
        P(Vb=e["brush_drop"] * V, ib=0.03 * Is)
        el.append("ub = Vb*(1.0-exp(-i/ib)) if i >= 0 else -Vb*(1.0-exp(i/ib))")
        br = "-ub"
    if m["torque"]:
        di = ["i = vx", "di = 0.0"]
    else:
        di = [f"di = (vx-{Rn}*i-{Kn}*w{br})/{Ln}"]
        if has("x_coast"):  # bridge opened at zero command
            P(to=4 * m["h"])
            di.append("if v == 0.0: di = -i/to")
        if has("driver_coast"):  # all switches open: diodes put the supply against the current until it is gone
            P(Vd0=V * e["driver_coast"])
            di.append("if v == 0.0:  # by the sign at the step's start\n    di = (-Vd0-R*i-K*w)/L if i_0 > 0.0 else "
                      "((Vd0-R*i-K*w)/L if i_0 < 0.0 else 0.0)")
        if has("x_limit") or has("driver_current_limit"):
            P(il=(e["x_limit"] if has("x_limit") else e["driver_current_limit"]) * Is)
            di.append("if i >= il and di > 0: di = 0.0")
            di.append("if i <= -il and di < 0: di = 0.0")
    # --- torque
    tm = f"{Kn}*i"
    if has("torque_ripple"):
        a, N, ph = e["torque_ripple"]
        P(ar=a, Nr=N, pr=ph)
        tm = f"{Kn}*i*(1.0+ar*sin(Nr*th+pr))"
    if has("x_torque_play"):  # magnetic hysteresis: the flux of the armature follows the current with play
        P(pw=e["x_torque_play"] * Is)
        st.append("ih")
        extra.append("dih = 0.0")
        tm = f"{Kn}*ih"
    if has("x_backdrive") or has("gear_efficiency"):  # gear: loss in the torque carried, another when driven back
        e1, e2 = e["x_backdrive"] if has("x_backdrive") else e["gear_efficiency"]
        P(e1=e1, e2=e2)
        tq.append(f"tm = {tm}")
        tq.append("tm = tm*e1 if tm*w > 0 else tm*e2")
        tm = "tm"
    if has("x_clutch"):  # slipping clutch: torque to the shaft is bounded
        P(cl=e["x_clutch"] * ts)
        tq.append(f"tm = {tm}")
        tq.append("tm = cl if tm > cl else (-cl if tm < -cl else tm)")
        tm = "tm"
    bn = "b*w"
    if has("x_viscous_angle"):
        P(bv=e["x_viscous_angle"])
        bn = "b*(1.0+bv*sin(th+0.4))*w"
    if has("x_warm_friction"):  # viscous friction that falls from b(1+f) to b while the grease warms
        f, tau = e["x_warm_friction"]
        P(wf=f, wt=tau)
        bn = "b*(1.0+wf*exp(-t/wt))*w"
    if has("x_self_warm"):  # a bearing that is warmed by the motor's loss, and its grease thinned
        f, tau = e["x_self_warm"]
        P(fw=f, tw=tau, Pn=R * (0.4 * Is) ** 2)
        st.append("T")
        extra.append("dT = (R*i*i/Pn-T)/tw")
        bn = "b*exp(-fw*T)*w"
    tq.append(f"q = {tm}-{bn}")
    if has("x_eddy") or has("eddy_brake"):
        f, w0 = e["x_eddy"] if has("x_eddy") else e["eddy_brake"]
        P(ce=f * ts / ws, we=w0 * ws)
        tq.append("q -= ce*w/(1.0+(w/we)**2)")
    if has("quadratic_drag"):
        P(c2=e["quadratic_drag"] * ts / ws**2)
        tq.append("q -= c2*w*abs(w)")
    if has("x_cubic"):
        P(c3=e["x_cubic"] * ts / ws**3)
        tq.append("q -= c3*w*w*w")
    if has("viscous_asymmetric"):
        P(ba=e["viscous_asymmetric"] * ts / ws)
        tq.append("q -= ba*abs(w)")
    if has("constant_load"):
        P(tl0=e["constant_load"] * ts)
        tq.append("q -= tl0")
    if has("gravity"):
        f, ph = e["gravity"]
        P(mgl=f * ts, pg=ph)
        tq.append("q -= mgl*sin(th+pg)")
    if has("cogging"):
        f, N, ph = e["cogging"]
        P(Ac=f * ts, Nc=N, pc=ph)
        tq.append("q -= Ac*sin(Nc*th+pc)")
    if has("x_oneway_fan"):  # blades that take the air only one way
        P(c2=e["x_oneway_fan"] * ts / ws**2)
        tq.append("if w > 0: q -= c2*w*w")
    if has("spring"):
        f, th0 = e["spring"]  # torque per unit angle, relative to the stall torque; angle without torque
        P(ks=f * ts, th0=th0)
        tq.append("q -= ks*(th-th0)")
    if has("x_spring_cubic"):  # a spring that stiffens
        P(ks=e["x_spring_cubic"] * ts)
        tq.append("q -= ks*th**3")
    if has("x_detent"):  # narrow notches
        f, N, ph = e["x_detent"]
        P(Ac=f * ts, Nc=N, pc=ph)
        tq.append("sd = sin(Nc*th+pc)\nq -= Ac*sd*sd*sd*sd*sd")
    if has("x_spring"):
        P(ks=e["x_spring"] * ts)  # torque per unit angle, relative to the stall torque
        tq.append("q -= ks*th")
    if has("x_endstop"):
        thm, k = e["x_endstop"]
        P(es=thm, ek=k * ts)
        tq.append("q -= ek*(th-es) if th > es else (ek*(th+es) if th < -es else 0.0)")
    if has("x_load_time"):
        f, form, p = e["x_load_time"]
        P(lt=f * ts, lp=p)
        tq.append({"sine": "q -= lt*sin(6.283185307179586*t/lp)",
                   "step": "q -= lt if t > lp else 0.0",
                   "pulses": "if t % lp < 0.3*lp: q -= lt",
                   "ramp": "q -= lt*t/lp"}[form])
    if has("x_crank"):  # inertia depends on the angle: J(1+a cos 2th)
        P(aj=e["x_crank"])
        tq.append("Jj = J*(1.0+aj*cos(2*th))")
        tq.append("q += J*aj*sin(2*th)*w*w")
        Jn = "Jj"
    if has("x_crank_once"):  # an arm out of balance in its inertia, in a plane
        P(aj=e["x_crank_once"])
        tq.append("Jj = J*(1.0+aj*cos(th))")
        tq.append("q += 0.5*J*aj*sin(th)*w*w")
        Jn = "Jj"
    if has("x_mass_drop"):  # a part of the load falls off
        f, at = e["x_mass_drop"]
        P(fj=1 + f, tj=at)
        tq.append("Jj = J*fj if t < tj else J")
        Jn = "Jj"
    if has("x_slip_clutch"):  # load behind a clutch that slips above a torque
        r, f, tau = e["x_slip_clutch"]
        Jl, Jm = r * J, (1 - r) * J
        P(c=Jl * Jm / J / tau, cl=f * ts, Jm=Jm, Jl=Jl)
        st.append("wl")
        tq.append("sh = c*(w-wl)\nsh = cl if sh > cl else (-cl if sh < -cl else sh)\nq -= sh")
        extra.append("dwl = sh/Jl")
        Jn = "Jm"
    if has("compliance") or has("backlash"):
        st += ["wl", "thl"]
        if has("compliance"):
            r, om, ze = e["compliance"]
            gap = 0.0
        else:
            r, gap, om, ze = e["backlash"]
        Jl, Jm = r * J, (1 - r) * J
        Je = Jl * Jm / J
        P(k=Je * om**2, c=2 * ze * Je * om, g=gap / 2, Jm=Jm, Jl=Jl)
        if gap == 0:
            tq.append("sh = k*(th-thl)+c*(w-wl)")
        else:  # hard gap; the teeth push and never pull
            tq += ["ee = th-thl", "sh = 0.0",
                   "if ee > g:\n    sh = k*(ee-g)+c*(w-wl)\n    if sh < 0: sh = 0.0",
                   "elif ee < -g:\n    sh = k*(ee+g)+c*(w-wl)\n    if sh > 0: sh = 0.0"]
            tq[-2:] = [tq[-2] + "\n" + tq[-1]]
        tq.append("q -= sh")
        extra += ["dwl = sh/Jl", "dthl = wl"]
        Jn = "Jm"
    if has("lugre"):
        fc, fs, wf, ths = e["lugre"]
        P(tc=fc * ts, tS=fs * ts, wS=wf * ws, s0=fc * ts / ths, s1=2 * 0.3 * math.sqrt(fc * ts / ths * J))
        st.append("z")
        tq += ["gg = (tc+(tS-tc)*exp(-(w/wS)**2))/s0", "dz = w-abs(w)/gg*z",
               "q -= s0*z+s1*exp(-(w/(0.02*wS))**2)*dz"]
    # --- dry friction: magnitude while sliding with sign s
    frp = []
    if has("coulomb"):
        P(tc=e["coulomb"] * ts)
        frp.append("tc")
    if has("x_friction_angle") or has("angular_friction"):
        f, a, ph = e["x_friction_angle"] if has("x_friction_angle") else e["angular_friction"]
        P(tc=f * ts, fa=a, fp=ph)
        frp.append("tc*(1.0+fa*sin(th+fp))")
    if has("x_friction_sets_in"):  # grease squeezed out: dry friction that grows with the time since the start
        f, g, tau = e["x_friction_sets_in"]
        P(tc=f * ts, fg=g, ft=tau)
        frp.append("tc*(1.0+fg*t/(t+ft))")
    if has("x_friction_time"):
        f, f2, tau = e["x_friction_time"]
        P(tc=f * ts, tc2=f2 * ts, ft=tau)
        frp.append("(tc+tc2*exp(-t/ft))")
    if has("coulomb_asymmetric"):
        p, n = e["coulomb_asymmetric"]
        P(tp=p * ts, tn=n * ts)
        frp.append("(tp if s > 0 else tn)")
    if has("stribeck"):
        fc, fs, wf = e["stribeck"]
        P(tc=fc * ts, tS=fs * ts, wS=wf * ws)
        frp.append("(tc+(tS-tc)*exp(-(w/wS)**2))")
    if has("load_friction"):
        P(mu=e["load_friction"])
        frp.append("mu*abs(K*i)")
    # --- sensors with a state
    if has("speed_lag"):
        st.append("wm")
        P(Tw=e["speed_lag"])
        extra.append("dwm = (w-wm)/Tw")
    if has("current_lag"):
        st.append("im")
        P(Ti=e["current_lag"])
        extra.append("dim = (i-im)/Ti")
    fr = "+".join(frp)
    body = ["vv = v", *vn, *vn_post, *el, *di, *tq]
    if fr:
        body += ["if s:", f"    dw = (q-s*({fr}))/{Jn}", "else:", "    dw = 0.0"]
    else:
        body += [f"dw = q/{Jn}"]
    body += ["dth = w", *extra]
    par.update(R=R, L=L, K=K, b=b, J=J)
    for k in list(par):
        par[k] = repr(par[k])

    def ind(lines, k):
        return "\n".join(" " * k + ln for x in lines for ln in x.split("\n"))

    src = ["def advance(X, t0, dur, v0, v1, nsub, exp=exp, sin=sin, cos=cos):",
           "    " + "; ".join(f"{k} = {v}" for k, v in par.items()),
           f"    {', '.join(st)}, s = X",
           "    h0 = dur/nsub; t = t0; rem = 0.0"]
    src += ["    for n in range(nsub):", "        t = t0+n*h0; rem = h0; tries = 0", "        while rem > 0.0:",
            "            h = rem; ta = t",
            "            " + "; ".join(f"{x}_0 = {x}" for x in st)]
    for stage, (c, nm) in enumerate([(0, "a"), (0.5, "b"), (0.5, "c"), (1.0, "d")]):
        if stage:
            prev = "abcd"[stage - 1]
            src.append("            " + "; ".join(f"{x} = {x}_0+{c}*h*{x}_{prev}" for x in st))
        src.append(f"            t = ta+{c}*h; v = v0+(v1-v0)*(t-t0)/dur")
        src.append(ind(body, 12))
        src.append("            " + "; ".join(f"{x}_{nm} = d{x}" for x in st))
    src.append("            " + "; ".join(
        f"{x} = {x}_0+h/6.0*({x}_a+2.0*({x}_b+{x}_c)+{x}_d)" for x in st))
    src.append("            t = ta+h; rem = 0.0")
    if has("x_torque_play"):
        src.append("            ih = i-pw if ih < i-pw else (i+pw if ih > i+pw else ih)")
    if has("driver_coast"):
        src.append("            if v == 0.0 and i*i_0 <= 0.0: i = 0.0")
    if has("x_limit") or has("driver_current_limit"):
        src.append("            i = il if i > il else (-il if i < -il else i)")
    if fr:
        src += ["            if s and w*s < 0.0 and tries < 4:",
                "                f = w_0/(w_0-w); tries += 1",
                "                " + "; ".join(f"{x} = {x}_0+f*({x}-{x}_0)" for x in st if x not in ("w", "th")),
                "                th = th_0+0.5*f*h*w_0; w = 0.0; t = ta+f*h; rem = h*(1.0-f)",
                "                s = 0",
                "            if not s:",
                "                w = 0.0; v = v0+(v1-v0)*(t-t0)/dur",
                ind(["vv = v", *vn, *vn_post, *el, *di, *tq], 16),
                "                s = 1", f"                fp = {fr}",
                "                s = -1", f"                fn = {fr}",
                "                s = 1 if q > fp else (-1 if q < -fn else 0)",
                "            if rem < 1e-12: rem = 0.0"]
    src.append(f"    return ({', '.join(st)}, s)")
    ns = {"exp": math.exp, "sin": math.sin, "cos": math.cos}
    text = "\n".join(src)
    exec(compile(text, "<plant>", "exec"), ns)
    x0 = tuple([V if x == "vb" else 0.0 for x in st] + [0 if fr else 1])
    return ns["advance"], st, x0


def excitation(kind, rng, m, n, dt):
    """Return the voltages (n,) of an open-loop run, or a controller f(k, t, w, th) -> v."""
    name, _, amp = kind.partition(":")
    A = (float(amp) if amp else 1.0) * m["V"]
    t = np.arange(n) * dt
    tm = max(m["tm"], 2 * dt)
    T = n * dt

    def levels(lo, hi, draw, start=0.0):
        v = np.empty(n)
        k = max(int(rng.uniform(0.4, 1.0) * tm / dt), 2)
        v[:k] = start
        while k < n:
            j = k + max(int(rng.uniform(lo, hi) * tm / dt), 2)
            v[k:j] = draw()
            k = j
        return v

    if name == "steps":
        state = [1]

        def d():
            state[0] = -state[0]
            return float(np.round(rng.choice([0.3, 0.5, 0.75, 1.0]) * A * (state[0] if rng.random() < 0.75 else 1), 3))
        return levels(3, 8, d)
    if name == "stopgo":
        state = [0]

        def d():
            state[0] += 1
            return 0.0 if state[0] % 2 == 0 else float(rng.choice([-1, 1]) * rng.choice([0.4, 0.7, 1.0]) * A)
        return levels(3, 6, d)
    if name == "prbs":
        state = [1]

        def d():
            state[0] *= -1
            return state[0] * A
        return levels(0.3, 3.0, d)
    if name == "mprbs":
        return levels(0.4, 3.0, lambda: float(rng.uniform(-A, A)))
    if name == "forward":
        return levels(3, 8, lambda: float(rng.uniform(0.35, 1.0) * A))
    if name == "fwdprbs":
        return levels(0.4, 3, lambda: float(rng.uniform(0.3, 1.0) * A))
    if name == "ramp":
        ph = 2 * t / T
        return A * np.interp(ph, [0, 0.5, 1.5, 2.0], [0, 1, -1, 0])
    if name == "ramps":
        ph = (4 * t / T) % 2
        return A * np.interp(ph, [0, 0.5, 1.5, 2.0], [0, 1, -1, 0])
    if name == "stair":
        k = np.floor(t / T * 16)
        lev = np.concatenate([np.arange(1, 5), np.arange(3, -5, -1), np.arange(-3, 1)]) / 4
        return A * lev[np.minimum(k.astype(int), 15)]
    if name == "chirp":
        f0, f1 = 0.03 / tm, 0.4 / tm
        f0 = max(f0, 1.0 / T)
        return A * np.sin(2 * np.pi * (f0 * t + (f1 - f0) * t * t / (2 * T)))
    if name == "multisine":
        v = sum(np.sin(2 * np.pi * j / T * t + rng.uniform(0, 6.28)) for j in (1, 2, 3, 5, 8, 13))
        return A * v / np.max(np.abs(v))
    if name == "telegraph":  # eighths of the voltage, 0 among them
        return levels(0.6, 5.0, lambda: float(rng.integers(-8, 9)) / 8 * A)
    if name == "pulses":  # kicks of both signs with rests between
        state = [0]

        def kick():
            state[0] += 1
            return 0.0 if state[0] % 2 == 0 else float(rng.choice([-1, 1]) * rng.uniform(0.5, 1.0) * A)
        return levels(1.0, 4.0, kick)
    if name == "sweepdown":
        f0, f1 = 0.35 / tm, max(0.03 / tm, 1.0 / T)
        return A * np.cos(2 * np.pi * (f0 * t + (f1 - f0) * t * t / (2 * T)))
    if name == "climb":  # a sine that grows
        return A * np.minimum(t / (0.8 * T), 1.0) * np.sin(2 * np.pi * t * max(0.06 / tm, 2.5 / T))
    if name == "speedloop":
        ref = levels(4, 9, lambda: float(rng.uniform(-0.7, 0.7))) / 1.0 * m["ws"] * (A / m["V"])
        kp = 2.0 * m["K"] if not m["torque"] else 4 * m["b"]
        ki = kp / tm
        s = {"I": 0.0}
        nr = rng.normal(size=n) * 0.004 * m["ws"]
        lsb = m["V"] / 512

        def f(k, tt, w, th):
            err = ref[k] - w - nr[k]
            u = kp * err + s["I"]
            us = min(max(u, -m["V"]), m["V"])
            if u == us:
                s["I"] += ki * err * dt
            return round(us / lsb) * lsb
        return f
    if name == "posloop":
        span = m["ws"] * tm * 6 * (A / m["V"])
        ref = levels(6, 12, lambda: float(rng.uniform(-1, 1))) * span
        kp = m["V"] / span * 1.5
        kd = 0.3 * m["K"] if not m["torque"] else 0.4 * math.sqrt(kp * m["J"])
        lsb = m["V"] / 512
        nr = rng.normal(size=n) * 0.001 * span

        def f(k, tt, w, th):
            u = kp * (ref[k] - th - nr[k]) - kd * w
            return round(min(max(u, -m["V"]), m["V"]) / lsb) * lsb
        return f
    raise ValueError(kind)


def run(m, eff, kind, rng, o, halve=1):
    """Simulate one run; return t, v (as logged), the true channels as the sensors see them, all states, more inputs."""
    adv, st, x = build(m, eff)
    dt, T = o["dt"], o["T"]
    pre = int(o.get("pre", 0.0) / dt)
    n = round(T / dt) + pre
    if o.get("uneven"):
        base = round(dt / m["h"])
        nsub = np.maximum(base + rng.integers(-base // 2, base // 2 + 1, n), 1)
    else:
        nsub = np.full(n, round(dt / m["h"]))
    h = m["h"]
    t = np.concatenate([[0.0], np.cumsum(nsub)[:-1]]) * h
    u = excitation(kind, rng, m, n, dt)
    if not callable(u) and o.get("uneven"):
        u = np.array(u)
    X = list(x)
    th0 = float(rng.uniform(0, 6.28)) if o.get("th0") == "random" else o.get("th0", 0.0)
    X[st.index("th")] = th0
    if "thl" in st:
        X[st.index("thl")] = th0
    share = supply(o["bus"], rng, t) if "bus" in o else None
    late = Late(eff["x_late_when_small"], m["V"], m["h"]) if "x_late_when_small" in eff else None
    X = tuple(X)
    out = np.empty((n, len(st)))
    vlog = np.empty(n)
    sag = o.get("bus_sag", 0.0)
    for k in range(n):
        out[k] = X[:-1]
        c = u(k, t[k], X[1], X[2]) if callable(u) else float(u[k])
        d = nsub[k] * h
        if sag:  # duty against a bus with inner resistance and ripple; the mean voltage is measured and logged
            duty = c / m["V"]
            bus = m["V"] * (1.08 + 0.01 * math.sin(2 * math.pi * 100 * t[k])) - sag * m["R"] * X[0] * duty
            c = round(duty * 512) / 512 * bus
        vlog[k] = c
        if share is not None:  # the command means a share of a supply that wanders
            c = c * share[k]
        ns = int(nsub[k]) * halve
        if o.get("pwm") and abs(c) < 1.1 * m["V"]:
            Vs = 1.15 * m["V"]
            on = d * abs(c) / Vs
            off = d - on
            if on > 1e-9:
                sv, npw = math.copysign(Vs, c), int(o["pwm"])
                of, on, tt = off / 2 / npw, on / npw, t[k]
                q = 2 * halve
                for _ in range(npw):  # centre-aligned, npw periods per tick; sampled amid the off time
                    X = adv(X, tt, of, 0.0, 0.0, q)
                    X = adv(X, tt + of, on, sv, sv, q)
                    X = adv(X, tt + of + on, of, 0.0, 0.0, q)
                    tt += d / npw
            else:
                X = adv(X, t[k], d, 0.0, 0.0, ns)
        elif late:
            for start, length, value in late.tick(t[k], d, c):
                X = adv(X, start, length, value, value, max(round(length / m["h"]) * halve, 1))
        else:
            c1 = float(u[min(k + 1, n - 1)]) if o.get("hold") == "linear" else c
            X = adv(X, t[k], d, c, c1, ns)
    col = {s: out[:, j] for j, s in enumerate(st)}
    y = {"i": col["im" if "im" in col else "i"].copy(), "omega": col["wm" if "wm" in col else "w"].copy(),
         "theta": col["th"].copy()}
    if "supply_side_current" in eff:
        sign, above = eff["supply_side_current"]
        duty = vlog / (above * m["V"])
        y["i"] = y["i"] * (np.abs(duty) if sign == "signed" else duty)
    if "current_gain" in eff:
        y["i"] *= eff["current_gain"]
    if "speed_average" in eff:  # travel per window
        q = round(eff["speed_average"] / dt)
        th = np.concatenate([np.full(q, y["theta"][0]), y["theta"]])
        y["omega"] = (th[q:] - th[:-q]) / (q * dt)
    if "speed_offset" in eff:
        y["omega"] += eff["speed_offset"] * m["ws"]
    if "x_tacho_curve" in eff:  # a tacho that reads less the faster it turns
        y["omega"] *= 1 - eff["x_tacho_curve"] * np.abs(y["omega"]) / m["ws"]
    if "x_tacho_dead" in eff:  # a tacho whose brushes lose a voltage
        y["omega"] = np.sign(y["omega"]) * np.maximum(np.abs(y["omega"]) - eff["x_tacho_dead"] * m["ws"], 0)
    if "x_angle_curve" in eff:  # a potentiometer or a magnet out of centre
        y["theta"] = y["theta"] + eff["x_angle_curve"] * np.sin(y["theta"] + 0.5)
    if "speed_delay" in eff:
        q = round(eff["speed_delay"] / dt)
        y["omega"] = np.concatenate([np.full(q, y["omega"][0]), y["omega"][:-q]])
    if "speed_gain" in eff:
        y["omega"] *= eff["speed_gain"]
    if "current_offset" in eff:
        y["i"] += eff["current_offset"] * m["is"]
    if "x_eccentric" in eff:  # speed from an encoder disc out of centre
        y["omega"] *= 1 + eff["x_eccentric"] * np.sin(y["theta"] + 0.7)
    if "x_current_gain" in eff:  # sensor that compresses
        y["i"] = y["i"] / np.sqrt(1 + (y["i"] / (eff["x_current_gain"] * m["is"])) ** 2)
    col = {k: a[pre:] for k, a in col.items()}
    y = {k: a[pre:] for k, a in y.items()}
    if o.get("zero", True):
        y["theta"] = y["theta"] - y["theta"][0]
    more = {} if share is None else {"v_supply": m["V"] * share[pre:]}
    return t[pre:] - t[pre], vlog[pre:], y, col, more


def supply(kind, rng, t):
    """Return a supply over time, as a share of its nominal voltage: it falls, steps down and up, ripples."""
    if kind != "wanders":
        raise ValueError(kind)
    T = t[-1]
    steps = np.interp(t, np.sort(rng.uniform(0, T, 12)), rng.uniform(-0.12, 0.05, 12))
    return 1 + steps - 0.12 * (np.abs(t - T * rng.uniform(0.3, 0.7)) < 0.1 * T)


class Late:
    """A voltage that acts later the smaller it is, by up to `most` seconds; a newer command takes over."""

    def __init__(self, most, V, h):
        self.most, self.V, self.h = most, V, h
        self.coming, self.now, self.last = [], 0.0, None

    def tick(self, t, d, c):
        """Return (start, length, voltage) for one tick of length `d` that begins at `t` with command `c`."""
        if c != self.last:
            at = t + round(self.most * (1 - min(abs(c) / self.V, 1)) / self.h) * self.h
            self.coming = [x for x in self.coming if x[0] < at] + [(at, c)]
            self.last = c
        parts, a = [], t
        while self.coming and self.coming[0][0] < t + d - self.h / 2:
            at, value = self.coming.pop(0)
            if at > a + self.h / 2:
                parts.append((a, at - a, self.now))
                a = at
            self.now = value
        return [*parts, (a, t + d - a, self.now)]


def measure(rng, o, scale, t, y, turn):
    """Return what the bench logs of the true channels: noise, counts, quantisation, hum, spikes, dropped samples."""
    z = {}
    n = len(t)
    for ch in y:
        if ch.startswith("_"):
            continue
        short = {"i": "i", "omega": "w", "theta": "th"}[ch]
        x = y[ch]
        cpr = o.get("cpr")
        if ch == "theta" and cpr:
            q = turn / cpr
            c = np.floor(x / q + o["_enc"])
            z[ch] = (c - c[0]) * q if o.get("zero", True) else c * q
            continue
        if ch == "omega" and cpr and not o.get("tacho"):
            q = turn / cpr
            th = y["_w_int"]
            c = np.floor(th / q + o["_enc"])
            if o.get("window"):  # counts of the last so many ticks
                ticks = int(o["window"])
                before = np.concatenate([np.full(ticks, c[0]), c])[:n]
                z[ch] = (c - before) / (ticks * (t[1] - t[0])) * q
            elif o.get("backward"):
                w = np.empty(n)
                w[1:] = np.diff(c) / np.diff(t)
                w[0] = w[1] if abs(x[0]) > 0 else 0.0
                z[ch] = w * q
            else:
                w = np.empty(n)
                w[1:-1] = (c[2:] - c[:-2]) / (t[2:] - t[:-2])
                w[0], w[-1] = (c[1] - c[0]) / (t[1] - t[0]), (c[-1] - c[-2]) / (t[-1] - t[-2])
                z[ch] = w * q
        else:
            sg = o.get("n" + short, {"i": 0.01, "w": 0.007, "th": 0.0004}[short]) * scale[ch]
            e = rng.normal(size=n)
            rho = o.get("rho", 0.0)
            if rho:
                e = lfilter([math.sqrt(1 - rho**2)], [1, -rho], np.concatenate([rng.normal(size=300), e]))[300:]
            z[ch] = x + sg * e
        if ch == "i" and o.get("hum"):
            z[ch] = z[ch] + o["hum"] * scale[ch] * np.sin(2 * np.pi * 50.02 * t + rng.uniform(0, 6.28))
        if ch == "i" and o.get("adc"):
            lsb = 12 * scale[ch] / 2 ** o["adc"]
            z[ch] = np.round(z[ch] / lsb) * lsb
        if o.get("spikes") and ch != "theta":
            k = rng.random(n) < o["spikes"]
            z[ch] = z[ch] + k * rng.choice([-1, 1], n) * rng.uniform(0.8, 2.5, n) * scale[ch]
    for ch in z:
        if o.get("glitch") and ch != "theta":  # one sample far off
            z[ch][int(rng.integers(n // 4, 3 * n // 4))] += rng.choice([-1, 1]) * rng.uniform(6, 10) * scale[ch]
        if o.get("drop"):
            k = rng.random(n) < o["drop"]
            k[0] = False
            z[ch] = np.where(k, np.nan, z[ch])
        if o.get("burst") and n > 200:
            a = int(rng.integers(n // 3, 2 * n // 3))
            z[ch] = z[ch].copy()
            z[ch][a:a + max(n // 60, 5)] = np.nan
    return z
