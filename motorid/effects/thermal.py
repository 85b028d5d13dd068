"""Effects of heat."""

from __future__ import annotations

from motorid.model.definition import P
from motorid.model.equations import Equations
from motorid.model.model import effect


@effect(balance="voltage")
def winding_heating(
    m: Equations,
    alpha=P(0.00393, "1/K", null=0.0, vary=False, doc="temperature coefficient of copper, held"),
    R_th=P(10.0, "K/W", positive=True, grid=(0.3, 1.0, 3.0), doc="thermal resistance to ambient"),
    C_th=P(10.0, "J/K", positive=True, grid=(0.3, 1.0, 3.0), doc="heat capacity of the winding"),
):
    """Winding resistance that grows with its own heat, R(1+αΔT). Kirtley, Electric Power Principles, 2010.

    ``C_th dΔT/dt = R i² − ΔT/R_th``, ΔT = 0 at the start of each run. Only α·R_th and α/C_th act on the
    electrical signals, so α is held at copper's value.
    """
    dT = m.state("dT")
    m.scale("R", 1 + alpha * dT)
    m.rate(dT, (m.R * m.i**2 - dT / R_th) / C_th)
