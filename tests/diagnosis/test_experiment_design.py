"""Designed experiments: exact gradients, limits that hold on the plant, words that a bench plays, and better fits."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import motorid as mi
from motorid.acquire.excitation import program
from motorid.cli.app import app
from motorid.diagnosis import design_criteria, experiment_design
from motorid.diagnosis.design_criteria import Driven, Layout, Rival, Task, quiet_seeds
from motorid.errors import FitError, UsageError

DT, DURATION, LEVELS = 2e-3, 0.6, 8
NOISE = {"i": 0.01, "omega": 0.3}
TRUTH = {"constant_load": {"tau_0": 6e-3}}


def measured(plant, motor, effects, t, v, rng):
    true = plant.simulate(motor, effects, t, v, substep=50e-6)
    outputs = {c: true[c] + s * rng.standard_normal(len(t)) for c, s in NOISE.items()}
    return mi.Experiment(t, {"v": v}, outputs), true


@pytest.fixture(scope="module")
def first(plant, lab):
    """One direction only: friction and load look the same."""
    t = DT * np.arange(400)
    v = np.round(5 + 1.5 * np.sin(2 * np.pi * t / 0.4), 4) * np.minimum(t / 0.1, 1)
    return measured(plant, lab, TRUTH, t, v, np.random.default_rng(4))[0]


@pytest.fixture(scope="module")
def fits(first):
    return [mi.fit(mi.dc_motor() + e, [first]) for e in (mi.effects.constant_load, mi.effects.coulomb)]


@pytest.fixture(scope="module")
def design(fits):
    return mi.design_experiment(fits, v_max=8, i_max=3, omega_max=120, duration=DURATION, levels=LEVELS)


# -- the criteria ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tasks(fits):
    """Both goals on the same short steps with binary signals."""
    layout = Layout((60,) * 6, DT, (8,) * 6, None, 8.0)
    rivals = [Rival.of(f) for f in fits]
    driven = tuple(Driven.of(r, layout, rivals[0].sigma, False) for r in rivals)
    both = Task(driven, {"i": (-3, 3)}, NOISE, (), ((0, 1), (1, 0)), np.inf)
    return both, replace(both, driven=driven[:1], asked=("R", "tau_0"), pairs=())


LEVELS_TRIED = np.array([2.0, 4.0, 1.0, -1.0, 3.0, 2.0, 0.5, 0.2, 0.0, 1.0, 0.3, 0.1])


@pytest.mark.parametrize("goal", [0, 1])
def test_gradients_agree_with_differences(tasks, goal, monkeypatch):
    task = tasks[goal].refined(LEVELS_TRIED, 1e-3)  # steps so rough that the value jumps with them have no slope
    monkeypatch.setattr(design_criteria, "STEPS", 40)  # at the end of the rivals' refit the gradient is exact
    monkeypatch.setattr(design_criteria, "SETTLED", 1e-9)

    def worth(levels, slopes=False):
        return task.criteria(levels, task.respond(levels, slopes), slopes)

    exact = worth(LEVELS_TRIED, True)
    for j in (0, 3, 7):
        step = np.where(np.arange(12) == j, 1e-3, 0.0)
        up, down = worth(LEVELS_TRIED + step), worth(LEVELS_TRIED - step)
        for e, a, b in zip(exact, up, down, strict=True):
            assert (a.value - b.value) / 2e-3 == pytest.approx(e.slope[j], rel=0.01, abs=0.01 * np.abs(e.slope).max())


def test_what_an_experiment_is_worth_is_the_mean_over_the_truths_of_the_nearest_rival(tasks):
    both, one = tasks
    three = replace(both, driven=both.driven * 2, pairs=((0, 1), (0, 2), (1, 0), (2, 3)))
    assert three.worth(np.array([3.0, 1.0, 2.0, 50.0])) == pytest.approx((1 + 2 + design_criteria.ENOUGH) / 3)
    assert one.worth(np.array([50.0])) == 50, "precision has no end"


def test_an_effect_that_the_records_leave_open_is_as_large_as_they_allow(plant, lab, fits):
    """The fit of a motor without friction says zero: as a truth that could be told from nothing."""
    t = DT * np.arange(400)
    v = np.round(5 + 1.5 * np.sin(2 * np.pi * t / 0.4), 4) * np.minimum(t / 0.1, 1)
    run = measured(plant, lab, {}, t, v, np.random.default_rng(8))[0]
    fit = mi.fit(mi.dc_motor() + mi.effects.coulomb, [run])
    assert fit.std["tau_c"] is None
    assert Rival.of(fit).model.values["tau_c"] == fit.values["tau_c"] < 1e-9
    tau = Rival.as_allowed(fit).model.values["tau_c"]
    assert 1e-5 < tau < 0.05, "of a stall torque of 0.4 N·m"
    with_it = mi.fit((mi.dc_motor() + mi.effects.coulomb).fix(tau_c=tau), [run])
    assert 0 < 2 * (with_it.cost - fit.cost) / (2 * fit.cost / fit.dof) <= design_criteria.REGION**2 * 1.01
    assert Rival.as_allowed(fits[0]).model.values == Rival.of(fits[0]).model.values, "what is determined stays"


def test_a_rival_answers_the_same_with_and_without_slopes(tasks):
    driven = tasks[0].driven[1]
    nothing = np.zeros(len(driven.rival.scale))
    with_slopes, without = (driven.respond(LEVELS_TRIED, nothing, by_level=b) for b in (True, False))
    np.testing.assert_allclose(with_slopes.y, without.y, rtol=1e-9, atol=1e-9)


def test_a_rival_that_can_follow_is_no_evidence(tasks, fits):
    """A model against itself: whatever the voltage, the refit takes all away."""
    twin = replace(tasks[0], driven=tasks[0].driven[:1] * 2)
    assert max(w.value for w in twin.criteria(LEVELS_TRIED, twin.respond(LEVELS_TRIED), False)) < 1e-6


def test_slopes_beyond_all_measure_leave_what_the_rivals_answer(tasks):
    """Two parameters that do the same 1e20 times over: nothing is left of the other information."""
    task = tasks[0]
    answers = task.respond(LEVELS_TRIED)
    wild = [a._replace(dy=np.full_like(a.dy, 1e20)) for a in answers]
    found = np.array([w.value for w in task.criteria(LEVELS_TRIED, wild, False)])
    assert (found <= np.sum((answers[0].y - answers[1].y) ** 2)).all()


def test_jumps_that_stay_where_they_are_take_short_steps_there_alone(tasks):
    """An inductance that no sample shows would else make every sample of a binary signal dear."""
    driven = tasks[0].driven[0]
    stiff = replace(driven, rival=replace(driven.rival, model=driven.rival.model.replace(L=1e-4)))
    steps = stiff.refined(LEVELS_TRIED, 3e-5).substeps
    jumps = driven.layout.jumps
    assert set(np.flatnonzero(jumps)) <= set(range(0, len(steps), 2)), "bits and segments are whole samples"
    assert 6 < jumps.sum() <= len(steps) / 4
    assert steps[jumps].mean() > 1.5 * steps[~jumps].mean()
    assert steps[~jumps].mean() < 6


def test_what_the_records_know_are_the_deviations_of_the_fit(fits):
    rival = Rival.of(fits[0])
    white = np.sqrt(np.diag(fits[0].covariance))
    names = [p.name for p in fits[0].problem.unknown]
    told = rival.deviations(rival.known)
    for name in ("R", "K", "J", "tau_0"):
        assert told[name] == pytest.approx(white[names.index(name)], rel=0.1)


def test_what_is_another_in_every_run_is_no_parameter_to_design_for(first):
    model = mi.dc_motor() + mi.effect(balance="voltage")(offset)
    rival = Rival.of(mi.fit(model, [first, first.with_(name="again")]))
    assert "V_r" not in rival.model.free_names
    assert rival.information.shape == (5, 5)


def offset(m, V_r=mi.P(0.0, "V", null=0.0, per_run=True)):
    """An offset of the voltage that is another in every run."""
    m.voltage += V_r


def test_a_quiet_binary_signal_goes_nowhere():
    """The running sum of its signs, which is the way of the speed, stays far below that of any other seed."""
    sums = {seed: np.abs(np.cumsum(program(f"prbs:1:0.002:0.12:0:{seed}").volts(500.0))).max()
            for seed in (*quiet_seeds(60)[:2], 1, 38, 75)}
    assert max(list(sums.values())[:2]) <= 3
    assert min(list(sums.values())[2:]) > 6


@pytest.mark.parametrize("dt", [1e-3, 2e-3, 1 / 300])
def test_waves_are_made_of_segments_that_the_bench_plays(fits, dt):
    rival = Rival.of(fits[0])
    layout = experiment_design._layout("steps", 12, 0.9, dt, 8.0)
    task = experiment_design._task([rival], layout, {"i": (-3, 3), "omega": (-120, 120)}, ("K",), None)
    waves = experiment_design._waves(task)
    assert {"reversals", "fast and slow"} < {n.split(" (")[0] for n in waves}
    for wave, c in list(waves.values())[::7]:
        levels = np.round(wave.of(c), 3)
        assert len(wave.ms) <= 12
        np.testing.assert_allclose(program(wave.words(levels)).volts(1 / dt), wave.voltage(levels)[:-1], atol=1e-2)


def test_reversals_stand_at_the_limits_of_current_and_speed(fits):
    rival = Rival.of(fits[0])
    layout = experiment_design._layout("steps", 12, 0.9, 1e-3, 12.0)
    task = experiment_design._task([rival], layout, {"i": (-3, 3), "omega": (-120, 120)}, ("K",), None)
    wave, c = experiment_design._waves(task)["reversals (4)"]
    low, high = task.laid(wave).reach(wave.of(c), [np.zeros((1, len(rival.scale)))])["i"]
    assert 0.85 * 3 < min(-low, high) < max(-low, high) < 1.1 * 3
    low, high = task.laid(wave).reach(wave.of(c), [np.zeros((1, len(rival.scale)))])["omega"]
    assert 0.75 * 120 < min(-low, high) < max(-low, high) < 120


def test_criteria_are_smooth_in_the_voltage_across_reversals(fits):
    """With the sharp sgn of a fit the slopes tell of the integration's error alone, and a search stays where it is."""
    rival = Rival.of(fits[1])
    layout = experiment_design._layout("steps", 12, 0.9, 1e-3, 12.0)
    task = experiment_design._task([rival], layout, {"i": (-3, 3), "omega": (-120, 120)}, ("J",), None)
    wave, c = experiment_design._waves(task)["reversals (6)"]
    task = task.laid(wave).refined(wave.of(c), experiment_design.TOLERANCE)
    way = np.random.default_rng(0).standard_normal(len(c))
    values = [task.criteria(wave.of(c + s * way), task.respond(wave.of(c + s * way)), False)[0].value
              for s in (-4e-3, 4e-3)]
    (exact,) = task.criteria(wave.of(c), task.respond(wave.of(c)), True)
    assert (values[1] - values[0]) / 8e-3 == pytest.approx(exact.slope @ way * wave.v_max, rel=0.02)


# -- the design --------------------------------------------------------------------------------------------


def test_what_the_first_record_left_open_is_expected_to_be_distinguished(design):
    assert "expected to distinguish" in design.text
    assert "No record" not in design.text
    assert set(design.evidence) == {("constant_load", "coulomb"), ("coulomb", "constant_load")}
    assert min(nats for _, nats in design.evidence.values()) > 20
    assert design.v.min() < 0 < design.v.max()


def test_the_bench_plays_just_this_voltage(design):
    np.testing.assert_allclose(program(design.excite).volts(1 / DT), design.v, atol=1e-9)
    assert len(program(design.excite).segments) == LEVELS
    program(design.excite).check(8.0, 32)


def test_limits_hold_on_the_plant_noise_included(plant, lab, design):
    run, true = measured(plant, lab, TRUTH, design.t, design.v, np.random.default_rng(5))
    for channel, limit in (("i", 3.0), ("omega", 120.0)):
        assert design.limits[channel] == limit
        assert np.abs(true[f"true_{channel}"]).max() < limit
        assert np.abs(run.outputs[channel]).max() < limit
        assert design.peaks[channel] < limit


def test_with_the_designed_record_the_truth_is_plain(plant, lab, first, fits, design):
    run, _ = measured(plant, lab, TRUTH, design.t, design.v, np.random.default_rng(6))
    load, friction = (mi.fit(f.problem.model, [first, run]) for f in fits)
    assert friction.chi2 - load.chi2 > min(n for _, n in design.evidence.values())


def test_tighter_limits_are_kept_for_every_rival(fits):
    tight = mi.design_experiment(fits, v_max=8, i_max=0.8, omega_max=60, theta_range=(-4.0, 6.0), duration=DURATION,
                                 levels=LEVELS, budget=1.0)
    assert tight.peaks["i"] < 0.8
    assert tight.peaks["omega"] < 60
    assert tight.peaks["theta"] < 6
    with pytest.raises(FitError, match="limits"):
        mi.design_experiment(fits, i_max=1e-6, duration=DURATION, levels=LEVELS)
    with pytest.raises(UsageError, match="rivals distinguished: say goal='sharpen'"):
        mi.design_experiment(fits, parameters=["R"], duration=DURATION, levels=LEVELS)


def test_by_default_it_stays_within_what_the_records_have_seen(first, fits):
    plan = mi.design_experiment(fits, duration=DURATION, levels=LEVELS, budget=0.0)
    for c, y in {**first.inputs, **first.outputs}.items():
        assert plan.limits[c] == pytest.approx(np.abs(y).max())
    assert plan.status == "stopped early"
    assert plan.peaks["i"] < plan.limits["i"]


def test_records_of_an_angle_alone_limit_the_speed_that_they_had(plant, lab):
    t = DT * np.arange(400)
    v = 5 * np.sin(2 * np.pi * t / 0.4)
    true = plant.simulate(lab, {}, t, v, substep=50e-6)
    noise = 1e-3 * np.random.default_rng(6).standard_normal(len(t))
    fit = mi.fit(mi.dc_motor(), mi.Experiment(t, {"v": v}, {"theta": true["theta"] + noise}))
    design = mi.design_experiment(fit, duration=0.3, levels=4)
    assert design.limits["omega"] == pytest.approx(np.abs(true["omega"]).max(), rel=0.05)
    assert design.peaks["omega"] <= design.limits["omega"]


def test_sharpening_lowers_the_deviation_that_was_asked_for(fits):
    plan = mi.design_experiment(fits[0], parameters=["J"], v_max=8, i_max=3, omega_max=120, duration=DURATION,
                                levels=LEVELS)
    before, fixed, after = plan.deviations["constant_load"]["J"]
    assert plan.goal == "sharpen"
    assert after < 0.8 * before
    assert after < 0.8 * fixed


@pytest.mark.parametrize("shape", ["free", "multisine"])
def test_ramps_keep_to_the_slew_rate_and_are_played(fits, shape):
    plan = mi.design_experiment(fits, v_max=8, i_max=3, omega_max=120, duration=DURATION, levels=LEVELS, shape=shape,
                                slew=80.0, budget=1.0)
    assert np.abs(np.diff(plan.v)).max() <= 80 * DT * 1.01
    assert plan.excite.startswith(("ramp", "rest"))
    assert "ramp" in plan.excite
    np.testing.assert_allclose(program(plan.excite).volts(1 / DT), plan.v, atol=1e-9)


@pytest.mark.parametrize(("words", "options"), [
    ("two of them", {"goal": "distinguish"}), ("goal", {"goal": "improve"}), ("tau_c", {"parameters": ["tau_c"]}),
    ("winding_heating", {"temp_max": 50.0}), ("both sides", {"theta_range": (1.0, 2.0)}), ("shape", {"shape": "sine"}),
    ("levels", {"levels": 1}), ("steps jump", {"slew": 5.0}),
])
def test_what_makes_no_sense_is_said(fits, words, options):
    with pytest.raises(UsageError, match=words):
        mi.design_experiment(fits[0], **options)


# -- the command line ---------------------------------------------------------------------------------------


def test_the_command_designs_from_what_diagnose_wrote(tmp_path, fits):
    rivals = [Rival.of(f).to_dict() for f in fits]
    (tmp_path / "found.json").write_text(json.dumps({"rivals": rivals, "best": rivals[0]}))
    words = ["design", str(tmp_path / "found.json"), "--out", str(tmp_path / "plan.csv"), "--duration", str(DURATION),
             "--levels", str(LEVELS), "--budget", "1", "--limit-voltage", "8", "--limit-current", "3",
             "--limit-angle", "-9", "9", "--json", str(tmp_path / "plan.json")]
    told = CliRunner().invoke(app, words)
    assert told.exit_code == 0, told.output
    plan = json.loads((tmp_path / "plan.json").read_text())
    assert f'--excite "{plan["excite"]}"' in told.output
    assert plan["goal"] == "distinguish"
    assert plan["peaks"]["theta"] < 9
    table = np.genfromtxt(tmp_path / "plan.csv", delimiter=",", names=True, skip_header=1)
    np.testing.assert_allclose(table["v_V"], program(plan["excite"]).volts(1 / DT), atol=1e-6)
    (tmp_path / "plan.csv").write_text("1,2,3")
    again = CliRunner().invoke(app, words)
    assert again.exit_code == 2
    assert (tmp_path / "plan.csv").read_text() == "1,2,3"


@pytest.mark.parametrize("text", ["", "{}", "[1]", '{"rivals": [{}]}'])
def test_a_file_without_rivals_is_refused(tmp_path, text):
    (tmp_path / "found.json").write_text(text)
    told = CliRunner().invoke(app, ["design", str(tmp_path / "found.json")])
    assert told.exit_code != 0
    assert "motorid diagnose" in str(told.exception) + told.output


# -- closing the loop ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_loop_on_a_bench_ends_with_nothing_open(tmp_path):
    bench = mi.virtual_bench("coulomb:tau_c=0.008", seed=7, rate=500.0)
    done = mi.identify_on(bench, tmp_path, v_max=6, i_max=4, duration=1.0, records=3,
                          first="step:3:0.3,step:4:0.3,step:3.5:0.3,step:2:0.3")
    assert done.reached
    assert len(done.steps) == len(done.runs) > 1
    assert "constant_load" in done.steps[0].open
    assert done.steps[-1].found.effects == ("coulomb",)
    assert (tmp_path / "record2.csv").exists()
