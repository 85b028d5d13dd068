"""The blind batteries: what they cover, that their plant is right by other means, how they are judged, a few run."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from battery.blind import first, fourth, fourth_plant, second, third, third_plant
from battery.blind.build import build, plain_sim
from battery.blind.judge import judge, mark, summary
from battery.blind.plant import MOTORS, TORQUE, Late, motor, run
from battery.blind.plant import build as law

from motorid.effects import EVERY, LIBRARY

RUN = Path(__file__).parents[1] / "battery" / "blind" / "run.py"


LATER = {"current_average", "driver_voltage_limit", "driver_lag", "speed_filter", "driver_slew", "pwm_coast",
         "pwm_fast_decay", "slip_clutch", "freewheel", "end_stop", "speed_ripple", "driver_one_quadrant",
         "angle_lag", "compliance_load_side"}  # than these


def of(battery, kind):
    return [c for c in battery.values() if c.kind == kind]


def test_the_batteries_cover_what_they_promise():
    assert len(first.B) == 120
    assert len(second.B) >= 100
    assert {t for c in of(second.B, "single") for t in c.truth} >= set(LIBRARY) - LATER
    assert all(len(of(second.B, k)) >= 20 for k in ("single", "pair", "none", "outside"))
    assert {t for c in of(third.B, "single") for t in c.truth} >= set(LIBRARY) - LATER
    acting = {e for c in third.B.values() for e in c.effects}
    assert acting == {*third_plant.LAW, *third_plant.SENSORS}
    assert {t for c in of(fourth.B, "single") for t in c.truth} >= set(LIBRARY) - LATER
    assert {e for c in fourth.B.values() for e in c.effects} == {*fourth_plant.LAW, *fourth_plant.SENSORS}
    assert all(len(of(fourth.B, k)) >= 20 for k in ("single", "pair", "none", "outside"))
    for case in (*first.B.values(), *second.B.values(), *third.B.values(), *fourth.B.values()):
        named = {*case.acceptable, *(n for w in case.whole for n in w)}
        assert named <= set(EVERY), case.name
        assert case.kind in ("none", "outside") or set(case.truth) <= set(EVERY), case.name
        assert case.kind != "outside" or not set(case.effects) & set(EVERY), case.name


def test_records_are_the_same_every_time():
    case = second.B["p_loadfric_speedlag"]
    one, again = build(case), build(case)
    for r, s in zip(one["train"] + one["check"], again["train"] + again["check"], strict=True):
        assert all(np.array_equal(r["outputs"][c], s["outputs"][c], equal_nan=True) for c in case.channels)
    assert all(0 < f < 0.05 for f in one["floor"].values())


@pytest.mark.parametrize(("name", "hold", "kind"), [("pump", "zoh", "steps"), ("joint", "linear", "climb")])
def test_the_plant_without_effects_is_the_exact_solution(name, hold, kind):
    m = motor(name, np.random.default_rng(1))
    options = {"dt": m["dt"], "T": 0.5 * m["T"], "hold": hold}
    t, v, y, *_ = run(m, {}, kind, np.random.default_rng(2), options)
    exact = plain_sim(m, name in TORQUE, t, v, (0, 0, 0), hold)
    for j, c in ((1, "omega"), (2, "theta")):
        assert np.abs(exact[:, j] - y[c]).max() < 1e-5 * np.std(y[c])


@pytest.mark.parametrize(("plant", "name", "within"), [
    (third_plant, "can", 1e-5), (third_plant, "crane", 1e-5), (third_plant, "slide", 1e-5),
    (third_plant, "table", 1e-5), (fourth_plant, "coreless16", 1e-4), (fourth_plant, "industrial", 1e-4),
    (fourth_plant, "gimbal", 1e-4)])
def test_a_later_plant_without_effects_is_the_exact_solution(plant, name, within):
    m = plant.motor(name, np.random.default_rng(1))
    options = {"dt": m["dt"], "T": 0.5 * m["T"]}
    kind = "steps" if plant is third_plant else "levels"
    t, v, y, *_ = plant.run(m, {}, kind, np.random.default_rng(2), options)
    exact = plain_sim(m, m["torque"], t, v, (0, 0, 0), "zoh")
    for j, c in ((1, "omega"), (2, "theta")):
        assert np.abs(exact[:, j] - y[c]).max() < within * np.std(y[c])


@pytest.mark.parametrize(("plant", "name", "within"), [(third_plant, "pivot", 1e-9), (fourth_plant, "gimbal", 1e-4)])
def test_a_later_plant_comes_to_rest_as_dry_friction_has_it(plant, name, within):
    m = plant.motor(name, np.random.default_rng(1))
    push = np.where(np.arange(2000) < 400, m["V"], 0.0)
    options = {"dt": m["dt"], "T": 2.0}
    t, _, y, *_ = plant.run(m, {"coulomb": 0.1}, "", np.random.default_rng(2), options, given=push)
    tau, dry = m["J"] / m["b"], 0.1 * m["ts"] / m["b"]
    rise = (m["V"] / m["b"] - dry) * (1 - np.exp(-np.minimum(t, 0.4) / tau))
    fall = np.exp(-np.maximum(t - 0.4, 0) / tau)
    assert np.allclose(y["omega"], np.maximum((rise + dry) * fall - dry, 0), atol=within * m["ws"])
    assert y["omega"][-1] == 0


def settle(m, effects, v, seconds=1.0):
    step, states, x = law(m, effects)
    return dict(zip(states, step(x, 0.0, seconds, v, v, round(seconds / m["h"])), strict=False))


def test_the_plant_has_its_effects_in_hard_form():
    m = motor("pump", np.random.default_rng(1))
    R, K, b, V, stall = m["R"], m["K"], m["b"], m["V"], m["ts"]
    assert settle(m, {"coulomb": 0.05}, 0.049 * V)["w"] == 0  # it sticks, exactly
    end = settle(m, {"coulomb": 0.05}, V)
    assert end["w"] == pytest.approx((K * V / R - 0.05 * stall) / (b + K**2 / R), rel=1e-6)
    end = settle(m, {"supply_sag": 0.3}, 0.5 * V)
    assert end["w"] * K == pytest.approx(0.5 * V - (R + 0.3 * R * 0.5**2) * end["i"], rel=1e-6)
    end = settle(m, {"spring": (0.05, 0.2)}, 0.5 * V, 20.0)
    assert end["th"] == pytest.approx(0.2 + 0.5 / 0.05, rel=1e-6)
    assert abs(settle(m, {"driver_current_limit": 0.3}, V, 0.01)["i"]) == pytest.approx(0.3 * m["is"])
    step, states, x = law(m, {"driver_coast": 1.05})
    turning = step(x, 0.0, 0.5, V, V, 5000)
    assert dict(zip(states, step(turning, 0.5, 0.01, 0.0, 0.0, 100), strict=False))["i"] == 0  # the diodes end it


def test_a_late_voltage_acts_when_it_should():
    late = Late(0.01, 10.0, 1e-4)
    acts = [part for k in range(30) for part in late.tick(k * 1e-3, 1e-3, 5.0)]
    first_at = next(start for start, _, value in acts if value == 5.0)
    assert first_at == pytest.approx(0.005)
    assert sum(length for _, length, _ in acts) == pytest.approx(0.03)


def answer(kind, truth, named, grades=None, groups=(), acceptable=(), whole=(), after=0.01):
    return {"name": "x", "kind": kind, "truth": truth, "acceptable": list(acceptable), "alternatives": {},
            "whole": whole, "floor": {"i": 0.01}, "verdict": "missing" if named else "adequate", "effects": named,
            "order": named, "grades": grades or dict.fromkeys(named, "named"), "groups": list(groups),
            "held_before": {"i": 0.1}, "held_after": {"i": after}, "cpu": 1.0}


@pytest.mark.parametrize(("result", "word"), [
    (answer("single", ["coulomb"], ["coulomb"]), "right"),
    (answer("single", ["coulomb"], ["coulomb", "cogging"]), "whole"),
    (answer("single", ["coulomb"], ["cogging"]), "WRONG"),
    (answer("single", ["coulomb"], []), "WRONG"),
    (answer("single", ["coulomb"], ["brush_drop"], groups=[["brush_drop", "coulomb"]]), "right"),
    (answer("pair", ["coulomb", "cogging"], ["coulomb"]), "first"),
    (answer("pair", ["coulomb", "constant_load"], ["coulomb_asymmetric"], whole=[["coulomb_asymmetric"]]), "right"),
    (answer("none", [], []), "fine"),
    (answer("none", [], ["coulomb"]), "ALARM"),
    (answer("outside", ["a cam"], ["gravity"]), "FORCED"),
    (answer("outside", ["a cam"], ["gravity"], {"gravity": "approximates"}), "approximate"),
    (answer("outside", ["a cam"], ["gravity"], acceptable=["gravity"]), "fine"),
    ({"name": "x", "kind": "none", "truth": [], "error": "died"}, "FAILED"),
])
def test_the_judge_keeps_to_the_rules(result, word):
    assert mark(judge(result)) == word


def test_what_failed_counts_as_wrong_and_the_floor_is_that_of_the_true_model():
    lines = summary([answer("outside", ["a cam"], [], after=0.0114), answer("outside", ["a cam"], [], after=0.0116),
                     {"name": "x", "kind": "outside", "truth": [], "error": "died"}])
    assert "without the remainder" in lines
    assert lines.splitlines()[-2].endswith("1/3 (33.3 %)")


def test_a_part_of_the_battery_runs(tmp_path):
    words = [sys.executable, str(RUN), "first", "--out", str(tmp_path), "--cases", "s_drag_lab,n_clean_lab"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    results = {n: json.loads((tmp_path / f"{n}.json").read_text()) for n in ("s_drag_lab", "n_clean_lab")}
    assert not any("error" in r for r in results.values()), results
    assert mark(judge(results["s_drag_lab"])) == "right"
    assert mark(judge(results["n_clean_lab"])) == "fine"


def test_every_motor_is_used():
    used = {c.motor for c in (*first.B.values(), *second.B.values())}
    assert used == set(MOTORS)
    assert {c.motor for c in third.B.values()} == set(third_plant.MOTORS)
    assert {c.motor for c in fourth.B.values()} == set(fourth_plant.MOTORS)
