"""Progress bars: seen where someone looks, silent elsewhere, never in the way."""

import io
import subprocess
import sys

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


def test_inner_bar_stays_silent_inside_another(monkeypatch):
    screen = terminal(monkeypatch)
    with progress("Outer", total=1) as advance:
        with progress("Inner", total=1) as inner:
            inner()
        advance()
    assert "Inner" not in screen.getvalue()
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
        advance(1, "fitting coulomb")
    assert "Looking: fitting coulomb" in screen.getvalue()
    assert "?" not in screen.getvalue().replace("\x1b[?25", "")


def test_a_round_whose_total_is_learnt_on_the_way_has_a_true_bar(monkeypatch):
    screen = terminal(monkeypatch)
    with progress("Looking") as advance:
        advance(0, "fitting coulomb", 4)
        advance(1, "fitting stribeck")
        advance(2, "fitting gravity")
    assert "3/4" in screen.getvalue()
