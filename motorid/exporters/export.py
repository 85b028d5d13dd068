"""Taking a fitted model along: a file of CasADi functions, C source, JSON; and back."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from motorid.effects import EVERY
from motorid.errors import DataError, ModelError, UsageError, one_of
from motorid.estimation.result import Fit
from motorid.exporters.c_code import c_files
from motorid.exporters.casadi_file import casadi_file, description, model_of, read_casadi
from motorid.exporters.json_file import json_text
from motorid.model.definition import Effect
from motorid.model.model import Model, dc_motor, torque_driven
from motorid.numerics.signals import Array
from motorid.records.files import read_bytes, write_files

FORMS = {".casadi": "casadi", ".c": "c", ".json": "json"}
NO_FMU = ("an FMU is not offered: those that CasADi 3.8.2 writes do not pass FMPy's checker (names of variables, "
          "initial unknowns), and FMPy simulates them with other trajectories. Take to='c' or to='casadi'.")
NOT_OURS = "it is not a file that mi.export wrote"


@dataclass(frozen=True, eq=False)
class Exported:
    """A ``.casadi`` file read back.

    Attributes
    ----------
    functions : dict of str to casadi.Function
        ``rhs``, ``outputs``, ``initial``, ``step``, ``parameters``; per record of the fit ``record_k`` and
        ``simulate_k``. See `export`.
    info : dict
        What ``fit --json`` holds, with covariance, fingerprints of the records and versions.
    """

    functions: Mapping[str, ca.Function]
    info: Mapping[str, Any]

    @property
    def values(self) -> dict[str, float]:
        """Parameter values, SI."""
        return {n: p["value"] for n, p in self.info["parameters"].items()}

    @property
    def model(self) -> Model:
        """The model, if all its effects are in the library; else see `model_from_json`."""
        return model_from_json(self.info)

    def simulate(self, k: int = 0, u: Array | None = None) -> Array:
        """Return the outputs (N, ny) on record `k` of the fit, with its own inputs or others of the same length."""
        if f"simulate_{k}" not in self.functions:
            known = [n for n in self.functions if n.startswith("simulate_")]
            raise UsageError(f"no simulation of record {k} in this file; it has {', '.join(known) or 'none'}.")
        record = self.functions[f"record_{k}"]()
        drive = record["u"] if u is None else np.asarray(u, float).reshape(-1, record["u"].shape[0]).T
        found = self.functions[f"simulate_{k}"](s=record["s"], u=drive, p=self.functions["parameters"]()["p"])
        return np.asarray(found["y"]).T


def export(found: Fit | Model | Exported, path: str | os.PathLike[str], to: str | None = None, *,
           force: bool = False) -> Path:
    """Write a fitted model in a form that works without motorid.

    Parameters
    ----------
    found : Fit, Model or Exported
        A fit brings its uncertainty, its records' inputs and the very steps of its simulation along.
    path : path
        ``motor.casadi``, ``motor.c`` or ``motor.json``. C makes ``motor.h``, ``motor_main.c`` and
        the records ``motor_run0.csv`` … beside it.
    to : {"casadi", "c", "json"}, optional
        Default: by the ending of `path`.
    force : bool
        Also over files that motorid did not write.

    Returns
    -------
    Path
        The file written (of several, the main one).

    Notes
    -----
    A ``.casadi`` file is read with CasADi alone::

        file = casadi.FileDeserializer("motor.casadi") functions, about = {f.name(): f for f in file.unpack()},
        file.unpack() record, p = functions["record_0"](), functions["parameters"]()["p"] y =
        functions["simulate_0"](s=record["s"], u=record["u"], p=p)["y"]

    Raises
    ------
    UsageError
        If the form is not known, or a file must not be written there.
    OutputError
        If the disk refuses.
    """
    target = Path(path).expanduser()
    form = to or FORMS.get(target.suffix.lower())
    if "fmu" in (form, target.suffix.lower().lstrip(".")):
        raise UsageError(NO_FMU)
    if form is None:
        raise UsageError(f"what to write is not clear from '{target.name}': end it with {', '.join(FORMS)}, or say "
                         "to='casadi'.")
    if form not in _CONTENTS:
        raise UsageError(one_of(form, _CONTENTS, "form"))
    if isinstance(found, Exported):
        found = found.model
    model_of(found)
    with contextlib.suppress(OSError):  # said when it is written
        target.parent.mkdir(parents=True, exist_ok=True)
    return write_files(_CONTENTS[form](found, target), force)[0]


def _json_file(found: Fit | Model, path: Path) -> dict[Path, str]:
    return {path: json_text(description(found))}


_CONTENTS: Mapping[str, Callable[[Fit | Model, Path], Mapping[Path, Any]]] = {
    "casadi": casadi_file, "c": c_files, "json": _json_file}


def load(path: str | os.PathLike[str], effects: Iterable[Effect] = (), *, trust: bool = False) -> Model | Exported:
    """Read back what `export` wrote. Nothing in the file is run.

    Parameters
    ----------
    path : path
        JSON gives the `Model` at its values, a ``.casadi`` file an `Exported`.
    effects : sequence of Effect, optional
        Effects of your own that the model uses.
    trust : bool
        Also take functions as CasADi serialized them (files that CasADi or an older motorid wrote). CasADi may then run
        commands or load libraries that the file names: only for files whose origin you know. Without it only
        arithmetic is built, from the JSON that `export` puts into a ``.casadi`` file.

    Raises
    ------
    DataError
        If the file cannot be read, or is none of these.
    ModelError
        If an effect is not known; the message says what is needed.
    """
    source = Path(path).expanduser()
    if source.suffix.lower() in (".c", ".h"):
        raise UsageError(f"{source.name} goes to other programs; load reads .json and .casadi files.")
    data = read_bytes(source)
    if data[:1] == b"{":
        try:
            contents = json.loads(data)
        except (ValueError, RecursionError) as error:
            raise DataError(f"{source.name} is not JSON: {error}.") from None
        return model_from_json(contents, effects)
    try:
        return Exported(*(_serialized(source) if trust else read_casadi(data)))
    except (RuntimeError, ValueError, TypeError, AttributeError, LookupError):  # RecursionError is a RuntimeError
        raise DataError(f"cannot read {source.name}: {NOT_OURS}, or an older version did. If you know where it comes "
                        "from, mi.load(path, trust=True) lets CasADi read it, and run what it holds.") from None


def _serialized(source: Path) -> tuple[dict[str, ca.Function], dict[str, Any]]:
    file = ca.FileDeserializer(str(source))
    functions = file.unpack()
    return {f.name(): f for f in functions}, json.loads(file.unpack())


def model_from_json(contents: Mapping[str, Any], effects: Iterable[Effect] = ()) -> Model:
    """Return the `Model`, at its values, of what ``fit --json`` or `export` wrote.

    Parameters
    ----------
    contents : mapping
        Needs ``model.base``, ``model.effects`` and ``parameters``; more does no harm.
    effects : sequence of Effect, optional
        Effects of your own that the model uses; they go before the library's of the same name.

    Raises
    ------
    DataError
        If something is missing in `contents`.
    ModelError
        If an effect is not known.
    """
    try:
        head, pars = dict(contents["model"]), dict(contents["parameters"])
        base, names, about = head["base"], [str(n) for n in head["effects"]], dict(head.get("own_effects", {}))
        values = {n: float(p["value"]) for n, p in pars.items()}
        fixed_names = [n for n, p in pars.items() if p["fixed"]]
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"this is not a fitted model: {error!s} is missing or wrong; expected model.base, "
                        "model.effects and parameters with value and fixed.") from None
    model = _base(base, head.get("axis", "rotary"))
    own = {e.name: e for e in effects}
    for name in names:
        model = model + _effect(name, own, about.get(name))
    missing = set(model.parameters) ^ set(values)
    if missing:
        raise DataError(f"the parameters {', '.join(sorted(missing))} are in only one of the file and the model: an "
                        "effect has changed since the file was written.")
    limits = {n: (p.get("lower", -np.inf), p.get("upper", np.inf)) for n, p in pars.items()
              if "lower" in p or "upper" in p}
    fixed = {n: values[n] for n in fixed_names}  # first: what is fixed may be zero, what is free may not
    free = {n: v for n, v in values.items() if n not in fixed}
    return model.fix(**fixed).replace(**free).bounded(**limits).free(*free)


def _base(base: str, axis: str) -> Model:
    if base == "dc_motor":
        return dc_motor()
    if base == "torque_driven":
        return torque_driven(axis)
    raise DataError(one_of(str(base), ("dc_motor", "torque_driven"), "base"))


def _effect(name: str, own: Mapping[str, Effect], about: Mapping[str, Any] | None) -> Effect:
    if name in own:
        return own[name]
    if about is not None:
        raise ModelError(f"the effect '{name}' is not in the library: it was defined in {about['defined_in']}, acts on "
                         f"the {about['balance']} and takes {', '.join(about['parameters'])}. Define it again and "
                         f"pass it on: mi.load(path, effects=[{name}]).")
    if name not in EVERY:
        raise ModelError(f"{one_of(name, EVERY, 'effect')} If it is one of your own, pass it on: "
                         f"mi.load(path, effects=[{name}]).")
    return EVERY[name]
