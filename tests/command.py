"""Running the command line inside the test's own process."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from typer.testing import CliRunner

from motorid.cli.app import app


@dataclass(frozen=True)
class Done:
    """Exit status, standard output and standard error of one command."""

    status: int
    out: str
    err: str


def motorid(*words: object) -> Done:
    """Run ``motorid words…``; an exception that is no exit is raised, so that no traceback goes unseen."""
    result = CliRunner().invoke(app, [str(w) for w in words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return Done(result.exit_code, result.stdout, result.stderr)


def motorid_json(folder: Path, *words: object) -> dict[str, Any]:
    """Run a command that must succeed with ``--json`` and return its contents; NaN is refused."""
    path = folder / "result.json"
    done = motorid(*words, "--json", path)
    assert done.status == 0, done.err
    return json.loads(path.read_text(encoding="utf-8"), parse_constant=_no_constant)


def _no_constant(word: str) -> None:
    raise AssertionError(f"{word} is not JSON")
