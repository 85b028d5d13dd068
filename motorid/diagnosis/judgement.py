"""Is what is left noise? Errors larger than the noise are, only if nothing predicts them.

Coloured noise cannot be predicted on data held out; what a model lacks can, by a free form of what the motor did.
"""

from __future__ import annotations

from collections.abc import Sequence

from motorid.diagnosis.adequacy import adequacy, following, unpredicted
from motorid.diagnosis.cross_validation import BLOCKS, HeldOut
from motorid.diagnosis.form_regression import Linear, halves, linearised
from motorid.diagnosis.free_forms import Form
from motorid.diagnosis.refit import FAILURES
from motorid.diagnosis.remainders import by_channel, far, fraction, fraction_of, left
from motorid.diagnosis.results import Adequacy
from motorid.diagnosis.score_test import Score
from motorid.estimation.fit import Fit

PREDICTED = 0.1  # of the squared misfit: what a form must explain, on data held out too, that is no noise
CLEAR = 1e-3  # p-value of errors larger than the noise that needs no second test: few coloured samples tell little


def judgement(fit: Fit, scores: Sequence[Score], held: HeldOut) -> Adequacy:
    """Judge whether the residuals of `fit` are noise; errors larger than it are, if no form predicts them.

    Unless what they depend on is beyond doubt.
    """
    judged = adequacy(fit, scores)
    if not far(fit) or not (doubtful := adequacy(fit, scores, level=CLEAR)).adequate:
        return judged
    try:
        found = predicted(fit, held)
    except FAILURES:
        return judged
    return following(judged, found[0].text, found[1]) if found else unpredicted(doubtful)


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
    before = by_channel(left(train.residual, train.slopes, train.own), train)
    after = by_channel(left(train.residual, train.slopes, train.own, train.forms[form]), train)
    most = fraction(after, before, channels)
    if most < 1 - PREDICTED:
        most = max(most, fraction_of(form, list(halves(train, BLOCKS)), channels))
    if most < 1 - PREDICTED and test and not form.local:
        most = max(most, fraction_of(form, [(train, test[0])], channels))
    return 1 - most


def pursued(judged: Adequacy, fit: Fit, held: HeldOut) -> Adequacy:
    """Return the judgement of an inadequate model with what its errors follow, as far as a free form tells."""
    if judged.adequate:
        return judged
    try:
        found = predicted(fit, held)
    except FAILURES:
        return judged
    return following(judged, found[0].text, found[1]) if found else judged
