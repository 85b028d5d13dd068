"""Records that others measured on real motors, fitted from the command line.

The figures to hold are in the README of that folder: 100·‖y − ŷ‖/‖y‖ of an open-loop simulation, from quick fits
by other means. R is held at 1 Ω and L left out where that README's models have none (no current was measured, so
only ratios matter); the error does not depend on it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from command import motorid, motorid_json

import motorid as mi
from motorid.problem.simulate import evaluate
from motorid.records.experiment import split
from motorid.records.reading import read_runs

BARE = ("--fix", "R=1,L=0")  # no inductance; without the current R is a matter of choice
GEAR = ("--columns", "t=t,v=u,omega=y", "--units", "omega=deg/s")


def value(found: dict, name: str) -> float:
    return found["parameters"][name]["value"]


def percent(found: dict, channel: str = "omega", held_out: bool = False) -> float:
    return 100 * found["validation_nrmse" if held_out else "nrmse"][channel]


# -- EMPS: ball screw, driven by force ---------------------------------------------------------------------
def emps(real: Path, folder: Path, *words: str) -> dict:
    return motorid_json(folder, "fit", real / "emps" / "run.csv", "--drive", "torque", "--set", "g=35.15065", *words)


def test_emps_linear_model_fails_as_published(real, tmp_path):
    found = emps(real, tmp_path)
    assert found["model"]["axis"] == "linear"
    assert 1e3 * found["rmse"]["theta"] < 95  # mm; the README has about 90


@pytest.mark.slow
def test_emps_with_friction_and_offset(real, tmp_path):
    """Open loop the position integrates every error of the force twice."""
    found = emps(real, tmp_path, "--effects", "coulomb,constant_load")
    assert 1e3 * found["rmse"]["theta"] < 3.0
    published = {"J": 95.1089, "b": 203.5034, "tau_c": 20.3935, "tau_0": -3.1648}  # from the inverse model, in kg, N
    for name, x in published.items():
        assert value(found, name) == pytest.approx(x, rel=0.15), name
    assert found["parameters"]["J"]["unit"] == "kg"
    # The true carriage starts at rest at the first sample; the initial state must not hide a wrong model.
    assert abs(found["initial"]["theta_0[0]"]) < 1e-3
    assert abs(found["initial"]["omega_0[0]"]) < 0.02


@pytest.mark.slow
def test_emps_with_asymmetric_friction(real, tmp_path):
    found = emps(real, tmp_path, "--effects", "coulomb_asymmetric,viscous_asymmetric")
    assert 1e3 * found["rmse"]["theta"] < 1.75
    b, b_a = value(found, "b"), value(found, "b_a")
    assert b + b_a == pytest.approx(166.706, rel=0.1)
    assert b - b_a == pytest.approx(240.424, rel=0.1)
    assert value(found, "tau_cp") == pytest.approx(20.144, rel=0.1)
    assert value(found, "tau_cn") == pytest.approx(20.628, rel=0.1)


# -- furuta_base: heavy dry friction, a slow filter in the speed -------------------------------------------
def furuta(real: Path, folder: Path, *words: str) -> dict:
    base = real / "furuta_base"
    return motorid_json(folder, "fit", base / "random.csv", *BARE, "--validate", base / "step.csv", *words)


def test_furuta_base_linear_and_with_friction(real, tmp_path):
    linear = furuta(real, tmp_path, "--ignore", "i,theta")
    assert percent(linear) < 51.9
    assert percent(linear, held_out=True) < 38.5
    better = furuta(real, tmp_path, "--ignore", "i,theta", "--effects", "coulomb,constant_load")
    assert percent(better) < 11.7


@pytest.mark.slow
def test_furuta_base_with_its_speed_filter_predicts_the_step(real, tmp_path):
    """The 50 ms filter is seen in the record at standstill; without it friction has to stand in for it."""
    found = furuta(real, tmp_path, "--ignore", "i", "--effects", "coulomb,constant_load,speed_lag")
    assert percent(found) < 11.7
    assert percent(found, held_out=True) < 7.2
    assert value(found, "T_w") == pytest.approx(0.05, rel=0.15)


# -- unmotor, fibo, frc: no current measured ---------------------------------------------------------------
def test_unmotor_linear_and_with_friction(real, tmp_path):
    words = ("fit", real / "unmotor" / "prbs.csv", *GEAR, "--validate", real / "unmotor" / "step.csv")
    assert percent(motorid_json(tmp_path, *words, *BARE)) < 6.1
    friction = motorid_json(tmp_path, *words, *BARE, "--effects", "coulomb")
    assert percent(friction) < 4.4
    lag = motorid_json(tmp_path, *words, "--effects", "coulomb", "--fix", "R=1")
    assert percent(lag) < 1.8  # an inductance of 16 ms does what the 20 ms delay does
    assert percent(lag, held_out=True) < 1.0


def test_fibo_linear_and_with_friction(real, tmp_path):
    """The error on the ramp is bounded below: fitted to the ramp itself these models reach 7.8 % and 4.1 %."""
    words = ("fit", real / "fibo" / "chirp.csv", *BARE, "--validate", real / "fibo" / "ramp.csv")
    linear = motorid_json(tmp_path, *words)
    assert percent(linear) < 4.75
    friction = motorid_json(tmp_path, *words, "--effects", "coulomb")
    assert percent(friction) < 3.35
    assert percent(friction, held_out=True) < 0.6 * percent(linear, held_out=True)
    ramp = motorid_json(tmp_path, "fit", real / "fibo" / "ramp.csv", *BARE, "--effects", "coulomb")
    assert 4.0 < percent(ramp) < percent(friction, held_out=True)


def test_frc_linear_and_with_friction_and_filter(real, tmp_path):
    words = ("fit", real / "frc", "--ignore", "theta")
    linear = motorid_json(tmp_path, *words, *BARE)
    friction = motorid_json(tmp_path, *words, "--fix", "R=1", "--effects", "coulomb,speed_lag")
    assert percent(linear) > 9
    assert percent(friction) < 1.1
    assert 0.03 < value(friction, "T_w") < 0.15  # the filter of about 100 ms


@pytest.mark.parametrize(("folder", "words"), [
    ("unmotor/prbs.csv", GEAR), ("fibo/chirp.csv", ()), ("frc/*.csv", ("--ignore", "theta")),
])
def test_without_current_no_confident_r_comes_out(real, folder, words):
    done = motorid("fit", real / folder, *words)
    said = " ".join(done.out.split())
    assert done.status == 0
    assert "The current was not measured" in said
    assert "fix R and K where they are known" in said
    # One row for all of them, and no value anywhere.
    assert any(" ".join(row.split()) == "R, L, K, b, J not determined" for row in done.out.splitlines())
    assert not any(row.split()[:1] == [name] for row in done.out.splitlines() for name in ("R", "L", "K", "b", "J"))


# -- xl330: a servo lifting a pendulum ---------------------------------------------------------------------
def xl330(runs: list[mi.Experiment], *effects: mi.Effect) -> float:
    """Mean absolute error of the angle over the records, rad, of a fit of every second sample.

    Such a mean is what the robust loss asks for, where the misfit is far above the noise.
    """
    model = sum(effects, mi.dc_motor()).fix(R=1)
    fit = mi.fit(model, [r.decimate(2) for r in runs], loss=mi.Huber())
    return float(np.mean([np.nanmean(np.abs(s.residual("theta"))) for s in evaluate(fit.model, runs).simulations]))


@pytest.mark.slow
def test_xl330_needs_friction_that_grows_with_the_load(real):
    """The README has 0.099 rad with gravity alone and 0.053 with load friction.

    Only that friction tells back-EMF from viscous friction here; a start with much of the former ends in another
    valley, at 0.06 rad.
    """
    runs = [r.without("omega") for r in read_runs(real / "xl330" / "*.csv")]
    assert xl330(runs, mi.effects.gravity) < 0.099
    assert xl330(runs, mi.effects.gravity, mi.effects.load_friction) < 0.053


def test_initial_states_of_held_out_runs_are_found_where_friction_stalls_the_search(real):
    """Sub-steps that suit the first guess once hid where the friction turns: an error 15 times as large."""
    runs = [r.without("theta") for r in read_runs([real / "frc" / f"{n}_forward.csv" for n in ("slow", "fast")])]
    halves = [split(r) for r in runs]
    model = mi.dc_motor(R=0.08217, L=0.06179, K=0.1023, b=0.01106, J=2.66e-4) + mi.effects.coulomb
    model = model.replace(tau_c=0.9081, sgn_width=0.05683)
    assert mi.evaluate(model, [b for _, b in halves]).nrmse["omega"] < 0.02
