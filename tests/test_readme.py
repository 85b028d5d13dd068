"""What the README says works: its two commands, its command lines, its Python."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
from itertools import pairwise
from pathlib import Path

import pytest
from command import motorid

from motorid.records.datasets import data_path

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
ONLY_HELP = ("record", "bench", "demo")


def blocks(language: str) -> list[str]:
    """The fenced blocks of one language, in order."""
    return re.findall(rf"^```{language}\n(.*?)^```", README, flags=re.MULTILINE | re.DOTALL)


def commands() -> list[list[str]]:
    """Every ``motorid …`` of the shell blocks, without comments."""
    lines = [line.split("#")[0] for block in blocks("sh") for line in block.replace("\\\n", " ").splitlines()]
    parts = [part.strip() for line in lines for part in line.split("&&")]
    return [shlex.split(p)[1:] for p in parts if p.startswith("motorid ")]


@pytest.fixture(scope="module")
def bench(tmp_path_factory) -> Path:
    """A folder with records under the names that the README uses, in which its lines follow one another."""
    folder = tmp_path_factory.mktemp("readme")
    for name in ("run1", "run2", "check1"):
        shutil.copy(data_path(f"hidden_friction/{name}.csv"), folder / f"{name}.csv")
    for other in ("check", "other"):
        shutil.copy(folder / "check1.csv", folder / f"{other}.csv")
    return folder


def test_the_two_commands_are_there_word_for_word():
    lines = [line for block in blocks("sh") for line in block.splitlines()]
    assert "pip install . && motorid demo" in lines
    assert [line for line in lines if line.startswith("pip install '.[test]' && pytest")]


def test_continuous_integration_runs_the_command_of_the_readme():
    """The script takes the line out of the README; it must find exactly one, and be a script."""
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    pattern = re.search(r"sed -n \"(.+?)\" README\.md", script)
    assert pattern is not None
    found = subprocess.run(["sed", "-n", pattern[1].replace("\\\\", "\\"), "README.md"], cwd=ROOT, text=True,
                           capture_output=True, timeout=60, check=True).stdout.splitlines()
    assert len(found) == 1
    assert found[0] in README
    assert subprocess.run(["bash", "-n", ".ci/run"], cwd=ROOT, timeout=60).returncode == 0
    assert os.access(ROOT / ".ci" / "run", os.X_OK)


def test_there_are_command_lines_to_run():
    assert {words[0] for words in commands()} >= {"demo", "fit", "diagnose"}


@pytest.mark.slow
def test_every_command_line_runs(bench, monkeypatch):
    """In their order, since some use what others wrote; for hardware and the demo (tested by itself) the help."""
    monkeypatch.chdir(bench)
    for words in commands():
        done = motorid(words[0], "--help") if words[0] in ONLY_HELP else motorid(*words)
        assert done.status == 0, (words, done.err)
        for option, path in pairwise(words):
            if option in ("--json", "--report", "--out") and words[0] not in ONLY_HELP:
                assert Path(path).exists(), path


def test_the_python_runs(bench, monkeypatch, capsys):
    monkeypatch.chdir(bench)
    names: dict[str, object] = {}
    assert blocks("python")
    for block in blocks("python"):
        exec(compile(block, "README.md", "exec"), names)
    assert "mi" in names


def test_links_into_the_project_lead_somewhere():
    links = [link for link in re.findall(r"\]\(([^)#\s]+)", README) if "://" not in link]
    assert [link for link in links if not (ROOT / link).exists()] == []
