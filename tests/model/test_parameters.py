"""Parameters with units and limits, and the coordinates in which the solvers see them."""

from __future__ import annotations

import numpy as np
import pytest

import motorid as mi
from motorid.errors import ModelError
from motorid.model.definition import P, Parameter
from motorid.problem.unknowns import Scaling

MIXED = [
    Parameter("R", 1.4, "Ω", positive=True),
    Parameter("tau_0", -2e-3, "N·m", lower=-1.0, upper=0.5),
    Parameter("J", 2e-5, "kg·m²", positive=True, lower=1e-6),
    Parameter("phi", 0.0, "rad"),
]


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"value": float("nan")}, "finite"),
        ({"value": float("inf")}, "finite"),
        ({"value": -1.0, "positive": True}, r"got -1\. Say what it is"),
        ({"value": 0.0, "positive": True}, r"must be positive"),
        ({"value": 1.0, "lower": 2.0, "upper": 1.0}, "above upper"),
        ({"value": 3.0, "lower": 0.0, "upper": 2.0}, r"outside its limits \[0, 2\]"),
    ],
)
def test_a_value_that_cannot_be_is_refused_with_a_reason(fields, words):
    with pytest.raises(ModelError, match=words):
        Parameter("x", **fields)


@pytest.mark.parametrize("name", ["R", "J"])
def test_what_no_motor_is_without_is_not_zero_and_no_message_says_so(name):
    for value in (0.0, -1.0):
        with pytest.raises(ModelError, match=f"'{name}' must be positive") as refused:
            mi.dc_motor().fix(**{name: value})
        assert "leave it to the fit" in str(refused.value)
        assert "=0" not in str(refused.value)
    with pytest.raises(ModelError, match=r"model\.fix\(L=0\)"):
        mi.dc_motor(L=-1.0)


def test_zero_is_allowed_for_a_positive_parameter_that_is_held():
    assert Parameter("L", 0.0, "H", positive=True, vary=False).value == 0


def test_a_declared_parameter_gets_its_name_and_keeps_its_fields():
    p = P(2e-3, "N·m", null=0.0, lower=0.0, grid=[1, 2], at_least="tau_c", doc="d")(name="tau_s")
    assert p == Parameter("tau_s", 2e-3, "N·m", 0.0, null=0.0, grid=(1, 2), at_least="tau_c", doc="d")


def test_scaling_goes_there_and_back_and_its_slope_is_the_derivative(rng):
    scaling = Scaling.of(MIXED)
    values = np.array([p.value for p in MIXED])
    assert scaling.physical(scaling.scaled(values)) == pytest.approx(values, rel=1e-14)
    assert scaling.scale == pytest.approx(
        [1.4, 2e-3, 2e-5, 1.0]
    )  # a value of zero says nothing about its size
    q = scaling.scaled(values) + rng.normal(size=4)
    h = 1e-6
    numeric = [(scaling.physical(q + h * e) - scaling.physical(q - h * e)) @ e / (2 * h) for e in np.eye(4)]
    assert scaling.slope(q) == pytest.approx(numeric, rel=1e-8)


def test_limits_in_solver_coordinates_are_those_of_the_values():
    scaling = Scaling.of(MIXED)
    low, high = scaling.bounds
    assert low[0] == -np.inf
    assert low[1] == pytest.approx(-500)
    assert high[1] == pytest.approx(250)
    assert scaling.physical(low)[2] == pytest.approx(1e-6)
    assert np.isinf(high[[0, 2, 3]]).all()
    # A positive parameter stays positive and finite however far a step goes.
    far = scaling.physical(np.array([-1e6, 0, 1e6, 0]))
    assert far[0] > 0
    assert np.isfinite(far).all()


def test_sizes_replace_the_values_scale_only():
    scaling = Scaling.of(MIXED, [1.0, 0.1, 1e-4, 3.0])
    assert scaling.scale == pytest.approx([1.0, 0.1, 1e-4, 3.0])
    assert scaling.physical(scaling.scaled([2.0, -1e-3, 3e-5, 0.2])) == pytest.approx([2.0, -1e-3, 3e-5, 0.2])
