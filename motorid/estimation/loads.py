"""Torques of a model's effects along a measured motion: further columns of its integrated torque balance.

A pendulum on the shaft moves by its weight, not by its inertia; a first guess that leaves the weight out lands
in another valley. Every torque that is linear in its size (Coulomb friction, gravity by its sine and cosine part,
drag, friction growing with the load, a user's own) is known along the measured motion but for that size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from motorid.integrate.engine import Array
from motorid.model.model import Model

WIDE = 0.02  # width of sgn over the highest speed: a measured speed is noise around standstill


class Load(NamedTuple):
    """One size to be found: parameter `name`, or with `phase` the part at that phase angle.

    `signed`: it may be negative. `ratio`: a share of the motor's torque, not a torque.
    """

    name: str
    phase: str = ""
    angle: float = 0.0
    signed: bool = False
    ratio: bool = False


def loads_of(model: Model) -> tuple[Load, ...]:
    """Return what can be found: sizes of torque effects that vanish at zero and were not given."""
    found = []
    for e in model.effects:
        pars = [model.parameters[p.name] for p in e.parameters]
        if e.balance != "torque" or any(p.order and not p.given for p in pars):
            continue
        phases = [p.name for p in pars if p.periodic and p.vary and not p.given]
        for p in pars:
            if p.null == 0 and p.vary and not p.given:
                ratio = p.unit == ""
                if len(phases) == 1:
                    found += [Load(p.name, phases[0], angle, True, ratio) for angle in (0.0, np.pi / 2)]
                else:
                    found.append(Load(p.name, signed=p.lower < 0, ratio=ratio))
    return tuple(found)


def columns(model: Model, loads: Sequence[Load], signals: Mapping[str, Array], base: Mapping[str, float]) -> Array:
    """Return the torque against the motion per unit of each load, (N, loads), along `signals`.

    Parameters
    ----------
    model : Model
    loads : sequence of Load
    signals : mapping
        v, omega, theta and i (or what stands for it), (N,) each.
    base : mapping of str to float
        Values of the base parameters; those of effects are taken at their null, shapes as they are.
    """
    system = model.system(("omega",))
    zero = np.zeros(len(signals["v"]))
    x = np.vstack([signals.get(n, zero) for n in system.states])
    u = np.vstack([signals["theta" if n == "theta_in" else n] for n in system.inputs])
    quiet = {n: base.get(n, p.value if p.null is None else p.null) for n, p in model.parameters.items()}
    quiet["sgn_width"] = WIDE * float(np.max(np.abs(signals["omega"]), initial=0.0)) or 1.0

    def torque(changes: Mapping[str, float]) -> Array:
        p = np.array([(quiet | dict(changes))[n] for n in system.parameters])
        return np.asarray(system.balances(x, u, p))[1]

    silence = torque({})
    acts = [silence - torque({load.name: 1.0} | ({load.phase: load.angle} if load.phase else {})) for load in loads]
    return np.column_stack(acts) if acts else np.empty((len(zero), 0))


def values(loads: Sequence[Load], sizes: Mapping[Load, float], per_ratio: float = 1.0) -> dict[str, float]:
    """Return parameter values from the sizes found; `per_ratio` turns the unit of the sizes into torque."""
    found: dict[str, float] = {}
    for load in loads:
        size = sizes[load] * (1.0 if load.ratio else per_ratio)
        if not load.phase:
            found[load.name] = size
        elif load.angle == 0.0:
            other = sizes[load._replace(angle=np.pi / 2)] * (1.0 if load.ratio else per_ratio)
            found[load.name] = float(np.hypot(size, other))
            found[load.phase] = float(np.arctan2(other, size))
    return {n: v for n, v in found.items() if v != 0.0 or n in {load.phase for load in loads}}


__all__ = ["Load", "columns", "loads_of", "values"]
