"""What all commands share: exit statuses, one clear sentence for a mistake, tables on the screen."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterable, Sequence
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from motorid.display.tables import Table
from motorid.errors import DataError, ModelError, MotoridError, UsageError

DONE, FAILED, WRONG = 0, 1, 2
MANY = ("--validate",)  # options that take all names up to the next option
OUTPUTS = ("--json", "--report")  # options that write a file
WIDTH = 110  # where the output is no terminal


class Command(TyperCommand):
    """A command whose ``--validate`` takes several names, as the shell makes them of a pattern."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """See click."""
        return super().parse_args(ctx, _spread(args))


class Group(TyperGroup):
    """Turns errors into one sentence on standard error and the exit status."""

    def main(self, args: Sequence[str] | None = None, prog_name: str | None = None, complete_var: str | None = None,
             standalone_mode: bool = True, windows_expand_args: bool = True, **extra: Any) -> Any:
        """See click; leaves by `SystemExit`."""
        try:
            status = super().main(args, prog_name or "motorid", complete_var, standalone_mode=False,
                                  windows_expand_args=windows_expand_args, **extra)
        except MotoridError as error:
            _say(str(error))
            status = WRONG if isinstance(error, DataError | ModelError | UsageError) else FAILED
        except typer.Abort:
            _say("stopped.")
            status = FAILED
        except BrokenPipeError:
            sys.stderr.close()  # nobody reads any more, e.g. `motorid fit … | head`
            status = FAILED
        except Exception as error:
            if not hasattr(error, "format_message"):
                raise
            _say(_usage(error))
            status = WRONG
        sys.exit(status if isinstance(status, int) else DONE)


def show(*parts: Table | str | None) -> None:
    """Print tables and text."""
    from rich import box
    from rich.console import Console
    from rich.table import Table as RichTable
    from rich.text import Text

    console = Console(highlight=False, soft_wrap=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=WIDTH)
    for part in parts:
        if part is None:
            continue
        if isinstance(part, str):
            console.print(Text(part))
            continue
        drawn = RichTable(title=part.title or None, box=box.SIMPLE_HEAD, title_justify="left",
                          title_style="bold")
        for k, head in enumerate(part.header):
            drawn.add_column(head, justify="left" if k in part.left else "right", overflow="fold")
        for row in part.rows:
            drawn.add_row(*(Text(str(cell)) for cell in row))
        console.print(drawn)
        if part.note:
            console.print(Text(f"{part.note}\n"))


def say_notes(notes: Iterable[str], title: str = "Remarks") -> None:
    """Print remarks as a list, if there are any."""
    lines = [f"  • {note}" for note in notes]
    if lines:
        show("\n".join([title, *lines, ""]))


def next_command(name: str) -> str:
    """Return what to type next: this command line with another command, without what it writes."""
    words = iter(sys.argv[2:])
    kept = [w for w in words if not (w in OUTPUTS and next(words, None)) and w.partition("=")[0] not in OUTPUTS]
    line = shlex.join(["motorid", name, *kept])
    return line if kept and len(line) <= WIDTH else f"motorid {name} RUN... (the same records and options)"


def save_report(result: Any, path: Any, held_out: Sequence[Any] = ()) -> None:
    """Write the page of a result, if a path was given."""
    if path is None:
        return
    from motorid.reports.report import report

    command = " ".join(["motorid", *sys.argv[1:]])
    show(f"Report: {report(result, path, command=command, validate=held_out)}")


def _say(text: str) -> None:
    typer.echo(f"motorid: {' '.join(text.split())}", err=True)


def _usage(error: Any) -> str:
    text = error.format_message().strip()
    text = text if text.endswith((".", "?", "!")) else f"{text}."
    context = getattr(error, "ctx", None)
    return f"{text} Help: {context.command_path if context else 'motorid'} --help"


def _spread(args: Sequence[str]) -> list[str]:
    """Turn ``--validate a b`` into ``--validate a --validate b``."""
    spread: list[str] = []
    option = None
    for k, word in enumerate(args):
        if word == "--":
            return [*spread, *args[k:]]
        if word in MANY:
            option, first = word, True
            spread.append(word)
        elif option and not (word.startswith("-") and len(word) > 1):
            spread += [word] if first else [option, word]
            first = False
        else:
            option = None
            spread.append(word)
    return spread
