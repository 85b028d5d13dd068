"""A user's mistake gives one clear sentence on standard error and exit status 2; failed work gives 1."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from broken_inputs import BROKEN, Broken
from command import Done, motorid

from motorid.cli import options as cli_options
from motorid.errors import FitError, MissingDependency, SimulationError
from motorid.records.datasets import data_path

RUN = data_path("two_step") / "step_6V.csv"


def wrong(done: Done, *says: str) -> None:
    """Assert that one clear sentence about the user's mistake came, and nothing else."""
    assert done.status == 2, (done.out, done.err)
    assert done.out == ""
    assert done.err.startswith("motorid: ")
    assert len(done.err.splitlines()) == 1
    assert 25 < len(done.err) < 1200
    assert not re.search(r"\w=\{|(?<!@)\bmi\.|\bmodel\.\w+\(|\b(engine|hold|units|columns)='", done.err), done.err
    for word in says:
        assert word in done.err


def test_all_that_is_missing_is_said_at_once_with_the_option_that_names_it(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("a,b c,d\n" + "".join(f"{k},{k},{k}\n" for k in range(30)))
    wrong(motorid("check", path), "the time (t)", "the drive voltage (v)", "speed (omega)",
          '--columns "t=a,v=b c,omega=d"', "--dt 0.001")
    path.write_text("t,steps(4),in(8bits)\n" + "".join(f"{k},{k},{k}\n" for k in range(30)))
    wrong(motorid("check", path), '--columns "v=steps(4),omega=in(8bits)"')  # brackets mean something to a shell


def test_a_current_is_no_drive_voltage():
    wrong(motorid("fit", RUN, "--units", "v=A"), "v is in A", "a commanded current or torque drives --drive torque")


def test_samples_a_fixed_time_apart_may_be_told(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("voltage (V),speed (rad/s)\n" + "".join(f"{6 * (k > 5)},{k}\n" for k in range(200)))
    wrong(motorid("check", path), "--dt 0.001")
    done = motorid("check", path, "--dt", "0.01")
    assert done.status == 0, done.err
    assert "1.99 s" in done.out


@pytest.mark.parametrize("broken", BROKEN, ids=lambda b: b.name)
def test_broken_records(broken: Broken, tmp_path):
    """Sixty kinds of files and descriptions of files that cannot be used."""
    words = [broken.make(tmp_path)]
    words += ["--columns", broken.columns] if broken.columns else []
    words += ["--units", broken.units] if broken.units else []
    wrong(motorid("fit", *words), broken.says)


@pytest.mark.parametrize(("words", "says"), [
    (["fit"], "Missing argument"),
    (["fti"], "Did you mean 'fit'"),
    (["fit", RUN, "--efects", "coulomb"], "--effects"),
    (["fit", RUN, "--effects"], "requires an argument"),
    (["fit", RUN, "--validate"], "requires an argument"),
    (["fit", RUN, "--validate", "nowhere.csv"], "no file nowhere.csv"),
    (["fit", RUN, "--effects", "coulom"], "Did you mean 'coulomb'"),
    (["fit", RUN, "--effects", "coulomb,coulomb"], "Take it out first: leave coulomb out of --effects."),
    (["fit", RUN, "--effects", "coulomb,stribeck"], "same friction twice"),
    (["fit", RUN, "--set", "R"], "name=value"),
    (["fit", RUN, "--set", "R=one"], "'one' is not a number"),
    (["fit", RUN, "--set", "Q=1"], "unknown parameter 'Q'"),
    (["fit", RUN, "--set", "R=-1"], "must be positive"),
    (["fit", RUN, "--fix", "R=0"], "'R' must be positive, got 0. Say what it is, in SI units, or leave it to"),
    (["fit", RUN, "--fix", "b=-1"], "set it to zero and fix it: --fix b=0"),
    (["fit", RUN, "--set", "R=nan"], "finite"),
    (["fit", RUN, "--fix", "M"], "unknown parameter 'M'"),
    (["fit", RUN, "--free", "x"], "unknown parameter 'x'"),
    (["fit", RUN, "--fix", "R=1,L=0,K=1,b=0,J=1"], "nothing"),
    (["fit", RUN, "--fix", "R"], "R is to be fixed, but at which value? Give it, in SI units: --fix R=…."),
    (["fit", RUN, "--fix", "R,J,b", "--set", "J=1e-5"], "R and b are to be fixed"),
    (["fit", RUN, "--drive", "steam"], "unknown drive 'steam'"),
    (["fit", RUN, "--drive", "torque", "--effects", "brush_drop"], "brush_drop"),
    (["fit", RUN, "--solver", "simplex"], "unknown solver 'simplex'"),
    (["fit", RUN, "--formulation", "soft"], "unknown formulation 'soft'"),
    (["fit", RUN, "--formulation", "hard", "--solver", "lm"], "multiple-shooting"),
    (["fit", RUN, "--formulation", "penalty", "--solver", "multiple-shooting"], "--solver lm"),
    (["fit", RUN, "--current-limit", "5"], "--formulation"),
    (["fit", RUN, "--current-limit", "much", "--formulation", "penalty"], "--current-limit"),
    (["fit", RUN, "--current-limit", "-3", "--formulation", "penalty"], "positive current"),
    (["fit", RUN, "--engine", "steam"], "unknown engine 'steam'"),
    (["fit", RUN, "--initial", "maybe"], "unknown initial state 'maybe'"),
    (["fit", RUN, "--loss", "heavy"], "unknown loss 'heavy'"),
    (["fit", RUN, "--hold", "spline"], "hold"),
    (["fit", RUN, "--median", "4"], "odd number"),
    (["fit", RUN, "--ignore", "thata"], "unknown measured channel 'thata'"),
    (["fit", RUN, "--ignore", "i,omega"], "measured"),
    (["fit", RUN, "--columns", "t:time"], "name=value"),
    (["fit", RUN, "--units", "omega=furlong"], "unknown unit 'furlong'"),
    (["fit", RUN, "--effects-from", "nowhere.py"], "no file nowhere.py"),
    (["fit", RUN, "--json", "no/such/folder/fit.json"], "cannot write"),
    (["fit", RUN, "--report", "no/such/folder/fit.html"], "cannot write"),
    (["simulate", "nowhere.json", RUN], "cannot read nowhere.json"),
    (["simulate", RUN, RUN], "cannot read step_6V.csv"),
    (["diagnose", RUN, "--max-effects", "-1"], "max-effects"),
    (["robustness", RUN, "--starts", "0"], "starts"),
    (["robustness", RUN, "--spread", "0.5"], "spread"),
    (["fit-many", "nowhere"], "not a folder"),
    (["export", "nowhere.json", "x", "--to", "fortran"], "unknown form 'fortran'"),
    (["demo", "--out", RUN], "cannot write"),
], ids=lambda v: "-".join(Path(str(w)).name for w in v) if isinstance(v, list) else "")
def test_wrong_words(words, says, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    wrong(motorid(*words), says)


@pytest.mark.parametrize(("text", "says"), [
    ("def f(:\n", "SyntaxError"),
    ("import nothing_like_this\n", "ModuleNotFoundError"),
    ("1 / 0\n", "ZeroDivisionError"),
    ("x = 1\n", "defines no effect"),
    ("import motorid as mi\n@mi.effect(balance='torque')\ndef f(m, a=1.0):\n    pass\n", "needs a default P("),
    ("import motorid as mi\n@mi.effect(balance='heat')\ndef f(m):\n    pass\n", "unknown balance 'heat'"),
])
def test_broken_files_of_effects(tmp_path, text, says):
    path = tmp_path / "own.py"
    path.write_text(text)
    wrong(motorid("fit", RUN, "--effects-from", path), says, str(path))


def test_an_effect_that_writes_nonsense_is_named(tmp_path):
    path = tmp_path / "own.py"
    path.write_text("import motorid as mi\n@mi.effect(balance='torque')\ndef odd(m, a=mi.P(1.0, 'N·m')):\n"
                    "    m.torque -= a * m.temperature\n")
    wrong(motorid("fit", RUN, "--effects", "odd", "--effects-from", path), "odd", "temperature")


@pytest.mark.parametrize(("contents", "says"), [
    ({}, "not a fitted model"),
    ([1, 2], "cannot read fit.json"),
    ({"model": {"base": "steam_engine", "effects": []}, "parameters": {}}, "steam_engine"),
    ({"model": {"base": "dc_motor", "effects": ["coulom"]}, "parameters": {}}, "Did you mean 'coulomb'"),
    ({"model": {"base": "dc_motor", "effects": []}, "parameters": {"R": {"value": "x", "fixed": False}}},
     "damaged: 'R' is missing or wrong"),
    ({"model": {"base": "dc_motor", "effects": []}, "parameters": {"R": {"value": None}}}, "'R' is missing or wrong"),
    ({"model": {"base": "dc_motor", "effects": []}, "parameters": {"R": 5}}, "'R' is missing or wrong"),
    ({"model": {"base": "dc_motor", "effects": []}, "parameters": None}, "'parameters' is missing or wrong"),
    ({"model": None, "parameters": None}, "'model' is missing or wrong"),
    ({"model": {"base": "dc_motor", "effects": []}, "parameters": {"Q": {"value": 1, "fixed": False}}}, "Q"),
], ids=str)
def test_json_that_is_no_fit(tmp_path, contents, says):
    path = tmp_path / "fit.json"
    path.write_text(json.dumps(contents))
    wrong(motorid("simulate", path, RUN), says)


def failing(error: Exception) -> Callable[..., None]:
    def fail(*_: object, **__: object) -> None:
        raise error
    return fail


@pytest.mark.parametrize("error", [FitError("the solver gave up: try another start."),
                                   SimulationError("it left the finite numbers at t = 1 s."),
                                   MissingDependency("this needs pyarrow: pip install 'motorid[parquet]'.")])
def test_work_that_fails_gives_one_sentence_and_status_1(monkeypatch, error):
    monkeypatch.setattr(cli_options, "fit", failing(error))
    done = motorid("fit", RUN)
    assert (done.status, done.err) == (1, f"motorid: {error}\n")


def test_a_mistake_of_ours_is_not_hidden(monkeypatch):
    monkeypatch.setattr(cli_options, "fit", failing(RuntimeError("a bug")))
    with pytest.raises(RuntimeError, match="a bug"):
        motorid("fit", RUN)


def test_a_fit_that_ends_badly_gives_status_1(monkeypatch):
    from dataclasses import replace

    real = cli_options.fit
    monkeypatch.setattr(cli_options, "fit", lambda *a, **k: replace(real(*a, **k), status="failed"))
    done = motorid("fit", RUN)
    assert done.status == 1
    assert "failed" in done.out


@pytest.mark.parametrize(("words", "says"), [
    (["fit", "nowhere.csv"], "no file nowhere.csv"),
    (["fit", str(RUN), "--effects", "coulom"], "Did you mean 'coulomb'"),
    (["fit", "--nonsense"], "No such option"),
])
def test_a_real_process_shows_no_traceback(tmp_path, words, says):
    command = [sys.executable, "-m", "motorid", *words]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, encoding="utf-8", timeout=300)
    wrong(Done(done.returncode, done.stdout, done.stderr), says)
