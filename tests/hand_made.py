"""Small results made by hand, so that showing them can be tested without making them."""

from __future__ import annotations

import numpy as np

from motorid import dc_motor, effects, evaluate, fit
from motorid.diagnosis.results import Adequacy, Binned, Candidate, Diagnosis, Ladder, Missing, Rung
from motorid.records.datasets import data_path
from motorid.records.reading import read_runs


def friction():
    """Records of the shipped set with dry friction: (runs, check)."""
    folder = data_path("hidden_friction")
    return read_runs(sorted(folder.glob("run*.csv"))), read_runs(sorted(folder.glob("check*.csv")))


def fits(runs):
    """The plain motor, and the motor with Coulomb friction."""
    plain = fit(dc_motor(), runs)
    return plain, fit(plain.model + effects.coulomb, runs)


def missing(runs, rng):
    """A missing torque of Coulomb's shape, and a missing voltage that is noise."""
    torque = tuple(8e-3 * np.tanh(r.outputs["omega"]) + rng.normal(0, 5e-4, r.n) for r in runs)
    voltage = tuple(rng.normal(0, 0.01, r.n) for r in runs)
    signals = tuple({"i": r.outputs["i"], "omega": r.outputs["omega"], "t": r.t} for r in runs)
    bins = {
        "torque": tuple(
            _binned(a, u, signals, torque, e)
            for a, u, e in (("omega", "rad/s", 0.93), ("i", "A", 0.4), ("t", "s", 0.03))
        ),
        "voltage": tuple(
            _binned(a, u, signals, voltage, e) for a, u, e in (("i", "A", 0.02), ("t", "s", 0.0))
        ),
    }
    return Missing(
        "mechanical",
        tuple(r.t for r in runs),
        voltage,
        torque,
        signals,
        {"electrical": 0.04, "mechanical": 0.95, "sensor": 0.01},
        {"standstill": 0.1, "steady": 0.6},
        bins,
        "The torque balance fails; the missing torque depends on the speed.",
    )


def _binned(against, unit, signals, values, explained):
    x, y = np.concatenate([s[against] for s in signals]), np.concatenate(values)
    edges = np.linspace(x.min(), x.max(), 21)
    which = np.clip(np.digitize(x, edges) - 1, 0, 19)
    full = [k for k in range(20) if np.count_nonzero(which == k) > 4]
    mean = np.array([y[which == k].mean() for k in full])
    half = np.array([2 * y[which == k].std() / np.sqrt(np.count_nonzero(which == k)) for k in full])
    centre = ((edges[:-1] + edges[1:]) / 2)[full]
    return Binned(
        against,
        unit,
        centre,
        mean,
        mean - half,
        mean + half,
        np.bincount(which, minlength=20)[full],
        explained,
    )


def candidates():
    return (
        Candidate(
            "coulomb",
            0.991,
            0.994,
            {"i": 0.0138, "omega": 0.0102},
            0.93,
            {"tau_c": 8.01e-3},
            ("stribeck", "coulomb_asymmetric"),
            True,
            "lowers the held-out error by 93 %",
        ),
        Candidate(
            "stribeck",
            0.97,
            0.994,
            {"i": 0.0138, "omega": 0.0102},
            0.93,
            {"tau_c": 8e-3},
            ("coulomb",),
            False,
            "no better than coulomb, and larger",
        ),
        Candidate(
            "load_friction",
            0.6,
            0.55,
            {"i": 0.3, "omega": 0.2},
            -0.4,
            {"mu": 0.1},
            (),
            False,
            "raises the held-out error",
        ),
        Candidate("brush_drop", 0.03),
    )


def ladder(plain, better, check):
    return Ladder(
        (
            Rung(None, plain, plain.nrmse, evaluate(plain, check).nrmse),
            Rung("coulomb", better, better.nrmse, evaluate(better, check).nrmse),
        ),
        "Stopped: nothing is left but noise.",
    )


def adequacy(adequate):
    channels = {
        "i": {
            "noise": 0.0042,
            "rms": 0.0043,
            "ratio": 1.02,
            "autocorrelation": 0.01,
            "p_value": 0.4,
        }
    }
    text = "What is left looks like noise." if adequate else "The residuals are far above the noise."
    return Adequacy(adequate, 0.4 if adequate else 1e-9, 0.01, channels, text)


def diagnosis(rng):
    """A whole diagnosis of the shipped friction set."""
    runs, check = friction()
    plain, better = fits(runs)
    return Diagnosis(
        "missing",
        "Coulomb friction is missing: tau_c = 8.0·10⁻³ N·m.",
        "mechanical",
        ("coulomb",),
        adequacy(False),
        missing(runs, rng),
        candidates(),
        ladder(plain, better, check),
        (("coulomb", "stribeck"),),
        "Reverse slowly through zero speed.",
        plain,
        better,
        adequacy(True),
    )
