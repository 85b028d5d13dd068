"""A fit says first whether it fits, and gives one standard deviation wherever it is asked."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from command import motorid, motorid_json

import motorid as mi
from motorid import plots
from motorid.display.numbers import with_error
from motorid.estimation.covariance import Certainty, certainty
from motorid.records.datasets import data_path, truth

FRICTION = data_path("hidden_friction")


@pytest.fixture(scope="module")
def runs():
    return mi.read_runs(FRICTION / "run*.csv")


@pytest.fixture(scope="module")
def plain(runs):
    return mi.fit(mi.dc_motor(), runs)


def test_the_same_fit_asked_in_six_ways_gives_one_standard_deviation(plain, tmp_path):
    """Asked of b, whose deviation taken as white noise is ten times too small here."""
    told = plain.std["b"]
    shown = with_error(plain.values["b"], told, "N·m·s/rad")
    assert told > 3 * plain.certainty("white").std[3]
    # 1 and 2: the command line and its JSON
    found = motorid_json(tmp_path, "fit", FRICTION / "run*.csv")
    assert found["parameters"]["b"]["std"] == pytest.approx(told, rel=1e-3)
    assert shown in motorid("fit", FRICTION / "run*.csv").out
    # 3: the card, 4: the report
    assert shown in plain.card().to_html()
    page = mi.report(plain, tmp_path / "fit.html").read_text(encoding="utf-8")
    assert shown in page.replace("\N{NO-BREAK SPACE}", " ")
    # 5: the covariance, and what the records can tell
    assert mi.covariance(plain).std["b"] == pytest.approx(told)
    assert np.sqrt(plain.covariance[3, 3]) == pytest.approx(told)
    assert mi.identifiability(plain).to_dict()["std"]["b"] == pytest.approx(told)
    # 6: the figure
    (low, high) = plots.plot_parameters(plain, names=["b"])[0].collections[0].get_segments()[0]
    assert (high[1] - low[1]) / 4 == pytest.approx(told * 1e6, rel=1e-6)
    # and fits side by side
    assert mi.compare([plain]).parameters["b"] == ((plain.values["b"], told),)
    assert shown in mi.compare([plain]).card().to_html()
    assert "same records" not in mi.compare([plain, plain]).card().to_html()
    other = mi.fit(mi.dc_motor(), plain.problem.experiments[:1])
    assert "Not all were fitted to the same records" in mi.compare([plain, other]).card().to_html()


def test_a_fit_that_misses_a_quarter_of_the_current_says_so_first(plain, tmp_path):
    assert plain.status == "converged"
    assert plain.fits == "poor"
    assert plain.verdict.startswith("Fits poorly: errors up to 16 times the noise")
    assert motorid("fit", FRICTION / "run*.csv").out.startswith(plain.verdict[:40])
    found = motorid_json(tmp_path, "fit", FRICTION / "run*.csv")
    assert (found["fits"], found["verdict"]) == ("poor", plain.verdict)
    card = plain.card()
    assert (card.flags[0].text, card.flags[0].mood) == ("fits poorly", "bad")
    assert not [f for f in card.flags if f.mood == "good"]
    assert card.text[0] == plain.verdict
    assert "fits poorly" in repr(plain)


def test_coloured_noise_is_no_poor_fit_and_the_missing_effect_makes_it_good(runs):
    """Errors beyond the noise from fast changes are given as what they are, with the question that is left."""
    clean = mi.fit(mi.dc_motor(), mi.read_runs(data_path("clean") / "run*.csv"))
    assert max(clean.misfit.values()) > 2
    better = mi.fit(mi.dc_motor() + mi.effects.coulomb, runs)
    assert clean.fits == better.fits == "noise"
    assert clean.verdict.startswith("Fits: errors up to 2.5 times the noise, which correlated noise can explain")
    assert better.verdict.startswith("Fits: errors at the level of the noise")
    assert "which correlated noise can explain; whether it does, a diagnosis tells (NRMSE" in clean.verdict
    assert "diagnosis" not in better.verdict


def test_errors_as_small_as_the_noise_are_no_fit_before_an_optimum(runs):
    """A fit that had stalled said "Fits …" and, a sentence later, that its values are none of an optimum."""
    fit = replace(mi.fit(mi.dc_motor() + mi.effects.coulomb, runs), status="stalled")
    assert fit.fits == "noise"
    assert fit.verdict.startswith("Errors at the level of the noise (NRMSE")
    assert "Not converged (stalled)" in fit.verdict
    assert [f.mood for f in fit.card().flags[:2]] == ["note", "bad"]
    assert "fits" not in repr(fit)


def test_a_channel_that_is_not_followed_at_all_is_lost(runs):
    turned = [r.with_(inputs={"v": -r.inputs["v"]}) for r in runs]
    fit = mi.fit(mi.dc_motor().fix(R=1.38, L=1.7e-3, K=0.0462, b=6.5e-5), turned)
    assert fit.fits == "lost"
    assert fit.verdict.startswith("Does not fit")


def still(run, angle=0.0):
    """The same voltage on a shaft that is held fast, its encoder anywhere."""
    return run.with_(outputs={"omega": 0 * run.t, "theta": angle + 1e-15 * np.sin(run.t)}, sigma={}, name="fast")


def test_a_motor_that_never_moves_determines_nothing(runs):
    """A speed of zero under half a volt "fits", and its export was advised."""
    fit = mi.fit(mi.dc_motor(), [still(r).without("theta") for r in runs])
    assert fit.verdict.startswith("Nothing is determined: ")
    assert fit.fits == "lost"
    assert repr(fit).endswith("NRMSE –>")


def test_an_error_over_a_motion_that_is_none_is_no_number_and_decides_nothing(runs):
    """A share of nothing was 7.64·10¹⁵⁰ %."""
    moved = [r.with_(outputs={"omega": r.outputs["omega"]}) for r in runs]
    fast = still(moved[0], 0.1)
    fit = mi.fit(mi.dc_motor(), moved)
    both = mi.evaluate(fit, [moved[1], fast.without("theta")])
    assert both.by_run[0]["omega"] < 1
    assert np.isnan(both.by_run[1]["omega"])
    assert "10¹" not in str(both.card())
    there = mi.evaluate(fit, fast)
    assert np.isnan([*there.nrmse.values(), *there.by_run[0].values()]).all()
    assert repr(there) == "<evaluation of 1 runs: NRMSE >"
    assert {"omega", "theta"} == {*there.nrmse}
    # All that was measured beside the current stands still: the current alone says whether it fits.
    locked = [r.with_(outputs={"i": r.inputs["v"] / 1.5 * (1 + 1e-3 * np.sin(9 * r.t)), "omega": 0 * r.t})
              for r in runs]
    resting = mi.fit(mi.dc_motor().fix(L=0.0), locked[:1])
    assert resting.fits != "lost"
    assert "speed –" in resting.verdict
    found = mi.diagnose(resting, locked[1:], effects=["coulomb", "brush_drop"])
    assert "10¹" not in str(found.card())
    assert "nan" not in found.text


def test_what_is_determined_does_not_depend_on_where_a_fit_without_current_ends(runs):
    """Currents ten thousand times as large beside an R as much smaller are the same motor; first ones are voltages."""
    fit = mi.fit(mi.dc_motor(), [r.without("i") for r in runs], window=0.4)
    problem, unknown = fit.problem, [p.name for p in fit.problem.unknown]
    assert any(n.startswith("i_0[") for n in unknown)
    power = np.array([{"R": -1, "L": -1, "J": 1, "b": 1}.get(n[0], 0) for n in unknown])
    q = problem.scaling.scaled(problem.scaling.physical(fit.q) * 1e4**power)
    r, jac = problem.residual_and_jacobian(q)
    assert r == pytest.approx(fit.residuals, rel=1e-3, abs=1e-3)
    found = certainty(problem, q, r, jac / problem.scaling.slope(q))
    assert {n for n, std in zip(unknown, found.std, strict=True) if std is None} >= {"R", "L", "J", "b"}
    assert found.std[unknown.index("K")] == pytest.approx(fit.std["K"], rel=0.05) if fit.std["K"] else True


def test_a_motor_on_a_linear_axis_has_a_speed_in_metres(runs):
    cart = [r.without("i").with_(outputs={"omega": 0.03 * r.outputs["omega"]}, units={"omega": "m/s"}) for r in runs]
    known = mi.fit(mi.dc_motor(), cart).determined
    assert known["gain"].unit == "m/s per V"


def test_a_motor_on_a_linear_axis_has_a_mass_and_forces_wherever_it_is_shown(runs, tmp_path):
    """Tables said N·m/A and kg·m² of a cart, and a remark that N/A and kg were meant."""
    cart = [r.with_(outputs={"i": r.outputs["i"], "omega": 0.03 * r.outputs["omega"]}, sigma={},
                    units={"omega": "m/s"}) for r in runs]
    fit = mi.fit(mi.dc_motor(), cart)
    units = {"R": "Ω", "L": "H", "K": "N/A", "b": "N·s/m", "J": "kg"}
    assert {n: p.unit for n, p in fit.model.parameters.items()} == units
    assert (fit.model.parameters["J"].doc, fit.model.axis) == ("moving mass", "linear")
    turning = mi.fit(mi.dc_motor(), runs)
    assert fit.values["J"] == pytest.approx(turning.values["J"] / 0.03**2, rel=1e-3)
    found = mi.diagnose(fit, effects=("coulomb", "speed_offset"))
    assert found.effects == ("coulomb",)
    assert re.search(r"tau_c = [\d.]+ ± [\d.]+ N[;,.]", found.answer), found.answer
    page = mi.report(found, tmp_path / "cart.html").read_text(encoding="utf-8")
    assert not re.search(r"N·m(?!/)|kg·m²|V·s/rad", page + str(found.card()) + str(fit.card()))
    saved = json.loads(fit.save(tmp_path / "cart.json").read_text(encoding="utf-8"))
    assert {n: p["unit"] for n, p in saved["parameters"].items()} == units
    assert mi.load(tmp_path / "cart.json").values == pytest.approx(fit.values)
    assert {n: p.unit for n, p in mi.load(tmp_path / "cart.json").model.parameters.items()} == units
    mi.export(fit, tmp_path / "motor.json")


def test_voltage_and_speed_alone_determine_gain_times_and_friction_in_volts(runs):
    """They are the plant's, within what they claim, though no single parameter is determined."""
    fit = mi.fit(mi.dc_motor() + mi.effects.coulomb, [r.without("i") for r in runs])
    assert fit.std["R"] is None
    hidden = truth("hidden_friction")
    p, tau_c = hidden["parameters"], hidden["effects"]["coulomb"]["tau_c"]
    stiff = p["K"] ** 2 + p["R"] * p["b"]
    true = {"gain": p["K"] / stiff, "tau_c_voltage": p["R"] * tau_c / p["K"],
            "no_load_speed": p["K"] / stiff * (2 - p["R"] * tau_c / p["K"])}
    for name, value in true.items():
        known = fit.determined[name]
        assert known.value == pytest.approx(value, abs=4 * known.std), name
        assert known.std < 0.01 * value
    both = mi.fit(fit.model.without("coulomb"), runs)
    assert set(fit.determined) >= {"time_constant", "damping"} <= set(both.determined)
    assert json.dumps([d.value for d in fit.determined.values()])


def test_what_parameters_do_alike_is_determined_however_wide_each_may_be():
    """Two that trade off: the longer the way that nothing but a tiny slope along it limits, the more it would claim."""
    wide, narrow = np.array([1.0, -1.0]) / np.sqrt(2), np.array([1.0, 1.0]) / np.sqrt(2)
    unit, product = np.array([3.0, 0.2]), np.array([0.2, 3.0])  # of a·b, SI
    for width in (5.0, 50.0, 5e4):
        scaled = width**2 * np.outer(wide, wide) + 1e-4 * np.outer(narrow, narrow)
        known = Certainty(scaled * np.outer(unit, unit), ("not determined",) * 2, 100.0, {}, np.zeros((2, 0)), unit)
        assert known.std_of(product) == pytest.approx(0.6 * np.sqrt(2) * 0.01, rel=1e-3)
        tilted = known.std_of(product * [1.002, 0.998])
        assert tilted == pytest.approx(0.6 * np.sqrt(2) * np.hypot(0.01, 0.002 * min(width, 10)), rel=1e-3)
    tiny = np.array([1.0, 1e-200])  # whose square is nothing
    known = Certainty(1e-4 * np.outer(tiny, tiny), ("determined",) * 2, 100.0, {}, np.zeros((2, 0)), tiny)
    assert known.std_of(np.array([1.0, 0.0])) == pytest.approx(0.01, rel=0.1)


def test_a_value_whose_interval_reaches_zero_does_not_count_as_determined(runs):
    """Dry friction tells a little of K without the current, or without the speed: a factor of several each way."""
    model, hidden = mi.dc_motor() + mi.effects.coulomb, truth("hidden_friction")["parameters"]
    for left_out in ("i", "omega"):
        fit = mi.fit(model, [r.without(left_out) for r in runs])
        assert [fit.std[n] for n in ("K", "b", "J")] == [None] * 3, left_out
        assert all(d.std < 0.5 * abs(d.value) for d in fit.determined.values())
    assert fit.values["R"] == pytest.approx(hidden["R"], abs=4 * fit.std["R"])
    assert "gain" not in fit.determined


@pytest.mark.parametrize("apart", [4e-8, 7e-8, 9.65361e-8, 1.2e-7])
def test_two_columns_that_are_nearly_one_give_no_deviation_of_zero(plain, apart):
    """What rounding made of them once: a variance below zero, a deviation of 0, and both determined."""
    jac = plain.jacobian.copy()
    jac[:, 3] = 1e-3 * jac[:, 4] * (1 + apart * np.sin(np.arange(len(jac))))
    known = certainty(plain.problem, plain.q, plain.residuals, jac)
    assert known.status[3:5] == ("not determined",) * 2
    assert np.all(np.diag(known.matrix) > 0)


def test_a_slope_of_rounding_determines_nothing(plain):
    jac = plain.jacobian.copy()
    jac[:, 3] = 1e-16 * np.abs(jac[:, 4]).max() * np.random.default_rng(0).normal(size=len(jac))
    tiny = certainty(plain.problem, plain.q, 1e-15 * plain.residuals, jac)
    assert tiny.status[3] == "not determined"
    assert tiny.status[0] == "determined"


def test_errors_beside_which_the_noise_is_nothing_are_over_a_thousand_times_it():
    """An encoder of a million counts made errors of "17000 times the noise" of an ordinary misfit."""
    t = np.arange(0, 2, 1e-3)
    motor = mi.dc_motor(R=1.4, L=1e-3, K=0.05, b=1e-5, J=1e-4) + mi.effects.coulomb(tau_c=0.02)
    exact = mi.planned(motor, t, 4 * np.sin(4 * np.pi * t), channels=("theta",))
    counts = np.round(exact.outputs["theta"] * 1e6)
    fit = mi.fit(mi.dc_motor(), exact.with_(outputs={"theta": counts * 1e-6}, sigma={}))
    assert fit.verdict.startswith("Fits poorly: errors over 1000 times the noise (NRMSE angle")
    assert "angle over 1000 times the noise" in mi.diagnose(fit, max_effects=0).text
    assert fit.misfit["theta"] > 1000  # as a number it stays


def test_a_fit_of_what_is_mostly_noise_says_so(rng):
    """A speed of 66 rad/s, 65 of it noise, fits at the level of the noise, and nothing would show in it."""
    t = np.arange(600) * 0.01
    speed = 20 * (1 - np.exp(-t / 0.5))
    noisy, quiet = (mi.fit(mi.dc_motor(), mi.Experiment(t, {"v": np.where(t < 0.01, 0.0, 6.0)}, {
        "omega": speed + noise * rng.normal(size=600)})) for noise in (60.0, 2.0))
    assert noisy.verdict.startswith("Fits records that are mostly noise: errors at the level of the noise")
    assert quiet.verdict.startswith("Fits: errors at the level of the noise")
    assert replace(noisy, status="limit").verdict.startswith(
        "Fits records that are mostly noise: errors at the level of the noise (NRMSE")
    assert (noisy.mostly_noise, quiet.mostly_noise) == (True, False)
