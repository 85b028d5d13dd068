"""Effects on the voltage balance: brushes, driver, magnetic circuit."""

import casadi as ca

from motorid.errors import ModelError
from motorid.model.definition import P, effect
from motorid.model.equations import Equations

SUPPLY = P(12.0, "V", positive=True, vary=False, grid=(1.0,), doc="supply, the voltage of full duty, fixed")


@effect(balance="voltage")
def brush_drop(m: Equations, V_b=P(0.5, "V", null=0.0, lower=0.0, doc="voltage lost at the brushes"),
               i_b=P(0.1, "A", positive=True, grid=(0.01, 0.03, 0.1, 0.3), doc="knee current")):
    """Voltage drop of the brushes, V_b·tanh(i/i_b). Shobert, Carbon Brushes, 1965."""
    m.voltage -= V_b * ca.tanh(m.i / i_b)


@effect(balance="voltage")
def winding_heating(m: Equations,
                    alpha=P(0.00393, "1/K", null=0.0, vary=False, doc="temperature coefficient of copper, fixed"),
                    R_th=P(10.0, "K/W", positive=True, grid=(0.3, 1.0, 3.0), doc="thermal resistance to ambient"),
                    C_th=P(10.0, "J/K", positive=True, grid=(0.3, 1.0, 3.0), doc="heat capacity of the winding")):
    """Heating of the winding, R(1+αΔT). Kirtley, Electric Power Principles, 2010.

    ``C_th dΔT/dt = R(1+αΔT) i² − ΔT/R_th``, ΔT = 0 at the start of each run. Only α·R_th and α/C_th act on the
    electrical signals, so α is fixed at copper's value."""
    dT = m.state("dT")
    m.scale("R", 1 + alpha * dT)
    m.rate(dT, (m.R * m.i**2 - dT / R_th) / C_th)


@effect(balance="voltage")
def magnet_heating(m: Equations,
                   alpha_m=P(0.002, "1/K", null=0.0, vary=False, doc="temperature coefficient of ferrite, fixed"),
                   R_thm=P(10.0, "K/W", positive=True, grid=(0.3, 1.0, 3.0), doc="thermal resistance to ambient"),
                   C_thm=P(10.0, "J/K", positive=True, grid=(0.3, 1.0, 3.0), doc="heat capacity")):
    """Heating of the magnets, K/(1+α·ΔT). Hendershot & Miller, Permanent-Magnet Machines, 2010.

    ``C_th dΔT/dt = R i² − ΔT/R_th``, ΔT = 0 at the start of each run; neodymium has half of ferrite's coefficient.
    Seen as a no-load speed that rises within minutes of heavy use."""
    dT = m.state("dT_magnet")
    m.scale("K", 1 / (1 + alpha_m * dT))
    m.rate(dT, (m.R * m.i**2 - dT / R_thm) / C_thm)


@effect(balance="voltage")
def inductance_saturation(m: Equations, i_L=P(5.0, "A", null=float("inf"), positive=True, grid=(0.3, 1.0, 3.0),
                                              doc="current that halves L")):
    """Saturation of the inductance, L/(1+(i/i_L)²). Krause et al., Analysis of Electric Machinery, 2013."""
    m.scale("L", 1 / (1 + (m.i / i_L) ** 2))


@effect(balance="voltage")
def magnetic_saturation(m: Equations, i_K=P(5.0, "A", null=float("inf"), positive=True, grid=(0.7, 1.5, 3.0),
                                            doc="current that halves K")):
    """Magnetic saturation, K/(1+(i/i_K)²) in torque and back-EMF. Krause et al., Electric Machinery, 2013."""
    m.scale("K", 1 / (1 + (m.i / i_K) ** 2))


@effect(balance="voltage")
def driver_dead_band(m: Equations, V_d=P(0.2, "V", null=0.0, lower=0.0, doc="half-width of the dead band")):
    """Dead band of the driver: within ±V_d nothing comes, larger commands lose V_d. Tao & Kokotović, 1996."""
    m.replace("v", m.command - ca.fmax(-V_d, ca.fmin(V_d, m.command)))


@effect(balance="voltage")
def driver_voltage_limit(m: Equations, V_lim=P(5.0, "V", null=float("inf"), positive=True, grid=(0.95, 0.8, 0.6, 0.4),
                                               doc="largest voltage of the driver")):
    """Saturation of the driver: larger commands than ±V_lim give no more. Åström & Murray, Feedback Systems, 2008.

    Seen in the logs of controllers that ask for more than the supply has: commands beyond it change nothing."""
    m.limit("v", V_lim)


OPEN = 1e-6  # V: a command that opens the bridge


@effect(balance="voltage")
def driver_coast(m: Equations, R_c=P(50.0, "Ω", null=0.0, positive=True, grid=(3.0, 30.0),
                                     doc="resistance that ends the current as fast as the diodes do")):
    """Coasting of the driver: at command 0 its bridge opens. Mohan, Electric Machines and Drives, 2012.

    The diodes put the supply against the current; linear, that is L di/dt = −(R + R_c) i, without the back-EMF.
    Seen where the command is 0: no current while the motor turns, and a slow run-down."""
    shorted = ca.exp(-3 * R_c / m.R)  # what is left of the back-EMF: 1 at R_c = 0, none behind an open bridge
    m.voltage -= ca.if_else(ca.fabs(m.command) <= OPEN, R_c * m.i - (1 - shorted) * m.K_e * m.omega, 0)


QUICKEST = 100.0  # in R: how firmly a current that ends is led to zero; no sample tells more, and steps would be short


@effect(balance="voltage", includes=("driver_coast",))
def driver_one_quadrant(m: Equations, R_q=P(50.0, "Ω", null=0.0, positive=True, grid=(3.0, 30.0),
                                            doc="resistance against a current that the drive does not carry")):
    """One-quadrant drive: no current but along the command. Mohan et al., Power Electronics, 2003, ch. 7.

    One switch and a diode, a supply that takes nothing back: a motor whose back-EMF is larger runs free, its current
    ends within L/R_q. Seen where steps down are far slower than steps up."""
    drives = m.v - m.R * m.i - m.K_e * m.omega
    more = (drives - R_q * m.i) / (1 + R_q / (QUICKEST * m.R)) - drives
    along = ca.if_else(m.command > 0, ca.fmax(more, 0), ca.fmin(more, 0))
    m.voltage += ca.if_else(ca.fabs(m.command) <= OPEN, -R_q * m.i, along)


@effect(balance="voltage")
def pwm_coast(m: Equations, s_c=P(0.5, "", null=0.0, lower=0.0, upper=1.5, doc="share of the pauses without current"),
              V_s=SUPPLY):
    """PWM whose bridge opens in its pauses: no back-EMF acts there, K·ω·(1−s·(1−d)), d = abs(v)/V_s. Mohan, 2012.

    Drivers switched by their enable pin, "fast decay": s is near 1 where a pause is long against L/R. Unless V_s is
    given it is the largest voltage of the records; s above 1 says that it is more. Seen as a motor that hardly brakes,
    and runs too fast at small duty: several duties, with steps down."""
    m.voltage += s_c * ca.fmax(1 - ca.fabs(m.v) / V_s, 0) * m.K_e * m.omega


@effect(balance="voltage", includes=("pwm_coast",))
def pwm_fast_decay(m: Equations, a_p=P(1.0, "", positive=True, grid=(0.3, 1.0, 3.0), doc="period of the PWM over L/R"),
                   s_f=P(1.0, "", null=0.0, vary=False, doc="share of the pauses that do so, fixed"),
                   V_s=P(12.0, "V", positive=True, grid=(1.1,), doc="supply, the voltage of full duty")):
    """PWM whose pauses lead the current back into the supply, then open. Mohan et al., Power Electronics, 2003.

    The bridge gives (d−φ)·V_s + (1−d−φ)·e in the mean, with e the back-EMF along the command and φ, at most 1−d, the
    share of a period in which the current ends, ln(1 + (V_s−e)/(V_s+e)·(1−exp(−a·d)))/a. Drivers switched by their
    enable pin; a far above 1 is `pwm_coast` with s = 1. Seen as small duties that hardly drive: steps to all duties."""
    d, sign = ca.fmin(ca.fabs(m.v) / V_s, 1), ca.if_else(m.v < 0, -1, 1)
    e = sign * m.K_e * m.omega
    falls = ca.fmax(V_s - e, 0) / ca.fmax(V_s + e, 0.05 * V_s) * (1 - ca.exp(-a_p * d))
    ends = ca.fmin(ca.log1p(falls) / a_p, 1 - d)
    m.voltage += s_f * sign * ((1 - d - ends) * e - ends * V_s)


LIMITER_GAIN, LIMITER_WIDTH = 5.0, 0.004  # in R: how firmly the current is led to its limit; of R·I_lim: how softly


@effect(balance="voltage")
def driver_current_limit(m: Equations, I_lim=P(5.0, "A", null=float("inf"), positive=True, grid=(0.8, 0.9, 0.97),
                                               doc="largest current of the driver")):
    """Current limit of the driver, which takes voltage away. Mohan, Electric Machines and Drives, 2012.

    The bridge gives no more than what holds the current at its limit, R·I + K·ω, and leads it there within L/(5 R).
    Seen as a flat top of the current: hard steps from rest, reversals."""
    width = LIMITER_WIDTH * m.R * I_lim

    def above(v, sign):
        z = (sign * (v - m.K_e * m.omega + LIMITER_GAIN * m.R * m.i) - (1 + LIMITER_GAIN) * m.R * I_lim) / width
        return width * (ca.fmax(z, 0) + ca.log1p(ca.exp(-ca.fabs(z))))

    m.voltage -= above(m.v, 1) - above(m.v, -1)


@effect(balance="voltage")
def driver_lag(m: Equations, T_v=P(5e-3, "s", null=0.0, positive=True, grid=(1.0, 4.0, 16.0), pole=True,
                                   doc="time constant of the driver's output")):
    """First-order lag of the driver: an output filter, a slow amplifier. Åström & Murray, Feedback Systems, 2008.

    Seen as current and speed that are both late. T_v and L/R may change places in a fit: fix L where it is known."""
    z = m.state("v_lagged", m.base("R") * m.start["i"] + m.base("K") * m.start["omega"])  # holds it as it was
    m.rate(z, (m.v - z) / T_v)
    m.voltage -= m.v - z


NO_RAMP = 6e-8  # s: a ramp quicker than that is a lag of it, which a step of any length follows


@effect(balance="voltage", includes=("driver_lag",))
def driver_slew(m: Equations, T_r=P(0.1, "s", null=0.0, positive=True, grid=(4.0, 16.0, 64.0, 256.0),
                                    doc="time of a change by V_s"), V_s=SUPPLY,
                V_w=P(0.1, "V", positive=True, grid=(0.01, 0.1), doc="how far behind it is at 3/4 of its fastest")):
    """Slew-rate limit of the driver (ramp, soft start), V_s/T_r·tanh(Δv/V_w). Franco, Operational Amplifiers, 2015.

    Seen as steps that come as ramps, small ones as through a lag of T_r·V_w/V_s. V_s: if not given, the largest."""
    z = m.state("v_ramped", m.base("R") * m.start["i"] + m.base("K") * m.start["omega"])
    m.rate(z, V_s / T_r * ca.tanh((m.v - z) / (V_w + V_s * NO_RAMP / T_r)))
    m.voltage -= m.v - z


@effect(balance="voltage")
def supply_sag(m: Equations, R_s=P(0.1, "Ω", null=0.0, lower=0.0, doc="resistance of supply and leads"), V_s=SUPPLY):
    """Sag of the supply, d·(V_s − R_s·d·i), d = v/V_s. Mohan, Electric Machines and Drives, 2012.

    Only R_s/V_s² acts. Unless V_s is given it is the largest voltage of the records: the duty is one there.
    Seen as a voltage missing with the duty squared and the current: steps to several duties, under load."""
    m.voltage -= R_s * (m.v / V_s) ** 2 * m.i


@effect(balance="voltage")
def voltage_offset(m: Equations, V_0=P(0.05, "V", null=0.0, doc="added to the applied voltage")):
    """Offset of the recorded voltage. Isermann, Identification of Dynamic Systems, 2011."""
    m.voltage += V_0


@effect(balance="voltage")
def measured_supply(m: Equations, k_v=P(1.0, "", null=0.0, doc="of the supply's change that acts; 1: all of it"),
                    V_n=P(12.0, "V", positive=True, vary=False, grid=(1.0,), doc="supply that commands mean, fixed")):
    """Recorded voltage of the supply, of which commands are shares. Mohan, Electric Machines and Drives, 2012."""
    m.scale("v", 1 + k_v * (m.input("v_supply") / V_n - 1))


@effect(balance="voltage")
def measured_temperature(m: Equations, alpha_T=P(0.00393, "1/K", null=0.0, lower=0.0, doc="copper: 0.0039"),
                         T_ref=P(25.0, "°C", vary=False, doc="temperature that R belongs to, fixed")):
    """Recorded temperature of the winding, R(1+α(T−T_ref)). Kirtley, Electric Power Principles, 2010."""
    m.scale("R", 1 + alpha_T * (m.input("temp") - T_ref))


@effect(balance="voltage")
def winding_warm_start(m: Equations, dT_0=P(0.0, "K", null=0.0, lower=-200.0, upper=200.0, per_run=True,
                                            doc="rise at the start")):
    """Winding warm at the start, beside winding_heating. Kirtley, Electric Power Principles, 2010.

    Another rise in every run, against the first one, whose resistance at the start is R."""
    if "dT" not in m.states:
        raise ModelError("winding_warm_start says how warm the winding of winding_heating begins: add that too.")
    m.initial["dT"] = ca.SX(dT_0)


@effect(balance="voltage")
def supply_per_run(m: Equations, g_v=P(0.0, "", null=0.0, lower=-0.9, per_run=True, doc="relative to the first run")):
    """Supply that is another in every run: the voltage is 1 + g_v of the recorded one. Isermann, 2011."""
    m.scale("v", 1 + g_v)
