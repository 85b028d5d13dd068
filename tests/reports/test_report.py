"""The report: one page that stands alone, can be read by anybody, and tells the whole story."""

import dataclasses
import importlib
import os
import re
from html import unescape
from itertools import pairwise
from pathlib import Path

import browser
import hand_made
import html5lib
import numpy as np
import pytest

import motorid as mi
from motorid.errors import UsageError

LIMIT = 2_000_000  # bytes


@pytest.fixture(scope="module")
def found():
    return hand_made.diagnosis(np.random.default_rng(20240611))


@pytest.fixture(scope="module")
def page(found, tmp_path_factory):
    """The report of a whole diagnosis."""
    path = tmp_path_factory.mktemp("report") / "report.html"
    mi.report(found, path, command="motorid diagnose run*.csv <here>", validate=hand_made.friction()[1])
    return path


@pytest.fixture(scope="module")
def text(page):
    return page.read_text(encoding="utf-8")


def test_one_run_to_validate_is_taken_as_a_list_of_it_is(found, tmp_path):
    check = hand_made.friction()[1][0]
    one, several = (mi.report(found, tmp_path / f"{k}.html", validate=v).read_text(encoding="utf-8")
                    for k, v in enumerate((check, [check])))
    assert one.count("<h2") == several.count("<h2")
    assert one.count(check.name) == several.count(check.name) > 0


@pytest.fixture(scope="module")
def tree(text):
    return html5lib.HTMLParser(strict=True, namespaceHTMLElements=False).parse(text)


def local(element):
    return str(element.tag).rsplit("}", 1)[-1]


def every(tree, *names):
    return [e for e in tree.iter() if local(e) in names]


def words(element):
    return " ".join("".join(element.itertext()).split())


def test_it_is_valid_html(tree):
    assert local(tree) == "html"


def test_it_is_small(page):
    assert page.stat().st_size < LIMIT


def test_it_needs_no_network_and_no_script(tree, text):
    assert not every(tree, "script", "iframe", "object", "embed", "link")
    for e in tree.iter():
        for name in ("href", "src", "data", "action", "{http://www.w3.org/1999/xlink}href"):
            target = e.get(name)
            assert target is None or target.startswith(("#", "data:")), target
    assert "@import" not in text
    assert not re.search(r"url\((?!#)", text)


def test_it_tells_the_whole_story(tree, found):
    titles = [words(h) for h in every(tree, "h2")]
    assert titles == [
        "The answer", "How the parameters moved", "The improved model", "Held-out records",
        "The original model", "Where it fails", "Which effect is missing", "The data", "Provenance",
    ]  # fmt: skip
    body = words(every(tree, "body")[0])
    for told in (found.text, found.missing.text, found.suggestion, "no better than",
                 "motorid diagnose run*.csv <here>", "run1.csv", "casadi"):  # fmt: skip
        assert told in body, told
    fingerprint = found.before.problem.experiments[0].meta["sha256"]
    assert fingerprint[:16] in body
    assert len(every(tree, "figure")) == 7


def test_numbers_are_those_of_the_result(tree, found):
    cells = [words(c) for c in every(tree, "td")]
    assert f"{100 * found.after.nrmse['omega']:.3g} %" in cells
    assert f"{100 * found.ladder.rungs[-1].validation_nrmse['i']:.3g} %" in cells
    assert any(c.startswith("(8.01") and c.endswith("N·m") and "±" in c for c in cells)


def test_whoever_cannot_see_the_figures_is_told_what_they_show(tree):
    for figure in every(tree, "figure"):
        svg = next(e for e in figure if local(e) == "svg")
        assert svg.get("role") == "img"
        assert len(svg.get("aria-label")) > 15
        caption = next(e for e in figure if local(e) == "figcaption")
        assert words(caption)


def test_headings_are_in_order_and_the_language_is_named(tree):
    assert tree.get("lang") == "en"
    assert words(every(tree, "title")[0])
    levels = [int(local(h)[1]) for h in tree.iter() if re.fullmatch(r"h[1-6]", local(h))]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(b - a <= 1 for a, b in pairwise(levels))


def test_tables_name_their_columns_and_rows(tree):
    assert len(every(tree, "table")) >= 9
    for table in every(tree, "table"):
        rows = every(table, "tr")
        assert all(c.get("scope") == "col" and words(c) for c in rows[0])
        assert all(r[0].get("scope") == "row" for r in rows[1:])
        assert {len(r) for r in rows} == {len(rows[0])}


def test_links_labels_and_names_resolve(tree):
    names = [e.get("id") for e in tree.iter() if e.get("id")]
    assert len(names) == len(set(names))
    for e in every(tree, "a"):
        assert e.get("href")[1:] in names
    for e in tree.iter():
        if e.get("aria-labelledby"):
            assert e.get("aria-labelledby") in names
        if e.get("role") == "region":
            assert e.get("aria-label")
            assert e.get("tabindex") == "0"  # wide tables can be scrolled with the keyboard
    landmarks = {local(e) for e in tree.iter()}
    assert {"header", "nav", "main", "footer"} <= landmarks


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_colours_have_enough_contrast(text, scheme):
    blocks = re.findall(r":root\{(.*?)\}", text, re.S)
    colours = {}
    for block in blocks if scheme == "dark" else blocks[:1]:
        colours |= dict(re.findall(r"--([\w-]+):(#[0-9a-f]{6})", block))
    reading = [("ink", "page"), ("muted", "page"), ("ink", "card"), ("muted", "card"), ("link", "page")]
    reading += [(f"{mood}-ink", mood) for mood in ("good", "note", "bad", "plain")]
    assert all(contrast(colours[a], colours[b]) >= 4.5 for a, b in reading)
    curves = ("blue", "orange", "green", "purple", "yellow", "grey")
    assert all(contrast(colours[c], colours["page"]) >= 3.0 for c in curves)


def contrast(a, b):
    lights = sorted((luminance(a) + 0.05, luminance(b) + 0.05))
    return lights[1] / lights[0]


def luminance(colour):
    parts = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.03928 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
    return float(np.dot(linear, [0.2126, 0.7152, 0.0722]))


def test_it_follows_the_colours_of_the_reader_and_prints_on_white(text):
    assert "@media screen and (prefers-color-scheme:dark)" in text
    assert "@media print" in text
    assert "#0072b2" not in text.split("</style>", 1)[1]


def test_words_from_outside_cannot_become_markup(tmp_path, found):
    path = mi.report(
        found.before, tmp_path / "x.html", title="<script>alert(1)</script>", command="</pre><b>"
    )
    shown = path.read_text(encoding="utf-8")
    assert "<script" not in shown
    assert "</pre><b>" not in shown
    assert "</pre><b>" in unescape(shown)


@pytest.mark.parametrize("kind", ["fit", "ladder", "adequate", "several", "other"])
def test_every_result_makes_a_valid_page(kind, found, tmp_path):
    rung = found.ladder.rungs[0]
    calm = dataclasses.replace(
        found, verdict="adequate", effects=(), ranking=(), ladder=mi_ladder(found, [rung]),
        after=found.before, groups=(), suggestion=None,
    )  # fmt: skip
    several = [found.before, found.after]
    results = {"fit": found.before, "ladder": found.ladder, "adequate": calm, "several": several}
    result = results.get(kind, found.adequacy)
    path = mi.report(result, tmp_path / "page.html")
    html5lib.HTMLParser(strict=True).parse(path.read_bytes())
    assert path.read_text(encoding="utf-8").count("<h1>") == 1


def mi_ladder(found, rungs):
    return type(found.ladder)(tuple(rungs), "Nothing is missing.")


def test_a_file_that_cannot_be_written_or_nothing_to_tell_is_said_in_words(found, tmp_path):
    with pytest.raises(UsageError, match="cannot write"):
        mi.report(found.before, tmp_path / "no" / "such" / "folder.html")
    with pytest.raises(UsageError, match="needs a result"):
        mi.report([], tmp_path / "x.html")
    with pytest.raises(UsageError, match="got int"):
        mi.report([found.before, 3], tmp_path / "x.html")


@pytest.fixture(scope="module", params=["wide", "dark", "phone"])
def opened(request, page, tmp_path_factory):
    """The page as Chromium shows it."""
    width, dark = {"wide": (1100, False), "dark": (1100, True), "phone": (500, False)}[request.param]
    return browser.visit(page, tmp_path_factory.mktemp("browser"), width=width, dark=dark), request.param


@pytest.mark.slow
def test_chromium_says_nothing_and_asks_the_network_for_nothing(opened):
    seen, _ = opened
    assert seen.console == ()
    assert seen.requests == () or all(u.startswith("file:") for u in seen.requests)
    assert seen.probe["loaded"] == []


@pytest.mark.slow
def test_chromium_draws_every_figure_and_the_page_does_not_run_out_of_the_window(opened):
    seen, kind = opened
    figures = seen.probe["figures"]
    assert len(figures) == 7
    assert all(w > 400 and h > 100 and paths > 10 for w, h, paths in figures)
    assert seen.probe["scroll"] <= seen.probe["view"]
    assert seen.probe["text"] >= 9  # pixels, the smallest words in a figure
    assert seen.probe["dark"] == (kind == "dark")


@pytest.mark.slow
def test_every_word_on_the_page_has_a_contrast_of_four_and_a_half(opened):
    worst = opened[0].probe["worst"]
    assert worst[0][0] >= 4.5, worst


@pytest.mark.slow
def test_a_picture_of_the_page_is_kept(page, tmp_path):
    target = Path(os.environ.get("MOTORID_PICTURES", tmp_path)) / "report.png"
    browser.screenshot(page, target, tmp_path)
    assert target.stat().st_size > 50_000


@pytest.mark.slow
def test_it_prints_on_few_sheets_of_a4(page, tmp_path):
    sheets = browser.printed(page, tmp_path)
    assert len(sheets) in (3, 4, 5)  # nine, where figures and tables leave pages half empty
    assert all((round(w), round(h)) == (210, 297) for w, h in sheets)


@pytest.mark.slow
def test_the_browser_check_itself_sees_errors_and_requests(tmp_path):
    page = tmp_path / "bad.html"
    page.write_text('<!DOCTYPE html><html lang="en"><title>x</title><body><p style="color:#ccc">pale</p>'
                    '<figure><svg></svg></figure><img src="http://motorid.invalid/x.png" alt="">'
                    '<script>console.error("broken")</script></body></html>', encoding="utf-8")  # fmt: skip
    seen = browser.visit(page, tmp_path)
    assert any("broken" in line for line in seen.console)
    assert any("motorid.invalid" in url for url in (*seen.requests, *seen.probe["loaded"]))
    assert seen.probe["worst"][0][0] < 4.5


def test_the_template_is_shipped_with_the_package():
    assert (Path(mi.__file__).parent / "reports" / "templates" / "report.html").is_file()


def test_the_held_out_records_are_fingerprinted_too(tree, text):
    assert "check1 (held out)" in words(every(tree, "body")[0])


def test_a_report_is_refused_under_the_name_of_another_format(found, tmp_path):
    with pytest.raises(UsageError, match=r"must end in \.html"):
        mi.report(found, tmp_path / "found.pdf")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("where", "broken", "left"), [("motorid.reports.report", "evaluate", "The comparison"),
                                                       ("motorid.plots", "plot_fit", "This figure")])
def test_what_cannot_be_made_is_left_out_and_the_page_is_written(found, tmp_path, monkeypatch, where, broken, left):
    def fails(*_args, **_options):
        raise mi.SimulationError("the simulation left the finite numbers at t = 6 s.")

    monkeypatch.setattr(importlib.import_module(where), broken, fails)
    page = mi.report(found, tmp_path / "page.html", validate=hand_made.friction()[1]).read_text(encoding="utf-8")
    html5lib.HTMLParser(strict=True, namespaceHTMLElements=False).parse(page)
    assert f"{left} is left out, because it could not be made: the simulation left the finite numbers" in page
    assert "Held-out records" in page
    assert "What the checks found" in page or "The checks found no problem" in page
