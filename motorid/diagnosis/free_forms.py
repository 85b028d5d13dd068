"""Which free forms there are, and what functions they are made of.

Cosines over the range of a time or an angle, waves of a turn, powers with jumps and kinks at zero for what has a sign.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from motorid.effects import LIBRARY
from motorid.estimation.angle_orders import likely_orders
from motorid.estimation.linearisation import Tangent
from motorid.estimation.result import Fit
from motorid.numerics.signals import Array

KNOTS = 9  # cosines over the range of a quantity
HARMONICS = 8  # of a turn
LINES = 2  # of the spectrum of the misfit over the angle
SHARP = 1e-3  # of the highest speed: below it a direction is not known
CHANGES = {
    "t": "changes with the time",
    "turn": "changes with the angle within a turn",
    "theta": "changes with the angle",
    "omega": "changes with the speed",
    "i": "changes with the current",
    "v": "changes with the voltage",
    "run": "differs from run to run",
}


@dataclass(frozen=True)
class Form:
    """A free function of the quantity `on` times `carrier`, in one balance; `words` says what that is.

    In the balance ``"sensor"`` it is added to the output `channel`; ``"both"`` is the motor constant, which makes
    torque of current and voltage of speed.
    """

    words: str
    balance: str
    on: str
    carrier: str = ""
    channel: str = ""

    @property
    def text(self) -> str:
        """What it is, in words."""
        return f"{self.words} that {CHANGES[self.on]}"

    @property
    def local(self) -> bool:
        """Tell whether what is learnt of it on some runs says nothing of others."""
        return self.on in ("theta", "run")


FORMS = (
    Form("a friction", "torque", "turn", "direction"),
    Form("a friction", "torque", "theta", "direction"),
    Form("a friction", "torque", "t", "direction"),
    Form("a load", "torque", "turn"),
    Form("a load", "torque", "theta"),
    Form("a load", "torque", "t"),
    Form("a drag", "torque", "t", "omega"),
    Form("a drag", "torque", "turn", "omega"),
    Form("a torque", "torque", "omega"),
    Form("a loss of voltage", "voltage", "omega"),
    Form("a loss of voltage", "voltage", "v"),
    Form("a loss of voltage", "voltage", "i"),
    Form("a loss of voltage", "voltage", "t"),
    Form("a resistance", "voltage", "t", "i"),
    Form("a motor constant", "both", "t"),
    Form("a friction", "torque", "run", "direction"),
    Form("a load", "torque", "run"),
    Form("a drag", "torque", "run", "omega"),
    Form("an inertia", "torque", "run", "acceleration"),
    Form("a loss of voltage", "voltage", "run"),
    Form("a resistance", "voltage", "run", "i"),
    Form("a motor constant", "both", "run"),
    Form("a gain of the speed sensor", "sensor", "turn", "omega", "omega"),
    Form("an error of the angle sensor", "sensor", "turn", "", "theta"),
)


def ranges_of(signals: Sequence[Mapping[str, Array]]) -> dict[str, tuple[float, float]]:
    """Return the smallest and the largest value of every quantity known in all runs."""
    names = set.intersection(*(set(s) for s in signals))
    return {n: (min(float(s[n].min()) for s in signals), max(float(s[n].max()) for s in signals)) for n in names}


def shown(form: Form, fit: Fit, ranges: Mapping[str, tuple[float, float]]) -> bool:
    """Tell whether the records can show a form: its quantity is known, its balance is in the model."""
    if form.channel and not {"omega", "theta"} <= set(fit.problem.outputs):
        return False  # one measure of the motion needs the other to be told wrong
    if form.on not in ranges or ranges[form.on][0] == ranges[form.on][1]:
        return False
    if form.balance in ("voltage", "both") and "i" not in fit.problem.outputs:
        return False  # there a torque says the same
    return form.on != "turn" or fit.problem.model.axis != "linear"


def orders_of(fit: Fit) -> list[float]:
    """Return orders of a turn: the lowest, the harmonics of those in the model, and what stands out of the misfit."""
    known = [fit.values[p.name] for e in fit.model.effects for p in e.parameters if p.order]
    seen = likely_orders(Tangent.of(fit), LIBRARY["cogging"], LINES) if "theta" in fit.problem.outputs else []
    return sorted({*range(1, HARMONICS + 1), *(round(k * n) for n in known for k in range(1, 5)), *map(round, seen)})


def basis_of(
    form: Form, signal: Mapping[str, Array], ranges: Mapping[str, tuple[float, float]], orders: Sequence[float]
) -> Array:
    """Return the form's functions along one run, (N, m)."""
    low, high = ranges[form.on]
    z = signal[form.on]
    if form.on not in ("turn", "run"):
        z = np.clip(z, low, high)  # nothing is known beyond
    if form.on == "run":
        functions = (signal["run"][:, None] == np.arange(int(high) + 1)).astype(float)
    elif form.on == "turn":
        waves = [f(k * z) for k in orders for f in (np.sin, np.cos)]
        functions = np.column_stack([np.ones_like(z), *waves])
    elif form.on in ("omega", "i", "v"):
        functions = _through_zero(z, max(abs(low), abs(high)))
    else:
        count = KNOTS if form.on == "t" else 2 * KNOTS
        functions = np.column_stack([np.cos(np.pi * k * (z - low) / (high - low)) for k in range(count)])
    if form.carrier == "direction":
        top = max(abs(x) for x in ranges["omega"])
        return functions * np.clip(signal["omega"] / (SHARP * top), -1, 1)[:, None]
    return functions * signal[form.carrier][:, None] if form.carrier else functions


def _through_zero(z: Array, top: float) -> Array:
    """Return odd and even functions of a quantity with a sign, kinks and jumps at zero included."""
    size, side = np.abs(z) / top, np.clip(z / (SHARP * top), -1, 1)
    powers = np.column_stack([size**p for p in (0.0, 0.5, 1.0, 2.0, 3.0, 4.0)])
    return np.column_stack([powers * side[:, None], powers])
