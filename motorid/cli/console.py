"""What all commands share: exit statuses, one clear sentence for a mistake, tables on the screen."""

import codecs
import contextlib
import errno
import logging
import os
import re
import shlex
import sys
import textwrap
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import typer
from typer.core import TyperCommand, TyperGroup

from motorid.display.cards import Table
from motorid.display.numbers import NO_BREAK, glued
from motorid.errors import DataError, ModelError, MotoridError, UsageError, printable
from motorid.numerics.parallel import interruption, progress
from motorid.records.files import check_output
from motorid.records.reading import find_records

DONE, FAILED, WRONG, INTERRUPTED = 0, 1, 2, 130
RESULTS = ("json", "report", "path", "remainder_to")
INPUTS = ("runs", "directories", "validate", "fit_json", "effects_from", "found_json")
_ASCII = {"Ω": "Ohm", "ω": "omega", "τ": "tau", "θ": "theta", "φ": "phi", "α": "alpha", "Δ": "Delta", "µ": "u",
          "μ": "mu", "·": "*", "×": "x", "±": "+-", "²": "^2", "°": "deg", "√": "sqrt", "…": "...", "→": "->",
          "•": "*", "–": "-", "—": "-", "−": "-", "─": "-", "━": "-", "│": "|", "≈": "~", "≤": "<=", "≥": ">=",
          "“": '"', "”": '"', "⁻": "^-", **dict(zip("⁰¹³⁴⁵⁶⁷⁸⁹", "013456789", strict=True))}
# Messages name what Python takes; on the command line the same is said by options.
_OPTIONS = ((r"\b(columns|units)=\{(.*?)\}", lambda m: f"--{m[1]} {_pairs(m[2])}"),
            (r"\bwith (columns|units)\b", r"with --\1"),
            (r"\b(engine|hold|solver|initial|formulation)='([\w-]+)'", r"--\1 \2"), (r"\bdt=([\d.]+)", r"--dt \1"),
            (r"\brunning_median\(\)", "--median"), (r"\bmi\.torque_driven\(\) \((--drive torque)\)", r"\1"),
            (r"\bmodel\.without\('(\w+)'\)", r"leave \1 out of --effects"),
            (r"\bmodel\.(fix|free)\(…\)", r"--\1 NAME"), (r"\bmodel\.replace\(…\)", "--set NAME=VALUE"),
            (r"\bmodel\.(fix|free)\('?(\w+)'?(=[^)]*)?\)", r"--\1 \2\3"),
            (r"\bmi\.evaluate\(model, runs\)", "motorid simulate FIT.json RUN..."),
            (r"\bmi\.load\(path, effects=\[\w+\]\)", "--effects-from FILE.py"),
            (r"\bSteadyState\(\) (cannot.*), or leave it out\.", r"The steady state of --formulation hard \1."),
            (r" If you know where it comes from, mi\.load.*", ""))
MANY = ("--validate",)  # options that take all names up to the next option
OUTPUTS = ("--json", "--report")  # options that write a file
COMMAND = ("Next: motorid", "Then: motorid", "Written: ")  # lines to copy, not wrapped
MAY_WRAP = 32  # characters of a cell that is a sentence: shorter ones are names and numbers, and stay whole
WIDTH = 80  # where the output is no terminal


class _PlainHelp:
    """Help that names no type of Python: a flag takes no value, an argument has its name."""

    def get_params(self, ctx: Any) -> list[Any]:
        """See click."""
        params: list[Any] = super().get_params(ctx)  # type: ignore[misc]  # of the click class it is mixed into
        for p in params:
            if p.param_type_name == "argument":
                p.display_type_rich = lambda ctx: ""
            elif p.is_flag:
                p.metavar = ""
        return params


class Command(_PlainHelp, TyperCommand):
    """A command whose ``--validate`` takes several names, as the shell makes them of a pattern."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """See click."""
        return super().parse_args(ctx, _spread(args))

    def invoke(self, ctx: Any) -> Any:
        """Look at the outputs before the work."""
        _check_outputs(ctx.params, ctx.info_name)
        return super().invoke(ctx)


class Group(_PlainHelp, TyperGroup):
    """Turns errors into one sentence on standard error and the exit status."""

    def main(self, args: Sequence[str] | None = None, prog_name: str | None = None, **extra: Any) -> Any:
        """See click; leaves by `SystemExit`."""
        try:
            status = super().main(args, prog_name or "motorid", **{**extra, "standalone_mode": False})
            if interruption.asked and not interruption.told:  # Typer made a status of it, while it read the words
                _say("interrupted.")
        except MotoridError as error:
            status = _say(str(error), WRONG if isinstance(error, DataError | ModelError | UsageError) else FAILED)
        except typer.Abort:
            status = _say("stopped.")
        except BrokenPipeError:
            sys.stderr.close()  # nobody reads any more, e.g. `motorid fit … | head`
            status = FAILED
        except (ArithmeticError, np.linalg.LinAlgError, MemoryError) as error:
            status = _say("the numbers or the size of these records are beyond what can be computed "
                          f"({str(error) or 'out of memory'}).", FAILED)
        except Exception as error:
            status = self._unexpected(error)
        sys.exit(status if isinstance(status, int) else DONE)

    def invoke(self, ctx: Any) -> Any:
        """End the work where Ctrl-C was pressed."""
        try:
            return super().invoke(ctx)
        except (Exception, KeyboardInterrupt) as error:
            if not interruption.behind(error):
                raise
            interruption.heard()
            raise typer.Exit(_say("interrupted before it was done; what was written before is kept.")) from None

    @staticmethod
    def _unexpected(error: Any) -> int:
        if interruption.behind(error):  # raised inside what was loading, and made another error of
            interruption.heard()
            return _say("interrupted.")
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EFBIG, errno.EIO):
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what is left of the output has no place
            return _say(f"cannot write the output: {error.strerror}.", FAILED)
        told: Any = getattr(error, "format_message", None)
        if told is None:
            raise error
        text, context = told().strip(), getattr(error, "ctx", None)
        help_ = f" Help: {context.command_path if context else 'motorid'} --help"
        return _say(text + ("" if text.endswith((".", "?", "!")) else ".") + help_, WRONG)


def prepare_process() -> None:
    """Make a process one that answers to Ctrl-C, prints whatever a terminal can show, and warns in one line."""
    codecs.register_error("motorid", _shown_otherwise)
    sys.stdout, sys.stderr = (s or open(os.devnull, "w") for s in (sys.stdout, sys.stderr))  # noqa: SIM115 closed by `>&-`
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="motorid")  # type: ignore[union-attr]  # asked the line above
    os.environ["MPLBACKEND"] = "agg"  # figures go to files, whatever backend a shell names
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # where it keeps its fonts is no user's business
    warnings.simplefilter("ignore", RuntimeWarning)  # of arithmetic: what came of it is said
    warnings.filterwarnings("ignore", message=r"\s*(casadi: a numpy|Glyph |constrained_layout)")  # no user's business
    warnings.formatwarning = lambda message, *_, **__: f"motorid: {message}\n"
    interruption.listen()


def _shown_otherwise(error: UnicodeError) -> tuple[str, int]:
    assert isinstance(error, UnicodeEncodeError)
    part = error.object[error.start:error.end]
    return "".join(_ASCII.get(c) or c.encode("unicode_escape").decode() for c in part), error.end


def _check_outputs(given: dict[str, Any], command: str) -> None:
    """Refuse, before the work, an output that must not be written: an input, twice, or another program's file."""
    wanted = [given[k] for k in (*RESULTS, *(["out"] if command in ("fit-many", "design") else []))
              if given.get(k) is not None]
    targets = [check_output(path, given.get("force", False)) for path in wanted if path != "-"]
    if len(set(targets)) < len(targets):
        raise UsageError(f"two results cannot be written to one file, {targets[0]}.")
    named = [n for k in INPUTS if given.get(k) for n in (given[k] if isinstance(given[k], list) else [given[k]])]
    inputs: list[Path] = []
    for name in named if targets and not given.get("force") else []:
        with contextlib.suppress(MotoridError, OSError):  # said when it is read
            inputs += find_records(name)
    for target in targets:
        if any(target.exists() and target.samefile(path) for path in inputs):
            raise UsageError(f"cannot write {target}: it is read as well. Choose another name, or replace it with "
                             "--force.")


def show(*parts: Table | str | None) -> None:
    """Print tables and text."""
    from rich import box
    from rich.table import Table as RichTable
    from rich.text import Text

    console = _console()
    for part in (p for p in parts if p is not None):
        if isinstance(part, str):
            for s in printable(in_options(part)).split("\n"):
                whole = "   " in s or s.startswith(COMMAND)  # a table, or what is to be copied
                console.print(Text(s if whole else _filled(s, console.width)), soft_wrap=whole)
            continue
        part = _upright(part, console.width)
        drawn = RichTable(title=part.title or None, box=box.SIMPLE_HEAD, title_justify="left", title_style="bold")
        widths = _widths(part, console.width)
        for k, (head, width) in enumerate(zip(part.header, widths, strict=True)):
            drawn.add_column(_filled(head, width), justify="left" if k in part.left else "right", overflow="fold",
                             width=width)
        for row in part.rows:
            drawn.add_row(*(Text(_filled(printable(str(cell)), w)) for cell, w in zip(row, widths, strict=True)))
        console.print(drawn)
        if part.note:
            console.print(Text(_filled(printable(part.note), console.width) + "\n"))


def _columns(table: Table) -> list[list[str]]:
    return [[str(c) for c in column] for column in zip(table.header, *table.rows, strict=True)]


def _least(cells: Sequence[str]) -> int:
    """Return the length of the longest part that stays whole: a word, a value with its error and unit."""
    return max((len(part) for cell in cells for part in re.split(r"[ \n]", glued(cell))), default=0)


def _upright(table: Table, room: int) -> Table:
    """Return a table with rows and columns exchanged where only that keeps its names and numbers whole."""
    whole = [max(_least(c), *(len(cell) for cell in c[1:] if max(map(len, c)) <= MAY_WRAP), 0) for c in _columns(table)]
    return table if sum(whole) + 3 * len(whole) < room or len(whole) <= len(table.rows) + 1 else table.turned()


def _widths(table: Table, room: int) -> list[int]:
    """Return the widths of columns that fit the screen with the least wrapping, of headers evenly shared."""
    room -= 3 * len(table.header) + 1
    options = [_options(cells, room) for cells in _columns(table)]
    found = [best for most in (1, 2, 3, 9) if (best := _narrow(options, room, most))]
    return min(found)[-1] if found else [1] * len(options)


def _options(cells: Sequence[str], room: int) -> dict[int, tuple[int, int]]:
    """Return the lines of the header and Σ lines² of the cells below for each width; to break a word costs most."""
    least = _least(cells)
    counts = ((w, [1 if len(c) <= w else -(-len(c) // w) if w < least else 1 + _filled(c, w).count("\n")
                   for c in cells]) for w in range(1, max(1, min(max(map(len, cells)), room)) + 1))
    return {w: (head, sum(n**2 for n in below) + 1000 * max(least - w, 0) ** 2) for w, (head, *below) in counts}


def _narrow(options: Sequence[dict[int, tuple[int, int]]], room: int, most: int) -> tuple[int, int, list[int]] | None:
    """Return cost, sum and widths of the best table whose header has at most so many lines; None without any."""
    found: dict[int, tuple[int, list[int]]] = {0: (most**2, [])}  # by the sum of the widths
    for lines in options:
        step: dict[int, tuple[int, list[int]]] = {}
        for used, (cost, widths) in found.items():
            for w, (head, below) in lines.items():
                if head <= most and used + w <= room and cost + below < step.get(used + w, (np.inf,))[0]:
                    step[used + w] = cost + below, [*widths, w]
        found = step
    return min((cost, used, widths) for used, (cost, widths) in found.items()) if found else None


def in_options(text: str) -> str:
    """Return a message with what Python takes said as the options of the command line."""
    for pattern, option in _OPTIONS:
        text = re.sub(pattern, option, text)
    return text


def _pairs(inside: str) -> str:
    """Return ``v=u_volt,omega=speed`` of ``'v': 'u_volt', 'omega': 'speed'``, quoted where a shell needs it."""
    pairs = re.findall(r"'(\w+)': ?(?:'([^']*)'|(\d+)|\.\.\.)", inside)
    words = ",".join(f"{name}={text or number or '...'}" for name, text, number in pairs)
    return f'"{words}"' if re.search(r"[^\w.,=:/%+-]", words) else words


def _console() -> Any:
    from rich.console import Console

    class Printer(Console):
        def on_broken_pipe(self) -> None:  # nobody reads on, `motorid fit … | head`: files are written all the same
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)

    console = Printer(highlight=False, soft_wrap=False)
    return console if console.is_terminal else Printer(highlight=False, width=WIDTH)


def say_notes(notes: Iterable[str], title: str = "Remarks") -> None:
    """Print remarks as a list, if there are any."""
    if lines := [wrapped(note, "  • ") for note in notes]:
        show("\n".join([title, *lines, ""]))


def wrapped(text: str, first: str = "") -> str:
    """Return a paragraph as wide as the screen, its further lines below the text of the first one."""
    return _filled(in_options(text), _console().width, first)


def _filled(text: str, width: int, first: str = "") -> str:
    """Return a line of text cut at spaces, but not within a value with its error and unit."""
    lines = textwrap.fill(glued(text), width, initial_indent=first, subsequent_indent=" " * len(first),
                          break_on_hyphens=False, break_long_words=False)
    return lines.replace(NO_BREAK, " ")


def next_command(name: str, *more: str) -> str:
    """Return what to type next: this command line with another command and `more`, without what it writes."""
    words = iter(sys.argv[2:])
    dropped = OUTPUTS if name == "diagnose" else (*OUTPUTS, "--budget", "--max-effects", "--remainder-to", "--jobs")
    kept = [w for w in words if not (w in dropped and next(words, None))
            and w.partition("=")[0] not in (*dropped, "--force")]
    line = shlex.join(["motorid", name, *kept, *more])
    short = shlex.join(["motorid", name, "RUN...", *more]).replace("'RUN...'", "RUN...")
    return line if kept and len(line) <= 2 * WIDTH else f"{short} (the same records and options)"


def save_report(result: Any, path: Any, held_out: Sequence[Any] = (), force: bool = False, quiet: bool = False) -> None:
    """Write the page of a result, if a path was given; and say so, unless numbers alone go to the screen."""
    if path is None:
        return
    from motorid.reports.report import report

    with progress("Writing the report"):
        written = report(result, path, command=" ".join(["motorid", *sys.argv[1:]]), validate=held_out, force=force)
    show(None if quiet else f"Report: {written}")


def _say(text: str, status: int = INTERRUPTED) -> int:
    """Say on standard error why a command ends, and return the exit status."""
    typer.echo(f"motorid: {printable(' '.join(in_options(text).split()))}", err=True)
    return status


def _spread(args: Sequence[str]) -> list[str]:
    """Turn ``--validate a b`` into ``--validate a --validate b``."""
    spread: list[str] = []
    option = None
    for k, word in enumerate(args):
        if word == "--":
            return [*spread, *args[k:]]
        if word.startswith("-") and len(word) > 1:
            option = word if word in MANY else None
        elif option and spread[-1] != option:
            spread.append(option)
        spread.append(word)
    return spread
