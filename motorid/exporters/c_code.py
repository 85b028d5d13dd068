"""A fitted model as C: source, header and an example program, with no dependency but the C library."""

import re
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from motorid.errors import ModelError, SimulationError, printable
from motorid.estimation.result import Fit
from motorid.exporters import casadi_file
from motorid.model.model import Model
from motorid.numerics.signals import Array
from motorid.problem.problem import Problem
from motorid.problem.runs import zoh_inputs
from motorid.problem.simulate import planned

ACCURATE = 1e-3  # of the span of an output, that the exported step may differ from the model
MOST_STEPS = 400_000  # on one record, to find that out
TEMPLATES = Path(__file__).with_name("templates")  # C with $names


def c_files(found: Fit | Model, path: Path) -> dict[Path, str]:
    """Return ``NAME.c``, ``NAME.h``, ``NAME_main.c`` and a fit's records, by their paths; the header tells the rest."""
    name = identifier(path.stem)
    fields = _fields(found, name)
    files = {path.with_name(f"{name}{ending}"): Template((TEMPLATES / file).read_text("utf-8")).substitute(fields)
             for ending, file in ((".c", "model.c"), (".h", "model.h"), ("_main.c", "main.c"))}
    if isinstance(found, Fit):
        files |= {path.with_name(f"{name}_run{k}.csv"): _record(run.grid, found.problem.system.inputs)
                  for k, (run, *_) in enumerate(casadi_file.runs_of(found.problem, found.q))}
    return files


class Checked(NamedTuple):
    """Sub-steps per `dt` (s) with which the exported step agrees with the model, and how well, in words."""

    dt: float
    substeps: int
    text: str


@lru_cache(maxsize=1)
def check(found: Fit | Model) -> Checked:
    """Walk the exported step over the records of a fit (of a model: over a falling square wave), in equal sub-steps,
    twice as many until it agrees with the simulation to `ACCURATE` of the span of each output."""
    functions = {f.name(): f for f in casadi_file.functions_of(found)}
    if isinstance(found, Fit):
        records, what = casadi_file.records_of(found)[:3], "the records of the fit"
    else:
        t: Array = np.arange(2000) / 1e3
        v = 12.0 if found.base == "dc_motor" else 1.0
        what = f"a square wave that falls from ±{v:g} to 0 in 2 s, sampled at 1 ms"
        try:
            plan = planned(found, t, v * (1 - t / 2) ** 2 * np.sign(np.sin(16 * t + 0.1)),
                           channels=casadi_file.system_of(found).outputs)
            problem = Problem(found.fix(*found.parameters), (plan,), initial="rest")
            records = casadi_file.records_of(problem.refined(problem.start))
        except (SimulationError, ModelError):
            return Checked(1e-3, 1, f"not checked, since the model cannot follow {what}.")
    dt = float(np.median(np.diff(records[0]["t"])))
    for m in (2**k for k in range(11)):
        if (error := max(_error(functions, r, m) for r in records)) < ACCURATE:
            break
    return Checked(dt, m, f"with {m} in {dt:.3g} s it differs from the model by at most {error:.2g} of the span, "
                          f"on {what}.")


def _error(functions: Mapping[str, ca.Function], record: Mapping[str, Any], m: int) -> float:
    """Return the largest difference of an output between `m` sub-steps and those of the record, over its span."""
    n = max(min(len(record["t"]), MOST_STEPS // m), 2)
    t, u, fine = np.array(record["t"][:n]), np.array(record["u"])[:, :n], np.array(record["substeps"][:n - 1])
    way = np.tile(1.0 - np.array(record["held"], float), (n - 1, 1))
    y, told = (np.array(casadi_file.simulation("walk", functions, t, k, way)(record["s"], u, record["p"])[0])
               for k in (np.full(n - 1, m), fine))
    error = float((np.abs(y - told).max(axis=1) / np.maximum(np.ptp(told, axis=1), 1e-300)).max())
    return error if np.isfinite(error) else np.inf


def identifier(stem: str) -> str:
    """Return a C identifier like `stem`."""
    name = re.sub(r"[\W_]+", "_", stem, flags=re.ASCII).strip("_")  # CasADi takes no two underscores in a row
    return name if name[:1].isalpha() else f"motor_{name}".rstrip("_")


def _fields(found: Fit | Model, name: str) -> dict[str, Any]:
    system, about = casadi_file.system_of(found), casadi_file.words(casadi_file.description(found))
    functions = casadi_file.plain_functions(system, f"{name}_f_")
    code = ca.CodeGenerator("model", {"casadi_int": "int", "casadi_real": "double", "with_header": False})
    for f in functions:
        code.add(f)
    sizes = dict(zip(("NX", "NU", "NP", "NY"), system.sizes, strict=True))
    own = [own for _, *own in casadi_file.runs_of(found.problem, found.q)] if isinstance(found, Fit) else []
    held = zoh_inputs(system.inputs, found.problem.experiments[0].hold if isinstance(found, Fit) else "zoh")
    starts, parameters = (",\n".join("  {" + ", ".join(map(repr, run[j].tolist())) + "}" for run in own)
                          for j in (0, 1))
    runs, size = f"#define {name.upper()}_RUNS {len(own)}\n" if own else "", f"[{len(own)}][{name.upper()}_NP]"
    checked = check(found)  # names of runs come from files: none may end a comment or continue a line
    harmless = (re.sub(r"[*/\\?]{2,}", "_", printable(" ".join(line.split()))).rstrip("\\") for line in about)
    return {
        "checked": checked.text, "dt": checked.dt, "substeps": checked.substeps,
        "name": name, "NAME": name.upper(), "title": f"{name}: a motor model as C", "generated": code.dump(),
        "about": "\n".join(f" * {line}".rstrip() for line in harmless),
        "sizes": "\n".join(f"#define {name.upper()}_{k} {v}" for k, v in sizes.items()),
        "states": _strings(system.states), "inputs": _strings(system.inputs), "outputs": _strings(system.outputs),
        "parameter_names": _strings(system.parameters), "held": ", ".join(str(int(h)) for h in held),
        "parameters": ",\n  ".join(f"{v!r}" for v in casadi_file.values_of(found, system).tolist()),
        "starts_declared": f"{runs}extern const double {name}_starts[{len(own)}][3];"
                           " /* (current, speed, angle) at the start of the records of the fit */\n"
                           f"extern const double {name}_run_parameters{size};\n" if own else "",
        "starts": f"const double {name}_starts[{len(own)}][3] = {{\n{starts}\n}};\n"
                  f"const double {name}_run_parameters{size} = {{\n{parameters}\n}};\n"
                  if own else "",
        **{size: max(least, *(getattr(f, size)() for f in functions))
           for size, least in (("sz_arg", 1), ("sz_res", 2), ("sz_iw", 1), ("sz_w", 1))}}


def _strings(names: Sequence[str]) -> str:
    return ", ".join('"' + re.sub(r'["\\?\s]', "_", printable(n)) + '"' for n in names)


def _record(grid: Any, inputs: Sequence[str]) -> str:
    rows = [",".join([repr(t), *map(repr, u), str(m)])
            for t, u, m in zip(grid.t.tolist(), grid.u.tolist(), np.append(grid.substeps, 1).tolist(), strict=True)]
    return "\n".join([",".join(["t", *inputs, "substeps"]), *rows, ""])
