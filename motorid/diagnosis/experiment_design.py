"""The next experiment: the one whose outcome the rival models predict most differently.

Candidate records within the voltage and current limits are simulated with every rival; the squared difference of
their outputs over the noise is what the record would add to the evidence between them (Hunter & Reiner,
Technometrics 7(3), 1965; Atkinson & Fedorov, Biometrika 62, 1975).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from motorid.display.cards import Card, Shown
from motorid.display.numbers import number
from motorid.display.tables import Flag, Table
from motorid.errors import FitError, MotoridError, UsageError
from motorid.estimation.result import Fit
from motorid.numerics.parallel import one_thread
from motorid.numerics.signals import Array
from motorid.problem.simulate import simulate
from motorid.records.experiment import Experiment

SAMPLES = 2000


@dataclass(frozen=True, eq=False, repr=False)
class Suggestion(Shown):
    """An experiment that would tell rival models apart.

    Attributes
    ----------
    name, text : str
    experiment : Experiment
        Time and voltage to apply; its outputs are what the first model predicts.
    discrimination : dict of str to float
        Per candidate: expected chi² per sample between the rivals that are hardest to tell apart.
    """

    name: str
    text: str
    experiment: Experiment
    discrimination: Mapping[str, float]

    def card(self) -> Card:
        """Return the experiment chosen, and how well each candidate would do."""
        best = sorted(self.discrimination.items(), key=lambda p: -p[1])
        rows = [[Flag(n, "good") if n == self.name else n, number(v, 3)] for n, v in best]
        return Card("Next experiment", (Flag(self.name, "good"),), (self.text,),
                    (Table(["experiment", "expected χ² per sample between the models"], rows),),
                    (("mi.plot_runs(suggestion.experiment)", "see it"),))


@one_thread
def suggest_experiment(fits: Sequence[Fit], *, v_max: float | None = None, i_max: float | None = None,
                       duration: float | None = None) -> Suggestion:
    """Choose the experiment that best tells the models of `fits` apart.

    Parameters
    ----------
    fits : sequence of Fit
        At least two rival models, fitted to the same records.
    v_max, i_max : float, optional
        Limits in V and A; by default the largest in the records.
    duration : float, optional
        s; by default that of the longest record.

    Raises
    ------
    UsageError
        If fewer than two fits are given.
    FitError
        If no candidate can be simulated with all of them.
    """
    if len(fits) < 2:
        raise UsageError("suggest_experiment() compares models: give at least two fits of the same records.")
    runs = fits[0].problem.experiments
    v_max = v_max or max(float(np.abs(r.inputs["v"]).max()) for r in runs)
    duration = duration or max(r.duration for r in runs)
    dt = max(float(np.median([r.dt for r in runs])), duration / SAMPLES)
    t = np.arange(0.0, duration, dt)
    scores: dict[str, float] = {}
    kept: dict[str, Experiment] = {}
    for name, (v, _) in candidates(t, v_max).items():
        predicted = _predictions(fits, t, v, name)
        if predicted is None or (i_max and _over(predicted, i_max)):
            continue
        scores[name] = min(_difference(a, b, fits[0]) for k, a in enumerate(predicted) for b in predicted[k + 1 :])
        kept[name] = Experiment(t, {"v": v}, predicted[0], name=name)
    if not scores:
        raise FitError("no candidate experiment stays within the limits with all models; raise i_max or v_max.")
    best = max(scores, key=lambda n: scores[n])
    what = candidates(t, v_max)[best][1]
    return Suggestion(best, f"{what} (up to {v_max:.3g} V, {duration:.3g} s)", kept[best], scores)


def candidates(t: Array, v_max: float) -> dict[str, tuple[Array, str]]:
    """Return the candidate voltages and what each of them is."""
    s = t / max(t[-1], 1e-12)
    levels = np.array([0, 0.3, 0.6, 1.0, 0.6, 0.3, -0.3, -0.6, -1.0, -0.6, -0.3, 0.15, -0.15])
    staircase = v_max * levels[np.minimum((s * len(levels)).astype(int), len(levels) - 1)]
    chirp = v_max * np.sin(2 * np.pi * (t[-1] * 1.0 * (s + 10 * s**2)) / max(t[-1], 1e-12) * 3)
    return {
        "reversals": (v_max * np.sign(np.sin(2 * np.pi * 4 * s + 1e-9)), "reversals at full voltage"),
        "staircase": (staircase, "a staircase through zero, both directions"),
        "slow sweep": (v_max * (2 * np.abs(2 * ((s + 0.25) % 1) - 1) - 1), "a slow triangle through zero"),
        "low speed": (0.25 * v_max * np.sin(2 * np.pi * 3 * s), "slow reversals at a quarter of the voltage"),
        "coast-down": (v_max * (s < 0.4), "run up and coast down at zero voltage"),
        "chirp": (0.7 * v_max * chirp / max(np.abs(chirp).max(), 1e-12), "a chirp"),
        "warm-up": (np.where((10 * s) % 1 < 0.8, v_max, -v_max),
                    "full voltage with short hard reversals, which also warms the winding"),
        "small steps": (v_max * (0.5 + 0.1 * np.sign(np.sin(2 * np.pi * 10 * s + 1e-9))), "small steps at half speed"),
    }


def _predictions(fits: Sequence[Fit], t: Array, v: Array, name: str) -> list[dict[str, Array]] | None:
    found = []
    blank = {c: np.zeros_like(t) for c in fits[0].problem.outputs}
    try:
        for f in fits:
            run = Experiment(t, {"v": v}, blank, sigma=dict.fromkeys(blank, 1.0), name=name)
            found.append(dict(simulate(f.model, run, initial="rest", estimate_initial=False)[0].outputs))
    except MotoridError:
        return None
    return found


def _over(predicted: Sequence[Mapping[str, Array]], i_max: float) -> bool:
    return any("i" in p and float(np.abs(p["i"]).max()) > i_max for p in predicted)


def _difference(a: Mapping[str, Array], b: Mapping[str, Array], fit: Fit) -> float:
    sigma = {c: s for run in fit.problem.runs for c, s in run.sigma.items()}
    return float(np.mean([np.mean(((a[c] - b[c]) / sigma[c]) ** 2) for c in a if c in sigma]))
