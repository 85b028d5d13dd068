"""The options that commands have in common, and what they become: records, a model, a fit.

`FitOptions` holds those of every command that fits, `ReadingOptions` those of every command that reads records;
`with_options` puts them on a command. Below them: effects and models from the user's files."""

import functools
import importlib.util
import inspect
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from motorid import effects as library
from motorid.channels import CHANNELS
from motorid.errors import ModelError, UsageError, among, looked_at
from motorid.estimation.fit import fit
from motorid.estimation.result import Fit
from motorid.estimation.shooting.multiple_shooting import MultipleShooting
from motorid.exporters.export import load
from motorid.model.definition import Effect
from motorid.model.model import Model, dc_motor, torque_driven
from motorid.numerics.least_squares import Huber
from motorid.numerics.parallel import interruption
from motorid.problem.constraints import CurrentLimit, SteadyState
from motorid.records.checks import as_command, check_runs, reading_notes
from motorid.records.experiment import Experiment
from motorid.records.headers import parse_pairs
from motorid.records.reading import read_runs

_reading = functools.partial(typer.Option, rich_help_panel="Reading")
_model = functools.partial(typer.Option, rich_help_panel="Model")
_solving = functools.partial(typer.Option, rich_help_panel="Estimation")
result = functools.partial(typer.Option, rich_help_panel="Results")

Runs = Annotated[list[str], typer.Argument(
    metavar="RUN", show_default=False, help="Records: files, directories or patterns.")]
Json = Annotated[str | None, result("--json", metavar="PATH", help="Write the result as JSON; - for standard output.")]
Report = Annotated[Path | None, result("--report", metavar="PATH.html", help="Write one page with figures.")]
Force = Annotated[bool, result("--force", help="Write over inputs and over files that motorid did not write.")]
Jobs = Annotated[int, result("--jobs", min=1, metavar="N", help="Processes that share the work.")]
EffectsFrom = Annotated[Path | None, typer.Option(metavar="FILE.py", help="Effects of your own.")]
Validate = Annotated[list[str] | None, result("--validate", metavar="RUN...",
    help="Held-out records, never fitted; put it after the records, since it takes all names that follow.")]


@dataclass(frozen=True)
class ReadingOptions:
    """How to read records."""

    columns: Annotated[str | None, _reading(metavar="t=…,v=…",
        help="Which column is which channel, where the header does not say: t=time,v=u_volt.")] = None
    units: Annotated[str | None, _reading(
        metavar="omega=rpm", help="Units of channels, where the header does not say.")] = None
    hold: Annotated[str | None, _reading(
        metavar="zoh|linear", help="The input between samples: constant (zoh) or linear.")] = None
    dt: Annotated[float | None, _reading(
        metavar="S", help="Seconds between samples of records without a column of time.")] = None
    median: Annotated[int | None, _reading(
        metavar="N", help="Running median over N samples (odd) of a voltage that was measured with noise.")] = None
    levels: Annotated[bool, _reading(
        "--levels", help="Mean between steps of a voltage that was measured with noise.")] = False
    delay: Annotated[float | None, _reading(
        metavar="S", help="Seconds by which the voltage acts later than its column says.")] = None
    no_spikes: Annotated[bool, _reading(
        "--no-spikes", help="Leave out single samples that stand far from both neighbours, of speed and angle two or "
        "three in a row, jumps that fade and zeros that failed, too.")] = False
    ignore: Annotated[str | None, _reading(metavar="i,theta", help="Measured channels to leave out.")] = None
    force: Force = False

    def read(self, paths: Sequence[str]) -> list[Experiment]:
        """Return the runs without the ignored channels, filtered, delayed and without spikes as asked."""
        runs, out = read_runs(paths, **self.reading), self._ignored
        kept = [r.without(*(c for c in out if c in r.outputs)) for r in runs]
        kept = [r.running_median(self.median) for r in kept] if self.median is not None else kept
        kept = [r.levelled() for r in kept] if self.levels else kept
        kept = [r.delayed(self.delay) for r in kept] if self.delay else kept
        return [r.without_spikes() for r in kept] if self.no_spikes else kept

    @property
    def reading(self) -> dict[str, Any]:
        """What was said for `read_runs`, as its keyword arguments."""
        named: dict[str, Any] = {k: parse_pairs(v, f"--{k}") for k in ("columns", "units") if (v := getattr(self, k))}
        if self.ignore:  # which of several columns it is does not matter then
            named["columns"] = {**dict.fromkeys(self._ignored), **named.get("columns", {})}
        return named | {k: v for k in ("hold", "dt") if (v := getattr(self, k)) is not None}

    @property
    def _ignored(self) -> list[str]:
        out = _words(self.ignore)
        for channel in out:
            among(channel, CHANNELS, "measured channel", where="--ignore: ")
        return out


@dataclass(frozen=True)
class DriveOptions(ReadingOptions):
    """How to read records, and what drives the motor in them."""

    drive: Annotated[str, _model(metavar="voltage|torque",
        help="torque: a drive that closes its own current loop; v is its command.")] = "voltage"

    def notes(self, runs: Sequence[Experiment], held_out: Sequence[Experiment] = ()) -> list[str]:
        """Return what a person should know about the records: how they were read, and what looks wrong."""
        among(self.drive, ("voltage", "torque"), "drive", where="--drive: ")
        said = reading_notes(runs)
        if self.drive == "torque":  # its command is no voltage of a winding, in volts or not
            said += ["the current i is not used: a torque-driven model has none."] * any("i" in r.outputs for r in runs)
            runs, held_out = (list(map(as_command, of)) for of in (runs, held_out))
        return [*said, *check_runs(runs, held_out)]


@dataclass(frozen=True)
class FitOptions(DriveOptions):
    """What a command that fits may be told: how to read, which model, how to estimate."""

    effects: Annotated[str | None, _model(metavar="a,b", help="Effects in the model beside the plain motor.")] = None
    fix: Annotated[list[str] | None, _model(
        metavar="R=1.2", help="Fix parameters at values (SI units); L=0 leaves the inductance out.")] = None
    set_: Annotated[list[str] | None, _model("--set", metavar="R=1.2", help="Values to start from (SI units).")] = None
    free: Annotated[list[str] | None, _model(metavar="g", help="Estimate parameters that are fixed by default.")] = None
    effects_from: Annotated[Path | None, _model(
        metavar="FILE.py", help="Python file with effects of your own (@mi.effect).")] = None
    solver: Annotated[str | None, _solving(
        metavar="lm|multiple-shooting", show_default=False, help="By default lm; multiple-shooting for hard.")] = None
    formulation: Annotated[str, _solving(metavar="plain|penalty|hard",
        help="Constraints beside the data: none, weighted penalties, or hard ones.")] = "plain"
    current_limit: Annotated[float | None, _solving(
        metavar="A", help="The current never exceeds this (penalty, hard).")] = None
    engine: Annotated[str, _solving(metavar="rosenbrock|cvodes|idas", help="Integrator.")] = "rosenbrock"
    initial: Annotated[str, _solving(
        metavar="STATE", help="The state at the first sample: auto, rest, measured or estimate.")] = "auto"
    window: Annotated[str, _solving(
        metavar="auto|none|SECONDS", help="Simulate the records in windows of so many seconds, each from an "
        "estimated state; auto: where small errors grow along the record.")] = "auto"
    loss: Annotated[str, _solving(metavar="squares|huber", help="huber: outliers count less.")] = "squares"

    def model(self, runs: Sequence[Experiment]) -> Model:
        """Return the model that was asked for."""
        self._check_words()
        own = own_effects(self.effects_from) if self.effects_from else {}
        model = dc_motor()
        if self.drive == "torque":
            linear = any(r.units.get("theta") == "m" or r.units.get("omega") == "m/s" for r in runs)
            model = torque_driven(axis="linear" if linear else "rotary")
        for name in _words(self.effects):
            model = model + named_effect(name, own)
        begin, fixed, free = _numbers(self.set_ or [], "--set"), _words(*(self.fix or ())), _words(*(self.free or ()))
        values = _numbers([w for w in fixed if "=" in w], "--fix")
        for option, others in (("--set", begin), ("--free", free)):
            if both := [n for n in values if n in others]:
                raise UsageError(f"{both[0]} is in --fix and in {option}: give it in one of them.")
        return model.replace(**begin).fix(*(w for w in fixed if "=" not in w), **values).free(*free)

    def keywords(self) -> dict[str, Any]:
        """Return the keyword arguments of `motorid.fit`; `model` has looked at the words."""
        hard = self.formulation == "hard"
        found: dict[str, Any] = {"engine": self.engine, "initial": self.initial,
                                 "loss": Huber() if self.loss == "huber" else None}
        if self.current_limit is not None or hard:
            limits = [CurrentLimit(self.current_limit)] if self.current_limit is not None else []
            # A plain penalty fit adds the steady state by itself only where no constraint is named.
            found["constraints"] = [*limits, SteadyState()] if self.formulation != "plain" else limits
        if hard or self.solver == "multiple-shooting":
            found["solver"] = MultipleShooting()
        found["formulation"] = "plain" if hard else self.formulation
        if self.window != "auto":
            expected = "a time; expected auto, none, or seconds, e.g. 0.5"
            found["window"] = None if self.window == "none" else _number(self.window, "--window", expected)
        return found

    def fit(self, runs: Sequence[Experiment]) -> Fit:
        """Fit the model to `runs`."""
        return fit(self.model(runs), runs, **self.keywords())

    def _check_words(self) -> None:
        for word, known, what in ((self.drive, ("voltage", "torque"), "drive"),
                                  (self.formulation, ("plain", "penalty", "hard"), "formulation"),
                                  (self.solver or "lm", ("lm", "multiple-shooting"), "solver"),
                                  (self.loss, ("squares", "huber"), "loss")):
            among(word, known, what, where=f"--{what}: ")
        if self.formulation == "hard" and self.solver == "lm":
            raise UsageError("--formulation hard needs --solver multiple-shooting: least squares has no true "
                             "constraints. Leave --solver out, or take --formulation penalty.")
        if self.formulation == "penalty" and self.solver == "multiple-shooting":
            raise UsageError("--formulation penalty is a least-squares problem: take --solver lm, or "
                             "--formulation hard for true constraints.")
        if self.current_limit is not None and self.formulation == "plain" and self.solver in (None, "lm"):
            raise UsageError("--current-limit needs --formulation penalty (weighted) or hard (a true limit).")


def with_options(kind: type) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command with a parameter ``options`` the fields of `kind` as options of its own."""

    def wrap(command: Callable[..., None]) -> Callable[..., None]:
        hints, own = get_type_hints(kind, include_extras=True), get_type_hints(command, include_extras=True)
        parts = [inspect.Parameter(f.name, inspect.Parameter.KEYWORD_ONLY, default=f.default,
                                   annotation=hints[f.name]) for f in fields(kind)]
        mine = [p.replace(annotation=own[p.name], kind=inspect.Parameter.KEYWORD_ONLY)
                for p in inspect.signature(command).parameters.values() if p.name != "options"]

        @functools.wraps(command)
        def run(**given: Any) -> None:
            taken = {f.name: given.pop(f.name) for f in fields(kind)}
            with looked_at():
                command(**given, options=kind(**taken))

        run.__signature__ = inspect.Signature([*parts, *mine])  # type: ignore[attr-defined]  # Typer reads it
        run.__annotations__ = {p.name: p.annotation for p in (*parts, *mine)}
        return run

    return wrap


def own_effects(path: Path) -> dict[str, Effect]:
    """Return the effects defined in a Python file, by name; a UsageError if it cannot be run or defines none."""
    if not (path := Path(os.path.expanduser(path))).is_file():
        raise UsageError(f"--effects-from: there is no file {path}.")
    name = f"motorid_own_{path.stem}"
    if (spec := importlib.util.spec_from_file_location(name, path)) is None or spec.loader is None:
        raise UsageError(f"--effects-from: {path} is not a Python file (*.py).")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # the laws are looked up there when a model goes to another process
    try:
        spec.loader.exec_module(module)
    except BaseException as error:  # whatever the user's own code raises
        if interruption.behind(error):
            raise
        raise UsageError(f"--effects-from: {path} cannot be run: {type(error).__name__}: {error}.") from None
    found = {e.name: e for e in vars(module).values() if isinstance(e, Effect) and library.EVERY.get(e.name) is not e}
    if not found:
        raise UsageError(f"--effects-from: {path} defines no effect of its own. Write a function and "
                         "decorate it with @mi.effect(balance=\"torque\").")
    return found


def named_effect(name: str, own: dict[str, Effect]) -> Effect:
    """Return an effect of the user's file, or of the library."""
    among(name, [*own, *library.EVERY], "effect", ModelError, "--effects: ")
    return {**library.EVERY, **own}[name]


def saved_model(path: Path, effects_from: Path | None = None) -> Model:
    """Return the model that ``fit --json`` or ``export`` wrote, at its values; see `load` for what it raises."""
    found = load(path, own_effects(effects_from).values() if effects_from else ())
    return found if isinstance(found, Model) else found.model


def make_folder(out: Path) -> None:
    """Make a folder for results, or raise a UsageError."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"cannot write to {out}: {error.strerror or error}. Choose another folder: --out "
                         "DIR") from None


def _words(*texts: str | None) -> list[str]:
    return [word for text in texts if text for part in text.split(",") if (word := part.strip())]


def _numbers(texts: Sequence[str], option: str) -> dict[str, float]:
    found: dict[str, float] = {}
    for text in texts:
        for name, value in parse_pairs(text, option).items():
            if name in found:
                raise UsageError(f"{option}: '{name}' is given twice, as {found[name]:g} and as {value}.")
            found[name] = _number(value, option, f"a number; expected e.g. {name}=1.2, in SI units")
    return found


def _number(text: str, option: str, expected: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise UsageError(f"{option}: '{text}' is not {expected}.") from None
