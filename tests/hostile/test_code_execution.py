"""Nothing that is read, and no name, runs code or gives orders to a terminal or a compiler."""

from __future__ import annotations

import json
import os
import re
import shutil
import stat
from binascii import crc_hqx

import casadi as ca
import numpy as np
import pytest
from command import motorid

import motorid as mi
from motorid.acquire.protocol import Decoder, Header
from motorid.exporters.c_code import check
from motorid.exporters.casadi_file import PLAIN, functions_of, simulation
from motorid.integrate import compiled
from motorid.records.datasets import data_path

RUN = data_path("two_step") / "step_6V.csv"
EVIL = "x\x1b]0;owned\x07\x9b31m\u202e*/ int evil(void){return 1;} /*"


@pytest.fixture(scope="module")
def fit() -> mi.Fit:
    return mi.fit(mi.dc_motor() + mi.effects.coulomb, mi.read_csv(RUN))


def crafted(path, mark) -> None:
    """A file whose functions CasADi would compile, with a command of the attacker's as the compiler."""
    x = ca.SX.sym("x")
    options = {"jit": True, "compiler": "shell", "jit_serialize": "source",
               "jit_options": {"compiler": f"touch {mark}; cc", "verbose": False}}
    f = ca.Function("rhs", [x], [x], options) if shutil.which("cc") else ca.Function("rhs", [x], [x])
    file = ca.FileSerializer(str(path), {})
    file.pack([f])
    file.pack("{}")
    del file
    mark.unlink(missing_ok=True)


def test_a_crafted_casadi_file_is_refused_before_casadi_sees_it(tmp_path, monkeypatch):
    path, mark = tmp_path / "m.casadi", tmp_path / "owned"
    crafted(path, mark)
    monkeypatch.setattr(ca, "FileDeserializer", None)  # not even opened
    with pytest.raises(mi.DataError, match="trust=True"):
        mi.load(path)
    done = motorid("simulate", path, RUN)
    assert done.status == 2
    assert not mark.exists()


def test_a_casadi_file_is_read_without_casadis_own_part_and_says_the_same(fit, tmp_path, monkeypatch):
    path = mi.export(fit, tmp_path / "m.casadi")
    trusted = mi.load(path, trust=True)
    monkeypatch.setattr(ca, "FileDeserializer", None)
    read = mi.load(path)
    np.testing.assert_array_equal(read.simulate(0), trusted.simulate(0))
    assert set(read.functions) == set(trusted.functions)
    assert read.values == trusted.values


@pytest.mark.parametrize("spoil", [
    lambda a: a["functions"][0]["code"].append(["OP_CALL", None, [0], [0]]),
    lambda a: a["functions"][0]["code"].insert(0, ["OP_SIN", None, [10**9], [0]]),
    lambda a: a["functions"][0].update(size=10**12),
    lambda a: a["functions"][0]["in"].append(["z", 10**12]),
    lambda a: a["records"][0].update(substeps=[10**12] * len(a["records"][0]["substeps"])),
    lambda a: a["records"][0].update(t=[0.0]),
    lambda a: a.update(functions=None), lambda a: a.pop("order"),
    lambda a: a["functions"][0].update(name="'); import os"),
], ids=range(9))
def test_nonsense_in_it_is_one_sentence(fit, tmp_path, spoil):
    head, _, text = mi.export(fit, tmp_path / "m.casadi").read_text(encoding="utf-8").partition(PLAIN)
    about = json.loads(text)
    spoil(about)
    (tmp_path / "m.casadi").write_text(head + PLAIN + json.dumps(about), encoding="utf-8")
    with pytest.raises(mi.DataError, match="cannot read"):
        mi.load(tmp_path / "m.casadi")


def test_json_of_any_depth_or_without_parameters_is_one_sentence(tmp_path):
    path = tmp_path / "fit.json"
    for text in ('{"model": ' + "[" * 200_000, '{"model": {"base": "dc_motor", "effects": []}, "parameters": {}}',
                 '{"model": [], "parameters": 3}', '{"model": {"base": ["a"], "effects": []}, "parameters": {}}',
                 '{"model": {"base": "dc_motor", "effects": [["a"]]}, "parameters": {}}',
                 '{"model": {"base": "dc_motor", "effects": [], "own_effects": 3}, "parameters": {}}',
                 '{"model": {"base": "dc_motor", "effects": []}, "parameters": {"R": {"value": 1e999, "fixed": 0}}}'):
        path.write_text(text, encoding="utf-8")
        done = motorid("simulate", path, RUN)
        assert (done.status, done.out, len(done.err.splitlines())) == (2, "", 1), done


def test_names_of_runs_stay_in_their_comments_in_exported_c(fit, tmp_path):
    run = mi.read_csv(RUN, name=EVIL)
    assert "\x1b" not in run.name
    path = mi.export(mi.fit(mi.dc_motor(), run), tmp_path / "motor.c")
    for file in (path, path.with_suffix(".h")):
        code = re.sub(r"/\*.*?\*/", "", file.read_text(encoding="utf-8"), flags=re.S)
        assert "evil" not in code
        assert "owned" not in code


def test_exported_c_says_how_many_sub_steps_it_needs(tmp_path):
    runs = mi.read_runs(sorted(data_path("hidden_friction").glob("run*.csv")))
    stiff = mi.dc_motor(R=1.4, L=2e-3, K=0.046, b=6e-5, J=2e-5) + mi.effects.lugre
    fit = mi.fit(stiff.fix(*stiff.parameters).free("R"), runs[:1])
    found = check(fit)
    functions = {f.name(): f for f in functions_of(fit)}
    run = fit.problem.runs[0]
    p, s, u = functions["parameters"]()["p"], functions["record_0"]()["s"], functions["record_0"]()["u"]
    wanted = np.array(functions["simulate_0"](s, u, p)[0])

    def error(m: int) -> float:
        walk = simulation("walk", functions, run.grid.t, np.full(len(run.grid.t) - 1, m),
                          np.zeros((len(run.grid.t) - 1, 1)))
        return float((np.abs(np.array(walk(s, u, p)[0]) - wanted).max(axis=1) / np.ptp(wanted, axis=1)).max())

    assert error(found.substeps) < 1e-3
    assert found.substeps == 1 or error(found.substeps // 2) >= 1e-3
    header = mi.export(fit, tmp_path / "m.c").with_suffix(".h").read_text(encoding="utf-8")
    assert f"M_SUBSTEPS {found.substeps}" in header
    assert found.text in header


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="no owners here")
def test_a_cache_that_others_can_write_is_refused(tmp_path, monkeypatch, capfd):
    mine, shared = tmp_path / "mine", tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o777)
    for folder, usable in ((mine, True), (shared, False)):
        monkeypatch.setenv("MOTORID_CACHE", str(folder))
        assert (compiled.cache_dir() is not None) is usable
        assert (compiled.find("step-x") is None)
    mine.chmod(0o755)  # one that was there before
    monkeypatch.setenv("MOTORID_CACHE", str(mine))
    assert compiled.cache_dir() == mine
    assert stat.S_IMODE(mine.stat().st_mode) == 0o700
    (shared / "below").mkdir(mode=0o700)
    for behind in (shared, shared / "below"):  # a link in a good place to a bad one
        (tmp_path / "link").unlink(missing_ok=True)
        (tmp_path / "link").symlink_to(behind)
        monkeypatch.setenv("MOTORID_CACHE", str(tmp_path / "link"))
        assert compiled.cache_dir() is None, behind


def test_escape_sequences_reach_neither_terminal_nor_record(tmp_path):
    path = tmp_path / "run\x1b]0;owned\x07.csv"
    path.write_bytes(RUN.read_bytes())
    for words in (("fit", path), ("fit", path, "--json", "-"), ("fit", path, "--effects", "\x1b[31mred"),
                  ("fit", str(path) + "x")):
        done = motorid(*words)
        assert "\x1b" not in done.out + done.err
        assert "\x07" not in done.out + done.err
    assert motorid("fit", path, "--report", tmp_path / "page.html").status == 0
    assert not set("\x1b\x07") & set((tmp_path / "page.html").read_text(encoding="utf-8"))
    fields = ["H", "1", "evil\x1b[2J", "100", "32", "32", "12", "5", "8", "v:V:1:0:n", "x:\x1b[2J:1:0:n"]
    body = ",".join(fields).encode()
    [message] = Decoder().feed(b"$%b*%04X\n" % (body, crc_hqx(body, 0xFFFF)))
    read = Header.read(message.fields)
    assert "\x1b" not in read.name + read.channels[1].unit


def test_an_effect_file_that_leaves_is_said(tmp_path):
    own = tmp_path / "own.py"
    own.write_text("import sys\nsys.exit(0)\n", encoding="utf-8")
    done = motorid("fit", RUN, "--effects-from", own, "--effects", "own")
    assert done.status == 2
    assert "SystemExit" in done.err
