"""Parameters that are others in every run: the zero of an encoder, a warm start, another supply."""

from __future__ import annotations

import numpy as np
import pytest
from lab_records import VALUES, drive

import motorid as mi
from motorid.errors import ModelError, UsageError

TRUTH = {"A": 8e-3, "N": 12.0, "phi": 0.7}
ZEROS = (0.0, 0.21, -0.13)


def turned(zero, volt, rng):
    """Cogging seen by an encoder whose zero is `zero` away from the first run's."""
    model = (mi.dc_motor(**VALUES) + mi.effects.cogging).replace(**{**TRUTH, "phi": TRUTH["phi"] + 12 * zero})
    t = np.arange(500) * 1e-3
    bare = mi.Experiment(t, {"v": drive(t, volt)}, {c: np.zeros(500) for c in ("i", "omega", "theta")}, name=f"{volt}")
    shown = mi.simulate(model, bare, initial="rest")[0].outputs
    noise = {"i": 0.02, "omega": 0.3, "theta": 1e-3}
    return bare.with_(outputs={c: shown[c] + s * rng.normal(size=500) for c, s in noise.items()})


def test_cogging_keeps_its_phase_where_the_encoder_starts_anew_in_every_run(rng):
    runs = [turned(z, v, rng) for z, v in zip(ZEROS, (2.0, -2.5, 1.5), strict=True)]
    model = mi.dc_motor() + mi.effects.cogging
    one, own = mi.fit(model, runs[:2]), mi.fit(model + mi.effects.encoder_zero, runs[:2])
    assert one.fits == "poor"
    assert own.fits == "noise"
    assert (own.values["N"], own.values["z_0"]) == (12, 0)
    assert own.values["A"] == pytest.approx(TRUTH["A"], rel=0.02)
    assert own.initial["z_0[1]"] == pytest.approx(ZEROS[1], abs=5e-3)
    judged = mi.evaluate(own, runs[2:])  # whose own zero is estimated there
    assert judged.nrmse["omega"] < 0.4 * mi.evaluate(one, runs[2:]).nrmse["omega"]
    assert mi.check_derivatives(own.problem, own.q).ok
    assert "Parameters per run" in str(own.card())
    with pytest.raises(UsageError, match="parameters per run"):
        mi.fit(model + mi.effects.encoder_zero, runs[:2], solver=mi.MultipleShooting())


def test_a_supply_and_a_warm_winding_of_every_run(rng):
    t, found = np.arange(300) * 4e-3, []
    warm = mi.dc_motor(**VALUES) + mi.effects.winding_heating + mi.effects.winding_warm_start
    for dT, volt in ((0.0, 6.0), (60.0, -5.0)):
        model = warm.replace(R_th=8.0, C_th=0.8, dT_0=dT)
        bare = mi.Experiment(t, {"v": drive(t, volt)}, {c: np.zeros(300) for c in ("i", "omega")})
        shown = mi.simulate(model, bare, initial="rest")[0].outputs
        found.append(bare.with_(outputs={"i": shown["i"] + 0.005 * rng.normal(size=300),
                                         "omega": shown["omega"] + 0.1 * rng.normal(size=300)}))
    fit = mi.fit(mi.dc_motor() + mi.effects.winding_heating + mi.effects.winding_warm_start, found)
    std = np.sqrt(fit.covariance[-1, -1])
    assert abs(fit.initial["dT_0[1]"] - 60) < 4 * std < 30
    assert fit.values["R"] == pytest.approx(VALUES["R"], rel=0.02)
    with pytest.raises(ModelError, match="winding_heating"):
        mi.fit(mi.dc_motor() + mi.effects.winding_warm_start, found)
    lower = [found[0], found[0].with_(inputs={"v": found[0].inputs["v"] / 0.9})]
    supply = mi.fit(mi.dc_motor() + mi.effects.supply_per_run, lower)
    assert supply.initial["g_v[1]"] == pytest.approx(-0.1, abs=2e-3)


def two_supplies(rng):
    """Two records of one motor, the second's supply 15 % higher than it says."""
    t, found = np.arange(300) * 2e-3, []
    for gain, volt in ((1.0, 6.0), (1.15, -5.0)):
        bare = mi.Experiment(t, {"v": gain * drive(t, volt)}, {c: np.zeros(300) for c in ("i", "omega")})
        shown = mi.simulate(mi.dc_motor(**VALUES), bare, initial="rest")[0].outputs
        noisy = {c: y + 2e-3 * np.ptp(y) * rng.normal(size=300) for c, y in shown.items()}
        found.append(bare.with_(inputs={"v": drive(t, volt)}, outputs=noisy))
    return found


@pytest.mark.parametrize("window", [None, 0.3])
def test_where_the_clock_of_one_file_starts_again_a_record_does(rng, tmp_path, window):
    first, second = (mi.records.reading.csv_text(r).splitlines()[2:] for r in two_supplies(rng))
    path = tmp_path / "both.csv"
    path.write_text("\n".join([*first, *second[1:]]), encoding="utf-8")
    for runs in (mi.read_csv(path), mi.read_runs(path)):
        fit = mi.fit(mi.dc_motor() + mi.effects.supply_per_run, runs, window=window)
        assert [v["value"] for v in fit.per_run["g_v"].values()] == pytest.approx([0.15], abs=5e-3)


def test_of_parts_of_one_record_none_has_parameters_of_its_own_which_is_said(rng):
    first, second = two_supplies(rng)
    t = np.r_[first.t, second.t + 5]
    run = first.with_(t=t, inputs={"v": np.r_[first.inputs["v"], second.inputs["v"]]},
                      outputs={c: np.r_[first.outputs[c], second.outputs[c]] for c in first.outputs})
    with pytest.warns(UserWarning, match="g_v differs between records; these are parts of one"):
        assert mi.fit(mi.dc_motor() + mi.effects.supply_per_run, run).per_run == {}


def test_records_of_one_name_have_a_row_each(rng, tmp_path):
    """Two of three records shared one, where the last one's size stood for both."""
    first, second = two_supplies(rng)
    third = second.with_(inputs={"v": second.inputs["v"] / 0.8})
    fit = mi.fit(mi.dc_motor() + mi.effects.supply_per_run, [first, second, third, first.with_(name="other")])
    found = {run: own["value"] for run, own in fit.per_run["g_v"].items()}
    assert found == pytest.approx({"run (2)": 0.15, "run (3)": -0.08, "other": 0.0}, abs=5e-3)
    assert list(mi.load(fit.save(tmp_path / "fit.json")).per_run["g_v"]) == list(found)
    assert [row[1] for row in next(t for t in fit.card().tables if t.title == "Parameters per run").rows] == list(found)
