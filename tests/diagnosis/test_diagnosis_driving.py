"""How the voltage is read: held or straight between samples, as commanded or measured with noise."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest
from battery.excite import P
from command import motorid_json

import motorid as mi
from motorid.channels import channel_name
from motorid.diagnosis import record_versions as readings
from motorid.diagnosis import stepwise
from motorid.diagnosis.record_versions import better_reading
from motorid.display.numbers import number
from motorid.records.checks import contradictions, dead_times
from motorid.records.reading import write_csv

FINE = 8  # steps of the plant per sample


def recorded(motor, effects, v, dt, rng, measured=0.0, name="run"):
    """A record of what the plant does under the voltage `v` at every fine step, read once per sample."""
    t = dt / FINE * np.arange(len(v))
    s = P.simulate(motor, effects, t, v)
    i, omega, t, v = s["i"][::FINE], s["omega"][::FINE], t[::FINE], v[::FINE]
    noisy = {"i": i + rng.normal(0, 0.01, t.size), "omega": omega + rng.normal(0, 0.2, t.size)}
    return mi.Experiment(t, {"v": v + measured * rng.normal(size=t.size)}, noisy, name=name)


def waves(n, dt, rng):
    """A smooth voltage at every fine step."""
    t = dt / FINE * np.arange(FINE * n)
    return sum(2.2 * np.sin(2 * np.pi * f * t + p) for f, p in zip((1.7, 6.1, 17.0), rng.uniform(0, 6, 3), strict=True))


def stairs(n, rng):
    """A voltage that is held for 150 samples at a time."""
    return np.repeat(rng.uniform(-6, 6, n // 150), 150 * FINE)


@pytest.mark.parametrize("alias", [False, True])
def test_a_command_that_changes_faster_than_its_log_is_not_taken_for_noise_of_its_measurement(alias):
    """Of a bench that plays noise at 8 kHz and logs every 43rd sample of it, and steps."""
    rng, n = np.random.default_rng(2), 900
    noise = rng.uniform(-0.5, 0.5, 43 * n) if alias else np.repeat(np.repeat(rng.uniform(-3, 3, n // 150), 150) + (
        0.05 * rng.normal(size=n)), 43)
    runs = []
    for v in (noise, np.repeat([0.0, 0.3, -0.3, 0.0], 43 * n // 4)):
        speed = np.zeros(len(v))
        for k in range(1, len(v)):
            speed[k] = speed[k - 1] + (100 * v[k - 1] - speed[k - 1]) / 80
        t, y = 125e-6 * np.arange(n) * 43, speed[::43]
        runs.append(mi.Experiment(t, {"v": v[::43]}, {"omega": y + 0.1 * rng.normal(size=n)}))
    assert "--levels" in {reading.option for reading in readings._readings(runs)}
    if alias:
        assert better_reading(mi.fit(mi.dc_motor(), runs)) is None


def test_an_amplifier_s_voltage_goes_on_between_samples(lab):
    """Read as held it is half a sample late, which lags and heating would make up for."""
    rng = np.random.default_rng(3)
    runs = [recorded(lab, {}, waves(1200, 2e-3, rng), 2e-3, rng) for _ in range(3)]
    fit = mi.fit(mi.dc_motor(), runs[:2])
    read_so = mi.fit(mi.dc_motor(), [r.with_(hold="linear") for r in runs[:2]])
    assert max(fit.nrmse.values()) > 1.3 * max(read_so.nrmse.values())
    found = mi.diagnose(fit, runs[2:], effects=("speed_lag", "winding_heating"))
    assert found.verdict == "adequate"
    assert "--hold linear" in found.text
    first = found.ladder.rungs[0].fit
    assert first.problem.experiments[0].hold == "linear"
    assert better_reading(first) is None


def test_noise_of_a_measured_voltage_is_no_effect(lab):
    rng = np.random.default_rng(4)
    friction = {"coulomb": {"tau_c": 0.008}}
    runs = [recorded(lab, friction, stairs(1500, rng), 1e-3, rng, measured=0.08) for _ in range(3)]
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs[:2]), runs[2:], effects=("coulomb", "brush_drop", "quadratic_drag"))
    assert found.effects == ("coulomb",)
    assert "measured with noise" in found.text
    assert found.ladder.best.values["tau_c"] == pytest.approx(0.008, rel=0.02)


@pytest.mark.parametrize("drive", ["held waves", "steps", "noise"])
def test_a_voltage_that_is_what_it_says_is_left_alone(lab, drive):
    rng = np.random.default_rng(5)
    sampled = waves(900, 2e-3, rng)[::FINE] if drive == "held waves" else 3 * rng.normal(size=900)
    v = stairs(900, rng) if drive == "steps" else np.repeat(sampled, FINE)
    fit = mi.fit(mi.dc_motor(), [recorded(lab, {}, v, 2e-3, rng)])
    assert better_reading(fit) is None


def test_a_reading_that_a_few_steps_do_not_favour_is_not_fitted_to_its_end(lab, monkeypatch):
    """What is missing is a friction: that takes its time to fit, and no reading of the voltage makes up for it."""
    rng = np.random.default_rng(7)
    runs = [recorded(lab, {"coulomb": {"tau_c": 0.008}}, waves(900, 2e-3, rng), 2e-3, rng)]
    read_so = mi.fit(mi.dc_motor(), [r.with_(hold="linear") for r in runs])
    fitted, solve = [], readings.solve
    monkeypatch.setattr(readings, "solve", lambda *args, **words: fitted.append(args) or solve(*args, **words))
    assert readings.better_reading(read_so) is None
    assert not fitted
    held = mi.fit(mi.dc_motor() + mi.effects.coulomb, runs)
    assert readings.better_reading(held) is not None
    assert fitted


def test_a_running_median_keeps_steps_and_loses_noise():
    rng, v = np.random.default_rng(6), np.repeat([0.0, 5.0, -3.0], 200)
    run = mi.Experiment(1e-3 * np.arange(600), {"v": v + rng.normal(0, 0.1, 600)}, {"omega": v}, name="run")
    quiet = run.running_median(15)
    assert np.std(quiet.inputs["v"] - v) < 0.05
    assert np.array_equal(quiet.outputs["omega"], v)
    assert abs(quiet.inputs["v"][199]) < 1 < 4 < quiet.inputs["v"][200]
    for wrong in (4, 0, 2.5):
        with pytest.raises(mi.UsageError, match="odd number of samples"):
            run.running_median(wrong)


def test_the_command_line_filters_a_voltage(tmp_path, lab):
    rng = np.random.default_rng(7)
    run = recorded(lab, {}, stairs(900, rng), 1e-3, rng, measured=0.1)
    write_csv(run, tmp_path / "run.csv")
    raw, quiet = (motorid_json(tmp_path, "fit", tmp_path / "run.csv", "--median", n)["nrmse"] for n in ("1", "15"))
    assert quiet["i"] < 0.8 * raw["i"]


# -- a voltage that is late, and spikes --------------------------------------------------------------------


def late(run, samples):
    """The record with its voltage logged `samples` before it acts."""
    v = run.inputs["v"]
    return run.with_(inputs={"v": np.concatenate([v[samples:], np.repeat(v[-1:], samples)])})


@pytest.mark.parametrize("hidden", [{}, {"coulomb": {"tau_c": 0.008}}])
def test_a_voltage_that_acts_late_is_no_effect(lab, hidden):
    rng = np.random.default_rng(7)
    runs = [late(recorded(lab, hidden, stairs(900, rng), 1e-3, rng, name=f"r{k}"), 3) for k in range(3)]
    tried = ("coulomb", "speed_delay", "current_lag")
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs[:2]), runs[2:], effects=tried)
    assert found.effects == tuple(hidden)
    assert found.remaining.adequate
    assert "acts 3 ms later than it was logged" in found.text
    assert "--delay 0.003" in found.text
    ends = [f"{channel_name(c)} {before} → {number(100 * e, 3)} %" for c, e in found.after.nrmse.items()
            for before in re.findall(rf"falls \(.*?{channel_name(c)} (\S+)", found.text)]
    assert all(text in found.text for text in ends)  # of the model with its effects, not of the one before
    assert len(ends) == 2


@pytest.mark.parametrize("differs", [False, True])
def test_a_dead_time_of_the_command_is_seen_before_friction_and_inductance_adapt_to_it(lab, differs):
    """From a computer that commands 60 ms late; it was sought among 12 samples, after a search on what looked so."""
    rng = np.random.default_rng(12)
    v = np.repeat([0.0, 6.0, 0.0, 3.0], 200 * FINE)
    runs = [recorded(lab, {"coulomb": {"tau_c": 0.008}}, v, 1e-3, rng, name=f"r{k}") for k in range(2)]
    runs = [late(run, 60 + 40 * k * differs) for k, run in enumerate(runs)]
    reading = better_reading(mi.fit(mi.dc_motor(), runs))
    assert reading is not None
    assert reading.says.startswith(f"The voltage acts 60 {'to 100 ms, another time' if differs else 'ms later than'}")
    assert reading.option == "--delay 0.06"
    assert bool(contradictions(runs)) == differs
    if differs:  # no one delay is right, and effects would imitate the rest: that is said first
        assert "60 to 100 ms, another time at each step" in contradictions(runs)
    else:
        found = mi.diagnose(mi.fit(mi.dc_motor(), runs), effects=("coulomb", "speed_delay", "driver_lag"))
        assert "--delay 0.06" in found.text
        assert found.effects == ("coulomb",)
        assert found.remaining.adequate
        assert found.after.values["L"] == pytest.approx(lab.L, rel=0.05)


@pytest.mark.parametrize(("effect", "size"), [
    ("driver_lag", {"T_v": 0.03}), ("driver_slew", {"T_r": 0.1, "V_s": 6.0, "V_w": 0.06})])
def test_what_comes_slowly_is_no_dead_time(lab, effect, size):
    rng, v = np.random.default_rng(13), np.repeat([0.0, 6.0, 0.0, 3.0], 200 * FINE)
    model = mi.dc_motor(R=1.0, L=2e-3, K=0.05, b=1e-4, J=1e-4) + mi.effects.coulomb(tau_c=0.02)
    blank = mi.Experiment(1e-3 * np.arange(800), {"v": v[::FINE]}, {"i": v[::FINE], "omega": v[::FINE]})
    shown = mi.simulate(model + getattr(mi.effects, effect)(**size), blank, initial="rest")[0].outputs
    run = blank.with_(outputs={c: y + rng.normal(0, 1e-3 * np.abs(y).max(), 800) for c, y in shown.items()})
    assert dead_times([run]) == []
    plain = blank.with_(outputs=dict(mi.simulate(model, blank, initial="rest")[0].outputs))
    assert dead_times([late(plain, 60)]) == pytest.approx(3 * [0.06], abs=2e-3)  # 3 V move the current alone


def test_a_speed_logged_with_the_step_that_caused_it_is_no_end_stop():
    """A row holds a command and the speed that it led to: the voltage acts one sample earlier, which no effect does."""
    rng, stairs = np.random.default_rng(14), np.arange(1.0, 41.0)
    v = np.tile(np.concatenate([stairs, -stairs]), 4)
    omega = 2.0 * np.sign(v) * np.maximum(np.abs(v) - 8, 0)
    runs = [mi.Experiment(np.arange(v.size), {"v": v}, {"omega": omega + rng.normal(0, 0.3, v.size)}, name=f"r{k}")
            for k in range(2)]
    tried = ("driver_dead_band", "end_stop", "coulomb", "speed_delay")
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs[:1]), runs[1:], effects=tried)
    assert "acts 1000 ms earlier than it was logged" in found.text
    assert "--delay=-1" in found.text
    assert found.ladder.rungs[0].fit.problem.experiments[0].inputs["v"][0] == v[1]
    assert "end_stop" not in found.effects
    assert found.after.nrmse["omega"] < 0.03


def test_of_a_late_speed_alone_a_late_voltage_is_named_too(lab):
    rng = np.random.default_rng(8)
    runs = [late(recorded(lab, {}, stairs(1500, rng), 1e-3, rng, name=f"r{k}"), 8).without("i") for k in range(3)]
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs[:2]), runs[2:], effects=("speed_delay", "coulomb"))
    assert found.effects == ("speed_delay",)
    assert "a voltage that acts late: --delay 0.007" in found.text  # fitted: 7.5 ms


def test_a_late_speed_is_not_taken_for_a_late_voltage(lab):
    rng = np.random.default_rng(8)
    runs = [recorded(lab, {}, stairs(1500, rng), 1e-3, rng, name=f"r{k}") for k in range(3)]
    late = [np.concatenate([np.full(4, y[0]), y[:-4]]) for y in (r.outputs["omega"] for r in runs)]  # from rest
    runs = [r.with_(outputs={**r.outputs, "omega": y}) for r, y in zip(runs, late, strict=True)]
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs[:2]), runs[2:], effects=("speed_delay", "speed_lag", "coulomb"))
    assert found.effects == ("speed_delay",)
    assert found.remaining.adequate
    assert "--delay" not in found.text


def test_a_noisy_voltage_between_steps_is_its_mean(lab):
    rng = np.random.default_rng(9)
    runs = [recorded(lab, {}, stairs(1500, rng), 1e-3, rng, measured=0.15, name=f"r{k}") for k in range(2)]
    chosen = better_reading(mi.fit(mi.dc_motor(), runs))
    assert chosen is not None
    assert chosen.option == "--levels"


def test_spikes_of_a_sensor_do_not_hide_what_is_missing(lab):
    rng = np.random.default_rng(10)
    runs = [recorded(lab, {"coulomb": {"tau_c": 0.008}}, stairs(1500, rng), 1e-3, rng, name=f"r{k}") for k in range(3)]
    spoilt = []
    for run in runs:
        i = run.outputs["i"].copy()
        at = 40 + 150 * np.arange(10) + rng.integers(0, 60, 10)
        i[at] += 60.0 * rng.choice([-1, 1], 10)
        spoilt.append(run.with_(outputs={**run.outputs, "i": i}))
    found = mi.diagnose(mi.fit(mi.dc_motor(), spoilt[:2]), spoilt[2:], effects=("coulomb", "brush_drop", "speed_lag"))
    assert found.effects == ("coulomb",)
    assert found.ladder.best.values["tau_c"] == pytest.approx(0.008, rel=0.03)
    assert "--no-spikes" in found.text
    forgiven = mi.diagnose(mi.fit(mi.dc_motor(), spoilt[:2], loss=mi.Huber()), effects=("coulomb",))
    assert "--no-spikes" not in forgiven.text
    assert "--loss huber" not in forgiven.text


def test_a_speed_averaged_over_some_samples_is_known_from_a_delay_and_a_lag(lab):
    rng = np.random.default_rng(11)
    runs = [recorded(lab, {}, stairs(1500, rng), 1e-3, rng, name=f"r{k}") for k in range(3)]
    means = [np.convolve(r.outputs["omega"], np.ones(12) / 12)[: r.n] + rng.normal(0, 1.0, r.n) for r in runs]
    mean = [r.with_(outputs={**r.outputs, "omega": y}) for r, y in zip(runs, means, strict=True)]
    tried = ("speed_lag", "speed_delay", "speed_average", "coulomb")
    found = mi.diagnose(mi.fit(mi.dc_motor(), mean[:2]), mean[2:], effects=tried)
    assert found.effects == ("speed_average",)
    assert found.after.values["T_a"] == pytest.approx(11e-3, abs=1e-3)  # from the middle of 12 samples


def switched(v, dt, full=12.0, periods=10, parts=40, R=3.0, L=2e-3, K=0.02, b=5e-6, J=2e-5, tau_c=4e-3):
    """Speed of a motor that rubs dryly, at each sample, behind a bridge that returns its current in the pauses of a PWM
    of so many periods to a sample, in so many steps each."""
    h, i, w, speeds = dt / (periods * parts), 0.0, 0.0, []
    for volts in v:
        speeds.append(w)
        sign = 1.0 if volts >= 0 else -1.0
        for k in range(periods * parts):
            if k % parts < abs(volts) / full * parts:
                i += h * (sign * full - R * i - K * w) / L
            elif i:
                falling = i + h * ((-full if i > 0 else full) - R * i - K * w) / L
                i = falling if falling * i > 0 else 0.0
            torque = K * i - b * w
            if w or abs(torque) > tau_c:
                friction = tau_c if (w or torque) > 0 else -tau_c
                moved = w + h * (torque - friction) / J
                w = moved if w * moved >= 0 else 0.0
    return np.array(speeds)


def test_a_bridge_whose_pauses_return_the_current_is_named_beside_dry_friction():
    """As drivers switched by their enable pin do; a drop of the brushes and another bridge took its place (8.5 %)."""
    runs, t = [], 0.01 * np.arange(500)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        v = np.repeat(rng.choice(np.linspace(-12, 12, 11), 13), 40)[:500]
        omega = switched(v, 0.01)
        runs.append(mi.Experiment(t, {"v": v}, {"omega": omega + rng.normal(0, 4.0, t.size)}))
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs[:2]), runs[2])
    assert {"pwm_fast_decay", "coulomb"} <= set(found.effects)
    assert found.after.values["a_p"] == pytest.approx(1.5, rel=0.2)  # 1 ms over L/R
    before, after = (found.ladder.rungs[k].validation_nrmse["omega"] for k in (0, -1))
    assert after < 0.04 < before / 5


def test_samples_are_left_out_only_where_that_helps(lab, monkeypatch):
    """Of a current that a driver cuts off some stand far from their neighbours, too, and the error rose without."""
    rng = np.random.default_rng(10)
    fit = mi.fit(mi.dc_motor(), recorded(lab, {"coulomb": {"tau_c": 0.008}}, stairs(900, rng), 1e-3, rng, name="run"))
    for share, said in ((1.01, False), (0.99, True)):
        left_out = readings.Reading("4 samples are left out", "--no-spikes", lambda run: run)
        after = SimpleNamespace(nrmse={c: share * e for c, e in fit.nrmse.items()})
        monkeypatch.setattr(readings, "without_spikes", lambda fit, reading=left_out: reading)
        monkeypatch.setattr(readings, "better_reading", lambda fit, **how: None)
        monkeypatch.setattr(readings.Reading, "fitted", lambda reading, fit, after=after: after)
        records = stepwise._read_and_climbed(fit, None, lambda records, **how: SimpleNamespace(misread=None))[0]
        assert ("--no-spikes" in " ".join(records.remarks)) == said
