"""The commands do what section by section their help says: JSON, tables, exit status."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from command import motorid, motorid_json
from typer.main import get_command

import motorid as mi
from motorid.cli.app import app
from motorid.cli.console import _spread, next_command, show, wrapped
from motorid.cli.diagnose import _next_step
from motorid.cli.fit import _held_out
from motorid.display.cards import Table
from motorid.records.datasets import data_path, truth
from motorid.records.reading import read_runs, write_csv

FRICTION = data_path("hidden_friction")
STEPS = data_path("two_step")
NOISY = data_path("two_step_noisy")

OWN_EFFECT = '''
import motorid as mi

@mi.effect(balance="torque")
def square_root_drag(m, c_r=mi.P(1e-4, "N·m", null=0.0, lower=0.0)):
    """A made-up drag that grows with the root of the speed."""
    m.torque -= c_r * m.sign(m.omega) * (m.omega**2 + 1e-6) ** 0.25
'''


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> tuple[Path, dict]:
    """``fit --json`` of Coulomb friction on the records that hide it, with a held-out record."""
    folder = tmp_path_factory.mktemp("fitted")
    contents = motorid_json(folder, "fit", FRICTION / "run*.csv", "--effects", "coulomb",
                            "--validate", FRICTION / "check*.csv")
    return folder / "result.json", contents


@pytest.fixture(scope="module")
def speed_only(tmp_path_factory) -> Path:
    """The noisy steps without their current."""
    folder = tmp_path_factory.mktemp("speed")
    for run in read_runs(NOISY):
        write_csv(run.without("i"), folder / f"{run.name}.csv")
    return folder


# -- fit ---------------------------------------------------------------------------------------------------
def test_fit_json_has_the_fields_of_the_contract(fitted):
    _, found = fitted
    assert found["model"]["base"] == "dc_motor"
    assert found["model"]["effects"] == ["coulomb"]
    for name, p in found["parameters"].items():
        assert {"value", "std", "unit", "fixed"} <= set(p), name
    assert set(found["nrmse"]) == set(found["rmse"]) == set(found["validation_nrmse"]) == {"i", "omega"}
    assert set(found["derived"]) == {"tau_e", "tau_m", "damping"}
    assert found["violations"] == {}
    assert (found["engine"], found["formulation"], found["status"]) == ("rosenbrock", "plain", "converged")
    for key in ("chi2", "dof", "iterations", "seconds"):
        assert found[key] > 0, key
    assert isinstance(found["message"], str)


def test_fit_finds_the_hidden_friction_and_says_how_certain_it_is(fitted):
    _, found = fitted
    hidden = truth("hidden_friction")
    tau_c = found["parameters"]["tau_c"]
    assert tau_c["value"] == pytest.approx(hidden["effects"]["coulomb"]["tau_c"], abs=4 * tau_c["std"])
    for name in "RLKbJ":
        p = found["parameters"][name]
        assert p["value"] == pytest.approx(hidden["parameters"][name], abs=5 * p["std"]), name
    assert found["parameters"]["sgn_width"]["fixed"]
    assert max(found["validation_nrmse"].values()) < 0.02


def test_fit_prints_values_with_errors_units_and_the_held_out_error():
    done = motorid("fit", FRICTION / "run*.csv", "--effects", "coulomb",
                   "--validate", FRICTION / "check1.csv")
    assert done.status == 0
    assert re.search(r"R\s+1\.37\d+ ± 0\.000\d+ Ω\s+winding resistance", done.out)
    assert re.search(r"tau_c\s+\(8\.0\d+ ± 0\.0\d+\)·10⁻³ N·m", done.out)
    for word in ("NRMSE", "RMSE", "held-out", "(electrical)", "damping ratio", "as a voltage",
                 "steady state", "Fits:", "run1", "run2", "converged", "chosen from the data"):
        assert word.lower() in done.out.lower(), word
    assert done.err == ""


def test_fixed_parameters_are_said_to_be_fixed(tmp_path):
    found = motorid_json(tmp_path, "fit", STEPS, "--fix", "L=0.0017,K", "--set", "K=0.0462")
    assert {n for n, p in found["parameters"].items() if p["fixed"]} == {"L", "K"}
    assert found["parameters"]["L"]["value"] == 0.0017
    assert found["parameters"]["K"] == {"value": 0.0462, "std": 0.0, "unit": "N·m/A", "fixed": True}
    assert "(fixed)" in motorid("fit", STEPS, "--fix", "L=0.0017").out


def test_two_step_without_noise_gives_the_truth_from_the_automatic_guess(tmp_path):
    found = motorid_json(tmp_path, "fit", STEPS)
    for name, value in truth("two_step")["parameters"].items():
        assert found["parameters"][name]["value"] == pytest.approx(value, rel=1e-3), name


@pytest.mark.parametrize("engine", ["cvodes", "idas"])
def test_the_engine_can_be_chosen(tmp_path, engine):
    found = motorid_json(tmp_path, "fit", STEPS / "step_6V.csv", "--engine", engine)
    assert found["engine"] == engine
    assert found["parameters"]["R"]["value"] == pytest.approx(1.38, rel=1e-3)


def test_json_goes_to_standard_output_and_nothing_else_does():
    done = motorid("fit", STEPS / "step_6V.csv", "--json", "-")
    assert json.loads(done.out)["status"] == "converged"


def test_without_current_the_fit_says_what_is_determined_and_that_r_and_k_are_not(tmp_path, speed_only):
    """A record of voltage and speed alone determines three numbers; no confident R, b, J may come of it."""
    found = motorid_json(tmp_path, "fit", speed_only)
    assert all(found["parameters"][n]["std"] is None for n in ("R", "b", "J"))
    said = " ".join(motorid("fit", speed_only).out.split())
    assert "The current was not measured" in said
    assert "--fix R=1.2,K=0.05" in said
    fixed = motorid_json(tmp_path, "fit", speed_only, "--fix", "R=1.38,K=0.0462")
    assert all(found["std"] is not None for found in fixed["parameters"].values()), "the advice must be enough"
    assert "not determined" in said
    for name in ("gain", "time_constant"):  # what voltage and speed alone do tell comes first
        known = found["determined"][name]
        assert known["std"] < 0.01 * known["value"], name
    assert said.index("speed per voltage") < said.index("R, L, K, b, J not determined")
    assert found["derived"] == {"tau_e": None, "tau_m": None, "damping": None}


def test_with_r_and_friction_given_the_speed_alone_determines_the_rest(tmp_path, speed_only):
    found = motorid_json(tmp_path, "fit", speed_only, "--fix", "R=1.38,L=0.00172,b=6.5e-5")
    for name, value in (("K", 0.0462), ("J", 2.35e-5)):
        p = found["parameters"][name]
        assert p["value"] == pytest.approx(value, rel=0.01)
        assert p["std"] is not None, name


def test_a_channel_can_be_left_out(tmp_path, speed_only):
    words = ("fit", "--fix", "R=1.38,L=0.00172,b=6.5e-5")
    without = motorid_json(tmp_path, *words, NOISY, "--ignore", "i")
    assert set(without["nrmse"]) == {"omega"}
    absent = motorid_json(tmp_path, *words, speed_only)
    assert without["parameters"]["J"]["value"] == pytest.approx(absent["parameters"]["J"]["value"], rel=1e-6)


def test_set_is_a_start_and_not_a_hold(tmp_path):
    found = motorid_json(tmp_path, "fit", STEPS / "step_6V.csv", "--set", "R=5", "--set", "K=0.2,L=0.01")
    assert found["parameters"]["R"]["value"] == pytest.approx(1.38, rel=1e-3)


def test_a_torque_drive_on_a_linear_axis_is_shown_as_mass_and_force(tmp_path):
    t = np.arange(0, 2, 0.01)
    u = np.where(t < 1, 2.0, -2.0)
    speed = np.where(t < 1, 1 - np.exp(-t), (1 - np.exp(-1)) * np.exp(-(t - 1)) - (1 - np.exp(-(t - 1))))
    path = tmp_path / "axis.csv"
    path.write_text("time_s,voltage_V,speed_m_s\n" + "".join(
        f"{a:.3f},{b:g},{c:.9f}\n" for a, b, c in zip(t, u, speed, strict=True)))
    found = motorid_json(tmp_path, "fit", path, "--drive", "torque", "--set", "g=10")
    assert found["model"] == {"base": "torque_driven", "axis": "linear", "effects": []}
    assert [found["parameters"][n]["unit"] for n in ("g", "b", "J")] == ["N/V", "N·s/m", "kg"]
    assert found["parameters"]["J"]["value"] == pytest.approx(20, rel=0.01)  # 20 N for 1 m/s², 1 s
    assert found["parameters"]["g"]["fixed"]
    assert found["derived"]["tau_e"] is None


def test_columns_and_units_are_taken_as_named(tmp_path):
    run = read_runs(STEPS / "step_6V.csv")[0]
    path = tmp_path / "odd.csv"
    rows = zip(run.t * 1e3, run.inputs["v"], run.outputs["omega"] * 30 / np.pi, run.outputs["i"], strict=True)
    path.write_text("a,b,c,d\n" + "".join(f"{a:.6f},{b:.6f},{c:.9f},{d:.9f}\n" for a, b, c, d in rows))
    found = motorid_json(tmp_path, "fit", path, "--columns", "t=a,v=b,omega=c,i=d",
                         "--units", "t=ms,omega=rpm")
    assert found["parameters"]["K"]["value"] == pytest.approx(0.0462, rel=1e-3)


def test_an_effect_of_ones_own_takes_part(tmp_path):
    (tmp_path / "own.py").write_text(OWN_EFFECT)
    own = ("--effects-from", tmp_path / "own.py")
    found = motorid_json(tmp_path, "fit", FRICTION / "run1.csv", "--effects", "square_root_drag", *own)
    assert found["model"]["effects"] == ["square_root_drag"]
    assert found["parameters"]["c_r"]["value"] > 0
    again = motorid("simulate", tmp_path / "result.json", FRICTION / "run1.csv", *own)
    assert again.status == 0
    alone = motorid("simulate", tmp_path / "result.json", FRICTION / "run1.csv")
    assert alone.status == 2
    assert "--effects-from" in alone.err


def test_penalty_formulation_weighs_the_current_limit(tmp_path):
    words = ("fit", STEPS / "step_6V.csv", "--formulation", "penalty")
    free, held = motorid_json(tmp_path, *words), motorid_json(tmp_path, *words, "--current-limit", "2.5")
    assert (free["formulation"], held["formulation"]) == ("penalty", "penalty")
    assert held["parameters"]["R"]["value"] > 1.05 * free["parameters"]["R"]["value"]
    assert held["violations"]["CurrentLimit(2.5 A), A"] > 0.01
    assert not any(name.startswith("Current") for name in free["violations"])


def test_hard_formulation_keeps_the_current_limit(tmp_path):
    found = motorid_json(tmp_path, "fit", STEPS / "step_6V.csv", "--formulation", "hard", "--current-limit", "2.5")
    assert (found["formulation"], found["status"]) == ("hard", "converged")
    assert max(found["violations"].values()) < 1e-6
    assert found["multipliers"][0]["constraint"] == "CurrentLimit(2.5 A)"
    assert found["multipliers"][0]["value"] > 0
    text = motorid("fit", STEPS / "step_6V.csv", "--formulation", "hard", "--current-limit", "2.5").out
    assert "Constraints" in text


def test_multiple_shooting_without_constraints_agrees_with_least_squares(tmp_path):
    shot = motorid_json(tmp_path, "fit", NOISY, "--solver", "multiple-shooting")
    plain = motorid_json(tmp_path, "fit", NOISY)
    assert shot["formulation"] == plain["formulation"] == "plain"
    for name, p in plain["parameters"].items():
        assert shot["parameters"][name]["value"] == pytest.approx(p["value"], abs=0.05 * p["std"]), name


def test_huber_loss_forgives_outliers(tmp_path):
    run = read_runs(NOISY / "run1.csv")[0]
    speed = run.outputs["omega"].copy()
    speed[40::37] = 250.0
    write_csv(run.with_(outputs={**run.outputs, "omega": speed}), tmp_path / "spikes.csv")
    error = {}
    for loss in ("squares", "huber"):
        found = motorid_json(tmp_path, "fit", tmp_path / "spikes.csv", "--loss", loss)
        error[loss] = abs(found["parameters"]["K"]["value"] / 0.0462 - 1)
    assert error["huber"] < 0.5 * error["squares"]


def test_a_record_fitted_and_held_out_at_once_is_remarked():
    done = motorid("fit", STEPS / "step_6V.csv", "--validate", STEPS / "step_6V.csv")
    assert "both fitted and held out" in " ".join(done.out.split())


def test_a_report_is_written(tmp_path):
    page = tmp_path / "fit.html"
    done = motorid("fit", STEPS / "step_6V.csv", "--report", page)
    assert done.status == 0
    assert "winding resistance" in page.read_text(encoding="utf-8")


# -- simulate ----------------------------------------------------------------------------------------------
def test_simulate_repeats_the_held_out_error_of_the_fit(fitted, tmp_path):
    path, found = fitted
    again = motorid_json(tmp_path, "simulate", path, FRICTION / "check1.csv", "--out", tmp_path / "sim")
    for channel, error in found["validation_nrmse"].items():
        assert again["nrmse"][channel] == pytest.approx(error, rel=1e-6), channel
    written = read_runs(again["files"])[0]
    measured = read_runs(FRICTION / "check1.csv")[0]
    e = written.outputs["omega"] - measured.outputs["omega"]
    rms = np.sqrt(np.mean(e**2) / np.mean(measured.outputs["omega"] ** 2))
    assert rms == pytest.approx(again["nrmse"]["omega"], rel=1e-2)


@pytest.mark.parametrize("name", ["motor.casadi", "motor.c", "motor.json"])
def test_export_writes_every_form(fitted, tmp_path, name):
    path, _ = fitted
    done = motorid("export", path, tmp_path / name)
    assert done.status == 0, done.err
    assert "noise" not in done.out
    assert (tmp_path / name).stat().st_size > 500
    assert name in " ".join(done.out.split())


def test_who_exports_a_fit_of_what_is_mostly_noise_is_told(rng, tmp_path):
    t = np.arange(600) * 0.01
    run = mi.Experiment(t, {"v": np.where(t < 0.01, 0.0, 6.0)}, {"omega": 20 + 60 * rng.normal(size=600)})
    path, said = write_csv(run, tmp_path / "noisy.csv"), "This fit is of records that are mostly noise"
    motorid_json(tmp_path, "fit", path)
    fit = mi.fit(mi.dc_motor(), run)
    assert fit.mostly_noise
    for saved in (tmp_path / "result.json", fit.save(tmp_path / "fit.json")):
        assert said in " ".join(motorid("export", saved, tmp_path / "motor.json", "--force").out.split())
    with pytest.warns(UserWarning, match="records that are mostly noise: its values mean little"):
        mi.export(fit, tmp_path / "motor.json", force=True)


def test_export_to_json_and_casadi_come_back(fitted, tmp_path):
    path, found = fitted
    for form in ("json", "casadi"):
        assert motorid("export", path, tmp_path / "motor", "--to", form).status == 0
        again = motorid_json(tmp_path, "simulate", tmp_path / "motor", FRICTION / "check1.csv")
        assert again["nrmse"]["omega"] == pytest.approx(found["validation_nrmse"]["omega"], rel=1e-3)


def test_a_held_inductance_of_zero_comes_back(tmp_path):
    found = motorid_json(tmp_path, "fit", STEPS / "step_6V.csv", "--fix", "L=0")
    (tmp_path / "fit.json").write_text((tmp_path / "result.json").read_text())
    again = motorid_json(tmp_path, "simulate", tmp_path / "fit.json", STEPS / "step_6V.csv")
    assert again["nrmse"]["omega"] == pytest.approx(found["nrmse"]["omega"], rel=1e-3)


# -- diagnose, identifiability, robustness, fit-many ---------------------------------------------------------
@pytest.mark.slow
def test_diagnose_names_the_missing_effect_and_processes_share_the_work(tmp_path):
    page = tmp_path / "found.html"
    asked = ("diagnose", FRICTION / "run*.csv", "--validate", FRICTION / "check*.csv", "--max-effects", "1")
    found = motorid_json(tmp_path, *asked, "--report", page)
    shared = motorid_json(tmp_path, *asked, "--jobs", "2")
    judged = [[(c["effect"], c["accepted"], c["reason"]) for c in each["ranking"]] for each in (found, shared)]
    assert (shared["answer"], judged[1]) == (found["answer"], judged[0])
    drops = [[c["predicted_drop"] for c in each["ranking"]] for each in (found, shared)]
    assert drops[1] == pytest.approx(drops[0], rel=1e-6, abs=1e-9)  # but for what arithmetic leaves
    assert (found["verdict"], found["where"], found["effects"]) == ("missing", "mechanical", ["coulomb"])
    assert [step["added"] for step in found["ladder"]] == [None, "coulomb"]
    assert found["ladder"][1]["validation_nrmse"]["omega"] < 0.2 * found["ladder"][0]["validation_nrmse"]["omega"]
    assert {"effect", "predicted_drop", "refit_drop", "validation_nrmse", "group", "parameters",
            "accepted"} <= set(found["ranking"][0])
    assert {"text", "location", "parameters_before", "parameters_after", "suggestion"} <= set(found)
    assert "coulomb" in page.read_text(encoding="utf-8")


def test_identifiability_tells_what_is_determined(tmp_path, speed_only):
    full = motorid_json(tmp_path, "identifiability", STEPS)
    assert {"singular_values", "condition_number", "rank", "parameters", "weak_directions",
            "std"} <= set(full)
    assert (full["rank"], full["weak_directions"]) == (5, [])
    lost = motorid_json(tmp_path, "identifiability", speed_only)
    assert lost["rank"] < 5
    assert lost["weak_directions"][0]["text"]
    assert None in lost["std"].values()


def test_robustness_counts_where_the_starts_end(tmp_path):
    found = motorid_json(tmp_path, "robustness", NOISY, "--starts", "6", "--spread", "5")
    assert (found["starts"], found["spread"]) == (6, 5)
    assert found["good"] + found["poor"] + found["failed"] == 6
    assert found["good"] == 6
    assert set(found["parameters"]["R"]) == {"reference", "mean", "std"}
    assert set(found["nrmse"]) == {"i", "omega"}


def test_fit_many_keeps_a_failed_motor_as_a_row(tmp_path):
    for name, source in (("one", STEPS), ("two", NOISY)):
        (tmp_path / "motors" / name).mkdir(parents=True)
        for file in source.glob("*.csv"):
            (tmp_path / "motors" / name / file.name).write_bytes(file.read_bytes())
    (tmp_path / "motors" / "three.csv").write_text("no record at all\n")
    found = motorid_json(tmp_path, "fit-many", tmp_path / "motors", "--out", tmp_path / "table.csv")
    rows = {r["motor"]: r for r in found["rows"]}
    assert rows["one"]["R"] == pytest.approx(1.38, rel=1e-3)
    assert rows["three"]["status"] == "failed"
    assert "rows of at least two numbers" in rows["three"]["message"]
    assert len((tmp_path / "table.csv").read_text().splitlines()) == 4


def test_fit_many_takes_several_folders_and_says_what_fits_poorly(tmp_path):
    for folder, source in (("a", STEPS), ("b", data_path("hidden_friction"))):
        (tmp_path / folder).mkdir()
        file = min(source.glob("*.csv"))
        (tmp_path / folder / "m1.csv").write_bytes(file.read_bytes())
    done = motorid("fit-many", tmp_path / "a", tmp_path / "b")
    assert "2 of 2 motors fitted" in done.out
    assert "1 of 2 motors fit poorly, errors over 3 times the noise: b/m1" in done.out
    assert " Ω" in done.out


# -- the whole ---------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_demo_tells_the_story_and_leaves_figures_and_report(tmp_path):
    out = tmp_path / "story"
    found = motorid_json(tmp_path, "demo", "--out", out)
    assert found["effects"] == ["coulomb"]
    held_out = [step["validation_nrmse"]["omega"] for step in found["ladder"]]
    assert held_out[-1] < 0.2 * held_out[0]
    assert {Path(f).name for f in found["files"]} == {"report.html", "fit.png", "missing.png", "ladder.png"}
    assert all(Path(f).stat().st_size > 5000 for f in found["files"])


@pytest.mark.parametrize("command", ["demo", "fit", "simulate", "diagnose", "identifiability", "robustness",
                                     "fit-many", "export", "record", "bench"])
def test_every_command_has_help_with_an_example(command):
    done = motorid(command, "--help")
    text = " ".join(done.out.split())
    assert done.status == 0
    assert "Usage:" in text
    if command not in ("record", "bench"):
        assert f"Example: motorid {command}" in text


def test_every_command_that_fits_takes_all_of_fits_options():
    group = app
    from typer.main import get_command

    commands = get_command(group).commands  # type: ignore[attr-defined]  # Typer makes a group of several
    options = {name: {o for p in c.params for o in p.opts} for name, c in commands.items()}
    shared = {"--effects", "--fix", "--set", "--drive", "--solver", "--formulation", "--current-limit",
              "--engine", "--columns", "--units", "--effects-from", "--json"}
    for name in ("fit", "diagnose", "identifiability", "robustness", "fit-many"):
        assert shared <= options[name], name
    for name in ("fit", "diagnose", "identifiability", "robustness"):
        assert "--report" in options[name], name
    assert "--validate" in options["fit"] & options["diagnose"]
    assert {"--starts", "--spread"} <= options["robustness"]
    assert "--max-effects" in options["diagnose"]


@pytest.mark.parametrize(("words", "spread"), [
    ("a --validate b c --json d", "a --validate b --validate c --json d"),
    ("a --validate b", "a --validate b"),
    ("--validate b --validate c", "--validate b --validate c"),
    ("a --validate --json d", "a --validate --json d"),
    ("a -- --validate b c", "a -- --validate b c"),
])
def test_validate_takes_all_names_up_to_the_next_option(words, spread):
    assert _spread(words.split()) == spread.split()


def test_without_a_command_the_help_comes_and_with_version_the_version():
    assert "Commands" in motorid().out
    assert re.fullmatch(r"motorid \S+", motorid("--version").out.strip())


def test_it_runs_as_a_process_of_its_own(tmp_path):
    """The installed script's way in, from another folder, output piped."""
    command = [sys.executable, "-m", "motorid", "fit", str(STEPS / "step_6V.csv"), "--json", "f.json"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, encoding="utf-8", timeout=300)
    assert done.returncode == 0, done.stderr
    assert "winding resistance" in done.stdout
    assert json.loads((tmp_path / "f.json").read_text(encoding="utf-8"))["status"] == "converged"


# -- before a fit ------------------------------------------------------------------------------------------
def test_check_shows_which_column_is_which_channel_and_what_to_type_next(tmp_path):
    done = motorid("check", FRICTION / "run*.csv")
    assert done.status == 0
    for word in ("voltage_V", "current_A", "rad/s", "No problem found", "Next: motorid fit"):
        assert word in done.out, word
    assert set(motorid_json(tmp_path, "check", FRICTION / "run1.csv")["runs"][0]["columns"]) == {"t", "v", "i", "omega"}
    rows = "".join(f"{0.01 * k:.2f},{0.5 * (k % 9)},{k % 50}\n" for k in range(300))
    (tmp_path / "rig.csv").write_text("time_s,command (Nm),speed (rad/s)\n" + rows)
    driven = motorid("check", tmp_path / "rig.csv", "--columns", "v=command (Nm)")
    assert "--drive torque" in driven.out.splitlines()[-1]  # however long the path


@pytest.mark.parametrize(("unit", "word"), [("Nm", "torque"), ("A", "current"), ("V", "command")])
def test_check_takes_the_drive_as_fit_does_and_says_what_drives(unit, word, tmp_path, monkeypatch):
    """It knew no --drive, called a torque a voltage, and took one in volts for the voltage of a winding."""
    t = np.arange(300) * 0.01
    rows = zip(t, 1 + np.arange(300) // 30 % 3, 0.01 * t, 1e6 * t, strict=True)
    path = tmp_path / "rig.csv"
    path.write_text(f"time_s,drive ({unit}),motor_A,speed (rad/s)\n" + "".join(
        f"{a:.2f},{b},{c:.5f},{d:.0f}\n" for a, b, c, d in rows))
    words = ["check", str(path), "--drive", "torque", "--columns", f"v=drive ({unit}),i=motor_A"]
    monkeypatch.setattr("sys.argv", ["motorid", *words])
    done = motorid(*words)
    said = " ".join(done.out.split())
    assert done.status == 0, done.err
    assert f"the {word} never reverses in any run" in said
    assert "voltage" not in said
    assert "the current i is not used: a torque-driven model has none." in said
    assert done.out.splitlines()[-1].count("--drive torque") == 1
    assert "voltage over" not in said
    assert motorid(*words[:2], "--drive", "tork").status == 2


def test_effects_lists_the_library_and_shows_one():
    assert re.search(r"coulomb +torque +dry \(Coulomb\) friction +tau_c", motorid("effects").out)
    shown = motorid("effects", "stribeck")
    assert "breakaway torque" in shown.out
    assert "Did you mean 'stribeck'" in motorid("effects", "stribek").err


def test_names_stay_whole_at_80_columns():
    lines = motorid("effects").out.splitlines()
    assert max(map(len, lines)) <= 80
    for name in ("inductance_saturation", "R_thm,", "omega_s"):
        assert any(name in line for line in lines), name


def test_no_table_is_wider_than_80_columns_and_no_number_breaks(capsys):
    done = motorid("fit", FRICTION / "run*.csv", "--effects", "coulomb", "--validate", FRICTION / "check1.csv")
    assert max(len(line) for line in done.out.splitlines() if not line.startswith("Next: motorid")) <= 80  # to copy
    assert re.search(r"b +\(6\.\d+ ± 0\.\d+\)·10⁻⁵ N·m·s/rad +viscous friction", done.out)
    errors = [f"{c}, {what}" for what in ("fitted", "held out") for c in ("current", "speed", "angle")]
    show(Table(["model", *errors], [["DC motor", *6 * ["16.8 %"]], ["+ cogging + gravity", *6 * ["0.261 %"]]]))
    upright = capsys.readouterr().out
    assert upright.count("0.261 %") == 6
    assert re.search(r"angle, held out +16\.8 % +0\.261 %", upright)


def test_headers_share_their_lines_evenly(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    heads = [f"{c}, {what}" for what in ("fitted", "held out") for c in ("current", "speed")]
    rows = [["DC motor", *4 * ["27.3 %"]], ["+ magnetic_saturation", *4 * ["0.815 %"]]]
    show(Table(["model", *heads], 2 * rows))
    first, second, line, *_ = [row.split() for row in capsys.readouterr().out.splitlines() if row.strip()]
    assert first == ["current,", "speed,", "current,", "speed,"]
    assert second == ["model", "fitted", "fitted", "held", "out", "held", "out"]
    assert set("".join(line)) == {"─"}


def test_a_value_keeps_its_error_and_unit_where_a_table_is_narrow(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    rows = [["time constant, slow (mechanical)", "0.112 ± 0.009 s", "1.01 ± 0.14 s"],
            ["speed per voltage, steady", "193.5 ± 1.2 rad/s per V", "442.25 ± 0.31 rad/s per V"]]
    show(Table(["parameter", "before", "after"], rows, left=(0, 1, 2)))
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= 80
    assert "0.112 ± 0.009 s" in shown
    assert "193.5 ± 1.2 rad/s" in shown


def test_what_to_type_next_is_one_line(monkeypatch):
    monkeypatch.chdir(FRICTION)
    runs = ["run1.csv", "../hidden_friction/../hidden_friction/../hidden_friction/run2.csv"]
    monkeypatch.setattr(sys, "argv", ["motorid", "fit", *runs])
    assert f"Next: motorid diagnose {' '.join(runs)}" in motorid("fit", *runs).out.splitlines()
    line = "motorid diagnose run.csv --budget 8 --max-effects=1 --jobs 2 --hold zoh"
    monkeypatch.setattr(sys, "argv", line.split())
    assert next_command("fit") == "motorid fit run.csv --hold zoh", "fit takes no budget, and no jobs"


def test_held_out_errors_are_said_beside_the_noise():
    """A record of smaller signals has a larger NRMSE, and is predicted as well."""
    done = motorid("fit", NOISY / "run1.csv", "--validate", NOISY / "run2.csv")
    assert "Held out: errors at the level of the noise (NRMSE" in done.out
    done = motorid("fit", FRICTION / "run1.csv", "--validate", FRICTION / "check1.csv")
    assert re.search(r"Held out: errors up to \d+ times the noise", done.out)


def test_lines_are_cut_between_words_but_not_before_a_unit():
    text = wrapped("the error of the current is " + "x" * 60 + " about 12.5 % and then more")
    assert "12.5 %" in text
    assert max(map(len, text.splitlines())) <= 80
    assert wrapped(12 * "a long word 1.25 % ").count("1.25 %") == 12
    assert wrapped("Start elsewhere with model.replace(…).") == "Start elsewhere with --set NAME=VALUE."


def test_what_no_effect_and_no_curve_explains_is_looked_at_next_not_exported(monkeypatch):
    """It said to keep the fit and to export it, though the model fails."""
    monkeypatch.setattr(sys, "argv", ["motorid", "diagnose", "run.csv"])
    found = mi.diagnose(mi.fit(mi.dc_motor(), read_runs(NOISY / "run1.csv")), max_effects=0)
    open_ = replace(found, verdict="unexplained", remainder=None)
    assert _next_step(open_).startswith("Next: motorid diagnose run.csv --report found.html")
    assert _next_step(open_, Path("found.html")).startswith("Next: look at found.html.")
    curved = replace(open_, remainder=SimpleNamespace(proposed=True))
    assert "--remainder-to" in _next_step(curved)
    assert "--remainder-to" not in _next_step(curved, None, Path("left.py"))  # it was asked for already
    assert "more time" in _next_step(replace(open_, stopped="the time is up"))
    assert _next_step(replace(open_, verdict="adequate")).endswith("Then: motorid export fit.json motor.casadi")


def test_what_is_mostly_noise_is_recorded_again_whatever_drives_it():
    """A drive that is given a torque was to be recorded with larger steps of the voltage."""
    last = SimpleNamespace(mostly_noise=True, model=mi.torque_driven())
    told = _next_step(SimpleNamespace(stopped="", suggestion=None, remainder=None, effects=(), verdict="adequate",
                                      after=last, text=""))
    assert told.startswith("Next: record again, driven by larger steps or with less noise")
    assert "voltage" not in told


def test_help_cuts_no_name_at_80_columns(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    for name, command in get_command(app).commands.items():
        shown = motorid(name, "--help").out
        for p in command.params:
            assert not p.metavar or p.metavar in shown, (name, p.metavar)
            assert all(o in shown for o in p.opts if o.startswith("--")), name
        assert not re.search(r"<\w", shown), name  # no type of Python


@pytest.mark.parametrize(("times", "told"), [(1.2, "at the level of the noise"), (2.4, "up to 2.4 times the noise"),
                                             (17000, "over 1000 times the noise")])
def test_fitted_and_held_out_errors_are_called_noise_by_one_rule(times, told):
    """Fitted errors were "up to 1.7 times the noise", and held-out ones of 2.4 times "at the level of the noise"."""
    runs = mi.read_runs(data_path("clean") / "run*.csv")
    fit = mi.fit(mi.dc_motor(), runs[:1])
    judged = replace(fit.evaluation, rmse={c: times * s for c, s in fit.noise.items()})
    assert _held_out(fit, judged).startswith(f"Held out: errors {told} (NRMSE")


@pytest.mark.parametrize("command", [["fit"], ["diagnose", "--max-effects", "0"]])
def test_a_held_out_record_of_another_scale_is_told(tmp_path, command):
    """A duty cycle for the voltage makes held-out errors that say nothing of the model."""
    for name, volt in (("run", 1.0), ("check", 12.0)):
        run = mi.read_csv(STEPS / "step_6V.csv")
        write_csv(run.with_(inputs={"v": run.inputs["v"] / volt}), tmp_path / f"{name}.csv")
    found = motorid_json(tmp_path, *command, tmp_path / "run.csv", "--validate", tmp_path / "check.csv")
    assert any("12 times the speed in check as in run" in note for note in found["notes"])


def test_numbers_alone_go_to_the_screen_where_they_were_asked_for(tmp_path):
    """What was written beside them made no JSON of it."""
    run, page = FRICTION / "run1.csv", tmp_path / "page.html"
    assert json.loads(motorid("fit", run, "--json", "-", "--report", page).out)["model"]
    found = json.loads(motorid("diagnose", run, "--max-effects", 0, "--json", "-", "--report", page, "--force").out)
    assert found["verdict"]
    (tmp_path / "motors").mkdir()
    write_csv(read_runs(run)[0], tmp_path / "motors" / "one.csv")
    done = motorid("fit-many", tmp_path / "motors", "--out", tmp_path / "table.csv", "--json", "-")
    assert json.loads(done.out)
    assert (tmp_path / "table.csv").exists()


def test_what_nobody_asked_for_has_the_option_that_does():
    done = motorid("fit", FRICTION / "run1.csv", "--formulation", "hard", "--current-limit", 30)
    assert done.status == 1
    assert "The steady state of --formulation hard cannot be kept" in done.err


def test_a_diagnosis_is_told_from_a_fit(tmp_path):
    motorid_json(tmp_path, "diagnose", FRICTION / "run1.csv", "--max-effects", 0)
    done = motorid("simulate", tmp_path / "result.json", FRICTION / "run1.csv")
    assert done.status == 2
    assert "this is a diagnosis and no fit (motorid fit RUN... --json fit.json writes one)" in done.err


@pytest.mark.parametrize("verdict", ["missing", "adequate"])
def test_the_next_command_reads_the_records_as_the_diagnosis_did(verdict, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["motorid", "diagnose", "run.csv"])
    text = ("The voltage acts 5 ms earlier than it was logged: with --delay=-0.005 the error falls (speed 50 → 2 %), "
            "and this diagnosis uses it. It is linear: with --hold linear the error falls (speed 3 → 2 %), and this "
            "diagnosis uses it. 3 samples are left out: with --no-spikes the error falls (speed 2 → 1 %).")
    last = SimpleNamespace(mostly_noise=False, model=mi.dc_motor() + mi.effects.coulomb)
    found = SimpleNamespace(stopped="", suggestion=None, remainder=None, verdict=verdict, after=last, text=text,
                            effects=("coulomb",) if verdict == "missing" else ())
    assert "--delay=-0.005 --hold=linear --no-spikes --json fit.json" in _next_step(found)


def test_a_voltage_of_zero_is_said_and_no_arithmetic(tmp_path):
    run = read_runs(FRICTION / "run1.csv")[0]
    path = write_csv(run.with_(inputs={"v": 0 * run.inputs["v"]}), tmp_path / "zero.csv")
    done = motorid("diagnose", path)
    assert done.status == 0, done.err
    assert "the voltage is 0 V from beginning to end" in done.out
    assert "Unexplained: " in done.out
    assert "Missing:" not in done.out
