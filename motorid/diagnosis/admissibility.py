"""Why a refit must not be believed, whatever its error: signs, limits, phases, what the data leave open."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from motorid.diagnosis.resolvable import unresolved
from motorid.display.numbers import percent
from motorid.estimation.fit import Fit
from motorid.model.definition import Parameter
from motorid.model.model import Effect

WORST_CONDITION = 1e4  # of the column-scaled Jacobian
HOPELESS = 1e6  # condition number beyond which a direction counts as open
KNOWN = 0.3  # of a parameter, its standard deviation: determined
MOST_LOST = 0.6  # of the largest voltage that a drop or a dead band may be
MOST_OFFSET = 0.3  # and an offset, which turns the motor by itself
EMPTIED = 1e-2  # of its value before: it has vanished
LENGTHS = ("rad", "m")  # a gap that runs to its limit is none
PHASE_KNOWN = 0.5  # rad, standard deviation: beyond it an amplitude is not told from none


def objections(fit: Fit, added: Effect, before: Fit | None = None) -> str:
    """Say why the refit must not be believed: a wrong sign, a shape at its limit; empty if it may be.

    `before` is the fit without the effect.
    """
    pars = [fit.problem.model.parameters[p.name] for p in added.parameters]
    for p in pars:
        if p.at_least and fit.values[p.name] < 0.98 * fit.values[p.at_least]:
            return f"{p.name} came out below {p.at_least}, which is not physical"
        inside = 1.02 * p.lower < fit.values[p.name] < 0.98 * p.upper
        if p.grid and p.vary and not inside and (added.includes or p.unit in LENGTHS):
            return f"{p.name} runs to its limit: nothing of this shape is in the data"
        if p.vary and p.null is not None and not p.positive and fit.values[p.name] <= p.lower == p.null:
            return f"{p.name} goes to {p.null:g}: the data do not want it, or only with the wrong sign"
        if p.vary and np.isfinite(p.upper) and fit.values[p.name] > 0.98 * p.upper and not _was_narrowed(p, added):
            return f"{p.name} runs to {p.upper:g}, the limit of what is physical"
    why = _too_large(fit, pars) or _adrift(fit, pars) or unresolved(fit, added)
    return why or (_emptied(fit, added, before) if before else "")


def _too_large(fit: Fit, pars: Sequence[Parameter]) -> str:
    """Say so where a voltage lost or added is of the size of what is applied: another parameter has paid for it."""
    top = max(float(np.abs(r.inputs["v"]).max()) for r in fit.problem.experiments)
    for p in pars:
        most = MOST_OFFSET if p.lower < 0 else MOST_LOST
        if p.unit == "V" and p.null == 0 and abs(fit.values[p.name]) > most * top:
            share = percent(abs(fit.values[p.name]) / top, 2)
            return f"{p.name} = {fit.values[p.name]:.3g} V is {share} of the largest voltage, which is not plausible"
    return ""


def _was_narrowed(p: Parameter, added: Effect) -> bool:
    """Tell whether the limit is one set for these records, and not one of physics."""
    return next(q.upper for q in added.parameters if q.name == p.name) != p.upper


def _emptied(fit: Fit, added: Effect, before: Fit) -> str:
    """Say so where a sensor's effect does away with a parameter of the motor that the data had determined.

    Friction of another kind may well take the place of all of the viscous one; a sensor cannot take the place of an
    inductance, it only buys its gain there.
    """
    if added.balance != "sensor":
        return ""
    for p in before.problem.unknown:
        std = before.std.get(p.name) if p.positive else None
        was, now = (f.values.get(p.name, 0.0) for f in (before, fit))
        if std is not None and std < KNOWN * was and now < EMPTIED * was:
            return f"{p.name} goes to nothing with it, though the data determine it without"
    return ""


def _adrift(fit: Fit, pars: Sequence[Parameter]) -> str:
    """Say so where a phase is not determined: what has no phase has no amplitude."""
    for p in pars:
        if p.periodic and p.vary and ((std := fit.std.get(p.name)) is None or std > PHASE_KNOWN):
            return f"{p.name} is not determined, so neither is the amplitude that goes with it"
    return ""


def ambiguity(fit: Fit) -> tuple[int, float]:
    """Return how many directions of the parameters the data leave open, and the condition of the others."""
    n = len([p for p in fit.problem.model.parameters.values() if p.vary])
    jac = fit.jacobian[:, :n]
    norms = np.linalg.norm(jac, axis=0)
    s = np.linalg.svd(np.linalg.qr(jac / np.where(norms > 0, norms, 1.0), mode="r"), compute_uv=False)
    clear = s[s > s[0] / HOPELESS]
    return len(s) - len(clear), float(clear[0] / clear[-1])
