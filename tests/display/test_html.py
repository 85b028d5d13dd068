"""Display in notebooks: what is shown is in golden files, nothing is computed to show it.

After a wanted change: ``MOTORID_UPDATE_GOLDEN=1 pytest tests/display/test_html.py``, then look at the difference.
"""

import os
from pathlib import Path
from types import SimpleNamespace

import hand_made
import html5lib
import numpy as np
import pytest

import motorid as mi
from motorid.acquire import Recording
from motorid.diagnosis.experiment_design import Suggestion
from motorid.diagnosis.results import Candidate, Diagnosis, Ladder, Missing, ranking_table
from motorid.display.cards import COLOURS, Flag, Table
from motorid.estimation.covariance import Quantity
from motorid.estimation.result import Comparison, Failure, Fit
from motorid.estimation.shooting.formulations import Formulations
from motorid.problem.problem import Problem
from motorid.problem.simulate import Evaluation
from motorid.uncertainty.bootstrap import Bootstrap
from motorid.uncertainty.covariance import Covariance
from motorid.uncertainty.identifiability import Identifiability
from motorid.uncertainty.multistart import Multistart
from motorid.uncertainty.profile import Intervals, Profile

GOLDEN = Path(__file__).parent / "golden"


def fake_fit():
    """What a card reads of a fit, with numbers chosen here: the golden file depends on nothing else."""
    model = (mi.dc_motor() + mi.effects.coulomb).start_at(
        {"R": 1.38012, "L": 1.72e-3, "K": 0.0462, "b": 6.5e-5, "J": 2.35e-5, "tau_c": 8.01e-3}
    )
    std = {"R": 0.0041, "L": None, "K": 1.2e-5, "b": 3e-7, "J": 0.0, "tau_c": 6e-6, "sgn_width": 0.0}
    run = SimpleNamespace(units={"v": "V", "i": "A", "omega": "rad/s"}, inputs={}, outputs={}, meta={}, name="run1")
    nrmse, rmse = {"i": 0.0168, "omega": 0.00815}, {"i": 0.0042, "omega": 0.149}
    limit = SimpleNamespace(name="CurrentLimit(8 A)", label="2 rows at the limit", value=31.4, unit="A", active=2)
    return SimpleNamespace(
        model=model.fix("J"), values=model.values, std=std, status="stalled", message="no step is better.",
        formulation="hard", extra={"multipliers": (limit,)},
        problem=SimpleNamespace(experiments=(run, run), n_outputs=7640, penalties=(), constraints=()), iterations=12,
        at_bound=set(),
        seconds=0.231, nrmse=nrmse, rmse=rmse, noise={"i": 0.004, "omega": 0.15},
        evaluation=SimpleNamespace(simulations=[SimpleNamespace(experiment=run)], nrmse=nrmse, rmse=rmse),
        fits="noise", verdict="Fits: errors at the level of the noise (NRMSE current 1.68 %, speed 0.815 %).",
        per_run={}, determined={"gain": Quantity(20.77, 0.005, "rad/s per V", "speed per voltage, steady")},
    )  # fmt: skip


def fake_ladder():
    plain, better = fake_fit(), fake_fit()
    plain.model = mi.dc_motor(R=1.4)
    plain.values = plain.model.values
    rungs = (
        SimpleNamespace(added=None, fit=plain, nrmse={"i": 0.273, "omega": 0.112}, removed=(),
                        validation_nrmse={"i": 0.211, "omega": 0.127}),
        SimpleNamespace(added="coulomb", fit=better, nrmse={"i": 0.0168, "omega": 0.00815}, removed=(),
                        validation_nrmse={"i": 0.0138, "omega": 0.0102}),
    )  # fmt: skip
    return SimpleNamespace(rungs=rungs, text="Stopped: nothing is left but noise.")


def fake_diagnosis():
    ladder = fake_ladder()
    return Diagnosis(
        "missing", "", "mechanical", ("coulomb",), None, None, hand_made.candidates(), ladder,
        (("coulomb", "stribeck"),), "Reverse slowly.", ladder.rungs[0].fit, ladder.rungs[1].fit, None,
        answer="Missing: dry (Coulomb) friction. What remains is noise.", details=("The voltage was measured late.",),
    )  # fmt: skip


def experiment():
    t = np.arange(10) * 1e-3
    i = np.where(np.arange(10) == 3, np.nan, 0.5)
    return mi.Experiment(t, {"v": np.ones(10)}, {"i": i, "omega": t}, name="run1", meta={"notes": ["rpm <converted>."]})


CARDS = {
    "experiment": lambda: experiment().card(),
    "model": lambda: (mi.dc_motor(R=1.3).fix("L") + mi.effects.cogging(N=12)).card(),
    "effect": lambda: mi.effects.stribeck.card(),
    "fit": lambda: Fit.card(fake_fit()),
    "failure": lambda: Failure({"R": 1.0, "L": 1e-3}, "failed", "The integration stopped at 0.2 s.").card(),
    "evaluation": lambda: Evaluation.card(SimpleNamespace(
        simulations=(SimpleNamespace(experiment=experiment()),), nrmse={"i": 0.0138, "omega": 0.0102},
        rmse={"i": 0.0042, "omega": 0.154}, by_run=({"i": 0.0138, "omega": 0.0102},))),
    "adequacy": lambda: hand_made.adequacy(False).card(),
    "missing": lambda: Missing.card(SimpleNamespace(
        where="mechanical", text="The torque balance fails.", shares={"electrical": 0.04, "mechanical": 0.95},
        regions={"steady": 0.6}, bins={"torque": (SimpleNamespace(against="omega", explained=0.93),)})),
    "ladder": lambda: Ladder.card(fake_ladder()),
    "diagnosis": lambda: fake_diagnosis().card(),
    "recording": lambda: Recording(
        Path("run1.csv"), None, "unplugged", "", 990, 10, False, 1.0, {}, {"i": 3}).card(),
    "covariance": lambda: Covariance.card(trusted()[0]),
    "bootstrap": lambda: Bootstrap.card(trusted()[1]),
    "profile": lambda: Profile.card(trusted()[2]),
    "intervals": lambda: Intervals.card(trusted()[3]),
    "identifiability": lambda: Identifiability.card(identifiability()),
    "multistart": lambda: Multistart.card(multistart()),
    "comparison": lambda: Comparison.card(comparison()),
    "formulations": lambda: Formulations.card(formulations()),
    "suggestion": lambda: Suggestion.card(SimpleNamespace(
        name="reversals", text="Reverse the voltage every 0.2 s.", discrimination={"chirp": 3.0, "reversals": 41.2})),
}  # fmt: skip


def trusted():
    """What says how far to trust a fit, as cards read it."""
    reach = {"R": (1.372, 1.388), "b": None}
    covariance = SimpleNamespace(
        names=("R", "b"), values=(1.38, 6.5e-5), units=("Ω", "N·m·s/rad"), std={"R": 0.004, "b": None},
        status={"R": "determined", "b": "at its lower limit"}, interval=lambda n, level=0.95: reach[n],
        correlation=[[1.0, -0.97], [-0.97, 1.0]], method="coloured",
        colours={"i": SimpleNamespace(effective_share=0.87)},
    )  # fmt: skip
    bootstrap = SimpleNamespace(
        kind="blocks", names=("R", "b"), reference=(1.38, 6.5e-5), units=("Ω", "N·m·s/rad"), samples=[0] * 100,
        std={"R": 0.0041, "b": None}, status={"R": "determined", "b": "not determined"}, interrupted="",
        interval=lambda n, level=0.95: reach[n], limited={"R": 0.0, "b": 0.12}, failures=(Failure({}, "failed", ""),),
    )  # fmt: skip
    profile = Profile("R", "Ω", 1.38, np.array([1.37, 1.38, 1.39]), np.array([9.0, 0.0, -2.0]), {}, 100, True)
    intervals = SimpleNamespace(level=0.95, covariance=covariance, bootstrap=bootstrap, profiles={"R": profile})
    return covariance, bootstrap, profile, intervals


def identifiability():
    return SimpleNamespace(
        names=("R", "K"), values=(1.38, 0.046), sizes=(1.38, 0.046), units=("Ω", "N·m/A"), rank=1, full=False,
        std={"R": None, "K": 1e-5}, text="These records determine 1 combination.", fitted_std=None,
        singular_values=(830.0, 0.0), condition_number=np.inf, structural_rank=1,
    )  # fmt: skip


def multistart():
    lost = {"reference": 0.046, "mean": None, "std": None}
    statistics = {"R": {"reference": 1.38, "mean": 1.38, "std": 1e-9}, "K": lost}
    words = "8 of 10 starts end in the best fit. Interrupted after 10 of 20 starts."
    return SimpleNamespace(
        good=8, poor=1, failed=1, text=words,
        reference=SimpleNamespace(model=mi.dc_motor()), statistics=lambda: statistics,
    )  # fmt: skip


def comparison():
    plain, better = fake_ladder().rungs[0].fit, fake_fit()
    return SimpleNamespace(fits=(plain, better), validation_nrmse=(plain.nrmse, better.nrmse))


def formulations():
    table = Table(("quantity", "plain", "hard"), (("R", "1.38 Ω", "–"),), note="The limit cannot be kept.")
    columns = [SimpleNamespace(name="plain", fit=1, violations={"CurrentLimit(4 A), A": 0.4}),
               SimpleNamespace(name="hard", fit=None, violations={})]  # fmt: skip
    return SimpleNamespace(table=table, all=columns)


@pytest.mark.parametrize("name", CARDS)
def test_a_card_is_what_its_golden_file_says(name):
    shown = CARDS[name]().to_html() + "\n"
    path = GOLDEN / f"{name}.html"
    if os.environ.get("MOTORID_UPDATE_GOLDEN"):
        path.write_text(shown, encoding="utf-8")
    assert shown == path.read_text(encoding="utf-8")


@pytest.mark.parametrize("name", CARDS)
def test_a_card_is_valid_html_with_named_columns_and_rows(name):
    page = f"<!DOCTYPE html><html><head><title>x</title></head><body>{CARDS[name]().to_html()}</body></html>"
    page = page.replace("<style>", "<style type='text/css'>")
    parser = html5lib.HTMLParser(strict=True, namespaceHTMLElements=False)
    tree = parser.parse(page)
    for table in tree.iter("table"):
        assert all(th.get("scope") == "col" for th in table.find("thead").iter("th"))
        widths = {len(list(row)) for row in table.iter("tr")}
        assert len(widths) == 1
        assert all(row[0].get("scope") == "row" for row in table.find("tbody"))


def test_no_golden_file_is_left_over():
    assert {p.stem for p in GOLDEN.glob("*.html")} == set(CARDS)


def test_text_from_files_cannot_become_markup():
    assert "&lt;converted&gt;" in CARDS["experiment"]().to_html()
    table = Table(["<a>"], [["<b>", Flag("<c>", "good")]], note="<d>")
    assert not {"<a>", "<b>", "<c>", "<d>"} & set(_tags(table.to_html()))


def test_one_table_is_text_in_a_terminal_and_html_on_a_page():
    table = Table(["part", "value", "verdict"], [["R", "1.38 Ω", Flag("good fit", "good")], ["L", "2 H", "–"]],
                  "Parts", "All of them.", left=(0, 2))  # fmt: skip
    assert str(table).splitlines() == [
        "Parts",
        "part   value  verdict",
        "────  ──────  ────────",
        "R     1.38 Ω  good fit",
        "L        2 H  –",
        "All of them.",
    ]
    for words in ("part", "1.38 Ω", ">good fit</span>", "<caption>All of them.</caption>"):
        assert words in table.to_html()


@pytest.mark.parametrize("name", CARDS)
def test_a_card_says_the_same_in_a_terminal_as_on_a_page(name):
    card = CARDS[name]()
    said = " ".join(str(card).split())
    cells = [str(cell) for t in card.tables for row in t.rows for cell in row]
    for words in (card.title, *(f.text for f in card.flags), *card.text, *cells):
        assert " ".join(words.split()) in said


def _tags(html):
    return [f"<{part.split('>')[0]}>" for part in html.split("<")[1:]]


def test_flags_are_told_apart_by_words_and_by_a_colour_of_enough_contrast():
    for ink, paper in COLOURS.values():
        light, dark = sorted((luminance(ink), luminance(paper)), reverse=True)
        assert (light + 0.05) / (dark + 0.05) >= 5.5


def luminance(colour):
    """Relative luminance of WCAG 2.1."""
    parts = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.03928 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
    return float(np.dot(linear, [0.2126, 0.7152, 0.0722]))


def test_what_is_not_determined_or_held_is_said_in_words():
    shown = CARDS["fit"]().to_html()
    assert ">not determined<" in shown
    assert "1 not determined" in shown
    assert "(fixed)" in shown
    assert "why L cannot be determined" in shown
    assert "(chosen from the data)" in shown


def test_every_card_says_what_to_do_next_unless_there_is_nothing_to_do():
    for name in CARDS:
        assert CARDS[name]().after or name == "failure"


def test_plain_text_is_one_line_for_every_result():
    found = hand_made.diagnosis(np.random.default_rng(1))
    results = [
        found,
        found.ladder,
        found.missing,
        found.adequacy,
        found.before,
        experiment(),
        mi.dc_motor(),
        mi.effects.coulomb,
        Failure({}, "failed", "why"),
        mi.evaluate(found.after, hand_made.friction()[1]),
    ]
    for r in results:
        line = repr(r)
        assert "\n" not in line
        assert 8 < len(line) < 160, line
        assert line.startswith("<")


def test_showing_a_result_computes_nothing(monkeypatch):
    found = hand_made.diagnosis(np.random.default_rng(1))
    fit = mi.fit(mi.dc_motor(), hand_made.friction()[0])

    def forbidden(*_args, **_kwargs):
        raise AssertionError("a simulation was made to show a result")

    monkeypatch.setattr(Problem, "simulate", forbidden)
    monkeypatch.setattr(np.linalg, "svd", forbidden)
    for r in (found, found.ladder, found.missing, found.adequacy, found.before, fit):
        assert r._repr_html_().count("<table>") >= 1
        assert repr(r)


def test_a_page_turns_a_wide_table_with_few_rows_and_puts_sentences_below_on_a_phone():
    wide = Table(["model", *"abcdef"], [["DC motor", *"123456"], ["+ coulomb", *"654321"]])
    assert wide.on_page.header == ("model", "DC motor", "+ coulomb")
    assert list(wide.on_page.rows[0]) == ["a", "1", "6"]
    assert Table(["model", *"abcd"], wide.rows).on_page.header == ["model", *"abcd"]
    said = Table(["effect", "fall", "verdict"], [["stribeck", "9 %", "no better than coulomb, which it contains"]])
    assert '<table class="wordy">' in said.to_html()
    assert "wordy" not in wide.to_html()


def test_the_effects_tried_begin_with_the_accepted_one_and_name_its_group():
    helps = "lowers the held-out error by 90 %"
    tried = [Candidate("spring", 0.9, reason=helps), Candidate("gravity", 0.8, reason=helps),
             Candidate("coulomb", 0.7, group=("spring",), accepted=True)]
    rows = ranking_table(tried).rows
    assert [r[0] for r in rows] == ["coulomb", "spring", "gravity"]
    assert [str(r[-1]) for r in rows[1:]] == ["not distinguished from coulomb", f"{helps}; coulomb was taken instead"]
