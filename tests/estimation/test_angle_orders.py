"""Orders of cogging and torque ripple are found by `fit` itself, where the user gives none."""

from __future__ import annotations

import numpy as np
import pytest

import motorid as mi

TRUTH = {"R": 2.0, "L": 1e-3, "K": 0.05, "b": 1e-5, "J": 2e-5}
T = np.arange(0, 3, 1e-3)
DRIVES = (6 * np.sin(2 * np.pi * 0.5 * T) + np.sign(np.sin(2 * np.pi * 1.1 * T)),
          4 * np.sign(np.sin(2 * np.pi * 0.8 * T + 0.3)))


def records(model: mi.Model, channels: str = "i omega theta") -> list[mi.Experiment]:
    rng = np.random.default_rng(3)
    runs = []
    for v in DRIVES:
        bare = mi.Experiment(T, {"v": v}, {c: np.zeros(len(T)) for c in channels.split()})
        y = mi.simulate(model, bare, initial="rest")[0].outputs
        noisy = {c: x + 2e-3 * np.abs(x).max() * rng.standard_normal(len(T)) for c, x in y.items()}
        runs.append(mi.Experiment(T, {"v": v}, noisy))
    return runs


def test_order_of_cogging_beside_friction_is_found():
    asked = mi.dc_motor() + mi.effects.coulomb + mi.effects.cogging
    truth = asked.replace(**TRUTH, tau_c=4e-3, A=3e-3, N=9.0, phi=0.5)
    fit = mi.fit(asked, records(truth))
    assert fit.values["N"] == 9
    assert fit.values["A"] == pytest.approx(3e-3, rel=0.02)
    assert fit.values["phi"] == pytest.approx(0.5, abs=0.05)
    assert fit.status == "converged"


def test_two_orders_are_told_apart():
    asked = mi.dc_motor() + mi.effects.cogging + mi.effects.torque_ripple
    truth = asked.replace(**TRUTH, A=3e-3, N=14.0, phi=-0.4, a_r=0.15, N_r=5.0, phi_r=1.0)
    fit = mi.fit(asked, records(truth))
    assert (fit.values["N"], fit.values["N_r"]) == (14, 5)
    assert fit.values["a_r"] == pytest.approx(0.15, rel=0.05)


def test_order_that_was_given_is_kept():
    truth = (mi.dc_motor() + mi.effects.cogging).replace(**TRUTH, A=3e-3, N=9.0, phi=0.5)
    runs = records(truth)
    fit = mi.fit(mi.dc_motor() + mi.effects.cogging(N=11), runs)
    assert fit.values["N"] == 11
    assert fit.history[-1] > 1.5 * mi.fit(mi.dc_motor() + mi.effects.cogging, runs).history[-1]


def test_order_found_once_stays():
    """A model taken from a fit keeps its order on other records."""
    asked = mi.dc_motor() + mi.effects.cogging
    runs = records(asked.replace(**TRUTH, A=3e-3, N=9.0, phi=0.5))
    again = mi.fit(mi.fit(asked, runs[0]).model, runs[1])
    assert again.values["N"] == 9
    assert again.values["A"] == pytest.approx(3e-3, rel=0.05)


def test_order_is_found_under_true_constraints_too():
    asked = mi.dc_motor() + mi.effects.cogging
    runs = records(asked.replace(**TRUTH, A=3e-3, N=9.0, phi=0.5))[:1]
    fit = mi.fit(asked, runs, constraints=[mi.CurrentLimit(50.0)], solver=mi.MultipleShooting())
    assert fit.values["N"] == 9
    assert fit.values["A"] == pytest.approx(3e-3, rel=0.05)


def test_nothing_but_the_effect_left_to_fit():
    asked = (mi.dc_motor() + mi.effects.cogging).fix(**TRUTH)
    runs = [r.without("theta") for r in records(asked.replace(A=3e-3, N=12.0, phi=0.5))]
    assert mi.fit(asked, runs).values["A"] == pytest.approx(3e-3, rel=0.1)
