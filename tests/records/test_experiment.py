"""One run is validated once and cannot be changed afterwards; its copies keep what belongs together."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest

from motorid.errors import DataError, UsageError
from motorid.records.experiment import Experiment, between_pauses, split
from motorid.records.reading import read_csv, write_csv

N = 40
T = np.arange(N) * 0.01


def make(**changes) -> Experiment:
    fields = {"t": T, "inputs": {"v": np.sin(T)}, "outputs": {"i": np.cos(T), "omega": 2 * T},
              "sigma": {"i": 0.1}, "name": "lab",
              "meta": {"notes": ["a"], "extra": {"temp": np.arange(N)}}} | changes
    return Experiment(**fields)


@pytest.mark.parametrize(("changes", "says"), [
    ({"t": T[:5], "inputs": {"v": T[:5]}, "outputs": {"i": T[:5]}}, "at least 8 samples; this one has 5"),
    ({"t": np.zeros(N)}, "sample 1 .* does not come after sample 0"),
    ({"t": T[::-1]}, "strictly"),
    ({"t": np.where(T > 0.2, np.nan, T)}, "time of sample 21 is not a finite"),
    ({"t": np.zeros((N, 2))}, "one dimension"),
    ({"t": "abc"}, "real numbers"),
    ({"t": T.astype(complex)}, "real numbers"),
    ({"t": T.astype("datetime64[s]")}, "real numbers"),
    ({"t": T[1:]}, "'v' has 40 samples but time has 39"),
    ({"inputs": {"u": T}}, "unknown input channel 'u'. Known: v"),
    ({"inputs": {}}, "inputs must be a mapping"),
    ({"inputs": T}, "inputs must be a mapping"),
    ({"inputs": {"v": np.where(T > 0.3, np.nan, T)}}, "'v' is missing or infinite in 9 of 40"),
    ({"inputs": {"v": [*T[1:], "x"]}}, "real numbers"),
    ({"outputs": {}}, "outputs must be a mapping"),
    ({"outputs": {"speed": T}}, "unknown output channel 'speed'"),
    ({"outputs": {"omgea": T}}, "Did you mean 'omega'"),
    ({"outputs": {"omega": np.full(N, np.nan)}}, "no output channel has a single value"),
    ({"outputs": {"omega": np.where(T > 0.3, np.inf, T)}}, "infinite"),
    ({"outputs": {"omega": T[:-1]}}, "39 samples but time has 40"),
    ({"hold": "foh"}, "unknown hold 'foh'.*zoh, linear"),
    ({"sigma": {"i": 0.0}}, "sigma of 'i' must be a positive number"),
    ({"sigma": {"i": -1}}, "positive"),
    ({"sigma": {"i": np.nan}}, "positive"),
    ({"sigma": {"i": "small"}}, "positive"),
    ({"sigma": {"speed": 1.0}}, "unknown channel in sigma 'speed'"),
    ({"sigma": 0.1}, "'sigma' must be a mapping"),
    ({"units": {"omega": "rpm"}}, "kept in rad/s or m/s, not in 'rpm'"),
    ({"units": {"w": "rad/s"}}, "unknown channel in units"),
    ({"outputs": {"omega": T, "theta": T}, "units": {"theta": "m", "omega": "rad/s"}}, "does not go with"),
    ({"meta": [1]}, "'meta' must be a mapping"),
])
def test_what_is_wrong_is_refused_and_said(changes, says):
    with pytest.raises(DataError, match=says) as caught:
        make(**changes)
    assert str(caught.value).startswith("lab: ")


def test_missing_samples_stay_missing():
    run = make(outputs={"i": np.ma.masked_greater(T, 0.3), "omega": [None, *T[1:]]})
    assert np.isnan(run.outputs["i"]).sum() == 9
    assert np.isnan(run.outputs["omega"][0])


def test_nothing_can_be_changed_afterwards():
    t, v = T.copy(), np.sin(T)
    run = make(t=t, inputs={"v": v})
    t[0], v[0] = -99, -99
    assert run.t[0] == 0
    assert run.inputs["v"][0] == 0
    with pytest.raises(ValueError, match="read-only"):
        run.t[0] = 1
    with pytest.raises(ValueError, match="read-only"):
        run.outputs["i"][0] = 1
    for change in (lambda: run.inputs.__setitem__("v", t), lambda: run.meta.__setitem__("a", 1)):
        with pytest.raises((TypeError, AttributeError)):
            change()
    with pytest.raises(AttributeError):
        run.name = "other"  # type: ignore[misc]


def test_properties_and_units():
    run = make()
    assert (run.n, run.channels) == (N, ("i", "omega"))
    assert run.dt == pytest.approx(0.01)
    assert run.duration == pytest.approx(0.39)
    assert run.units == {"v": "V", "i": "A", "omega": "rad/s"}
    assert run.t.dtype == run.inputs["v"].dtype == np.float64
    assert make(outputs={"theta": T, "omega": T}, units={"theta": "m"}).units["omega"] == "m/s"
    assert make(units={"v": "N·m"}).units["v"] == "N·m"
    assert make(outputs={"theta": T, "i": T, "omega": T}).channels == ("i", "omega", "theta")
    assert make(t=np.cumsum([0.01] * 30 + [9.0] * 10)).dt == pytest.approx(0.01)


def test_the_repr_is_one_short_line():
    assert repr(make()) == "<Experiment 'lab': v → i, omega; 40 samples, 0.39 s>"


def test_runs_are_compared_by_identity_and_can_be_keys():
    a, b = make(), make()
    assert a != b
    assert len({a, b, a}) == 2


def _echo(run: Experiment) -> tuple[Experiment, bool]:
    return run, bool(run.t.flags.writeable)


def assert_same(a: Experiment, b: Experiment) -> None:
    np.testing.assert_array_equal(a.t, b.t)
    for mine, theirs in ((a.inputs, b.inputs), (a.outputs, b.outputs)):
        assert list(mine) == list(theirs)
        for c in mine:
            np.testing.assert_array_equal(mine[c], theirs[c])
    for field in ("sigma", "hold", "units", "name"):
        assert getattr(a, field) == getattr(b, field)
    assert list(a.meta) == list(b.meta)


def test_a_run_survives_copying_and_pickling():
    run = make(hold="linear", outputs={"i": np.where(T > 0.2, np.nan, T)})
    for again in (copy.copy(run), copy.deepcopy(run), pickle.loads(pickle.dumps(run))):
        assert_same(again, run)
        assert not again.outputs["i"].flags.writeable


def test_a_run_reaches_another_process():
    run = make()
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        again, writeable = pool.submit(_echo, run).result(timeout=60)
    assert_same(again, run)
    assert not writeable


def test_with_replaces_fields_and_validates_again():
    run = make()
    assert run.with_(name="b", hold="linear").hold == "linear"
    assert run.with_(outputs={"omega": T}).units == {"v": "V", "omega": "rad/s"}
    assert run.with_(outputs={"omega": T}).sigma == {}
    assert run.with_(sigma=None).sigma == {}
    with pytest.raises(DataError):
        run.with_(t=T[::-1])
    with pytest.raises(UsageError, match="unknown field 'time'"):
        run.with_(time=T)


def test_without_takes_a_channel_away():
    run = make().without("i")
    assert run.channels == ("omega",)
    assert run.sigma == {}
    assert run.units == {"v": "V", "omega": "rad/s"}
    with pytest.raises(UsageError, match="unknown output channel 'theta'"):
        run.without("theta")
    with pytest.raises(DataError, match="at least one"):
        run.without("omega")


def test_select_by_slice_mask_or_index_takes_everything_along():
    run = make()
    for which in (slice(10, 20), (T > 0.095) & (T < 0.195), np.arange(10, 20)):
        part = run.select(which)
        np.testing.assert_allclose(part.t, T[10:20])
        np.testing.assert_allclose(part.inputs["v"], np.sin(T[10:20]))
        np.testing.assert_allclose(part.outputs["omega"], 2 * T[10:20])
        np.testing.assert_array_equal(part.meta["extra"]["temp"], np.arange(10, 20))
        assert part.sigma == run.sigma
        assert part.meta["notes"] == ["a"]
    with pytest.raises(UsageError, match="a mask needs 40"):
        run.select(T[:5] > 0)
    with pytest.raises(UsageError, match="slice, a mask or indices"):
        run.select([3, 99])
    with pytest.raises(DataError, match="at least 8"):
        run.select(slice(0, 3))


def test_decimate_picks_outputs_and_keeps_the_integral_of_a_held_input():
    v = np.zeros(N)
    v[5] = 4.0  # a pulse that picking would lose
    run = make(inputs={"v": v})
    coarse = run.decimate(4)
    np.testing.assert_array_equal(coarse.t, T[::4])
    np.testing.assert_array_equal(coarse.outputs["omega"], 2 * T[::4])
    np.testing.assert_allclose(coarse.inputs["v"], [0, 1, 0, 0, 0, 0, 0, 0, 0, 0], atol=1e-12)
    assert run.with_(hold="linear").decimate(4).inputs["v"].max() == 0
    load = make(inputs={"v": v, "tau_load": v}).decimate(4)
    np.testing.assert_array_equal(load.inputs["tau_load"], v[::4])  # goes on between samples
    np.testing.assert_array_equal(run.decimate(1).inputs["v"], v)
    uneven = make(t=np.cumsum(np.linspace(0.01, 0.05, N)), inputs={"v": np.sin(np.arange(N))})
    fine, wide = np.diff(uneven.t), np.diff(uneven.decimate(3).t)
    whole = uneven.decimate(3)
    last = 3 * len(wide)
    held = np.sum(uneven.inputs["v"][:last] * fine[:last])
    assert np.sum(whole.inputs["v"][:-1] * wide) == pytest.approx(held)
    for wrong in (0, -1, 1.5):
        with pytest.raises(UsageError, match="whole number"):
            run.decimate(wrong)


def test_split_gives_contiguous_blocks_that_lose_nothing():
    blocks = split(make(), 3)
    assert [b.name for b in blocks] == ["lab[1/3]", "lab[2/3]", "lab[3/3]"]
    np.testing.assert_array_equal(np.concatenate([b.t for b in blocks]), T)
    assert max(b.n for b in blocks) - min(b.n for b in blocks) <= 1
    assert split(make(), 1)[0].n == N
    with pytest.raises(DataError, match="at least 8"):
        split(make(), 6)
    with pytest.raises(UsageError):
        split(make(), 0)


@pytest.fixture(params=["clock starts again", "pause", "resumed"])
def parted(request, tmp_path, rng):
    """Two parts in one run, as a file or an array has them, with spikes that count in either part by itself."""
    rows, begins = [], {"clock starts again": 0.0, "pause": 0.9, "resumed": 0.502}[request.param]
    for first, n, volt in ((0.0, 251, 6.0), (begins, 301, -4.0)):
        omega = volt * (1 - np.exp(-np.arange(n) / 40)) + 0.01 * rng.normal(size=n)
        omega[[80, 120, 160, 200]] += 30
        volts = np.where(np.arange(n) < 200, volt, volt / 2) + 0.01 * rng.normal(size=n)
        rows += [f"{first + 2e-3 * k:.3f},{v:.4f},{w:.4f}" for k, (v, w) in enumerate(zip(volts, omega, strict=True))]
    told = ["# part begins: 0.502000"] if request.param == "resumed" else []
    path = tmp_path / "run.csv"
    path.write_text("\n".join(["time_s,voltage_V,speed_rad_s", *told, *rows]), encoding="utf-8")
    return read_csv(path)


@pytest.mark.parametrize("change", [
    lambda r: r.decimate(3), lambda r: r.decimate(30), lambda r: r.delayed(0.013), lambda r: r.delayed(-0.013),
    lambda r: r.without_spikes(),
    lambda r: r.with_(t=1.3 * r.t + 0.3), lambda r: r.select(slice(40, 400)), lambda r: r.decimate(2).decimate(2)])
def test_nothing_of_a_part_goes_into_the_next_and_none_is_lost(parted, change, tmp_path):
    changed = change(parted)
    again = read_csv(write_csv(changed, tmp_path / "again.csv"))
    first, second = between_pauses(parted)
    assert (first.n, second.n) == (251, 301)
    apart = [change(first), change(second)]
    if changed.n == 360:  # a slice of the whole is another one in each part
        apart = [first.select(slice(40, None)), second.select(slice(0, 149))]
    for parts in (between_pauses(changed), between_pauses(again)):
        assert [p.n for p in parts] == [p.n for p in apart]
        for mine, alone in zip(parts, apart, strict=True):
            np.testing.assert_allclose(mine.inputs["v"], alone.inputs["v"], atol=1e-9)
            np.testing.assert_array_equal(mine.outputs["omega"], alone.outputs["omega"])


def test_parts_are_not_those_of_other_samples(parted):
    other = parted.with_(t=parted.t[:300], inputs={"v": np.ones(300)}, outputs={"omega": np.ones(300)})
    assert sum(p.n for p in between_pauses(other)) == 300


@pytest.mark.parametrize("extra", ["a note", None, [1, 2], {"motorid part": 3}, {"motorid part": np.array(["a"] * 50)},
                                   {"motorid part": np.where(np.arange(50) == 20, np.nan, 0.0)}])
def test_what_a_user_keeps_beside_a_run_makes_no_parts(extra):
    run = Experiment(np.arange(50) * 1e-3, {"v": np.ones(50)}, {"omega": np.arange(50.0)}, meta={"extra": extra})
    assert between_pauses(run) == [run]


def test_short_parts_and_spikes_that_are_few_in_each_part_are_not_lost():
    t = np.concatenate([np.arange(500) * 1e-3, 1 + np.arange(5) * 1e-3, 2 + np.arange(500) * 1e-3])
    speed = 100 + 0.1 * np.random.default_rng(0).normal(size=1005)
    speed[[100, 300, 600, 800]] = 500
    run = Experiment(t, {"v": np.ones(1005)}, {"omega": speed})
    assert run.decimate(1).n == 1005
    assert np.isnan(run.without_spikes().outputs["omega"]).sum() == 4
    assert run.select(np.r_[0:10, 510:1005]).running_median(15).n == 505
