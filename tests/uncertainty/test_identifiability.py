"""What records can tell: ranks, weak directions in words, remedies, planned experiments."""

import json

import numpy as np
import pytest

import motorid as mi
from motorid.errors import UsageError
from motorid.problem.problem import Problem
from motorid.problem.sensitivity import relative_jacobian
from motorid.records.datasets import truth
from motorid.uncertainty.identifiability import identifiability, monomials, sparse_basis

MOTOR = truth("two_step_noisy")["parameters"]


def records(name):
    return mi.read_runs(f"{mi.data_path(name)}/run*.csv")


@pytest.fixture(scope="module")
def noisy():
    return records("two_step_noisy")


@pytest.fixture(scope="module")
def speed_only(noisy):
    return [r.without("i") for r in noisy]


# The table of the study: singular values fall evenly, the rank is full, one condition number per motor.
@pytest.mark.parametrize(("name", "condition"), [("two_step_noisy", 77), ("two_step_small", 1440)])
def test_two_steps_determine_all_five_parameters(name, condition):
    found = identifiability(mi.fit(mi.dc_motor(), records(name)))
    assert (found.rank, found.structural_rank, found.full) == (5, 5, True)
    assert found.condition_number == pytest.approx(condition, rel=0.1)
    assert np.all(np.diff(found.singular_values) < 0)
    assert "full rank" in found.text


def test_relative_is_relative_to_the_value_beside_it(noisy):
    """Also of a load that may be zero, which the size of a relative change is not that of."""
    found = identifiability(mi.fit(mi.dc_motor() + mi.effects.constant_load, noisy))
    shown = {row[0]: row[3] for row in found.card().tables[0].rows}
    for name, value in zip(found.names, found.values, strict=True):
        said = float(shown[name].removesuffix(" %"))
        assert said == pytest.approx(100 * found.std[name] / abs(value), rel=0.06), name


@pytest.mark.parametrize("name", ["two_step_noisy", "two_step_small"])
def test_promised_standard_deviations_are_those_of_the_fit(name):
    fit = mi.fit(mi.dc_motor(), records(name))
    promised = identifiability(fit).noise_std
    for parameter, sd in mi.covariance(fit, method="white").std.items():
        assert promised[parameter] == pytest.approx(sd, rel=0.1)


def test_speed_alone_tells_three_combinations_of_five(speed_only):
    found = identifiability(Problem(mi.dc_motor(**MOTOR), speed_only))
    assert (found.rank, found.structural_rank) == (3, 3)
    assert all(sd is None for sd in found.std.values())
    assert "3 combinations of the 5 parameters" in found.text
    assert "in the equations" in found.text
    assert set(found.combinations) == {"K", "L·J", "R·J"}
    assert "Measure the current" in found.text
    # Resistance, inductance and inertia can be traded off exactly: the same voltage makes the same speed.
    scale = next(w for w in found.weak if {"R", "L", "J"} <= set(w.parameters))
    assert scale.seen < 1e-6
    assert np.sign(scale.parameters["R"]) == np.sign(scale.parameters["L"]) == -np.sign(scale.parameters["J"])


def test_weak_direction_of_speed_alone_does_leave_the_speed_unchanged(speed_only):
    before = mi.simulate(mi.dc_motor(**MOTOR), speed_only)[0].outputs["omega"]
    scaled = {n: v * {"R": 1.3, "L": 1.3, "J": 1 / 1.3, "b": 1 / 1.3}.get(n, 1.0) for n, v in MOTOR.items()}
    after = mi.simulate(mi.dc_motor(**scaled), speed_only)[0].outputs["omega"]
    np.testing.assert_allclose(after, before, rtol=1e-6, atol=1e-6)


def test_fixing_what_the_remedy_says_makes_the_rank_full(speed_only):
    found = identifiability(Problem(mi.dc_motor(**MOTOR), speed_only))
    assert any("Fix R and" in r for r in found.remedies)
    only_r = identifiability(Problem(mi.dc_motor(**MOTOR).fix("R"), speed_only))
    assert (only_r.rank, len(only_r.names)) == (3, 4)
    both = identifiability(Problem(mi.dc_motor(**MOTOR).fix("R", "b"), speed_only))
    assert both.full
    assert both.rank == 3


def test_without_inductance_speed_tells_two(speed_only):
    found = identifiability(Problem(mi.dc_motor(**MOTOR).fix(L=0), speed_only))
    assert (found.rank, len(found.names)) == (2, 4)
    assert "R·J" in found.combinations


def test_current_alone_leaves_one_direction(noisy):
    found = identifiability(Problem(mi.dc_motor(**MOTOR), [r.without("omega") for r in noisy]))
    assert (found.rank, found.structural_rank) == (4, 4)
    assert found.std["R"] is not None
    assert found.std["K"] is None
    assert "Measure the speed" in found.text


def test_sensitivities_agree_with_differences(noisy):
    model = mi.dc_motor(**MOTOR)
    found = identifiability(Problem(model, noisy))
    for j, name in enumerate(found.names):
        step = 1e-4
        up, down = (mi.simulate(model.replace(**{name: MOTOR[name] * np.exp(s)}), noisy, initial="rest")[0].outputs
                    for s in (step, -step))
        for c in ("i", "omega"):
            rms = np.sqrt(np.mean(noisy[0].outputs[c] ** 2))
            slope = (up[c] - down[c]) / (2 * step) / rms
            np.testing.assert_allclose(found.sensitivities[0][c][:, j], slope, atol=2e-4 * np.abs(slope).max())


def test_plan_is_judged_before_anything_is_measured():
    model, t = mi.dc_motor(**MOTOR), np.arange(0, 1, 1e-3)
    step = np.where(t > 0.05, 6.0, 0.0)
    good = identifiability(Problem(model, [mi.planned(model, t, step)]))
    assert good.full
    blind = identifiability(Problem(model, [mi.planned(model, t, step, channels=["omega"])]))
    assert blind.rank == 3


def test_too_much_noise_lowers_the_rank_but_not_the_structural_one():
    model, t = mi.dc_motor(**MOTOR), np.arange(0, 0.2, 1e-2)
    plan = mi.planned(model, t, np.full(len(t), 6.0), sigma={"i": 3.0, "omega": 30.0})
    found = identifiability(Problem(model, [plan]))
    assert found.rank < 5
    assert found.structural_rank == 5
    assert "too noisy" in found.text


def test_estimated_initial_states_are_not_counted_as_knowledge(noisy):
    at_rest = Problem(mi.dc_motor(**MOTOR), noisy, initial="rest")
    unknown = Problem(mi.dc_motor(**MOTOR), noisy, initial="estimate")
    less = relative_jacobian(unknown, unknown.start)
    assert less.shape[1] == 5
    assert np.linalg.norm(less) < np.linalg.norm(relative_jacobian(at_rest, at_rest.start))


def test_problem_without_values_is_judged_at_the_first_guess(noisy):
    found = identifiability(Problem(mi.dc_motor(), noisy))
    assert found.values[0] == pytest.approx(MOTOR["R"], rel=0.1)


def test_dictionary_keeps_the_contract_and_is_json(speed_only):
    found = identifiability(Problem(mi.dc_motor(**MOTOR), speed_only)).to_dict()
    assert {"singular_values", "condition_number", "rank", "parameters", "weak_directions", "std"} <= set(found)
    assert found["parameters"] == ["R", "L", "K", "b", "J"]
    assert set(found["weak_directions"][0]) == {"parameters", "text"}
    assert found["std"]["R"] is None
    assert json.loads(json.dumps(found))["rank"] == 3


def test_effect_that_one_direction_of_turning_hides_shows_as_a_weak_direction(noisy):
    model = mi.dc_motor(**MOTOR) + mi.effects.viscous_asymmetric(b_a=1e-5)
    found = identifiability(Problem(model, noisy))
    assert (found.rank, found.structural_rank) == (5, 6)
    assert "excite too little" in found.text
    assert [set(w.parameters) for w in found.weak] == [{"b", "b_a"}]


def test_nothing_free_is_refused(noisy):
    with pytest.raises(UsageError, match="no free parameter"):
        identifiability(Problem(mi.dc_motor().fix(**MOTOR), noisy))


def test_products_that_a_direction_leaves_alone_are_named():
    names = ("R", "K", "J")
    weak = np.linalg.svd(np.array([[1.0, -2.0, 1.0], [1.0, 0.0, -1.0]]))[2][2:]  # only two products are known
    assert set(monomials(names, weak)) == {"R/K", "K/J"} or "R·J/K²" in monomials(names, weak)
    direction = np.array([[1.0, 1.0, 1.0]]) / np.sqrt(3)
    for text in monomials(names, direction):
        above, below = text.split("/")
        assert above.count("·") + above.count("²") == below.count("·") + below.count("²")


def test_basis_of_weak_directions_is_sparse_and_spans_the_same_space(rng):
    wanted = np.array([[1.0, 1, 0, 0, -1], [0, 0, 1, -1, 0]])
    mixed = np.linalg.qr((rng.normal(size=(2, 2)) @ wanted).T)[0].T
    found = sparse_basis(mixed)
    assert np.sum(np.abs(found) > 1e-9) == 5
    np.testing.assert_allclose(found - found @ mixed.T @ mixed, 0, atol=1e-9)
