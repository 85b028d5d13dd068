"""What is wrong with a record is said in plain words; a good record gets no remark."""

from __future__ import annotations

import numpy as np
import pytest

from motorid.channels import CHANNELS, worded
from motorid.errors import DataError
from motorid.records.checks import check_runs, dead_times, reading_notes
from motorid.records.datasets import data_path, datasets
from motorid.records.experiment import Experiment
from motorid.records.reading import read_csv, read_runs


@pytest.fixture(scope="module")
def good() -> Experiment:
    """A lab motor with current, speed and angle, driven both ways."""
    return read_runs(data_path("hidden_cogging/run2.csv"))[0]


@pytest.fixture(scope="module")
def steps() -> Experiment:
    return read_runs(data_path("hidden_friction/run1.csv"))[0]


def said(*runs: Experiment) -> str:
    return "\n".join(check_runs(runs))


def changed(run: Experiment, **scale: float) -> Experiment:
    return run.with_(inputs={"v": run.inputs["v"] * scale.get("v", 1.0)},
                     outputs={c: y * scale.get(c, 1.0) for c, y in run.outputs.items()})


def test_what_was_noted_of_several_files_is_said_once(good):
    runs = [good.with_(name=f"run{k}", meta={"notes": ["no unit stated", *(["late"] if k == 3 else [])]})
            for k in range(1, 7)]
    assert reading_notes(runs) == ["run1: no unit stated (The same in run2, run3, run4 and 2 more.)", "run3: late"]


# -- silence ------------------------------------------------------------------------------------------------

TRUE_REMARKS = ("the voltage never reverses in any run", "too slow for the inductance")


@pytest.mark.parametrize("name", datasets())
def test_shipped_records_raise_no_false_alarm(name):
    remarks = check_runs(read_runs(data_path(name)))
    assert [r for r in remarks if not any(t in r for t in TRUE_REMARKS)] == []


@pytest.mark.parametrize("motor", ["lab", "micro", "servo"])
@pytest.mark.parametrize("drive", ["staircase", "chirp"])
def test_a_plain_motor_raises_no_false_alarm(motor, drive, plant, rng):
    machine = plant.MOTORS[motor]
    if drive == "staircase":
        t, v = plant.staircase([3, -3, 1, 0, 5], hold=0.3)
    else:
        t = np.arange(2000) * 1e-3
        v = 5 * np.sin(2 * np.pi * (0.5 + 2 * t) * t)
    record = plant.simulate(machine, {}, t, v)
    noisy = {c: record[c] + 0.003 * np.std(record[c]) * rng.normal(size=len(t)) for c in CHANNELS}
    remarks = check_runs([Experiment(t, {"v": v}, noisy)])
    assert [r for r in remarks if "too slow for the inductance" not in r] == []


def test_nothing_is_said_about_nothing():
    assert check_runs([]) == []


def test_real_records_are_remarked_on_with_reason(real):
    expected = {
        "emps": [], "fibo": ["4 samples of the speed stand"], "frc": ["never reverses"],
        "furuta_base": ["the angle advances 1.26", "at rest without a voltage"],  # -21 ± 7 mA in 1,700 samples
        "odri_mn4004": ["is 1 V from beginning to end", "uneven"], "xl330": ["uneven"],
        "unmotor": ["never reverses"],
    }
    for folder, parts in expected.items():
        runs = read_runs(real / folder, units={"omega": "deg/s"} if folder == "unmotor" else None)
        remarks = check_runs(runs)
        assert len(remarks) == len(parts), remarks
        for part, remark in zip(parts, remarks, strict=True):
            assert part in remark


# -- signs and units ----------------------------------------------------------------------------------------


def test_a_swapped_sign_is_told_with_its_channel(good, steps):
    assert "sign of the current" in said(changed(good, i=-1))
    assert "units={'i': '-1 A'}" in said(changed(good, i=-1))
    assert "sign of the voltage" in said(changed(good, v=-1))
    both = said(changed(steps, omega=-1))
    assert "sign of the speed" in both
    assert "'omega': '-1 rad/s'" in both
    only = steps.without("i")
    assert "sign of the speed (or of the voltage)" in said(changed(only, omega=-1))
    assert "angle falls while the speed is positive" in said(changed(good, theta=-1))
    angle = good.without("i", "omega")
    assert "'theta': '-1 deg'" in said(changed(angle, theta=-1))  # as its file has it: a sign must not lose a scale


@pytest.mark.parametrize(("scale", "remedy"), [
    ({"omega": 30 / np.pi}, "'omega': 'rpm'"), ({"omega": 180 / np.pi}, "'omega': 'deg/s'"),
    ({"theta": 180 / np.pi}, "'theta': 'deg'"),
    ({"omega": np.pi / 30}, "already in rad/s although rpm is stated"),
    ({"omega": 1 / (2 * np.pi)}, "'omega': 'rev/s'"), ({"theta": 1 / (2 * np.pi)}, "'theta': 'rev'"),
    ({"theta": 1 / 43.7}, "a gear between the two sensors"),
    ({"theta": 180 / np.pi, "omega": 30 / np.pi}, "'omega': 'rpm', 'theta': 'deg'"),  # six, not two pi
])
def test_angle_and_speed_must_agree(good, scale, remedy):
    assert remedy in said(changed(good, **scale))


@pytest.mark.parametrize(("scale", "part"), [
    ({"omega": 100.0}, "is it in rpm"), ({"i": 1000.0}, "mA"), ({"v": 1000.0}, "is it in mV"),
])
def test_sizes_no_motor_has_point_to_the_unit(steps, scale, part):
    assert part in said(changed(steps, **scale))


def test_a_duty_in_per_cent_read_as_a_share_is_said(tmp_path):
    """As told by the hint for a header that says so, and once more where it was read as a whole duty all the same."""
    rows = "".join(f"{0.01 * k:.2f},{50 + k % 50},{k}\n" for k in range(200))
    (tmp_path / "a.csv").write_text("t,duty_pct,omega\n" + rows)
    with pytest.raises(DataError, match=r"'0\.12 V' for per cent.*units={'v': '0\.12 V'}"):
        read_csv(tmp_path / "a.csv")
    right, wrong = (read_csv(tmp_path / "a.csv", columns={"v": "duty_pct"}, units={"v": u}) for u in ("0.12 V", "12 V"))
    assert right.inputs["v"].max() < 12
    assert "is the column a duty cycle, in per cent" in said(wrong)
    assert "units={'v': '0.12 V'}" in said(wrong)


def test_a_speed_of_no_stated_unit_is_suspected_sooner(tmp_path):
    t = np.arange(200) * 1e-3
    w = 1650 * (1 - np.exp(-t / 0.03))  # a lab motor at 8 V, in rpm
    rows = "".join(f"{a:.3f},8,{b:.2f}\n" for a, b in zip(t, w, strict=True))
    (tmp_path / "a.csv").write_text("time_s,voltage_V,omega\n0,-8,0\n" + rows[rows.index("\n") + 1:])
    assert "is it in rpm" in said(read_csv(tmp_path / "a.csv"))
    assert "is it in rpm" not in said(read_csv(tmp_path / "a.csv", units={"omega": "rpm"}))


def test_a_speed_that_is_too_large_in_rpm_is_not_asked_to_be_in_rpm(tmp_path):
    """Counts every 4 ms that were scaled as if they were every second."""
    rows = "".join(f"{4 * k},{(k // 50) % 4},{9000 * ((k // 50) % 4)}\n" for k in range(400))
    (tmp_path / "a.csv").write_text("time_ms,voltage_V,speed_rpm\n" + rows)
    text = said(read_csv(tmp_path / "a.csv"))
    assert "omega reaches 2827 rad/s" not in text  # 27,000 rpm is possible
    assert "V·s/rad, far less than motors have" not in text
    (tmp_path / "b.csv").write_text("time_ms,voltage_V,speed_RPM\n" + rows.replace("000\n", "0000\n"))
    text = said(read_csv(tmp_path / "b.csv"))
    assert "read as RPM" in text
    assert "is read in rpm already: is its scale right" in text
    assert "is it in rpm" not in text


@pytest.mark.parametrize(("whole", "one"), [(1, "12 V"), (100, "0.12 V"), (255, "0.047 V"), (200, "0.047 V"),
                                            (1023, "0.012 V")])
def test_the_hint_for_a_duty_cycle_knows_how_far_it_reaches(tmp_path, whole, one):
    rows = "".join(f"{0.01 * k:.2f},{whole * (k // 50 % 3 - 1)},{k % 7}\n" for k in range(200))
    (tmp_path / "a.csv").write_text("t,pwm,omega\n" + rows)
    with pytest.raises(DataError, match=f"reaches {whole} here.*units={{'v': '{one}'}}"):
        read_csv(tmp_path / "a.csv")


def test_a_tiny_or_a_huge_constant_points_to_the_unit(steps):
    tiny = changed(steps, v=0.01)
    assert "V·s/rad, far less" in said(tiny.without("i"))
    assert "Ω, far less" in said(changed(steps, i=300.0))
    assert "Ω, far more" in said(changed(steps, i=1e-4))


def test_the_unit_of_the_time_is_suspected(steps):
    assert "is the time in ms" in said(steps.with_(t=steps.t * 1000))
    assert "unit of the time right" in said(steps.with_(t=steps.t * 1e-6))


def test_swapped_columns_are_told(steps):
    swapped = steps.with_(inputs={"v": steps.outputs["omega"]}, outputs={"omega": steps.inputs["v"]})
    assert "columns swapped" in said(swapped)


def test_a_commanded_torque_need_not_obey_the_balances_of_a_voltage(steps):
    swapped = steps.with_(inputs={"v": steps.outputs["i"]}, outputs={**steps.outputs, "i": steps.inputs["v"]})
    assert "columns are exchanged" in said(swapped)
    assert "columns are exchanged" not in said(swapped.with_(units={**swapped.units, "v": "N·m"}))


@pytest.mark.parametrize("gain", [0.0, 0.03])
def test_a_speed_that_is_measured_now_and_then_is_no_voltage(gain):
    """By a controller, or beside a smooth voltage: it follows the voltage, and the voltage does not follow it."""
    t, v, omega, shown, load = np.arange(1500) * 1e-2, np.zeros(1500), np.zeros(1500), np.zeros(1500), 0.0
    for k in range(1499):
        shown[k] = shown[k - 1] if k % 25 else omega[k]
        wanted = 60.0 * (k > 100) - 90.0 * (k > 700)
        load += 3e-2 * gain * (wanted - shown[k])
        v[k] = load + gain * (wanted - shown[k]) if gain else 6 * np.sin(k / 40)
        omega[k + 1] = omega[k] + 1e-2 / 0.1 * (20 * v[k] - omega[k])
    shown[-1], v[-1] = shown[-2], v[-2]
    assert "columns swapped" not in said(Experiment(t, {"v": v}, {"omega": shown}))


def test_an_angle_that_is_another_axis_s_is_said(steps):
    turned = np.cumsum(steps.outputs["omega"]) * float(np.diff(steps.t).mean())
    own = steps.with_(outputs={**steps.outputs, "theta": turned})
    other = own.with_(outputs={**own.outputs, "theta": 3 * np.sin(7 * steps.t)})
    assert "does not follow from the speed" not in said(own)
    assert "the angle does not follow from the speed" in said(other)
    assert "--ignore theta" in said(other)


def carriage(v: np.ndarray, spring: float = 100.0, weight: float = 0.0, dt: float = 5e-3) -> tuple[np.ndarray, ...]:
    """Return current and place of a motor of R = 1, K = 1, J = 0.1 that pulls a spring and a weight."""
    x, speed, shown = 0.0, 0.0, []
    for u in v:
        shown.append((u - speed, x))
        for _ in range(10):
            speed += 0.1 * dt * (u - speed - 1.0 * speed - spring * x - weight) / 0.1
            x += 0.1 * dt * speed
    i, x = np.array(shown).T
    return i, x


PULSES = np.repeat([0, 3, -3, 3, -3, 3, 0, 3, -3, 0], 400).astype(float)


@pytest.mark.parametrize("v", [PULSES, np.abs(PULSES) * (np.arange(4000) // 200 % 2)], ids=["both ways", "one way"])
def test_the_swapped_sign_of_an_angle_against_a_spring_is_told(v):
    """The angle comes back with the voltage, so the travel says nothing."""
    i, x = carriage(v)
    run = Experiment(5e-3 * np.arange(len(v)), {"v": v}, {"i": i, "theta": x}, units={"theta": "m"})
    assert "swapped" not in said(run)
    text = said(changed(run, theta=-1))
    assert "moves the position backwards: the sign of the position is probably swapped" in text
    assert "'theta': '-1 m'" in text


@pytest.mark.parametrize("late", [0, 20])
def test_a_voltage_that_jumps_at_random_and_is_logged_late_turns_no_angle_round(late, rng):
    """A jump says something of the one before, but not of the one to come, which moves the angle."""
    v = np.repeat(rng.uniform(-3, 3, 400), 20)
    _, x = carriage(v, spring=3000.0)
    logged = np.roll(v, late)
    run = Experiment(5e-3 * np.arange(len(v)), {"v": logged}, {"theta": x + 1e-5 * rng.normal(size=len(v))})
    assert "swapped" not in said(run)
    if not late:
        assert "sign of the angle" in said(changed(run, theta=-1))


def test_a_servo_that_answers_noise_turns_no_angle_round(rng):
    """Its voltage falls where the angle seems to rise."""
    x, speed, shown = 0.0, 0.0, []
    for k in range(4000):
        seen = np.round((x + 1e-3 * rng.normal()) / 1e-3) * 1e-3
        u = float(np.clip(400 * (0.01 * np.sign(np.sin(k / 300)) - seen), -5, 5))
        shown.append((u, seen))
        for _ in range(10):
            speed += 5e-5 * (u - 2 * speed) / 0.01
            x += 5e-5 * speed
    v, theta = np.array(shown).T
    assert "swapped" not in said(Experiment(5e-4 * np.arange(4000), {"v": v}, {"theta": theta}))


def test_a_controller_that_jumps_between_two_voltages_turns_no_angle_round():
    """It turns the voltage round where the angle crosses its reference, and lies against the voltage all the while."""
    t, theta, speed, shown = 1e-3 * np.arange(6000), 0.0, 0.0, []
    for now in t:
        v = 12.0 if 20 * np.sign(np.sin(25 * now)) > theta else -12.0
        shown.append((v, theta))
        speed += 1e-3 * (612 * v / 12 - speed) / 0.03
        theta += 1e-3 * speed
    v, theta = np.array(shown).T
    assert "swapped" not in said(Experiment(t, {"v": v}, {"theta": theta}))


def test_a_motor_that_is_stalled_at_the_limit_of_its_current_is_not_off():
    t = 1e-3 * np.arange(3000)
    v = np.where(t < 1.8, 2.5 * np.sign(np.sin(12 * t)), 24.0)
    i = np.where(t < 1.8, 0.4 * np.sign(v), 0.4)
    omega = np.where(t < 1.8, 20 * np.sign(v), 0.0)
    assert "disabled" not in said(Experiment(t, {"v": v}, {"i": i, "omega": omega}))


def duty(plant, lab, signed: np.ndarray, effects: dict | None = None) -> tuple[np.ndarray, np.ndarray]:
    t = 5e-3 * np.arange(len(signed))
    return t, plant.simulate(lab, effects or {}, t, signed, substep=1e-3)["omega"]


def test_friction_that_holds_a_motor_back_is_no_other_scale(plant, lab):
    """One run of 2 V, of which friction takes 1.8, and one of 12 V: the slow one shows the friction."""
    t = 1e-3 * np.arange(2000)
    runs = []
    for volts in (2.0, 12.0):
        omega = (volts - 1.8) / 0.05 * (1 - np.exp(-t / 0.1))
        runs.append(Experiment(t, {"v": np.full(2000, volts)}, {"omega": omega}, name=f"{volts:.0f} V"))
    assert "times the speed" not in said(*runs)
    small = runs[1].with_(inputs={"v": runs[1].inputs["v"] / 12}, name="duty")
    assert "times the speed in duty as in 12 V" in said(small, runs[1])


@pytest.mark.parametrize("channel", ["omega", "theta"])
def test_a_speed_that_reverses_alone_is_told(plant, lab, channel):
    """A duty cycle beside its direction that never rests."""
    signed = np.repeat([-6.0, 5, 3, -4, 6, 2, -3, -6], 100)
    t, omega = duty(plant, lab, signed)
    y = {"omega": omega, "theta": np.cumsum(omega) * 5e-3}[channel]
    assert "reverses" not in said(Experiment(t, {"v": signed}, {channel: y}))
    text = said(Experiment(t, {"v": np.abs(signed)}, {channel: y}))
    assert "the speed reverses although the voltage never does" in text
    assert "without its sign" in text


@pytest.mark.parametrize("case", ["hoist", "spring", "spring at a constant voltage", "coasting", "one quadrant",
                                  "slip"])
def test_a_motor_that_is_turned_back_is_not_taken_for_a_voltage_without_its_sign(plant, lab, case, rng):
    v = np.repeat([3.0, 1.0, 2.5, 0.5, 3.0, 0.0, 2.0, 3.0], 300)
    t = 5e-3 * np.arange(len(v))
    if case == "hoist":  # raised under 3 V, lowered as fast under 1
        outputs = {"omega": np.gradient(carriage(v, spring=0.0, weight=2.0)[1], t)}
    elif case == "spring":
        outputs = {"omega": np.gradient(carriage(v, spring=1000.0)[1], t)}
    elif case == "spring at a constant voltage":
        v[:] = 3.0
        outputs = {"omega": 5 * np.sin(9 * t)}
    elif case == "coasting":  # thrown backwards, then driven
        v[:300] = 0.0
        outputs = {"omega": np.where(t < 1.5, -40 * np.exp(-t / 0.5), 15 * v)}
    elif case == "slip":  # of the counter, where the current is switched on
        outputs = {"omega": np.where((t > 6.0) & (t < 6.03), -40.0, 15 * v)}
    else:
        outputs = {"omega": duty(plant, lab, v)[1] + 0.1 * rng.normal(size=len(v))}
    text = said(Experiment(t, {"v": v}, outputs))
    assert "without its sign" not in text
    assert "reverses although" not in text


# -- quality ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("channel", ["i", "omega"])
@pytest.mark.parametrize("side", [1, -1])
def test_a_clipped_channel_is_told(steps, channel, side):
    y = steps.outputs[channel]
    stop = 0.6 * (y.max() if side > 0 else y.min())
    clipped = np.minimum(y, stop) if side > 0 else np.maximum(y, stop)
    remarks = said(steps.with_(outputs={**steps.outputs, channel: clipped}))
    assert f"{'current' if channel == 'i' else 'speed'} stays at exactly {stop:.4g}" in remarks
    assert "clipped" in remarks


def test_rest_and_steps_of_the_sensor_are_not_clipping(steps):
    coarse = steps.with_(outputs={c: np.round(y / (np.ptp(y) / 60)) * np.ptp(y) / 60
                                  for c, y in steps.outputs.items()})
    assert "clipped" not in said(coarse)
    rest = steps.with_(outputs={"omega": np.maximum(steps.outputs["omega"], 0.0)})
    assert "clipped" not in said(rest)


def test_too_few_counts_are_told(steps):
    step = np.ptp(steps.outputs["omega"]) / 9
    remarks = said(steps.with_(outputs={"omega": np.round(steps.outputs["omega"] / step) * step}))
    assert "too few counts" in remarks


def test_a_channel_of_noise_is_told(steps, rng):
    assert "mostly noise" in said(steps.with_(outputs={"i": rng.normal(size=steps.n)}))


def test_counts_that_alternate_are_not_taken_for_noise_and_the_only_channel_is_kept(rng):
    """Differences of successive samples make 3.6 times of it; without the only channel nothing is left to fit."""
    t = np.arange(300) * 0.01
    speed = 20 * (1 - np.exp(-t / 0.4)) + 60
    run = Experiment(t, {"v": np.full(300, 6.0)}, {"omega": speed + 5.0 * (-1.0) ** np.arange(300)})
    assert "mostly noise" not in said(run)
    noisy = said(run.with_(outputs={"omega": speed + 20 * rng.normal(size=300)}))
    assert "the speed is mostly noise" in noisy
    assert "--ignore" not in noisy
    gaps = np.where(np.arange(300) % 2, np.nan, 1e4 * rng.normal(size=300))  # of a logger of several rates
    assert "mostly noise" in said(run.with_(outputs={"omega": gaps, "i": speed}))
    both = {"omega": speed + 20 * rng.normal(size=300), "theta": np.cumsum(speed) * 0.01}
    assert "--ignore omega" in said(run.with_(outputs=both))


@pytest.mark.parametrize("whole", [1023, 4095, 65535])
def test_counts_of_a_timer_are_not_taken_for_millivolts(whole):
    t = np.arange(300) * 0.01
    run = Experiment(t, {"v": np.where(t > 1, float(whole), 0.3 * whole)}, {"omega": 50 * (1 - np.exp(-t))})
    remarks = said(run)
    assert "counts of a timer" in remarks
    assert f"units={{'v': '{12 / whole:.2g} V'}}" in remarks
    assert "mV" not in remarks


def test_spikes_are_told_and_what_forgives_them(steps, rng):
    y = steps.outputs["i"].copy()
    where = rng.choice(steps.n, 9, replace=False)
    y[where] += 20.0 * rng.choice([-1, 1], 9)
    remarks = said(steps.with_(outputs={**steps.outputs, "i": y}))
    assert "samples of the current stand about 20 A away" in remarks
    assert "--loss huber" in remarks
    pair = steps.outputs["i"].copy()
    for k in where:
        pair[k:k + 3] += 20.0  # three in a row are no spike
    assert "away from their neighbours" not in said(steps.with_(outputs={**steps.outputs, "i": pair}))


def test_a_current_held_by_the_driver_is_told(plant, rng):
    machine = plant.MOTORS["wheel"]
    t, v = plant.staircase([20, -20, 12, -20], hold=0.5, dt=1e-3)
    limit = 0.5 * float(np.abs(plant.simulate(machine, {}, t, v)["i"]).max())
    i, omega, held = 0.0, 0.0, {"i": [], "omega": []}
    for u in v:  # the driver takes the voltage back as soon as the current reaches its limit
        held["i"].append(i)
        held["omega"].append(omega)
        for _ in range(20):
            i += 5e-5 * (u - machine.R * i - machine.K * omega) / machine.L
            i = float(np.clip(i, -limit, limit))
            omega += 5e-5 * (machine.K * i - machine.b * omega) / machine.J
    noisy = {c: np.array(y) + 0.003 * np.std(y) * rng.normal(size=len(t)) for c, y in held.items()}
    assert f"the current stays at {limit:.3g} A" in said(Experiment(t, {"v": v}, noisy))
    free = plant.simulate(machine, {}, t, v)
    assert "held at" not in said(Experiment(t, {"v": v}, {c: free[c] for c in noisy}))


def test_missing_samples_are_told(steps, rng):
    y = np.where(rng.random(steps.n) < 0.3, np.nan, steps.outputs["omega"])
    assert "29 % of the speed samples are missing" in said(steps.with_(outputs={"omega": y}))


def test_uneven_sampling_is_told(steps, rng):
    t = steps.t + rng.uniform(0, 0.9e-3, steps.n)
    assert "sampling is uneven" in said(steps.with_(t=t))
    assert "uneven" not in said(steps.with_(t=steps.t + rng.uniform(0, 1e-4, steps.n)))


def test_sampling_too_slow_for_the_inductance_is_told(steps):
    assert "too slow for the inductance" in said(steps.decimate(8).with_(
        inputs={"v": steps.inputs["v"][::8]}))
    assert "inductance" not in said(steps)
    assert "too slow for the inductance" in said(*read_runs(data_path("two_step_small")))  # L/R is 0.1 ms


@pytest.mark.parametrize("late", [0, 1])
def test_a_current_that_follows_a_random_voltage_is_no_noise(late, rng):
    """Sampled more often than it is measured, once for every jump of the voltage: its differences look like noise."""
    levels = rng.uniform(-3, 3, 200)
    i = np.roll(levels, late) / 4 + 0.05 * rng.normal(size=200)
    t = 5e-3 * np.arange(4000)
    fresh = np.arange(4000) % 20 == 0
    stairs = Experiment(t, {"v": np.repeat(levels, 20)}, {"i": np.repeat(i, 20)})
    assert "mostly noise" not in said(stairs)
    assert "mostly noise" not in said(stairs.with_(outputs={"i": np.where(fresh, stairs.outputs["i"], np.nan)}))
    assert "mostly noise" in said(stairs.with_(outputs={"i": np.repeat(rng.normal(size=200), 20)}))


def logged(command, tau, rng, noise=0.0, every=43, jitter=0, name="run"):
    """A speed that follows the command (125 µs a sample) with a lag, logged every so often, at uneven times."""
    speed, a = np.zeros(len(command)), np.exp(-125e-6 / tau)
    for k in range(1, len(speed)):
        speed[k] = a * speed[k - 1] + (1 - a) * 100 * command[k - 1]
    at = np.arange(every, len(command), every)
    at = at - rng.integers(0, jitter + 1, len(at))
    y = speed[at] + noise * rng.normal(size=len(at))
    return Experiment(at * 125e-6, {"v": command[at]}, {"omega": y}, name=name)


def swept(top, seconds=7.0):
    t = np.arange(0, seconds, 125e-6)
    return 0.25 * np.sin(np.pi * top / seconds * t**2)


FAST_LOG = "The column does not tell what acted between its samples: log faster"


@pytest.mark.parametrize("tau", [4e-3, 0.1])
def test_a_command_that_changes_faster_than_its_log_is_told(tau, rng):
    random = said(logged(rng.uniform(-0.5, 0.5, 56000), tau, rng, jitter=10))
    assert "run: the voltage seems to change faster than its samples can show, at random" in random
    chirp = said(logged(swept(250.0), tau, rng, jitter=3))
    assert "run: the voltage seems to change faster than its samples can show from " in chirp
    assert FAST_LOG in chirp
    assert 1.7 < float(chirp.partition("show from ")[2].split()[0]) < 2.7  # from 2.6 s on it is beyond 93 Hz


@pytest.mark.parametrize("tau", [4e-3, 0.1, 1.0])
@pytest.mark.parametrize("case", ["random", "two levels", "uneven", "slow sweep", "measured", "coasting"])
def test_a_command_that_is_held_from_sample_to_sample_is_resolved(tau, case, rng):
    n = 1300
    values = rng.choice([-0.5, 0.5], n) if case == "two levels" else rng.uniform(-0.5, 0.5, n)
    command = {"slow sweep": swept(60.0), "measured": 3 + 0.02 * rng.normal(size=43 * n),
               "coasting": 1e-3 * rng.normal(size=43 * n)}.get(case, np.repeat(values, 43))
    run = logged(command, tau, rng, noise=1.0, jitter=10 * (case == "uneven"))
    if case == "coasting":
        run = run.with_(outputs={"omega": 100 * np.exp(-run.t / 3) + rng.normal(size=run.n)})
    assert FAST_LOG not in said(run)


def test_a_voltage_that_acts_late_is_no_drive_that_is_off_and_no_other_column(plant, rng):
    """A computer's command: 240 to 300 ms of nothing were said to be a disabled drive, its columns exchanged."""
    machine, t = plant.MOTORS["lab"], 1e-3 * np.arange(1600)
    commanded = np.where((t >= 0.5) & (t < 1.1), 6.0, 0.0)
    runs = []
    for k, dead in enumerate((0.24, 0.3)):
        clean = plant.simulate_linear(machine, t, np.where((t >= 0.5 + dead) & (t < 1.1 + dead), 6.0, 0.0))
        noisy = {c: clean[c] + rng.normal(0, 1e-3 * np.abs(clean[c]).max(), t.size) for c in ("i", "omega")}
        runs.append(Experiment(t, {"v": commanded}, noisy, name=f"run{k + 1}"))
    text = said(*runs)
    assert "only after 240 to 300 ms, another time at each step," in text
    assert "--delay 0.24, run.delayed(0.24)" in text
    assert "disabled" not in text
    assert "exchanged" not in text
    assert "only after 240 ms and" in said(runs[0])
    assert "only after" not in said(runs[0].delayed(0.24))
    assert "only after" in said(runs[0].without("i")), "it slows down late, too"
    assert "only after" not in said(runs[0].without("i").select(slice(0, 1000))), "from rest a friction may do so"


def test_a_drive_that_was_off_is_told_with_its_times(rng):
    v = np.repeat([3, -3, 3, -3, 3, 0, 3, -3, 3, -3], 400).astype(float)
    t = 5e-3 * np.arange(len(v))
    on = (t > 2.6) & (t < 18.5)
    i, x = carriage(np.where(on, v, 0))
    run = Experiment(t, {"v": v}, {"i": i + 0.02 * rng.normal(size=len(v)), "theta": x}, units={"theta": "m"})
    text = said(run)
    assert "neither current nor motion follows the voltage from 0 to 2.4 s and from 18.8 to 20 s" in text
    assert "was the drive disabled?" in text
    assert "run.select()" in text
    assert "disabled" not in said(run.select(on))
    assert "disabled" not in said(run.without("i")), "it may as well stick"


@pytest.mark.parametrize("case", ["dead band", "sticks", "no voltage"])
def test_a_motor_that_rests_is_not_taken_for_a_drive_that_is_off(case):
    v = np.repeat([0.8, 3, 0.5, -3, 0.9, 3, -0.7, 3, -3, 0.8], 400)
    v = np.where(np.abs(v) < 1, 0.0, v) if case == "no voltage" else v
    driven = np.where(np.abs(v) < 1, 0.0, v)
    i, x = carriage(driven, spring=0.0)
    i = np.where(np.abs(v) < 1, v, i) if case == "sticks" else i
    assert "disabled" not in said(Experiment(5e-3 * np.arange(len(v)), {"v": v}, {"i": i, "theta": x}))


# -- what the records cannot show ---------------------------------------------------------------------------


def test_no_excitation_is_told(steps):
    constant = steps.select(steps.t > steps.t[-1] - 0.1)
    assert "from beginning to end" in said(constant)
    dead = steps.with_(outputs={"omega": np.zeros(steps.n), "i": steps.outputs["i"]})
    assert "speed never changes" in said(dead)
    steady = steps.with_(inputs={"v": np.full(steps.n, 6.0)})
    frozen = steady.with_(outputs={**steps.outputs, "theta": np.full(steps.n, 7.0)})
    assert "from beginning to end" in said(steady, frozen)
    assert "angle never changes" in said(steady, frozen)
    assert "never changes" not in said(steady.with_(outputs={"omega": np.full(steps.n, 7.0)}))  # a steady speed


@pytest.mark.parametrize("sign", [1, -1])
def test_a_motor_that_accelerates_without_a_voltage_is_told(sign, rng):
    t = 1e-2 * np.arange(200)
    omega = sign * 10 * (1 - np.exp(-t / 0.3)) + 0.2 * rng.normal(size=200)
    run = Experiment(t, {"v": np.zeros(200)}, {"omega": omega, "theta": np.cumsum(omega) * 1e-2})
    for seen in (run, run.without("omega")):
        text = said(seen)
        assert "from beginning to end, yet the motor accelerates by itself: is it the wrong column" in text
        assert "and the way there at most" not in text
    dragged = run.with_(inputs={"v": np.zeros(200), "tau_load": np.ones(200)})
    swings, coasts, rests = np.sin(6 * t) * np.exp(-t), 10 * np.exp(-t), 0.1 * rng.normal(size=200)
    for other in (dragged, run.with_(inputs={"v": np.full(200, 6.0)}),
                  *(run.with_(outputs={"omega": y}) for y in (swings, coasts, rests))):
        assert "by itself" not in said(other)
        assert "and the way there at most" in said(other)


@pytest.mark.parametrize("channel", ["omega", "theta"])
def test_scales_that_contradict_each_other_are_told(plant, lab, channel):
    v = np.repeat([0.0, 2, 4, 6, 3, 1], 150)
    t, omega = duty(plant, lab, v)
    outputs = {"omega": {"omega": omega}, "theta": {"theta": np.cumsum(omega) * 5e-3}}[channel]
    run = Experiment(t, {"v": v}, outputs, name="in volts")
    share = run.with_(inputs={"v": v / 12}, name="as a share")
    rpm = run.with_(outputs={c: 30 / np.pi * y for c, y in outputs.items()}, name="in rpm")
    for other in (share, rpm):
        text = said(run, other)
        assert f"times the speed in {other.name} as in in volts: do their units differ" in text
        assert "times the speed" in "".join(check_runs([run], [other])), "held out"
        assert "times the speed" not in said(other)


@pytest.mark.parametrize("case", ["half", "fast", "stuck", "friction", "rest"])
def test_runs_that_differ_have_no_other_scale(plant, lab, case):
    v = np.repeat([0.0, 2, 4, 6, -6, 1], 150)
    t, omega = duty(plant, lab, v, {"coulomb": {"tau_c": 8e-3}})
    run = Experiment(t, {"v": v}, {"omega": omega})
    other = {"half": v / 2, "fast": 6 * np.sign(np.sin(100 * t)), "stuck": v, "rest": 0 * v,
             "friction": np.full(len(t), 0.3 + 8e-3 * lab.R / lab.K)}[case]
    turned = np.where(v > 5, 1e-3, 0.0) if case == "stuck" else duty(plant, lab, other, {"coulomb": {"tau_c": 8e-3}})[1]
    assert "times the speed" not in said(run, Experiment(t, {"v": other}, {"omega": turned}, name="other"))


def test_a_run_that_never_settles_is_told():
    t = np.arange(1500) * 1e-3
    v = np.where(t < 0.2, 0.0, 6.0)
    slow = 100 * (1 - np.exp(-np.maximum(t - 0.2, 0) / 2.0))
    fast = 100 * (1 - np.exp(-np.maximum(t - 0.2, 0) / 0.1))
    assert "never settles" in said(Experiment(t, {"v": v}, {"omega": slow}))
    assert "never settles" not in said(Experiment(t, {"v": v}, {"omega": fast}))


def test_a_voltage_that_never_reverses_is_told_once_for_all_runs(steps):
    forward = steps.with_(inputs={"v": np.abs(steps.inputs["v"])})
    assert said(forward, forward).count("never reverses") == 1
    assert "never reverses" not in said(forward, steps)


def test_the_same_remark_about_many_runs_is_made_once(steps):
    runs = [changed(steps, i=-1).with_(name=f"run{k}") for k in range(6)]
    remarks = [r for r in check_runs(runs) if "sign of the current" in r]
    assert len(remarks) == 1
    assert remarks[0].startswith("run0: ")
    assert "(The same in run1, run2, run3 and 2 more.)" in remarks[0]


@pytest.mark.parametrize("dead", ["i", "omega", "theta"])
def test_a_channel_without_a_single_sample_is_said_to_be_missing(dead):
    t = np.arange(0, 1, 1e-3)
    v = 6 * np.sign(np.sin(9 * t))
    outputs = {"i": 0.1 * v, "omega": 20 * v, "theta": 20 * np.cumsum(v) * 1e-3}
    said = check_runs([Experiment(t, {"v": v}, outputs | {dead: np.full(len(t), np.nan)})])
    assert any("100 %" in text and "missing" in text for text in said)


@pytest.mark.parametrize(("each", "unit"), [(1.0, "ms"), (500.0, "us")])
def test_a_time_that_was_not_in_seconds_is_asked_for(each, unit, rng):
    t = each * np.arange(200)
    run = Experiment(t, {"v": np.sign(np.sin(0.1 * np.arange(200) + 0.1))}, {"omega": rng.normal(size=200)})
    assert f"units={{'t': '{unit}'}}" in said(run)


def test_a_sensor_that_is_read_more_often_than_it_measures_is_not_clipped(rng):
    t = 1e-3 * np.arange(2000)
    v = 5 * np.sin(6 * t)
    speed = (90 * np.sin(6 * t - 0.4) + rng.normal(size=2000))[np.arange(2000) // 40 * 40]
    assert "clipped" not in said(Experiment(t, {"v": v}, {"omega": speed}))


def test_levels_of_a_counter_that_times_its_pulses_are_no_limit():
    """The highest speeds are few levels, wide apart: 1/n of one clock."""
    t = 1e-2 * np.arange(1800)
    rise = 1 - 0.9 * np.exp(-np.mod(3 * t, np.pi) / 0.3)
    speed = 4.8 * np.sign(np.sin(3 * t)) * rise + 0.3 * np.random.default_rng(0).normal(size=1800)
    counted = np.sign(speed) * 47 / np.ceil(47 / np.maximum(np.abs(speed), 0.05))
    assert "clipped" not in said(Experiment(t, {"v": np.sin(3 * t)}, {"omega": counted}))


def test_a_driver_at_its_end_does_not_turn_the_speed_round(plant, lab):
    """The command goes on beyond what there is; the speed stays, and still is along the voltage."""
    t = np.arange(0, 4, 2e-3)
    command = 1.5 * lab.v_max * t / t[-1]
    shown = plant.simulate(lab, {}, t, np.minimum(command, 0.5 * lab.v_max))
    assert "swapped" not in said(Experiment(t, {"v": command}, {"omega": shown["omega"]}))


def test_a_speed_in_rpm_beside_an_angle_in_turns_is_told(good):
    """Read as degrees per second, the ratio was taken for that of pi to 180."""
    text = said(changed(good, omega=30 / np.pi, theta=1 / (2 * np.pi)))
    assert "units={'omega': 'rpm', 'theta': 'rev'}" in text


def test_a_coarse_current_that_stays_where_noise_moves_all_others_is_clipped(rng):
    """3 % of a converter's samples at the end of its range were taken for the driver's current limit."""
    t = np.arange(2000) * 2e-3
    v = np.sign(np.sin(2 * np.pi * t))
    noisy = 0.5 * v * np.exp(-(t % 0.5) / 0.02) + 4e-3 * rng.normal(size=2000)
    coarse = np.clip(np.round(noisy / 2e-3) * 2e-3, -0.34, 0.34)
    run = Experiment(t, {"v": v}, {"i": coarse, "omega": 10 * v * (1 - np.exp(-(t % 0.5) / 0.1))})
    assert "the current stays at exactly 0.34 A" in said(run)
    assert "clipped" not in said(run.with_(outputs={**run.outputs, "i": np.round(noisy / 2e-3) * 2e-3}))


def test_a_coarse_sensor_s_offset_at_rest_is_no_limit(rng):
    t = np.arange(6000) * 1e-3
    motion = np.where(t < 3, -80 * (1 - np.exp(-t / 0.3)), -80 * np.exp(-(t - 3) / 0.3))
    rippled = np.minimum(motion * (1 + 0.05 * rng.normal(size=6000)), -1)
    speed = np.round(np.where(motion < -0.5, rippled, 0)) + 1.0
    assert "clipped" not in said(Experiment(t, {"v": np.where(t < 3, -6.0, 0.0)}, {"omega": speed}))


@pytest.mark.parametrize("levels", [(0, 6, -6, 6, -6, 3, -3), (0, 4, 8, -8, 6)])
def test_a_slow_motor_that_is_reversed_before_it_settles_is_not_late(rng, levels):
    """It falls back through what it was just before; nor is a sensor that is read every few samples late."""
    v, omega = np.repeat(levels, 300).astype(float), [0.0]
    for volts in v[1:]:
        omega.append(20 * volts + (omega[-1] - 20 * volts) * np.exp(-1e-3 / 0.4))
    y = np.array(omega) + rng.normal(0, 0.05, v.size)
    run = Experiment(1e-3 * np.arange(v.size), {"v": v}, {"omega": y})
    assert dead_times([run]) == []
    kept = np.repeat(y[::12], 12)
    assert dead_times([run.with_(outputs={"omega": kept})]) == []


def servo(load: float, sign: float = 1.0, unit: str = "A") -> Experiment:
    """An axis that a controller of its place drives by torque, with dry friction and against a weight of `load`."""
    t, omega, angle = np.arange(6000) * 1e-3, 0.0, 0.0
    shown = []
    for now in t:
        wanted = 0.8 * np.sin(2 * np.pi * 0.9 * now) + 0.4 * np.sign(np.sin(2 * np.pi * 0.37 * now))
        u = 8.0 * (wanted - angle) - 0.5 * omega
        shown.append((u, omega, angle))
        omega += 1e-3 / 0.02 * (u - 0.05 * omega - 0.4 * np.tanh(omega / 0.05) - load * np.sin(angle))
        angle += 1e-3 * omega
    u, omega, angle = np.array(shown).T
    return Experiment(t, {"v": sign * u}, {"omega": omega, "theta": angle}, units={"v": unit})


@pytest.mark.parametrize("load", [0.0, 2.0, 12.0])
@pytest.mark.parametrize("channel", ["omega", "theta"])
def test_the_swapped_sign_of_a_commanded_torque_is_told(load, channel):
    """A weight that is moved slowly asks for a torque against its acceleration, too: that is no swapped sign."""
    true, turned = (servo(load, sign).without({"omega": "theta", "theta": "omega"}[channel]) for sign in (1, -1))
    assert "swapped" not in said(true)
    assert "a positive current accelerates the axis backwards: the sign of the current" in said(turned)
    assert "units={'v': '-1 A'}" in said(turned)


def test_an_angle_that_follows_the_speed_for_a_smaller_part_is_another_axis_s(steps):
    turned = np.cumsum(steps.outputs["omega"]) * float(np.diff(steps.t).mean())
    rate = np.std(steps.outputs["omega"])
    both = steps.with_(outputs={**steps.outputs, "theta": turned + rate * np.cumsum(np.sin(40 * steps.t)) * steps.dt})
    frame = 0.1 * turned + 0.03 * np.std(turned) * np.sin(40 * steps.t)  # leans as the wheel is turned, and swings
    assert "does not follow from the speed" not in said(both)
    assert "does not follow from the speed" in said(steps.with_(outputs={**steps.outputs, "theta": frame}))


def test_a_logger_that_writes_a_negative_voltage_logs_its_sign(plant, lab):
    t, v = plant.staircase([6, 0, 6, 0, 4, 0, 4, 0], hold=0.3)
    s = plant.simulate(lab, {}, t, v)
    direction = np.repeat([1, 1, -1, -1, 1, 1, -1, -1], len(t) // 8 + 1)[:len(t)]
    lost = Experiment(t, {"v": v}, {"omega": direction * s["omega"]}, name="lost")
    signed = Experiment(t, {"v": direction * v}, {"omega": direction * s["omega"]}, name="signed")
    assert "logged without its sign" in said(lost)
    assert "logged without its sign" not in said(lost, signed)


def test_a_fast_voltage_that_only_shakes_a_speed_leaves_no_doubt_of_its_sign():
    t = np.arange(3000) * 1e-3
    v = 12 * np.sin(2 * np.pi * 25 * t)
    omega = 30 * (1 - np.cos(2 * np.pi * 25 * t))
    assert "never negative" not in said(Experiment(t, {"v": v}, {"omega": omega}))
    slow = 12 * np.sign(np.sin(2 * np.pi * t))
    assert "the speed is never negative" in said(Experiment(t, {"v": slow}, {"omega": 20 * np.abs(slow)}))


def test_names_of_records_keep_their_words_where_another_drive_is_spoken_of():
    t = np.arange(600) * 1e-3
    first = Experiment(t, {"v": np.full(600, 2.0)}, {"omega": 1 - np.exp(-t / 0.05)},
                       units={"v": "N", "omega": "m/s"}, name="low voltage")
    told = check_runs([first, first.with_(name="low voltage (2)")])[0]
    assert told.startswith("low voltage: the force is 2 N from beginning to end")
    assert told.endswith("Add runs with steps or a sweep of the force. (The same in low voltage (2).)")
    said = "The voltage and the angle in a run, voltage test, of angle tests, and their voltages."
    assert worded(said, {"v": "A", "theta": "m"}, ["voltage", "run", "voltage test", "angle tests"]) == (
        "The current and the position in a run, voltage test, of angle tests, and their currents.")


@pytest.mark.parametrize(("size", "unit"), [(1e3, "ms"), (1e6, "us"), (1e9, "ns")])
def test_one_advice_on_the_unit_of_the_time_is_enough(steps, size, unit):
    """Nanoseconds were to be tried as microseconds, and then as milliseconds."""
    assert f"units={{'t': '{unit}'}}" in said(steps.with_(t=steps.t * size))
    read = steps.with_(t=steps.t * size * 1e-3, meta={**steps.meta, "original_units": {"t": "ms"}})
    assert (f"units={{'t': '{unit}'}}" in said(read)) == (unit != "ms")
