"""Problem: what enters the residual, with which weights, and what is refused."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from lab_records import NOISE, VALUES, drive, noisy, pair, simulated

import motorid as mi
from motorid.errors import DataError, ModelError, UsageError
from motorid.estimation.least_squares import RACE, least_squares
from motorid.exporters.casadi_file import functions_of, runs_of
from motorid.problem.problem import as_problem
from motorid.problem.runs import initial_state, time_since, top_acceleration
from motorid.problem.simulate import simulate
from motorid.records.experiment import windows

TRUE = mi.dc_motor(**VALUES)


@pytest.fixture
def runs(rng):
    return pair(rng)


def holed(run, channel, rng, share=0.3):
    y = np.array(run.outputs[channel])
    y[rng.random(run.n) < share] = np.nan
    return run.with_(outputs={**run.outputs, channel: y})


# -- inputs --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("shape", ["sine", "steps"])
def test_over_a_few_samples_left_out_a_voltage_goes_on_as_evenly_as_beside(shape, rng):
    t = 0.003 * np.arange(1200)
    v = 8 * np.sin(5 * t) if shape == "sine" else np.where(np.floor(t / 0.3) % 2 == 1, 6.0, 0.0)
    whole = simulated(t, v, ("theta",)).outputs["theta"]
    steps = np.flatnonzero(np.diff(v)) + 1 if shape == "steps" else []
    kept = np.setdiff1d(np.arange(1200), np.setdiff1d(rng.choice(np.arange(3, 1190), 60, replace=False), steps))
    assert 1100 < len(kept) < 1200
    run = mi.Experiment(t[kept], {"v": v[kept]}, {"theta": whole[kept]})
    theta = simulate(TRUE, run, initial="rest")[0].outputs["theta"]
    assert np.abs(theta - whole[kept]).max() < (2e-4 if shape == "sine" else 1e-6) * np.ptp(whole)
    fit = mi.fit(TRUE.fix(*TRUE.parameters).free("K"), run)
    exported = {f.name(): f for f in functions_of(fit)}
    y = np.array(exported["simulate_0"](*(exported["record_0"]()[n] for n in "sup"))[0])
    np.testing.assert_allclose(y[0], fit.simulations[0].outputs["theta"], atol=1e-9 * np.ptp(whole))


@pytest.mark.parametrize("channels", [("theta",), ("i", "omega")])
@pytest.mark.parametrize("lost", [0, -1], ids=["step", "before"])
def test_a_step_that_came_while_samples_were_left_out_is_where_the_outputs_ask_for_it(channels, lost, rng):
    t = 3e-3 * np.arange(1200)
    noise = {"theta": 0.009, "i": 0.03, "omega": 0.5}

    def record(seed):
        v = 8 * np.repeat(np.random.default_rng(seed).choice([-1.0, 0.5, 1.0], 60), 20)
        whole = simulated(t, v, channels)
        kept = np.setdiff1d(np.arange(1200), np.flatnonzero(np.diff(v))[4::6] + 1 + lost)
        assert 1180 < len(kept) < 1196
        return mi.Experiment(t[kept], {"v": v[kept]}, {
            c: y[kept] + noise[c] * rng.standard_normal(len(kept)) for c, y in whole.outputs.items()})

    other = {c: y for c, y in record(3).outputs.items() if c != "i"}  # not all channels in every run
    fit, check = mi.fit(mi.dc_motor(), [record(1), record(3).with_(outputs=other)]), record(2)
    assert all(misfit < 1.15 for misfit in fit.misfit.values()), fit.misfit
    # A ramp of the same mean stands for a step between samples: one sample of the current, after each, shows that.
    assert all(e < 1.3 * noise[c] for c, e in mi.evaluate(fit, [check]).rmse.items() if c != "i" or lost)
    placed = np.count_nonzero(fit.problem.runs[0].grid.way)
    assert placed == 0 if lost else placed >= 5
    exported = {f.name(): f for f in functions_of(fit)}
    y = np.array(exported["simulate_0"](*(exported["record_0"]()[n] for n in "sup"))[0])
    for c, row in zip(fit.problem.outputs, y, strict=True):
        np.testing.assert_allclose(row, fit.simulations[0].outputs[c], atol=1e-9 * np.ptp(row))


# -- residuals -----------------------------------------------------------------------------------------------
def test_at_the_truth_the_residual_is_white_noise_of_size_one(runs):
    problem = as_problem(TRUE, runs)
    r = problem.refined(problem.start).residual(problem.start)
    assert len(r) == problem.n_outputs == 2 * 2 * 500
    assert np.std(r) == pytest.approx(1.0, abs=0.1)
    assert abs(np.mean(r)) < 0.1


def test_missing_samples_are_left_out_and_nothing_else_changes(runs, rng):
    gaps = [holed(r, "i", rng) for r in runs]
    whole, part = as_problem(TRUE, runs), as_problem(TRUE, gaps)
    sigma = [run.sigma for run in whole.runs]
    part = replace(part, _runs=tuple(replace(r, sigma=s) for r, s in zip(part.runs, sigma, strict=True)))
    q = whole.start + 0.05
    r, jac = whole.residual_and_jacobian(q)
    r2, jac2 = part.residual_and_jacobian(q)
    there = np.concatenate(
        [np.isfinite(np.column_stack([g.outputs["i"], g.outputs["omega"]])).ravel() for g in gaps]
    )
    assert part.n_outputs == there.sum() < whole.n_outputs
    assert np.array_equal(r2, r[there])
    assert np.array_equal(jac2, jac[there])


def test_runs_may_lack_different_channels(runs):
    first, second = runs[0].without("omega"), runs[1].without("i")
    problem = as_problem(TRUE, [first, second])
    assert problem.outputs == ("i", "omega")
    assert problem.n_outputs == 1000
    both = as_problem(TRUE, runs)
    r, whole = problem.residual(problem.start), both.residual(both.start).reshape(2, 500, 2)
    scale = [both.runs[k].sigma[c] / problem.runs[k].sigma[c] for k, c in ((0, "i"), (1, "omega"))]
    assert r[:500] == pytest.approx(whole[0, :, 0] * scale[0], abs=1e-9)
    assert r[500:] == pytest.approx(whole[1, :, 1] * scale[1], abs=1e-9)
    assert mi.check_derivatives(problem).ok


def test_noise_that_is_stated_counts_and_noise_that_is_not_is_estimated(runs):
    stated = [r.with_(sigma={"i": 0.1}) for r in runs]
    problem = as_problem(TRUE, stated)
    assert [r.sigma["i"] for r in problem.runs] == [0.1, 0.1]
    assert problem.runs[0].sigma["omega"] == pytest.approx(NOISE["omega"], rel=0.1)
    one = as_problem(TRUE, [stated[0], runs[1]])
    assert one.runs[0].sigma["i"] == 0.1


def test_weights_by_rms_make_channels_count_alike(runs):
    problem = as_problem(TRUE, runs, weights="rms")
    problem = problem.refined(problem.start)
    r = problem.residual(problem.start)
    sim = mi.simulate(TRUE, runs[0])[0]
    expected = (sim.outputs["omega"] - runs[0].outputs["omega"]) / np.sqrt(
        np.mean(runs[0].outputs["omega"] ** 2)
    )
    assert r[1:1000:2] == pytest.approx(expected, abs=1e-5)


# -- priors and loss -----------------------------------------------------------------------------------------
def test_a_prior_is_one_more_residual_in_standard_deviations(runs):
    priors = {"R": (1.0, 0.1), "J": (2e-5, 1e-6)}
    problem = as_problem(TRUE, runs, priors=priors)
    r, jac = problem.residual_and_jacobian(problem.start)
    assert len(r) == problem.n_outputs + 2
    assert r[-2:] == pytest.approx([(1.38 - 1.0) / 0.1, 3.5])
    names = [p.name for p in problem.unknown]
    slopes = jac[-2:] / problem.scaling.slope(problem.start)
    assert slopes[0, names.index("R")] == pytest.approx(10.0)
    assert slopes[1, names.index("J")] == pytest.approx(1e6)
    assert np.count_nonzero(slopes) == 2


def test_a_prior_on_a_held_parameter_is_no_residual(runs):
    problem = as_problem(TRUE.fix("R"), runs, priors={"R": (1.0, 0.1)})
    assert len(problem.residual(problem.start)) == problem.n_outputs


def test_huber_is_quadratic_inside_linear_outside_and_its_derivative_is_right():
    huber = mi.Huber(delta=1.5)
    r = np.linspace(-6, 6, 241)
    pseudo, slope = huber.pseudo(r)
    rho = np.where(np.abs(r) <= 1.5, r**2 / 2, 1.5 * np.abs(r) - 1.5**2 / 2)
    assert pseudo**2 / 2 == pytest.approx(rho, abs=1e-12)
    assert np.all(np.sign(pseudo) == np.sign(r))
    h = 1e-6
    numeric = (huber.pseudo(r + h)[0] - huber.pseudo(r - h)[0]) / (2 * h)
    assert slope == pytest.approx(numeric, abs=1e-5)


def test_the_loss_acts_on_outputs_and_not_on_priors(runs):
    plain = as_problem(TRUE, runs, priors={"R": (1.0, 0.01)})
    robust = replace(plain, loss=mi.Huber())
    r, r2 = plain.residual(plain.start), robust.residual(robust.start)
    assert r2[-1] == r[-1] == pytest.approx(38)
    far = np.abs(r[:-1]) > 1.345
    assert far.any()
    assert np.array_equal(r2[:-1][~far], r[:-1][~far])
    assert (np.abs(r2[:-1][far]) < np.abs(r[:-1][far])).all()


# -- coordinates ---------------------------------------------------------------------------------------------
def test_a_linear_parameter_is_measured_in_natural_sizes_so_zero_may_be_a_start(runs):
    model = TRUE + mi.effects.constant_load(tau_0=0.0) + mi.effects.quadratic_drag
    problem = as_problem(model, runs)
    size = dict(zip([p.name for p in problem.unknown], problem.scaling.scale, strict=True))
    assert size["R"] == 1.38
    assert 0.05 < size["tau_0"] < 1.0  # what the motor makes at its highest current, N·m
    assert 1e-6 < size["c_2"] < 1e-4
    assert problem.values(problem.start) == pytest.approx(problem.model.values)


def test_values_and_simulation_follow_the_coordinates(runs):
    problem = as_problem(TRUE.fix("L"), runs)
    q = problem.start + np.array([np.log(2), 0, 0, 0])
    values = problem.values(q)
    assert values["R"] == pytest.approx(2 * 1.38)
    assert values["L"] == VALUES["L"]
    there = problem.refined(q).simulate(q, 1, derivatives=False)
    model = TRUE.replace(R=2 * 1.38)
    assert there.y[:, 1] == pytest.approx(mi.simulate(model, runs[1])[0].outputs["omega"], abs=0.05)
    assert there.dy is None
    assert problem.simulate(q, 1).dy.shape == (500, 2, 4)


# -- how records begin ---------------------------------------------------------------------------------------
def moving(rng, channels=("i", "omega", "theta")):
    t = np.arange(800) * 1e-3
    whole = noisy(simulated(t, drive(t, 6.0), channels), rng)
    return whole.select(slice(300, None))


def test_a_record_from_rest_has_no_unknown_beginning(runs):
    assert [p.name for p in as_problem(TRUE, runs).unknown] == list(VALUES)


def test_a_motor_at_rest_with_the_voltage_on_from_the_first_sample_begins_at_rest(rng):
    """Slowly sampled it is in full motion at the second one; where the speed was not measured that says nothing."""
    t = np.arange(400) * 4e-3
    run = noisy(simulated(t, np.where(t < 0.8, 6.0, -4.0)), rng)
    assert run.outputs["i"][1] > 0.5 * np.max(run.outputs["i"])
    assert [p.name for p in as_problem(TRUE, run).unknown] == list(VALUES)
    assert len(as_problem(TRUE, run.without("omega")).unknown) > len(VALUES)


@pytest.mark.parametrize(
    ("initial", "names"),
    [
        ("auto", ["i_0[0]", "omega_0[0]", "theta_0[0]"]),
        ("estimate", ["i_0[0]", "omega_0[0]", "theta_0[0]"]),
        ("measured", []),
        ("rest", []),
    ],
)
def test_a_record_that_begins_in_motion(rng, initial, names):
    run = moving(rng)
    problem = as_problem(TRUE, run, initial=initial)
    assert [p.name for p in problem.unknown[5:]] == names
    start = problem.runs[0].start
    if initial == "rest":
        assert start[:2] == pytest.approx([0, 0])
    else:
        assert start == pytest.approx([run.outputs[c][0] for c in ("i", "omega", "theta")], abs=1.5)
    if initial == "auto":  # within what the first samples allow, so that it hides nothing
        low, high = problem.scaling.bounds
        assert np.isfinite([low[5:], high[5:]]).all()
        assert (problem.start[5:] > low[5:]).all()


def test_the_speed_at_the_start_may_come_from_the_angle_alone(rng):
    run = moving(rng, ("theta",))
    problem = as_problem(TRUE, run)
    found = {p.name: p.value for p in problem.unknown[5:]}
    assert set(found) == {"i_0[0]", "omega_0[0]", "theta_0[0]"}  # a moving motor has a current, measured or not
    assert found["omega_0[0]"] == pytest.approx(
        simulated(np.arange(800) * 1e-3, drive(np.arange(800) * 1e-3, 6.0)).outputs["omega"][300], rel=0.1
    )


def test_the_speed_at_the_start_is_estimated_where_the_current_alone_is_measured(rng):
    """Taken to be none, a plain motor's current was 19 times its noise away."""
    run = moving(rng, ("i",))
    assert [p.name for p in as_problem(TRUE, run).unknown[5:]] == ["i_0[0]", "omega_0[0]"]
    fit = mi.fit(mi.dc_motor(K=VALUES["K"]).fix("K"), run)
    assert fit.misfit["i"] < 1.05
    t = np.arange(800) * 1e-3
    true = simulated(t, drive(t, 6.0)).outputs["omega"][300]
    assert fit.initial["omega_0[0]"] == pytest.approx(true, rel=0.05)
    still = simulated(t, drive(t, 6.0), ("i",))
    assert [p.name for p in as_problem(TRUE, still).unknown] == list(VALUES)  # one that begins at rest does so
    running = still.select(slice(400, None)).with_(sigma={"i": 0.05})  # at a current within its noise, the voltage on
    assert [p.name for p in as_problem(TRUE, running).unknown[5:]] == ["i_0[0]", "omega_0[0]"]


def test_a_first_current_that_was_not_measured_accelerates_no_more_than_the_records_show(rng):
    """With next to no inductance 189 A through a megohm were but a kick at the start, which hid the inductance."""
    run = moving(rng, ("omega",))
    problem = mi.Problem(TRUE, [run])
    [current] = [p for p in problem.unknown if p.name == "i_0[0]"]
    assert (current.unit, current.lower, current.upper) == ("rad/s²", -top_acceleration([run]), top_acceleration([run]))
    names, values = [p.name for p in problem.unknown], [p.value for p in problem.unknown]
    assert problem.scaling.scale[names.index("i_0[0]")] == current.upper  # its natural size: steps of 1 are none
    values[names.index("i_0[0]")] = 150.0
    q, drag = problem.scaling.scaled(values), VALUES["b"] * values[names.index("omega_0[0]")]
    assert problem.simulate(q, 0).x[0, 0] == pytest.approx((150 * VALUES["J"] + drag) / VALUES["K"])
    assert mi.check_derivatives(problem.refined(q), q, tolerance=1e-5).ok
    rubbing = mi.Problem(TRUE + mi.effects.coulomb(tau_c=5e-3), [run])
    [current_of_that] = [p for p in rubbing.unknown if p.name == "i_0[0]"]  # what a load takes accelerates nothing
    assert current_of_that.upper == pytest.approx(current.upper + 5e-3 / VALUES["J"])
    fit = mi.fit(mi.dc_motor(), run)
    assert fit.misfit["omega"] < 1.1
    assert fit.values["R"] < 1e3
    [(_, first, _)] = runs_of(fit.problem, fit.q)  # as it is exported
    assert first[:2] == pytest.approx([fit.simulations[0].states[c][0] for c in ("i", "omega")], rel=1e-6)


def test_the_largest_acceleration_is_seen_in_speed_or_angle():
    t = np.arange(2000) * 1e-3
    omega = 30 * np.sin(5 * t)
    fast, angle = (mi.Experiment(t, {"v": t}, y) for y in ({"omega": omega}, {"theta": -6 * np.cos(5 * t)}))
    assert top_acceleration([fast]) == pytest.approx(150, rel=0.02)
    assert top_acceleration([angle]) == pytest.approx(150, rel=0.02)
    assert top_acceleration([fast, angle.with_(outputs={"theta": 0 * t})]) == pytest.approx(150, rel=0.02)
    assert top_acceleration([]) == 0.0


def test_a_speed_of_half_the_largest_is_no_rest_however_noisy_the_sensor(rng):
    t = np.arange(300) * 0.01
    omega = 50 + 12 * rng.standard_normal(300)
    run = mi.Experiment(t, {"v": np.full(300, 6.0)}, {"omega": omega, "theta": 50 * t}, name="going")
    begun = mi.Problem(mi.dc_motor(), [run]).runs[0]
    assert abs(begun.start[1] - 50) < 40


def test_a_first_speed_is_not_looked_for_across_a_turn_of_the_motor():
    """Of 100 lines it lay outside what the fit allowed, and a plain motor's angle showed 1.3 times its noise."""
    t, line = np.arange(2000) * 2.4e-3, 2 * np.pi / 100
    motor = mi.dc_motor(R=1.22, L=1.06e-3, K=0.247, b=1.5e-3, J=2.7e-3)
    v = np.where(np.arange(2000) // 60 % 2, -9.0, 4.3)
    clean = mi.simulate(motor, mi.Experiment(t, {"v": v}, dict.fromkeys(("omega", "theta"), 0 * t)), initial="rest")[0]
    begin = 120 + int(np.argmin(np.abs(clean.outputs["omega"][120:180] + 9)))  # -9 rad/s, turning round
    counts = line * np.floor(clean.outputs["theta"][begin:] / line)
    run = mi.Experiment(t[begin:] - t[begin], {"v": v[begin:]}, {"theta": counts - counts[0]})
    low, high = initial_state(run, {"theta": line / np.sqrt(12)}, "auto")[1]["omega"]
    assert low < clean.outputs["omega"][begin] < high
    assert mi.fit(mi.dc_motor(), run).misfit["theta"] < 1.1


def test_a_record_that_begins_at_rest_may_do_so_however_few_counts_tell_its_first_speed(rng):
    """A quick start under 256 counts a turn: the speed that the first counts suggest is no limit."""
    t = 2e-3 * np.arange(3000)
    v = np.where(t < 0.004, 0.0, -3 * np.cos(3 * t))
    motor = mi.dc_motor(R=1.71, L=8.6e-4, K=0.915, b=4.2e-3, J=0.0164)
    clean = mi.simulate(motor, mi.Experiment(t, {"v": v}, {"i": 0 * t, "theta": 0 * t}), initial="rest")[0].outputs
    step = 2 * np.pi / 256
    run = mi.Experiment(t, {"v": v}, {"i": clean["i"] + 6e-3 * rng.normal(size=3000),
                                      "theta": step * np.round(clean["theta"] / step)})
    _, limits = initial_state(run, {"i": 6e-3, "theta": step / np.sqrt(12)}, "auto")
    low, high = limits["omega"]
    assert low <= 0 <= high
    assert mi.evaluate(motor, run).rmse["i"] < 6.5e-3


def test_a_motor_that_comes_to_rest_before_the_first_voltage_begins_in_motion(rng):
    """Over all of the time without a voltage its median speed is next to zero."""
    t = np.arange(1200) * 1e-3
    v = np.where(t < 0.3, 6.0, np.where(t < 0.8, 0.0, 4.0))
    whole = noisy(simulated(t, v, ("i", "omega")), rng)
    run = whole.select(slice(300, None))
    assert abs(np.median(run.outputs["omega"][:500])) < 0.01 * run.outputs["omega"][0]
    assert [p.name for p in as_problem(TRUE, run).unknown[5:]] == ["i_0[0]", "omega_0[0]"]
    assert mi.evaluate(TRUE, run).rmse["omega"] < 1.1 * mi.evaluate(TRUE, whole).rmse["omega"]
    windowed = mi.fit(mi.dc_motor(), whole, window=0.3)  # one of them begins where the voltage falls to zero
    assert max(windowed.misfit.values()) < 1.1
    shorter = whole.select(slice(300, 800))  # nothing but the way to rest
    assert mi.simulate(TRUE, shorter)[0].outputs["omega"][0] == pytest.approx(whole.outputs["omega"][300], rel=0.05)


def test_a_slow_start_that_an_encoder_counts_is_motion_and_rest_is_rest(rng):
    """A controller holds a motor at a crawl, 0.4 % of its highest speed: taken as rest that is 20 counts wrong."""
    count = 2 * np.pi / 4000
    t = np.arange(1500) * 1e-3
    whole = simulated(t, np.where(t < 0.2, 0.0, np.where(t < 0.5, 0.03, 6.0)), ("i", "omega", "theta"))
    outputs = {"i": whole.outputs["i"] + rng.normal(0, 0.01, len(t)),
               "theta": np.round(whole.outputs["theta"] / count) * count}
    counted = whole.with_(outputs=outputs)
    crawl, rest = counted.select(slice(400, None)), counted.select(slice(100, None))
    assert 0 < whole.outputs["omega"][400] < 0.005 * np.max(whole.outputs["omega"])
    assert {p.name for p in as_problem(TRUE, rest).unknown} <= {*VALUES, "theta_0[0]"}
    assert "omega_0[0]" in {p.name for p in as_problem(TRUE, holed(crawl, "theta", rng)).unknown}
    found = mi.fit(TRUE, crawl)
    assert found.initial["omega_0[0]"] == pytest.approx(whole.outputs["omega"][400], rel=0.2)
    assert found.misfit["theta"] < 1.3


def test_what_runs_out_before_the_first_voltage_is_in_motion(rng):
    """A part that began in the last slow turns of a motor running out was taken for one at rest: 27 times the noise."""
    count, t = 2 * np.pi / 4000, np.arange(2500) * 1e-3
    whole = simulated(t, np.where(t < 0.5, 8.0, np.where(t < 2.0, 0.0, -6.0)), ("i", "omega", "theta"))
    outputs = {"i": whole.outputs["i"] + rng.normal(0, 0.01, len(t)),
               "theta": np.round(whole.outputs["theta"] / count) * count}
    slow = int(np.argmax((t > 0.5) & (whole.outputs["omega"] < 0.02 * np.max(whole.outputs["omega"]))))
    found = mi.fit(TRUE, whole.with_(outputs=outputs).select(slice(slow, None)))
    assert found.initial["omega_0[0]"] == pytest.approx(whole.outputs["omega"][slow], rel=0.2)
    assert found.misfit["theta"] < 1.3


def test_an_angle_that_is_not_measured_starts_at_zero_and_is_no_unknown(runs):
    problem = as_problem(TRUE + mi.effects.gravity, runs)
    assert "theta" in problem.system.states
    assert all("theta_0" not in p.name for p in problem.unknown)


# -- sub-steps -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("engine", ["rosenbrock", "cvodes"])
def test_a_run_is_differentiated_by_what_it_depends_on_alone(runs, engine, monkeypatch):
    """Of many runs with initial states, or a zero each, the unknowns of all others cost as much as its own."""
    model = TRUE + mi.effects.gravity + mi.effects.encoder_zero
    problem = as_problem(model.start_at({"tau_g": 2e-3}), runs, initial="estimate", engine=engine)
    own = [len(problem.model.free_names) + 2 + k for k in range(2)]  # the first run's zero is that of the angle
    widths, integrator = [], problem.integrator
    integrate = type(integrator).run
    monkeypatch.setattr(type(integrator), "run", lambda self, system, grid, x0, p, *slopes, **kw: (
        widths.append(slopes[1].shape[1] if slopes else 0), integrate(self, system, grid, x0, p, *slopes, **kw))[1])
    jac = problem.jacobian(problem.start)
    assert widths == own
    assert jac.shape[1] == len(problem.unknown) > max(own)
    for j, p in enumerate(problem.unknown):
        step = 1e-3 * (np.arange(len(problem.unknown)) == j)
        slope = (problem.residual(problem.start + step) - problem.residual(problem.start - step)) / 2e-3
        assert np.allclose(jac[:, j], slope, atol=1e-2 * max(np.abs(slope).max(), 1.0)), p.name


def test_a_run_without_an_unknown_of_its_own_has_no_slopes(runs):
    held = TRUE.fix(*TRUE.free_names)
    problem = as_problem(held, [runs[0], runs[1].select(slice(250, None))])
    jac, n = problem.jacobian(problem.start), problem.measured[0].size
    assert {run for _, run, _ in problem.unknowns.initial} == {1}
    assert not jac[:n].any()
    assert np.linalg.norm(jac[n:], axis=0).all()


def test_refined_keeps_the_integration_error_well_below_the_noise(runs):
    from motorid.problem.simulate import integration_error

    coarse = as_problem(TRUE, runs)
    fine = coarse.refined(coarse.start)
    assert integration_error(coarse, coarse.start) > 0.5  # L/R is about one sample
    assert integration_error(fine, fine.start) < 0.1
    assert fine.fine_enough(fine.start)
    assert not coarse.fine_enough(coarse.start)
    assert fine.refined(fine.start).runs[0] is fine.runs[0]


@pytest.mark.parametrize("quiet", [0.1, 1e-3])
def test_less_noise_asks_for_finer_steps(rng, quiet):
    from motorid.problem.simulate import integration_error

    noise = {c: s * quiet for c, s in NOISE.items()}
    t = np.arange(500) * 1e-3
    problem = as_problem(TRUE, noisy(simulated(t, drive(t, 6.0)), rng, noise).with_(sigma=noise))
    loud = problem.with_(experiments=(problem.experiments[0].with_(sigma=NOISE),))
    fine, rough = (p.refined(p.start) for p in (problem, loud))
    further = [(p.runs[0].grid.substeps - 1).sum() for p in (fine, rough)]
    assert further[0] > 2 * further[1]
    if quiet > 0.01:  # the records were themselves simulated to a few millionths
        assert integration_error(fine, fine.start) < 0.2


def test_a_misfit_far_above_the_noise_spares_steps(rng):
    quiet = {c: 1e-3 * s for c, s in NOISE.items()}
    t = np.arange(500) * 1e-3
    problem = as_problem(TRUE, noisy(simulated(t, drive(t, 6.0)), rng, quiet).with_(sigma=quiet))
    wrong = problem.for_model(TRUE.replace(K=0.06))
    further = [(p.refined(p.start).runs[0].grid.substeps - 1).sum() for p in (problem, wrong)]
    assert further[1] < 0.2 * further[0]


def test_an_angle_of_many_turns_asks_of_other_states_what_it_shows_of_them(rng):
    """An encoder knows a millionth of its travel, and nothing like it of a current; where a torque follows the angle,
    a small error may grow."""
    from motorid.problem.simulate import integration_error

    t, noise = np.arange(1500) * 1e-3, {**NOISE, "theta": 1e-3}
    run = noisy(simulated(t, drive(t, 6.0), channels=("i", "omega", "theta")), rng, noise).with_(sigma=noise)
    problem = as_problem(TRUE, run)
    spring = TRUE + mi.effects.spring(k_s=0.0)
    further = [(p.refined(p.start).runs[0].grid.substeps - 1).sum() for p in (
        problem, problem.for_model(spring), problem.with_(experiments=(run.without("theta"),)))]
    assert further[2] < 1.1 * further[0] < 0.5 * further[1]
    assert integration_error(problem.refined(problem.start), problem.start) < 0.1


def test_a_plan_is_as_exact_as_the_noise_that_it_states():
    motor = mi.torque_driven(g=0.05, b=2e-4, J=5e-5)
    model = motor + mi.effects.coulomb(tau_c=4e-3) + mi.effects.gravity(mgl=5e-3, phi_g=0.3)
    model = model.replace(sgn_width=1e-2)  # the same however fast the plan is
    sigma = {"omega": 0.3, "theta": 5e-3}
    t = np.arange(0, 1, 1e-3)
    volts = np.random.default_rng(1).uniform(-3, 3, 12)
    plan = mi.planned(model, t, volts[np.arange(1000) * 12 // 1000], channels=tuple(sigma), sigma=sigma)
    quiet = plan.with_(sigma={c: 1e-3 * s for c, s in sigma.items()})
    exact = simulate(model, quiet, initial="rest", engine="cvodes")[0]
    for c, s in sigma.items():
        assert np.abs(exact.residual(c)).max() < 0.1 * s


def test_a_plan_of_a_slow_axis_has_a_sgn_for_its_speeds():
    model = mi.torque_driven(axis="linear", g=10.0, b=5.0, J=2.0) + mi.effects.coulomb(tau_c=8.0)
    t = np.arange(0, 1, 1e-3)
    plan = mi.planned(model, t, np.where(t < 0.02, 0.0, 0.85 * np.sign(np.sin(6 * np.pi * t))), channels=["omega"])
    exact = simulate(model.replace(sgn_width=1e-5), plan, initial="rest", engine="cvodes")[0]
    assert np.abs(exact.residual("omega")).max() < 0.01 * np.abs(exact.outputs["omega"]).max()


def test_a_slow_motor_of_which_the_current_alone_was_measured_has_a_sgn_for_its_speeds():
    model = mi.dc_motor(R=1.2, L=1e-3, K=30.0, b=3.0, J=20.0) + mi.effects.coulomb(tau_c=8.0)
    t = np.arange(0, 1, 1e-3)
    volts = np.random.default_rng(1).uniform(-3, 3, 12)[np.arange(1000) * 12 // 1000]
    run = mi.planned(model.replace(sgn_width=2e-5), t, volts, channels=["i"])
    assert mi.evaluate(model, run).nrmse["i"] < 2e-3
    plan = mi.planned(model, t, volts, channels=["i"])
    assert np.allclose(plan.outputs["i"], run.outputs["i"], rtol=0, atol=run.sigma["i"])
    narrow = model.start_at({"sgn_width": 1e-5})  # a fit of these records chose it
    assert as_problem(narrow, run).model.values["sgn_width"] == 1e-5
    fast = as_problem(model.start_at({"K": 0.03}), run)
    assert fast.model.values["sgn_width"] == 0.01


def test_a_problem_for_another_model_keeps_noise_and_beginnings(runs):
    problem = as_problem(TRUE, runs)
    other = problem.for_model(TRUE + mi.effects.coulomb)
    assert other.runs == problem.runs
    assert other.model.effect_names == ("coulomb",)
    assert problem.with_(initial="estimate").runs[0].limits.keys() == {"i", "omega"}


def test_a_problem_travels_to_another_process(runs):
    problem = as_problem(TRUE + mi.effects.coulomb, runs, priors={"R": (1.3, 0.1)}, loss=mi.Huber())
    problem = problem.refined(problem.start)
    expected = problem.residual(problem.start)
    there = pickle.loads(pickle.dumps(problem))
    assert there.residual(there.start) == pytest.approx(expected, abs=1e-12)


# -- refused -------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"weights": "sigma"}, UsageError, "unknown weights 'sigma'"),
        ({"initial": "standstill"}, UsageError, "unknown initial state"),
        ({"engine": "rk4"}, UsageError, "unknown engine 'rk4'.*Known: rosenbrock"),
        ({"priors": {"r": (1, 1)}}, UsageError, "prior: unknown parameter 'r'"),
    ],
)
def test_unknown_words_are_answered_with_the_known_ones(runs, options, error, words):
    def work():
        problem = as_problem(TRUE, runs, **options)
        problem.residual(problem.start)

    with pytest.raises(error, match=words):
        work()


@pytest.mark.parametrize("records", [[], ["run.csv"]])
def test_records_must_be_experiments(records):
    with pytest.raises(UsageError, match=r"mi\.read_runs"):
        as_problem(TRUE, records)


def test_a_torque_drive_cannot_explain_a_current(runs):
    only = [r.without("omega") for r in runs]
    with pytest.raises(ModelError, match=r"at least one of i, omega, theta"):
        as_problem(mi.torque_driven(), only)


def test_a_record_without_any_output_is_no_record(runs):
    with pytest.raises(DataError):
        runs[0].without("i", "omega")


def test_an_offset_of_the_speed_sensor_does_not_set_the_first_speed_where_an_angle_denies_it():
    """A motor that stands still by its encoder, and turns by its tachometer: the fit may begin at rest."""
    t = 1e-3 * np.arange(400)
    blank = mi.Experiment(t, {"v": 3 * np.sign(np.sin(20 * t))}, {c: np.zeros(400) for c in ("i", "omega", "theta")},
                          sigma={"i": 0.01, "omega": 0.5, "theta": 1e-3})
    clean = simulate(TRUE, blank, initial="rest", estimate_initial=False)[0].outputs
    fit = mi.fit(mi.dc_motor(), blank.with_(outputs={**clean, "omega": clean["omega"] + 40.0}))
    assert fit.values["R"] == pytest.approx(VALUES["R"], rel=0.02)
    assert fit.misfit["theta"] < 0.1
    assert abs(fit.initial["omega_0[0]"]) < 0.5


def test_the_first_angle_of_the_finest_encoder_is_estimated():
    """An encoder that counts down to whole counts is half a count off; over a hundred turns that shows."""
    t = np.arange(2000) * 1e-3
    bare = mi.Experiment(t, {"v": np.where(t < 1.0, 10.0, 4.0)}, {"theta": np.zeros(2000)})
    model = mi.dc_motor(R=1.0, L=1e-3, K=0.05, b=1e-5, J=1e-5)
    angle, count = mi.simulate(model, bare, initial="rest")[0].outputs["theta"], 2 * np.pi / 65536
    fit = mi.fit(mi.dc_motor().fix(R=1.0, L=1e-3), bare.with_(outputs={"theta": count * np.floor(angle / count)}))
    assert np.ptp(angle) > 1e5 * count
    assert fit.initial["theta_0[0]"] == pytest.approx(-0.5 * count, rel=0.1)
    assert fit.misfit["theta"] < 1.1


@pytest.mark.parametrize("unit", ["A", "N·m", "N"])
def test_a_commanded_current_or_torque_is_no_voltage(unit):
    t = np.arange(50) * 1e-2
    run = mi.Experiment(t, {"v": np.ones(50)}, {"omega": t}, units={"v": unit})
    with pytest.raises(mi.ModelError, match=rf"v is in {unit}.*torque_driven"):
        mi.Problem(mi.dc_motor(), [run])
    mi.Problem(mi.torque_driven(), [run])


@pytest.mark.parametrize("units", [{"theta": "m"}, {"omega": "m/s"}])
def test_records_in_metres_are_none_of_a_drive_that_turns(units):
    t = np.arange(50) * 1e-2
    run = mi.Experiment(t, {"v": np.ones(50)}, dict.fromkeys(units, t), units=units)
    with pytest.raises(mi.ModelError, match=r"metres.*torque_driven\(axis='linear'\)"):
        mi.Problem(mi.torque_driven(), [run])
    assert mi.Problem(mi.torque_driven(axis="linear"), [run]).outputs == tuple(units)


def test_a_fit_keeps_the_trajectories_of_where_it_is_alone():
    """Not of all sub-steps on its way, and of a window those by its own states: else windows fill the memory."""
    run = pair(np.random.default_rng(2))[0]
    parts = windows(run, run.duration / 10)
    problem = as_problem(mi.dc_motor(R=20.0, K=0.2, J=1e-3), parts)
    end, links, there = least_squares(problem, RACE).problem, 0, problem
    while (known := there._latest.get("refined")) is not None:
        links, there = links + 1, known[1]
    assert links <= 2
    assert end.simulate(end.start, 3).dx.shape[2] == len(end.unknown)
    assert end._latest[3][1].dx.shape[2] < len(end.unknown) / 2


def test_a_voltage_that_is_averaged_over_longer_steps_has_not_changed():
    """Their mean rounds, and a firmware that saves power had nothing that it could depend on."""
    t = np.linspace(0, 4, 4001)
    run = mi.Experiment(t, {"v": np.repeat([0.0, 6.1, -7.2, 3.3], 1002)[:4001]}, {"omega": 0 * t})
    thin = time_since(run.decimate(3), "since_change")
    assert thin == pytest.approx(time_since(run, "since_change")[::3], abs=4e-3)
    assert thin[767] == pytest.approx(0.3, abs=4e-3)
