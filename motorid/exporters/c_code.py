"""A fitted model as C: source, header and an example program, with no dependency but the C library."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from motorid.errors import ModelError, SimulationError, printable
from motorid.estimation.result import Fit
from motorid.exporters.casadi_file import (
    description,
    functions_of,
    plain_functions,
    records_of,
    runs_of,
    simulation,
    system_of,
    values_of,
    words,
    zoh_inputs,
)
from motorid.model.model import Model
from motorid.numerics.signals import Array
from motorid.problem.problem import Problem
from motorid.problem.simulate import planned

ACCURATE = 1e-3  # of the span of an output, that the exported step may differ from the model
MOST_STEPS = 400_000  # on one record, to find that out

HEADER = """/* {title}
 *
{about}
 */
#ifndef {NAME}_H
#define {NAME}_H

#ifdef __cplusplus
extern "C" {{
#endif

/* States x, inputs u, outputs y, parameters p: SI units, in this order. */
{sizes}

extern const char* const {name}_state_names[{NAME}_NX];
extern const char* const {name}_input_names[{NAME}_NU];
extern const char* const {name}_output_names[{NAME}_NY];
extern const char* const {name}_parameter_names[{NAME}_NP];
extern const double {name}_parameters[{NAME}_NP];
extern const int {name}_held[{NAME}_NU]; /* 1: the input stays constant between samples, 0: straight lines */
{starts_declared}
/* x at the start from s = (current, speed, angle) there. */
void {name}_initial(const double s[3], const double* p, double* x);
/* dx/dt; of a balance without storage, the balance itself. */
void {name}_rhs(const double* x, const double* u, const double* p, double* dx);
/* What the sensors show. */
void {name}_outputs(const double* x, const double* u, const double* p, double* y);
/* x over dt in equal sub-steps, the input running from u0 to u1; with substeps < 1 as many as {NAME}_SUBSTEPS in
 * {NAME}_DT seconds. The step is L-stable, but quick states (bristles, a small inductance) need short ones:
 * {checked} */
#define {NAME}_DT {dt!r}
#define {NAME}_SUBSTEPS {substeps}
void {name}_step(double* x, const double* u0, const double* u1, double dt, int substeps, const double* p);

#ifdef __cplusplus
}}
#endif
#endif
"""

WRAPPER = """
#include "{name}.h"

const char* const {name}_state_names[{NAME}_NX] = {{{states}}};
const char* const {name}_input_names[{NAME}_NU] = {{{inputs}}};
const char* const {name}_output_names[{NAME}_NY] = {{{outputs}}};
const char* const {name}_parameter_names[{NAME}_NP] = {{{parameter_names}}};
const double {name}_parameters[{NAME}_NP] = {{
  {parameters}
}};
const int {name}_held[{NAME}_NU] = {{{held}}};
{starts}
static void {name}_call(int (*f)(const double**, double**, int*, double*, int), const double** given, int n_given,
                        double* result, double* other) {{
  const double* arg[{sz_arg}];
  double* res[{sz_res}];
  int iw[{sz_iw}];
  double w[{sz_w}];
  int k;
  for (k = 0; k < {sz_arg}; k++) arg[k] = k < n_given ? given[k] : 0;
  for (k = 0; k < {sz_res}; k++) res[k] = 0;
  res[0] = result;
  res[1] = other;
  f(arg, res, iw, w, 0);
}}

void {name}_initial(const double s[3], const double* p, double* x) {{
  const double* given[2];
  given[0] = s; given[1] = p;
  {name}_call({name}_f_initial, given, 2, x, 0);
}}

void {name}_rhs(const double* x, const double* u, const double* p, double* dx) {{
  const double* given[3];
  given[0] = x; given[1] = u; given[2] = p;
  {name}_call({name}_f_rhs, given, 3, dx, 0);
}}

void {name}_outputs(const double* x, const double* u, const double* p, double* y) {{
  const double* given[3];
  given[0] = x; given[1] = u; given[2] = p;
  {name}_call({name}_f_outputs, given, 3, y, 0);
}}

void {name}_step(double* x, const double* u0, const double* u1, double dt, int substeps, const double* p) {{
  double a[{NAME}_NU], b[{NAME}_NU], next[{NAME}_NX], error[{NAME}_NX], h;
  const double* given[5];
  int s, j;
  if (substeps < 1) substeps = (int)(dt / {NAME}_DT * {NAME}_SUBSTEPS + 0.999);
  if (substeps < 1) substeps = 1;
  h = dt / substeps;
  for (s = 0; s < substeps; s++) {{
    for (j = 0; j < {NAME}_NU; j++) {{
      a[j] = u0[j] + (u1[j] - u0[j]) * s / substeps;
      b[j] = u0[j] + (u1[j] - u0[j]) * (s + 1) / substeps;
    }}
    given[0] = x; given[1] = a; given[2] = b; given[3] = &h; given[4] = p;
    {name}_call({name}_f_step, given, 5, next, error);
    for (j = 0; j < {NAME}_NX; j++) x[j] = next[j];
  }}
}}
"""

MAIN = r"""/* Example, written by motorid: walk the model over a record.
 *
 *   cc -O2 {name}_main.c {name}.c -lm -o {name}
 *   ./{name} RECORD.csv [RUN] > out.csv
 *
 * RECORD.csv has one heading line, then per sample: time (s), the inputs, and the sub-steps to the next sample.
 * RUN counts the records of the fit from 0; it picks the state at the start (all zero where there is none).
 */
#include <stdio.h>
#include <stdlib.h>
#include "{name}.h"

static int read_row(FILE* file, double* t, double* u, int* substeps) {{
  int j;
  if (fscanf(file, "%lf", t) != 1) return 0;
  for (j = 0; j < {NAME}_NU; j++) if (fscanf(file, " ,%lf", &u[j]) != 1) return 0;
  return fscanf(file, " ,%d", substeps) == 1 && *substeps > 0;
}}

int main(int argc, char** argv) {{
  double s[3] = {{0, 0, 0}}, x[{NAME}_NX], y[{NAME}_NY], u[{NAME}_NU], v[{NAME}_NU], t, later;
  int run = argc > 2 ? atoi(argv[2]) : 0, m, next, j, c;
  FILE* file = argc > 1 ? fopen(argv[1], "r") : 0;
  if (!file) {{ fprintf(stderr, "usage: %s RECORD.csv [RUN]\n", argv[0]); return 2; }}
  while ((c = fgetc(file)) != '\n' && c != EOF) {{}}
#ifdef {NAME}_RUNS
  if (run < 0 || run >= {NAME}_RUNS) {{ fprintf(stderr, "runs are 0 to %d\n", {NAME}_RUNS - 1); return 2; }}
  for (j = 0; j < 3; j++) s[j] = {name}_starts[run][j];
#else
  (void)run;
#endif
  if (!read_row(file, &t, u, &m)) {{ fprintf(stderr, "%s has no rows of t, inputs, sub-steps\n", argv[1]); return 2; }}
  {name}_initial(s, {name}_parameters, x);
  printf("t");
  for (j = 0; j < {NAME}_NY; j++) printf(",%s", {name}_output_names[j]);
  for (;;) {{
    {name}_outputs(x, u, {name}_parameters, y);
    printf("\n%.17g", t);
    for (j = 0; j < {NAME}_NY; j++) printf(",%.17g", y[j]);
    if (!read_row(file, &later, v, &next)) break;
    {{
      double end[{NAME}_NU];
      for (j = 0; j < {NAME}_NU; j++) end[j] = {name}_held[j] ? u[j] : v[j];
      {name}_step(x, u, end, later - t, m, {name}_parameters);
    }}
    for (j = 0; j < {NAME}_NU; j++) u[j] = v[j];
    t = later; m = next;
  }}
  printf("\n");
  fclose(file);
  return 0;
}}
"""


def c_files(found: Fit | Model, path: Path) -> dict[Path, str]:
    """Return ``NAME.c``, ``NAME.h``, ``NAME_main.c``, and of a fit its records ``NAME_run0.csv`` …, by their paths.

    NAME is the stem of `path`, made a C identifier. See the header for the functions.
    """
    name = identifier(path.stem)
    folder = path.parent
    fields = _fields(found, name)
    source = f"/* {fields['title']}, written by motorid */\n" + fields["generated"] + WRAPPER.format_map(fields)
    files = {f"{name}.c": source, f"{name}.h": HEADER.format_map(fields), f"{name}_main.c": MAIN.format_map(fields)}
    if isinstance(found, Fit):
        for k, (run, _) in enumerate(runs_of(found)):
            files[f"{name}_run{k}.csv"] = _record(run.grid, found.problem.system.inputs)
    return {folder / file: text for file, text in files.items()}


class Checked(NamedTuple):
    """Sub-steps per `dt` (s) with which the exported step agrees with the model, and how well, in words."""

    dt: float
    substeps: int
    text: str


@lru_cache(maxsize=1)
def check(found: Fit | Model) -> Checked:
    """Walk the exported step over the records of a fit (of a model: over a falling square wave), in equal sub-steps,
    twice as many until it agrees with the simulation to `ACCURATE` of the span of each output."""
    functions = {f.name(): f for f in functions_of(found)}
    p = functions["parameters"]()["p"]
    if isinstance(found, Fit):
        records, what = records_of(found)[:3], "the records of the fit"
    else:
        t: Array = np.arange(2000) / 1e3
        v = 12.0 if found.base == "dc_motor" else 1.0
        what = f"a square wave that falls from ±{v:g} to 0 in 2 s, sampled at 1 ms"
        try:
            plan = planned(found, t, v * (1 - t / 2) ** 2 * np.sign(np.sin(16 * t + 0.1)),
                           channels=system_of(found).outputs)
            problem = Problem(found.fix(*found.parameters), (plan,), initial="rest")
            records = records_of(problem.refined(problem.start))
        except (SimulationError, ModelError):
            return Checked(1e-3, 1, f"not checked, since the model cannot follow {what}.")
    dt = float(np.median(np.diff(records[0]["t"])))
    for m in (2**k for k in range(11)):
        error = max(_error(functions, r, m, p) for r in records)
        if error < ACCURATE:
            break
    return Checked(dt, m, f"with {m} in {dt:.3g} s it differs from the model by at most {error:.2g} of the span, "
                          f"on {what}.")


def _error(functions: Mapping[str, ca.Function], record: Mapping[str, Any], m: int, p: ca.DM) -> float:
    """Return the largest difference of an output between `m` sub-steps and those of the record, over its span."""
    n = max(min(len(record["t"]), MOST_STEPS // m), 2)
    t, u, fine = np.array(record["t"][:n]), np.array(record["u"])[:, :n], np.array(record["substeps"][:n - 1])
    y, told = (np.array(simulation("walk", functions, t, k, record["held"])(record["s"], u, p)[0])
               for k in (np.full(n - 1, m), fine))
    span = np.maximum(np.ptp(told, axis=1), 1e-300)
    error = float((np.abs(y - told).max(axis=1) / span).max())
    return error if np.isfinite(error) else np.inf


def identifier(stem: str) -> str:
    """Return a C identifier like `stem`."""
    name = re.sub(r"[\W_]+", "_", stem, flags=re.ASCII).strip("_")  # CasADi takes no two underscores in a row
    return name if name[:1].isalpha() else f"motor_{name}".rstrip("_")


def _fields(found: Fit | Model, name: str) -> dict[str, Any]:
    system = system_of(found)
    functions = plain_functions(system, f"{name}_f_")
    code = ca.CodeGenerator("model", {"casadi_int": "int", "casadi_real": "double", "with_header": False})
    for f in functions:
        code.add(f)
    sizes = dict(zip(("NX", "NU", "NP", "NY"), system.sizes, strict=True))
    starts = [s for _, s in runs_of(found)] if isinstance(found, Fit) else []
    held = zoh_inputs(system.inputs, found.problem.experiments[0]) if isinstance(found, Fit) else [
        n != "theta_in" for n in system.inputs]
    runs = f"#define {name.upper()}_RUNS {len(starts)}\n" if starts else ""
    checked = check(found)
    return {
        "checked": checked.text, "dt": checked.dt, "substeps": checked.substeps,
        "name": name, "NAME": name.upper(), "title": f"{name}: a motor model as C", "generated": code.dump(),
        "about": "\n".join(f" * {_harmless(line)}".rstrip() for line in words(description(found))),
        "sizes": "\n".join(f"#define {name.upper()}_{k} {v}" for k, v in sizes.items()),
        "states": _strings(system.states), "inputs": _strings(system.inputs), "outputs": _strings(system.outputs),
        "parameter_names": _strings(system.parameters), "held": ", ".join(str(int(h)) for h in held),
        "parameters": ",\n  ".join(f"{v!r}" for v in values_of(found, system).tolist()),
        "starts_declared": f"{runs}extern const double {name}_starts[{len(starts)}][3];"
                           " /* (current, speed, angle) at the start of the records of the fit */\n" if starts else "",
        "starts": _starts(name, starts),
        **{size: max(least, *(getattr(f, size)() for f in functions))
           for size, least in (("sz_arg", 1), ("sz_res", 2), ("sz_iw", 1), ("sz_w", 1))},
    }


def _strings(names: Sequence[str]) -> str:
    return ", ".join('"' + re.sub(r'["\\?\s]', "_", printable(n)) + '"' for n in names)


def _harmless(line: str) -> str:
    """Return text that cannot end a comment or continue a line: names of runs come from files."""
    return re.sub(r"[*/\\?]{2,}", "_", printable(" ".join(line.split()))).rstrip("\\")


def _starts(name: str, starts: Sequence[np.ndarray]) -> str:
    if not starts:
        return ""
    rows = ",\n".join("  {" + ", ".join(repr(v) for v in s.tolist()) + "}" for s in starts)
    return f"const double {name}_starts[{len(starts)}][3] = {{\n{rows}\n}};\n"


def _record(grid: Any, inputs: Sequence[str]) -> str:
    substeps = np.append(grid.substeps, 1)
    rows = [",".join([repr(t), *map(repr, u), str(m)])
            for t, u, m in zip(grid.t.tolist(), grid.u.tolist(), substeps.tolist(), strict=True)]
    return "\n".join([",".join(["t", *inputs, "substeps"]), *rows, ""])
