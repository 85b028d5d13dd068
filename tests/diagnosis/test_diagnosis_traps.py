"""What a diagnosis must not fall for: every trap has a record that invites the wrong answer."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from battery.cases import CASES
from battery.excite import driven, record
from lab_records import VALUES, pair

import motorid as mi
from motorid.diagnosis.adequacy import adequacy
from motorid.diagnosis.admissibility import run_through
from motorid.diagnosis.candidates import Search, Stages
from motorid.diagnosis.predictive_score import deciding, finer
from motorid.diagnosis.record_versions import Reading
from motorid.diagnosis.score_test import Score, rank, score
from motorid.diagnosis.thresholds import FINER, FINER_RATE, LARGER
from motorid.effects import LIBRARY
from motorid.estimation.linearisation import Tangent
from motorid.records.checks import contradictions
from motorid.records.experiment import Experiment

ANGLE = ("i", "omega", "theta")


def runs_of(
    motor, effects, drives, channels=("i", "omega"), n=800, seed=3, dt=1e-3, chain="logger"
) -> list[Experiment]:
    rng = np.random.default_rng(seed)
    return [
        record(driven(motor, effects, words, n, dt, rng), chain, channels, motor, rng, f"run{k + 1}")
        for k, words in enumerate(drives)
    ]


def diagnosed(runs, effects=None, base=None, **how):
    """Fit all runs but the last and diagnose with that one held out."""
    return mi.diagnose(mi.fit(base or mi.dc_motor(), runs[:-1]), runs[-1:], effects=effects, **how)


def candidate(found, name):
    return next(c for c in found.ranking if c.effect == name)


def test_a_current_of_the_supply_comes_before_what_explains_the_speed_alone():
    """The motor's own explained none of it; a freewheel that left the speed as noise, and R of none, was in the way."""
    rng, t = np.random.default_rng(0), np.arange(1900) * 4e-3
    effects = mi.effects.supply_side_current(V_dc=9.0, u_i=1.0), mi.effects.viscous_asymmetric(b_a=2.67e-5)
    model, runs = sum(effects, mi.dc_motor(R=1.065, L=0.53e-3, K=0.02176, b=1.53e-5, J=2.68e-5)), []
    for k in range(3):
        v = rng.uniform(-9, 9, 60)[(t / 0.4).astype(int)]
        bare = mi.Experiment(t, {"v": v}, dict.fromkeys(("i", "omega"), 0 * t), name=f"run{k}")
        shown = mi.simulate(model, bare, initial="rest")[0].outputs
        runs.append(bare.with_(outputs={c: shown[c] + sd * rng.normal(size=1900)
                                        for c, sd in (("i", 0.07), ("omega", 1.2))}))
    found = diagnosed(runs)
    assert set(found.effects) == {"supply_side_current", "viscous_asymmetric"}
    assert found.after.values["b_a"] == pytest.approx(2.67e-5, rel=0.05)


@pytest.fixture(scope="module")
def loaded(plant):
    """A geared servo whose friction grows with the torque it carries."""
    return runs_of(plant.MOTORS["servo"], {"load_friction": {"mu": 0.15}}, ("stairs", "prbs", "steps"), dt=2e-3)


def test_coulomb_scores_but_load_friction_is_the_answer(loaded):
    found = diagnosed(loaded, ("coulomb", "coulomb_asymmetric", "load_friction", "quadratic_drag", "brush_drop"))
    assert candidate(found, "coulomb").predicted_drop > 0.05  # the bait
    assert found.effects == ("load_friction",)
    assert found.after.values["mu"] == pytest.approx(0.15, rel=0.1)


def test_a_wrong_first_choice_is_undone(loaded):
    """Coulomb is in the model already; load friction takes its place instead of standing beside it."""
    found = diagnosed(loaded, ("load_friction", "quadratic_drag", "constant_load"), mi.dc_motor() + mi.effects.coulomb)
    assert "load_friction" in found.effects
    left = found.after.values.get("tau_c", 0.0)
    assert left < 0.2 * found.before.values["tau_c"]


def test_a_constant_offset_that_fits_forward_runs_is_refused_on_a_reversed_one(plant):
    runs = runs_of(plant.MOTORS["servo"], {"coulomb": {"tau_c": 0.04}}, ("forward", "waves", "stairs"), dt=2e-3)
    both = ("constant_load", "voltage_offset", "coulomb")
    found = diagnosed(runs, both)
    assert candidate(found, "constant_load").refit_drop > 0.5  # on the forward runs it is as good
    assert found.effects == ("coulomb",)
    assert "held-out" in candidate(found, "constant_load").reason
    blind = mi.diagnose(mi.fit(mi.dc_motor(), runs[:-1]), effects=both)  # nothing reversed was ever seen
    assert set(blind.groups[0]) >= {"coulomb", "constant_load"}
    assert "do not distinguish" in blind.text
    assert "revers" in (blind.suggestion or "") or "through zero" in (blind.suggestion or "")


def test_a_drag_with_the_wrong_sign_scores_nothing(plant):
    """Drag that is smaller than linear at high speed: a negative c_2 would explain it well."""
    runs = runs_of(plant.MOTORS["wheel"], {"quadratic_drag": {"c_2": -1.5e-6}}, ("stairs", "ramps", "steps"), dt=2e-3)
    fit = mi.fit(mi.dc_motor(), runs[:-1])
    drag = LIBRARY["quadratic_drag"]
    assert score(Tangent.of(fit), drag).drop < 0.01

    @mi.effect(balance="torque")
    def any_drag(m, c_x=mi.P(1e-7, "N·m·s²/rad²", null=0.0)):
        """The same without a sign."""
        m.torque -= c_x * m.omega * (m.omega**2 + 1e-6) ** 0.5

    assert score(Tangent.of(fit), any_drag).drop > 0.2  # the bait
    found = mi.diagnose(fit, runs[-1:], effects=("quadratic_drag",))
    assert found.effects == ()


def test_at_a_single_operating_point_friction_is_not_told_from_b(lab, plant):
    """The motor runs at one speed all the time; only b + tau_c/omega can be known."""
    rng = np.random.default_rng(5)
    t = np.arange(900) * 1e-3
    v = np.round(5 + 0.02 * rng.normal(size=900), 4)
    runs = []
    for k in range(3):
        start = plant.simulate(lab, {"coulomb": {"tau_c": 4e-3}}, np.arange(300) * 1e-3, np.full(300, 5.0))
        r = plant.simulate(lab, {"coulomb": {"tau_c": 4e-3}}, t, v, omega0=float(start["omega"][-1]))
        y = {c: plant.white(r[c], s, rng)[100:] for c, s in (("i", 0.01), ("omega", 0.3))}
        runs.append(Experiment(t[100:] - t[100], {"v": v[100:]}, y, name=f"run{k + 1}"))
    found = diagnosed(
        runs, ("coulomb", "constant_load", "quadratic_drag", "load_friction", "voltage_offset", "brush_drop")
    )
    assert found.effects == () or len(found.groups[0]) > 1


def test_a_closed_loop_is_said(plant):
    runs = runs_of(plant.MOTORS["wheel"], {"coulomb": {"tau_c": 0.05}}, ("loop", "loop", "stairs"), dt=2e-3)
    found = diagnosed(runs, ("coulomb", "constant_load"))
    assert "coulomb" in found.effects
    assert "closed loop" in found.text
    open_loop = runs_of(plant.MOTORS["wheel"], {}, ("prbs", "stairs", "steps"), dt=2e-3)
    assert "closed loop" not in diagnosed(open_loop, ("coulomb",)).text


def test_a_speed_in_rpm_is_recognised(plant):
    """An angle beside it gives the scale away."""
    runs = runs_of(
        plant.MOTORS["servo"], {"speed_gain": {"k_w": 30 / np.pi - 1}}, ("stairs", "multisine", "steps"), ANGLE, dt=2e-3
    )
    found = diagnosed(runs, ("speed_gain", "speed_lag", "coulomb", "gravity"))
    assert found.effects == ("speed_gain",)
    assert found.where == "sensor"
    assert "rpm" in found.text


def test_of_two_sensors_the_one_that_predicts_better_beside_the_other_comes_first(plant):
    """Its errors are smoother, of fewer effective samples: the gain on the plain motor alone would take the lag."""
    hidden = {"coulomb": {"tau_c": 8e-3}, "speed_average": {"T_a": 0.012}}
    runs = runs_of(plant.MOTORS["lab"], hidden, ("steps", "chirp", "prbs"))
    found = diagnosed(runs, ("speed_delay", "speed_average", "speed_lag", "coulomb"))
    assert [r.added for r in found.ladder.rungs] == [None, "speed_average", "coulomb"]


@pytest.mark.slow
@pytest.mark.parametrize("chain", ["logger", "coloured", "coarse", "spikes"])
def test_noise_alone_gets_no_effect(plant, chain):
    runs = runs_of(plant.MOTORS["wheel"], {}, ("stairs", "multisine", "steps"), ANGLE, dt=2e-3, chain=chain)
    found = diagnosed(runs)
    assert found.effects == ()
    assert found.verdict == "adequate", found.text


@pytest.mark.slow
def test_the_smaller_of_two_effects_is_found_behind_the_larger(plant):
    hidden = {"gravity": {"mgl": 1.5, "phi_g": 0.5}, "cogging": {"A": 0.35, "N": 8, "phi": 1.0}}
    runs = runs_of(plant.MOTORS["big"], hidden, ("stairs 0.4", "ramps 0.5", "steps 0.4"), ANGLE)
    found = diagnosed(runs, ("gravity", "cogging", "coulomb", "torque_ripple", "constant_load"))
    assert set(found.effects) == {"gravity", "cogging"}
    assert found.effects[0] == "gravity"
    assert found.after.values["N"] == 8
    assert found.after.values["A"] == pytest.approx(0.35, rel=0.1)


@pytest.mark.slow
def test_what_is_found_later_is_no_rival_any_more():
    """In the first round either explains what both do together; in the end both are there."""
    runs, check = CASES["quadratic_drag+voltage_offset"].records()
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs), check, effects=("quadratic_drag", "voltage_offset", "coulomb"))
    assert set(found.effects) == {"quadratic_drag", "voltage_offset"}
    assert found.groups == ()
    assert "not distinguish" not in found.text
    assert not any(set(c.group) & set(found.effects) for c in found.ranking)


def test_what_held_out_runs_refuse_for_the_lack_of_another_is_found_with_that(plant):
    """A spring alone makes the held-out runs worse: friction would hold the motor where it springs back."""
    motor = replace(plant.MOTORS["lab"], R=0.106, L=9e-5, K=0.52, b=0.0135, J=0.24, v_max=36.0)
    hidden = {"spring": {"k_s": 1.3, "theta_0": 0.7}, "coulomb": {"tau_c": 23.0}}
    rng, t = np.random.default_rng(1), 1e-3 * np.arange(1720)
    ends = [0.052, 0.086, 0.226, 0.581, 0.729, 1.126, 1.371, 1.624]
    hard = np.array([0, -32.4, 36, -32.3, -16.8, -31.1, -26.4, -12.2, -26.5])[np.searchsorted(ends, t, "right")]
    other = np.repeat([-15.0, 12, 0, 13, 2, 21, 20, 19, -4, -2, 5, -19, -7, 15, 24, -23, 0, 0], 100)[:1720]
    runs = []
    for name, v in (("hard", hard), ("other", other)):
        true = plant.simulate(motor, hidden, t, v, substep=None)
        noisy = {c: true[f"true_{c}"] + s * rng.normal(size=len(t)) for c, s in
                 (("i", 1.2), ("omega", 0.3), ("theta", 0.03))}
        runs.append(Experiment(t, {"v": v}, noisy, name=name))
    found = diagnosed(runs, ("spring", "coulomb", "stribeck"))
    assert "held-out error rises" in candidate(diagnosed(runs, ("spring",)), "spring").reason
    assert found.effects == ("spring", "coulomb")
    assert found.ladder.rungs[1].added == "spring + coulomb"
    assert found.after.fits == "noise"


def fine_encoder(motor, effects, seed=5, lowest=-8.0) -> list[Experiment]:
    """An encoder that sees a millionth of a turn; the driver's voltage wanders by a thousandth, which none records."""
    runs, rng, t = [], np.random.default_rng(seed), 2e-3 * np.arange(1500)
    model = mi.dc_motor(R=motor.R, L=motor.L, K=motor.K, b=motor.b, J=motor.J)
    for name, sizes in effects.items():
        model += LIBRARY[name](**sizes)
    for k in range(3):
        v = np.repeat(rng.uniform(lowest, 8, 30), 50)
        wander = sum(rng.normal() * np.sin(w * t + rng.uniform(0, 6)) for w in rng.uniform(3, 40, 6))
        blank = Experiment(t, {"v": v * (1 + 1e-3 * wander / np.std(wander))}, dict.fromkeys(ANGLE, 0 * t))
        clean = mi.simulate(model, blank, initial="rest")[0].outputs
        size = {"i": 5e-3 * np.std(clean["i"]), "omega": 5e-3 * np.std(clean["omega"]), "theta": 5e-6}
        outputs = {c: y + size[c] * rng.standard_normal(len(t)) for c, y in clean.items()}
        runs.append(Experiment(t, {"v": v}, outputs, name=f"run{k + 1}"))
    return runs


def test_an_encoder_finer_than_any_model_invites_no_effect(lab):
    """What moves the current and the speed by a fifth of their noise is 50 times that of the angle."""
    found = diagnosed(fine_encoder(lab, {"coulomb": {"tau_c": 8e-3}}))
    assert [r.added for r in found.ladder.rungs] == [None, "coulomb"]
    assert found.after.misfit["theta"] > 30
    assert found.remaining.adequate
    assert "no model is asked for less" in found.text


def test_what_an_angle_that_decides_nothing_hides_is_seen_in_the_other_channels(lab):
    """Its errors are eleven times its noise, whatever there is; those of the current and of the speed are the noise."""
    judged = {}
    for size in (0.0, 1e-3):
        fit = mi.fit(mi.dc_motor(), fine_encoder(lab, {"cogging": {"A": size, "N": 12, "phi": 0.5}}, lowest=1.0)[:2])
        assert finer(fit, "theta")
        assert fit.misfit["theta"] > 10
        search = Search(fit, None, [LIBRARY["cogging"], LIBRARY["coulomb"]], Stages())
        scores = search.scores(search.root)
        drops, beside = ({s.effect.name: s.drop for s in found} for found in (scores, rank(fit, search.effects)))
        assert drops["coulomb"] < 0.3 * beside["coulomb"]  # which the wandering angle asks for
        judged[size] = adequacy(fit, scores)
        assert (drops["cogging"] > 0.05) is bool(size)
    assert [a.adequate for a in judged.values()] == [True, False]


def test_an_effect_that_takes_up_what_an_angle_is_asked_no_more_says_nothing(lab):
    """A flap's angle was followed to 0.04 %, twice its counts: all else was noise, and a curve was sought for long."""
    runs = [run.with_(outputs={**run.outputs, "theta": y + 8e-4 * np.sqrt(np.mean(y**2)) * np.sin(3 * run.t)})
            for run in fine_encoder(lab, {}, lowest=1.0)[:2] for y in [run.outputs["theta"]]]
    fit = mi.fit(mi.dc_motor(), runs)
    assert finer(fit, "theta")
    scored = deciding(fit)
    squares = np.sum([np.nansum(r**2, axis=0) for r in scored.problem.unstack(scored.residuals)], axis=0)
    share = squares[fit.problem.outputs.index("theta")] / squares.sum()
    assert 0.03 < share < 0.3
    told = [adequacy(fit, [Score(LIBRARY["coulomb"], drop, ({},), 3000.0)]) for drop in (share, share + 0.04)]
    assert [a.adequate for a in told] == [True, False]


def test_a_fine_angle_is_not_asked_either_what_its_noise_nearly_hides(lab):
    rng = np.random.default_rng(1)
    runs = [run.with_(outputs={**run.outputs, "theta": run.outputs["theta"] + 0.01 * rng.standard_normal(run.n)})
            for run in fine_encoder(lab, {}, lowest=1.0)[:2]]
    fit = mi.fit(mi.dc_motor(), runs)
    assert finer(fit, "theta")
    assert 1.2 < fit.misfit["theta"] < LARGER
    assert adequacy(fit).channels["theta"]["p_value"] == 1.0
    alone = mi.fit(mi.dc_motor().fix(R=lab.R, L=lab.L), [run.without("i", "omega") for run in runs])
    assert deciding(alone) is alone  # scored as it is where nothing else is
    assert adequacy(alone).adequate


@pytest.mark.parametrize(("hidden", "close"), [({}, True), ({"cogging": {"A": 3e-2, "N": 12, "phi": 0.5}}, False)])
def test_the_jumps_of_an_encoder_s_counts_are_no_error_of_the_model(hidden, close, lab):
    """Their rate is a per cent of the speed's, cogging's too; over many turns an angle shows neither."""
    turn = 2 * np.pi / 1000
    runs = [run.with_(outputs={**run.outputs, "theta": turn * np.floor(run.outputs["theta"] / turn)})
            for run in fine_encoder(lab, hidden, lowest=1.0)]
    fit = mi.fit(mi.dc_motor(), runs[:2])
    assert fit.nrmse["theta"] < FINER
    sigma, dt = fit.problem.runs[0].sigma["theta"], float(np.median(np.diff(runs[0].t)))
    assert np.sqrt(2) * sigma / dt > FINER_RATE * np.sqrt(np.mean(runs[0].outputs["omega"] ** 2))
    assert finer(fit, "theta") is close


@pytest.mark.parametrize(("counts", "jitter"), [(250, 0.3), (500, 0.3), (500, 0.6)])
def test_how_well_the_noise_of_counts_is_known_is_no_error_of_the_model_either(counts, jitter, lab):
    """Their rate is up to a tenth of the speed's: half a per cent of that is less than its own scatter."""
    turn, rng = 2 * np.pi / counts, np.random.default_rng(1)
    runs = fine_encoder(lab, {}, lowest=1.0)[:2]
    read = [turn * np.round(r.outputs["theta"] / turn + jitter * rng.standard_normal(r.n)) for r in runs]
    runs = [r.with_(outputs={**r.outputs, "theta": theta}) for r, theta in zip(runs, read, strict=True)]
    fit = mi.fit(mi.dc_motor(), runs)
    assert fit.nrmse["theta"] < FINER
    assert finer(fit, "theta")


@pytest.mark.parametrize("counts", [1000, 8000])
def test_an_angle_that_decides_nothing_still_tells_the_scale_of_the_speed(counts, lab):
    """To a thousandth, which is what is asked of it: without it the motor's constant would take the scale up."""
    turn, scaled = 2 * np.pi / counts, fine_encoder(lab, {"speed_gain": {"k_w": 0.04}}, lowest=1.0)[:2]
    runs = [r.with_(outputs={**r.outputs, "theta": turn * np.floor(r.outputs["theta"] / turn)}) for r in scaled]
    fit = mi.fit(mi.dc_motor(), runs)
    assert finer(fit, "theta")
    search = Search(fit, None, [LIBRARY["speed_gain"]], Stages())
    (score_of_gain,) = search.scores(search.root)
    assert score_of_gain.drop > 0.5


def test_an_error_is_not_taken_for_noise_where_the_noise_is_thought_larger_than_it_is(lab):
    fit = mi.fit(mi.dc_motor(), fine_encoder(lab, {"cogging": {"A": 1.8e-2, "N": 12, "phi": 0.5}}, lowest=1.0)[:2])
    assert fit.nrmse["theta"] < FINER
    assert fit.problem.runs[0].sigma["theta"] > 5 * 5e-6  # the encoder's
    assert not finer(fit, "theta")


def test_what_an_angle_shows_within_a_turn_is_still_asked_of_it(lab):
    """Cogging, of which a turn's mean knows nothing."""
    runs = [run.with_(outputs={"theta": run.outputs["theta"]})
            for run in fine_encoder(lab, {"cogging": {"A": 4e-3, "N": 12, "phi": 0.5}})]
    fit = mi.fit(mi.dc_motor().fix(R=lab.R, L=lab.L), runs[:2])
    found = mi.diagnose(fit, runs[2:], effects=("cogging", "coulomb", "quadratic_drag"))
    assert found.effects == ("cogging",)


def position_loop(step: float, rate: float, seconds: float = 8.0, dt: float = 5e-3) -> mi.Experiment:
    """A geared motor that rubs in a position loop, rad; its bridge adds 0.4 V, its encoder counts by `step`."""
    omega = theta = 0.0
    t, v, y = np.arange(0, seconds, dt), [], []
    for now in t:
        y.append(step * np.round(theta / step))
        v.append(float(np.clip(6 * (np.sin(rate * now) - y[-1]), -12, 12)))
        for _ in range(10):
            torque = 0.4 * (v[-1] + 0.4 - 0.4 * omega) / 4 - 2e-3 * omega - 0.05 * np.tanh(omega / 0.05)
            omega += dt / 10 * torque / 4e-3
            theta += dt / 10 * omega
    return mi.Experiment(t=t, inputs={"v": np.array(v)}, outputs={"theta": np.array(y)})


def test_what_draws_a_drifting_axis_back_is_not_named_for_it():
    """In a position loop an angle that is simulated drifts; a spring or stops help, whatever is missing."""
    runs, check = [position_loop(0.06, 2.0)], [position_loop(0.06, 1.6)]
    tried = ("coulomb", "coulomb_asymmetric", "spring", "end_stop", "gravity", "speed_ripple")
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs), check, effects=tried)
    assert not {"spring", "end_stop", "gravity", "speed_ripple"} & set(found.effects)
    assert found.after.window is not None


def test_a_command_beyond_the_supply_is_a_voltage_limit_and_no_stop(rng):
    """Of the speed alone: what no longer rises with the command was 'end stops' at thousands of radians."""
    t = np.arange(0, 8, 5e-3)
    runs = []
    for v in (np.repeat([2, 5, 8, 11, 14, 17, 20, 6.0], 200), 2.5 * t):
        omega, y = 0.0, []
        for volts in np.minimum(v, 12.0):
            y.append(omega)
            omega += 5e-3 * (20 * max(volts - 0.7, 0.0) - omega) / 0.1
        runs.append(mi.Experiment(t=t, inputs={"v": v}, outputs={"omega": np.array(y) + rng.normal(0, 1.0, len(t))}))
    fit = mi.fit(mi.dc_motor(), runs)
    found = mi.diagnose(fit)
    assert found.effects[0] == "driver_voltage_limit"
    assert found.after.values["V_lim"] == pytest.approx(12, rel=5e-3)
    stopped = mi.fit(mi.dc_motor() + mi.effects.end_stop, runs)
    assert run_through(stopped, mi.effects.end_stop).startswith("the motor runs on through theta_hi")


def test_a_record_that_ends_during_an_impact_does_not_refute_the_stop(rng):
    """Before it turns back the motor moves on; what a record's end cuts off is no passage."""
    t = np.arange(0, 3, 2e-3)
    blank = mi.Experiment(t, {"v": 6 * np.sign(np.sin(2 * t + 0.1))}, {"i": 0 * t, "theta": 0 * t})
    motor = mi.dc_motor(R=1.0, L=2e-3, K=0.05, b=1e-4, J=1e-4) + mi.effects.end_stop(
        k_stop=1.0, theta_lo=-3.0, theta_hi=2.0, d_stop=1e-3)
    clean = mi.simulate(motor, blank, initial="rest")[0].outputs
    entered = np.flatnonzero(np.diff((clean["theta"] > 2.0).astype(int)) == 1)
    assert len(entered) > 1
    run = blank.with_(outputs={c: y + rng.normal(0, 1e-3, len(t)) for c, y in clean.items()})
    for last in (entered[-1] + 3, len(t)):
        fit = mi.fit(motor, run.select(slice(0, int(last))))
        assert run_through(fit, mi.effects.end_stop) == ""


def test_a_size_that_is_open_is_not_zero_where_the_error_needs_it():
    """Of a speed under one sign of the voltage deviations, from slopes, allow no pulsed bridge at all; nothing else
    makes the speeds fall behind the voltage so."""
    values = {"R": 1.18, "L": 0.0149, "K": 0.3, "b": 0.0164, "J": 0.015, "tau_c": 0.56, "s_c": 0.86, "V_s": 12.0}
    true = (mi.dc_motor() + mi.effects.coulomb + mi.effects.pwm_coast).replace(**values)
    v, rng = np.repeat([0.0, 3, 6, 9, 12, 0], 300), np.random.default_rng(1)
    still = Experiment(0.01 * np.arange(len(v)), {"v": v}, {"omega": 0 * v})
    speed = mi.simulate(true, [still])[0].outputs["omega"]
    runs = [still.with_(outputs={"omega": speed + 0.3 * rng.normal(size=len(v))}) for _ in range(2)]
    found = diagnosed(runs)
    assert set(found.effects) == {"coulomb", "pwm_coast"}
    assert "could as well be zero" not in found.text


def rubbing(v, rng, dt=0.01, steps=10):
    """A speed of a motor whose friction falls with the speed, under a torque that nothing predicts."""
    R, K, J, b, h, omega, other, speeds = 2.0, 0.05, 1e-4, 2e-5, dt / steps, 0.0, 0.0, []
    stays = np.exp(-h / 0.05)
    for volt in v:
        speeds.append(omega)
        for _ in range(steps):
            other = stays * other + np.sqrt(1 - stays**2) * 1e-3 * rng.normal()
            free, dry = K * (volt - K * omega) / R - b * omega + other, 6e-3 * (1 + 1.5 * np.exp(-abs(omega) / 40))
            if omega or abs(free) > dry:
                moved = omega + h * (free - dry * np.sign(omega or free)) / J
                omega = 0.0 if omega * moved < 0 else moved
    noisy = np.array(speeds) + 0.2 * rng.normal(size=len(v))
    return Experiment(dt * np.arange(len(v)), {"v": v}, {"omega": noisy})


def test_dry_friction_is_not_called_a_brake_that_few_motors_have():
    levels = ([3.0, 6, 9, 12, 5, 8, 2, 10], [4.0, 10, 7, 12, 3, 6])
    found = diagnosed([rubbing(np.repeat(each, 150), np.random.default_rng(k)) for k, each in enumerate(levels, 1)])
    assert found.effects[0] == "stribeck"
    assert "eddy_brake" not in found.effects


FIRST = "The records seem to contradict themselves; check first: run: "


def test_a_current_without_its_sign_is_said_first(rng):
    hidden = mi.dc_motor(**VALUES) + mi.effects.coulomb(tau_c=8e-3)
    true = pair(rng, model=hidden)
    runs = [run.with_(outputs={**run.outputs, "i": np.abs(run.outputs["i"])}) for run in true]
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs[:1]), runs[1:], effects=["coulomb", "eddy_brake", "current_offset"])
    assert found.answer.startswith(f"{FIRST}the current is never negative")
    assert "--ignore i" in found.answer
    assert not found.remainder.errors  # of records to be mended no curve is worth its time
    good = mi.diagnose(mi.fit(mi.dc_motor(), true[:1]), true[1:], effects=["coulomb", "eddy_brake", "current_offset"])
    assert good.answer.startswith("Missing: dry (Coulomb) friction")


def test_a_current_of_one_sign_is_a_hoist_s():
    """It holds a weight while the voltage lets it down, and no model that leaves noise contradicts its records."""
    t, rng = np.arange(3000) * 2e-3, np.random.default_rng(7)
    v = np.interp(t, [0, 0.5, 2, 2.5, 4, 4.5, 6], [0, 10, 10, -4, -4, 6, 6])
    hoist = mi.dc_motor(R=1.2, L=1e-3, K=0.05, b=2e-5, J=8e-5) + mi.effects.constant_load(tau_0=0.16)
    still = Experiment(t, {"v": v}, {"i": 0 * v, "omega": 0 * v})
    seen, noise = mi.simulate(hoist, [still])[0].outputs, rng.normal(size=(2, len(t)))
    run = still.with_(outputs={"i": seen["i"] + 0.02 * noise[0], "omega": seen["omega"] + 0.3 * noise[1]})
    assert "never negative" in contradictions([run])  # so it may seem
    found = mi.diagnose(mi.fit(mi.dc_motor(), run), effects=["constant_load", "coulomb"])
    assert found.effects == ("constant_load",)
    assert found.answer.startswith("Missing: constant load")


def test_an_angle_of_another_axis_is_said_first(rng):
    hidden = mi.dc_motor(**VALUES) + mi.effects.coulomb(tau_c=8e-3)
    runs = [run.with_(outputs={**run.outputs, "theta": 0.3 * np.sin(23 * run.t) + 1e-3 * rng.normal(size=run.n)})
            for run in pair(rng, model=hidden)]
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs[:1]), runs[1], effects=["coulomb", "speed_ripple", "speed_gain"])
    assert found.answer.startswith(f"{FIRST}the angle does not follow from the speed")
    assert "--ignore theta" in found.answer


def test_the_swapped_sign_of_a_torque_is_said_first():
    t, rng = np.arange(1500) * 1e-3, np.random.default_rng(4)
    u = rng.choice([-2.0, -1.0, 1.0, 2.0], 15).repeat(100)
    bare = mi.Experiment(t, {"v": u}, {"omega": np.zeros(1500)}, units={"v": "A"})
    axis = mi.torque_driven(g=0.1, b=0.01, J=1e-3)
    shown = mi.simulate(axis, bare, initial="rest")[0].outputs["omega"]
    turned = bare.with_(inputs={"v": -u}, outputs={"omega": shown + 0.05 * rng.normal(size=1500)})
    found = mi.diagnose(mi.fit(mi.torque_driven(g=0.1).fix("g"), turned), effects=["coulomb"])
    assert found.answer.startswith(f"{FIRST}a positive current accelerates the axis backwards")
    assert " Taken as they are: " in found.answer


@pytest.mark.parametrize("sign", [1, -1])
def test_a_fast_torque_beside_an_angle_alone_is_not_called_swapped(sign):
    t = np.arange(3000) * 2e-3
    bare = mi.Experiment(t, {"v": 1.5 * np.sin(2 * np.pi * 20 * t)}, {"theta": 0 * t}, units={"v": "N·m"})
    shown = mi.simulate(mi.torque_driven(g=1.0, b=0.02, J=0.01), bare, initial="rest")[0].outputs["theta"]
    said = contradictions([bare.with_(outputs={"theta": sign * shown})])
    assert ("backwards" in said) == (sign < 0)


def test_an_error_that_rises_where_spikes_are_left_out_does_not_fall():
    """Of the smaller signal without them it is a larger share."""
    was, now = (SimpleNamespace(nrmse={"omega": e}) for e in (0.524, 0.538))
    read = Reading("Spikes are left out", "--no-spikes", mi.Experiment.without_spikes)
    assert "with --no-spikes the error becomes (speed 52.4 → 53.8 %)" in read.remark(was, now)
    assert "with --no-spikes the error falls (speed 53.8 → 52.4 %)" in read.remark(now, was)
    assert "the error becomes (speed 53.8 → 53.8 %)" in read.remark(now, now)


def test_a_current_that_is_never_negative_may_be_the_supply_s():
    runs, motor = [], mi.dc_motor(R=1.2, L=1e-3, K=0.05, b=2e-5, J=8e-5)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        v = np.repeat(rng.choice([-10.0, -6, -3, 0, 4, 8, 11], 16), 80)
        still = Experiment(2e-3 * np.arange(len(v)), {"v": v}, {"i": 0 * v, "omega": 0 * v})
        seen, noise = mi.simulate(motor, [still])[0].outputs, rng.normal(size=(2, len(v)))
        drawn = np.maximum(np.sign(v) * seen["i"], 0) * np.abs(v) / 12 + 0.02 * noise[0]
        runs.append(still.with_(outputs={"i": np.maximum(drawn, 0), "omega": seen["omega"] + 0.3 * noise[1]}))
    found = diagnosed(runs, ("supply_side_current", "coulomb", "brush_drop", "current_gain"))
    assert found.effects == ("supply_side_current",)
    assert "contradict" not in found.text


def test_a_current_without_its_sign_is_said_first_where_no_supply_explains_it():
    """A supply's current, which is never negative either, helped, and hid it."""
    run = mi.read_runs(mi.data_path("hidden_friction/run1.csv"))[0]
    run = run.with_(outputs={**run.outputs, "i": np.abs(run.outputs["i"])})
    found = mi.diagnose(mi.fit(mi.dc_motor(), run), effects=("coulomb", "supply_side_current"))
    said = "The records seem to contradict themselves; check first: run1: the current is never negative"
    assert found.answer.startswith(said)
