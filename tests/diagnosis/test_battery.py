"""The battery of hidden effects: what it covers, how it is scored, and a small part of it run."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from battery import cases as battery
from battery.score import figures, run_case

import motorid as mi
from motorid.effects import LIBRARY

HERE = Path(__file__).parents[1]
PART = ("magnetic_saturation", "coulomb_coloured", "driver_dead_band+magnetic_saturation", "none_outliers",
        "driver_one_quadrant", "angle_lag", "current_average", "compliance_load_side")


def test_the_battery_covers_what_it_promises():
    of = {
        kind: [c for c in battery.CASES.values() if c.kind == kind]
        for kind in ("single", "pair", "none", "outside", "twins")
    }
    assert len(battery.CASES) >= 40
    assert {e for c in of["single"] for e in c.effects} == set(LIBRARY)
    assert len(of["pair"]) >= 10
    assert all(len(c.effects) == 2 for c in of["pair"])
    assert len(of["none"]) >= 5
    assert not any(c.effects for c in of["none"])
    assert len(of["outside"]) >= 2
    assert not any(set(c.effects) & set(LIBRARY) for c in of["outside"])
    assert len(of["twins"]) >= 3
    assert all(c.twins for c in of["twins"])
    every = battery.CASES.values()
    assert len({c.motor for c in every}) >= 4
    assert len({words.split()[0] for c in every for words in (*c.train, c.check)}) >= 7
    assert len({c.chain for c in every}) >= 5
    assert {c.channels for c in every} >= {
        ("omega",),
        ("theta",),
        ("i", "theta"),
        ("i", "omega"),
        ("i", "omega", "theta"),
    }


@pytest.mark.parametrize("name", ["coulomb_closed_loop", "none_uneven", "load_or_coulomb_forward"])
def test_records_are_reproducible_and_moderate(name):
    case = battery.CASES[name]
    (runs, check), (again, _) = case.records(), case.records()
    limit = battery.P.MOTORS[case.motor].i_max
    for r, s in zip((*runs, *check), again, strict=False):
        assert np.array_equal(r.outputs["i"], s.outputs["i"])
    for r in (*runs, *check):
        assert 600 <= r.n <= 2000
        assert np.abs(r.outputs["i"]).max() <= 1.3 * limit
    if name == "load_or_coulomb_forward":  # nothing in these records turns backward
        assert all(r.outputs["omega"].min() > 0 for r in runs)


def _row(**what):
    return {
        "kind": "single",
        "first_right": True,
        "set_right": True,
        "alarm": True,
        "forced": True,
        "group_said": False,
        "ratio": 1.0,
        "cpu": 1.0,
    } | what


def test_the_figures_count_failures():
    rows = [
        _row(),
        _row(first_right=False, ratio=1.2),
        _row(kind="pair", set_right=False),
        _row(kind="none", alarm=True),
        _row(kind="none", alarm=False),
        _row(kind="outside"),
        {"case": "x", "error": "no"},
    ]
    said = figures(rows)
    assert said["cases"] == "6 of 7 ran"
    assert said["first effect right"].startswith("2/3")
    assert said["whole set right, pairs"].startswith("0/1")
    assert said["false alarms"].startswith("1/2")
    assert said["forced on outside cases"].startswith("1/1")
    assert said["held-out within 10 %"].startswith("4/5")


@pytest.mark.slow
@pytest.mark.parametrize("name", PART)
def test_a_part_of_the_battery_is_right(name):
    row = run_case(battery.CASES[name])
    if row["kind"] == "none":
        assert not row["alarm"], row["text"]
    elif row["kind"] == "outside":
        assert row["verdict"] == "unexplained"
        assert not row["forced"], row["text"]
    else:
        assert row["visible"] > 1.3  # it matters
        assert row["first_right"], row["text"]
        assert row["set_right"], row["text"]
        assert row["ratio"] < 1.1


@pytest.mark.slow
def test_the_script_runs_cases_and_goes_on_where_it_stopped(tmp_path):
    command = [
        sys.executable,
        str(HERE / "battery" / "run.py"),
        "--cases",
        "none_white",
        "--out",
        str(tmp_path),
        "--scatter",
    ]
    first = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert first.returncode == 0, first.stderr
    assert "none_white" in first.stdout
    row = json.loads((tmp_path / "none_white.json").read_text())
    assert row["verdict"] == "adequate"
    assert (tmp_path / "battery.csv").read_text().count("\n") == 2
    assert (tmp_path / "scatter.png").stat().st_size > 5000
    again = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert again.returncode == 0
    assert not again.stdout.startswith(("ok", "WRONG"))  # nothing was run again
    unknown = subprocess.run(
        [*command[:3], "no_such", *command[4:]], capture_output=True, text=True, timeout=60, check=False
    )
    assert unknown.returncode != 0
    assert "no_such" in unknown.stderr


@pytest.mark.parametrize(("name", "rival"), [("coulomb+cogging", "eddy_brake"),
                                             ("quadratic_drag+voltage_offset", "speed_offset"),
                                             ("coulomb+speed_lag", "speed_average")])
def test_what_does_as_well_as_the_first_effect_alone_is_no_rival_once_the_second_is_known(name, rival):
    case = battery.CASES[name]
    runs, check = case.records()
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs), check, effects=[*case.effects, rival])
    assert next(c for c in found.ranking if c.effect == rival).reason.startswith("lowers the held-out error")
    assert set(found.effects) == set(case.effects)
    assert found.groups == ()
    assert found.rivals == (found.best,)
    assert rival not in found.text


def test_a_bridge_that_opens_at_zero_alone_is_no_one_quadrant_drive():
    """The wider law does the same there; on a tie the smaller one is told."""
    runs, check = battery.CASES["driver_coast"].records()
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs), check, effects=("driver_coast", "driver_one_quadrant"))
    assert (found.effects, found.groups) == (("driver_coast",), ())
