"""Playing with a model: what the mouse does is done to it, and an impossible wish is answered in words."""

import builtins
import sys
from types import SimpleNamespace

import hand_made
import pytest

import motorid as mi
from motorid.errors import MissingDependency, UsageError
from motorid.reports.explorer import _can_be_seen


@pytest.fixture(scope="module")
def fit():
    return mi.fit(mi.dc_motor(), hand_made.friction()[0])


@pytest.fixture
def playing(fit):
    return mi.explore(fit, effects=["coulomb", "stribeck", "cogging"])


def test_it_begins_with_the_fit_its_curves_and_its_errors(playing, fit):
    assert playing.model.values == fit.values
    assert playing.evaluation.nrmse == pytest.approx(fit.nrmse, rel=1e-4)
    assert {n: s.value for n, s in playing.sliders.items()} == pytest.approx(fit.values, rel=1e-3)
    assert not any(box.value for box in playing.boxes.values())
    assert bytes(playing._picture.value).startswith(b"\x89PNG")
    assert "DC motor" in playing._errors.value


def test_ticking_an_effect_and_refitting_makes_the_error_fall(playing, fit):
    drawn = bytes(playing._picture.value)
    playing.boxes["coulomb"].value = True
    assert playing.model.effect_names == ("coulomb",)
    assert "tau_c" in playing.sliders
    assert playing.evaluation.nrmse["omega"] != pytest.approx(fit.nrmse["omega"], rel=1e-3)
    assert playing._picture.value != drawn
    playing.buttons["refit"].click()
    assert playing.message.startswith("refitted: converged")
    assert playing.evaluation.nrmse["omega"] < 0.01 < fit.nrmse["omega"]
    assert playing.fit.values["tau_c"] == pytest.approx(8e-3, rel=0.01)
    assert playing.sliders["tau_c"].value == pytest.approx(8e-3, rel=0.02)


def test_moving_a_slider_moves_the_parameter_and_the_error(playing, fit):
    playing.sliders["R"].value = 2 * fit.values["R"]
    assert playing.model.values["R"] == pytest.approx(2 * fit.values["R"], rel=0.01)
    assert playing.evaluation.nrmse["i"] > fit.nrmse["i"]
    assert playing.fit is fit


def test_parameters_can_be_set_beyond_the_slider(playing, fit):
    playing.move(R=50 * fit.values["R"])
    assert playing.sliders["R"].value == pytest.approx(50 * fit.values["R"], rel=0.01)


def test_unticking_and_reset_lead_back(playing, fit):
    playing.tick("cogging")
    playing.tick("cogging", on=False)
    assert playing.model.effect_names == ()
    playing.move(K=0.05)
    playing.buttons["reset"].click()
    assert playing.model.values == fit.values
    assert playing.evaluation.nrmse == pytest.approx(fit.nrmse, rel=1e-4)


def test_what_cannot_be_is_said_and_nothing_changes(playing):
    playing.boxes["coulomb"].value = True
    playing.boxes["stribeck"].value = True
    assert "same friction" in playing.message
    assert not playing.boxes["stribeck"].value
    assert playing.model.effect_names == ("coulomb",)
    playing.move(nonsense=1.0)
    assert "no parameter 'nonsense'" in playing.message
    playing.tick("nonsense")
    assert "no effect 'nonsense'" in playing.message


def test_a_model_that_cannot_be_simulated_is_not_taken(playing, monkeypatch):
    def fails(*_args, **_kwargs):
        raise mi.SimulationError("the integration stopped at 0.1 s.")

    monkeypatch.setattr(sys.modules["motorid.reports.explorer"], "evaluate", fails)
    before = playing.model
    playing.move(R=3.0)
    assert playing.model is before
    assert playing.message == "the integration stopped at 0.1 s."


def test_effects_that_the_channels_cannot_see_are_not_offered(fit):
    offered = mi.explore(fit).boxes
    assert {"coulomb", "stribeck", "brush_drop"} <= set(offered)
    speed_only = mi.fit(mi.dc_motor().fix(R=1.0, L=1e-3), [r.without("i") for r in hand_made.friction()[0]])
    assert "current_offset" not in mi.explore(speed_only).boxes


def test_an_effect_of_the_users_own_can_be_ticked(fit):
    @mi.effect(balance="torque")
    def bump(m, A=mi.P(1e-3, "N·m", null=0)):
        m.torque -= A

    assert list(mi.explore(fit, effects=[bump]).boxes) == ["bump"]


def test_it_shows_itself_in_a_notebook_and_in_one_line_elsewhere(playing):
    shown = playing._repr_mimebundle_()
    bundle = shown[0] if isinstance(shown, tuple) else shown
    assert "application/vnd.jupyter.widget-view+json" in bundle
    assert repr(playing) == "<explorer of DC motor on 2 runs>"


def test_without_ipywidgets_it_says_what_to_install(fit, monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "ipywidgets":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.delitem(sys.modules, "ipywidgets", raising=False)
    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingDependency, match=r"motorid\[notebooks\]"):
        mi.explore(fit)


def test_something_else_than_a_fit_is_refused():
    with pytest.raises(UsageError, match="explore takes a fit"):
        mi.explore(mi.dc_motor())


def test_effects_stand_by_balance_the_most_promising_first_with_their_law(fit):
    playing = mi.explore(fit, effects=["brush_drop", "quadratic_drag", "coulomb"])
    beside, *below = playing.widget.children  # what is moved and what it does beside one another, the ticks below
    shown = [str(getattr(part, "value", "")) for part in below]
    assert [t for t in shown if t.startswith("<b>")] == ["<b>Voltage balance</b>", "<b>Torque balance</b>"]
    assert "<b>Parameters</b>" in [getattr(part, "value", "") for part in beside.children[0].children]
    assert next(iter(playing.boxes)) == "coulomb"
    assert playing.boxes["coulomb"].description.startswith("coulomb −")
    assert "sgn" in playing.boxes["coulomb"].tooltip
    assert [label.value for _, label in (row.children for row in playing._sliders.children)] == [
        "Ω", "H", "N·m/A", "N·m·s/rad", "kg·m²"]


def test_curves_follow_the_mouse(playing, fit):
    """While a slider is dragged, not only when it is let go."""
    assert playing.sliders["R"].continuous_update
    drawn = bytes(playing._picture.value)
    playing.move(R=1.5 * fit.values["R"])
    assert bytes(playing._picture.value) != drawn


def test_a_browser_that_rounds_what_it_shows_moves_nothing(fit):
    """Seen in one: opening the widget sent every value back, changed in its last digits."""
    fresh = mi.explore(fit, effects=["coulomb"])
    before = dict(fresh.model.values)
    for slider in fresh.sliders.values():
        slider.value *= 1.0005
    assert fresh.model.values == before
    assert fresh.message == ""
    fresh.sliders["R"].value *= 1.01
    assert fresh.model.values["R"] == pytest.approx(1.01 * before["R"], rel=1e-3)
    assert fresh.message == "moved"


@pytest.mark.parametrize(("present", "kin"), [("driver_lag", "driver_slew"), ("speed_lag", "speed_filter"),
                                              ("compliance", "backlash"), ("coulomb", "stribeck")])
def test_what_would_take_the_place_of_an_effect_is_offered_in_every_balance(fit, present, kin):
    model = mi.dc_motor() + mi.effects.get(present)
    there = SimpleNamespace(model=model, problem=fit.problem)
    assert _can_be_seen(there, mi.effects.get(kin))
