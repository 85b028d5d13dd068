"""Are the effects that were found there, or do they only stand in for something that the library lacks?

They stand in if a free form (see `forms`) does what they do and leaves far less, on data that it was not fitted to
either, and what they miss is no trifle beside what they explain: a test of a parametric against a nonparametric form
(Härdle & Mammen, Ann. Statist. 21(4), 1993), with held-out data for a judge. An effect that no such form can do without
is kept. All is linear, about the fitted model; where its errors are too large for that, the form is fitted in earnest.

The same forms tell whether errors larger than the noise are coloured noise: that cannot be predicted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from motorid.diagnosis.adequacy import LARGER, adequacy, following, unpredicted
from motorid.diagnosis.evidence import compare_errors, despiked
from motorid.diagnosis.forms import Form, Linear, as_effect, halves, linearised
from motorid.diagnosis.rank import Score
from motorid.diagnosis.results import Adequacy
from motorid.diagnosis.trial import BLOCKS, FAILURES, HeldOut, refit, train_errors
from motorid.fit import Fit
from motorid.integrate.grid import Array

MUCH_LESS = 0.5  # of the squared misfit that the effects leave: what a form in their place may leave
PREDICTED = 0.1  # of the squared misfit: what a form must explain, on data held out too, that is no noise
LITTLE = 0.1  # of the squared misfit: forms that leave less are equals
NEARLY = 3.0  # times what the best form leaves: what others may leave to be believed too
CONTAINS = 0.7  # of what an effect does: what a form must do in its place
NO_TRIFLE = 0.03  # of what an effect does: what it must miss
VOID = 100.0  # times the misfit: a linear answer that went astray
ROUGH = 0.1  # NRMSE beyond which a linear answer is not trusted
RIDGE = 1e-7  # of the largest singular value; smaller ones are left out


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
    earnest = _in_earnest(steps, held, channels) if len(steps) > 1 else None
    return earnest or (_best(beside, len(steps) - 1) if beside else None)


def judgement(fit: Fit, scores: Sequence[Score], held: HeldOut) -> Adequacy:
    """Judge whether the residuals of `fit` are noise; errors larger than it must not be predictable by any form."""
    judged = adequacy(fit, scores)
    if not judged.adequate or not far(fit):
        return judged
    try:
        found = predicted(fit, held)
    except FAILURES:
        return judged
    return following(judged, found[0].text, found[1]) if found else unpredicted(judged)


def predicted(fit: Fit, held: HeldOut) -> tuple[Form, float] | None:
    """Return the free form that explains most of errors larger than the noise, and how much, on data held out too.

    It must do so on the records, on blocks of them held out and, if there are any, on held-out runs.

    Raises
    ------
    SimulationError
    """
    channels = far(fit)
    if not channels:
        return None
    train, *test = linearised(fit, held.validation)
    best = max(((f, _share(f, train, test, channels)) for f in train.forms), key=lambda f: f[1], default=None)
    return best if best is not None and best[1] > PREDICTED else None


def _share(form: Form, train: Linear, test: Sequence[Linear], channels: Sequence[int]) -> float:
    """Return how much a form explains of the squared misfit, where it explains least."""
    before = _by_channel(_left(train.residual, train.slopes, train.own), train)
    after = _by_channel(_left(train.residual, train.slopes, train.own, train.forms[form]), train)
    left = _fraction(after, before, channels)
    if left < 1 - PREDICTED:
        left = max(left, _fraction_of(form, list(halves(train, BLOCKS)), channels))
    if left < 1 - PREDICTED and test and form.on != "theta":
        left = max(left, _fraction_of(form, [(train, test[0])], channels))
    return 1 - left


def _believed(rivals: Sequence[Rival]) -> list[Rival]:
    """Return the forms that explain about as much as the best of them: the others imitate it."""
    least = min((max(r.leaves, r.judged, LITTLE) for r in rivals), default=0.0)
    return [r for r in rivals if max(r.leaves, r.judged) <= NEARLY * least]


def _best(rivals: Sequence[Rival], kept: int) -> Outside:
    best = min(rivals, key=lambda r: (max(r.judged, LITTLE), r.form.on != "turn", r.judged))
    return Outside(best.form, kept, best.judged)


def far(fit: Fit) -> list[int]:
    """Return which channels' errors are plainly larger than their noise."""
    found = []
    for j, c in enumerate(fit.problem.outputs):
        pairs = zip(fit.simulations, fit.problem.runs, strict=True)
        parts = [despiked(s.residual(c)) / run.sigma[c] for s, run in pairs if c in run.sigma]
        if float(np.sqrt(np.mean(np.concatenate(parts) ** 2))) > LARGER:
            found.append(j)
    return found


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
    last = _by_channel(_weighed(steps[-1], fit), train)
    now = _by_channel(train.residual, train)
    found = []
    for form in train.forms:
        after = _by_channel(_left(train.residual, train.slopes, train.own, train.forms[form]), train)
        leaves = _fraction(after, last, channels)
        if leaves < MUCH_LESS:
            does, missed = _against(form, train, was, now - after, channels) if was else (1.0, 1.0)
            found.append(Rival(form, leaves, _judged(form, train, test, channels), does, missed))
    return found


def _against(form: Form, train: Linear, was: Linear, gained: Array, channels: Sequence[int]) -> tuple[float, float]:
    """Return how much of what an effect does a form does too, and what the form gains beside it."""
    effect = _left(train.residual - was.residual, was.slopes, was.own)
    rest = _left(effect, was.slopes, was.own, was.forms[form])
    whole = _by_channel(effect, was)
    does = 1 - float(rest @ rest) / max(float(effect @ effect), 1e-300)
    return does, float(sum(gained[c] for c in channels) / max(sum(whole[c] for c in channels), 1e-300))


def _in_earnest(steps: Sequence[Fit], held: HeldOut, channels: Sequence[int]) -> Outside | None:
    """Fit the form that promises most in place of all effects, where errors are too large to be linear."""
    root, last = steps[0], steps[-1]
    if max(last.nrmse[last.problem.outputs[c]] for c in channels) < ROUGH:
        return None
    try:
        rivals = sorted(_rivals(steps, 0, held, channels), key=lambda r: r.leaves)
        made = [(r.form, e) for r in rivals if (e := as_effect(r.form, last)) is not None]
        if not made:
            return None
        form, effect = made[0]
        fit = refit(root, root.model.start_at({n: last.values[n] for n in root.values}) + effect, ({},))
        if fit is None:
            return None
        leaves = compare_errors(train_errors(last), train_errors(fit), held.noise)
        judged = compare_errors(held.block_errors(last), held.block_errors(fit), held.noise)
    except FAILURES:
        return None
    fraction = (1 - min(leaves.fall, judged.fall)) ** 2
    return Outside(form, 0, fraction) if fraction < MUCH_LESS else None


def _weighed(last: Fit, fit: Fit) -> Array:
    """Return the residual of `last` in the weights of `fit`."""
    problem, parts = fit.problem, []
    for k, sim in enumerate(last.simulations):
        y, weights, index = problem._weights[k]
        r = ((np.column_stack([sim.outputs[c] for c in problem.outputs]) - y) * weights).ravel()
        parts.append(r if index is None else r[index])
    return np.concatenate(parts)


def _by_channel(residual: Array, part: Linear) -> Array:
    squares: Array = np.bincount(part.channel.astype(int), residual**2).astype(float)
    return squares


def _fraction(after: Array, before: Array, channels: Sequence[int]) -> float:
    """Return what is left of squared misfits, geometric mean over the channels that are not yet down to noise."""
    return float(np.exp(np.mean([np.log((after[c] + 1e-300) / (before[c] + 1e-300)) for c in channels])))


def _judged(form: Form, train: Linear, test: Sequence[Linear], channels: Sequence[int]) -> float:
    """Return what is left where a form is judged on data it was not fitted to.

    Held-out runs may turn through angles that were never seen, or carry a linear answer too far; then blocks of the
    fitted runs are held out.
    """
    if test and form.on != "theta":
        fraction = _fraction_of(form, [(train, test[0])], channels)
        if fraction < VOID:
            return fraction
    return _fraction_of(form, list(halves(train, BLOCKS)), channels)


def _fraction_of(form: Form, parts: Sequence[tuple[Linear, Linear]], channels: Sequence[int]) -> float:
    before = np.sum([_by_channel(_left(judge.residual, judge.own), judge) for _, judge in parts], axis=0)
    after = np.sum([_by_channel(_predicted(form, learn, judge), judge) for learn, judge in parts], axis=0)
    return _fraction(after, before, channels)


def _predicted(form: Form, learn: Linear, judge: Linear) -> Array:
    """Return the residual on `judge` of what `learn` tells; only initial states are fitted there."""
    moved = _solved(np.concatenate([learn.forms[form], learn.slopes, learn.own], axis=1), learn.residual)
    columns = np.concatenate([judge.forms[form], judge.slopes], axis=1)
    return _left(judge.residual - columns @ moved[: columns.shape[1]], judge.own)


def _left(residual: Array, *columns: Array) -> Array:
    """Return what the best mixture of `columns` leaves."""
    together = np.concatenate(columns, axis=1)
    return residual - together @ _solved(together, residual) if together.shape[1] else residual


def _solved(columns: Array, residual: Array) -> Array:
    """Return the least-squares coefficients, directions that hardly show left out."""
    norms = np.linalg.norm(columns, axis=0)
    norms = np.where(norms > 0, norms, 1.0)
    return np.linalg.lstsq(columns / norms, residual, rcond=RIDGE)[0] / norms
