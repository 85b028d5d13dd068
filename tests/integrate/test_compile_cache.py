"""Compiled steps on disk: named by content, whole or absent, shared by processes, never needed."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import motorid as mi
from motorid.integrate import Grid, Rosenbrock, rodas3
from motorid.integrate import compiled as cc
from motorid.integrate import rosenbrock as rb

needs_compiler = pytest.mark.skipif(cc.compiler() is None, reason="no C compiler on this machine")


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache, and steppers that have loaded nothing yet."""
    monkeypatch.setenv("MOTORID_CACHE", str(tmp_path / "cache"))
    forget()
    yield tmp_path / "cache"
    forget()


def forget():
    rb.stepper.cache_clear()
    rb._known.clear()


@pytest.fixture
def builds(monkeypatch):
    """How many steps were compiled."""
    calls = []
    build = cc.build

    def counted(source, mark, *flags):
        calls.extend([mark] if mark.startswith("step-") else [])
        return build(source, mark, *flags)

    monkeypatch.setattr(cc, "build", counted)
    return calls


def simulate(n=50, model=None, nq=0):
    model = model or mi.dc_motor(L=5e-3, K=0.1)
    system = model.system(("i", "omega"))
    p = np.array([model.values[k] for k in system.parameters])
    grid = Grid.of(np.arange(n) * 1e-3, np.full((n, 1), 6.0), np.array([True]))
    more = (np.zeros((2, nq)), np.eye(len(p))[:, :nq]) if nq else ()
    return Rosenbrock(compiled=True).run(system, grid, np.zeros(2), p, *more)


@needs_compiler
def test_one_library_serves_all_run_lengths_values_and_free_parameters(cache, builds):
    for n in (20, 50, 300):
        for nq in (0, 2, 5):
            simulate(n, nq=nq)
            simulate(n, mi.dc_motor(R=2.0, K=0.2), nq)
    assert len(builds) == 1
    assert len(list(cache.glob("step-*/*.so"))) == 1
    simulate(model=mi.dc_motor() + mi.effects.voltage_offset)
    assert len(builds) == 2


@needs_compiler
def test_the_next_process_finds_it_and_writes_no_step_of_its_own(cache, builds, monkeypatch):
    first = simulate(nq=2).x
    forget()
    monkeypatch.setattr(rodas3, "rosenbrock_step", lambda *_: pytest.fail("a step was written again"))
    assert np.array_equal(simulate(nq=2).x, first)
    assert len(builds) == 1


@needs_compiler
@pytest.mark.parametrize("damage", ["half", "empty", "text", "flipped"])
def test_a_damaged_library_is_replaced_and_not_loaded(cache, builds, damage):
    first = simulate().x
    (path,) = cache.glob("step-*/*.so")
    data = bytearray(path.read_bytes())
    flipped = bytes(data[:4000]) + bytes([data[4000] ^ 255]) + bytes(data[4001:])
    path.unlink()
    path.write_bytes(
        {"half": data[: len(data) // 2], "empty": b"", "text": b"no library", "flipped": flipped}[damage]
    )
    forget()
    assert np.array_equal(simulate().x, first)
    assert len(builds) == 2
    assert [p.read_bytes() for p in cache.glob("step-*/*.so")] == [bytes(data)]


@needs_compiler
def test_a_damaged_driver_is_replaced_and_not_loaded(cache, builds):
    first = simulate().x
    (path,) = cache.glob("driver-*/*.so")
    data = path.read_bytes()
    path.unlink()
    path.write_bytes(data[: len(data) // 2])
    forget()
    assert np.array_equal(simulate().x, first)
    assert [p.read_bytes() for p in cache.glob("driver-*/*.so")] == [data]
    assert len(builds) == 1


@needs_compiler
def test_a_step_holds_its_functions_alone_and_goes_with_what_made_it(cache, builds, monkeypatch):
    source = cc.generate(rodas3.StepFunctions(mi.dc_motor().system(("i", "omega"))))
    assert all(f"int motorid_{name}(" in source for name in ("light", "full", "out"))
    assert "checkout" not in source
    assert "sparsity" not in source
    simulate()
    forget()
    monkeypatch.setattr(cc, "MAKER", cc.MAKER + "# another method")
    simulate()
    assert len(builds) == 2


@needs_compiler
def test_two_processes_at_once(cache):
    code = """
import numpy as np, time, sys, motorid as mi
from motorid.integrate import Grid, Rosenbrock
system = (mi.dc_motor() + mi.effects.quadratic_drag).system(("i", "omega"))
grid = Grid.of(np.arange(50) * 1e-3, np.full((50, 1), 6.0), np.array([True]))
print("ready", flush=True)
sys.stdin.readline()
x = Rosenbrock(compiled=True).run(system, grid, np.zeros(2), np.array([1, 1e-3, .05, 1e-5, 1e-5, 1e-7])).x
print(x[-1, 1].hex())
"""
    both = [
        subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "MOTORID_CACHE": str(cache)},
        )
        for _ in range(2)
    ]
    for p in both:
        assert p.stdout is not None
        assert p.stdout.readline() == "ready\n"
    said = [p.communicate("go\n", timeout=120) for p in both]
    assert [p.returncode for p in both] == [0, 0]
    assert said[0] == said[1]
    assert said[0][1] == ""
    # A folder with its library for the step and for the driver: no temporary left, the same bytes from both.
    assert sorted(p.relative_to(cache).as_posix().split("-")[0] for p in cache.rglob("*.so")) == ["driver", "step"]
    assert len(list(cache.rglob("*"))) == 4


@needs_compiler
def test_a_half_written_folder_of_another_process_does_no_harm(cache, builds):
    (cache / "tmpabc").mkdir(parents=True)
    (cache / "tmpabc" / "step.so").write_bytes(b"half")
    simulate()
    assert len(builds) == 1


@needs_compiler
def test_another_compiler_or_other_flags_make_another_library(cache, builds, monkeypatch):
    simulate()
    forget()
    monkeypatch.setattr(cc, "FLAGS", (*cc.FLAGS, "-O1"))
    simulate()
    assert len(builds) == 2
    assert len(list(cache.glob("step-*/*.so"))) == 2


@needs_compiler
def test_a_cache_that_cannot_be_written_costs_speed_only(cache, tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("MOTORID_CACHE", str(tmp_path / "file" / "cache"))
    cc.say_once.cache_clear()
    machine = simulate().x
    simulate()
    assert capsys.readouterr().err.count("cannot compile") == 1
    assert np.isfinite(machine).all()


def test_a_compiler_that_fails_is_told_once_and_not_asked_again(cache, builds, monkeypatch, capsys, tmp_path):
    broken = tmp_path / "cc"
    broken.write_text('#!/bin/sh\n[ "$1" = --version ] && echo cc 1.0 && exit 0\necho no space >&2\nexit 1\n')
    broken.chmod(0o755)
    monkeypatch.setenv("MOTORID_CC", str(broken))
    cc.say_once.cache_clear()
    cc.compiler.cache_clear()
    try:
        first = simulate().x
        simulate()
    finally:
        monkeypatch.undo()
        cc.compiler.cache_clear()
    assert capsys.readouterr().err == (
        "motorid: cannot compile: the C compiler failed (no space); going on with CasADi's virtual "
        "machine, same results, slower.\n"
    )
    assert len(builds) == 1
    assert np.isfinite(first).all()


@pytest.mark.parametrize(("line", "own"), [
    ("gcc (Debian 12.2.0-14) 12.2.0", True), ("cc (Ubuntu 13.2.0) 13.2.0", True),
    ("x86_64-linux-gnu-gcc-12 (Debian 12.2.0-14) 12.2.0", True), ("Apple clang version 15.0.0 (clang-1500)", False),
    ("tcc version 0.9.27 (x86_64 Linux)", False), ("icc (ICC) 19.0", False)])
def test_only_gcc_is_asked_for_what_only_gcc_knows(monkeypatch, line, own):
    monkeypatch.setattr(cc, "compiler", lambda: ("cc", line))
    assert (cc.flags() != cc.FLAGS) is own


@needs_compiler
def test_short_work_is_not_compiled_and_long_work_is(cache, builds, monkeypatch):
    system = mi.dc_motor().system(("i", "omega"))
    p = np.array([1.0, 1e-3, 0.05, 1e-5, 1e-5])
    grid = Grid.of(np.arange(2000) * 1e-3, np.full((2000, 1), 6.0), np.array([True]))
    engine = Rosenbrock()
    engine.run(system, grid, np.zeros(2), p)
    assert not builds
    for _ in range(200):
        engine.run(system, grid, np.zeros(2), p)
        if builds:
            break
    assert len(builds) == 1
    assert replace(engine, compiled=False).run(system, grid, np.zeros(2), p).x == pytest.approx(
        engine.run(system, grid, np.zeros(2), p).x, rel=1e-9
    )
