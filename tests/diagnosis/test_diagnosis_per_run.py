"""What begins anew with every run (an encoder's zero, a supply, a warm winding) is found, told once and paid for."""

from __future__ import annotations

import numpy as np
import pytest
from lab_records import VALUES, drive

import motorid as mi
from motorid.diagnosis.candidates import Search, Stages, library
from motorid.diagnosis.model_comparison import node_of, size_of
from motorid.diagnosis.predictive_score import predictions_left_out
from motorid.records.experiment import windows

TRIED = ["cogging", "torque_ripple", "coulomb", "stribeck", "winding_heating", *mi.effects.PER_RUN]
BASE = mi.dc_motor(**VALUES)


def records(models, volts, rng, noise=(0.02, 0.3), dt=1e-3, n=500):
    """`noise` of current, speed and, where there are three, angle."""
    t, found = np.arange(n) * dt, []
    sizes = dict(zip(("i", "omega", "theta"), noise, strict=False))
    for model, volt in zip(models, volts, strict=True):
        bare = mi.Experiment(t, {"v": drive(t, volt)}, dict.fromkeys(sizes, np.zeros(n)), name=f"{volt} V")
        shown = mi.simulate(model, bare, initial="rest")[0].outputs
        found.append(bare.with_(outputs={c: shown[c] + s * rng.normal(size=n) for c, s in sizes.items()}))
    return found


def cogging(zero):
    return (BASE + mi.effects.cogging).replace(A=8e-3, N=12.0, phi=0.7 + 12 * zero)


def test_cogging_under_an_encoder_zeroed_at_every_start_is_named_with_the_zeros(rng):
    runs = records(map(cogging, (0.0, 0.21, -0.13, 0.4)), (2.0, -2.5, 1.5, 2.2), rng)
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs[:3]), runs[3:], effects=TRIED)
    assert found.effects == ("cogging", "encoder_zero"), found.text
    assert found.remaining.adequate
    assert abs(found.after.values["A"] - 8e-3) < 3 * found.after.std["A"]
    own = found.to_dict()["per_run"]["z_0"]
    assert list(own) == ["-2.5 V", "1.5 V"]  # the first run's stands
    for truth, z in zip((0.21, -0.13), own.values(), strict=True):
        assert abs(z["value"] - truth) < 3 * z["std"] < 0.02
    assert found.text.count("rad, by run") == 1
    assert "Parameters per run" in str(found.best.card())
    assert mi.identifiability(found.best).rank == 7


def test_a_ripple_of_torque_and_back_emf_under_such_an_encoder_is_named_with_its_angle_measured(rng):
    def rippling(zero):
        return (BASE + mi.effects.torque_ripple + mi.effects.constant_load).replace(
            a_r=0.3, N_r=6.0, phi_r=0.7 + 6 * zero, e_r=1.0, tau_0=0.01)

    runs = records(map(rippling, (0.0, 0.43, -0.13)), (6.0, -5.0, 5.5), rng, noise=(0.02, 0.3, 2e-4))
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs[:2]), runs[2:], effects=[*TRIED, "constant_load"])
    assert set(found.effects) == {"torque_ripple", "constant_load", "encoder_zero"}, found.text
    assert found.after.values["e_r"] == 1.0
    assert found.after.values["a_r"] == pytest.approx(0.3, rel=0.02)


def test_no_zero_is_asked_for_where_the_phase_stays(rng):
    runs = records(map(cogging, (0.0, 0.0, 0.0)), (2.0, -2.5, 1.5), rng)
    assert mi.diagnose(mi.fit(mi.dc_motor(), runs[:2]), runs[2:], effects=TRIED).effects == ("cogging",)


def test_a_supply_and_a_warm_winding_of_every_run_are_named(rng):
    shares = (1.0, 0.9, 1.05, 0.95)
    runs = [r.with_(inputs={"v": r.inputs["v"] / s})
            for r, s in zip(records([BASE] * 4, (6.0, -5.0, 4.0, 5.0), rng), shares, strict=True)]
    supply = mi.diagnose(mi.fit(mi.dc_motor(), runs[:3]), runs[3:], effects=TRIED)
    assert supply.effects == ("supply_per_run",), supply.text
    assert [own["value"] for own in supply.after.per_run["g_v"].values()] == pytest.approx([-0.1, 0.05], abs=2e-3)
    heated = (BASE + mi.effects.winding_heating + mi.effects.winding_warm_start).replace(R_th=8.0, C_th=0.8)
    runs = records([heated.replace(dT_0=dT) for dT in (0, 60, 30, 45)], (6, -5, 5, 6), rng, (5e-3, 0.1), 4e-3)
    warm = mi.diagnose(mi.fit(mi.dc_motor(), runs[:3]), runs[3:], effects=TRIED)
    assert warm.effects == ("winding_heating", "winding_warm_start"), warm.text
    assert [own["value"] for own in warm.after.per_run["dT_0"].values()] == pytest.approx([60, 30], abs=3)
    # Whether the heating is real is asked of the model without it, and without what only it makes sense of.
    search = Search(mi.fit(mi.dc_motor(), runs[:3]), None, library(TRIED), Stages())
    cold = search.without(node_of(warm.after, search.held), "winding_heating")
    assert cold is not None
    assert cold.key == frozenset()


def test_each_runs_own_value_is_paid_for_and_parts_of_a_run_share_it(rng):
    runs = records([BASE] * 3, (6.0, -5.0, 4.0), rng)
    model = mi.dc_motor() + mi.effects.supply_per_run
    fit = mi.fit(model, runs)
    assert size_of(model, fit.problem) == 7  # five of the motor, two of the second and the third run
    assert predictions_left_out(fit)["i"].nrmse > fit.nrmse["i"]
    own = mi.fit(model.fix(**{n: fit.values[n] for n in VALUES if n != "b"}), runs)
    one = mi.fit(own.model.fix(g_v=0.0), runs)  # the same but for values of runs, which cost something where none acts
    lost = [predictions_left_out(f)["omega"].nrmse / f.nrmse["omega"] for f in (own, one)]
    assert lost[0] > lost[1]
    parts = [p for r in runs for p in windows(r, 0.25)]
    assert list(mi.Problem(model, parts).unknowns.firsts) == [0, 0, 2, 2, 4, 4]
    assert [p.name for *_, p in mi.Problem(model, parts).unknowns.apart] == ["g_v[2]", "g_v[4]"]


def test_without_the_cogging_nobody_asks_for_the_zero_of_the_encoder():
    from motorid.diagnosis.candidates import _without

    both = mi.dc_motor() + mi.effects.cogging + mi.effects.get("encoder_zero")
    assert [m.effect_names for m in _without(both, "cogging")] == [()]
    assert [m.effect_names for m in _without(both + mi.effects.gravity, "cogging")] == [("encoder_zero", "gravity")]
    assert [m.effect_names for m in _without(both, "encoder_zero")] == [("cogging",)]


def test_what_is_another_in_every_run_is_not_asked_of_runs_of_one_voltage_each():
    """There it is any law of the voltage: dry friction made a supply of -31 to +15 %."""
    t = 2e-3 * np.arange(500)
    motor = mi.dc_motor(R=1.4, L=2e-3, K=0.05, b=6e-5, J=2.4e-5) + mi.effects.coulomb(tau_c=1e-2)
    runs = [mi.planned(motor, t, np.where(t < 0.05, 0.0, v), channels=["omega"]) for v in (-6.0, 2.0, 1.5, 3.5, 5.0)]
    rng = np.random.default_rng(2)
    runs = [r.with_(outputs={"omega": r.outputs["omega"] + rng.normal(size=r.n)}) for r in runs]
    names = {e.name for e in Search(mi.fit(mi.dc_motor(), runs), None, library(None), Stages()).effects}
    assert not names & {"supply_per_run", "winding_warm_start"}
    half = [r.with_(inputs={"v": np.where(t < 0.5, r.inputs["v"], 0.5 * r.inputs["v"])}) for r in runs]
    names = {e.name for e in Search(mi.fit(mi.dc_motor(), half), None, library(None), Stages()).effects}
    assert {"supply_per_run", "winding_warm_start"} <= names
    drive_ = [r.with_(units={"v": "N·m"}) for r in half]
    names = {e.name for e in Search(mi.fit(mi.torque_driven(), drive_), None, library(None), Stages()).effects}
    assert not names & {"supply_per_run", "winding_warm_start"}  # no supply makes a commanded torque


def test_what_was_named_without_an_angle_can_be_fitted_by_name():
    """The order of a cogging is sought without it, and then nothing is left that a zero of the encoder shifts."""
    t = 1e-3 * np.arange(1200)
    motor = mi.dc_motor(R=1.4, L=2e-3, K=0.05, b=6e-5, J=2.4e-5) + mi.effects.cogging(A=4e-3, N=6, phi=0.4)
    runs = [mi.planned(motor, t, np.where(t < 0.6, v, -v)) for v in (1.5, 2.2)]
    runs = [r.with_(outputs={c: y for c, y in r.outputs.items() if c != "theta"}) for r in runs]
    found = mi.fit(mi.dc_motor() + mi.effects.cogging + mi.effects.encoder_zero, runs)
    assert found.values["N"] == 6
    assert max(found.nrmse.values()) < 0.01


def test_a_bent_shaft_under_such_an_encoder_is_named_in_the_place_of_dry_friction(rng):
    def bent(zero):
        return (BASE + mi.effects.angular_friction).replace(tau_m=1e-2, a_f=0.6, N_f=1.0, phi_f=0.5 + zero)

    runs = records(map(bent, (0.0, 1.9, -2.2)), (2.0, -2.5, 1.5), rng, noise=(0.02, 0.3, 2e-3), n=800)
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs[:2]), runs[2:], effects=["coulomb", "angular_friction", *TRIED[:2],
                                                                           "encoder_zero"])
    assert set(found.effects) == {"angular_friction", "encoder_zero"}, found.text
    assert found.after.values["a_f"] == pytest.approx(0.6, rel=0.02)
    assert found.to_dict()["per_run"]["z_0"]["-2.5 V"]["value"] == pytest.approx(1.9, abs=0.02)


def test_stops_that_leave_no_travel_between_them_are_a_spring(rng):
    sprung = (BASE + mi.effects.spring).replace(k_s=0.02, theta_0=0.1)
    t = np.arange(500) * 1e-3
    bare = [mi.Experiment(t, {"v": drive(t, v)}, {"i": 0 * t, "theta": 0 * t}, name=f"{v} V") for v in (4.0, -6.0)]
    runs = [r.with_(outputs={c: mi.simulate(sprung, r, initial="rest")[0].outputs[c] + s * rng.normal(size=500)
                             for c, s in (("i", 0.02), ("theta", 1e-3))}) for r in bare]
    stops = (mi.dc_motor(**VALUES) + mi.effects.end_stop).replace(k_stop=0.02, theta_lo=0.1, theta_hi=0.1, d_stop=1e-4)
    search = Search(mi.fit(mi.dc_motor(), runs), None, library(["spring", "end_stop"]), Stages())
    node = node_of(mi.fit(stops, runs, start="model"), search.held)
    assert search.pruned(node, search.root).key == {"spring"}
