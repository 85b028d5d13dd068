"""A load torque, a temperature, a supply that were measured beside the voltage drive the model through effects."""

from __future__ import annotations

import numpy as np
import pytest
from lab_records import VALUES, drive

import motorid as mi
from motorid.errors import DataError, ModelError
from motorid.records.reading import write_csv

MEASURED = {
    "measured_load": ("tau_load", {"k_l": 1.0}),
    "measured_temperature": ("temp", {"alpha_T": 0.0039, "T_ref": 25.0}),
    "measured_supply": ("v_supply", {"k_v": 1.0, "V_n": 8.0}),
}
NOISE = {"i": 0.02, "omega": 0.4}


def beside(t, k):
    """A load, a temperature and a supply that change while the motor runs."""
    return {
        "tau_load": 0.02 * np.sin(9 * t + k) + 0.01,
        "temp": 30 + 60 * t / t[-1] + 10 * k,
        "v_supply": 8.0 - 1.5 * np.sin(5 * t + k) ** 2,
    }


def runs_with(effect, rng, names=("tau_load", "temp", "v_supply")):
    model = (mi.dc_motor(**VALUES) + effect).replace(**MEASURED[effect.name][1])
    t, found = np.arange(600) * 1e-3, []
    for k, volt in enumerate((8.0, -6.0, 7.0)):
        inputs = {"v": drive(t, volt), **{n: beside(t, k)[n] for n in names}}
        bare = mi.Experiment(t, inputs, {c: np.zeros(600) for c in NOISE}, name=f"r{k}")
        shown = mi.simulate(model, bare, initial="rest")[0].outputs
        found.append(bare.with_(outputs={c: shown[c] + s * rng.normal(size=600) for c, s in NOISE.items()}))
    return found


@pytest.mark.parametrize("name", MEASURED)
def test_what_acts_is_named_where_it_was_recorded(name, rng):
    effect = mi.effects.get(name)
    runs = runs_with(effect, rng)
    fit = mi.fit(mi.dc_motor(), runs[:2])
    tried = [*mi.effects.MEASURED, "coulomb", "winding_heating", "voltage_offset", "constant_load"]
    found = mi.diagnose(fit, runs[2:], effects=tried)
    assert found.effects == (name,), found.text
    size = effect.size.name
    value, std = found.after.values[size], found.after.std[size]
    assert abs(value - MEASURED[name][1][size]) < 4 * std < 0.2 * abs(value)
    channel = MEASURED[name][0]
    with pytest.raises(ModelError, match=f"needs the input '{channel}'.*Name its column"):
        mi.fit(mi.dc_motor() + effect, runs_with(effect, rng)[0].with_(inputs={"v": runs[0].inputs["v"]}))


def test_they_come_with_the_file_and_go_back_into_one(tmp_path, rng):
    t = np.arange(30) * 0.01
    rows = "\n".join(f"{a:.2f},{6},{a * 100:.3f},{-50 * a:.2f},{300 + a:.2f},11.9,{'' if k < 2 else 0.5}"
                     for k, a in enumerate(t))
    path = tmp_path / "run.csv"
    path.write_text(f"t_s,voltage_V,speed_rad_s,load_torque_mNm,motor_temp_K,battery_V,speed_ref\n{rows}\n")
    run = mi.read_runs(path)[0]
    assert list(run.inputs) == ["v", "v_supply", "tau_load", "temp"]
    assert run.inputs["tau_load"] == pytest.approx(-0.05 * t, abs=1e-6)
    assert run.inputs["temp"] == pytest.approx(26.85 + t, abs=1e-6)
    assert any("'speed_ref' looks like the reference of a controller: what drives the model is 'voltage_V'" in n
               for n in run.meta["notes"])
    again = mi.read_runs(write_csv(run, tmp_path / "again.csv"))[0]
    assert all(np.allclose(again.inputs[c], y) for c, y in run.inputs.items())
    assert "tau_load" in repr(run)
    assert mi.fit(mi.dc_motor(**VALUES).fix("R", "L", "K", "J"), run).model.effect_names == ()  # none acts by itself


def test_the_voltage_alone_is_what_readings_change_and_no_record_lacks_it():
    t = np.arange(40) * 1e-2
    run = mi.Experiment(t, {"v": np.sign(np.sin(9 * t)), "temp": 25 + t}, {"omega": np.sin(t)})
    late = run.delayed(0.05)
    assert np.array_equal(late.inputs["temp"], run.inputs["temp"])
    assert not np.array_equal(late.inputs["v"], run.inputs["v"])
    with pytest.raises(DataError, match="the input 'v'"):
        mi.Experiment(t, {"temp": 25 + t}, {"omega": np.sin(t)})
