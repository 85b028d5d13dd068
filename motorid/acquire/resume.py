"""Going on with a record that was cut short: what is left to do, and where it goes on the time axis."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from motorid.acquire.excitation import Program
from motorid.acquire.record_file import RunFile, Tail, read_tail
from motorid.errors import UsageError

__all__ = ["Part", "plan"]


@dataclass(frozen=True)
class Part:
    """What this recorder adds to the file: all of it, or (with a tail) what is left."""

    excite: str | Program | None
    tail: Tail | None = None

    def todo(self, whole: Program) -> tuple[Program, int]:
        """Return what is left of the whole program, and the number of its segments that are done.

        The segment that was interrupted is repeated from its start, since the motor stood still meanwhile.

        Raises
        ------
        UsageError
            If nothing is left.
        """
        if self.tail is None:
            return whole, 0
        meta = self.tail.meta
        before = int(meta.get("segments done", 0))
        ran = self.tail.time - float(meta.get("part begins", 0))
        left = Program(whole.segments[before:], whole.words).after(ran)
        if meta.get("ended") == "done" or (whole.segments and not left.segments):
            raise UsageError("this record is complete; there is nothing to resume. Choose another name for "
                             "--out.")
        return left, len(whole.segments) - len(left.segments)

    def begin(self, file: RunFile, done: int) -> None:
        """Set the time axis, by the clock of this computer, and mark the pause."""
        if self.tail is None:
            return
        now, tail, step = datetime.now().astimezone(), self.tail, 1 / file.rate
        at = tail.time + 2 * step
        if "started" in tail.meta:
            at = max(at, (now - datetime.fromisoformat(tail.meta["started"])).total_seconds())
        at = math.ceil(at * file.rate) / file.rate
        file.pause(tail, at)
        file.note({"resumed": now.isoformat(timespec="milliseconds"), "part begins": f"{at:.6f}",
                   "segments done": done,
                   "pause": f"{at - tail.time:.3f} s, the motor taken to be off; the angle may count from "
                            "another zero after it"})


def plan(out: Path, excite: str | Program | None, resume: bool) -> Part:
    """Say what this recorder adds to `out`; without an excitation, a resumed record goes on with its own."""
    if not (resume and out.exists()):
        return Part(excite)
    tail = read_tail(out)
    return Part(excite if excite is not None else tail.meta.get("excitation"), tail)

