"""Every public function has an example in its docstring, and it runs as it stands there."""

from __future__ import annotations

import doctest
import importlib
import inspect
import pkgutil
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

import motorid as mi

FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
PUBLIC = [n for n in dir(mi) if not inspect.ismodule(o := getattr(mi, n))
          and not (inspect.isclass(o) and issubclass(o, Exception))]  # fmt: skip


def inner_examples() -> list[doctest.DocTest]:
    """Those of functions that are not public, which know what their module knows."""
    finder, known = doctest.DocTestFinder(exclude_empty=True), {
        inspect.unwrap(getattr(mi, n)).__module__ + "." + n for n in PUBLIC}
    names = [m.name for m in pkgutil.walk_packages(mi.__path__, "motorid.") if not m.name.endswith("__main__")]
    return [t for name in names for t in finder.find(importlib.import_module(name)) if t.examples and
            t.name not in known]


@pytest.fixture(scope="module")
def shared():
    """What the examples take for granted: the names that the docstring of the package introduces."""
    names = {"mi": mi, "np": np}
    for example in doctest.DocTestParser().get_examples(mi.__doc__ or ""):
        exec(example.source, names)
    return names


def run(test: doctest.DocTest) -> None:
    said: list[str] = []
    failed = doctest.DocTestRunner(optionflags=FLAGS).run(test, out=said.append).failed
    plt.close("all")
    assert not failed, "".join(said)


@pytest.mark.parametrize("name", PUBLIC)
def test_the_example_of_a_public_name_runs(name, shared, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("bench").mkdir()
    tests = doctest.DocTestFinder(recurse=False).find(inspect.unwrap(getattr(mi, name)), name, globs=dict(shared))
    assert [t for t in tests if t.examples], f"mi.{name} has no example"
    for test in tests:
        run(test)


@pytest.mark.parametrize("test", inner_examples(), ids=lambda t: t.name)
def test_the_example_of_an_inner_name_runs(test):
    run(test)
