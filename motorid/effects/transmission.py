"""Effects between the motor and its load: elastic shaft, backlash. Sensors sit on the motor side."""

from __future__ import annotations

import casadi as ca

from motorid.model.definition import P
from motorid.model.equations import Equations
from motorid.model.model import effect

CORNER = 0.01  # of half a gap: a stiff shaft is twisted by much less than the gap, and a wide corner is a soft shaft


def _two_inertias(m: Equations, share, resonance, zeta, twist_of, name: str) -> None:
    """Split J into motor and load joined by a shaft; `twist_of` shapes the elastic twist (a gap).

    The total inertia stays J. With load share r, stiffness k = ω_r²·J·r·(1−r) and damping 2·ζ·ω_r·J·r·(1−r),
    so that everything vanishes smoothly as r → 0.
    """
    twist, omega_load = m.state(f"twist_{name}"), m.state(f"omega_{name}", m.start["omega"])
    slip = m.omega - omega_load
    elastic, contact = twist_of(twist)
    # Shaft torque over J·r:
    per_share = (1 - share) * (resonance**2 * elastic + 2 * zeta * resonance * contact * slip)
    motor_side = m.symbols["J"]
    m.rate(twist, slip)
    m.rate(omega_load, per_share)
    m.scale("J", 1 - share)
    m.torque -= motor_side * share * per_share


@effect(balance="transmission")
def compliance(
    m: Equations,
    r_load=P(0.3, "", null=0.0, lower=0.0, upper=0.98, grid=(0.3, 0.7), doc="load's share of the inertia"),
    omega_r=P(200.0, "1/s", positive=True, grid=(0.02, 0.06, 0.2, 0.6), doc="resonance of the two inertias"),
    zeta_r=P(0.05, "", positive=True, upper=2.0, grid=(0.05, 0.3), doc="damping ratio of the resonance"),
):
    """Elastic shaft between two inertias. Ellis, Control System Design Guide, ch. 16, 2012."""
    _two_inertias(m, r_load, omega_r, zeta_r, lambda twist: (twist, 1.0), "load")


@effect(balance="transmission", includes=("compliance",))
def backlash(
    m: Equations,
    r_gap=P(0.3, "", null=0.0, lower=0.0, upper=0.98, grid=(0.3, 0.7), doc="load's share of the inertia"),
    gap=P(0.02, "rad", positive=True, grid=(0.01, 0.03, 0.1), doc="total free play"),
    omega_c=P(500.0, "1/s", positive=True, grid=(0.1, 0.4), doc="resonance while in contact"),
    zeta_c=P(0.2, "", positive=True, upper=2.0, grid=(0.1, 0.5), doc="damping ratio while in contact"),
):
    """Free play between two inertias, elastic in contact. Nordin & Gutman, Automatica 38(10), 2002."""
    half = gap / 2
    width = CORNER * half

    def in_contact(twist):
        # Smooth dead zone (softplus of square-root type) and its slope.
        up, down = twist - half, twist + half
        soft_up, soft_down = ca.sqrt(up**2 + width**2), ca.sqrt(down**2 + width**2)
        return twist + (soft_up - soft_down) / 2, 1 + (up / soft_up - down / soft_down) / 2

    _two_inertias(m, r_gap, omega_c, zeta_c, in_contact, "geared")
