"""Closing the loop with a bench: record, fit, diagnose, design the next record, record again."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from motorid.acquire.client import Link
from motorid.acquire.recorder import record
from motorid.diagnosis.diagnose import diagnose
from motorid.diagnosis.experiment_design import Design, design_experiment, names_apart
from motorid.diagnosis.results import Diagnosis
from motorid.display.cards import Card, Flag, Printed, Table
from motorid.display.numbers import percent
from motorid.errors import FitError, among, at_least, positive
from motorid.estimation.fit import fit
from motorid.model.model import dc_motor
from motorid.records.experiment import Experiment
from motorid.records.reading import read_csv


@dataclass(frozen=True, eq=False)
class Step:
    """One record: what was played, how it ended, what was found with it, and the design for the next."""

    excite: str
    ended: str
    found: Diagnosis
    open: str
    design: Design | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Campaign(Printed):
    """What `identify_on` did."""

    steps: tuple[Step, ...]
    runs: tuple[Experiment, ...]
    reached: bool
    text: str

    @property
    def best(self) -> Any:
        """The last fit."""
        return self.steps[-1].found.best

    def card(self) -> Card:
        """Return the steps, one by one."""
        rows = [[str(k + 1), s.ended, " + ".join(s.found.effects) or "–",
                 ", ".join(percent(e, 2) for e in s.found.best.nrmse.values()), s.open or "nothing"]
                for k, s in enumerate(self.steps)]
        table = Table(["record", "ended", "missing effects", "errors", "open after it"], rows, left=(0, 1, 2, 3, 4))
        return Card("Identification on a bench", (Flag("reached", "good") if self.reached else Flag("open", "note"),),
                    (self.text,), (table,), (("campaign.best", "the last fit"), ("campaign.runs", "the records")))


def identify_on(bench: str | Link, folder: str | Path = ".", *, goal: str = "distinguish", until: float = 0.01,
                parameters: Sequence[str] | None = None, v_max: float, i_max: float, records: int = 4,
                duration: float = 2.0, first: str = "standard", progress: Callable[[str], None] | None = None,
                **options: Any) -> Campaign:
    """Identify a motor on a bench: record, fit, diagnose, design the next record, until all is determined.

    Each voltage was checked against every rival; the device enforces the limits. **The motor will move: keep clear.**

    Parameters
    ----------
    bench : str or Link
        Port of a bench, as for `record`, or `virtual_bench(...)`.
    folder : path
        Where the records go, as ``record1.csv`` and so on; those that exist are left alone and an error raised.
    goal : {"distinguish", "sharpen"}
        Until no group of effects is left, or until `parameters` are known.
    until : float
        Relative standard deviation that is asked of each of them.
    parameters, v_max, i_max, duration, **options
        As in `design_experiment`.
    records : int
        Largest number of records.
    first : str
        Excitation of the first record.
    progress : callable, optional
        Called with a sentence on each step.

    Raises
    ------
    UsageError, DeviceError
        For words or limits that make no sense; if the bench cannot be reached.

    Examples
    --------
    >>> bench = mi.virtual_bench("coulomb")
    >>> campaign = mi.identify_on(bench, "bench", v_max=8, i_max=8)  # doctest: +SKIP
    """
    among(goal, ("distinguish", "sharpen"), "goal")
    at_least(1, records=records)
    positive(until=until, v_max=v_max, i_max=i_max, duration=duration)
    say, folder = progress or (lambda sentence: None), Path(folder)
    steps, runs, words, text = [], [], first, f"{records} records were not enough."
    for k in range(records):
        path = folder / f"record{k + 1}.csv"
        recording = record(bench, path, excite=words, limit_voltage=v_max, limit_current=i_max)
        runs.append(read_csv(path))
        found = diagnose(fit(dc_motor(), runs))
        left = _open(found, goal, until, parameters)
        say(f"record {k + 1}: {recording.ended}; {found.text.split('. ')[0]}. Open: {left or 'nothing'}.")
        steps.append(Step(words, recording.ended, found, left))
        if not left:
            return Campaign(tuple(steps), tuple(runs), True, f"Nothing is open after {k + 1} records.")
        if not recording.complete:
            text = f"Stopped: {recording.sentence}"
            break
        if k + 1 < records:
            try:
                design = design_experiment(found, goal=goal, parameters=parameters, v_max=v_max, i_max=i_max,
                                           duration=duration, **options)
            except FitError as error:
                text = f"Stopped: {error}"
                break
            steps[-1] = Step(words, recording.ended, found, left, design)
            words = design.excite
            say(design.text)
    return Campaign(tuple(steps), tuple(runs), False, text)


def _open(found: Diagnosis, goal: str, until: float, parameters: Sequence[str] | None) -> str:
    """Say what is still open; empty where the goal is reached."""
    if goal == "distinguish":
        return ", ".join(names_apart([f.model for f in found.rivals])) if len(found.rivals) > 1 else ""
    std, values = found.best.std, found.best.values
    asked = parameters or found.best.model.free_names
    return ", ".join(n for n in asked if n not in values or (s := std[n]) is None or s > until * abs(values[n]))
