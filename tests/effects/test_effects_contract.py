"""The contract of an effect, asked of every one in the library."""

from __future__ import annotations

import re
from itertools import combinations, islice

import casadi as ca
import numpy as np
import pytest

import motorid as mi
from motorid.effects import LIBRARY
from motorid.errors import ModelError
from motorid.integrate import Grid, Rosenbrock

VALUES = {"R": 1.38, "L": 1.72e-3, "K": 0.0462, "b": 6.5e-5, "J": 2.35e-5}
ALL = ("i", "omega", "theta")
FRICTION = (
    "coulomb",
    "coulomb_asymmetric",
    "stribeck",
    "quadratic_drag",
    "load_friction",
    "viscous_asymmetric",
    "lugre",
    "eddy_brake",
    "angular_friction",
    "gear_efficiency",
)
UNITS = {
    *("", "V", "A", "Ω", "s", "1/s", "s/rad", "rad", "rad/s", "1/K", "K/W", "J/K"),
    *("N·m", "N·m/rad", "N·m·s/rad", "N·m·s²/rad²"),
}
every_effect = pytest.mark.parametrize("effect", LIBRARY.values(), ids=LIBRARY)


def motor(*effects):
    model = mi.dc_motor(**VALUES)
    for e in effects:
        model = model + e
    return model


def parameters(model, **values):
    found = {**model.values, **values}
    return np.array([found[n] for n in model.system(ALL).parameters])


def simulated(model, p, x0=None, v=None):
    t = np.linspace(0, 0.3, 301)
    v = np.select([t < 0.01, t < 0.15, t < 0.25], [0, 6.0, -5.0], 0.0) if v is None else v  # coasts at last
    system = model.system(ALL)
    x0 = np.zeros(len(system.states)) if x0 is None else x0
    grid = Grid.of(t, v[:, None], np.array([True]))
    engine = Rosenbrock(compiled=False)
    grid = engine.prepare(system, grid, x0, p, 1e-6)
    return engine.run(system, grid, x0, p, np.zeros((len(x0), len(p))), np.eye(len(p)))


def nulls(effect):
    """Null values of the sizes; a time constant comes close to zero, a knee current goes far away."""
    sizes = {p.name: p for p in effect.parameters if p.null is not None}
    return {n: 1e9 if p.null == np.inf else 1e-8 if p.positive else p.null for n, p in sizes.items()}


@pytest.fixture(scope="module")
def plain():
    model = motor()
    return simulated(model, parameters(model)).y


@every_effect
def test_vanishes_at_its_null_value(effect, plain):
    assert nulls(effect), "some parameter must make the effect vanish"
    model = motor(effect)
    traj = simulated(model, parameters(model, **nulls(effect)))
    assert np.abs(traj.y - plain).max(axis=0) == pytest.approx([0, 0, 0], abs=2e-5 * np.abs(plain).max())
    assert (np.abs(traj.y - plain).max(axis=0) <= 2e-5 * np.abs(plain).max(axis=0)).all()
    assert np.isfinite(traj.dy).all()  # the score at null of the diagnosis rests on it


@every_effect
def test_does_something_at_its_declared_value(effect, plain):
    model = motor(effect)
    traj = simulated(model, parameters(model))
    assert np.isfinite(traj.y).all()
    assert np.isfinite(traj.dy).all()
    assert (np.abs(traj.y - plain).max(axis=0) > 1e-7 * np.abs(plain).max(axis=0)).any()


def test_order_of_adding_does_not_matter(rng):
    for first, second in islice(combinations(LIBRARY.values(), 2), 0, None, 3):  # each with a third of the others
        try:
            models = motor(first, second), motor(second, first)
        except ModelError:
            continue  # both describe the same friction
        a, b = (m.system(ALL) for m in models)
        assert a.states == b.states
        nx, nu, _, _ = a.sizes
        x, u = rng.normal(size=nx), rng.normal(size=nu)
        for f, g in ((a.rhs, b.rhs), (a.out, b.out)):
            assert np.array_equal(
                f(x, u, parameters(models[0])).full(), g(x, u, parameters(models[1])).full()
            )


@pytest.mark.parametrize("names", [("encoder_zero", "speed_ripple"), ("speed_ripple", "encoder_zero")])
@pytest.mark.parametrize("begun", [0.0, 2.1, -3.0])
def test_an_encoder_off_centre_shows_the_angle_that_it_was_started_with(names, begun):
    model = motor(*(getattr(mi.effects, n) for n in names))
    p = parameters(model, a_w=0.1, N_w=1.0, phi_w=0.7, e_w=1.0, z_0=0.3)
    system = model.system(ALL)
    x0 = system.first_state(np.array([0.0, 0.0, begun]), p)
    shown = system.out(x0, np.zeros(system.sizes[1]), p).full()[2]
    assert shown == pytest.approx(begun, abs=1e-4)


@pytest.mark.parametrize("effect", ["cogging", "torque_ripple"])  # written before and after the encoder's zero
def test_beside_the_zero_of_an_encoder_an_effect_sees_the_measured_angle_where_that_is_given(effect):
    model = motor(mi.effects.get(effect), mi.effects.encoder_zero)
    system = model.with_(angle_input=True).system(ALL)
    x, u, p = ca.SX.sym("x", len(system.states)), ca.SX.sym("u", system.sizes[1]), ca.SX.sym("p", system.sizes[2])
    torque = system.rhs(x, u, p)[system.states.index("omega")]
    assert not ca.depends_on(torque, x[system.states.index("theta")])
    assert ca.depends_on(torque, u[system.inputs.index("theta_in")])


@every_effect
@pytest.mark.parametrize("v", [0.0, 6.0])
def test_value_and_jacobian_are_finite_at_standstill(effect, v):
    model = motor(effect)
    system = model.system(ALL)
    x, u, p = ca.SX.sym("x", len(system.states)), ca.SX.sym("u"), ca.SX.sym("p", len(system.parameters))
    f = ca.vertcat(system.rhs(x, u, p), system.out(x, u, p))
    both = ca.Function("both", [x, u, p], [f, ca.jacobian(f, x), ca.jacobian(f, p)])
    for values in ({}, nulls(effect)):
        for part in both(np.zeros(x.numel()), v, parameters(model, **values)):
            assert np.isfinite(part.full()).all()


@pytest.mark.parametrize("name", FRICTION)
def test_friction_never_drives(name, rng):
    effect = LIBRARY[name]
    model = motor(effect)
    values = {"b_a": 6e-5} if name == "viscous_asymmetric" else {}
    p = parameters(model, **values)
    system = model.system(ALL)
    w0 = 80.0
    for start in (w0, -w0):
        x0 = np.zeros(len(system.states))
        x0[system.states.index("omega")] = start
        omega = simulated(model, p, x0, np.zeros(301)).y[:, 1]
        assert (np.abs(omega) <= w0 * (1 + 1e-9)).all()
        assert np.abs(omega[-1]) < 1e-2 * w0
        back = 1e-2 if name == "lugre" else 1e-3  # bristles spring back a little
        assert (omega * np.sign(start) > -back * w0).all()  # it stops, it does not turn back
    if name != "lugre":  # whose bristles store a little energy
        for _ in range(200):
            x = rng.normal(size=len(system.states)) * [3.0, 100.0, 10.0]
            lost = model_torque(model, x, p) - model_torque(motor(), x[:3], parameters(motor()))
            omega, viscous = x[1], 6.5e-5 * x[1]
            assert (lost - (viscous if name == "viscous_asymmetric" else 0)) * omega <= 1e-12
    rest = simulated(model, p, None, np.zeros(301)).y
    assert np.abs(rest).max() == 0


def model_torque(model, x, p):
    return float(model.system(ALL).balances(x, 0.0, p).full()[1, 0])


def test_every_torque_effect_is_either_friction_or_known_to_do_work():
    drives = {"constant_load", "gravity", "spring", "end_stop", "cogging", "torque_ripple"}
    assert {n for n, e in LIBRARY.items() if e.balance == "torque"} == drives | set(FRICTION)


@every_effect
def test_says_what_it_is_with_units_limits_and_source(effect):
    assert re.search(r"(18|19|20)\d\d", effect.doc), "the source, with its year"
    assert effect.doc.splitlines()[0].endswith(".")
    for p in effect.parameters:
        assert p.unit in UNITS
        assert p.doc
        assert p.unit or p.name in (
            "mu",
            "r_load",
            "zeta_r",
            "r_far",
            "zeta_far",
            "zeta_f",
            "r_gap",
            "zeta_c",
            "r_slip",
            "r_free",
            "side",
            "N",
            "a_r",
            "a_w",
            "N_w",
            "e_w",
            "N_r",
            "e_r",
            "k_w",
            "s_c",
            "a_p",
            "s_f",
            "s_b",
            "a_f",
            "N_f",
            "mu_d",
            "mu_b",
            "k_i",
            "s_i",
            "u_i",
        )
    assert effect.balance in ("voltage", "torque", "transmission", "sensor")


def linear_record():
    t = np.linspace(0, 1, 101)
    v = np.sign(np.sin(10 * t))
    return (mi.Experiment(t, {"v": v}, {"theta": np.sin(3 * t)}, units={"theta": "m"}),)


@every_effect
def test_a_linear_axis_shows_no_rotary_units(effect):
    any_command = effect.name in ("driver_dead_band", "driver_voltage_limit")
    electrical = effect.balance == "voltage" and not any_command
    if electrical or "current" in effect.name:
        with pytest.raises(ModelError, match=r"dc_motor\(\)"):
            mi.Problem(mi.torque_driven("linear") + effect, linear_record())
        return
    model = mi.torque_driven("linear") + effect
    for p in effect.parameters:
        unit = model.parameters[p.name].unit
        angle = p.periodic  # phases stay angles
        assert angle or not re.search(r"rad|N·m(?!/)", unit.replace("N·m/", "")), (p.name, unit)


@every_effect
def test_survives_a_trip_to_another_process(effect):
    import pickle

    model = motor(effect)
    there = pickle.loads(pickle.dumps(model))
    a, b = model.system(ALL), there.system(ALL)
    assert a.rhs.serialize() == b.rhs.serialize()
    assert there.values == model.values


@pytest.mark.parametrize("name", ["driver_current_limit", "driver_lag", "driver_slew", "supply_sag", "pwm_coast",
                                  "pwm_fast_decay"])
def test_a_limited_voltage_is_what_others_of_the_driver_see(name):
    """As if the command had been clipped before."""
    t = np.arange(600) * 1e-3
    v = np.repeat([0.0, 12, -12, 3], 150)
    sizes = {"driver_current_limit": {"I_lim": 3.0}, "supply_sag": {"R_s": 0.3}}.get(name, {})
    motor = mi.dc_motor(R=1.0, L=2e-3, K=0.05, b=1e-4, J=1e-4) + LIBRARY[name](**sizes)
    limited = motor + mi.effects.driver_voltage_limit(V_lim=8.0)
    seen = []
    for model, volts in ((limited, v), (motor, np.clip(v, -8, 8))):
        run = mi.Experiment(t, {"v": volts}, {"i": 0 * t, "omega": 0 * t})
        seen.append(mi.simulate(model, run, initial="rest")[0].outputs)
    for c, y in seen[0].items():
        assert y == pytest.approx(seen[1][c], abs=1e-6 * np.abs(y).max())


@pytest.mark.parametrize("period", [0.4, 1.5, 6.0])
def test_a_bridge_that_returns_its_current_drives_the_mean_current_of_its_switching(period):
    """Steps through periods of a current that rises, falls against the supply and ends; the last one counts."""
    supply, R, L, K, n = 12.0, 2.0, 1e-3, 0.05, 2000
    duty, emf = (a.ravel() for a in np.meshgrid([0.0, 0.2, 0.5, 0.8, 1.0], supply * np.array([-0.3, 0.0, 0.6])))
    i = np.zeros_like(emf)
    for _ in range(30):
        total = np.zeros_like(i)
        for k in range(n):
            on = k < duty * n
            i = i + (np.where(on, supply, -supply) - emf - R * i) * period / (R * n)
            i = np.where(on, i, np.maximum(i, 0.0))
            total += i / n
    model = mi.dc_motor(R=R, L=L, K=K) + mi.effects.pwm_fast_decay(a_p=period, V_s=supply)
    system = model.system(("i", "omega"))
    p = np.array([model.values[name] for name in system.parameters])
    for sign in (1, -1):
        for d, e, mean in zip(duty, emf, total, strict=True):
            rates = np.array(system.rhs(np.array([0.0, sign * e / K]), sign * d * supply, p)).ravel()
            assert sign * rates[0] * L / R == pytest.approx(mean, abs=3e-3 * supply / R)
