"""Progress bars: seen where someone looks, silent elsewhere, never in the way."""

import io
import subprocess
import sys
import time

import pytest

from motorid.numerics.parallel import progress


class Screen(io.StringIO):
    def isatty(self):
        return True


def terminal(monkeypatch):
    """Make standard error a terminal; called in the test itself, after pytest has set its own capture."""
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys, "stderr", Screen())
    return sys.stderr


def test_bar_counts_up_in_a_terminal(monkeypatch):
    screen = terminal(monkeypatch)
    with progress("Refitting", total=3) as advance:
        for _ in range(3):
            advance()
    assert "Refitting" in screen.getvalue()
    assert "3/3" in screen.getvalue()


def test_inside_another_bar_one_says_what_that_one_is_at(monkeypatch):
    screen = terminal(monkeypatch)
    with progress("Outer", total=1) as advance:
        with progress("Inner", total=1) as inner:
            inner()
            time.sleep(0.25)  # drawn ten times a second
        advance()
    assert "Inner" in screen.getvalue()
    assert "2/1" not in screen.getvalue()
    with progress("Later", total=1) as advance:
        advance()
    assert "Later" in screen.getvalue()


def test_quiet_shows_nothing(monkeypatch):
    screen = terminal(monkeypatch)
    with progress("Refitting", total=1, quiet=True) as advance:
        advance()
    assert screen.getvalue() == ""


def test_error_in_the_block_passes_and_ends_the_bar(monkeypatch):
    screen = terminal(monkeypatch)
    with pytest.raises(KeyError), progress("Refitting", total=1):
        raise KeyError("x")
    with progress("Again", total=1) as advance:
        advance()
    assert "Again" in screen.getvalue()


def test_pipe_stays_clean_and_rich_is_not_loaded():
    code = ("import sys; from motorid.numerics.parallel import progress\n"
            "with progress('Refitting', total=2) as a: a(); a()\n"
            "assert 'rich' not in sys.modules")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_what_is_at_work_is_said_and_no_total_is_made_up(monkeypatch):
    screen = terminal(monkeypatch)
    with progress("Looking") as advance:
        advance(1, "Fitting coulomb")
    assert "Fitting coulomb" in screen.getvalue()
    assert "?" not in screen.getvalue().replace("\x1b[?25", "")


def test_parts_of_a_task_count_and_a_total_may_grow_on_the_way(monkeypatch):
    screen = terminal(monkeypatch)
    with progress("Looking", 4, at_most=True) as advance:
        advance(0, "Round 1/3: fitting coulomb", 0.5)
        advance(0, "Round 2/3: fitting stribeck", 1.5, 8)
    assert "at most" in screen.getvalue()
    assert "Round 2/3: fitting stribeck" in screen.getvalue()
