"""Effects of the measuring chain; the motor itself is not touched."""

from itertools import pairwise

import casadi as ca

from motorid.model.definition import P, effect
from motorid.model.equations import Equations


def _filter(m: Equations, channel: str, name: str, T, a: tuple, b: tuple = ()) -> None:
    """Let a channel pass a₀(1 + b₁x + …)/(a₀ + a₁x + … + xⁿ) at x = Ts, in a row of n states."""
    reaching, z = m.measured(channel), [m.state(f"{channel}_{name}", m.start[channel])]
    z += [m.state(f"{channel}_{name}_{k}") for k in range(2, len(a) + 1)]
    for slow, fast in pairwise(z):
        m.rate(slow, fast / T)
    m.rate(z[-1], (a[0] * (reaching - z[0]) - sum(k * x for k, x in zip(a[1:], z[1:], strict=True))) / T)
    m.measure(channel, z[0] + sum(k * x for k, x in zip(b, z[1:], strict=False)))


@effect(balance="sensor")
def speed_lag(m: Equations, T_w=P(5e-3, "s", null=0.0, positive=True, grid=(1.0, 4.0, 16.0), pole=True,
                                  doc="time constant of the speed filter")):
    """First-order lag of the speed measurement. Åström & Murray, Feedback Systems, 2008."""
    _filter(m, "omega", "lagged", T_w, (1,))


@effect(balance="sensor", includes=("speed_lag",))
def speed_filter(m: Equations, T_f=P(5e-3, "s", null=0.0, positive=True, grid=(1.0, 4.0, 16.0),
                                     doc="1/natural frequency"),
                 zeta_f=P(0.7, "", positive=True, upper=5.0, grid=(0.1, 0.7), doc="damping ratio")):
    """Second-order filter of the speed: Butterworth, tracking loop, tacho's coupling. Åström & Murray, 2008, ch. 6."""
    _filter(m, "omega", "filtered", T_f, (1, 2 * zeta_f))


@effect(balance="sensor")
def speed_delay(m: Equations,
                T_d=P(5e-3, "s", null=0.0, positive=True, grid=(1.0, 4.0, 16.0), doc="delay of the speed measurement")):
    """Delay of the speed measurement, Padé of orders 4 and 5. Golub & Van Loan, 2013, sec. 9.3."""
    # With fewer zeros than poles a jump does not pass at once; x = Ts, (15120 − 6720x + …)/(15120 + 8400x + …).
    _filter(m, "omega", "delayed", T_d, (15120, 8400, 2100, 300, 25), tuple(k / 15120 for k in (-6720, 1260, -120, 5)))


@effect(balance="sensor")
def speed_average(m: Equations, T_a=P(5e-3, "s", null=0.0, positive=True, grid=(2.0, 6.0, 20.0), pole=True,
                                      doc="window of mean")):
    """Averaging of the speed over a window (counts), Padé of orders 2 and 3. Golub & Van Loan, 2013, sec. 9.3.

    Seen as straight flanks that come late after reversals."""
    # (1 − e⁻ˣ)/x = (120 + 2x²)/(120 + 60x + 12x² + x³) at x = Ts, exact up to x⁵.
    _filter(m, "omega", "mean", T_a, (120, 60, 12), (0, 1 / 60))


@effect(balance="sensor")
def speed_gain(m: Equations, k_w=P(0.01, "", null=0.0, lower=-0.9, upper=9.0, doc="relative error of the speed scale")):
    """Wrong scale of the speed sensor. Isermann, Identification of Dynamic Systems, 2011.

    Needs an angle, or fixed motor constants, to be distinguished from K and J."""
    m.scale("smoothing", 1 / (1 + k_w))  # a width of the records: a scale of K and J must not sharpen friction
    m.measure("omega", m.measured("omega") * (1 + k_w))


@effect(balance="sensor")
def speed_offset(m: Equations, w_0=P(0.5, "rad/s", null=0.0, doc="added by the speed sensor")):
    """Offset of the speed sensor (a tacho, a gyro). Isermann, Identification of Dynamic Systems, 2011.

    While the motor turns, a voltage offset with a load does the same; records at standstill or an angle tell."""
    m.measure("omega", m.measured("omega") + w_0)


@effect(balance="sensor")
def speed_ripple(m: Equations, a_w=P(0.02, "", null=0.0, lower=0.0, upper=0.3, doc="relative amplitude"),
                 N_w=P(1.0, "", order=True, vary=False, lower=1.0, doc="periods per turn, from the misfit, then fixed"),
                 phi_w=P(0.0, "rad", periodic=True, doc="phase at theta = 0"),
                 e_w=P(0.0, "", vary=False, lower=0.0, upper=1.0, grid=(0.0, 1.0), doc="1: in the angle too, fixed")):
    """Ripple of the speed as read, ω·(1+a·sin(N·θ+φ)): a tacho's, an encoder's. Isermann, Mechatronic Systems, 2005.

    With e_w = 1 it is an encoder off centre, in whose angle it shows too. What suits is taken, unless given."""
    size, begun = e_w * a_w / N_w, 0.0  # the rate of the angle's ripple is the speed's
    m.measure("omega", m.measured("omega") * (1 + a_w * ca.sin(N_w * m.theta + phi_w)))
    m.measure("theta", m.measured("theta") - size * ca.cos(N_w * m.theta + phi_w))
    for _ in range(3):  # the angle that shows as the first one read
        begun = size * ca.cos(N_w * (m.start["theta"] + m.zero + begun) + phi_w)
    m.initial["theta"] += begun


@effect(balance="sensor")
def angle_lag(m: Equations, T_pos=P(5e-3, "s", null=0.0, positive=True, grid=(1.0, 4.0, 16.0), pole=True,
                                    doc="time constant of the angle filter")):
    """First-order lag of the angle sensor, as of a magnetic encoder. Åström & Murray, Feedback Systems, 2008."""
    _filter(m, "theta", "lagged", T_pos, (1,))
    m.initial["theta"] += T_pos * m.start["omega"]


@effect(balance="sensor")
def current_lag(m: Equations, T_i=P(1e-3, "s", null=0.0, positive=True, grid=(0.5, 2.0, 8.0), pole=True,
                                    doc="time constant of current filter")):
    """First-order lag of the current measurement. Åström & Murray, Feedback Systems, 2008."""
    _filter(m, "i", "lagged", T_i, (1,))


@effect(balance="sensor")
def current_average(m: Equations, T_m=P(5e-3, "s", null=0.0, positive=True, grid=(2.0, 6.0, 20.0), pole=True,
                                        doc="window of mean")):
    """Averaging of the current over a window (a power monitor), by a filter of order 5. Åström & Murray, 2008."""
    # A current jumps: the least error after jumps that fade within 0.1 to 2 windows, exact in gain and delay.
    _filter(m, "i", "mean", T_m, (8962, 4698, 1111, 169.5, 12.68), (4698 / 8962 - 0.5, 0.0316, 5.5e-4, 1.557e-4))


@effect(balance="sensor")
def current_offset(m: Equations, i_0=P(0.02, "A", null=0.0, doc="added by the current sensor")):
    """Offset of the current sensor. Isermann, Identification of Dynamic Systems, 2011."""
    m.measure("i", m.measured("i") + i_0)


@effect(balance="sensor")
def current_gain(m: Equations, k_i=P(0.01, "", null=0.0, lower=-0.9, upper=9.0, doc="relative error of current scale")):
    """Wrong scale of the current sensor. Isermann, Identification of Dynamic Systems, 2011.

    R, L, b and J take it up: fix one of them (R by an ohmmeter) to determine it."""
    m.measure("i", m.measured("i") * (1 + k_i))


@effect(balance="sensor")
def supply_side_current(m: Equations, V_dc=P(12.0, "V", positive=True, vary=False, grid=(1.0,), doc="supply, fixed"),
                        s_i=P(1.0, "", null=0.0, lower=0.0, upper=1.0, vary=False, doc="1: reads so, fixed"),
                        u_i=P(0.0, "", vary=False, lower=0.0, upper=1.0, grid=(1.0, 0.0), doc="1: no sign, fixed")):
    """Current of the supply, not the motor's: d·i, d = abs(v)/V_dc. Mohan, Electric Machines and Drives, 2012.

    With u_i = 1 it counts positive out of the supply; what suits, unless given, as is the largest voltage for V_dc: a
    larger one leaves R, L, b and J wrong by that factor. Seen as next to no current at small duties, at any load."""
    duty = ca.fmin(ca.fabs(m.command) / V_dc, 1) * (1 + u_i * (ca.sign(m.command) - 1))
    m.measure("i", m.measured("i") * (1 - s_i + s_i * duty))


@effect(balance="sensor")
def encoder_zero(m: Equations, z_0=P(0.0, "rad", null=0.0, per_run=True, doc="angle that the encoder calls 0")):
    """Zero of the encoder, another in every run: cogging keeps its phase. Isermann, Mechatronic Systems, 2005."""
    m.angle_state()
    m.initial["theta"] += z_0
    m.replace("zero", z_0)
    m.measure("theta", m.measured("theta") - z_0)
