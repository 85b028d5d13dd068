"""The noise of a channel is found from its samples, whatever the motor does meanwhile."""

from __future__ import annotations

import numpy as np
import pytest

import motorid as mi
from motorid.numerics.autoregression import autocorrelation
from motorid.numerics.signals import noise_level, quantum
from motorid.problem.runs import noise_of
from motorid.records.experiment import repeated

N = 2000
T = np.arange(N) * 1e-3


def speed() -> np.ndarray:
    """Standstill, start, reversal: 80 ms time constant."""
    start = 100 * (1 - np.exp(-np.maximum(T - 0.3, 0) / 0.08))
    return np.where(T < 1, start, -100 + 200 * np.exp(-(T - 1) / 0.08))


def current() -> np.ndarray:
    """Two spikes of 4 ms, little otherwise."""
    return sum(np.exp(-np.clip(T - a, 0, None) / 0.004) * (a <= T) for a in (0.3, 1.0))


@pytest.mark.parametrize("signal", [speed, current, lambda: 687 + np.cumsum(speed()) * 1e-3,
                                    lambda: np.sin(2 * np.pi * np.arange(N) / 40), lambda: np.zeros(N)],
                         ids=["speed", "current", "angle", "sine", "nothing"])
@pytest.mark.parametrize("size", [0.003, 0.3])
def test_white_noise_is_found_within_15_per_cent(signal, size, rng):
    assert noise_level(signal() + size * rng.normal(size=N)) == pytest.approx(size, rel=0.15)


def test_short_records_are_estimated_without_large_bias(rng):
    levels = [noise_level(np.linspace(0, 9, 30) + rng.normal(size=30)) for _ in range(200)]
    assert np.mean(levels) == pytest.approx(1, rel=0.1)


def test_outliers_and_missing_samples_do_no_harm(rng):
    y = speed() + 0.5 * rng.normal(size=N)
    spiked = y.copy()
    spiked[rng.random(N) < 0.02] += 50
    assert noise_level(spiked) == pytest.approx(0.5, rel=0.15)
    holed = y.copy()
    holed[rng.random(N) < 0.3] = np.nan
    assert noise_level(holed, T) == pytest.approx(0.5, rel=0.15)


def test_uneven_time_stamps_are_used(rng):
    t = T + 4e-4 * rng.uniform(-1, 1, N)
    y = 5000 * t + 0.5 * rng.normal(size=N)
    assert noise_level(y, t) == pytest.approx(0.5, rel=0.15)
    assert noise_level(y) > 0.8  # without them the jitter counts as noise


def test_bursts_with_pauses_between_are_used(rng):
    t = np.concatenate([0.1 * k + 1e-3 * np.arange(5) for k in range(100)])
    assert noise_level(100 * np.sin(6 * t) + 0.1 * rng.normal(size=500), t) == pytest.approx(0.1, rel=0.15)


def test_a_signal_with_few_samples_per_period_counts_as_noise_in_part(rng):
    nine, five = (np.sin(2 * np.pi * np.arange(N) / k) + 0.01 * rng.normal(size=N) for k in (9, 5))
    assert noise_level(nine) == pytest.approx(0.01, rel=0.15)
    assert 0.03 < noise_level(five) < 0.3


def test_an_exact_standstill_says_nothing(rng):
    y = speed() + 0.5 * rng.normal(size=N)
    y[:1500] = 0
    assert noise_level(y) == pytest.approx(0.5, rel=0.15)


@pytest.mark.parametrize("step", [0.1, 1.0, 6.4])
def test_a_quantised_channel_has_the_noise_of_its_steps(step):
    y = step * np.round(speed() / step)
    assert quantum(y) == pytest.approx(step)
    assert noise_level(y) == pytest.approx(step / np.sqrt(12), rel=0.15)


@pytest.mark.parametrize("missing", [0.02, 0.3])
def test_dropped_samples_of_a_fast_encoder_are_no_steps(rng, missing):
    """At a steady 79.6 counts per sample a gap is a jump of 80, forty times as large as any change of the speed."""
    y = np.round(79.6 * np.arange(N) + 300 * np.sin(np.arange(N) / 90))
    clean = noise_level(y)
    y[rng.random(N) < missing] = np.nan
    assert quantum(y) == pytest.approx(1.0)
    assert noise_level(y) == pytest.approx(clean, rel=0.2)


def test_noise_and_steps_together(rng):
    y = np.round(speed() + 0.7 * rng.normal(size=N))
    assert noise_level(y) == pytest.approx(np.hypot(0.7, 1 / np.sqrt(12)), rel=0.2)


@pytest.mark.parametrize("step", [0.01, 0.1, 1.0])
def test_a_quantised_angle_has_the_noise_of_its_steps(step):
    y = step * np.round(np.cumsum(speed()) * 1e-3 / step)
    assert noise_level(y) == pytest.approx(step / np.sqrt(12), rel=0.15)


def test_steps_are_not_seen_where_there_are_none(rng):
    assert quantum(speed()) == 0
    assert quantum(speed() + rng.normal(size=N)) == 0
    assert quantum(np.linspace(0, 1, N)) == 0
    assert quantum(np.zeros(N)) == 0
    assert quantum([]) == 0


def test_no_channel_has_no_noise_at_all():
    assert 1e-6 < noise_level(speed()) / np.std(speed()) < 2e-5
    assert noise_level(np.full(N, 3.0)) == pytest.approx(3e-5)
    for nothing in (np.zeros(N), np.full(N, np.nan), [], [1.0]):
        assert noise_level(nothing) > 0


def test_smooth_noise_is_underestimated_by_the_documented_factor(rng):
    from scipy.signal import lfilter

    coloured = lfilter([np.sqrt(1 - 0.81)], [1, -0.9], rng.normal(size=20000))
    assert 0.2 < noise_level(coloured) / np.std(coloured) < 0.33


@pytest.mark.parametrize("name", ["two_step_noisy", "two_step_small", "hidden_friction", "hidden_cogging",
                                  "hidden_brush", "hidden_two"])
def test_the_stated_noise_of_shipped_records_is_found(name):
    from motorid.records.datasets import data_path, truth
    from motorid.records.reading import read_runs

    for run in read_runs(data_path(name)):
        for channel, stated in truth(name)["sigma"].items():
            assert noise_level(run.outputs[channel], run.t) == pytest.approx(stated, rel=0.15)


def test_the_step_of_a_fast_encoder_is_found():
    from motorid.records.datasets import data_path
    from motorid.records.reading import read_runs

    for run in read_runs(data_path("hidden_cogging")):  # up to 27 counts from sample to sample
        assert quantum(run.outputs["theta"]) == pytest.approx(2 * np.pi / 4096, rel=0.01)
        level = noise_level(run.outputs["theta"], run.t)
        assert level == pytest.approx(2 * np.pi / 4096 / np.sqrt(12), rel=0.15)


def test_autocorrelation_leaves_gaps_out(rng):
    r = rng.normal(size=4000)
    coloured = np.convolve(r, np.ones(2) / 2, "valid")
    coloured[500:700] = np.nan
    rho = autocorrelation([coloured], 5)
    assert rho[0] == 1
    assert rho[1] == pytest.approx(0.5, abs=0.05)
    assert np.abs(rho[2:]).max() < 0.06


def test_times_that_wander_a_little_change_nothing(rng):
    y = speed() + 0.3 * rng.standard_normal(N)
    assert noise_level(y, T + 1e-8 * rng.standard_normal(N)) == pytest.approx(noise_level(y, T), rel=1e-3)
    assert noise_level(y, T) == noise_level(y, None)


@pytest.mark.parametrize("step", [0.3, 2.0])
def test_a_step_is_found_in_a_signal_that_passes_many_at_once(step, rng):
    y = np.round((20 * speed() + 2 * step * rng.standard_normal(N)) / step) * step
    assert quantum(y) == pytest.approx(step, rel=1e-6)
    assert quantum(y + 0.3 * step * rng.standard_normal(N)) == 0.0


def test_a_sensor_that_is_read_more_often_than_it_measures_has_the_noise_of_its_measurements(rng):
    t = 1e-3 * np.arange(4000)
    measured = 20 * np.sin(3 * t) + 0.1 * rng.normal(size=4000)
    held = measured[np.arange(4000) // 8 * 8]
    assert noise_level(held, t) == pytest.approx(0.1, rel=0.3)


def test_a_short_rest_tells_nothing_of_the_noise(rng):
    """A logger that writes zeros before it begins has no noise of one unit."""
    t, zero = np.arange(3000) * 1e-3, np.zeros(10)
    moving = np.sin(3 * t) + 0.01 * rng.standard_normal(t.size)
    long = mi.Experiment(t, {"v": np.sign(np.sin(9 * t))}, {"omega": moving})
    rest = mi.Experiment(t[:10], {"v": zero}, {"omega": zero})
    alone, both = (noise_of(runs, ("omega",))["omega"] for runs in ([long], [rest, long]))
    assert both == alone == pytest.approx(0.01, rel=0.1)
    assert noise_of([rest], ("omega",))["omega"] > 0
    assert not repeated([rest, long], [rest]), "a rest is no record"
    dead = long.with_(outputs={"i": np.full(long.n, np.nan), **long.outputs})
    assert repeated([dead], [dead]), "whatever other channel is empty"


def test_levels_of_a_coarse_counter_are_no_slow_sensor(rng):
    """A speed of few counts per sample, whose period varies: it stays at one level or the other, now and then between.

    The steps alone made 2.6 rad/s of rounding look like 12.
    """
    period = np.where(rng.random(1000) < 0.1, 0.011, 0.010)
    counts = np.where(rng.random(1000) < 0.12, 9, 10)
    y = np.concatenate([np.zeros(100), counts * 0.0523 / period])
    assert noise_level(y) < 5
