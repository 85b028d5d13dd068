"""What the library lacks must not be forced into it: the verdict says where it acts and what it is like."""

from __future__ import annotations

import json
import re
import runpy
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from battery.excite import driven, record

import motorid as mi
from motorid.channels import channel_name
from motorid.diagnosis.free_forms import Form, Span, linearised, signals_along
from motorid.diagnosis.model_comparison import far
from motorid.diagnosis.remainder import Curve, Part
from motorid.display.numbers import arrow
from motorid.numerics.parallel import one_thread
from motorid.records.experiment import Experiment, part_meta

ANGLE = ("i", "omega", "theta")
FRICTION = ("coulomb", "coulomb_asymmetric", "constant_load", "quadratic_drag")
SLOW = ("stairs 0.5", "ramps 0.6", "steps 0.5")


def runs_of(motor, effects, drives=SLOW, channels=ANGLE, n=800, seed=4, chain="logger") -> list[Experiment]:
    rng = np.random.default_rng(seed)
    return [
        record(driven(motor, effects, words, n, 1e-3, rng), chain, channels, motor, rng, f"run{k + 1}")
        for k, words in enumerate(drives)
    ]


def diagnosed(runs, effects=FRICTION, validated=True):
    fit = mi.fit(mi.dc_motor(), runs[:-1] if validated else runs)
    return mi.diagnose(fit, runs[-1:] if validated else None, effects=effects)


def is_like(found, form, where="mechanical"):
    """The verdict where something acts like `form`: what helps stays in the ladder, and nothing is named after it."""
    assert (found.verdict, found.effects, found.groups) == ("unexplained", (), ())
    assert (found.where, found.missing.where) == (where, where)
    assert found.missing.acts_like.startswith(form)
    assert f"acts like {form}" in found.text
    assert (found.remainder.kind, found.remainder.where) == ("structure", where)
    assert found.remainder.follows.startswith(form)
    assert not found.adequacy.adequate
    assert not found.remaining.adequate
    approximates(found)


def approximates(found):
    """Every rung beyond the first helps, and says why it is not the thing itself."""
    rungs = found.ladder.rungs
    assert [r.added for r in rungs if r.grade] == [r.added for r in rungs[1:]]
    for before, rung in pairwise(rungs):
        assert rung.grade == "approximates"
        assert ("which the library lacks, predicts better in its place" in rung.why
                or "of the squared error, and the rest is not noise" in rung.why)
        short = "a free curve predicts better"
        why = re.sub("^.*, which the library lacks, predicts better in its place", short, rung.why)
        said = rf"'{rung.added}'[^:]* but only approximates? it: {re.escape(why)}"
        assert re.search(said, found.text)  # those with one reason share a sentence
        falls(before, rung, found.text)
    if len(rungs) == 1:
        assert "none of the effects asked for" in found.text


def falls(before, rung, text):
    """The rung predicts better, surely; where a printed error rises, the text says so, and what decided.

    Rises below what matters are told together.
    """
    assert rung.gain > 2 * rung.gain_se > 0
    small = re.search(r"Other rises are below 1 % of the error: ([\w, ]+)\.", text)
    for was, now in ((before.nrmse, rung.nrmse), (before.validation_nrmse, rung.validation_nrmse)):
        ratios = {c: now[c] / e for c, e in was.items()} if was else {}
        for c, ratio in ratios.items():
            told = f"{channel_name(c)} rises {arrow(was[c], now[c])}" in text
            assert ratio <= 1 or told or (ratio <= 1.01 and small and channel_name(c) in small[1])
        decided = "blocks left out of the fitted runs decided" in text
        assert np.prod(list(ratios.values())) < 1 or decided or not was


@pytest.fixture(scope="module")
def beyond(plant):
    """Effects made up here, put into the plant."""
    effects = plant.effects.BEYOND
    effects["ageing"] = lambda m, tau_c, rise: {"dry": lambda i, w, th, s, t: tau_c * (1 + rise * t)}
    effects["hard_spring"] = lambda m, k: {"torque": lambda i, w, th, t: -k * th * abs(th)}
    effects["dip"] = lambda m, s: {"drive": lambda v, w: v * (1 - s * abs(v) / (m.i_max * m.R / 2))}
    yield plant
    for name in ("ageing", "hard_spring", "dip"):
        effects.pop(name)


@pytest.mark.parametrize("validated", [True, False])
def test_friction_that_changes_along_a_turn_is_not_called_coulomb(lab, validated):
    found = diagnosed(runs_of(lab, {"angular_friction": {"tau_m": 8e-3, "a_f": 0.7}}), validated=validated)
    is_like(found, "a friction that changes with the angle")
    assert len(found.ladder.rungs) > 1  # something of the library helps


def test_friction_that_fades_is_not_called_coulomb(lab):
    grease = {"grease_warm_up": {"tau_c": 3e-3, "extra": 4.0, "t_g": 0.3}}
    found = diagnosed(runs_of(lab, grease, ("stairs", "ramps", "steps"), ("i", "omega")))
    is_like(found, "a friction that changes with the time")
    assert [r.added for r in found.ladder.rungs] == [None, "coulomb"]
    whole = json.loads(json.dumps(found.to_dict()))
    assert whole["location"]["acts_like"] == whole["remaining"]["follows"] == found.missing.acts_like
    assert (whole["effects"], whole["ladder"][1]["grade"]) == ([], "approximates")


def test_friction_that_grows_is_not_called_coulomb(beyond, lab):
    found = diagnosed(runs_of(lab, {"ageing": {"tau_c": 4e-3, "rise": 4.0}}, ("stairs", "ramps", "steps")))
    is_like(found, "a friction that changes with the time")


def test_a_spring_is_not_called_a_constant_load(beyond, lab):
    found = diagnosed(runs_of(lab, {"hard_spring": {"k": 3e-5}}), ("constant_load", "coulomb", "viscous_asymmetric"))
    is_like(found, "a load that changes with the angle")


def test_a_supply_that_dips_is_found_in_the_voltage(beyond, lab):
    effects = ("brush_drop", "quadratic_drag", "voltage_offset", "coulomb")
    found = diagnosed(runs_of(lab, {"dip": {"s": 0.25}}, ("stairs", "ramps", "steps"), ("i", "omega")), effects)
    is_like(found, "a loss of voltage that changes with the voltage", "electrical")


def test_a_cam_is_neither_called_cogging_nor_gravity(lab):
    found = diagnosed(runs_of(lab, {"cam": {"A": 2.5e-2}}), ("cogging", "gravity", "coulomb"))
    is_like(found, "a load that changes with the angle within a turn")
    assert {r.added for r in found.ladder.rungs} & {"cogging", "gravity"}


def test_what_is_needed_beside_it_is_kept_and_the_rest_is_said(lab):
    both = {"coulomb": {"tau_c": 1e-2}, "cam": {"A": 5e-3}}
    found = diagnosed(runs_of(lab, both), ("coulomb", "cogging", "constant_load"))
    assert (found.verdict, found.effects) == ("missing", ("coulomb",))
    assert found.after.values["tau_c"] == pytest.approx(1e-2, rel=0.1)
    assert [(r.grade, r.why) for r in found.ladder.rungs[1:]] == [("named", "")]
    falls(*found.ladder.rungs, found.text)
    assert "They follow a load that changes with the angle" in found.text
    assert not found.remaining.adequate


def of_different_motors(lab, name, factors) -> list[Experiment]:
    motors = [replace(lab, **{name: getattr(lab, name) * k}) for k in factors]
    drives = ("stairs 0.5", "ramps 0.6", "prbs 0.5", "steps 0.5")
    every = [runs_of(m, {}, (d,), seed=4 + k, n=400)[0] for k, (m, d) in enumerate(zip(motors, drives, strict=True))]
    return [run.with_(name=f"run{k + 1}") for k, run in enumerate(every)]


OTHER_CONSTANTS = (0.97, 1.0, 1.04, 1.0)


@pytest.mark.parametrize(
    ("name", "factors", "form", "where"),
    [
        ("R", (0.8, 1.0, 1.25, 0.9), "a resistance that differs from run to run", "electrical"),
        ("K", OTHER_CONSTANTS, "a motor constant that differs from run to run", "electrical"),
        ("J", (0.8, 1.0, 1.3, 1.0), "an inertia that differs from run to run", "mechanical"),
    ],
)
def test_a_motor_that_is_another_in_every_run_lacks_a_size_of_each(lab, name, factors, form, where, tmp_path):
    """Warm and cold, another supply, another load: no law fits the runs together. As an effect it has a size in every
    run, relative to the first, which a run held out estimates for itself."""
    runs = of_different_motors(lab, name, factors)
    found = diagnosed(runs, ("brush_drop", "coulomb", "load_friction"))
    is_like(found, form, where)
    left = found.remainder
    assert left.proposed
    better = mi.fit(left.model + left.as_effect(), runs[:-1])
    assert max(better.misfit.values()) < 1.1
    unit = {"R": 1 / lab.R, "K": -1 / lab.K, "J": factors[0]}[name]  # losses; of an inertia relative to the first run's
    sizes = [run["value"] * unit for run in better.per_run["remainder_0"].values()]
    assert sizes == pytest.approx([f - factors[0] for f in factors[1:-1]], abs=0.02)
    held_out, plain = (mi.evaluate(f, runs[-1]).nrmse for f in (better, found.before))
    assert all(e < 0.6 * plain[c] for c, e in held_out.items())
    assert len(np.unique(left.curve[1])) == len(runs) - 1
    (tmp_path / "own.py").write_text(left.code("own"))
    again = runpy.run_path(str(tmp_path / "own.py"))["own"]
    assert mi.fit(left.model + again, runs[:-1]).misfit == pytest.approx(better.misfit, rel=1e-3)


def test_parts_of_one_record_are_one_motor(lab):
    """A size of each record: what parts of one show differs with the time, not from run to run."""
    whole = of_different_motors(lab, "J", (0.8, 1.3, 1.0, 1.0))[:2]
    cuts = ((run, run.select(cut)) for run in whole for cut in (slice(0, 200), slice(200, None)))
    parts = [part.with_(meta=part_meta(run, part)) for run, part in cuts]
    both, one = (mi.fit(mi.dc_motor(), runs) for runs in (parts, parts[:2]))
    assert [s["run"][0] for s in signals_along(both)] == [0, 0, 1, 1]
    asked = {form.on for form in linearised(both).forms}
    assert "run" in asked
    assert "run" not in {form.on for form in linearised(one).forms}
    inertia = Form("an inertia", "torque", "run", "acceleration")
    grown = Curve(both, (Part.of(both, inertia, True),)).grown()
    assert list(grown.fitted.initial)[-1] == "remainder_0[2]"  # of the second record, whose first part is the third
    assert np.unique(grown.points[1]).tolist() == pytest.approx([0.0, 1.3 / 0.8 - 1], abs=0.03)


@pytest.mark.parametrize(("axis", "unit"), [("rotary", "N·m·s/rad"), ("linear", "N·s/m")])
def test_a_drag_that_is_another_in_every_run_is_in_the_units_of_its_axis(axis, unit):
    drag = Part(Form("a drag", "torque", "run", "omega"), Span({"run": (0.0, 1.0)}, (), 1e-3))
    assert drag.unit(SimpleNamespace(model=SimpleNamespace(axis=axis))) == unit


def test_a_resistance_that_is_another_in_every_run_is_in_ohms():
    motor = SimpleNamespace(model=SimpleNamespace(axis="rotary"))
    winding, constant = Form("a resistance", "voltage", "run", "i"), Form("a motor constant", "both", "run")
    parts = (Part(form, Span({"run": (0.0, 1.0)}, (), 1e-3)) for form in (winding, constant))
    assert [part.unit(motor) for part in parts] == ["Ω", "N·m/A"]


def test_improve_grades_its_rungs_too(lab):
    runs = runs_of(lab, {"angular_friction": {"tau_m": 8e-3, "a_f": 0.7}})
    ladder = mi.improve(mi.fit(mi.dc_motor(), runs[:-1]), runs[-1:], effects=FRICTION)
    assert [r.grade for r in ladder.rungs[1:]] == ["approximates"]
    assert "which the library lacks, predicts better in its place" in ladder.rungs[1].why
    assert ladder.best is ladder.rungs[1].fit  # what helps is not thrown away


@pytest.mark.parametrize("chain", ["logger", "coloured", "coarse"])
def test_true_friction_is_kept(lab, chain):
    found = diagnosed(runs_of(lab, {"coulomb": {"tau_c": 8e-3}}, chain=chain))
    assert found.effects == ("coulomb",)
    assert found.ladder.rungs[1].grade == "named"
    assert found.missing.acts_like == ""


def test_true_friction_is_kept_although_more_than_noise_is_left(lab):
    """A little of the cam remains, many times the noise of the angle, but it is a trifle beside the friction."""
    runs = runs_of(lab, {"coulomb": {"tau_c": 1e-2}, "cam": {"A": 2e-3}})
    found = diagnosed(runs)
    assert far(found.best)
    assert found.effects == ("coulomb",)
    assert found.ladder.rungs[1].grade == "named"
    assert not found.remaining.adequate
    assert found.remainder.follows.startswith("a load that changes with the angle")


@one_thread
def test_a_form_answers_as_the_plant_does(lab):
    """The columns of a load over a turn hold what a small torque does to the outputs."""
    runs = runs_of(lab, {}, n=500)
    plain = mi.fit(mi.dc_motor(), runs)
    with_it = plain.model + mi.effects.gravity(mgl=2e-5, phi_g=0.0)
    linear = linearised(plain)
    shifts = []
    both = mi.simulate(plain.model, runs), mi.simulate(with_it, runs)
    for s, t, run in zip(*both, plain.problem.runs, strict=True):
        shifts.append(np.column_stack([(t.outputs[c] - s.outputs[c]) / run.sigma[c] for c in ANGLE]).ravel())
    factors = [plain.problem.noise_factors.get(c, 1.0) for c in ANGLE]
    change = np.concatenate(shifts) / np.tile(factors, sum(r.n for r in runs))
    form = next(f for f in linear.forms if (f.on, f.carrier) == ("turn", ""))
    columns = np.concatenate([linear.answer(form), linear.own], axis=1)
    left = change - columns @ np.linalg.lstsq(columns, change, rcond=None)[0]
    assert np.linalg.norm(left) < 0.02 * np.linalg.norm(change)


@pytest.mark.slow
def test_where_the_errors_are_too_large_to_be_linear_the_form_is_fitted(plant):
    """A belt whose splice all but stops the wheel: the plain model is off by half of the current."""
    splice = {"belt_splice": {"tau": 0.15, "width": 3.0, "ratio": 2.7}}
    wheel, rng = plant.MOTORS["wheel"], np.random.default_rng(8)
    runs = [record(driven(wheel, splice, w, 1000, 2e-3, rng), "logger", ANGLE, wheel, rng, w) for w in SLOW]
    found = diagnosed(runs, ("coulomb", "coulomb_asymmetric", "constant_load"))
    is_like(found, "a friction that changes with the angle")


@one_thread
def test_a_sensor_is_blamed_only_where_another_contradicts_it(lab):
    """With an angle and nothing else, any error of the model would be one of the sensor."""
    both, alone = (mi.fit(mi.dc_motor(), runs_of(lab, {}, channels=c)) for c in (("i", "theta"), ("theta",)))
    balances = [{f.balance for f in linearised(fit).forms} for fit in (both, alone)]
    assert "sensor" in balances[0]
    assert "sensor" not in balances[1]


def test_eddy_currents_in_the_iron_are_no_voltage_that_acts_before_it_was_logged(rng):
    @mi.effect(balance="voltage")
    def shunted(m, R_2=mi.P(2.3, "ohm", given=True), T_2=mi.P(1e-3, "s", given=True)):
        """A part of the inductance is shunted by a resistance, as eddy currents in solid iron do."""
        i_2 = m.state("i_2", 0.0)
        m.rate(i_2, (m.i - i_2) / T_2)
        m.voltage -= R_2 * (m.i - i_2)

    motor, t = mi.dc_motor(R=1.03, L=1.7e-3, K=0.041, b=1e-4, J=1.1e-4) + shunted, np.arange(1500) * 2e-4
    chirp, noise = 12 * np.sin(2 * np.pi * (20 * t + 1200 * t**2)), {"i": 0.02, "omega": 0.15}
    runs = []
    for v in (np.repeat(rng.choice([-12.0, 12.0], 188), 8)[:1500], chirp, np.repeat(rng.choice([-12.0, 12.0], 300), 5)):
        still = mi.Experiment(t, {"v": v}, {c: np.zeros_like(t) for c in noise})
        shown = mi.simulate(motor, still, initial="rest")[0].outputs
        runs.append(still.with_(outputs={c: shown[c] + rng.normal(0, s, 1500) for c, s in noise.items()}))
    rivals = ["inductance_saturation", "speed_lag", "current_lag", "brush_drop"]
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs[:2]), runs[2], effects=rivals)
    assert found.verdict == "unexplained"
    assert "earlier" not in found.text
    assert "a loss of voltage that depends on the current before" in found.remainder.as_effect().doc
    assert max(found.remainder.fitted.misfit.values()) < 1.1
