"""Models and problems as plain data for JSON, and back; only what the library holds is built, nothing is run."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from motorid.effects import EVERY
from motorid.errors import DataError, ModelError, UsageError, among, one_of
from motorid.integrate import ENGINES
from motorid.model.definition import Effect
from motorid.model.model import Model, dc_motor, torque_driven
from motorid.numerics.least_squares import Huber
from motorid.problem.constraints import CurrentLimit, SteadyState
from motorid.problem.problem import Problem
from motorid.problem.runs import Run, prepare_run
from motorid.records.experiment import Experiment

MOST_STEPS = 10_000_000  # of a simulation that a file asks for
KINDS = {kind.__name__: kind for kind in (CurrentLimit, SteadyState, Huber, *ENGINES.values())}
PLAIN = ("weights", "initial", "noise_factors", "priors", "accuracy", "width")  # a problem's fields that are plain data
OPTIONS = ("loss", "engine", "penalties", "constraints")  # and those that are objects
RECORD = ("t", "inputs", "outputs", "sigma", "hold", "units", "name", "meta")  # fields of a record
OWN = ("sigma", "start", "limits", "apart")  # and of the run made of it
KEPT = ("value", "vary", "given", "lower", "upper")  # fields of a parameter that may differ from the library's


def model_dict(model: Model) -> dict[str, Any]:
    """Return what a model is made of; effects that are not in the library by where they were defined."""
    own = {e.name: {"balance": e.balance, "parameters": [p.name for p in e.parameters],
                    "defined_in": getattr(e.law, "__module__", None), "doc": e.doc}
           for e in model.effects if e.name not in EVERY or EVERY[e.name].law != e.law}
    return {"base": model.base, "axis": model.axis, "effects": list(model.effect_names),
            "angle_input": model.angle_input, "own_effects": own}


def problem_dict(problem: Problem) -> dict[str, Any]:
    """Return a problem as plain data: the records, made ready as they are, and what is asked of them."""
    model = problem.model
    given = {e.name: {p.name: p.value for p in e.parameters if p.given} for e in model.effects}
    return {"parameters": {n: {f: getattr(p, f) for f in KEPT} for n, p in model.parameters.items()},
            "given": given, "runs": [
                {"record": {f: getattr(r.experiment, f) for f in RECORD}, **{f: getattr(r, f) for f in OWN},
                 "substeps": r.grid.substeps} for r in problem.runs],
            **{f: getattr(problem, f) for f in PLAIN}, **{f: _options(getattr(problem, f)) for f in OPTIONS}}


def problem_of(about: Mapping[str, Any], data: Mapping[str, Any], effects: Iterable[Effect] = ()) -> Problem:
    """Return the problem of what `model_dict` and `problem_dict` told."""
    model = _assembled(about, effects, data["given"])
    told = {n: {"lower": -np.inf, "upper": np.inf} | {f: p[f] for f in KEPT if p[f] is not None}
            for n, p in data["parameters"].items()}
    model = model.with_(angle_input=bool(about["angle_input"]),
                        parameters={n: replace(p, **told[n]) for n, p in model.parameters.items()})
    runs = [Experiment(**r["record"]) for r in data["runs"]]
    problem = Problem(model, tuple(runs), **{f: data[f] for f in PLAIN}, **{f: _built(data[f]) for f in OPTIONS})
    ready = [_run_of(problem, run, r) for run, r in zip(problem.experiments, data["runs"], strict=True)]
    return problem.with_runs(tuple(ready))


def _run_of(problem: Problem, record: Experiment, data: Mapping[str, Any]) -> Run:
    steps = np.array(data["substeps"], np.int64)
    if steps.shape != (record.n - 1,) or steps.min() < 1 or steps.max() > MOST_STEPS or steps.sum() > MOST_STEPS:
        raise ValueError(f"substeps of {record.name}")
    run = prepare_run(record, problem.outputs, data["sigma"], problem.system.inputs, "rest")
    limits = {c: (-np.inf if low is None else low, np.inf if high is None else high)
              for c, (low, high) in data["limits"].items()}
    if (start := np.array(data["start"], float)).shape != (3,):
        raise ValueError(f"3 numbers expected, {start.shape} came")
    return replace(run, grid=run.grid.with_substeps(steps), sigma=dict(data["sigma"]), limits=limits, start=start,
                   apart=dict(data["apart"]))


def _options(given: Any) -> Any:
    """Return an object of options as its kind and fields; a tuple of them as a list; text as it is."""
    if isinstance(given, tuple):
        return [_options(g) for g in given]
    if given is None or isinstance(given, str):
        return given
    if type(given) not in KINDS.values():
        raise UsageError(f"{type(given).__name__} is code of your own, which a saved fit cannot hold: fit without it, "
                         "or take the model alone along, mi.export(fit, 'motor.json').")
    return {"kind": type(given).__name__, **asdict(given)}


def _built(told: Any) -> Any:
    if isinstance(told, list):
        return tuple(_built(t) for t in told)
    return KINDS[told["kind"]](**{k: v for k, v in told.items() if k != "kind"}) if isinstance(told, dict) else told


def model_from_json(contents: Mapping[str, Any], effects: Iterable[Effect] = ()) -> Model:
    """Return the `Model`, at its values, that ``fit --json`` or `export` wrote; `effects` go before the library's."""
    part, values, fixed = "model", {}, {}  # fixed first: what is fixed may be zero, what is free may not
    try:
        head = dict(contents[part])
        _, part = (head["base"], list(head["effects"])), "parameters"
        pars = dict(contents[part])
        for part, p in pars.items():
            values[part] = float(p["value"])
            fixed |= {part: values[part]} if p["fixed"] else {}
    except (KeyError, TypeError, ValueError):
        what = "a diagnosis and no fit (motorid fit RUN... --json fit.json writes one)" if "verdict" in contents else (
            "not a fitted model, or damaged")
        raise DataError(f"this is {what}: '{part}' is missing or wrong; expected model.base, "
                        "model.effects and parameters, each with a number as value, and fixed.") from None
    model = _assembled(head, effects)
    if missing := set(model.parameters) ^ set(values):
        raise DataError(f"the parameters {', '.join(sorted(missing))} are in only one of the file and the model: an "
                        "effect has changed since the file was written.")
    for name, p in pars.items():
        if (p.get("unit") or model.parameters[name].unit) != model.parameters[name].unit:
            raise DataError(f"the file gives {name} in {p['unit']}, the model in {model.parameters[name].unit or '1'}.")
    limits = {n: (p.get("lower", -np.inf), p.get("upper", np.inf)) for n, p in pars.items()
              if "lower" in p or "upper" in p}
    free = {n: v for n, v in values.items() if n not in fixed}
    shared = {n: v for n, v in free.items() if not model.parameters[n].per_run}  # others are of the first run alone
    return model.fix(**fixed).replace(**shared).bounded(**limits).start_at(free).free(*free)


def _assembled(head: Mapping[str, Any], effects: Iterable[Effect],
               given: Mapping[str, Mapping[str, float]] | None = None) -> Model:
    """Return base and effects; `given` are parameters that the user set in an effect."""
    base, axis = str(head["base"]), head.get("axis", "rotary")
    among(base, ("dc_motor", "torque_driven"), "base", DataError)
    model = dc_motor() if base == "dc_motor" else torque_driven()
    model = model.on_linear_axis() if axis == "linear" else model
    own = {e.name: e for e in effects}
    for name in map(str, head["effects"]):
        model = model + _effect(name, own, head.get("own_effects", {}).get(name))(**(given or {}).get(name, {}))
    return model


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
