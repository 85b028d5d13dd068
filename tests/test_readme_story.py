"""What the README shows is what happens: its code runs, its output is real, its tables are complete."""

import contextlib
import io
import re
from pathlib import Path

import pytest
from readme_table import library_table

import motorid as mi

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
pytestmark = pytest.mark.skipif(not README.is_file(), reason="an installed package has no README")


@pytest.fixture(scope="module")
def text():
    return README.read_text(encoding="utf-8")


def blocks(text, language):
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.S | re.M)


def numbers(text):
    return [float(x.replace("−", "-")) for x in re.findall(r"(?<![\w.⁻])[−-]?\d+(?:\.\d+)?", text)]


@pytest.mark.slow
def test_the_story_runs_and_prints_what_the_readme_shows(text):
    story, shown = blocks(text, "python")[0], blocks(text, "text")[0]
    assert len([line for line in story.splitlines() if line and not line.startswith(("import", "print"))]) <= 10
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        exec(compile(story, "README.md", "exec"), {})
    printed, shown = (" ".join(x.split()) for x in (said.getvalue(), shown))  # the README is wrapped
    assert re.sub(r"[\d.]+", "#", printed) == re.sub(r"[\d.]+", "#", shown), printed
    assert numbers(printed) == pytest.approx(numbers(shown), rel=0.05), printed


def test_the_effect_of_the_readme_is_one(text):
    names = {}
    exec(compile(blocks(text, "python")[1], "README.md", "exec"), names)
    assert names["model"].effect_names == ("magnet_brake",)
    assert "magnet_brake" in repr(names["magnet_brake"])


def test_the_table_of_effects_is_made_from_the_library(text):
    """If not: python tests/readme_table.py."""
    assert library_table() in text
    assert library_table().count("\n") == len(mi.effects.LIBRARY) + 2
    assert f"The library has the {len(mi.effects.LIBRARY)} effects above" in text


def test_links_lead_somewhere(text):
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        assert target.startswith("http") or (ROOT / target).exists(), target


def test_every_function_named_in_the_readme_exists(text):
    for name in set(re.findall(r"\bmi\.(\w+)", text)):
        assert hasattr(mi, name), name
