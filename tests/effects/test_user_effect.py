"""An effect of the user's own, written in a few lines, takes part in everything a library effect does."""

from __future__ import annotations

import numpy as np
import pytest

import motorid as mi
from motorid.errors import ModelError

VALUES = {"R": 1.38, "L": 1.72e-3, "K": 0.0462, "b": 6.5e-5, "J": 2.35e-5}


@mi.effect(balance="torque")
def spring(m, k_s=mi.P(1e-4, "N·m/rad", null=0, doc="stiffness")):
    """Torsion spring to a wall, k_s·theta. Hooke, 1678."""
    m.torque -= k_s * m.theta


@mi.effect(balance="transmission")
def absorber(m, r_a=mi.P(0.2, "", null=0.0, lower=0.0, upper=0.9), w_a=mi.P(60.0, "1/s", positive=True)):
    """A flywheel on a viscous coupling: two states of the motor's own kind."""
    wheel = m.state("omega_wheel", m.start["omega"])
    pull = r_a * m.symbols["J"] * w_a * (m.omega - wheel)
    m.rate(wheel, w_a * (m.omega - wheel))
    m.torque -= pull


def records(model, rng, channels=("i", "omega", "theta")):
    t = np.arange(600) * 1e-3
    noise = {"i": 0.01, "omega": 0.2, "theta": 1e-3}
    runs = []
    for volt in (6.0, -4.0):
        v = np.where(t < 0.02, 0.0, np.where(t < 0.3, volt, -volt / 2))
        bare = mi.Experiment(t, {"v": v}, {c: np.zeros(len(t)) for c in channels})
        sim = mi.simulate(model, bare, initial="rest")[0]
        out = {c: sim.outputs[c] + noise[c] * rng.normal(size=len(t)) for c in channels}
        runs.append(mi.Experiment(t, {"v": v}, out))
    return runs


@pytest.mark.parametrize(
    ("effect", "truth"),
    [(spring, {"k_s": 2e-3}), (absorber, {"r_a": 0.5, "w_a": 40.0})],
    ids=["spring", "absorber"],
)
def test_takes_part_in_a_fit(effect, truth, rng):
    runs = records((mi.dc_motor(**VALUES) + effect).replace(**truth), rng)
    plain = mi.fit(mi.dc_motor(), runs)
    better = mi.fit(mi.dc_motor() + effect, runs)
    assert plain.chi2 / plain.dof > 3
    assert better.chi2 / better.dof < 1.2
    for name, value in {**truth, **VALUES}.items():
        std = better.std[name]
        assert std is not None
        assert abs(better.values[name] - value) < 5 * std
    for name, value in truth.items():
        assert better.values[name] == pytest.approx(value, rel=0.03)
    # The next step of the story: from the fitted model on, in one line.
    again = mi.fit(plain.model + effect, runs)
    exact = (f.problem.with_finer_steps(10).residual(f.q) for f in (better, again))  # each has its own sub-steps
    first, second = (float(r @ r) for r in exact)
    assert second == pytest.approx(first, rel=1e-6)
    assert mi.check_derivatives(better.problem, better.q).ok


def test_stands_beside_library_effects(rng):
    model = (mi.dc_motor(**VALUES) + spring + mi.effects.coulomb).replace(k_s=2e-3, tau_c=4e-3)
    runs = records(model, rng)
    fit = mi.fit(mi.dc_motor() + mi.effects.coulomb + spring, runs)
    assert fit.values["k_s"] == pytest.approx(2e-3, rel=0.02)
    assert fit.values["tau_c"] == pytest.approx(4e-3, rel=0.05)
    assert fit.model.without("spring").effect_names == ("coulomb",)


def test_an_angle_of_the_models_own_appears_where_it_is_used():
    assert "theta" in (mi.dc_motor() + spring).system(("i",)).states
    assert "theta" not in (mi.dc_motor() + absorber).system(("i",)).states


def test_a_law_may_call_casadi_and_keep_its_documentation():
    import casadi as ca

    @mi.effect(balance="voltage", name="diode")
    def law(m, V_f=mi.P(0.6, "V", null=0.0, lower=0.0), i_f=mi.P(0.1, "A", positive=True, grid=(0.03, 0.3))):
        """Two diodes back to back. Any datasheet, 1990."""
        m.voltage -= V_f * ca.asinh(m.i / i_f)

    assert law.name == "diode"
    assert law.doc.startswith("Two diodes")
    assert law.size.name == "V_f"
    assert [p.unit for p in law.parameters] == ["V", "A"]
    given = law(V_f=0.7)
    assert given.parameters[0].given
    assert (mi.dc_motor() + given).values["V_f"] == 0.7


def test_a_mistake_in_a_law_names_the_effect():
    @mi.effect(balance="torque")
    def typo(m, c=mi.P(1.0, "")):
        m.torque -= c * m.omga

    with pytest.raises(ModelError, match=r"typo: unknown quantity 'omga'\. Did you mean 'omega'\?"):
        mi.dc_motor() + typo
