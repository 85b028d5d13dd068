"""Export: the same trajectories elsewhere, without motorid; and back."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest

import motorid as mi
from motorid.errors import DataError, ModelError, UsageError
from motorid.exporters.export import Exported, export, load
from motorid.problem.plain_data import model_from_json

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
ALONE = """
import json, sys
import casadi
file = casadi.FileDeserializer(sys.argv[1])
functions, about = {f.name(): f for f in file.unpack()}, json.loads(file.unpack())
p = functions["parameters"]()["p"]
found = []
for k in range(2):
    record = functions[f"record_{k}"]()
    found.append(functions[f"simulate_{k}"](s=record["s"], u=record["u"], p=p)["y"].full().T.tolist())
assert not any(m.split(".")[0] == "motorid" for m in sys.modules)
print(json.dumps({"y": found, "R": about["parameters"]["R"]["value"]}))
"""


@mi.effect(balance="torque")
def my_drag(m, c_3=mi.P(1e-10, "N·m·s³/rad³", null=0.0, lower=0.0)):
    """Drag with the cube of the speed."""
    m.torque -= c_3 * m.omega**3


def runs_of(name: str) -> list[mi.Experiment]:
    return mi.read_runs(sorted(str(p) for p in mi.data_path(name).glob("*.csv") if not p.name.startswith("check")))


@pytest.fixture(scope="module", params=["plain", "friction", "heating", "linear"])
def fit(request) -> mi.Fit:
    name, effects = {"plain": ("two_step_noisy", ()), "friction": ("hidden_friction", ("coulomb",)),
                     "heating": ("hidden_heating", ("winding_heating",)),
                     "linear": ("two_step_noisy", ())}[request.param]
    model = mi.dc_motor()
    for e in effects:
        model = model + mi.effects.get(e)
    runs = runs_of(name)
    if request.param == "linear":  # a ramp that begins slowly, the input joined by lines between the samples
        runs = [r.with_(hold="linear", inputs={"v": np.convolve(r.inputs["v"], np.ones(5) / 5, "same")}) for r in runs]
    return mi.fit(model, runs)


def trajectories(fit: mi.Fit) -> list[np.ndarray]:
    return [np.column_stack([s.outputs[c] for c in fit.problem.outputs]) for s in fit.simulations]


def assert_close(found, wanted, tolerance):
    for a, b in zip(found, wanted, strict=True):
        assert np.abs(np.asarray(a) - b).max() <= tolerance * np.abs(b).max()


def test_casadi_file_alone_reproduces_the_fit(fit, tmp_path):
    path = export(fit, tmp_path / "motor.casadi")
    done = subprocess.run([sys.executable, "-c", ALONE, str(path)], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert_close(found["y"], trajectories(fit), 1e-9)
    assert found["R"] == fit.values["R"]


@pytest.mark.skipif(COMPILER is None, reason="no C compiler on this machine")
def test_c_program_reproduces_the_fit(fit, tmp_path):
    export(fit, tmp_path / "my-motor.c")
    build = [COMPILER, "-O2", "-std=c99", "-Wall", "-Werror", "-pedantic", "my_motor_main.c", "my_motor.c", "-lm",
             "-o", "walk"]
    done = subprocess.run(build, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    for k, wanted in enumerate(trajectories(fit)):
        walked = subprocess.run([tmp_path / "walk", f"my_motor_run{k}.csv", str(k)], cwd=tmp_path,
                                capture_output=True, text=True, timeout=60)
        assert walked.returncode == 0, walked.stderr
        lines = walked.stdout.strip().splitlines()
        assert lines[0] == ",".join(["t", *fit.problem.outputs])
        assert_close([np.array([line.split(",")[1:] for line in lines[1:]], float)], [wanted], 1e-7)
    refused = subprocess.run([tmp_path / "walk", "my_motor_run0.csv", "9"], cwd=tmp_path, capture_output=True,
                             timeout=60)
    assert refused.returncode == 2


def test_json_reloads_into_the_same_model(fit, tmp_path):
    again = load(export(fit, tmp_path / "motor.json"))
    assert isinstance(again, mi.Model)
    assert again.values == fit.model.values
    assert again.free_names == fit.model.free_names
    assert again.effect_names == fit.model.effect_names
    problem = fit.problem.for_model(again)
    q = problem.scaling.scaled(fit.problem.scaling.physical(fit.q))  # coordinates are relative to the start values
    for k, wanted in enumerate(trajectories(fit)):
        assert_close([problem.simulate(q, k, derivatives=False).y], [wanted], 1e-9)


def test_what_travels_along_is_complete(fit, tmp_path):
    info = json.loads(export(fit, tmp_path / "motor.json").read_text(encoding="utf-8"))
    assert {d["name"] for d in info["data"]} == {r.name for r in fit.problem.experiments}
    assert all(len(d["sha256"]) == 64 for d in info["data"])
    assert np.array(info["covariance"]["matrix"]) == pytest.approx(fit.covariance)
    assert set(info["versions"]) == {"motorid", "casadi", "numpy", "python"}
    for name, p in info["parameters"].items():
        assert p["unit"] == fit.problem.model.parameters[name].unit
    file = load(export(fit, tmp_path / "motor.casadi"))
    assert isinstance(file, Exported)
    assert file.info == info
    assert file.values == fit.model.values
    assert file.model.values == fit.model.values


@pytest.fixture(scope="module")
def per_run():
    """A fit of three runs whose supplies differ, and a check with another."""
    t, rng, motor = np.arange(400) * 1e-3, np.random.default_rng(3), mi.dc_motor(R=1.2, L=1e-3, K=0.05, b=2e-5, J=5e-5)
    runs = []
    for k, gain in enumerate((1.0, 1.1, 0.9, 1.15)):
        v = np.repeat(rng.uniform(-6, 6, 8), 50)
        shown = mi.planned(motor, t, gain * v).outputs
        runs.append(mi.Experiment(t, {"v": v}, {"i": shown["i"] + 0.02 * rng.normal(size=400),
                                                "omega": shown["omega"] + 0.3 * rng.normal(size=400)}, name=f"r{k}"))
    return mi.fit(mi.dc_motor() + mi.effects.supply_per_run, runs[:3]), runs[3]


def test_an_export_simulates_every_run_with_its_own_parameters(per_run, tmp_path):
    fit, _ = per_run
    found = load(export(fit, tmp_path / "motor.casadi"))
    for k, s in enumerate(fit.simulations):
        assert found.simulate(k) == pytest.approx(np.column_stack([s.outputs[c] for c in ("i", "omega")]), abs=1e-9)


@pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")
def test_a_c_program_walks_every_run_with_its_own_parameters(per_run, tmp_path):
    fit, _ = per_run
    export(fit, tmp_path / "motor", to="c")
    subprocess.run([COMPILER, "-O1", "motor_main.c", "motor.c", "-lm", "-o", "motor"], cwd=tmp_path, check=True)
    for k, s in enumerate(fit.simulations):
        out = subprocess.run(["./motor", f"motor_run{k}.csv", str(k)], cwd=tmp_path, check=True, capture_output=True)
        rows = np.array([[float(x) for x in line.split(",")] for line in out.stdout.decode().splitlines()[1:]])
        assert rows[:, 2] == pytest.approx(s.outputs["omega"], abs=1e-6 * np.abs(s.outputs["omega"]).max())


@pytest.mark.parametrize("name", ["motor.json", "motor.casadi"])
def test_a_model_read_back_is_judged_on_other_runs_as_the_fit_is(name, per_run, tmp_path):
    """What each run has for itself is what that run says."""
    fit, check = per_run
    again = load(export(fit, tmp_path / name))
    assert mi.evaluate(again if isinstance(again, mi.Model) else again.model, check).nrmse == pytest.approx(
        mi.evaluate(fit, check).nrmse, rel=1e-3)


@mi.effect(balance="torque")
def rubbing_soon(m, tau=mi.P(5e-3, "N·m", null=0.0)):
    """A friction that fades after each change of the voltage."""
    m.torque -= tau * m.sign(m.omega) * ca.exp(-m.input("since_change") / 0.05)


@pytest.mark.parametrize("hold", ["zoh", "linear"])
def test_between_samples_an_export_goes_on_as_the_fit_does(hold, tmp_path):
    """What was measured beside the voltage goes on, and so may that; times since a change do not."""
    t = np.arange(200) * 5e-3
    inputs = {"v": np.where((4 * t).astype(int) % 2, 0.0, 6.0), "tau_load": 0.05 * np.sin(60 * t)}
    blank = mi.Experiment(t, inputs, {"i": 0 * t, "omega": 0 * t}, hold=hold)
    model = mi.dc_motor(R=1.3, L=2e-3, K=0.05, b=2e-5, J=3e-5) + mi.effects.measured_load + rubbing_soon
    shown = mi.simulate(model, blank, initial="rest")[0].outputs
    fit = mi.fit(model, blank.with_(outputs=shown, sigma={"i": 0.01, "omega": 0.3}))
    again = load(export(fit, tmp_path / "motor.casadi")).simulate(0)
    wanted = np.column_stack([fit.simulations[0].outputs[c] for c in ("i", "omega")])
    assert again == pytest.approx(wanted, abs=1e-9 * np.abs(wanted).max())


def test_exported_step_follows_other_inputs(tmp_path):
    """The file is a model, not a recording: another voltage gives what motorid gives."""
    fit = mi.fit(mi.dc_motor(), runs_of("two_step_noisy"))
    file = load(export(fit, tmp_path / "motor.casadi"))
    run = fit.problem.experiments[0]
    other = run.with_(inputs={"v": 0.5 * run.inputs["v"]})
    found = file.simulate(0, u=other.inputs["v"])
    fine = mi.simulate(fit.model, other)[0]
    assert_close([found], [np.column_stack([fine.outputs[c] for c in fit.problem.outputs])], 1e-4)
    with pytest.raises(UsageError, match="simulate_0"):
        file.simulate(5)


def test_fit_with_another_engine_exports_our_step(tmp_path):
    fit = mi.fit(mi.dc_motor(), runs_of("two_step_noisy")[:1], engine="cvodes")
    file = load(export(fit, tmp_path / "motor.casadi"))
    assert_close([file.simulate(0)], trajectories(fit), 1e-3)


def test_a_model_without_a_fit_can_be_exported(tmp_path):
    model = mi.dc_motor(R=2.0) + mi.effects.coulomb
    file = load(export(model, tmp_path / "m.casadi"))
    assert sorted(file.functions) == ["initial", "outputs", "parameters", "rhs", "step"]
    assert load(export(model, tmp_path / "m.json")).values == model.values
    assert "m_main.c" in {p.name for p in export(model, tmp_path / "m.c").parent.iterdir()}


def test_own_effect_says_what_is_needed_and_loads_with_it(tmp_path):
    model = mi.dc_motor() + my_drag
    path = export(model, tmp_path / "own.json")
    with pytest.raises(ModelError, match=r"my_drag.*c_3.*effects=\[my_drag\]"):
        load(path)
    assert load(path, effects=[my_drag]).values == model.values
    exported = load(export(model, tmp_path / "own.casadi"), effects=[my_drag])
    assert exported.model.values == model.values
    assert load(export(exported, tmp_path / "again.json"), effects=[my_drag]).values == model.values


def test_limits_and_held_values_come_back(tmp_path):
    model = mi.dc_motor().replace(R=2.0).bounded(R=(1.5, 3.0)).fix(L=1e-3)
    again = load(export(model, tmp_path / "m.json"))
    assert (again.parameters["R"].lower, again.parameters["R"].upper) == (1.5, 3.0)
    assert "L" not in again.free_names
    held = mi.torque_driven("linear", g=35.0) + mi.effects.coulomb
    assert load(export(held, tmp_path / "t.json")).axis == "linear"


def test_fit_json_of_the_command_line_reloads():
    contents = {"model": {"base": "dc_motor", "effects": ["coulomb"]}, "something": "else", "parameters": {
        n: {"value": v, "std": None, "unit": "", "fixed": n in ("L", "sgn_width")}
        for n, v in {"R": 1.0, "L": 1e-3, "K": 0.05, "b": 1e-5, "J": 1e-5, "tau_c": 1e-3, "sgn_width": 0.1}.items()}}
    model = model_from_json(contents)
    assert model.values["tau_c"] == 1e-3
    assert "L" not in model.free_names


def test_bad_files_and_words_are_refused(tmp_path):
    model = mi.dc_motor()
    with pytest.raises(UsageError, match="not clear"):
        export(model, tmp_path / "motor.txt")
    with pytest.raises(UsageError, match="FMU is not offered"):
        export(model, tmp_path / "motor.fmu")
    with pytest.raises(UsageError, match="unknown form"):
        export(model, tmp_path / "motor.c", to="cpp")
    with pytest.raises(UsageError, match="a fit or a model"):
        export("motor", tmp_path / "motor.c")
    with pytest.raises(DataError, match="cannot read"):
        load(tmp_path / "none.json")
    (tmp_path / "bad.json").write_text("{ not json", encoding="utf-8")
    with pytest.raises(DataError, match="not JSON"):
        load(tmp_path / "bad.json")
    (tmp_path / "bad.casadi").write_text("rubbish", encoding="utf-8")
    with pytest.raises(DataError, match=r"bad\.casadi"):
        load(tmp_path / "bad.casadi")
    with pytest.raises(DataError, match="not a fitted model"):
        model_from_json({"model": {"base": "dc_motor"}})
    with pytest.raises(DataError, match="only one of the file and the model"):
        model_from_json({"model": {"base": "dc_motor", "effects": []}, "parameters": {}})


def test_a_saved_fit_comes_back_as_it_was(fit, tmp_path):
    """Values, errors, deviations and words; with the records, so that everything that takes a fit takes it."""
    back = load(fit.save(tmp_path / "fit.json"))
    assert isinstance(back, mi.Fit)
    assert back.values == fit.values
    assert back.verdict == fit.verdict
    assert back.initial == fit.initial
    assert {n: pytest.approx(s, rel=1e-5) for n, s in fit.std.items()} == back.std
    np.testing.assert_allclose(back.covariance, fit.covariance, rtol=1e-5, atol=1e-6 * np.abs(fit.covariance).max())
    for a, b in zip(back.problem.experiments, fit.problem.experiments, strict=True):
        assert (a.name, a.hold, a.meta.get("sha256")) == (b.name, b.hold, b.meta.get("sha256"))
        np.testing.assert_array_equal(a.outputs["omega"], b.outputs["omega"])
    assert mi.identifiability(back).condition_number == pytest.approx(mi.identifiability(fit).condition_number, 1e-4)
    assert mi.fit(back.model, back.problem.experiments).values == pytest.approx(fit.values, rel=1e-4)


def test_a_saved_fit_is_diagnosed_as_the_fit_itself(tmp_path):
    runs = runs_of("hidden_friction")[:1]
    fit = mi.fit(mi.dc_motor(), runs)
    assert mi.diagnose(load(fit.save(tmp_path / "fit.json"))).text == mi.diagnose(fit).text


def test_what_was_asked_of_a_fit_comes_back(tmp_path):
    """Limits, priors, fixed and given values, a robust loss, penalties, constraints with their multipliers, windows."""
    runs = [r.with_(meta={**r.meta, "note": None}) for r in runs_of("hidden_friction")[:1]]
    model = (mi.dc_motor() + mi.effects.cogging(N=7)).bounded(b=(1e-7, 1e-2)).fix(L=1e-3).replace(K=0.05)
    asked = {"priors": {"R": (1.0, 0.5)}, "loss": mi.Huber(2.0), "penalties": [mi.CurrentLimit(50.0)], "window": 1.0}
    fit = mi.fit(model, runs, **asked)
    back = load(fit.save(tmp_path / "fit.json"))
    assert back.problem.model.parameters == fit.problem.model.parameters
    assert (back.problem.loss, back.window, dict(back.problem.priors)) == (mi.Huber(2.0), 1.0, {"R": [1.0, 0.5]})
    assert back.problem.model.effects[0].parameters == fit.problem.model.effects[0].parameters
    assert back.cost == pytest.approx(fit.cost, 1e-9)
    friction = mi.dc_motor() + mi.effects.coulomb
    hard = mi.fit(friction, runs, solver=mi.MultipleShooting(), constraints=[mi.SteadyState()])
    back = load(hard.save(tmp_path / "hard.json"))
    assert back.std == pytest.approx(hard.std, rel=1e-4)
    assert back.card().text == hard.card().text
    assert back.extra["multipliers"] == hard.extra["multipliers"]


def test_a_fit_with_an_effect_of_ones_own_asks_for_it(tmp_path):
    path = mi.fit(mi.dc_motor() + my_drag, runs_of("two_step_noisy")[:1]).save(tmp_path / "own.json")
    with pytest.raises(ModelError, match=r"effects=\[my_drag\]"):
        load(path)
    assert load(path, effects=[my_drag]).model.effect_names == ("my_drag",)


def test_code_of_ones_own_cannot_be_saved(tmp_path):
    fit = mi.fit(mi.dc_motor(), runs_of("two_step_noisy")[:1], penalties=[mi.Constraint(lambda m: m.K, upper=1.0)])
    with pytest.raises(UsageError, match="Constraint is code of your own"):
        fit.save(tmp_path / "fit.json")
    assert not (tmp_path / "fit.json").exists()


@pytest.mark.parametrize("wrong", [{"q": [1.0]}, {"q": None}, {"problem": {}}, {"cost": "x"}, {"extra": {"free": "x"}},
                                   {"problem.runs": []}, {"problem.engine": {"kind": "Popen", "args": "true"}},
                                   {"problem.runs.0.substeps": [10**9]}, {"problem.runs.0.record.t": [0.0]}],
                         ids=str)
def test_a_damaged_fit_is_refused_in_a_sentence(tmp_path, wrong):
    path = mi.fit(mi.dc_motor(), runs_of("two_step_noisy")[:1]).save(tmp_path / "fit.json")
    contents = json.loads(path.read_text())
    place, value = next(iter(wrong.items()))
    at = contents["fit"]
    for part in place.split(".")[:-1]:
        at = at[int(part) if part.isdigit() else part]
    at[place.split(".")[-1]] = value
    path.write_text(json.dumps(contents))
    with pytest.raises((DataError, UsageError)):
        load(path)


def test_a_fit_of_another_law_is_warned_of(tmp_path):
    path = mi.fit(mi.dc_motor(), runs_of("two_step_noisy")[:1]).save(tmp_path / "fit.json")
    contents = json.loads(path.read_text())
    contents["fit"]["cost"] *= 2
    path.write_text(json.dumps(contents))
    with pytest.warns(UserWarning, match="an effect has changed since"):
        load(path)
