"""Progress bars: one place for all long work, in a terminal and in Jupyter, silent anywhere else."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from importlib.util import find_spec

_showing: ContextVar[bool] = ContextVar("motorid_progress", default=False)


@contextmanager
def progress(text: str, total: float | None = None, *, quiet: bool = False) -> Iterator[Callable[..., None]]:
    """Show a bar while the block runs; call what it yields once per finished task.

    The bar stands on standard error and vanishes at the end. There is none if `quiet`, if nobody looks (a
    pipe, a log file, a worker process), or inside another bar, so any function may use it whoever calls it.

    Parameters
    ----------
    text : str
        What is being done, e.g. ``"Refitting"``.
    total : float, optional
        Number of tasks; None shows a running bar without an end.
    quiet : bool

    Yields
    ------
    callable
        ``advance(n=1)``.

    Examples
    --------
    >>> with progress("Refitting", total=3) as advance:
    ...     for _ in range(3):
    ...         advance()
    """
    if quiet or _showing.get() or not _watched():
        yield lambda n=1.0: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    token = _showing.set(True)
    try:
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(text, total=total)
            yield lambda n=1.0: bar.advance(task, n)
    finally:
        _showing.reset(token)


def _watched() -> bool:
    """Tell whether a person sees standard error: a terminal, or a Jupyter front end."""
    if in_jupyter():
        return find_spec("ipywidgets") is not None  # without it Rich warns instead of drawing
    return bool(getattr(sys.stderr, "isatty", lambda: False)())


def in_jupyter() -> bool:
    """Tell whether this process is the kernel of a notebook."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return type(shell).__name__ == "ZMQInteractiveShell"
