"""What a newcomer types: public names only, and mistakes that are answered with what was meant."""

from __future__ import annotations

import pandas as pd
import pytest

import motorid as mi
from motorid.records.experiment import repeated

STEPS = mi.data_path("two_step_small")


@pytest.fixture(scope="module")
def runs():
    return mi.read_runs(STEPS)


@pytest.fixture(scope="module")
def fit(runs):
    return mi.fit(mi.dc_motor(), runs)


def test_dir_shows_public_names_and_no_rooms():
    shown = dir(mi)
    assert {"fit", "diagnose", "plot_answer", "effects", "datasets"} <= set(shown)
    assert not {"estimation", "numerics", "problem", "uncertainty"} & set(shown)
    assert all(hasattr(mi, n) for n in shown)


@pytest.mark.parametrize(("mistake", "says"), [
    (lambda runs, fit: mi.fit(mi.dc_motor, runs), "with brackets"),
    (lambda runs, fit: mi.fit(runs, mi.dc_motor()), "model comes first"),
    (lambda runs, fit: mi.fit(mi.dc_motor(), "run1.csv"), "read_runs"),
    (lambda runs, fit: mi.fit(mi.dc_motor(), runs, solver="LM"), "mi.LevenbergMarquardt()"),
    (lambda runs, fit: mi.diagnose(mi.dc_motor()), "diagnose takes a fit"),
    (lambda runs, fit: mi.improve(runs), "improve takes a fit"),
    (lambda runs, fit: mi.covariance(mi.dc_motor()), "covariance takes a fit"),
    (lambda runs, fit: mi.dc_motor() + "coulomb", "mi.effects.coulomb"),
])  # fmt: skip
def test_a_mistake_is_answered_in_a_sentence(runs, fit, mistake, says):
    with pytest.raises(mi.MotoridError, match=says.replace("(", r"\(").replace(")", r"\)")):
        mistake(runs, fit)


@pytest.mark.parametrize(("owner", "name", "meant"), [(mi.effects, "columb", "coulomb"), (mi, "plot_fits", "plot_fit")])
def test_a_misspelt_name_is_answered_with_the_right_one(owner, name, meant):
    with pytest.raises(AttributeError, match=f"Did you mean '{meant}'"):
        getattr(owner, name)


def test_parameters_come_as_a_data_frame(fit):
    frame = fit.to_frame()
    assert list(frame.index) == ["R", "L", "K", "b", "J"]
    assert frame.loc["R", "value"] == fit.values["R"]
    assert frame.loc["R", "std"] == fit.std["R"]


def test_records_may_be_data_frames(runs):
    frames = [pd.read_csv(p, comment="#") for p in sorted(STEPS.glob("*.csv"))]
    for found, run in zip(mi.read_runs(frames), runs, strict=True):
        assert found.outputs["omega"] == pytest.approx(run.outputs["omega"])
    assert mi.read_runs(frames[0])[0].channels == runs[0].channels


def test_held_out_runs_that_were_fitted_are_remarked(runs, fit):
    found = mi.diagnose(fit, validate=runs[:1], effects=["coulomb"])
    assert f"{runs[0].name} is both fitted and held out" in found.text
    halves = [runs[0].select(part) for part in (slice(0, runs[0].n // 2), slice(runs[0].n // 2, None))]
    assert not repeated(halves[:1], halves[1:]), "parts of one file are not the same record"


def test_results_print_their_tables(fit):
    ladder = mi.diagnose(fit, effects=["coulomb"]).ladder
    for shown in (mi.compare([fit]), ladder):
        assert "current" in str(shown)
        assert "─" in str(shown), "a table"
        assert repr(shown).startswith("<")
        assert "\n" not in repr(shown)
