"""Errors larger than the noise: coloured noise, or something missing that coloured noise would look like?"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy
from battery.excite import P, driven, record
from lab_records import pair

import motorid as mi
from motorid.diagnosis.adequacy import adequacy, judge_adequacy
from motorid.diagnosis.free_forms import Form
from motorid.diagnosis.misspecification import better_forms, hum_of
from motorid.diagnosis.model_comparison import node_of
from motorid.diagnosis.predictive_score import HeldOut
from motorid.diagnosis.record_versions import without_spikes
from motorid.diagnosis.score_test import Score
from motorid.diagnosis.verdict import _noise_feedback, closed_loop_remark, outliers_remark
from motorid.effects import LIBRARY
from motorid.numerics.parallel import one_thread
from motorid.numerics.signals import despiked
from motorid.records.experiment import Experiment

DRIVES = ("stairs", "multisine", "steps")


def runs_of(motor, effects, drives=DRIVES, n=800, seed=4, dt=1e-3, rho=0.0, size=0.005) -> list[Experiment]:
    """Records of current, speed and an angle of 4096 counts, with noise of correlation `rho`."""
    rng, runs = np.random.default_rng(seed), []
    for k, words in enumerate(drives):
        r = driven(motor, effects, words, n, dt, rng)
        y = {c: P.coloured(r[c], size * float(np.std(r[c])), rho, rng) for c in ("i", "omega")}
        y["theta"] = P.encoder(r["theta"], 4096)
        runs.append(Experiment(r["t"], {"v": r["v"]}, y, name=f"run{k + 1}"))
    return runs


def rippled(run: Experiment, share: float = 0.05) -> Experiment:
    """The same with a tachometer that ripples once per turn."""
    gain = 1 + share * np.sin(run.outputs["theta"] + 0.4)
    return run.with_(outputs={**run.outputs, "omega": run.outputs["omega"] * gain})


@one_thread
def test_friction_and_drag_that_bend_against_one_another_are_both_found(lab, rng):
    """Long steps of constant voltage: the residual is constant on each, and few samples of it count."""
    both, runs = {"coulomb": {"tau_c": 5e-3}, "quadratic_drag": {"c_2": 1e-7}}, []
    for levels in ([2.4, 4.8, -3.6, 8.4, -14.4, 12], [14.4, 3.6, -10.8], [13.2, 6, -3, -9]):
        t, v = P.staircase(levels, 0.4)
        r = P.simulate(lab, both, t, v, substep=None)
        y = {c: P.white(r[c], 0.005 * float(np.std(r[c])), rng) for c in ("i", "omega")}
        runs.append(Experiment(t, {"v": v}, y, name=f"run{len(runs) + 1}"))
    fit = mi.fit(mi.dc_motor(), runs[:2])
    assert adequacy(fit).adequate  # bins alone do not see it
    judged = judge_adequacy(node_of(fit, HeldOut.of(fit, runs[2:])), ())
    assert not judged.adequate
    assert "follow a torque that changes with the speed" in judged.text
    found = mi.diagnose(fit, runs[2:], effects=("coulomb", "quadratic_drag", "constant_load", "brush_drop"))
    assert set(found.effects) == {"coulomb", "quadratic_drag"}
    assert found.remaining.adequate


def test_a_tachometer_that_ripples_is_found_in_the_measurement(lab):
    runs = [rippled(r) for r in runs_of(lab, {})]
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs[:2]), runs[2:], effects=("coulomb", "cogging", "speed_gain"))
    assert (found.verdict, found.effects, found.where) == ("unexplained", (), "sensor")
    assert found.missing.acts_like == "a gain of the speed sensor that changes with the angle within a turn"
    assert (found.remainder.kind, found.remainder.where) == ("structure", "sensor")
    assert "The measurement fails" in found.text


@one_thread
def test_no_form_predicts_coloured_noise(lab):
    for seed in range(5):
        runs = runs_of(lab, {}, seed=seed, rho=0.93, size=0.02)
        fit = mi.fit(mi.dc_motor(), runs[:2])
        assert adequacy(fit).channels["omega"]["ratio"] > 2
        assert better_forms(fit, fit) == []


@one_thread
def test_a_hum_that_is_a_trifle_of_all_errors_is_no_missing_physics(lab):
    """Alone the speed's error would fall by more than 1 %, with the current's by less; its noise is stated too low."""
    runs = []
    for r in runs_of(lab, {}, n=3000):
        sigma = 0.005 * float(np.std(r.outputs["omega"]))
        hum = 0.3 * sigma * np.sin(2 * np.pi * 50 * r.t + 1)
        outputs = {"i": r.outputs["i"], "omega": r.outputs["omega"] + hum}
        runs.append(r.without("theta").with_(outputs=outputs, sigma={"omega": sigma / 2.5}))
    fit = mi.fit(mi.dc_motor(), runs[:2])
    assert fit.misfit["omega"] > 2
    assert judge_adequacy(node_of(fit, HeldOut.of(fit, runs[2:])), ()).adequate


@pytest.mark.parametrize(("channel", "named"), [("omega", "speed"), ("i", "current")])
def test_a_hum_in_a_sensor_is_said_and_is_no_missing_physics(lab, channel, named):
    runs = []
    for r in runs_of(lab, {}, n=3000):
        y = r.outputs[channel]
        hum = 0.02 * float(np.std(y)) * np.sin(2 * np.pi * 50 * r.t + 1)
        runs.append(r.without("theta").with_(outputs={c: r.outputs[c] for c in ("i", "omega")} | {channel: y + hum}))
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs[:2]), runs[2:], effects=("coulomb", "quadratic_drag"))
    assert found.verdict == "adequate", found.text
    assert found.answer.endswith(f"larger than the noise: a hum of 50 Hz in the sensor of {named}."), found.answer


@one_thread
def test_what_follows_the_motion_as_well_is_no_hum(lab):
    runs = []
    for r in runs_of(lab, {}, n=3000):
        hum = 0.02 * float(np.std(r.outputs["omega"])) * np.sin(2 * np.pi * 50 * r.t + 1)
        runs.append(r.without("theta").with_(outputs={"i": r.outputs["i"], "omega": r.outputs["omega"] + hum}))
    fit = mi.fit(mi.dc_motor(), runs[:2])
    found = better_forms(fit, fit)
    assert "50 Hz" in hum_of(fit, found)
    along = replace(found[0], form=Form("a friction", "torque", "omega"))
    assert not hum_of(fit, [found[0], along])
    assert not hum_of(fit, [along])
    assert not hum_of(fit, [])


def test_adequate_although_larger_than_the_noise_says_what_was_tried(lab):
    runs = runs_of(lab, {}, seed=2, rho=0.93, size=0.02)
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs[:2]), runs[2:], effects=("coulomb", "brush_drop"))
    assert found.verdict == "adequate", found.text
    assert "no smooth function of time, angle, speed, current or voltage predicts them" in found.text
    assert "coloured" in found.text
    assert (found.remainder.kind, found.remainder.follows) == ("fluctuation", None)


def test_what_is_a_tenth_of_rounding_is_not_worth_a_word(lab, rng):
    """Rounding repeats itself at a steady speed, as coloured as anything: the same share of true noise is."""
    line = 2 * np.pi / 16  # so coarse that what is left of the angle is more than a thousandth of it
    runs = [r.with_(outputs={"theta": line * np.floor(r.outputs["theta"] / line)})
            for r in runs_of(lab, {}, ("stairs", "ramps"))]
    small = Score(LIBRARY["coulomb"], 0.1, (), 400.0)
    fit = mi.fit(mi.dc_motor(), runs)
    assert adequacy(fit).channels["theta"]["rounded"] == 1.0
    assert adequacy(fit, [small]).adequate
    assert not adequacy(fit, [replace(small, drop=0.3)]).adequate
    noisy = [r.with_(outputs={"theta": r.outputs["theta"] + 4 * line * rng.normal(size=r.n)}) for r in runs]
    fit = mi.fit(mi.dc_motor(), noisy)
    assert adequacy(fit).channels["theta"]["rounded"] == 0.0
    assert adequacy(fit).adequate
    assert not adequacy(fit, [small]).adequate


def test_spikes_are_no_misfit_but_a_few_samples_in_a_row_are(rng):
    r = rng.normal(size=500)
    spiked, failing = r.copy(), r.copy()
    spiked[[20, 100, 300]] = 50.0
    failing[200:210] += 50.0
    assert np.std(despiked(spiked)) == pytest.approx(np.std(r), rel=0.05)
    assert np.array_equal(despiked(failing), failing)
    assert np.array_equal(despiked(r), r)


def test_outliers_are_left_out_and_what_is_not_is_said(lab, rng):
    runs = []
    for run in runs_of(lab, {"coulomb": {"tau_c": 8e-3}}):
        i = run.outputs["i"].copy()
        i[rng.choice(run.n, 12, replace=False)] += 60.0
        runs.append(run.with_(outputs={**run.outputs, "i": i}))
    fit = mi.fit(mi.dc_motor(), runs[:2])
    assert "24 outliers (single samples) make" in outliers_remark(fit)
    assert "--loss huber" in outliers_remark(fit)
    assert outliers_remark(mi.fit(mi.dc_motor(), runs[:2], loss=mi.Huber())) == ""  # it is used already
    found = mi.diagnose(fit, runs[2:], effects=("coulomb", "constant_load"))
    assert found.effects == ("coulomb",)
    assert "single samples stand far from both neighbours" in found.text
    assert "--no-spikes" in found.text
    alone = runs_of(lab, {})[0]
    alone = alone.with_(outputs={**alone.outputs, "i": alone.outputs["i"] + 400.0 * (np.arange(alone.n) == 500)})
    assert outliers_remark(mi.fit(mi.dc_motor(), alone)).startswith("1 outlier (single samples) makes")


def test_two_wrong_samples_in_a_row_are_left_out_first_and_no_friction_is_made_of_them(rng):
    """After the only step of a record in coarse counts: they made the winding ring, and "a friction … of the heat"."""
    t, v = 2e-2 * np.arange(300), np.where(np.arange(300) < 100, 0.0, 9.0)
    speed = 1.25 * scipy.signal.lfilter([0, 1 - np.exp(-1 / 3)], [1, -np.exp(-1 / 3)], v)
    speed = 0.73 * np.round((speed + (v > 0) * rng.normal(0, 0.25, 300)) / 0.73)
    speed[101:103] = 16.0, 16.73
    run = Experiment(t, {"v": v}, {"omega": speed})
    found = mi.diagnose(mi.fit(mi.dc_motor(), run), effects=("coulomb", "winding_heating", "speed_lag"))
    assert "2 samples, some of them in a row, stand far" in found.text
    assert "heat" not in found.answer
    assert found.before.determined["time_constant"].value == pytest.approx(0.06, rel=0.2)
    assert found.before.nrmse["omega"] < 0.04


def test_an_angle_that_follows_a_smooth_drive_is_no_closed_loop(lab, plant):
    rng = np.random.default_rng(2)
    smooth = record(driven(lab, {}, "multisine", 900, 1e-3, rng), "logger", ("theta",), lab, rng, "smooth")
    assert closed_loop_remark(mi.fit(mi.dc_motor(), smooth)) == ""
    t = np.arange(1400) / 45
    sweep = mi.Experiment(t, {"v": 2 * np.sin(2 * np.pi * (0.1 * t + 0.08 * t**2))}, {"theta": t})
    motor = mi.dc_motor(R=1.0, L=1e-3, K=0.05, b=1e-4, J=1e-4)
    counts = np.round(mi.simulate(motor, sweep, initial="rest")[0].outputs["theta"] / 0.01) * 0.01
    assert _noise_feedback(sweep.inputs["v"], counts) == 0
    wheel = plant.MOTORS["wheel"]
    looped = record(driven(wheel, {}, "loop", 900, 2e-3, rng), "logger", ("i", "omega"), wheel, rng, "loop")
    assert "closed loop" in closed_loop_remark(mi.fit(mi.dc_motor(), looped))
    for volts, said in ((np.full(smooth.n, 3.3), False), (np.sin(9 * smooth.t), True)):
        told = smooth.with_(meta={**smooth.meta, "extra": {"adc_vref": volts}})
        assert ("closed loop" in closed_loop_remark(mi.fit(mi.dc_motor(), told))) is said  # a sensor's own stands still


def test_samples_that_stand_out_at_one_angle_of_a_turn_are_no_accident(rng):
    runs = pair(rng, 1500, channels=("i", "omega", "theta"))
    for gathered in (True, False):
        dipped = []
        for run in runs:
            turn = run.outputs["theta"] % (2 * np.pi)
            lacking = (np.diff(turn > 2.0, prepend=False) > 0) & (np.arange(run.n) > 100)  # one sample a turn
            if not gathered:
                lacking = rng.permutation(lacking)
            assert 10 < lacking.sum() < 0.05 * run.n
            dipped.append(run.with_(outputs={**run.outputs, "omega": run.outputs["omega"] * np.where(lacking, 0.5, 1)}))
        fit = mi.fit(mi.dc_motor(), dipped)
        assert (without_spikes(fit) is None) == gathered
        assert ("They gather at angles of a turn" in outliers_remark(fit)) == gathered
