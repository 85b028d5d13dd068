"""What a diagnosis leaves alone: what samples cannot show, what parameters do already, what has no limit in physics."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from battery.excite import driven, record
from lab_records import simulated

import motorid as mi
from motorid.diagnosis import admissibility, candidates, stepwise
from motorid.diagnosis import record_versions as parts
from motorid.diagnosis.admissibility import objections, samples_within, unresolved
from motorid.diagnosis.candidates import Search, Stages, library
from motorid.diagnosis.model_comparison import node_of
from motorid.diagnosis.predictive_score import QUICK, HeldOut
from motorid.diagnosis.score_test import score
from motorid.effects import LIBRARY
from motorid.errors import ModelError
from motorid.estimation.angle_orders import likely_lines, spectrum
from motorid.estimation.least_squares import RACE
from motorid.estimation.linearisation import Tangent
from motorid.numerics.autoregression import Whitening
from motorid.numerics.parallel import one_thread

ANGLE = ("i", "omega", "theta")


def runs_of(motor, effects, drives, channels=ANGLE, n=800, seed=5, dt=1e-3, chain="logger"):
    rng = np.random.default_rng(seed)
    return [
        record(driven(motor, effects, words, n, dt, rng), chain, channels, motor, rng, f"run{k + 1}")
        for k, words in enumerate(drives)
    ]


@pytest.fixture(scope="module")
def lab(plant):
    return plant.MOTORS["lab"]


@pytest.fixture(scope="module")
def rubbing(lab):
    return runs_of(lab, {"coulomb": {"tau_c": 8e-3}}, ("stairs 0.5", "waves"))


def searched(fit, effects=None):
    return Search(fit, None, library(effects), Stages())


# -- what samples cannot show ------------------------------------------------------------------------------


def test_samples_of_a_passage_are_counted_from_each_turning_point():
    there = np.linspace(0, 1, 101)
    angle = np.concatenate([there, there[::-1][1:]])
    assert samples_within(angle, 0.205) == [18, 18]  # from a tenth of the width on, after the start and after the turn


@pytest.mark.parametrize(("theta_s", "seen"), [(1e-5, False), (0.05, True)])
def test_bristles_finer_than_the_samples_are_refused(rubbing, theta_s, seen):
    fit = mi.fit(mi.dc_motor() + mi.effects.coulomb, rubbing)
    own = mi.effects.lugre(tau_c=8e-3, s_b=1.2, omega_s=5.0, theta_s=theta_s)
    problem = fit.problem.with_(model=fit.model.without("coulomb") + own)
    bristles = mi.solve(problem, solver=mi.LevenbergMarquardt(max_iterations=0), start="model")
    assert (unresolved(bristles, LIBRARY["lugre"]) == "") is seen


@pytest.mark.parametrize(("noise", "seen"), [(0.005, True), (0.3, False)])
def test_bristles_that_the_current_determines_may_be_finer_than_the_noise_of_the_angle(noise, seen):
    own = mi.effects.lugre(tau_c=8e-3, s_b=1.2, omega_s=3.0, theta_s=0.02)
    truth = mi.dc_motor(R=1.2, L=2e-3, K=0.055, b=1.5e-5, J=2.5e-4) + own
    t, rng = np.arange(2000) * 1e-3, np.random.default_rng(3)
    v = 3 * np.sin(2 * np.pi * 2 * t) * (1 + 0.3 * np.sin(2 * np.pi * 0.7 * t))
    shown = mi.simulate(truth, mi.Experiment(t, {"v": v}, {"i": v, "theta": v}), initial="rest")[0].outputs
    noises = {"i": noise, "theta": 0.02}  # the angle's as large as the bristles are long
    noisy = {c: y + noises[c] * rng.standard_normal(2000) for c, y in shown.items()}
    fit = mi.fit(truth, mi.Experiment(t, {"v": v}, noisy))
    assert (unresolved(fit, LIBRARY["lugre"]) == "") is seen


def test_a_friction_that_varies_twice_a_turn_is_one_that_varies_over_a_turn():
    t, rng = np.arange(3000) * 1e-3, np.random.default_rng(5)
    v = 4 * np.sin(2 * np.pi * 0.8 * t) + 2 * np.sin(2 * np.pi * 2.3 * t)
    own = mi.effects.angular_friction(tau_m=0.02, a_f=0.6, N_f=2.0, phi_f=1.0)
    truth = mi.dc_motor(R=1.2, L=2e-3, K=0.055, b=1.5e-5, J=1e-4) + own
    shown = mi.simulate(truth, mi.Experiment(t, {"v": v}, {"i": v, "omega": v, "theta": v}), initial="rest")[0].outputs
    noises = {"i": 0.02, "omega": 0.3, "theta": 0.01}
    run = mi.Experiment(t, {"v": v}, {c: y + noises[c] * rng.standard_normal(3000) for c, y in shown.items()})
    beside = mi.fit(mi.dc_motor() + mi.effects.coulomb, run)
    found = mi.improve(beside, effects=["angular_friction"]).best
    assert found.model.effect_names == ("angular_friction",)
    assert found.values["N_f"] == 2
    assert found.values["a_f"] == pytest.approx(0.6, abs=5 * found.std["a_f"])
    assert mi.fit(mi.dc_motor() + mi.effects.angular_friction, run).values["N_f"] == 2


def test_an_effect_that_replaces_nothing_may_be_as_quick_as_it_likes(rubbing):
    assert unresolved(mi.fit(mi.dc_motor() + mi.effects.coulomb, rubbing), LIBRARY["coulomb"]) == ""


# -- what parameters do already ----------------------------------------------------------------------------


def test_an_offset_beside_two_frictions_is_refused_and_said(lab):
    runs = runs_of(lab, {"coulomb": {"tau_c": 8e-3}, "constant_load": {"tau_0": 4e-3}}, ("stairs 0.5", "waves"))
    fit = mi.fit(mi.dc_motor() + mi.effects.coulomb_asymmetric, runs)
    offset = score(Tangent.of(fit), LIBRARY["constant_load"])
    assert set(offset.same_as) == {"tau_cp", "tau_cn"}
    assert offset.drop == 0
    search = searched(fit, ("constant_load", "brush_drop", "coulomb_asymmetric"))
    children, listed = search.expand(search.root)
    assert "constant_load" not in {c.added for c in children}
    why = next(c.reason for c in listed if c.effect == "constant_load")
    assert "do not distinguish" in why
    assert "tau_cp and tau_cn" in why


def test_an_offset_beside_one_friction_is_told(rubbing):
    fit = mi.fit(mi.dc_motor() + mi.effects.coulomb, rubbing)
    assert score(Tangent.of(fit), LIBRARY["constant_load"]).same_as == ()


def test_a_scale_of_the_speed_cannot_sharpen_a_friction_where_no_angle_tells_it(lab):
    """It scales K, b and J alone, and not the width of the smooth sgn: else friction as hard as real buys it."""
    runs = runs_of(lab, {"coulomb": {"tau_c": 8e-3}}, ("stairs", "steps"), channels=("i", "omega"))
    fit = mi.fit(mi.dc_motor() + mi.effects.coulomb, runs)
    found = score(Tangent.of(fit), LIBRARY["speed_gain"])
    assert found.drop == 0
    assert {"K", "tau_c"} <= set(found.same_as)
    with pytest.raises(ModelError, match="cannot be seen"):
        (mi.dc_motor() + mi.effects.coulomb + mi.effects.speed_gain).check_visible(("i", "theta"))


@pytest.mark.slow
@one_thread
def test_what_made_a_special_effect_special_may_be_taken_over(rubbing, monkeypatch):
    """Asymmetric friction on a motor that rubs alike both ways is Coulomb's, in the same place."""
    start = mi.fit(mi.dc_motor() + mi.effects.coulomb_asymmetric + mi.effects.constant_load, rubbing)
    search = searched(start)
    plain = node_of(mi.fit(mi.dc_motor(), rubbing), search.held)
    assert search.pruned(search.root, plain).fit.model.effect_names == ("coulomb",)
    # On a tie with the model before the smaller one stays. Losses that may each be chance add up over a chain of
    # prunings: never to surely less than the model before had.
    assert search.pruned(search.root, search.root).fit.model.effect_names == ("coulomb",)
    monkeypatch.setattr(candidates, "superfluous", lambda node, smaller: True)
    assert search.pruned(search.root, search.root).fit.model.effect_names == ("coulomb",)


@one_thread
def test_what_two_effects_imitate_together_takes_their_place(lab):
    """An offset of the voltage is one of the current's sensor and a constant torque: with friction that differs with
    the direction, three sizes do what two in truth did."""
    runs = runs_of(lab, {"coulomb": {"tau_c": 8e-3}, "voltage_offset": {"V_0": 0.3}}, ("stairs 0.5", "waves"))
    start = mi.fit(mi.dc_motor() + mi.effects.coulomb_asymmetric + mi.effects.current_offset, runs)
    search = searched(start)
    plain = node_of(mi.fit(mi.dc_motor(), runs), search.held)
    assert search.pruned(search.root, plain) is search.root
    assert search.exchanged(search.root, plain).key == {"coulomb", "voltage_offset"}
    other = mi.fit(mi.dc_motor() + mi.effects.coulomb + mi.effects.voltage_offset, runs)
    search = searched(other)
    assert search.exchanged(search.root, plain) is search.root


def test_a_friction_that_two_effects_contain_takes_the_place_of_neither():
    """As a model it would describe the same twice; a diagnosis goes on without it."""
    model = mi.dc_motor() + LIBRARY["coulomb_asymmetric"] + LIBRARY["angular_friction"]
    assert candidates._in_place(model, model.effects[0], LIBRARY["coulomb"]) is None
    alone = model.without("angular_friction")
    assert candidates._in_place(alone, alone.effects[0], LIBRARY["coulomb"]).effect_names == ("coulomb",)


@pytest.mark.parametrize(("ended", "efforts"), [("limit", [QUICK, RACE]), ("stalled", [QUICK])])
def test_what_is_on_its_way_after_a_quick_solve_goes_on(rubbing, monkeypatch, ended, efforts):
    """The current of a supply was found at 25 % of it, and gravity beside it for what the rest of the way takes."""
    search, tried = searched(mi.fit(mi.dc_motor(), rubbing)), []

    def solve(problem, effort, start):
        tried.append(effort)
        return replace(search.root.fit, status=ended)

    monkeypatch.setattr(candidates, "solve", solve)
    monkeypatch.setattr(candidates, "led_on", lambda fit: None)
    search.brought_to_its_end(replace(search.root, fit=replace(search.root.fit, status="stalled")))
    assert tried == efforts


# -- limits of physics -------------------------------------------------------------------------------------


def test_an_offset_of_the_size_of_the_voltage_is_refused(rubbing):
    fit = mi.fit(mi.dc_motor() + mi.effects.voltage_offset, rubbing)
    top = max(np.abs(r.inputs["v"]).max() for r in rubbing)
    for share, refused in ((0.2, False), (0.4, True), (-0.4, True)):
        far = replace(fit, values={**fit.values, "V_0": share * top})
        assert ("not plausible" in objections(far, LIBRARY["voltage_offset"])) == refused


def test_a_size_at_the_limit_of_what_is_physical_is_refused(rubbing):
    fit = mi.fit(mi.dc_motor() + mi.effects.load_friction, rubbing)
    assert "limit" not in objections(fit, LIBRARY["load_friction"])
    at_limit = replace(fit, values={**fit.values, "mu": 1.0})
    assert "the limit of what is physical" in objections(at_limit, LIBRARY["load_friction"])


def test_no_motor_loses_more_than_half_its_torque_at_some_angle(lab):
    """Of a motor with a coil open half is left; ripples of 96 % were named that imitated friction at the start."""
    (run,) = runs_of(lab, {}, ("stairs 0.5",))
    fit = mi.fit(mi.dc_motor() + mi.effects.torque_ripple(N_r=7), [run])
    for size, refused in ((0.4, False), (0.5, True), (0.96, True)):
        far = replace(fit, values={**fit.values, "a_r": size})
        assert ("the limit of what is physical" in objections(far, LIBRARY["torque_ripple"])) == refused


def test_what_turns_is_not_tried_on_a_linear_axis(lab):
    runs = runs_of(lab, {"coulomb": {"tau_c": 8e-3}}, ("stairs 0.5",), ("theta",))
    runs = [r.with_(units={**r.units, "theta": "m"}) for r in runs]
    fit = mi.fit(mi.torque_driven(axis="linear", g=1.0), runs)
    search = searched(fit)
    names = {s.effect.name for s in search.scores(search.root)}
    assert names & {"coulomb", "constant_load"}
    assert not names & {"gravity", "cogging", "torque_ripple"}


# -- orders ------------------------------------------------------------------------------------------------


def test_an_order_needs_some_periods_within_the_travel(lab):
    (run,) = runs_of(lab, {"cogging": {"A": 8e-3, "N": 16, "phi": 0.7}}, ("ramps 0.3",))
    angle = run.outputs["theta"]
    short = run.select(np.abs(angle - angle[0]) < 1.0).with_(name="short")
    orders = [line.order for line in spectrum(Tangent.of(mi.fit(mi.dc_motor(), [short])), LIBRARY["cogging"]).lines]
    assert min(orders) >= 3 * 2 * np.pi / np.ptp(short.outputs["theta"])


@pytest.mark.parametrize("effect", ["cogging", "torque_ripple"])
@one_thread
def test_a_line_tells_order_size_and_phase(lab, effect):
    size, order, phase = {"cogging": ("A", "N", "phi"), "torque_ripple": ("a_r", "N_r", "phi_r")}[effect]
    value = {"cogging": 8e-3, "torque_ripple": 0.15}[effect]
    runs = runs_of(lab, {effect: {size: value, order: 14, phase: 0.7}}, ("stairs 0.3", "ramps 0.3"))
    best = likely_lines(Tangent.of(mi.fit(mi.dc_motor(), runs)), LIBRARY[effect], 3)[0]
    assert best.order == 14
    assert best.amplitude == pytest.approx(value, rel=0.25)
    assert best.phase == pytest.approx(0.7, abs=0.2)


@pytest.mark.slow
@one_thread
def test_a_small_line_beside_a_large_misfit_gets_its_refit(lab):
    hidden = {"coulomb": {"tau_c": 1.2e-2}, "cogging": {"A": 1.5e-3, "N": 22, "phi": 0.3}}
    fit = mi.fit(mi.dc_motor(), runs_of(lab, hidden, ("stairs 0.4", "waves"), n=1200))
    line = score(Tangent.of(fit), LIBRARY["cogging"])
    assert line.starts[0]["N"] == 22
    assert line.stands_out
    rubbing = score(
        Tangent.of(mi.fit(mi.dc_motor(), runs_of(lab, {"coulomb": {"tau_c": 1.2e-2}}, ("stairs 0.4",)))),
        LIBRARY["cogging"],
    )
    assert not rubbing.stands_out


def test_a_drift_has_no_colour_left(rng):
    drift = np.cumsum(rng.normal(size=(2000, 1)), axis=0)
    white = Whitening.of([drift])([drift])
    assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < 0.1
    assert white.std() == pytest.approx(1.0, rel=0.05)


# -- long records ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_long_record_is_looked_at_in_parts_and_that_is_said(lab, monkeypatch):
    (run,) = runs_of(lab, {"coulomb": {"tau_c": 8e-3}}, ("waves",), n=3000)
    whole = mi.fit(mi.dc_motor(), [run])
    assert parts.affordable(whole) is whole
    monkeypatch.setattr(parts, "AFFORDABLE", 100)
    monkeypatch.setattr(parts, "PART", 500)
    monkeypatch.setattr(parts, "WANTED", sum(int(r.grid.substeps.sum()) for r in whole.problem.runs) / 3)
    found = mi.diagnose(whole, effects=("coulomb", "brush_drop"))
    assert found.effects == ("coulomb",)
    assert found.after.values["tau_c"] == pytest.approx(8e-3, rel=0.1)
    assert "2 parts of 0.5 s, 33 % of the samples" in found.text
    worse = mi.diagnose(whole, [run.with_(outputs={c: 1.2 * y for c, y in run.outputs.items()})], effects=())
    assert "larger on the held-out runs" not in worse.text  # which are looked at as a whole


def test_what_remembers_is_looked_at_on_whole_records(monkeypatch):
    """In parts of 0.3 s the load behind a freewheel began anew, and "only approximated" what it is."""
    t, rng = np.arange(1800) * 1e-3, np.random.default_rng(2)
    model = mi.dc_motor().start_at({"J": 6e-5}) + mi.effects.freewheel(r_free=0.5, g_free=150.0, b_free=2e-5)
    runs = []
    for seed in (1, 2, 3):
        v = np.repeat(np.random.default_rng(seed).uniform(-10, 10, 9), 200)
        clean = mi.planned(model, t, v, channels=("i", "omega"))
        runs.append(clean.with_(sigma={}, outputs={
            c: y + 0.01 * np.sqrt(np.mean(y**2)) * rng.standard_normal(1800) for c, y in clean.outputs.items()}))
    whole = mi.fit(mi.dc_motor(), runs[:2])
    monkeypatch.setattr(parts, "AFFORDABLE", 100)
    monkeypatch.setattr(parts, "PART", 300)
    monkeypatch.setattr(parts, "WANTED", parts._work(whole) / 3)
    found = mi.diagnose(whole, runs[2], effects=("freewheel", "coulomb", "quadratic_drag"))
    assert (found.verdict, found.effects) == ("missing", ("freewheel",))
    assert "parts of" not in found.text
    few = parts.affordable(whole)
    held = HeldOut.of(few, runs[2])
    more = few.model + mi.effects.freewheel + mi.effects.constant_load  # in parts it takes up what the load begins with
    path = [node_of(mi.fit(m, few.problem.experiments), held) for m in (few.model, more.without("constant_load"), more)]
    for nodes, anew in ((path, True), (path[:2], False), (path[::2], False)):
        climb = SimpleNamespace(search=SimpleNamespace(root=path[0], effects=more.effects), path=nodes, rounds=(),
                                remaining=SimpleNamespace(adequate=True))
        asking = stepwise._asking_for_all(climb, whole, runs[2:])
        assert asking == ({"freewheel", "constant_load"} if anew else set())  # what is smaller leaves noise there
    monkeypatch.setattr(stepwise.versions, "WHOLE", 2)  # these are three times as long
    assert "parts of" in mi.diagnose(whole, runs[2], effects=("freewheel",)).text


def test_a_zero_that_drifts_over_a_record_is_seen_on_whole_ones(monkeypatch):
    """In parts it fluctuated: a gyro's zero was said to depend on nothing, five times the noise."""
    t, runs, rng = np.arange(4800) * 1e-3, [], np.random.default_rng(0)
    for seed in (1, 2, 3):
        v = np.repeat(np.random.default_rng(seed).uniform(-10, 10, 80), 60)
        clean = mi.planned(mi.dc_motor().start_at({"J": 6e-5}), t, v, channels=("i", "omega"))
        noise = {c: 0.01 * np.sqrt(np.mean(y**2)) for c, y in clean.outputs.items()}
        outputs = {c: y + s * (rng.standard_normal(4800) + 5 * (c == "omega") * (t / t[-1] - 0.5))
                   for (c, y), s in zip(clean.outputs.items(), noise.values(), strict=True)}
        runs.append(clean.with_(sigma={}, outputs=outputs))
    whole = mi.fit(mi.dc_motor(), runs[:2])
    monkeypatch.setattr(parts, "AFFORDABLE", 100)
    monkeypatch.setattr(parts, "PART", 200)
    monkeypatch.setattr(parts, "RUN_IN", 20)
    monkeypatch.setattr(parts, "WANTED", parts._work(whole) / 2.5)
    found = mi.diagnose(whole, runs[2], effects=("coulomb",))
    assert "parts of" in found.text
    assert found.verdict == "unexplained"
    assert found.remainder.follows == "an error of the speed sensor that changes with the time"
    assert mi.evaluate(mi.fit(found.remainder.model + found.remainder.as_effect(), runs[:2]), runs[2]).rmse[
        "omega"] < 1.1 * noise["omega"]


@pytest.mark.parametrize(("hertz", "more"), [(60, True), (0.2, False)])
def test_dry_friction_counts_in_the_work_of_a_long_record(hertz, more, rng):
    """What turns round every few samples takes sub-steps with friction that the plain motor does not ask for."""
    t = np.arange(2000) * 1e-3
    run = mi.planned(mi.dc_motor(), t, 6 * np.sin(2 * np.pi * hertz * t), channels=("theta",))
    theta = run.outputs["theta"]
    run = run.with_(outputs={"theta": theta + 0.01 * np.std(theta) * rng.normal(size=run.n)}, sigma={})
    fit = mi.fit(mi.dc_motor(), run)
    plain = sum(int(r.grid.substeps.sum()) for r in fit.problem.runs)
    assert (parts._work(fit) > 1.5 * plain) is more
    rubs = fit.problem.for_model(fit.model + mi.effects.lugre)  # beside which there is no dry friction
    assert parts._work(replace(fit, problem=rubs)) == sum(int(r.grid.substeps.sum()) for r in rubs.runs)


def test_samples_that_their_neighbours_predict_are_left_out_and_that_is_said(lab, monkeypatch):
    monkeypatch.setattr(parts, "ENOUGH", 400)
    run, check = runs_of(lab, {"coulomb": {"tau_c": 8e-3}}, ("ramps 0.3", "waves"), ("theta",), n=3200)
    whole = mi.fit(mi.dc_motor().fix(R=lab.R, L=lab.L, K=lab.K), [run])
    thin = parts.affordable(whole)
    assert thin.problem.experiments[0].n == parts.thinned_alike(thin, [check])[0].n == 800
    for name in ("b", "J"):
        assert thin.values[name] == pytest.approx(whole.values[name], rel=0.05), name
    found = mi.diagnose(whole, check, effects=("coulomb", "brush_drop"))
    assert found.effects == ("coulomb",)
    assert found.after.values["tau_c"] == pytest.approx(8e-3, rel=0.03)
    assert "One sample of 4 was used" in found.text


def test_a_voltage_that_steps_between_the_samples_kept_is_seen_on_all_of_them(monkeypatch):
    """Beside a ramp of the driver thinned records left 1.8 times the noise, and sizes were 20 % off."""
    monkeypatch.setattr(parts, "ENOUGH", 400)
    t, rng = np.arange(1200) * 3e-3, np.random.default_rng(3)
    motor = mi.dc_motor(R=1.7, L=9e-4, K=0.055, b=6.4e-5, J=9e-5) + mi.effects.driver_slew(T_r=0.12, V_s=12, V_w=0.6)
    runs = [mi.planned(motor, t, np.repeat(rng.uniform(-9, 9, 12), 101)[:1200], channels=("i", "omega")) for _ in "abc"]
    spread = {"i": 0.012, "omega": 1.0}
    runs = [r.with_(outputs={c: y + spread[c] * rng.normal(size=r.n) for c, y in r.outputs.items()}, sigma={})
            for r in runs]
    fit = mi.fit(mi.dc_motor(), runs[:2])
    thin = parts.affordable(fit)
    assert thin.problem.experiments[0].n == 600
    assert mi.fit(motor.fix(V_s=12), thin.problem.experiments).misfit["i"] > 1.3
    found = mi.diagnose(fit, runs[2], effects=("driver_slew", "coulomb"))
    assert found.effects == ("driver_slew",)
    assert found.remaining.adequate
    assert found.after.values["L"] == pytest.approx(9e-4, rel=0.1)
    assert "One sample of" not in found.text


def test_a_counted_speed_that_dithers_in_one_run_only_is_thinned_too(monkeypatch):
    """Of a speed in steps, one run rested on a count and another flickered between two: louder than their mean noise,
    it kept all samples of all runs, and a diagnosis took seven times as long."""
    monkeypatch.setattr(parts, "ENOUGH", 400)
    t, q = np.arange(0, 1.6, 1e-3), 4.0
    runs = []
    for volts in (3.0, 4.0, 5.0):
        run = simulated(t, np.where(t < 0.2, 0.0, volts), ("omega",))
        omega = run.outputs["omega"]
        dither = np.where(np.random.default_rng(1).random(t.size) < 0.5, q / 2, -q / 2) if volts == 4.0 else 0.0
        counted = q * np.round(omega / q) + np.where(omega > 0.9 * omega[-1], dither, 0.0)
        runs.append(run.with_(outputs={"omega": counted}))
    fit = mi.fit(mi.dc_motor(), runs)
    louder = fit.problem.with_(experiments=(runs[1],), model=fit.model)
    assert louder.runs[0].sigma["omega"] > (1 + parts.SMALL) * fit.problem.runs[1].sigma["omega"]
    assert parts.affordable(fit).problem.experiments[0].n < t.size


@pytest.mark.parametrize(("hidden", "voltage", "channels"), [
    ({}, "prbs", ("omega",)), ({}, "stairs 0.4", ("i", "omega")),
    ({"cogging": {"A": 8e-3, "N": 40}}, "ramps 0.3", ("i",))])
def test_samples_that_show_what_is_quick_stay(lab, monkeypatch, hidden, voltage, channels):
    """A binary signal, a current that rises within samples, teeth that pass in a few: neighbours predict none."""
    monkeypatch.setattr(parts, "ENOUGH", 400)
    whole = mi.fit(mi.dc_motor(), runs_of(lab, hidden, (voltage,), channels, n=3200))
    assert parts.affordable(whole) is whole


# -- what is shown while it works --------------------------------------------------------------------------


def test_the_share_done_never_falls_and_a_second_climb_makes_the_whole_longer():
    seen = []
    stages = Stages(3, show=lambda n, words, done, total: seen.append((words, done, total)))
    for climb in range(2):
        stages.climb()
        stages.at("ranking 36 effects")
        for number in (1, 2):
            stages.round(number)
            for lot in (4, 1, 3):  # races, then the finish: how many lots a round has is not known before
                assert list(stages.map(str, range(lot))) == list(map(str, range(lot)))
        stages.round(4)
        stages.at("Looking at what remains")
        assert seen[-1] == ("Looking at what remains", 4 * climb + 3, 4 * climb + 4)
    done = [share for _, share, _ in seen]
    assert done == sorted(done)
    assert all(share < total for _, share, total in seen)
    assert ("Round 2/3: fitting once more, 2 of 4", 1.125, 4) in seen


def test_what_only_held_out_runs_show_is_looked_for_there(rng):
    """A fan's drag is less than noise at a tenth of the speed: those runs alone say that nothing is missing."""
    fan = mi.dc_motor(R=1.2, L=2e-3, K=0.055, b=1.5e-5, J=2.5e-5) + mi.effects.quadratic_drag(c_2=1.2e-6)
    noise = {"i": 0.02, "omega": 0.5}

    def recorded(volts: float) -> mi.Experiment:
        v = np.where(np.arange(1500) < 20, 0.0, volts * rng.choice([-1.0, -0.5, 0.5, 1.0], 15).repeat(100))
        blank = mi.Experiment(np.arange(1500) * 1e-3, {"v": v}, {c: np.zeros(1500) for c in noise})
        shown = mi.simulate(fan, blank, initial="rest")[0].outputs
        return blank.with_(outputs={c: y + noise[c] * rng.standard_normal(1500) for c, y in shown.items()})

    slow, fast = [recorded(1.0), recorded(0.8)], recorded(12.0)
    fit = mi.fit(mi.dc_motor(), slow)
    assert mi.diagnose(fit, effects=("quadratic_drag", "coulomb")).verdict == "adequate"
    found = mi.diagnose(fit, fast, effects=("quadratic_drag", "coulomb"))
    assert found.effects == ("quadratic_drag",)
    assert "fails on the held-out ones: these were fitted, too" in found.text
    assert len(found.best.problem.experiments) == 3
    assert found.best.values["c_2"] == pytest.approx(1.2e-6, rel=0.05)
    alike = mi.diagnose(fit, recorded(0.9), effects=("quadratic_drag", "coulomb"))
    assert alike.verdict == "adequate"
    assert "fitted, too" not in alike.text


@pytest.mark.parametrize(("name", "share", "refused"), [
    ("tau_0", 0.9, False), ("tau_0", -0.9, False), ("tau_0", 1.2, True), ("tau_0", -1.2, True),
    ("tau_cn", 0.9, False), ("tau_cn", 1.2, True)])
def test_a_load_or_friction_is_no_more_than_the_motor_holds(monkeypatch, name, share, refused):
    """Of a bridge that gives little more at twice the duty a load was "missing" that turned the motor by itself; of one
    that only ran forward a friction backward of five times the largest voltage."""
    t, effect = np.arange(400) * 2e-3, LIBRARY["constant_load" if name == "tau_0" else "coulomb_asymmetric"]
    model = mi.dc_motor(R=2.0, L=2e-3, K=0.05, b=4e-5, J=3e-5) + effect(**{name: 1e-3})
    fit = mi.solve(mi.Problem(model, [simulated(t, np.where(t < 0.1, 0.0, 6.0), model=model)]), start="model")
    fit = replace(fit, values=fit.values | {name: share * fit.values["K"] * 6.0 / fit.values["R"]})
    # A load drags it, and nothing else is missing; a friction does not.
    assert ("motor holds" in objections(fit, effect)) == (refused and name != "tau_0")
    if name == "tau_cn":  # what only coasts may rub more than that, both ways
        coasts = replace(fit, values=fit.values | {"tau_cp": 1.1 * fit.values[name]})
        assert "motor holds" not in objections(coasts, effect)
    monkeypatch.setattr(admissibility, "far", lambda fit: ["omega"])
    assert ("times what the motor holds" in objections(fit, effect)) == refused
