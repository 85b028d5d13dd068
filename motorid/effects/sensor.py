"""Effects of the measuring chain; the motor itself is not touched."""

from __future__ import annotations

from motorid.model.definition import P, effect
from motorid.model.equations import Equations


def _lag(m: Equations, channel: str, time_constant) -> None:
    reaching = m.measured(channel)
    z = m.state(f"{channel}_lagged", m.start[channel])
    m.rate(z, (reaching - z) / time_constant)
    m.measure(channel, z)


@effect(balance="sensor")
def speed_lag(
    m: Equations,
    T_w=P(5e-3, "s", null=0.0, positive=True, grid=(1.0, 4.0, 16.0), doc="time constant of the speed filter"),
):
    """First-order filter in the speed measurement. Åström & Murray, Feedback Systems, 2008."""
    _lag(m, "omega", T_w)


@effect(balance="sensor")
def current_lag(m: Equations,
                T_i=P(1e-3, "s", null=0.0, positive=True, grid=(0.5, 2.0, 8.0), doc="time constant of current filter")):
    """First-order filter in the current measurement. Åström & Murray, Feedback Systems, 2008."""
    _lag(m, "i", T_i)


@effect(balance="sensor")
def speed_delay(m: Equations,
                T_d=P(5e-3, "s", null=0.0, positive=True, grid=(1.0, 4.0, 16.0), doc="delay of the speed measurement")):
    """Pure delay of the speed measurement, Padé of orders 2 and 3. Golub & Van Loan, 2013, sec. 9.3."""
    # (60 − 24Ts + 3T²s²)/(60 + 36Ts + 9T²s² + T³s³): with fewer zeros than poles, a jump does not pass at once.
    reaching = m.measured("omega")
    z = [m.state("omega_delayed", m.start["omega"]), m.state("omega_delayed_2"), m.state("omega_delayed_3")]
    m.rate(z[0], z[1] / T_d)
    m.rate(z[1], z[2] / T_d)
    m.rate(z[2], (60 * (reaching - z[0]) - 36 * z[1] - 9 * z[2]) / T_d)
    m.measure("omega", z[0] - 0.4 * z[1] + 0.05 * z[2])


@effect(balance="sensor")
def current_offset(m: Equations, i_0=P(0.02, "A", null=0.0, doc="added by the current sensor")):
    """Offset of the current sensor. Isermann, Identification of Dynamic Systems, 2011."""
    m.measure("i", m.measured("i") + i_0)


@effect(balance="sensor")
def speed_gain(m: Equations, k_w=P(0.01, "", null=0.0, lower=-0.9, upper=9.0, doc="relative error of the speed scale")):
    """Wrong scale of the speed sensor. Isermann, Identification of Dynamic Systems, 2011.

    Needs an angle, or held motor constants, to be told from K and J.
    """
    m.measure("omega", m.measured("omega") * (1 + k_w))
