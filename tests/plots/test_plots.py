"""Figures: they say what they show, hide no peak, overlap nothing, and leave the user's settings alone."""

import dataclasses
import itertools
import re
import subprocess
import sys
from functools import lru_cache
from types import SimpleNamespace

import hand_made
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

import motorid as mi
from motorid import plots
from motorid.diagnosis.locate import binned
from motorid.errors import UsageError
from motorid.estimation.shooting.formulations import compare_formulations
from motorid.plots import diagnosis as plots_of_diagnosis
from motorid.plots.fits import LiveFit
from motorid.plots.style import axis_label, detached, envelope, svg_of
from motorid.problem.constraints import CurrentLimit
from motorid.uncertainty.identifiability import identifiability
from motorid.uncertainty.multistart import multistart
from motorid.uncertainty.profile import intervals


@pytest.fixture(scope="module")
def found():
    return hand_made.diagnosis(np.random.default_rng(20240611))


@pytest.fixture(scope="module")
def check():
    return hand_made.friction()[1]


@pytest.fixture(autouse=True)
def _closed():
    yield
    plt.close("all")


FIGURES = {
    "plot_runs": lambda d, check: plots.plot_runs([*d.before.problem.experiments, *check]),
    "plot_fit": lambda d, check: plots.plot_fit(d.before),
    "plot_fit, before": lambda d, check: plots.plot_fit(d.after, before=d.before),
    "plot_fit, held out": lambda d, check: plots.plot_fit(mi.evaluate(d.after, check)),
    "plot_residuals": lambda d, check: plots.plot_residuals(d.after),
    "plot_missing": lambda d, check: plots.plot_missing(d),
    "plot_ranking": lambda d, check: plots.plot_ranking(d),
    "plot_ladder": lambda d, check: plots.plot_ladder(d),
    "plot_design": lambda d, check: plots.plot_design(
        mi.design_experiment(d.before, duration=0.2, levels=3, budget=0.0)),
    "plot_parameters": lambda d, check: plots.plot_parameters(d, truth={"R": 1.38, "b": 6.5e-5}),
    "plot_sensitivities": lambda d, check: plots.plot_sensitivities(d.after),
    "plot_singular_values": lambda d, check: plots.plot_singular_values(identifiability(d.after)),
    "plot_profile": lambda d, check: plots.plot_profile(intervals(d.after, n=12, quiet=True)),
    "plot_waterfall": lambda d, check: plots.plot_waterfall(multistart(d.after, starts=6, quiet=True)),
    "plot_formulations": lambda d, check: plots.plot_formulations(formulations(d)),
    "plot_current_limit, formulations": lambda d, check: plots.plot_current_limit(formulations(d)),
    "plot_current_limit": lambda d, check: plots.plot_current_limit(
        d.before, d.after, limit=1.0, labels=["plain", "better"]
    ),
}


@lru_cache
def formulations(d):
    run = d.before.problem.experiments[0]
    return compare_formulations(mi.fit(mi.dc_motor(), run), [CurrentLimit(1.5)], weights=(0.1, 1.0))


@pytest.fixture(scope="module", params=FIGURES)
def drawn(request, found, check):
    """Every figure, drawn once."""
    with detached():
        axes = np.atleast_1d(np.asarray(FIGURES[request.param](found, check), object)).ravel()
    figure = axes[0].figure
    FigureCanvasAgg(figure).draw()
    return request.param, figure, axes


def test_every_axis_says_what_it_shows_and_in_which_unit(drawn):
    name, figure, axes = drawn
    told = [text for ax in axes for text in (ax.get_xlabel(), ax.get_ylabel(), ax.get_title(loc="left")) if text]
    told.append(figure.get_supxlabel())
    units = {"plot_ranking": "(%)", "plot_ladder": "(%)", "plot_parameters": "(Ω)", "plot_profile": "(Ω)"}
    units |= {
        "plot_waterfall": "ratio",
        "plot_singular_values": "singular value",
        "plot_formulations": "(%)",
    }  # numbers without a unit
    assert any(units.get(name, "(A)") in t for t in told), told
    bottom = [ax for ax in axes if ax.get_subplotspec() is not None and ax.get_subplotspec().is_last_row()]
    named_by_ticks = ("plot_parameters", "plot_ladder", "plot_singular_values", "plot_waterfall", "plot_formulations")
    if name not in named_by_ticks:
        assert all(ax.get_xlabel() for ax in bottom if ax.axison)


def test_no_words_overlap(drawn):
    name, figure, _ = drawn
    renderer = figure.canvas.get_renderer()
    boxes = []
    for ax in figure.axes:
        words = [ax.title, ax._left_title, ax._right_title, ax.xaxis.label, ax.yaxis.label]
        words += [t for t in ax.get_xticklabels() + ax.get_yticklabels() if _in_view(ax, t)]
        boxes += [(w.get_text(), w.get_window_extent(renderer)) for w in words if w.get_text() and w.get_visible()]
        if ax.get_legend() is not None:
            boxes.append(("legend", ax.get_legend().get_window_extent(renderer)))
    for (a, p), (b, q) in itertools.combinations([x for x in boxes if x[1].width > 0], 2):
        smaller = min(p.width * p.height, q.width * q.height)
        across = mpl.transforms.Bbox.intersection(p, q)
        assert across is None or across.width * across.height < 0.05 * smaller, f"{name}: '{a}' on '{b}'"


def _in_view(ax, tick):
    low, high = sorted(ax.get_xlim() if tick in ax.get_xticklabels() else ax.get_ylim())
    position = tick.get_position()[0 if tick in ax.get_xticklabels() else 1]
    return tick.get_visible() and low <= position <= high


def test_nothing_is_cut_off_at_the_edge(drawn):
    _, figure, _ = drawn
    inside = figure.get_tightbbox(figure.canvas.get_renderer())
    width, height = figure.get_size_inches()
    assert inside.x0 > -0.06
    assert inside.y0 > -0.06
    assert inside.x1 < width + 0.06
    assert inside.y1 < height + 0.06


def test_figures_fit_a_notebook(drawn):
    assert drawn[1].get_size_inches()[0] <= 9.3


def test_every_public_figure_is_reachable_from_the_package_and_drawn_here():
    drawn_here = {name.split(",")[0] for name in FIGURES}
    assert set(plots.__all__) <= set(dir(mi))
    assert all(getattr(mi, name) is getattr(plots, name) for name in plots.__all__)
    assert drawn_here <= set(plots.__all__)


def test_importing_the_package_loads_no_matplotlib_until_a_figure_is_asked_for():
    code = (
        "import sys, motorid; assert 'matplotlib' not in sys.modules; "
        "motorid.plot_fit; assert 'matplotlib' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(AttributeError, match="plot_nothing"):
        mi.plot_nothing  # noqa: B018


def test_the_users_settings_are_left_as_they_were(found):
    before = dict(mpl.rcParams)
    plots.plot_ladder(found)
    assert dict(mpl.rcParams) == before


def test_long_records_keep_the_peak_of_a_single_sample_and_their_gaps():
    t = np.arange(100_000.0)
    y = np.sin(t / 1e4)
    y[77_777], y[12_345], y[50_000:60_000] = 9.0, -9.0, np.nan
    x, z = envelope(t, y)
    assert len(x) < 2_000
    assert (np.nanmax(z), np.nanmin(z)) == (9.0, -9.0)
    assert (x[0], x[-1]) == (t[0], t[-1])
    assert np.all(np.diff(x) > 0)
    assert np.isnan(z[(x > 50_000) & (x < 60_000)]).all()


def test_short_records_are_drawn_sample_by_sample():
    t = np.linspace(0, 1, 500)
    assert envelope(t, t**2)[1].size == 500


def test_a_long_name_runs_over_no_neighbour():
    name = "2024-11-03_bench4_motor_A17_steps_recorded_at_night"
    runs = [r.with_(name=f"{name}_{k}") for k, r in enumerate(hand_made.friction()[0])]
    axes = np.ravel(plots.plot_fit(mi.fit(mi.dc_motor(), runs)))
    titles = [t for a in axes for t in (a.get_title(), a.get_title("left")) if t]
    assert any("…" in t and t.endswith("_0") for t in titles)
    assert max(map(len, titles)) <= 29


def test_the_title_tells_the_error_of_the_run_it_stands_on(found):
    axes = plots.plot_fit(found.before)
    assert axes[0, 0].get_title(loc="right") == f"NRMSE {100 * found.before.evaluation.by_run[0]['i']:.3g} %"


def test_the_band_is_two_standard_deviations_of_the_noise(found):
    axes = plots.plot_fit(found.after)
    heights = [p.get_height() for p in axes[1, 0].patches]
    sigma = found.after.problem.runs[0].sigma["i"]
    assert heights == pytest.approx([4 * sigma], rel=0.2)


def test_more_runs_than_fit_side_by_side_are_named(found):
    runs = list(found.before.problem.experiments) * 3
    assert plots.plot_runs(runs)[0, -1].get_title(loc="left").endswith("(and 3 more not shown)")


def test_a_channel_that_one_run_lacks_is_said_so(found):
    runs = found.before.problem.experiments
    axes = plots.plot_runs([runs[0], runs[1].without("i")])
    assert [t.get_text() for t in axes[1, 1].texts] == ["i not measured"]


def test_a_linear_axis_is_labelled_in_metres(found):
    run = mi.Experiment(np.arange(10.0), {"v": np.ones(10)}, {"theta": np.arange(10.0)}, units={"theta": "m", "v": "A"})
    assert axis_label("theta", run) == "position x (m)"
    assert axis_label("v", run) == "command u (A)"


def test_bars_of_the_ranking_are_the_drops_and_the_accepted_one_stands_out(found):
    ax = plots.plot_ranking(found)
    widths = sorted({round(p.get_width(), 3) for p in ax.patches})
    assert widths == [3.0, 55.0, 60.0, 97.0, 99.1, 99.4]
    assert [t.get_text() for t in ax.get_yticklabels()] == [c.effect for c in found.ranking]
    colours = {p.get_facecolor()[:3] for p in ax.patches if p.get_fill()}
    assert len(colours) == 2


def test_the_ladder_shows_fitted_and_held_out_errors_in_per_cent(found):
    ax = plots.plot_ladder(found)
    lines = {line.get_label(): line.get_ydata() for line in ax.get_lines()}
    first, last = found.ladder.rungs[0], found.ladder.rungs[-1]
    assert lines["speed ω, fitted"] == pytest.approx([100 * first.nrmse["omega"], 100 * last.nrmse["omega"]])
    assert lines["current i, held out"][1] == pytest.approx(100 * last.validation_nrmse["i"])


def test_errors_that_lie_close_are_written_apart(found):
    near = {"i": 0.5, "omega": 0.505}
    rungs = [dataclasses.replace(r, nrmse=near) for r in found.ladder.rungs]
    ax = plots.plot_ladder(dataclasses.replace(found.ladder, rungs=tuple(rungs)))
    FigureCanvasAgg(ax.figure).draw()
    boxes = [t.get_window_extent() for t in ax.texts]
    assert len(boxes) == 4
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))


def test_a_live_figure_is_the_figure_of_the_fit(found):
    """Moved, it shows what a new drawing shows; a curve that leaves its axes gets wider ones."""
    fit = found.after
    live = LiveFit(fit)
    moved = mi.evaluate(fit.model.replace(R=1.01 * fit.values["R"]), fit.problem.experiments)
    far = mi.evaluate(fit.model.replace(R=20 * fit.values["R"]), fit.problem.experiments)
    first = live.png(fit)
    assert live.png(moved) != first
    axes = plots.plot_fit(far)
    live.png(far)
    for drawn, wanted in zip(live.axes.flat, axes.flat, strict=True):
        np.testing.assert_array_equal(drawn.get_lines()[-1].get_ydata(), wanted.get_lines()[-1].get_ydata())
        low, high = drawn.get_ylim()
        y = drawn.get_lines()[-1].get_ydata()
        assert low <= np.nanmin(y) <= np.nanmax(y) <= high
        assert drawn.get_title(loc="right") == wanted.get_title(loc="right")


def test_parameters_show_two_standard_deviations_and_what_is_not_determined(found):
    axes = plots.plot_parameters(found.before, found.after, names=["K"])
    segments = axes[0].collections[0].get_segments()[0]
    assert segments[1][1] - segments[0][1] == pytest.approx(4 * found.before.std["K"])
    vague = mi.fit(mi.dc_motor(), [r.without("i") for r in found.before.problem.experiments])
    assert None in vague.std.values()
    texts = [t.get_text() for ax in plots.plot_parameters(vague) for t in ax.texts]
    assert "not\ndetermined" in texts


def test_a_true_angle_is_drawn_beside_its_estimate_whatever_the_turn(found):
    model = (found.after.model + mi.effects.gravity).start_at({"phi_g": 4.2})
    fit = SimpleNamespace(model=model, values=model.values, std={"phi_g": 0.1}, formulation="plain")
    axes = plots.plot_parameters(fit, truth={"phi_g": -2.0}, names=["phi_g"])
    assert axes[0].get_lines()[0].get_ydata()[0] == pytest.approx(-2.0 + 2 * np.pi)


def test_sensitivities_are_what_one_per_cent_of_a_parameter_does(found):
    fit = found.after
    axes = plots.plot_sensitivities(fit, names=["K"])
    t, drawn = axes[0, 1].get_lines()[0].get_data()
    run = fit.problem.experiments[0]
    moved = [mi.simulate(fit.model.replace(K=fit.values["K"] * s), run)[0].outputs["omega"] for s in (1.001, 0.999)]
    finite = (moved[0] - moved[1]) / 0.002 * 0.01
    at = np.searchsorted(run.t, t)
    assert np.max(np.abs(drawn - finite[at])) < 0.05 * np.max(np.abs(finite))  # where it stops, steps differ


def test_binned_means_follow_the_curve(rng):
    x = rng.uniform(-1, 1, 5000)
    b = binned("omega", x, x**3 + rng.normal(0, 0.1, 5000))
    assert np.mean(np.abs(b.mean - b.centre**3) < b.high - b.low) > 0.9


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda d: plots.plot_fit(3), "plot_fit takes a fit"),
        (lambda d: plots.plot_missing(d.before), "plot_missing takes a diagnosis"),
        (lambda d: plots.plot_ladder(d.before), "plot_ladder takes"),
        (lambda d: plots.plot_ranking([]), "plot_ranking takes"),
        (lambda d: plots.plot_parameters(), "at least one fit"),
        (lambda d: plots.plot_parameters(3), "plot_parameters takes"),
        (lambda d: plots.plot_runs([]), "at least one run"),
        (lambda d: plots.plot_residuals(d.before, ["omega", "speed"]), "unknown channel 'speed'"),
        (lambda d: plots.plot_sensitivities(d.before, names=["tau_c"]), "unknown estimated parameter"),
        (lambda d: plots.plot_sensitivities(d.before, run=7), "numbered from 0"),
        (lambda d: plots.plot_profile(d.before), "plot_profile takes"),
        (lambda d: plots.plot_singular_values(d.before), "plot_singular_values takes"),
        (lambda d: plots.plot_formulations(d.before), "plot_formulations takes"),
        (lambda d: plots.plot_waterfall(d.before), "plot_waterfall takes"),
        (lambda d: plots.plot_current_limit(d.before), "no CurrentLimit"),
        (lambda d: plots.plot_current_limit(), "plot_current_limit takes fits"),
        (lambda d: plots.plot_current_limit(d.before, mi.fit(mi.dc_motor(), d.before.problem.experiments[0]), limit=1),
         "fits of the same runs"),
        (lambda d: plots.plot_current_limit(d.before, d.after, limit=1.0, labels=["one"]), "one label per fit"),
    ],
)
def test_a_wrong_argument_is_told_what_to_pass(found, call, words):
    with pytest.raises(UsageError, match=words):
        call(found)


def test_a_figure_for_a_page_has_its_own_names_follows_the_colours_and_opens_no_window(found):
    svg = svg_of(plots.plot_ladder, found, name="ladder", alt="errors <fall>")
    assert plt.get_fignums() == []
    assert svg.startswith('<svg viewBox="')
    assert 'aria-label="errors &lt;fall&gt;"' in svg
    assert "var(--blue)" in svg
    assert "#0072b2" not in svg
    assert 'id="ladder-' in svg
    assert all(part.startswith("ladder-") for part in svg.split('id="')[1:])
    assert "plain motor" in svg


def test_numbers_in_words_are_not_shortened_with_the_coordinates(found):
    svg = svg_of(plots.plot_parameters, found.before, found.after, names=["K"], name="k", alt="K")
    assert re.search(r">0\.04\d+<", svg)
    assert not re.search(r'd="[^"]*\d\.\d{3}', svg)


def test_detached_figures_need_no_closing(found):
    with detached():
        plots.plot_ladder(found)
    assert plt.get_fignums() == []


@pytest.mark.parametrize(("effect", "folder", "axis"), [("coulomb", "hidden_friction", "speed"),
                                                        ("cogging", "hidden_cogging", "phase of 12 periods")])
def test_what_was_added_lies_on_what_was_missing(effect, folder, axis):
    """Over the phase of the effect, so that nothing is aliased; the shift of the parameters is part of the line."""
    runs = mi.read_runs(mi.data_path(folder) / "run1.csv")
    ax = plots.plot_answer(mi.diagnose(mi.fit(mi.dc_motor(), runs), effects=[effect]))
    assert axis in ax.get_xlabel()
    missing, added = ax.get_lines()[1:3]
    assert effect in added.get_label()
    assert np.corrcoef(missing.get_ydata(), added.get_ydata())[0, 1] > 0.95
    assert np.std(added.get_ydata()) == pytest.approx(np.std(missing.get_ydata()), rel=0.4)


def test_a_curve_where_nothing_is_named_lies_on_what_was_missing():
    runs = mi.read_runs(mi.data_path("hidden_friction") / "run1.csv")
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs), effects=[])
    assert (found.verdict, found.effects) == ("unexplained", ())
    ax = plots.plot_answer(found)
    assert "speed" in ax.get_xlabel()
    missing, added = ax.get_lines()[1:3]
    assert " ".join(added.get_label().split()) == f"{found.remainder.follows}, with the shift of the parameters"
    assert np.corrcoef(missing.get_ydata(), added.get_ydata())[0, 1] > 0.95
    assert np.std(added.get_ydata()) == pytest.approx(np.std(missing.get_ydata()), rel=0.4)


def test_what_a_driver_lacks_is_drawn_over_its_command():
    """Of a speed alone: over the angle, which passes through each turn, any course was a curve."""
    t, runs, rng = np.arange(0, 8, 5e-3), [], np.random.default_rng(0)
    for v in (np.repeat([2, 5, 8, 11, 14, 17, 20, 6.0], 200), 2.5 * t):
        omega, y = 0.0, []
        for volts in np.minimum(v, 12.0):
            y.append(omega)
            omega += 5e-3 * (20 * max(volts - 0.7, 0.0) - omega) / 0.1
        runs.append(mi.Experiment(t, {"v": v}, {"omega": np.array(y) + rng.normal(0, 1.0, len(t))}))
    ax = plots.plot_answer(mi.diagnose(mi.fit(mi.dc_motor(), runs), effects=["driver_voltage_limit"]))
    assert ax.get_xlabel() == "voltage v (V)"


def test_dots_over_a_turn_are_of_all_turns():
    """The means over an angle are taken within a turn; dots were drawn of the first turn only."""
    theta, missing = np.linspace(0, 8 * np.pi, 400), np.sin(np.linspace(0, 8 * np.pi, 400))
    ax = plt.figure().add_subplot()
    plots_of_diagnosis._binned(ax, binned("theta", np.mod(theta, 2 * np.pi), missing), [{"theta": theta}], [missing],
                               1.0, "k")
    (dots,) = [line for line in ax.lines if line.get_linestyle() == "None"]
    assert len(dots.get_xdata()) == np.count_nonzero(np.isfinite(dots.get_ydata())) > 300
    plt.close(ax.figure)


@pytest.mark.parametrize("n", [8, 200])
def test_residuals_of_few_samples_are_drawn(n):
    t = np.arange(n) * 1e-3
    run = mi.Experiment(t, {"v": np.ones(n)}, {"i": 0 * t, "omega": 0 * t})
    motor = mi.dc_motor(R=1.0, L=1e-3, K=0.05, b=1e-5, J=1e-5)
    run = run.with_(outputs={c: y + 1e-3 * np.random.default_rng(0).normal(size=n)
                             for c, y in mi.simulate(motor, run, initial="rest")[0].outputs.items()})
    sparse = np.where(np.arange(n) % 100 == 5, run.outputs["omega"], np.nan) if n > 8 else run.outputs["omega"]
    fit = mi.fit(motor, run.with_(outputs={**run.outputs, "omega": sparse}))
    assert plots.plot_residuals(fit) is not None
