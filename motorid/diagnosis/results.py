"""What a diagnosis found, as plain frozen results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from motorid.display.display import Shown
from motorid.display.tables import Std
from motorid.estimation.result import Fit
from motorid.numerics.signals import Array


@dataclass(frozen=True, eq=False, repr=False)
class Adequacy(Shown):
    """Is anything missing at all?

    Attributes
    ----------
    adequate : bool
    p_value : float
        Probability of residuals at least this bad from noise alone, coloured noise allowed for.
    false_alarm : float
        Rate of false alarms of the verdict.
    channels : dict of str to dict
        Per channel: ``noise`` and ``rms`` of the residual (SI), ``ratio`` of the two, ``autocorrelation`` at lag 1,
        ``input_correlation`` (largest), ``effective_samples``, ``p_value``.
    text : str
    """

    adequate: bool
    p_value: float
    false_alarm: float
    channels: Mapping[str, Mapping[str, float]]
    text: str


@dataclass(frozen=True, eq=False)
class Binned:
    """A missing voltage or torque against one quantity: bin centres, mean, and a band of 95 %."""

    against: str
    unit: str
    centre: Array
    mean: Array
    low: Array
    high: Array
    count: Array
    explained: float  # share of the variance that this quantity explains


@dataclass(frozen=True, eq=False, repr=False)
class Missing(Shown):
    """Where the model fails.

    Attributes
    ----------
    where : {"electrical", "mechanical", "sensor"} or None
    t, voltage, torque : tuple of ndarray
        Per run: time (s), missing voltage (V) and missing torque (N·m) that would make the model match.
    signals : tuple of dict of str to ndarray
        Per run: ``i, omega, theta, heat, t`` at the samples, as far as known.
    shares : dict of str to float
        Share of the misfit by balance: ``electrical``, ``mechanical``, ``sensor``.
    regions : dict of str to float
        Share of the misfit by region: standstill, reversal, acceleration, steady, high current.
    bins : dict of str to tuple of Binned
        ``"voltage"`` and ``"torque"`` against i, omega, theta, heat, t; the best explanation first.
    text : str
    torque_unit : str
    acts_like : str
        What it is like where the library lacks it, e.g. "a load that changes with the angle"; else empty.
    """

    where: str | None
    t: tuple[Array, ...]
    voltage: tuple[Array, ...]
    torque: tuple[Array, ...]
    signals: tuple[Mapping[str, Array], ...]
    shares: Mapping[str, float]
    regions: Mapping[str, float]
    bins: Mapping[str, tuple[Binned, ...]]
    text: str
    torque_unit: str = "N·m"
    acts_like: str = ""


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect (or pair) tried.

    Attributes
    ----------
    effect : str
        Name; a pair is ``"a + b"``.
    predicted_drop, refit_drop : float or None
        Share of chi² that vanishes, predicted from the sensitivities and after refitting.
    validation_nrmse : dict of str to float or None
        Held-out errors after refitting.
    held_out_gain : float or None
        Relative fall of the error on held-out runs, or on held-out blocks without them; None where it came to no
        such test.
    parameters : dict of str to float
        Of the effect, SI: refitted values where there was a refit, else predicted.
    group : tuple of str
        Effects that these data cannot tell from it.
    accepted : bool
    reason : str
        Why it was taken or not.
    """

    effect: str
    predicted_drop: float
    refit_drop: float | None = None
    validation_nrmse: Mapping[str, float] | None = None
    held_out_gain: float | None = None
    parameters: Mapping[str, float] = field(default_factory=dict)
    group: tuple[str, ...] = ()
    accepted: bool = False
    reason: str = ""
    fit: Fit | None = field(default=None, repr=False)


@dataclass(frozen=True, eq=False)
class Rung:
    """One step of the ladder: what was added (None: the model to begin with), the fit, its errors."""

    added: str | None
    fit: Fit
    nrmse: Mapping[str, float]
    validation_nrmse: Mapping[str, float] | None
    removed: tuple[str, ...] = ()
    candidates: tuple[Candidate, ...] = ()


@dataclass(frozen=True, eq=False, repr=False)
class Ladder(Shown):
    """Models of growing detail, training and held-out error of each, and why it stopped."""

    rungs: tuple[Rung, ...]
    text: str

    @property
    def fits(self) -> tuple[Fit, ...]:
        """The fit of each rung."""
        return tuple(r.fit for r in self.rungs)

    @property
    def best(self) -> Fit:
        """The fit of the last rung."""
        return self.rungs[-1].fit


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(Shown):
    """The answer to: where does the model fail, and what is missing?

    Attributes
    ----------
    verdict : {"adequate", "missing", "unexplained"}
    text : str
        The answer in words.
    where : {"electrical", "mechanical", "sensor"} or None
    effects : tuple of str
        Accepted effects, in order.
    adequacy, missing, ranking, ladder
        What it rests on; `ranking` is of the first round, best first.
    groups : tuple of tuple of str
        Effects that these data cannot tell apart.
    suggestion : str or None
        The experiment that would separate them.
    before, after : Fit
    remaining : Adequacy
        Of the model after the last rung.
    std : pair of dict, or None
        One standard deviation per parameter of `before` and `after`, the residuals taken as coloured as they are.
    """

    verdict: str
    text: str
    where: str | None
    effects: tuple[str, ...]
    adequacy: Adequacy
    missing: Missing
    ranking: tuple[Candidate, ...]
    ladder: Ladder
    groups: tuple[tuple[str, ...], ...]
    suggestion: str | None
    before: Fit
    after: Fit
    remaining: Adequacy
    std: tuple[Std, Std] | None = None

    def std_of(self, fit: Fit) -> Std:
        """Return the standard deviations of `before` or `after`, as the text gives them."""
        return fit.std if self.std is None else self.std[fit is self.after]

    def to_dict(self) -> dict[str, Any]:
        """Return the contents of ``diagnose --json``."""
        m = self.missing
        return {
            "verdict": self.verdict,
            "text": self.text,
            "where": self.where,
            "location": {
                "shares": dict(m.shares),
                "regions": dict(m.regions),
                "text": m.text,
                "acts_like": m.acts_like or None,
                "depends_on": {k: [{"on": b.against, "explained": b.explained} for b in v] for k, v in m.bins.items()},
            },
            "ranking": [
                {
                    "effect": c.effect,
                    "predicted_drop": c.predicted_drop,
                    "refit_drop": c.refit_drop,
                    "validation_nrmse": dict(c.validation_nrmse) if c.validation_nrmse else None,
                    "held_out_gain": c.held_out_gain,
                    "group": list(c.group),
                    "parameters": dict(c.parameters),
                    "accepted": c.accepted,
                    "reason": c.reason,
                }
                for c in self.ranking
            ],
            "effects": list(self.effects),
            "ladder": [
                {
                    "added": r.added,
                    "nrmse": dict(r.nrmse),
                    "validation_nrmse": dict(r.validation_nrmse) if r.validation_nrmse else None,
                }
                for r in self.ladder.rungs
            ],
            "parameters_before": dict(self.before.values),
            "parameters_after": dict(self.after.values),
            "groups": [list(g) for g in self.groups],
            "suggestion": self.suggestion,
        }
