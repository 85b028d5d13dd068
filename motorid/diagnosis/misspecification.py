"""Are the effects that were found there, or do they only stand in for something that the library lacks?

They stand in if a free form (see `forms`) does what they do and leaves far less, on data that it was not fitted to
either, and what they miss is no trifle beside what they explain: a test of a parametric against a nonparametric form
(Härdle & Mammen, Ann. Statist. 21(4), 1993), with held-out data for a judge. An effect that no such form can do without
is kept. All is linear, about the fitted model; where its errors are too large for that, the form is fitted in earnest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from motorid.diagnosis.cross_validation import BLOCKS, HeldOut, train_errors
from motorid.diagnosis.form_regression import (
    Linear,
    as_effect,
    by_channel,
    fraction,
    fraction_of,
    halves,
    left,
    linearised,
)
from motorid.diagnosis.free_forms import FORMS, Form
from motorid.diagnosis.model_comparison import Node
from motorid.diagnosis.refit import Raced, finished, lost, raced
from motorid.diagnosis.residual_analysis import Errors, astray, compare_errors, far
from motorid.display.numbers import number
from motorid.errors import FAILURES
from motorid.estimation.result import Fit
from motorid.numerics.noise import despiked
from motorid.numerics.signals import Array
from motorid.problem.simulate import misfit_over_noise

MUCH_LESS = 0.5  # of the squared misfit that the effects leave: what a form in their place may leave
LITTLE = 0.1  # of the squared misfit: forms that leave less are equals
NEARLY = 3.0  # times what the best form leaves: what others may leave to be believed too
CONTAINS = 0.7  # of what an effect does: what a form must do in its place
NO_TRIFLE = 0.03  # of what an effect does: what it must miss
VOID = 100.0  # times the misfit: a linear answer that went astray
ROUGH = 0.1  # NRMSE beyond which a linear answer is not trusted
FINISHED = 3  # forms, of those that a few steps put first
FAR_OFF = 30.0  # times the noise, the same


@dataclass(frozen=True)
class Outside:
    """A free form that explains much of what the accepted effects leave, and that the library lacks.

    Attributes
    ----------
    form : Form
    kept : int
        How many of the accepted effects, the first ones, are needed beside it; the others only stand in for it.
    leaves : float
        What it leaves of the squared misfit that they leave, on data that it was not fitted to.
    """

    form: Form
    kept: int
    leaves: float


def outside(steps: Sequence[Fit], held: HeldOut) -> Outside | None:
    """Tell whether something is in the data that the library lacks, and which effects only stand in for it.

    Parameters
    ----------
    steps : sequence of Fit
        Of the first model, and after each effect that was accepted.
    held : HeldOut

    Returns
    -------
    Outside or None
        None where nothing is left, or nothing that any free form would explain.
    """
    channels = far(steps[-1])
    if not channels:
        return None
    rivals: list[Rival] = []
    for kept in range(max(len(steps) - 1, 1)):
        try:
            rivals = _rivals(steps, kept, held, channels)
        except FAILURES:
            continue
        rivals = _believed(rivals)
        instead = [r for r in rivals if r.instead]
        if instead and len(steps) > 1:
            nearer = _in_earnest(steps, held, channels) if kept else None  # the first may have been judged too early
            return nearer or _best(instead, kept)
    beside = [r for r in rivals if r.explains]
    earnest = _in_earnest(steps, held, channels) if len(steps) > 1 or lost(steps[-1]) else None
    return earnest or (_best(beside, len(steps) - 1) if beside else None)


def _believed(rivals: Sequence[Rival]) -> list[Rival]:
    """Return the forms that explain about as much as the best of them: the others imitate it."""
    least = min((max(r.leaves, r.judged, LITTLE) for r in rivals), default=0.0)
    return [r for r in rivals if max(r.leaves, r.judged) <= NEARLY * least]


def _best(rivals: Sequence[Rival], kept: int) -> Outside:
    best = min(rivals, key=lambda r: (max(r.judged, LITTLE), r.form.on != "turn", r.judged))
    return Outside(best.form, kept, best.judged)


@dataclass(frozen=True)
class Rival:
    """A free form against the effect added after the first `kept`; shares of squared misfit.

    Attributes
    ----------
    form : Form
    leaves : float
        Of what the last model leaves.
    judged : float
        The same on data that it was not fitted to.
    does : float
        Of what the effect does.
    missed : float
        What the form explains beside the effect, over what the effect does.
    """

    form: Form
    leaves: float
    judged: float
    does: float
    missed: float

    @property
    def explains(self) -> bool:
        """Tell whether the form explains much of what is left."""
        return max(self.leaves, self.judged) < MUCH_LESS

    @property
    def instead(self) -> bool:
        """Tell whether the effect only stands in for the form."""
        takes_over = (self.does > CONTAINS and self.missed > NO_TRIFLE) or self.missed > 1.0
        return self.explains and takes_over


def _rivals(steps: Sequence[Fit], kept: int, held: HeldOut, channels: Sequence[int]) -> list[Rival]:
    """Return the forms that leave far less than the last model."""
    fit = steps[min(kept + 1, len(steps) - 1)]
    train, *test = linearised(fit, held.validation)
    was = linearised(steps[kept], None, fit.problem.balance)[0] if len(steps) > 1 else None
    last = by_channel(_weighed(steps[-1], fit), train)
    now = by_channel(train.residual, train)
    found = []
    for form in train.forms:
        after = by_channel(left(train.residual, train.slopes, train.own, train.forms[form]), train)
        leaves = fraction(after, last, channels)
        if leaves < MUCH_LESS:
            does, missed = _against(form, train, was, now - after, channels) if was else (1.0, 1.0)
            found.append(Rival(form, leaves, _judged(form, train, test, channels), does, missed))
    return found


def _against(form: Form, train: Linear, was: Linear, gained: Array, channels: Sequence[int]) -> tuple[float, float]:
    """Return how much of what an effect does a form does too, and what the form gains beside it."""
    effect = left(train.residual - was.residual, was.slopes, was.own)
    rest = left(effect, was.slopes, was.own, was.forms[form])
    whole = by_channel(effect, was)
    does = 1 - float(rest @ rest) / max(float(effect @ effect), 1e-300)
    return does, float(sum(gained[c] for c in channels) / max(sum(whole[c] for c in channels), 1e-300))


def _in_earnest(steps: Sequence[Fit], held: HeldOut, channels: Sequence[int]) -> Outside | None:
    """Fit the form that promises most in place of all effects, where errors are too large to be linear.

    Beside the first effect, if it leaves far less there.
    """
    last = steps[-1]
    over_noise = misfit_over_noise(last.problem, last.q)
    names = [last.problem.outputs[c] for c in channels]
    if max(last.nrmse[c] for c in names) < ROUGH and max(over_noise[c] for c in names) < FAR_OFF:
        return None
    try:
        tried = [_nearest(steps, kept, held, channels) for kept in range(min(len(steps), 2))]
        found = [(kept, *pair) for kept, pair in enumerate(tried) if pair is not None]
        if not found:
            return None
        kept, form, fit = found[0]
        if found[-1][2].chi2 < LITTLE * fit.chi2:
            kept, form, fit = found[-1]
        leaves = compare_errors(train_errors(last), train_errors(fit), held.noise)
        judged = compare_errors(held.block_errors(last), held.block_errors(fit), held.noise)
    except FAILURES:
        return None
    fraction = (1 - min(leaves.fall, judged.fall)) ** 2
    return Outside(form, kept, fraction) if fraction < MUCH_LESS else None


def _nearest(steps: Sequence[Fit], kept: int, held: HeldOut, channels: Sequence[int]) -> tuple[Form, Fit] | None:
    """Return the form that explains most beside the first `kept` effects, and its fit.

    It is the one that slopes tell, or the best of all where they cannot, nor a few steps: the best few are finished.
    """
    base, last = steps[kept], steps[-1]
    values = {n: last.values.get(n, v) for n, v in base.values.items()}  # an effect of the first may be gone
    if lost(steps[0]):
        forms = list(FORMS)
    else:
        forms = [
            r.form for r in sorted(_rivals(steps, min(kept, len(steps) - 2), held, channels), key=lambda r: r.leaves)
        ]
    made = [(form, e) for form in forms if (e := as_effect(form, last)) is not None]
    races: list[tuple[Form, Raced]] = []
    for form, effect in made if lost(steps[0]) else made[:1]:
        race = raced(base, base.model.start_at(values) + effect, ({},))
        races += [(form, race)] if race is not None else []
    fits = [(form, finished(base, race)) for form, race in sorted(races, key=lambda found: found[1].cost)[:FINISHED]]
    return min(((form, fit) for form, fit in fits if fit is not None), key=lambda found: found[1].chi2, default=None)


def _weighed(last: Fit, fit: Fit) -> Array:
    """Return the residual of `last` in the weights of `fit`."""
    channels = fit.problem.outputs
    return fit.problem.whiten([np.column_stack([sim.outputs[c] for c in channels]) for sim in last.simulations])


def _judged(form: Form, train: Linear, test: Sequence[Linear], channels: Sequence[int]) -> float:
    """Return what is left where a form is judged on data it was not fitted to.

    Held-out runs may turn through angles that were never seen, or carry a linear answer too far; then blocks of the
    fitted runs are held out.
    """
    if test and not form.local:
        fraction = fraction_of(form, [(train, test[0])], channels)
        if fraction < VOID:
            return fraction
    return fraction_of(form, list(halves(train, BLOCKS)), channels)


STAYS = 5.0  # times the noise, held out
HARDLY = 0.2  # fall of the error


def hardly_moved(path: Sequence[Node], noise: dict[str, float]) -> str:
    """Say which channel's held-out error the effects of the last model leave as it is; empty if none.

    Held-out runs that both lose say nothing; there the error on the fitted runs counts.

    Parameters
    ----------
    path : sequence of Node
        From the first model to the last.
    noise : dict of str to float
        Per channel, SI.
    """
    first, last = path[0], path[-1]
    added = [e for e in last.fit.model.effects if e.name not in first.key]
    if not any(e.balance != "sensor" for e in added):
        return ""  # a sensor's effect need not show in other channels
    before, after = _sizes(first.held), _sizes(last.held)
    for c in astray(first.held.nrmse(), last.held.nrmse()):
        before[c], after[c] = _sizes(first.train)[c], _sizes(last.train)[c]
    for c in before:
        far = after.get(c, 0.0) / noise.get(c, np.inf)
        if far > STAYS and after[c] > (1 - HARDLY) * before[c]:
            return f"leaves the error of {c} at {number(far, 2)} times its noise, where it hardly falls"
    return ""


def _sizes(errors: Errors) -> dict[str, float]:
    found = {}
    for c, parts in errors.residuals.items():
        r = np.concatenate([despiked(p) for p in parts])
        found[c] = float(np.sqrt(np.mean(r**2))) if r.size else 0.0
    return found
