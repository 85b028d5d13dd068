"""A user's mistake, a strange name or a strange terminal is one sentence and a status, never a traceback."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
from command import motorid

import motorid as mi
from motorid.errors import FitError, ModelError
from motorid.records.datasets import data_path

RUN = data_path("two_step") / "step_6V.csv"


def process(*words: object, cwd: object = None, **env: str) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run([sys.executable, "-m", "motorid", *map(os.fspath, map(str, words))], capture_output=True,
                          env={**os.environ, **env}, cwd=cwd, timeout=120)  # type: ignore[call-overload]


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp1252"])
def test_a_terminal_of_few_letters_gets_the_whole_result(encoding):
    done = process("fit", RUN, "--fix", "L=0", PYTHONIOENCODING=encoding)
    assert done.returncode == 0, done.stderr
    assert b"Ohm" in done.stdout
    told = process("fit", RUN, "--fix", "L=0", "--json", "-", PYTHONIOENCODING=encoding)
    assert json.loads(told.stdout.decode("ascii"))["parameters"]["R"]["unit"] == "Ω"


def test_names_with_dollars_or_bytes_that_are_no_text_and_no_such_backend(tmp_path):
    for name in ("a$x_{b$.csv", "bad\udcff.csv"):
        path = tmp_path / name
        path.write_bytes(RUN.read_bytes())
        page, out = tmp_path / "page.html", tmp_path / "fit.json"
        done = motorid("fit", path, "--report", page, "--json", out)
        assert done.status == 0, done.err
        assert json.loads(out.read_text(encoding="utf-8"))["parameters"]
    done = process("fit", RUN, "--report", tmp_path / "other.html", MPLBACKEND="nonsense", SOURCE_DATE_EPOCH="today")
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="a folder in use cannot be removed there")
def test_a_working_directory_that_is_gone(tmp_path):
    gone = tmp_path / "gone"
    gone.mkdir()
    code = ("import os, sys; os.rmdir(os.getcwd()); from motorid.cli import main; sys.argv[1:] = ['fit', 'x.csv']; "
            "main()")
    done = subprocess.run([sys.executable, "-c", code], cwd=gone, capture_output=True, text=True, timeout=60,
                          env={**os.environ, "PYTHONPATH": os.pathsep.join(os.path.abspath(p) for p in sys.path if p)})
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "does not exist any more" in done.stderr


LAWS = {
    "branch": "    if m.omega > 0:\n        m.torque -= c\n",
    "float": "    m.torque -= c * float(m.omega)\n",
    "exit": "    raise SystemExit(3)\n",
    "text": "    m.torque -= 'x'\n",
    "vector": "    m.torque -= ca.vertcat(m.omega, c)\n",
    "endless": "    own.law(m, c)\n",
    "callback": "    m.torque -= c * BOX(m.omega)\n",
    "root": "    m.torque -= c * ca.sqrt(m.omega)\n",
}
OWN = """import casadi as ca
import motorid as mi
class Box(ca.Callback):
    def __init__(self):
        ca.Callback.__init__(self)
        self.construct("box", {})
    def eval(self, arg):
        return [arg[0]]
BOX = Box()
@mi.effect(balance="torque")
def own(m, c=mi.P(1e-4, "N·m", null=0)):
"""


@pytest.mark.parametrize("law", LAWS)
def test_a_law_that_cannot_be_traced_is_said(law, tmp_path):
    path = tmp_path / "own.py"
    path.write_text(OWN + LAWS[law], encoding="utf-8")
    done = motorid("fit", RUN, "--effects-from", path, "--effects", "own")
    assert done.status in (1, 2)
    assert len(done.err.splitlines()) == 1, done.err


@pytest.mark.parametrize("table", [{"t": [], "v": [], "i": []}, {}], ids=["no rows", "no columns"])
def test_an_empty_parquet_file(table, tmp_path):
    pytest.importorskip("pyarrow")
    pd.DataFrame(table).to_parquet(tmp_path / "run.parquet")
    done = motorid("fit", tmp_path / "run.parquet")
    assert (done.status, len(done.err.splitlines())) == (2, 1)


@pytest.mark.parametrize(("seconds", "size"), [(1.0, 1e-300), (1.0, 1e25), (1e-300, 1.0)])
def test_numbers_of_no_motor(seconds, size, tmp_path):
    t = np.linspace(0, 1, 500)
    pd.DataFrame({"time_s": seconds * t, "voltage_V": size * np.sign(np.sin(20 * t)),
                  "current_A": size * np.sin(20 * t)}).to_csv(tmp_path / "run.csv", index=False)
    done = motorid("fit", tmp_path / "run.csv")
    assert done.status in (0, 1, 2)
    assert len(done.err.splitlines()) == (1 if done.status else 0)


def test_a_dead_current_sensor_does_not_end_the_fit():
    run = mi.read_csv(RUN)
    dead = run.with_(outputs={**run.outputs, "i": 0 * run.outputs["i"]})
    assert mi.fit(mi.dc_motor(), dead).std["R"] is None
    assert any("never changes" in text for text in mi.check_runs([dead]))


def test_what_arithmetic_raises_inside_a_fit_is_a_fit_error(monkeypatch):
    """A singular matrix is a failed fit, which one of many may be."""
    from motorid.estimation import fit as module

    for error in (np.linalg.LinAlgError("singular"), ZeroDivisionError("x"), ValueError("array has infs or NaNs")):
        def fail(*_: object, error: Exception = error, **__: object) -> None:
            raise error

        monkeypatch.setattr(module, "with_start_values", fail)
        with pytest.raises(FitError, match="beyond what can be computed"):
            mi.fit(mi.dc_motor(), mi.read_csv(RUN))


def test_a_start_outside_the_limits_is_moved_to_them():
    """So a refit whose start, scaled by tiny records, crosses its limits is a refit like any other."""
    model = (mi.dc_motor() + mi.effects.torque_ripple).bounded(a_r=(0.0, 0.5))
    assert model.start_at({"a_r": 7.0}).values["a_r"] == 0.5
    with pytest.raises(ModelError, match="outside its limits"):
        model.replace(a_r=7.0)


@pytest.mark.parametrize("size", [1e-12, 1e9])
def test_a_diagnosis_of_tiny_and_huge_records_ends_in_a_verdict(size):
    run = mi.read_csv(RUN).decimate(4)
    run = run.with_(inputs={"v": size * run.inputs["v"]}, outputs={c: size * y for c, y in run.outputs.items()})
    tried = ["winding_heating", "brush_drop", "stribeck"]
    found = mi.diagnose(mi.fit(mi.dc_motor(), run), effects=tried, max_effects=1)
    assert found.verdict in ("adequate", "missing", "unexplained")


def test_a_refit_that_cannot_be_begun_is_a_value(monkeypatch):
    from motorid.diagnosis import refit

    fit = mi.fit(mi.dc_motor(), mi.read_csv(RUN).decimate(4))

    def fail(*_: object) -> None:
        raise ModelError("limits that cross")

    monkeypatch.setattr(refit, "_started", fail)
    assert refit.raced(fit, fit.model + mi.effects.coulomb, ({},)) is None


def test_a_name_that_makes_no_name_of_a_function(tmp_path):
    fit = mi.fit(mi.dc_motor().fix(L=0), mi.read_csv(RUN))
    for stem in ("my__motor", '"); system("x', "__", "1 2"):
        mi.export(fit, tmp_path / f"{stem}.c")


def test_trust_is_advised_for_casadi_files_alone(tmp_path):
    for name, advised in (("x.csv", False), ("x.casadi", True)):
        (tmp_path / name).write_text("1,2\n3,4\n", encoding="utf-8")
        with pytest.raises(mi.DataError) as told:
            mi.load(tmp_path / name)
        assert ("trust=True" in str(told.value)) is advised


def test_names_that_no_system_takes(tmp_path):
    """Neither `~x.csv`, which names no user's home, nor one that is too long."""
    (tmp_path / "~x.csv").write_bytes(RUN.read_bytes())
    done = process("fit", "~x.csv", "--fix", "L=0", "--json", "~x.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "~x.json").exists()
    for words in (("fit", "x" * 5000), ("fit", RUN, "--json", tmp_path / ("x" * 5000)), ("simulate", "x" * 5000, RUN)):
        told = motorid(*words)
        assert (told.status, len(told.err.splitlines())) == (2, 1), told


@pytest.mark.skipif(sys.platform == "win32", reason="no such redirection there")
def test_a_terminal_that_is_closed(tmp_path):
    for closed in (">&-", "2>&-", "<&-"):
        line = f'"{sys.executable}" -m motorid fit "{RUN}" --fix L=0 --json "{tmp_path}/fit.json" {closed}'
        done = subprocess.run(line, shell=True, capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, (closed, done.stderr)
        assert "Traceback" not in done.stderr


def test_a_warning_is_a_sentence_without_a_line_of_source():
    code = ("import sys; from motorid.cli.console import prepare_process; prepare_process(); "
            "import warnings; warnings.warn('be careful')")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stderr == "motorid: be careful\n"


def test_an_address_without_its_port_is_said():
    for port in ("socket://127.0.0.1", "socket://"):
        done = motorid("record", "--port", port, "--out", "never.csv", "--excite", "rest:1", "--limit-voltage", 1)
        assert done.status in (1, 2)
        assert "names no port" in done.err


@pytest.mark.parametrize("what", ["SystemExit(0)", "GeneratorExit", "type('Own', (BaseException,), {})"])
def test_whatever_the_file_of_own_effects_raises_is_said(what, tmp_path):
    (tmp_path / "own.py").write_text(f"raise {what}\n", encoding="utf-8")
    done = motorid("fit", RUN, "--effects-from", tmp_path / "own.py", "--effects", "own")
    assert (done.status, len(done.err.splitlines())) == (2, 1), done


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="no folder here that nobody may write to")
def test_a_home_that_cannot_be_written_is_no_news(tmp_path):
    told = {"HOME": "/proc/none", "XDG_CACHE_HOME": "", "XDG_CONFIG_HOME": "", "MPLCONFIGDIR": ""}
    done = process("fit", RUN, "--fix", "L=0", "--report", tmp_path / "page.html", **told)
    assert done.returncode == 0, done.stderr
    assert b"atplotlib" not in done.stderr
    assert len(done.stderr.splitlines()) <= 1  # that nothing is compiled


@pytest.mark.parametrize("end", [("--link", "/dev/null/port"), ("--socket", "{port}")], ids=lambda end: end[0])
def test_a_virtual_port_that_cannot_be_had_is_said(end):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        done = motorid("bench", end[0], end[1].format(port=taken.getsockname()[1]), "--once")
    assert (done.status, len(done.err.splitlines())) == (2, 1), done
    assert "cannot serve" in done.err


def test_lists_in_lists_without_end_are_no_diagnosis_and_no_calibration(tmp_path):
    (tmp_path / "found.json").write_text("[" * 100_000, encoding="utf-8")
    (tmp_path / "bench.toml").write_text("a = " + "[" * 100_000, encoding="utf-8")
    done = motorid("design", tmp_path / "found.json")
    assert done.status == 2
    assert "holds no rival models" in done.err
    with pytest.raises(mi.DataError, match="is not TOML"):
        mi.record(mi.virtual_bench("none"), tmp_path / "run.csv", calibration=tmp_path / "bench.toml")


@pytest.mark.filterwarnings("ignore:SteadyState. no steady part")
def test_a_steady_state_that_no_record_has_asks_for_nothing():
    t = 1e-3 * np.arange(200)
    run = mi.planned(mi.dc_motor(), t, 6 * np.sin(40 * t))
    hard = mi.fit(mi.dc_motor(), run, solver=mi.MultipleShooting(), constraints=[mi.SteadyState()])
    assert hard.status == "converged"


def test_a_constraint_that_is_no_formula_is_said():
    for odd in (lambda m: "x", lambda m: 1 / 0, lambda m: None):
        with pytest.raises(ModelError, match="no formula of i"):
            mi.fit(mi.dc_motor(), mi.read_csv(RUN), penalties=[mi.Constraint(odd, upper=1.0)])


def test_no_memory_left_is_said(monkeypatch):
    def greedy(*_: object, **__: object) -> None:
        raise MemoryError

    monkeypatch.setattr("motorid.cli.options.read_runs", greedy)
    done = motorid("fit", RUN)
    assert done.status == 1
    assert "out of memory" in done.err
