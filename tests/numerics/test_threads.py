"""The package holds its own linear algebra to one thread, in this process and in workers, and gives the rest back."""

from __future__ import annotations

import multiprocessing
import re
import threading
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest
from threadpoolctl import ThreadpoolController

import motorid as mi
from motorid.numerics import parallel
from motorid.numerics.parallel import map_items, one_thread

MANY = 2


def threads_of_blas(*_: object) -> set[int]:
    return {c.num_threads for c in ThreadpoolController().select(user_api="blas").lib_controllers}


@pytest.fixture(autouse=True)
def as_installed():
    """What a user has who set nothing: as many threads as there are processors, here two."""
    with ThreadpoolController().limit(limits=MANY, user_api="blas"):
        if threads_of_blas() != {MANY}:
            pytest.skip("this BLAS has one thread only")
        yield


def test_a_fit_runs_on_one_thread_and_gives_the_others_back():
    run = mi.read_runs(f"{mi.data_path('two_step')}/*.csv")[:1]
    seen = []
    mi.fit(mi.dc_motor(), run, callback=lambda *_: seen.append(threads_of_blas()))
    assert len(seen) > 1
    assert all(s == {1} for s in seen)
    assert threads_of_blas() == {MANY}


def test_an_error_gives_the_threads_back():
    with pytest.raises(mi.UsageError):
        mi.fit(mi.dc_motor(), [])
    assert threads_of_blas() == {MANY}


@pytest.mark.parametrize("first_out", ["first in", "last in"])
def test_nested_and_concurrent_calls_leave_it_as_it_was(first_out):
    inside, leave = threading.Event(), threading.Event()

    def other() -> None:
        with one_thread, one_thread:
            inside.set()
            leave.wait(60)

    thread = threading.Thread(target=other)
    with one_thread:
        with one_thread:
            assert threads_of_blas() == {1}
        thread.start()
        assert inside.wait(60)
        assert threads_of_blas() == {1}
        if first_out == "last in":
            leave.set()
            thread.join()
            assert threads_of_blas() == {1}
    leave.set()
    thread.join()
    assert threads_of_blas() == {MANY}


def test_a_task_runs_on_one_thread_wherever_it_is_done():
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        for way in (None, pool.map):
            assert map_items(threads_of_blas, None, [0, 1], way, "Counting", quiet=True).results == [{1}, {1}]


@pytest.mark.parametrize("name", ["fit", "solve", "diagnose", "improve", "locate", "suggest_experiment", "simulate",
                                  "evaluate", "multistart", "bootstrap", "profile", "profiles", "intervals",
                                  "covariance", "identifiability", "fit_many", "compare_formulations",
                                  "check_derivatives", "planned"])
def test_every_call_that_computes_is_held_to_one_thread(name, monkeypatch):
    seen = []
    monkeypatch.setattr(type(one_thread), "__enter__", lambda self: seen.append(name) or self)
    monkeypatch.setattr(type(one_thread), "__exit__", lambda self, *_: None)
    with pytest.raises(TypeError):
        getattr(mi, name)()
    assert seen == [name]


THREADS = re.compile(r"\w+_NUM_" r"THREADS|VECLIB_MAXIMUM_" r"THREADS|threadpool_" r"limits")
ROOT = Path(__file__).resolve().parents[2]


def test_no_test_and_no_benchmark_sets_threads_that_users_would_not_have():
    given = [*(ROOT / "tests").rglob("*.py"), ROOT / "pyproject.toml", *(ROOT / ".ci").glob("*")]
    assert {str(p): found for p in given if (found := THREADS.findall(p.read_text("utf-8")))} == {}


@pytest.mark.parametrize(("shared", "waves"), [(10, [3, 4, 3]), (parallel.WAVE, [1] * 10)])
def test_a_pool_is_handed_as_much_at_once_as_it_can_hold_whatever_its_tasks_share(shared, waves):
    def parcel(size):
        return parallel.Parcel("", bytes(size))

    tasks = [parallel.Task(parcel(shared), parcel(1_000_000), len) for _ in range(10)]
    assert [len(wave) for wave in parallel._waves(tasks)] == waves
    assert list(parallel._waves([])) == []
