"""What all long work shares: pieces over any `map`, a budget of time, Ctrl-C, a progress bar, one thread for BLAS.

`map` is anything with the signature of the built-in one: ``executor.map`` of `concurrent.futures`,
``client.get_executor(pure=False).map`` of Dask, ``lambda f, xs: joblib.Parallel(2)(joblib.delayed(f)(x) for x in xs)``.
"""

import builtins
import hashlib
import os
import pickle
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import AbstractContextManager, ContextDecorator, contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.util import find_spec
from itertools import accumulate, groupby
from typing import Any, NamedTuple

from motorid.errors import OutOfTime, UsageError

Map = Callable[..., Iterable[Any]]
# Those of this system; the alarm repeats Ctrl-C.
SIGNALS = [getattr(signal, n) for n in ("SIGINT", "SIGALRM", "SIGTERM", "SIGHUP") if hasattr(signal, n)]
WAVE = 4_000_000  # bytes of records handed to a pool at once; two waves are under way
MOST_TASKS = 64  # when many small pieces go to a pool together: few enough to ship, many enough to share out


class OneThread(ContextDecorator):
    """Keeps BLAS to one thread while a call runs: around a block, or as a decorator.

    Threads that share out products of a few columns only wait for one another: twice the processor time for the
    same wall time alone, and several times the wall time beside another busy process. The setting is the
    process's: the first thread that comes in makes it and takes it back when it leaves, others find it made."""

    def __init__(self) -> None:
        self._lock, self._owner, self._depth = threading.Lock(), 0, 0
        self._limit: AbstractContextManager[Any] | None = None

    def __enter__(self) -> "OneThread":
        with self._lock:
            if not self._depth:
                self._owner = threading.get_ident()
                self._limit = limit = _blas().limit(limits=1)
                limit.__enter__()
            self._depth += self._owner == threading.get_ident()
        return self

    def __exit__(self, *error: object) -> None:
        with self._lock:
            mine = self._depth > 0 and self._owner == threading.get_ident()
            self._depth -= mine
            if mine and not self._depth and self._limit is not None:
                self._limit.__exit__(None, None, None)


one_thread = OneThread()
_deadline: ContextVar[float] = ContextVar("motorid_deadline", default=float("inf"))


@contextmanager
def budget(seconds: float | None) -> Iterator[None]:
    """Let `check_time` raise `OutOfTime` once so many seconds have passed; never for None."""
    if seconds is not None and not seconds >= 0:
        raise UsageError(f"a budget takes seconds, zero or more; got {seconds!r}.")
    token = _deadline.set(_deadline.get() if seconds is None else min(_deadline.get(), time.monotonic() + seconds))
    try:
        yield
    finally:
        _deadline.reset(token)


def check_time() -> None:
    """Raise `OutOfTime` if the budget around this call is spent; called once an iteration by whatever takes long."""
    if time.monotonic() > _deadline.get():
        raise OutOfTime


@lru_cache(maxsize=1)
def _blas() -> Any:
    from threadpoolctl import ThreadpoolController  # late: not needed to import the package

    return ThreadpoolController().select(user_api="blas")


class Interruption:
    """Ctrl-C, or a polite kill, that arrives: C libraries swallow the exception at times, or make another one of it, so
    it is raised again until someone says `heard`. `asked` tells that it came. Only after `listen`, in the command line.
    """

    AGAIN = 0.5  # s

    def __init__(self) -> None:
        self.asked = self.told = False

    def listen(self) -> None:
        """Take over Ctrl-C, and what ends a process politely where that is not ignored (``nohup``)."""
        for number in SIGNALS:
            if number == signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._raise)

    def over(self) -> None:
        """Ignore it from now on: all is done, and Python, which hears nothing while it ends, would die of it."""
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN)

    def behind(self, error: BaseException) -> bool:
        """Tell whether Ctrl-C is what an exception comes from."""
        return self.asked or isinstance(error, KeyboardInterrupt)

    def heard(self) -> None:
        """Stop raising it; who hears it tells it."""
        self.told = True
        if hasattr(signal, "setitimer") and self.asked:
            signal.setitimer(signal.ITIMER_REAL, 0)

    def _raise(self, number: int, frame: object) -> None:
        self.asked = True
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, self.AGAIN)
        raise KeyboardInterrupt


interruption = Interruption()


def as_worker(parent: int) -> None:
    """Make this process one of a command's pool: Ctrl-C is the command's, and none goes on without the command."""
    one_thread.__enter__()
    for name, action in (("SIGINT", signal.SIG_IGN), ("SIGTERM", signal.SIG_DFL), ("SIGHUP", signal.SIG_DFL)):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), action)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def processes(jobs: int) -> Iterator[Map | None]:
    """Yield the `map` of so many processes of this machine, None for one; Ctrl-C leaves what was not begun undone."""
    if jobs == 1:
        yield None
        return
    most = min(jobs, 4 * (os.cpu_count() or 1))  # each costs memory and a second to begin
    with ProcessPoolExecutor(most, initializer=as_worker, initargs=(os.getpid(),)) as pool:
        try:
            yield pool.map
        finally:
            pool.shutdown(wait=not interruption.told, cancel_futures=True)


@dataclass(frozen=True)
class Parcel:
    """An object pickled once, unpacked once per process; a notebook's law travels as CasADi functions."""

    key: str
    data: bytes = field(compare=False, repr=False)

    @staticmethod
    def of(content: Any) -> "Parcel":
        """Pack `content`."""
        data = pickle.dumps(content, protocol=pickle.HIGHEST_PROTOCOL)
        return Parcel(hashlib.sha256(data).hexdigest(), data)

    @lru_cache(maxsize=8)  # noqa: B019 a few parcels are kept on purpose
    def open(self) -> Any:
        """Return the content; one object per process, so it must not be changed."""
        return pickle.loads(self.data)


class Task(NamedTuple):
    """What a pool is handed: a function, and what it is applied to."""

    shared: Parcel
    items: Parcel
    function: Callable[[Any, Any], Any]


class Done(NamedTuple):
    """Results in the order of the tasks, and why there are not all of them (empty if there are)."""

    results: list[Any]
    interrupted: str


def map_items(function: Callable[[Any, Any], Any], shared: Any, items: Sequence[Any], map: Map | None, text: str, *,
              quiet: bool = False, each: Callable[[Any], object] | None = None) -> Done:
    """Return ``[function(shared, item) for item in items]`` by way of `map`, with a progress bar that says `text`.

    `function` stands at a module's top level and returns failures instead of raising them. `shared` travels once per
    process, small items in chunks; `each` is called with every result as it comes. An interruption keeps what is done;
    if the pool breaks (a worker was killed), the rest is done in this process: that costs time, not results."""
    parcel = Parcel.of(shared)
    size = 1 if map is None or map is builtins.map else max(-(-len(items) // MOST_TASKS), 1)
    tasks = [Task(parcel, Parcel.of(items[k:k + size]), function) for k in range(0, len(items), size)]
    results, done = [], 0
    with progress(text, total=len(tasks), quiet=quiet) as advance:
        try:
            for way in ([map] if map is not None else []) + [builtins.map]:
                try:
                    for chunk in _in_waves(way, tasks[done:]):
                        results += chunk
                        done += 1
                        if each is not None:
                            for result in chunk:
                                each(result)
                        advance()
                    break
                except Exception as error:
                    if interruption.asked:
                        raise KeyboardInterrupt from None
                    if way is builtins.map:
                        raise
                    print(f"motorid: the pool failed ({error!r}); doing "
                          f"the remaining {len(tasks) - done} of {len(tasks)} tasks in this process.", file=sys.stderr)
        except KeyboardInterrupt:
            interruption.heard()
            return Done(results, f"interrupted after {len(results)} of {len(items)}")
    return Done(results, "")


def _apply(task: Task) -> list[Any]:
    with one_thread:  # for its linear algebra, in whatever process it runs
        return [task.function(task.shared.open(), item) for item in task.items.open()]


def _in_waves(way: Map, tasks: Sequence[Task]) -> Iterator[list[Any]]:
    """Yield the results in order, handing over the tasks in waves so that a pool need not hold all records."""
    under_way: Iterable[list[Any]] = ()
    for wave in _waves(tasks):
        before, under_way = under_way, way(_apply, wave)
        yield from before
    yield from under_way


def _waves(tasks: Sequence[Task]) -> Iterator[list[Task]]:
    room = max(WAVE - sum(len(task.shared.data) for task in tasks[:1]), 1)  # beside what all of a wave share
    sizes = accumulate(len(task.items.data) for task in tasks)
    for _, wave in groupby(zip(sizes, tasks, strict=True), lambda pair: pair[0] // room):
        yield [task for _, task in wave]


_outer: ContextVar[Callable[..., None] | None] = ContextVar("motorid_progress", default=None)


@contextmanager
def progress(text: str, total: float | None = None, *, quiet: bool = False, at_most: bool = False, short: bool = False
             ) -> Iterator[Callable[..., None]]:
    """Show a bar while the block runs; call what it yields once per finished task.

    The bar stands on standard error and vanishes at the end. There is none if `quiet`, or if nobody looks (a pipe, a
    log file, a worker process). Inside another one it only says what that one is at, so any function may use it. With a
    `total` of tasks it shows the time left, which may be less if the total is `at_most`. What is `short` has no bar in
    its first second in a notebook, where a bar leaves an empty output. It yields ``advance(n=1, at_work="", done=None,
    total=None)``: `at_work` takes the place of `text`; `done` is how many tasks are, parts of one included."""
    if (outer := _outer.get()) is not None:
        outer(0, text)
    # A person sees standard error on a terminal, or in Jupyter; there without ipywidgets Rich warns instead of drawing.
    if quiet or outer is not None or not (find_spec("ipywidgets") is not None if in_jupyter() else
                                          getattr(sys.stderr, "isatty", lambda: False)()):
        yield lambda n=1.0, at_work="", done=None, total=None: None
        return
    from rich import progress as rich
    from rich.console import Console
    from rich.table import Column

    columns: list[rich.ProgressColumn] = [rich.SpinnerColumn(), rich.TextColumn("{task.description}",
        table_column=Column(overflow="ellipsis")), rich.TimeElapsedColumn(table_column=Column(min_width=7))]
    if total:
        count = rich.TextColumn("at most") if at_most else rich.MofNCompleteColumn()
        columns += [rich.BarColumn(8), count, rich.TimeRemainingColumn(table_column=Column(min_width=7))]
    bar = rich.Progress(*columns, console=Console(stderr=True), transient=True, speed_estimate_period=3600.0)
    task, begin = bar.add_task(text, total=total), time.monotonic() + (short and in_jupyter())

    def advance(n: float = 1.0, at_work: str = "", done: float | None = None, total: float | None = None) -> None:
        if time.monotonic() >= begin:
            bar.start()
        bar.update(task, description=at_work or text, completed=done, total=total, advance=n if done is None else None)

    token = _outer.set(advance)
    try:
        advance(0)
        yield advance
    finally:
        _outer.reset(token)
        bar.stop()


def in_jupyter() -> bool:
    """Tell whether this process is the kernel of a notebook."""
    return type(getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()).__name__ == "ZMQInteractiveShell"
