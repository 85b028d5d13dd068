"""The benchmark on real records: its search, its clock and its figures, on the smallest case."""

from __future__ import annotations

import contextlib
import json
import time

import bench_real
import brute_force
import pytest
from real_cases import CASES

from motorid.effects import LIBRARY

SMALL = CASES["unmotor_closed"]


def test_error_of_several_channels_is_their_geometric_mean():
    assert brute_force.figure({"i": 0.04, "omega": 0.01}) == pytest.approx(0.02)


def test_work_that_takes_too_long_is_stopped():
    def forever():
        while True:
            with contextlib.suppress(Exception):
                time.sleep(0)

    with pytest.raises(brute_force.OutOfTime):
        brute_force.within(0.05, forever)


def test_an_unknown_record_is_named():
    with pytest.raises(SystemExit, match="no case called fibbo"):
        bench_real.chosen("fibbo")


def test_without_the_records_it_says_where_to_put_them(tmp_path, monkeypatch):
    monkeypatch.setenv("MOTORID_REAL_DATA", str(tmp_path / "none"))
    monkeypatch.setattr("sys.argv", ["bench_real.py"])
    with pytest.raises(SystemExit, match="MOTORID_REAL_DATA"):
        bench_real.main()


@pytest.mark.slow
def test_every_case_has_runs_to_fit_and_runs_held_out(real):
    for case in CASES.values():
        fitted, held = case.parts(real)
        assert {r.channels for r in fitted} == {r.channels for r in held}, case.name
        assert all(r.n > 50 for r in (*fitted, *held)), case.name


@pytest.mark.slow
def test_a_diagnosis_gets_its_regret_from_a_search_that_can_be_taken_up_again(real, tmp_path, monkeypatch):
    few = {n: LIBRARY[n] for n in ("gravity", "coulomb", "stribeck", "current_lag")}
    monkeypatch.setattr(brute_force, "LIBRARY", few)
    monkeypatch.setattr(brute_force, "WIDTHS", (brute_force.Width("full", 4, 1, 1),))
    journal, file, parts = tmp_path / "fits.jsonl", tmp_path / "best.json", SMALL.parts(real)
    ladder = [{"added": None}, {"added": "gravity"}, {"added": "coulomb", "removed": ["gravity"]}]
    found = [{"case": SMALL.name, "ladder": ladder}]
    brute_force.search_all([SMALL], {SMALL.name: parts}, journal, file, found=found)
    table = json.loads(file.read_text())
    entry = table[SMALL.name]
    rows = [json.loads(line) for line in journal.read_text().splitlines()]
    assert {"refused" in r.get("failed", "") for r in rows if set(r["effects"]) >= {"coulomb", "stribeck"}} == {True}
    assert entry["best"]["figure"] == min(r["figure"] for r in rows if "failed" not in r)

    row = bench_real.with_regret(bench_real.diagnosed(SMALL, parts), SMALL, parts, table)
    assert row["best"]["error"] == pytest.approx(entry["best"]["figure"], rel=1e-3)  # stored values judge the same
    assert row["regret"] == pytest.approx(row["end"] / row["best"]["error"])
    assert row["not_in_table"]
    assert f"regret {row['regret']:.3f}" in "\n".join(bench_real.lines(row))

    def no_fit(*_):
        raise AssertionError("fitted again")

    monkeypatch.setattr(brute_force, "fitted", no_fit)
    brute_force.search_all([SMALL], {SMALL.name: parts}, journal, file)
    assert json.loads(file.read_text()) == table
