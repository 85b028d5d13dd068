"""Effects of what was measured beside the voltage, for records that have it: load torque, temperature, supply."""

from __future__ import annotations

from motorid.model.definition import P, effect
from motorid.model.equations import Equations


@effect(balance="torque")
def measured_load(m: Equations, k_l=P(1.0, "", null=0.0, doc="of the recorded torque that acts; 1: all of it")):
    """Load torque as recorded, against positive speed. Isermann, Identification of Dynamic Systems, 2011."""
    m.torque -= k_l * m.input("tau_load")


@effect(balance="voltage")
def measured_temperature(m: Equations, alpha_T=P(0.00393, "1/K", null=0.0, lower=0.0, doc="copper: 0.0039"),
                         T_ref=P(25.0, "°C", vary=False, doc="temperature that R belongs to, fixed")):
    """Winding resistance at the recorded temperature, R(1+α(T−T_ref)). Kirtley, Electric Power Principles, 2010."""
    m.scale("R", 1 + alpha_T * (m.input("temp") - T_ref))


@effect(balance="voltage")
def measured_supply(m: Equations, k_v=P(1.0, "", null=0.0, doc="of the supply's change that acts; 1: all of it"),
                    V_n=P(12.0, "V", positive=True, vary=False, grid=(1.0,), doc="supply that commands mean, fixed")):
    """Command that means a share of the supply as recorded, v·V/V_n. Mohan, Electric Machines and Drives, 2012."""
    m.scale("v", 1 + k_v * (m.input("v_supply") / V_n - 1))
