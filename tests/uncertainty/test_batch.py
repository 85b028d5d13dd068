"""Many motors: one table whatever the pool, failures as rows, going on after an interruption, outliers."""

import json
import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pandas as pd
import pytest

import motorid as mi
from motorid.errors import DataError, UsageError
from motorid.numerics.parallel import Parcel
from motorid.records.datasets import truth
from motorid.records.reading import write_csv
from motorid.uncertainty import batch as batch_module
from motorid.uncertainty.batch import fit_many, motors_in, outliers

MOTOR, NOISE = truth("two_step_noisy")["parameters"], {"i": 0.02, "omega": 0.4}


def motors(n, seed=0, odd=None):
    """Records of n motors that scatter by 3 %; `odd` has 40 % more resistance."""
    rng = np.random.default_rng(seed)
    runs = [r.decimate(3) for r in mi.read_runs(f"{mi.data_path('two_step_noisy')}/run*.csv")]
    found = {}
    for k in range(n):
        values = {p: v * np.exp(0.03 * rng.standard_normal()) for p, v in MOTOR.items()}
        values["R"] *= 1.4 if k == odd else 1.0
        shown = mi.simulate(mi.dc_motor(**values), runs, initial="rest")
        found[f"m{k:03d}"] = [s.experiment.with_(outputs={
            c: y + NOISE[c] * rng.standard_normal(len(y)) for c, y in s.outputs.items()}) for s in shown]
    return found


@pytest.fixture(scope="module")
def ten():
    return motors(10, odd=7)


@pytest.fixture(scope="module")
def fitted(ten):
    return fit_many(mi.dc_motor(), ten, quiet=True)


def without_seconds(found):
    return [{k: v for k, v in row.items() if k != "seconds"} for row in found.rows]


def same_rows(found):
    """Equal to the rows of `found` but for their times; sums in threads differ in the last digits."""
    return [{k: pytest.approx(v, rel=1e-9, nan_ok=True) if isinstance(v, float) else v for k, v in row.items()}
            for row in without_seconds(found)]


def test_table_has_values_errors_and_misfit_of_every_motor(fitted):
    table = fitted.table
    assert table.index.tolist() == [f"m{k:03d}" for k in range(10)]
    assert {"status", "message", "flags", "R", "R_std", "nrmse_i", "nrmse_omega", "chi2", "dof"} <= set(table)
    assert table["R_std"].between(1e-4, 1e-2).all()
    assert (table["status"] == "converged").all()


def test_odd_motor_stands_out_and_the_others_do_not(fitted):
    assert {(o.motor, o.parameter) for o in fitted.outliers} == {("m007", "R")}
    assert "above the batch's median" in str(fitted)


def test_failing_motors_are_rows_that_say_why(ten):
    run = ten["m000"][0]
    still = run.with_(inputs={"v": np.zeros(run.n)}, outputs={"i": np.zeros(run.n), "omega": np.zeros(run.n)})
    found = fit_many(mi.dc_motor(), {"good": ten["m001"], "no file": "nowhere/run.csv", "still": [still],
                                     "nothing": []}, quiet=True)
    assert "nowhere" in found.failed["no file"]
    assert "at least one Experiment" in found.failed["nothing"]
    rows = {r["motor"]: r for r in found.rows}
    assert rows["still"]["status"] == "failed" or "R not determined" in rows["still"]["flags"]
    assert rows["good"]["status"] == "converged"
    assert str(found).startswith(("3 of 4", "2 of 4", "1 of 4"))
    assert len(found.table) == 4


def test_a_bug_in_one_motors_fit_does_not_end_the_batch(ten, monkeypatch):
    real = batch_module.fit

    def fit(model, runs, **options):
        if runs[0].t[0] == ten["m001"][0].t[0] and runs[0] is ten["m001"][0]:
            raise ZeroDivisionError("by zero")
        return real(model, runs, **options)

    monkeypatch.setattr(batch_module, "fit", fit)
    monkeypatch.setattr(Parcel, "of", staticmethod(_unpacked))
    found = fit_many(mi.dc_motor(), {k: ten[k] for k in ("m000", "m001", "m002")}, quiet=True)
    assert found.failed == {"m001": "ZeroDivisionError: by zero"}


def _unpacked(content):
    return type("Held", (), {"data": b"", "open": lambda self: content})()


def test_undetermined_parameters_are_flagged_and_empty(ten):
    found = fit_many(mi.dc_motor(), {"m": [r.without("i") for r in ten["m000"]]}, quiet=True)
    assert "R not determined" in found.rows[0]["flags"]
    assert found.rows[0]["R_std"] is None
    assert found.outliers == ()


def test_options_of_fit_reach_every_motor(ten):
    found = fit_many(mi.dc_motor().fix(L=0), {"m": ten["m000"]}, weights="rms", quiet=True)
    assert "L" not in found.parameters
    alone = mi.fit(mi.dc_motor().fix(L=0), ten["m000"], weights="rms")
    other = mi.fit(mi.dc_motor().fix(L=0), ten["m000"])
    assert found.rows[0]["R"] == pytest.approx(alone.values["R"], rel=1e-9)
    assert found.rows[0]["R"] != pytest.approx(other.values["R"], rel=1e-6)


# -- journal ------------------------------------------------------------------------------------------------
def stops_after(n):
    def way(function, tasks):
        for k, task in enumerate(tasks):
            if k == n:
                raise KeyboardInterrupt
            yield function(task)
    return way


def test_interrupted_batch_goes_on_where_it_was(ten, fitted, tmp_path):
    path = tmp_path / "batch.jsonl"
    first = fit_many(mi.dc_motor(), ten, journal=path, map=stops_after(4), quiet=True)
    assert len(first.rows) == 4
    assert "Interrupted after 4 of 10" in str(first)
    done = []

    def counting(function, tasks):
        for task in tasks:
            done.extend(name for name, _ in task[1].open())
            yield function(task)

    second = fit_many(mi.dc_motor(), ten, journal=path, map=counting, quiet=True)
    assert done == [f"m{k:03d}" for k in range(4, 10)]
    assert without_seconds(second) == same_rows(fitted)


def test_journal_cut_off_by_a_crash_is_still_read(ten, tmp_path):
    path = tmp_path / "batch.jsonl"
    few = {k: ten[k] for k in ("m000", "m001")}
    fit_many(mi.dc_motor(), few, journal=path, quiet=True)
    text = path.read_text()
    path.write_text(text[:-40])
    again = fit_many(mi.dc_motor(), few, journal=path, quiet=True)
    assert len(again.rows) == 2
    assert all(json.loads(line) for line in path.read_text().splitlines() if line.endswith("}}"))
    assert path.read_text().count('"m001"') == 2  # the damaged line and its replacement


def test_other_model_options_or_records_are_not_taken_from_the_journal(ten, tmp_path):
    path, one = tmp_path / "batch.jsonl", {"m": ten["m000"]}
    tasks = []

    def spy(function, todo):
        tasks.append(len(todo))
        return map(function, todo)

    for model, options, records in ((mi.dc_motor(), {}, one), (mi.dc_motor(), {}, one),
                                    (mi.dc_motor().fix(L=0), {}, one), (mi.dc_motor(), {"weights": "rms"}, one),
                                    (mi.dc_motor(), {}, {"m": ten["m001"]})):
        fit_many(model, records, journal=path, map=spy, quiet=True, **options)
    assert tasks == [1, 1, 1, 1]  # the second, the same again, was not done


# -- files ---------------------------------------------------------------------------------------------------
def test_folder_has_a_folder_or_a_file_per_motor(ten, tmp_path):
    for k, run in enumerate(ten["m000"]):
        (tmp_path / "left").mkdir(exist_ok=True)
        write_csv(run, tmp_path / "left" / f"run{k}.csv")
    write_csv(ten["m001"][0], tmp_path / "right.csv")
    (tmp_path / "notes").mkdir()
    (tmp_path / ".hidden").mkdir()
    found = motors_in(tmp_path)
    assert {k: len(v) for k, v in found.items()} == {"left": 2, "right": 1}
    table = fit_many(mi.dc_motor(), found, quiet=True).table
    assert table.loc["left", "R"] == pytest.approx(MOTOR["R"], rel=0.15)
    assert (table["status"] == "converged").all()


def test_folder_without_records_is_refused(tmp_path):
    with pytest.raises(DataError, match="holds no records"):
        motors_in(tmp_path)
    with pytest.raises(DataError, match="is not a folder"):
        motors_in(tmp_path / "absent")


def test_table_is_saved_as_its_ending_says(fitted, tmp_path):
    back = pd.read_csv(fitted.save(tmp_path / "t.csv"), index_col="motor")
    np.testing.assert_allclose(back["J"], fitted.table["J"])
    assert pd.read_parquet(fitted.save(tmp_path / "t.parquet"))["R"].tolist() == fitted.table["R"].tolist()
    assert json.loads(fitted.save(tmp_path / "t.json").read_text())[7]["motor"] == "m007"
    with pytest.raises(UsageError, match="saved as"):
        fitted.save(tmp_path / "t.xlsx")
    assert json.dumps(fitted.to_dict())


def test_empty_batch_is_refused():
    with pytest.raises(UsageError, match="motors_in"):
        fit_many(mi.dc_motor(), {})


# -- outliers ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("n", [5, 10, 40, 200])
def test_batch_of_equals_seldom_raises_an_alarm(rng, n):
    alarms = 0
    for _ in range(300):
        x = 1 + 0.03 * rng.standard_normal(n)
        rows = [{"motor": str(k), "R": v, "R_std": 0.01} for k, v in enumerate(x)]
        alarms += bool(outliers(rows, ["R"], frozenset()))
    assert alarms <= 30  # asked for: 1 %; robust scatter of few motors costs some


def test_uncertain_motor_is_no_outlier():
    rows = [{"motor": str(k), "R": 1 + 0.01 * k, "R_std": 0.01} for k in range(10)]
    far = {"motor": "far", "R": 2.0}
    assert [o.motor for o in outliers([*rows, far | {"R_std": 0.01}], ["R"], frozenset())] == ["far"]
    assert not outliers([*rows, far | {"R_std": 0.5}], ["R"], frozenset())
    assert not outliers([*rows, far | {"R_std": None}], ["R"], frozenset())


# -- pools ---------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_spawned_pool_gives_the_same_table(ten, fitted):
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        found = fit_many(mi.dc_motor(), ten, map=pool.map, quiet=True)
    assert without_seconds(found) == same_rows(fitted)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_dask_gives_the_same_table_even_when_a_worker_is_killed(ten, fitted):
    distributed = pytest.importorskip("distributed")
    with (distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as farm,
          distributed.Client(farm) as client):
        way = client.get_executor().map
        assert without_seconds(fit_many(mi.dc_motor(), ten, map=way, quiet=True)) == same_rows(fitted)
        more = {f"{k}-{copy}": v for copy in range(8) for k, v in ten.items()}
        victim = next(iter(client.run(os.getpid).values()))
        threading.Timer(0.5, os.kill, (victim, signal.SIGKILL)).start()
        found = fit_many(mi.dc_motor(), more, map=way, quiet=True)
        assert victim not in client.run(os.getpid).values()
    assert found.failed == {}
    by_name = {r["motor"]: r for r in fitted.rows}
    wanted = [by_name[k.split("-")[0]]["R"] for k in more]
    assert [r["R"] for r in found.rows] == pytest.approx(wanted, rel=1e-9)
