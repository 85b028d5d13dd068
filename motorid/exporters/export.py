"""Taking a fitted model along: a file of CasADi functions, C source, JSON; and back."""

import contextlib
import json
import os
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from motorid.errors import DataError, MotoridError, UsageError, among
from motorid.estimation.result import SAVED, Fit
from motorid.estimation.shooting.outcome import Multiplier
from motorid.exporters.c_code import c_files
from motorid.exporters.casadi_file import casadi_file, description, model_of, read_casadi
from motorid.exporters.json_file import json_text
from motorid.model.definition import Effect
from motorid.model.model import Model
from motorid.numerics.parallel import one_thread
from motorid.numerics.signals import Array
from motorid.problem.plain_data import model_from_json, problem_of
from motorid.records.files import read_bytes, write_files

FORMS = {".casadi": "casadi", ".c": "c", ".json": "json"}
_CONTENTS: Mapping[str, Callable[[Fit | Model, Path], Mapping[Path, Any]]] = {
    "casadi": casadi_file, "c": c_files, "json": lambda found, path: {path: json_text(description(found))}}
NO_FMU = ("an FMU is not offered: those that CasADi 3.8.2 writes do not pass FMPy's checker (names of variables, "
          "initial unknowns), and FMPy simulates them with other trajectories. Take to='c' or to='casadi'.")
SAME = 1e-4  # relative difference of costs that machines and engines make
NOT_OURS = "it is no model or fit that motorid wrote"
MOSTLY_NOISE = "this fit is of records that are mostly noise: its values mean little; record again."


@dataclass(frozen=True, eq=False)
class Exported:
    """A ``.casadi`` file read back."""

    functions: Mapping[str, ca.Function]  # by name, see `motorid.exporters.casadi_file.functions_of`
    info: Mapping[str, Any]  # what ``fit --json`` holds, with covariance, fingerprints of the records and versions
    effects: Iterable[Effect] = ()  # of the user's own, as given to `load`

    @property
    def values(self) -> dict[str, float]:
        """Parameter values, SI."""
        return {n: p["value"] for n, p in self.info["parameters"].items()}

    @property
    def model(self) -> Model:
        """The model; ModelError if it has an effect that neither the library nor `effects` has."""
        return model_from_json(self.info, self.effects)

    def simulate(self, k: int = 0, u: Array | None = None) -> Array:
        """Return the outputs (N, ny) on record `k` of the fit, with its own inputs or others of the same length."""
        if f"simulate_{k}" not in self.functions:
            known = [n for n in self.functions if n.startswith("simulate_")]
            raise UsageError(f"no simulation of record {k} in this file; it has {', '.join(known) or 'none'}.")
        record = self.functions[f"record_{k}"]()
        drive = record["u"] if u is None else np.asarray(u, float).reshape(-1, record["u"].shape[0]).T
        return np.asarray(self.functions[f"simulate_{k}"](s=record["s"], u=drive, p=record["p"])["y"]).T


def export(found: Fit | Model | Exported, path: str | os.PathLike[str], to: str | None = None, *,
           force: bool = False) -> Path:
    """Write a fitted model in a form that works without motorid; return the file (of several, the main one).

    Parameters
    ----------
    found : Fit, Model or Exported
        A fit brings its uncertainty, its records' inputs and the very steps of its simulation along.
    path : path
        ``motor.casadi`` (CasADi alone reads it), ``motor.c`` or ``motor.json``. C makes ``motor.h``, ``motor_main.c``
        and the records ``motor_run0.csv`` … beside it.
    to : {"casadi", "c", "json"}, optional
        Default: by the ending of `path`.
    force : bool
        Also over files that motorid did not write.

    Raises
    ------
    UsageError, OutputError
        If the form is not known, or a file must not or cannot be written there.

    Examples
    --------
    >>> path = mi.export(better, "motor.casadi")
    >>> import casadi
    >>> file = casadi.FileDeserializer("motor.casadi")
    >>> functions = {f.name(): f for f in file.unpack()}
    >>> record = functions["record_0"]()
    >>> y = functions["simulate_0"](s=record["s"], u=record["u"], p=record["p"])["y"]  # (channels, samples)
    """
    target = Path(os.path.expanduser(path))
    form = to or FORMS.get(target.suffix.lower())
    if "fmu" in (form, target.suffix.lower().lstrip(".")):
        raise UsageError(NO_FMU)
    if form is None:
        raise UsageError(f"what to write is not clear from '{target.name}': end it with {', '.join(FORMS)}, or say "
                         "to='casadi'.")
    among(form, _CONTENTS, "form")
    found = found.model if isinstance(found, Exported) else found
    model_of(found)
    if isinstance(found, Fit) and found.mostly_noise:
        warnings.warn(MOSTLY_NOISE, stacklevel=2)
    with contextlib.suppress(OSError):  # said when it is written
        target.parent.mkdir(parents=True, exist_ok=True)
    return write_files(_CONTENTS[form](found, target), force)[0]


@one_thread
def load(path: str | os.PathLike[str], effects: Iterable[Effect] = (), *,
         trust: bool = False) -> Model | Exported | Fit:
    """Read back what `Fit.save` or `export` wrote. Nothing in the file is run.

    Parameters
    ----------
    path : path
        What `Fit.save` wrote gives the `Fit`, at its values, with its records: simulated, not fitted again. Other JSON
        gives the `Model` at its values, a ``.casadi`` file an `Exported`.
    effects : sequence of Effect, optional
        Effects of your own that the model uses.
    trust : bool
        Also take functions as CasADi serialized them (files that CasADi or an older motorid wrote). CasADi may then run
        commands or load libraries that the file names: only for files whose origin you know. Without it only
        arithmetic is built, from the JSON that `export` puts into a ``.casadi`` file.

    Raises
    ------
    DataError, ModelError
        If the file cannot be read, is none of these, or has an effect that is not known: the message says what to give.

    Examples
    --------
    >>> path = better.save("fit.json")
    >>> again = mi.load(path)  # a Fit, not fitted again
    >>> again.values == better.values
    True
    """
    if (source := Path(os.path.expanduser(path))).suffix.lower() in (".c", ".h"):
        raise UsageError(f"{source.name} goes to other programs; load reads .json and .casadi files.")
    if (data := read_bytes(source))[:1] == b"{":
        try:
            contents = json.loads(data)
        except (ValueError, RecursionError) as error:
            raise DataError(f"{source.name} is not JSON: {error}.") from None
        return _fit_of(contents, effects, source.name) if "fit" in contents else model_from_json(contents, effects)
    try:
        if not trust:
            return Exported(*read_casadi(data), tuple(effects))
        file = ca.FileDeserializer(str(source))
        return Exported({f.name(): f for f in file.unpack()}, json.loads(file.unpack()), tuple(effects))
    except (RuntimeError, ValueError, TypeError, AttributeError, LookupError):  # RecursionError is a RuntimeError
        other = source.suffix.lower() != ".casadi"
        raise DataError(f"cannot read {source.name}: {NOT_OURS}" + ("." if other else ", or an older version did. If "
                        "you know where it comes from, mi.load(path, trust=True) lets CasADi read it, and run what it "
                        "holds.")) from None


def _fit_of(contents: Mapping[str, Any], effects: Iterable[Effect], name: str) -> Fit:
    try:
        told = contents["fit"]
        problem = problem_of(contents["model"], told["problem"], effects)
        if (q := np.array(told["q"], float)).shape != problem.start.shape:
            raise ValueError("q")
        residuals, jac = problem.residual_and_jacobian(q)
        extra = {k: tuple(Multiplier(**m) for m in v) if k in ("multipliers", "active") else np.array(v, float)
                 if k == "free" else v for k, v in told["extra"].items()}
        plain: dict[str, Any] = {f: np.nan if told[f] is None else told[f] for f in SAVED}  # as JSON has it
        plain |= {"q": q, "history": tuple(told["history"]), "extra": extra}
        cost = float(told["cost"])
        found = Fit(problem, problem.values(q), residuals, jac / problem.scaling.slope(q), **plain)
    except MotoridError:
        raise
    except (ValueError, TypeError, AttributeError, LookupError, RuntimeError, OverflowError) as error:
        raise DataError(f"cannot read {name}: its fit is incomplete or wrong ({error}).") from None
    if not abs(found.cost - cost) <= SAME * abs(found.cost):
        warnings.warn(f"{name}: its model gives another error than when it was saved, so an effect has changed since. "
                      "Fit again: mi.fit(fit.model, fit.problem.experiments).", stacklevel=4)
    return found
