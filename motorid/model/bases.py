"""The base motors: their states, the quantities that effects may scale or replace, their parameters."""

from __future__ import annotations

from motorid.model.definition import Parameter

STATES = {"dc_motor": ("i", "omega"), "torque_driven": ("omega",)}
QUANTITIES = {"dc_motor": ("R", "L", "K", "K_t", "K_e", "b", "J"), "torque_driven": ("g", "b", "J")}
DERIVED = {"K_t": lambda m: m.K, "K_e": lambda m: m.K}
BASES = {
    "dc_motor": (
        Parameter("R", 1.0, "Ω", positive=True, doc="winding resistance"),
        Parameter("L", 1e-3, "H", positive=True, doc="winding inductance"),
        Parameter("K", 0.05, "N·m/A", positive=True, doc="torque and back-EMF constant (V·s/rad)"),
        Parameter("b", 1e-5, "N·m·s/rad", positive=True, doc="viscous friction"),
        Parameter("J", 1e-5, "kg·m²", positive=True, doc="moment of inertia"),
    ),
    "torque_driven": (
        Parameter("g", 1.0, "N·m/V", positive=True, vary=False, doc="torque per unit of the command; held"),
        Parameter("b", 1e-3, "N·m·s/rad", positive=True, doc="viscous friction"),
        Parameter("J", 1e-3, "kg·m²", positive=True, doc="moment of inertia"),
    ),
}
