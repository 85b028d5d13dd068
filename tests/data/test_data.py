"""The shipped records against their seeds, and where motorid finds them."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from plant_truth import by_expm

from motorid.errors import DataError
from motorid.records import datasets

DATA = datasets.data_path()

# ---------------------------------------------------------------- shipped records


def test_two_step_is_exact(plant):
    p = plant.Motor("truth", **datasets.truth("two_step")["parameters"], v_max=12, i_max=8)
    for level in (6, 8):
        d = pd.read_csv(datasets.data_path(f"two_step/step_{level}V.csv"))
        assert list(d) == ["t_s", "voltage_V", "current_A", "speed_rad_s"]
        assert len(d) == 1200
        x = by_expm(p, d["t_s"].to_numpy(), d["voltage_V"].to_numpy())
        assert d["current_A"].to_numpy() == pytest.approx(x[:, 0], abs=1e-10 * x[:, 0].max())
        assert d["speed_rad_s"].to_numpy() == pytest.approx(x[:, 1], abs=1e-10 * x[:, 1].max())
        assert np.array_equal(d["voltage_V"], np.where(np.arange(1200) < 20, 0, level))


@pytest.mark.parametrize("run", ["run1", "run2", "check1"])
def test_hidden_friction_is_what_truth_says_and_not_a_plain_motor(plant, run):
    d = pd.read_csv(datasets.data_path(f"hidden_friction/{run}.csv"))
    known = datasets.truth("hidden_friction")
    motor = plant.Motor("truth", **known["parameters"], v_max=12, i_max=8)
    for effects, fits in ((known["effects"], True), ({}, False)):
        r = plant.simulate(motor, effects, d["time_s"].to_numpy(), d["voltage_V"].to_numpy())
        rms_i, rms_w = np.std(d["current_A"] - r["i"]), np.std(d["speed_rad_s"] - r["omega"])
        if fits:
            assert rms_i == pytest.approx(known["sigma"]["i"], rel=0.1)
            assert rms_w == pytest.approx(known["sigma"]["omega"], rel=0.1)
        else:
            assert rms_i > 10 * known["sigma"]["i"]
            assert rms_w > 10 * known["sigma"]["omega"]


def make_data(*words, cwd=DATA.parent):
    command = [sys.executable, str(DATA / "make_data.py"), *words]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, check=False)


QUICK = ("two_step", "two_step_noisy", "two_step_small", "hidden_friction")


def test_shipped_records_are_what_their_seeds_give_bit_for_bit():
    done = make_data("--check", "--only", *QUICK)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_all_other_shipped_records_are_what_their_seeds_give_bit_for_bit():
    done = make_data("--check", "--only", *(n for n in datasets.datasets() if n not in QUICK))
    assert done.returncode == 0, done.stdout + done.stderr


def test_one_digit_changed_in_a_shipped_record_is_found(tmp_path):
    made = make_data("--out", str(tmp_path), "--only", "two_step")
    assert made.returncode == 0, made.stderr
    assert json.loads((tmp_path / "truth.json").read_text(encoding="utf-8")).keys() == {"two_step"}
    file = tmp_path / "two_step" / "step_6V.csv"
    assert file.read_bytes() == datasets.data_path("two_step/step_6V.csv").read_bytes()
    file.write_bytes(file.read_bytes().replace(b"0.021,6,2.3", b"0.021,6,2.4", 1))
    done = make_data("--check", "--out", str(tmp_path), "--only", "two_step")
    assert done.returncode == 1
    assert "step_6V.csv: differs at line 23" in done.stdout
    file.unlink()
    assert "step_6V.csv: missing" in make_data("--check", "--out", str(tmp_path), "--only", "two_step").stdout


def test_data_folder_is_small_and_lists_every_record():
    shipped = {f.relative_to(DATA).as_posix() for f in DATA.glob("*/*.csv")}
    told = {f for name in datasets.datasets() for f in datasets.truth(name)["files"]}
    assert shipped == told
    assert sum((DATA / f).stat().st_size for f in shipped) < 2e6
    for name in datasets.datasets():
        if not name.startswith("two_step"):
            assert {f"{name}/run1.csv", f"{name}/run2.csv", f"{name}/check1.csv"} <= told


def test_the_plant_shares_no_code_with_the_models():
    sources = [*DATA.glob("*.py"), *DATA.glob("plant/*.py")]
    assert len(sources) >= 8
    for source in sources:
        for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not any(n.split(".")[0] in ("motorid", "casadi", "scipy") for n in names), source.name


# ---------------------------------------------------------------- motorid.datasets


def test_shipped_sets_are_found_by_name():
    hidden = {f"hidden_{n}" for n in ("friction", "heating", "cogging", "brush", "two", "coast", "sag")}
    assert hidden | {"two_step", "two_step_noisy", "clean"} <= set(datasets.datasets())
    assert (datasets.data_path() / "truth.json").is_file()
    assert datasets.data_path("two_step/step_6V.csv").is_file()
    assert datasets.truth("hidden_friction")["effects"] == {"coulomb": {"tau_c": 8e-3}}
    assert datasets.truth("clean")["effects"] == {}


def test_a_wrong_name_is_answered_with_the_near_one():
    with pytest.raises(DataError, match="Did you mean 'hidden_friction'"):
        datasets.data_path("hiden_friction")
    with pytest.raises(DataError, match=r"Did you mean 'two_step/step_6V.csv'"):
        datasets.data_path("two_step/step_6v.csv")
    with pytest.raises(DataError, match="Did you mean 'clean'"):
        datasets.truth("claen")


def test_an_installed_wheel_finds_the_data_inside_the_package(tmp_path, monkeypatch):
    package = tmp_path / "site" / "motorid"
    (package / "data").mkdir(parents=True)
    monkeypatch.setattr(datasets, "__file__", str(package / "records" / "datasets.py"))
    with pytest.raises(DataError, match=r"looked for truth\.json in"):
        datasets.datasets()
    (package / "data" / "truth.json").write_text("{}", encoding="utf-8")
    assert datasets.data_path() == package / "data"
    monkeypatch.delitem(sys.modules, "motorid_plant", raising=False)
    with pytest.raises(DataError, match="motor plant was expected at"):
        datasets.load_plant()


def test_the_plant_is_loaded_once():
    assert datasets.load_plant() is datasets.load_plant()
    assert Path(datasets.load_plant().__file__).parent == DATA / "plant"
