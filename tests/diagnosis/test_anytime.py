"""A diagnosis answers at any time: at once, when its budget is spent, when it is interrupted."""

from __future__ import annotations

import json
import re
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hand_made import adequacy
from typer.testing import CliRunner

import motorid as mi
from motorid.cli.app import app
from motorid.diagnosis import candidates, refit, stepwise
from motorid.diagnosis import diagnose as diagnosing
from motorid.diagnosis.locate import locate
from motorid.diagnosis.misspecification import Grade
from motorid.errors import OutOfTime
from motorid.numerics.parallel import budget, check_time
from motorid.records.datasets import data_path

RUNS, CHECK = (str(data_path("hidden_friction") / name) for name in ("run1.csv", "check1.csv"))


@pytest.fixture(scope="module")
def plain():
    return mi.fit(mi.dc_motor(), mi.read_runs(RUNS))


def interrupted_at(monkeypatch, count: int) -> None:
    """Press Ctrl-C while the `count`-th refit is finished."""
    finish, left = refit._finish, [count]

    def pressed(task):
        left[0] -= 1
        if not left[0]:
            raise KeyboardInterrupt
        return finish(task)

    monkeypatch.setattr(refit, "_finish", pressed)


def test_the_first_answer_comes_before_any_refit(plain, monkeypatch):
    words = []

    def told(*tasks, **more):
        words.append("refits")
        return refit.refits(*tasks, **more)

    monkeypatch.setattr(candidates, "refits", told)
    mi.diagnose(plain, max_effects=1, progress=words.append)
    first = next(w for w in words if w.startswith("first answer"))
    assert words.index(first) < words.index("refits")
    assert "Fits poorly" in first
    assert re.search(r"Most promising, by the share.*: \w+ \(\d+ %\)", first)


def test_a_spent_budget_gives_the_ranking_and_says_what_was_not_done(plain):
    found = mi.diagnose(plain, budget=0)
    assert found.stopped == "the time is up"
    assert found.verdict == "unexplained"
    assert "not all effects were tried" in found.text
    assert "Stopped early: the time is up" in found.text
    assert len(found.ranking) > 20
    assert found.ranking[0].predicted_drop > 0.5
    assert json.loads(json.dumps(found.to_dict()))["stopped"] == "the time is up"


def test_a_budget_that_is_enough_changes_nothing(plain):
    free, bounded = mi.diagnose(plain, max_effects=1), mi.diagnose(plain, max_effects=1, budget=600)
    assert bounded.stopped == free.stopped == ""
    assert bounded.text == free.text


def test_what_was_refitted_before_an_interruption_is_the_answer(plain, monkeypatch):
    interrupted_at(monkeypatch, 2)
    found = mi.diagnose(plain)
    assert found.stopped == "interrupted"
    assert len(found.ladder.rungs) == 2  # the most promising effect was finished first
    assert found.ladder.rungs[1].gain > 0
    assert "Stopped early: interrupted" in found.text
    assert any(c.reason == "interrupted" for c in found.ranking)


def test_the_command_line_keeps_what_there_is_and_says_130(monkeypatch, tmp_path):
    interrupted_at(monkeypatch, 2)
    out = tmp_path / "found.json"
    done = CliRunner().invoke(app, ["diagnose", RUNS, "--validate", CHECK, "--json", str(out)])
    assert done.exit_code == 130
    assert "First answer: Fits poorly" in done.output
    assert json.loads(out.read_text())["stopped"] == "interrupted"


def test_a_budget_ends_with_its_block_and_an_inner_one_is_no_longer():
    with budget(0), budget(600):
        time.sleep(1e-3)
        with pytest.raises(OutOfTime):
            check_time()
    check_time()
    with budget(600), budget(None):
        check_time()


def test_a_chosen_effect_is_not_lost_where_the_time_is_up_before_it_is_fitted_on(plain, monkeypatch):
    def late(search, node):
        raise OutOfTime

    monkeypatch.setattr(candidates.Search, "brought_to_its_end", late)
    found = mi.diagnose(plain, effects=["coulomb", "cogging"])
    assert found.effects == ("coulomb",)
    assert found.stopped


def test_what_was_found_is_kept_where_the_look_at_what_remains_is_interrupted(plain, monkeypatch):
    graded, left = stepwise.grades_of, [1]

    def pressed(*given):
        if left.pop():
            left.append(0)
            raise KeyboardInterrupt
        return graded(*given)

    monkeypatch.setattr(stepwise, "grades_of", pressed)
    found = mi.diagnose(plain, effects=["coulomb"])
    assert (found.effects, found.stopped) == (("coulomb",), refit.INTERRUPTED)


@pytest.mark.parametrize("error", [KeyboardInterrupt, OutOfTime])
@pytest.mark.parametrize("look", ["_asking_for_all", "_in_windows", "_late_reading", "_seen_on_whole",
                                  "_beside_curves"])
def test_what_was_found_is_kept_where_a_look_after_the_search_is_interrupted(plain, monkeypatch, look, error):
    asked = []

    def pressed(*given):
        asked.append(given)
        raise error

    monkeypatch.setattr(stepwise, look, pressed)
    found = mi.diagnose(plain, effects=["coulomb"])
    assert len(asked) == 1  # and nothing new begins
    assert (found.verdict, found.effects) == ("missing", ("coulomb",))
    assert found.stopped == (refit.INTERRUPTED if error is KeyboardInterrupt else refit.OUT_OF_TIME)
    assert "Stopped early" in found.text


def test_a_look_after_the_search_has_the_time_that_is_left(plain, monkeypatch):
    """An hour passes in it; the clock is moved, so that no slow machine decides."""
    now = time.monotonic

    def slow(found):
        with monkeypatch.context() as later:
            later.setattr(time, "monotonic", lambda: now() + 3600)
            check_time()

    monkeypatch.setattr(stepwise, "_in_windows", slow)
    found = mi.diagnose(plain, effects=["coulomb"], budget=1800.0)
    assert (found.effects, found.stopped) == (("coulomb",), refit.OUT_OF_TIME)
    assert mi.diagnose(plain, effects=["coulomb"], budget=7200.0).stopped == ""


def test_a_second_climb_that_is_cut_short_does_not_lose_the_first(plain, monkeypatch):
    """A pendulum is climbed again in windows; whoever stops that at its start still gets what was found."""
    climbs, climb = [], stepwise.climb

    def cut(search, max_effects, seconds=None, early=False):
        climbs.append(search)
        if len(climbs) > 1:
            seconds = 0.0
        return climb(search, max_effects, seconds, early)

    monkeypatch.setattr(stepwise, "climb", cut)
    monkeypatch.setattr(stepwise, "_in_windows", lambda found: found.path[0].fit)
    words = []
    found = mi.diagnose(plain, effects=["coulomb"], progress=words.append)
    assert len(climbs) == 2
    assert sum(w.startswith("first answer") for w in words) == 1, "the second climb gave another one"
    assert found.effects == ("coulomb",)
    assert found.stopped == refit.OUT_OF_TIME


def test_what_comes_in_the_place_of_two_leaves_room_for_another(monkeypatch):
    """The limit counts effects, not rounds: friction over a turn took the place of friction and of a sensor's offset,
    which was never looked for again."""
    keys = iter(map(frozenset, ("a", "ab", "cd", "cde", "cdef")))

    def node(key=frozenset()):
        return SimpleNamespace(key=key, added=max(key, default=None), fit=None, parent=None)

    stages = SimpleNamespace(round=lambda k: None, done=lambda words: None)
    search = SimpleNamespace(root=node(), stages=stages, effects=(), nodes={}, brought_to_its_end=lambda new: new,
                             expand=lambda best: ([node(next(keys))], []), stopped="",
                             pruned=lambda new, best: new, scores=lambda new: [], led_out=lambda best, new: best,
                             exchanged=lambda new, best: new)
    for name, instead in {"at_noise": lambda best: False, "far": lambda fit: [],
                          "_better": lambda some, best: (next(iter(some)), list(some)), "group_of": lambda *_: (),
                          "judge_adequacy": lambda *_: SimpleNamespace(adequate=False),
                          "_with": lambda found, best, *_: replace(found, path=(*found.path, best))}.items():
        monkeypatch.setattr(stepwise, name, instead)
    begun = stepwise.Climb(search, (search.root,), (), (), "", None, SimpleNamespace(adequate=False))
    *_, last = stepwise._rounds(begun, 3)
    assert last.path[-1].key == frozenset("cde")
    assert last.text == "stopped at the limit of 3 effects"


def test_a_model_that_was_led_out_of_a_valley_is_the_one_to_go_on_from(monkeypatch):
    """What only led it out is not taken, and its round does not count; where it leaves noise the loop is done."""
    def node(key=frozenset(), parent=None):
        return SimpleNamespace(key=key, added=max(key, default=None), fit=None, parent=parent)

    root, expanded = node(), []
    stuck = node(frozenset("a"), root)
    out = node(frozenset("a"), root)

    def expand(best):
        expanded.append(best)
        return [stuck if best is root else node(best.key | {"b"}, best)], []

    search = SimpleNamespace(
        root=root, stages=SimpleNamespace(round=lambda k: None, done=lambda words: None), effects=(), nodes={},
        brought_to_its_end=lambda new: new, expand=expand, stopped="", pruned=lambda new, best: new,
        scores=lambda new: [], led_out=lambda best, new: out if best is stuck else best,
        exchanged=lambda new, best: new)
    for name, instead in {"at_noise": lambda best: best is out, "far": lambda fit: [],
                          "_better": lambda some, best: (next(iter(some)), list(some)), "group_of": lambda *_: (),
                          "judge_adequacy": lambda best, *_: SimpleNamespace(adequate=best is out)}.items():
        monkeypatch.setattr(stepwise, name, instead)
    begun = stepwise.Climb(search, (root,), (), (), "", None, SimpleNamespace(adequate=False))
    *_, last = stepwise._rounds(begun, 3)
    assert expanded == [root, stuck]
    assert last.path == (root, out)
    assert len(last.rounds) == 1
    assert last.text == "stopped: what remains is noise"


@pytest.mark.parametrize("noise", [True, False])
def test_curves_are_asked_where_held_out_runs_hold_more_than_noise(monkeypatch, noise):
    """A battery that polarises was fitted to its noise by three effects, and missed by three times that elsewhere."""
    asked = []
    monkeypatch.setattr(stepwise, "at_noise", lambda best: noise)
    monkeypatch.setattr(stepwise, "beside_leaving_noise", lambda *_: asked.append(best))
    monkeypatch.setattr(stepwise, "alone_predicting_more", lambda *_: None)
    monkeypatch.setattr(stepwise, "differs", lambda *_: 0.2)
    search = SimpleNamespace(root=SimpleNamespace(fit=None, key=()), held=None)
    best = SimpleNamespace(fit=SimpleNamespace(model=mi.dc_motor() + mi.effects.winding_heating, nrmse={"i": 0.02}),
                           predictions=SimpleNamespace(held_out={}))
    found = stepwise.Climb(search, (best,), (), (), "", None, SimpleNamespace(adequate=True),
                           (SimpleNamespace(form=None),), (Grade("winding_heating", "named"),))
    assert stepwise._beside_curves(found).grades == found.grades
    assert bool(asked) is not noise


def test_what_a_finished_search_says_takes_no_part_of_the_time_for_a_curve(plain, monkeypatch):
    asked = []
    monkeypatch.setattr(diagnosing, "time", SimpleNamespace(monotonic=lambda: 0.0))
    monkeypatch.setattr(diagnosing, "CURVE", 0.0)
    monkeypatch.setattr(diagnosing, "locate", lambda fit: (asked.append(check_time()), locate(fit))[1])
    assert mi.diagnose(plain, effects=("coulomb",)).verdict
    assert asked == [None]


def test_a_curve_in_the_place_of_all_is_tried_whatever_error_is_left(monkeypatch):
    """Of a lever that the plain motor loses stops left 7 %, 90 times the noise, and a spring that hardens none."""
    curve = SimpleNamespace(smaller=False, form=SimpleNamespace(text="a load that changes with the angle"))
    monkeypatch.setattr(stepwise, "alone_predicting_more", lambda *_: curve)
    best = SimpleNamespace(key={"end_stop"}, fit=SimpleNamespace(nrmse={"theta": 0.02}))
    found = stepwise.Climb(SimpleNamespace(root=SimpleNamespace(fit=None), held=None), (best,), (), (), "", None,
                           adequacy(False), grades=(Grade("end_stop", "named"),))
    (grade,) = stepwise._beside_curves(found).grades
    assert (grade.grade, grade.form) == ("approximates", curve.form)


def test_what_was_found_before_a_voltage_was_read_as_earlier_outlives_the_end_of_the_time(monkeypatch):
    """The logged voltage is a sample late, beside dry friction; the time is up when all is climbed again."""
    motor = mi.dc_motor(R=1.0, L=2e-3, K=0.05, b=1e-4, J=1e-4) + mi.effects.coulomb(tau_c=0.1)
    motor, t, runs = motor + mi.effects.quadratic_drag(c_2=2e-5), np.arange(800) * 5e-3, []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        v = np.repeat(rng.uniform(-8, 8, 20), 40)
        blank = mi.Experiment(t, {"v": v}, {"i": v, "omega": v})
        omega = mi.simulate(motor, blank, initial="rest")[0].outputs["omega"] + rng.normal(0, 0.3, 800)
        runs.append(mi.Experiment(t, {"v": np.concatenate([[0.0], v[:-1]])}, {"omega": omega}))
    climb, climbs = stepwise.climb, []

    def cut(search, max_effects, seconds=None, early=False):
        climbs.append(climb(search, max_effects, 0.0 if climbs else seconds, early))
        return climbs[-1]

    monkeypatch.setattr(stepwise, "climb", cut)
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs[:2]), runs[2:], effects=("coulomb", "quadratic_drag"))
    assert climbs[0].misread is not None
    assert "coulomb" in climbs[0].path[-1].key
    assert len(climbs) == 2
    assert "coulomb" in {rung.added for rung in found.ladder.rungs if rung.grade}
    assert found.stopped == refit.OUT_OF_TIME


def interrupted_after_the_first_of(monkeypatch, number: int) -> list[list[str]]:
    """Press Ctrl-C when the first refit of the list of this number is done; return the lists that are asked for."""
    asked, refits = list[list[str]](), refit.refits

    def pressed(tasks, map_):
        if not tasks:
            return []
        asked.append([task.name for task in tasks])
        if len(asked) != number:
            return refits(tasks, map_)
        return [*refits(tasks[:1], map_), *(refit.GivenUp(refit.INTERRUPTED) for _ in tasks[1:])]

    monkeypatch.setattr(candidates, "refits", pressed)
    return asked


def test_after_an_interruption_no_simpler_kin_is_tried(plain, monkeypatch):
    effects = candidates.library(("stribeck", "coulomb", "brush_drop"))
    search = candidates.Search(plain, None, effects, candidates.Stages())
    short = [s for s in search.scores(search.root) if s.effect.name != "coulomb"]
    monkeypatch.setattr(search, "_shortlist", lambda node: short)
    monkeypatch.setattr(candidates, "objections", lambda *fits: "refused")
    asked = interrupted_after_the_first_of(monkeypatch, 1)
    children, listed = search.expand(search.root)
    assert [c.added for c in children] == ["stribeck"]
    assert "interrupted" in {c.reason for c in listed}
    assert asked == [["stribeck", "brush_drop"]]


def test_a_diagnosis_interrupted_among_its_pairs_ends_there(plain, monkeypatch):
    expand = candidates.Search.expand
    monkeypatch.setattr(candidates.Search, "expand", lambda search, node: ([], expand(search, node)[1]))
    asked = interrupted_after_the_first_of(monkeypatch, 2)
    found = mi.diagnose(plain, effects=["coulomb", "quadratic_drag", "cogging", "brush_drop"])
    assert found.stopped == refit.INTERRUPTED
    assert len(asked) == 2
    assert len(found.after.model.effects) in (0, 2)


def test_a_search_that_was_stopped_at_once_says_what_to_try_first(monkeypatch):
    """Not a curve over an angle that was not even measured, for which it took longer than the search itself."""
    fit, asked = mi.fit(mi.dc_motor(), mi.read_runs(data_path("hidden_friction/run1.csv"))), []
    monkeypatch.setattr(stepwise, "better_forms", lambda *fits: asked.append(fits) or [])
    found = mi.diagnose(fit, effects=("coulomb", "brush_drop"), budget=0)
    assert found.stopped
    assert found.answer.startswith("Unexplained so far: something is missing; not all effects were tried.")
    assert "Most promising, by the share of the squared error that they would remove: coulomb (" in found.answer
    assert not asked
