"""Models: a base plus effects, every change a copy; what is refused, and with which remedy."""

from __future__ import annotations

import pickle
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest

import motorid as mi
from motorid.errors import ModelError

ALL = ("i", "omega", "theta")


def record(*channels):
    t = np.linspace(0, 1, 101)
    v = np.where(t < 0.1, 0.0, 6.0)
    signals = {"i": 1 - np.cos(t), "omega": 100 * t, "theta": 50 * t**2}
    return mi.Experiment(t, {"v": v}, {c: signals[c] for c in channels})


# -- copies --------------------------------------------------------------------------------------------------
def test_every_change_returns_a_copy():
    base = mi.dc_motor()
    more = base + mi.effects.coulomb
    held, set_, bounded = more.fix("L"), more.replace(R=3.0), more.bounded(R=(0.5, 5.0))
    assert base.effect_names == ()
    assert "L" in more.free_names
    assert more.values["R"] == base.values["R"]
    assert "L" not in held.free_names
    assert "L" in held.free("L").free_names
    assert set_.values["R"] == 3.0
    assert set_.parameters["R"].given
    assert not more.parameters["R"].given
    assert bounded.parameters["R"].lower == 0.5
    assert more.bounded(J=(1e-4, 1e-2)).values["J"] == 1e-4  # nobody gave the 1e-5 that it had


def test_fix_with_a_value_sets_and_holds():
    model = mi.dc_motor().fix(R=1.2)
    assert model.values["R"] == 1.2
    assert not model.parameters["R"].vary


def test_values_of_a_result_do_not_count_as_given():
    model = mi.dc_motor().start_at({"R": 3.0, "unheard_of": 1.0})
    assert model.values["R"] == 3.0
    assert not model.parameters["R"].given


def test_an_effect_with_given_values_keeps_them_and_holds_an_order():
    effect = mi.effects.cogging(N=12, A=2e-3)
    model = mi.dc_motor() + effect
    assert model.values["A"] == 2e-3
    assert not model.parameters["N"].vary
    assert model.parameters["A"].vary
    assert mi.effects.cogging.parameters[0].given is False


def test_without_takes_out_the_effect_and_its_parameters_only():
    model = (mi.dc_motor(R=2.0) + mi.effects.coulomb + mi.effects.gravity).replace(mgl=0.3).fix("K")
    less = model.without("coulomb")
    assert less.effect_names == ("gravity",)
    assert "tau_c" not in less.parameters
    assert "sgn_width" not in less.parameters  # no sgn is left
    assert less.values["mgl"] == 0.3
    assert less.values["R"] == 2.0
    assert not less.parameters["K"].vary


def test_the_width_of_sgn_appears_with_the_first_sgn_and_is_held():
    model = mi.dc_motor() + mi.effects.coulomb
    assert not model.parameters["sgn_width"].vary
    assert "sgn_width" not in (mi.dc_motor() + mi.effects.quadratic_drag).parameters


# -- the equations -------------------------------------------------------------------------------------------
def test_the_base_is_the_textbook_motor():
    system = mi.dc_motor(R=2.0, L=0.5, K=0.1, b=0.01, J=0.2).system(("i", "omega"))
    p = [2.0, 0.5, 0.1, 0.01, 0.2]
    assert system.parameters == ("R", "L", "K", "b", "J")
    assert system.rhs([3.0, 40.0], [6.0], p).full().ravel() == pytest.approx(
        [(6 - 2 * 3 - 0.1 * 40) / 0.5, (0.1 * 3 - 0.01 * 40) / 0.2]
    )
    assert system.out([3.0, 40.0], [6.0], p).full().ravel() == pytest.approx([3.0, 40.0])


def test_a_torque_drive_turns_its_command_into_torque():
    model = mi.torque_driven(g=2.0, b=0.1, J=0.5)
    system = model.system(("omega", "theta"))
    assert system.states == ("omega", "theta")
    f = system.rhs([3.0, 1.0], [4.0], [2.0, 0.1, 0.5]).full().ravel()
    assert f == pytest.approx([(2 * 4 - 0.1 * 3) / 0.5, 3.0])
    assert model.free_names == ("b", "J")  # only ratios to the gain can be found
    assert mi.torque_driven().free("g").free_names == ("g", "b", "J")


def test_a_linear_axis_shows_linear_units():
    model = mi.torque_driven("linear") + mi.effects.coulomb + mi.effects.quadratic_drag
    units = {n: p.unit for n, p in model.parameters.items()}
    assert units == {"g": "N/V", "b": "N·s/m", "J": "kg", "tau_c": "N", "c_2": "N·s²/m²", "sgn_width": "m/s"}
    phase = (model + mi.effects.cogging).parameters["phi"]
    assert phase.unit == "rad"  # of a wave, over a metre as over a turn


def test_an_effect_may_read_what_a_later_one_changes():
    @mi.effect(balance="torque")
    def extra(m, share=mi.P(0.1, "")):
        m.torque -= share * m.K_t * m.i

    for order in ((extra, mi.effects.magnetic_saturation), (mi.effects.magnetic_saturation, extra)):
        model = mi.dc_motor(K=0.2)
        for e in order:
            model = model + e
        system = model.system(("i", "omega"))
        p = [{**model.values, "i_K": 2.0}[n] for n in system.parameters]
        torque = system.balances([2.0, 0.0], [0.0], p).full()[1, 0]
        assert torque == pytest.approx(0.2 / 2 * 2.0 * 0.9)  # K halved at i_K, in the new effect too


def test_factors_of_several_effects_multiply_and_sensors_follow_one_another():
    @mi.effect(balance="voltage")
    def twice(m, f=mi.P(2.0, "")):
        m.scale("R", f)

    @mi.effect(balance="sensor")
    def turned(m, sense=mi.P(-1.0, "")):
        m.measure("i", sense * m.measured("i"))

    model = mi.dc_motor(R=1.0) + twice + mi.effects.winding_heating + turned + mi.effects.current_offset
    system = model.system(("i",))
    p = [{**model.values, "i_0": 0.5}[n] for n in system.parameters]
    dT = 100.0
    x = [{"i": 1.0, "dT": dT}.get(s, 0.0) for s in system.states]
    voltage = system.balances(x, [0.0], p).full()[0, 0]
    assert voltage == pytest.approx(-2.0 * (1 + 0.00393 * dT))
    # Sensor effects follow in the order of their names, whatever the order of adding.
    assert system.out(x, [0.0], p).full()[0, 0] == pytest.approx(-(1.0 + 0.5))


def test_held_without_inductance_the_current_is_algebraic():
    assert mi.dc_motor().fix(L=0).system(("i",)).stored == (False, True)
    assert mi.dc_motor().fix(L=1e-3).system(("i",)).stored == (True, True)


def test_models_that_differ_in_values_share_their_functions():
    a, b = mi.dc_motor() + mi.effects.coulomb, mi.dc_motor(R=3.0).fix("L") + mi.effects.coulomb
    assert a.system(("i", "omega")) is b.system(("i", "omega"))
    assert a.system(("i", "omega")) is not a.system(("omega",))
    assert a.system(("i", "omega")) is not a.fix(L=0).system(("i", "omega"))


# -- refused, with the remedy --------------------------------------------------------------------------------
def test_the_same_effect_twice():
    with pytest.raises(ModelError, match=r"model\.without\('coulomb'\)"):
        mi.dc_motor() + mi.effects.coulomb + mi.effects.coulomb


@pytest.mark.parametrize(
    ("first", "second"), [("coulomb", "stribeck"), ("stribeck", "coulomb"), ("coulomb_asymmetric", "lugre")]
)
def test_the_same_friction_twice(first, second):
    with pytest.raises(ModelError, match=rf"model\.without\('{first}'\)"):
        mi.dc_motor() + mi.effects.get(first) + mi.effects.get(second)


def test_duplicate_parameter_names():
    @mi.effect(balance="torque")
    def mine(m, tau_c=mi.P(1e-3, "N·m")):
        m.torque -= tau_c

    with pytest.raises(ModelError, match=r"'mine' brings a parameter 'tau_c'.*rename"):
        mi.dc_motor() + mi.effects.coulomb + mine


def test_two_replacements_of_one_quantity():
    @mi.effect(balance="voltage")
    def amplifier(m, gain=mi.P(1.1, "")):
        m.replace("v", gain * m.command)

    with pytest.raises(ModelError, match=r"'driver_dead_band' and 'amplifier' both replace 'v'.*without"):
        mi.dc_motor() + amplifier + mi.effects.driver_dead_band


def test_circular_definitions():
    @mi.effect(balance="voltage")
    def a(m, c_a=mi.P(1.0, "")):
        m.scale("R", 1 + c_a * m.K)

    @mi.effect(balance="torque")
    def b(m, c_b=mi.P(1.0, "")):
        m.scale("K", 1 + c_b * m.R)

    with pytest.raises(ModelError, match=r"definitions of .*R.* go in a circle"):
        (mi.dc_motor() + a + b).system(("i",))


@pytest.mark.parametrize("how", ["read", "scale", "replace", "push", "measure"])
def test_unknown_quantities(how):
    def law(m, c=mi.P(1.0, "")):
        if how == "read":
            m.torque -= c * m.omegga
        elif how == "scale":
            m.scale("Rr", c)
        elif how == "replace":
            m.replace("Rr", c)
        elif how == "push":
            m.push("omega_lod", c)
        else:
            m.measure("omegga", c * m.omega)

    effect = mi.effect(balance="torque", name="mistaken")(law)
    with pytest.raises(ModelError, match=r"mistaken.*(Did you mean|Known)"):
        mi.dc_motor() + effect


def test_a_push_adds_to_the_rate_of_another_effect_s_state():
    """A torque on the load behind a shaft, over its inertia."""
    @mi.effect(balance="transmission")
    def hung(m, tau=mi.P(1e-3, "N·m")):
        m.push("omega_load", -tau / (m.base("J") * m.base("r_load")))

    shaft = mi.dc_motor(R=1.0, L=1e-3, K=0.05, b=1e-5, J=2e-5) + mi.effects.compliance(r_load=0.4)
    was, now = (model.system(("omega",)) for model in (shaft, shaft + hung))
    values = {**shaft.values, "tau": 1e-3}
    rates = [np.asarray(s.rhs(np.zeros(len(s.states)), np.zeros(1), [values[n] for n in s.parameters])).ravel()
             for s in (was, now)]
    changed = dict(zip(was.states, rates[1] - rates[0], strict=True))
    assert changed.pop("omega_load") == pytest.approx(-1e-3 / (2e-5 * 0.4))
    assert not any(changed.values())
    with pytest.raises(ModelError, match="unknown quantity 'r_load'"):
        mi.dc_motor() + hung


def test_a_state_without_a_rate():
    @mi.effect(balance="torque")
    def lazy(m, c=mi.P(1.0, "")):
        m.torque -= c * m.state("z")

    with pytest.raises(ModelError, match=r"'z' has no rate: call m\.rate"):
        (mi.dc_motor() + lazy).system(("i",))


def test_a_state_twice_and_a_rate_of_the_motor():
    @mi.effect(balance="torque")
    def twin(m, c=mi.P(1.0, "K")):
        m.rate(m.state("dT"), c)

    with pytest.raises(ModelError, match=r"'winding_heating' adds a state 'dT'.*rename"):
        mi.dc_motor() + twin + mi.effects.winding_heating

    @mi.effect(balance="torque")
    def bold(m, c=mi.P(1.0, "")):
        m.rate(m.omega, c)

    with pytest.raises(ModelError, match=r"made with m\.state"):
        mi.dc_motor() + bold


def test_symbols_of_the_users_own():
    stray = ca.SX.sym("stray")

    @mi.effect(balance="torque")
    def smuggler(m, c=mi.P(1.0, "")):
        m.torque -= c * stray

    with pytest.raises(ModelError, match=r"uses stray, which nothing defines"):
        (mi.dc_motor() + smuggler).system(("i",))


@pytest.mark.parametrize(
    ("effect", "channels"),
    [
        ("current_lag", ("omega",)),
        ("current_offset", ("omega", "theta")),
        ("speed_gain", ("i", "theta")),
        ("speed_lag", ("theta",)),
        ("speed_delay", ("i",)),
    ],
)
def test_an_effect_that_the_channels_cannot_see(effect, channels):
    with pytest.raises(ModelError, match=rf"'{effect}' cannot be seen.*model\.without\('{effect}'\)"):
        mi.fit(mi.dc_motor() + mi.effects.get(effect), record(*channels))


@pytest.mark.parametrize("channels", [("i",), ("omega",), ("theta",)])
def test_an_effect_on_the_motor_is_seen_in_any_channel(channels):
    for name, effect in mi.effects.LIBRARY.items():
        if effect.balance != "sensor":
            visible = mi.Problem(mi.dc_motor() + effect, record(*channels)).system.visible
            assert {p.name for p in effect.parameters} <= visible, name


def test_electrical_effects_on_a_torque_drive():
    for name in ("voltage_offset", "brush_drop", "winding_heating"):
        with pytest.raises(ModelError, match=r"dc_motor\(\)"):
            (mi.torque_driven() + mi.effects.get(name)).system(("omega",))


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (lambda: mi.dc_motor(r=1.0), r"unknown parameter 'r'\. Did you mean|Known"),
        (lambda: mi.dc_motor().fix("Rr"), "unknown parameter"),
        (lambda: mi.dc_motor().without("coulomb"), "unknown effect in this model"),
        (lambda: mi.effects.get("coulom"), "Did you mean 'coulomb'"),
        (lambda: mi.effects.coulomb(tau=1.0), r"effect 'coulomb': unknown parameter 'tau'"),
        (lambda: mi.dc_motor() + "coulomb", r"takes effects, got coulomb.*mi\.effects"),
        (lambda: mi.torque_driven("rotational"), "unknown axis"),
        (lambda: mi.torque_driven().system(("i",)), r"has no current"),
        (lambda: mi.dc_motor().system(("speed",)), "unknown channel"),
        (lambda: mi.effect(balance="thermal"), "unknown balance"),
        (lambda: mi.effect(balance="torque")(lambda m, c=1.0: None), r"'c' needs a default P\("),
        (lambda: mi.dc_motor(R=-1.0), "must be positive"),
        (lambda: mi.dc_motor(R=1.0).bounded(R=(2.0, 3.0)), "outside its limits"),
    ],
)
def test_wrong_words_are_answered_with_the_right_ones(wrong, words):
    with pytest.raises(ModelError, match=words):
        wrong()


# -- travelling ----------------------------------------------------------------------------------------------
def test_a_model_travels_as_plain_data_and_works_there():
    model = (mi.dc_motor(R=2.0) + mi.effects.coulomb(tau_c=0.01)).fix("L")
    model.system(ALL)
    there = pickle.loads(pickle.dumps(model))
    assert there.parameters == model.parameters
    assert there.system(ALL).rhs.serialize() == model.system(ALL).rhs.serialize()


def test_a_model_with_a_law_from_another_session_says_so():
    code = """
import pickle, sys, motorid as mi
@mi.effect(balance="torque")
def mine(m, c=mi.P(1e-3, "N·m", null=0)):
    m.torque -= c
sys.stdout.buffer.write(pickle.dumps(mi.dc_motor() + mine))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    model = pickle.loads(done.stdout)
    assert model.effect_names == ("mine",)
    with pytest.raises(ModelError, match=r"law of the effect 'mine' is not here.*Define it again"):
        model.system(("omega",))


def test_shows_what_it_is():
    model = mi.dc_motor() + mi.effects.coulomb
    assert repr(model) == "<model dc_motor + coulomb: R, L, K, b, J, tau_c>"
    assert repr(mi.effects.coulomb) == "<effect coulomb (torque): tau_c>"


def test_a_start_outside_the_limits_is_moved_to_them_and_a_value_that_is_set_there_is_refused():
    model = mi.dc_motor()
    model = model._change({"R": {"lower": 1.0, "upper": 3.0, "value": 2.0}})
    assert model.start_at({"R": 1.0 - 1e-15}).parameters["R"].value == 1.0
    assert model.start_at({"R": 3.0 + 1e-12}).parameters["R"].value == 3.0
    assert model.start_at({"R": 0.9}).parameters["R"].value == 1.0
    with pytest.raises(mi.ModelError, match="outside its limits"):
        model.replace(R=0.9)
