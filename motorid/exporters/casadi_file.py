"""A fitted model as plain CasADi functions, and what travels with it: values, uncertainty, data, versions."""

import hashlib
import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from motorid.errors import UsageError
from motorid.estimation.result import Fit
from motorid.exporters.json_file import fit_dict
from motorid.integrate.rodas3 import StepFunctions
from motorid.model.equations import System
from motorid.model.model import SHOWN, Model
from motorid.numerics.signals import Array
from motorid.problem.plain_data import model_dict
from motorid.problem.problem import Problem
from motorid.problem.runs import Run, zoh_inputs
from motorid.records.experiment import Experiment
from motorid.records.files import package_version

FORMAT = 1
MOST_RUNS = 20  # of a fit, that travel along as whole simulations
MOST_SCALARS = 10_000_000  # in one function or record of a file that is read
PLAIN = "\nmotorid: the same as JSON, which CasADi does not read\n"
UNARY, BINARY = (frozenset(f"OP_{n}" for n in names.split()) for names in (
    "NEG EXP LOG SQRT SQ TWICE SIN COS TAN ASIN ACOS ATAN NOT FLOOR CEIL FABS SIGN ERF INV SINH COSH TANH ASINH ACOSH "
    "ATANH ERFINV LOG1P EXPM1",
    "ADD SUB MUL DIV POW CONSTPOW LT LE EQ NE AND OR FMOD REMAINDER COPYSIGN IF_ELSE_ZERO FMIN FMAX ATAN2 HYPOT"))


def model_of(found: Fit | Model) -> Model:
    """Return the model at its values; UsageError if `found` is neither a fit nor a model."""
    if not isinstance(found, Fit | Model):
        raise UsageError(f"a fit or a model can be exported, not {type(found).__name__}: mi.export(fit, path).")
    return found.model if isinstance(found, Fit) else found


def system_of(found: Fit | Model) -> System:
    """Return the model's functions for the channels of the fit; of a model, for all that it can show."""
    return found.problem.system if isinstance(found, Fit) else found.system(SHOWN[found.base])


def values_of(found: Fit | Model, system: System) -> Array:
    """Return p (np,) in the order of the system."""
    return np.array([*map(model_of(found).values.__getitem__, system.parameters)])


def description(found: Fit | Model) -> dict[str, Any]:
    """Return all that is known of the model as plain data: ``fit --json``, and what builds it again."""
    model, version = model_of(found), package_version("motorid")
    if isinstance(found, Fit):
        covariance = {"unknowns": [p.name for p in found.problem.unknown], "matrix": found.covariance.tolist()}
        contents = fit_dict(found) | {"model": model_dict(model), "covariance": covariance,
                                      "data": [fingerprint(r) for r in found.problem.experiments]}
    else:
        contents = {"model": model_dict(model), "data": [], "parameters": {n: {"value": p.value, "std": None,
            "unit": p.unit, "fixed": not p.vary} for n, p in model.parameters.items()}}
    for name, p in model.parameters.items():
        contents["parameters"][name] |= {k: v for k in ("lower", "upper") if np.isfinite(v := getattr(p, k))}
    return contents | {"motorid": version, "export": FORMAT, "order": list(system_of(found).parameters), "versions": {
        "motorid": version, "casadi": ca.CasadiMeta.version(), "numpy": np.__version__,
        "python": platform.python_version()}}


def fingerprint(run: Experiment) -> dict[str, Any]:
    """Return what identifies a record: name, samples, channels, SHA-256 of its numbers."""
    mark = hashlib.sha256(run.t.tobytes())
    for name, a in (*sorted(run.inputs.items()), *sorted(run.outputs.items())):
        mark.update(name.encode() + a.tobytes())
    return {"name": run.name, "samples": run.n, "channels": list(run.channels), "sha256": mark.hexdigest()}


def functions_of(found: Fit | Model) -> list[ca.Function]:
    """Return the model as CasADi functions that need nothing but CasADi.

    ``rhs(x, u, p)``, ``outputs(x, u, p)``, ``initial(s, p)`` with s = (i, omega, theta) at the start,
    ``step(x, u0, u1, h, p)`` (the input runs from u0 to u1 over h), ``parameters()``; of a fit also, per record,
    ``record_k()`` (t, s, u, p) and ``simulate_k(s, u, p)`` with the very steps of the fit. Columns are samples."""
    system = system_of(found)
    functions = [*plain_functions(system), ca.Function("parameters", [], [ca.DM(values_of(found, system))], [], ["p"])]
    return [*functions, *_simulations({f.name(): f for f in functions}, records_of(found))]


def plain_functions(system: System, prefix: str = "") -> list[ca.Function]:
    """Return ``rhs``, ``outputs``, ``initial`` and ``step``, see `functions_of`, with dense results."""
    sparse = {"rhs": system.rhs, "outputs": system.out, "initial": system.initial, "step": StepFunctions(system).light}
    return [ca.Function(f"{prefix}{name}", args := f.sx_in(), [ca.densify(r) for r in f.call(args)], f.name_in(),
                        f.name_out()) for name, f in sparse.items()]


def casadi_file(found: Fit | Model, path: Path) -> dict[Path, str]:
    """Return the contents of a ``.casadi`` file: functions and a text; for `read_casadi`, which runs none, as JSON."""
    functions, about = functions_of(found), description(found)
    file = ca.StringSerializer({})
    file.pack(functions)
    file.pack(json.dumps(about))
    plain = {"functions": [_instructions(f) for f in functions[:4]], "records": records_of(found)}
    return {path: f"{file.encode()}{PLAIN}{json.dumps({**plain, **about})}\n"}


def read_casadi(data: bytes) -> tuple[dict[str, ca.Function], dict[str, Any]]:
    """Return functions and description from the JSON in a ``.casadi`` file; CasADi's own part is not looked at. Raises
    ValueError, TypeError, AttributeError, LookupError or RuntimeError if there is none, or nonsense."""
    _, found, text = data.rpartition(PLAIN.encode())
    if not found:
        raise KeyError("JSON")
    about = json.loads(text)
    functions = {f.name(): f for f in map(_rebuilt, about.pop("functions"))}
    p = [about["parameters"][n]["value"] for n in about["order"]]
    functions["parameters"] = ca.Function("parameters", [], [ca.DM(p)], [], ["p"])
    return functions | {f.name(): f for f in _simulations(functions, about.pop("records"))}, about


def records_of(found: Fit | Model | Problem) -> list[dict[str, Any]]:
    """Return the records of a fit or problem as plain data: samples, start, inputs (nu, N), sub-steps, parameters."""
    if isinstance(found, Model):
        return []
    problem, q = (found.problem, found.q) if isinstance(found, Fit) else (found, found.start)
    inputs = problem.system.inputs
    return [{"t": run.grid.t.tolist(), "s": start.tolist(), "p": p.tolist(), "u": run.grid.u.T.tolist(),
             "substeps": run.grid.substeps.tolist(), "held": (held := zoh_inputs(inputs, run.experiment.hold)),
             "way": [[*map(int, at), float(run.grid.way[*at])] for at in np.argwhere(run.grid.way * held)]}
            for run, start, p in runs_of(problem, q)[:MOST_RUNS]]


def _instructions(f: ca.Function) -> dict[str, Any]:
    """Return a function of scalars as plain data: shapes, and its elementary operations in their order."""
    names = {getattr(ca, n): n for n in dir(ca) if n.startswith("OP_")}
    code = [[names[op], f.instruction_constant(k) if op == ca.OP_CONST else None, f.instruction_input(k),
             f.instruction_output(k)] for k in range(f.n_instructions()) for op in [f.instruction_id(k)]]
    return {"name": f.name(), "code": code, "size": f.sz_w(),
            "in": [[f.name_in(k), f.size1_in(k)] for k in range(f.n_in())],
            "out": [[f.name_out(k), f.size1_out(k)] for k in range(f.n_out())]}


def _rebuilt(told: Mapping[str, Any]) -> ca.Function:
    """Return the function that `_instructions` told; of the operations only arithmetic is known."""
    args = [ca.SX.sym(name, _bounded(n)) for name, n in told["in"]]
    results = [[ca.SX(0.0)] * _bounded(n) for _, n in told["out"]]
    work: list[Any] = [None] * _bounded(told["size"])
    for name, constant, given, to in told["code"]:
        if name == "OP_OUTPUT":
            results[to[0]][to[1]] = work[given[0]]
        elif name == "OP_INPUT":
            work[to[0]] = args[given[0]][given[1]]
        elif name == "OP_CONST":
            work[to[0]] = ca.SX(float(constant))
        elif name in UNARY and len(given) == 1:
            work[to[0]] = ca.SX.unary(getattr(ca, name), work[given[0]])
        elif name in BINARY and len(given) == 2:
            work[to[0]] = ca.SX.binary(getattr(ca, name), work[given[0]], work[given[1]])
        else:
            raise ValueError(f"operation {name}")
    return ca.Function(told["name"], args, [ca.vertcat(*r) for r in results], [n for n, _ in told["in"]],
                       [n for n, _ in told["out"]])


def _bounded(size: int) -> int:
    if not 0 <= size <= MOST_SCALARS:
        raise ValueError(f"{size} numbers")
    return size


def _simulations(functions: Mapping[str, ca.Function], records: Sequence[Mapping[str, Any]]) -> list[ca.Function]:
    """Return ``record_k`` and ``simulate_k`` for each of the records."""
    found = []
    for k, r in enumerate(records):
        t, u, m = np.array(r["t"], float), np.array(r["u"], float), np.array(r["substeps"], np.int64)
        if m.min() < 1 or m.sum() > MOST_SCALARS or (len(t), len(m)) != (u.shape[1], len(t) - 1):
            raise ValueError(f"record {k}")
        way = np.tile(1.0 - np.array(r["held"], float), (len(m), 1))
        for i, j, share in r.get("way", ()):
            way[i, j] = share
        p = ca.DM(r["p"]) if "p" in r else functions["parameters"]()["p"]
        found += [ca.Function(f"record_{k}", [], [ca.DM(t).T, ca.DM(r["s"]), ca.DM(u), p], [], ["t", "s", "u", "p"]),
                  simulation(f"simulate_{k}", functions, t, m, way)]
    return found


def runs_of(problem: Problem, q: Array) -> list[tuple[Run, Array, Array]]:
    """Return the records with the steps of a fit, (i, omega, theta) at their start, (3,), and their parameters."""
    if getattr(problem.integrator, "name", "") != "rosenbrock":
        # Another engine chose its own steps: take those that suit ours.
        problem = replace(problem, engine="rosenbrock").refined(q)
    point = problem.unknowns.point(q)
    return [(run, problem.unknowns.sensed(point, k), problem.unknowns.of_run(point, k).p)
            for k, run in enumerate(problem.runs)]


def simulation(name: str, functions: Mapping[str, ca.Function], t: Array, m: NDArray[np.int64],
                way: Array) -> ca.Function:
    """Return ``(s, u, p) -> (y, x)`` on the samples t (N,) and sub-steps m (N-1,): s (3,), u (nu, N), y (ny, N). Inputs
    do so much of a change by the `way` (N-1, nu): none while they are held, all between linear ones."""
    initial, outputs, step = (functions[n] for n in ("initial", "outputs", "step"))
    nu, np_ = step.size1_in(1), step.size1_in(4)
    interval = np.repeat(np.arange(len(m)), m)
    first = np.concatenate([[0], np.cumsum(m)])
    part = np.arange(len(interval)) - first[:-1][interval]
    share = 1.0 / m[interval]
    s, u, p = ca.MX.sym("s", 3), ca.MX.sym("u", nu, len(t)), ca.MX.sym("p", np_)
    before = u[:, interval.tolist()]
    slope = (u[:, (interval + 1).tolist()] - before) * ca.DM(way[interval].T)
    u0 = before + slope * ca.repmat(ca.DM(part * share).T, nu, 1)
    u1 = u0 + slope * ca.repmat(ca.DM(share).T, nu, 1)
    h = ca.DM(np.diff(t)[interval] * share).T
    x0 = initial(s, p)
    walked = step.mapaccum("walk", len(interval), 1)(x0, u0, u1, h, ca.repmat(p, 1, len(interval)))[0]
    x = ca.horzcat(x0, walked[:, (first[1:] - 1).tolist()])
    y = outputs.map(len(t))(x, u, ca.repmat(p, 1, len(t)))
    return ca.Function(name, [s, u, p], [y, x], ["s", "u", "p"], ["y", "x"])


def words(contents: Mapping[str, Any]) -> list[str]:
    """Return the description as lines of text, for the head of a source file."""
    model = contents["model"]
    lines = [" + ".join([model["base"], *model["effects"]]), ""]
    for name, p in contents["parameters"].items():
        spread = f" ± {p['std']:.3g}" if p["std"] else ""
        lines.append(f"{name} = {p['value']:.17g}{spread} {p['unit']}" + (" (fixed)" if p["fixed"] else ""))
    lines += ["", *(f"fitted to {d['name']}: {d['samples']} samples, SHA-256 {d['sha256']}" for d in contents["data"])]
    lines.append("written by " + ", ".join(f"{k} {v}" for k, v in contents["versions"].items()))
    return lines
