"""What each result shows in a notebook: its card, read off the result; nothing is computed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from motorid.display._cards_trust import WRITERS
from motorid.display._html_tables import (
    NAMES,
    UNITS,
    counted,
    error_table,
    ladder_table,
    model_name,
    parameter_table,
    ranking_table,
)
from motorid.display.cards import Card, Flag, Table
from motorid.display.numbers import duration, number, percent, quantity

_STATUS = {"converged": "good", "stalled": "note", "limit": "note", "failed": "bad"}


def card_of(result: Any) -> Card:
    """Return the card of any result, by its kind."""
    for kind in type(result).__mro__:
        write = _WRITERS.get(kind.__name__) or WRITERS.get(kind.__name__)
        if write is not None:
            return write(result)
    return Card(type(result).__name__)


def _experiment(run: Any) -> Card:
    rows = []
    for name, y in (*run.inputs.items(), *run.outputs.items()):
        good = y[y == y]
        missing = len(y) - len(good)
        reach = (
            f"{number(float(good.min()), 3)} … {number(float(good.max()), 3)} {run.units[name]}" if len(good) else "–"
        )
        rows.append([f"{NAMES[name]} {name}", reach, Flag(f"{missing} of {len(y)}", "note") if missing else "none"])
    notes = [str(n) for n in run.meta.get("notes", ())]
    return Card(
        f"Run {run.name}",
        text=(
            f"{run.n} samples in {duration(run.duration)}, {number(1e3 * run.dt, 3)} ms apart; "
            f"input {'held' if run.hold == 'zoh' else 'linear'} between samples.",
            *notes,
        ),
        tables=(Table(["channel", "range", "missing samples"], rows),),
        after=(("mi.plot_runs(run)", "see it"), ("mi.fit(mi.dc_motor(), [run])", "fit a model")),
    )


def _model(model: Any) -> Card:
    rows = []
    owner = {p.name: e.name for e in model.effects for p in e.parameters}
    for p in model.parameters.values():
        rows.append(
            [
                p.name,
                quantity(p.value, p.unit),
                "estimated" if p.vary else "held",
                owner.get(p.name, "base"),
                p.doc,
            ]
        )
    return Card(
        f"Model: {model_name(model)}",
        tables=(Table(["parameter", "value", "in a fit", "of", "meaning"], rows),),
        after=(("mi.fit(model, runs)", "fit it"), ("model + mi.effects.coulomb", "add an effect")),
    )


def _effect(effect: Any) -> Card:
    rows = [
        [p.name, quantity(p.value, p.unit), "–" if p.null is None else quantity(p.null, p.unit), p.doc]
        for p in effect.parameters
    ]
    return Card(
        f"Effect: {effect.name}",
        (Flag(effect.balance),),
        (effect.doc,),
        (Table(["parameter", "start", "vanishes at", "meaning"], rows),),
        (("model + effect", "use it"),),
    )


def _fit(fit: Any) -> Card:
    runs = fit.problem.experiments
    undetermined = [n for n, s in fit.std.items() if s is None]
    flags = [
        Flag(fit.status, _STATUS.get(fit.status, "plain")),
        *([Flag(fit.formulation)] if fit.formulation != "plain" else []),
    ]
    flags += [Flag(f"{len(undetermined)} not determined", "note")] if undetermined else []
    units = {c: u for r in runs for c, u in r.units.items()}
    times = [f"{what} {duration(t)}" for what, t in (("τ_e", fit.tau_e), ("τ_m", fit.tau_m)) if t]
    times += [f"damping {number(fit.damping, 3)}"] if fit.damping else []
    steps = counted(fit.iterations, "iteration")
    text = (
        f"{counted(len(runs), 'run')}, {fit.problem.n_outputs} samples, {steps} in {duration(fit.seconds)}. "
        + ", ".join(times),
        "" if fit.status == "converged" else f"{fit.message[:1].upper()}{fit.message[1:]}",
    )
    after = [("mi.plot_fit(fit)", "see it"), ("mi.diagnose(fit)", "what is missing")]
    if undetermined:
        after.append(("mi.identifiability(fit)", f"why {', '.join(undetermined)} cannot be determined"))
    return Card(
        f"Fit of {model_name(fit.model)}",
        flags,
        text,
        [parameter_table(fit), error_table([("", fit)], units), *_multipliers(fit.extra.get("multipliers", ()))],
        after,
    )


def _multipliers(found: Any) -> list[Table]:
    """What each constraint costs: only of fits with true constraints."""
    rows = [
        [m.name, Flag(m.label, "note") if m.active else m.label, f"{number(m.value, 3)} per {m.unit or 'unit'}"]
        for m in found
    ]
    header = ["constraint", "at the solution", "multiplier (fall of the cost if it gave way)"]
    return [Table(header, rows)] if rows else []


def _failure(failure: Any) -> Card:
    start = ", ".join(f"{n} = {number(v)}" for n, v in failure.start.items())
    return Card(
        "Failed run",
        (Flag(failure.status, "bad"),),
        (failure.message, f"It started from {start}." if start else ""),
    )


def _evaluation(e: Any) -> Card:
    units = {c: u for s in e.simulations for c, u in s.experiment.units.items()}
    rows = [
        [s.experiment.name, *(percent(errors.get(c)) for c in e.nrmse)]
        for s, errors in zip(e.simulations, e.by_run, strict=True)
    ]
    by_run = Table(["run", *(f"NRMSE {NAMES[c]}" for c in e.nrmse)], rows)
    return Card(
        f"Evaluation on {counted(len(e.simulations), 'run')}",
        tables=(error_table([("", e)], units), by_run),
        after=(("mi.plot_fit(evaluation)", "see it"),),
    )


def _adequacy(a: Any) -> Card:
    flag = Flag("adequate", "good") if a.adequate else Flag("something is missing", "bad")
    rows = [
        [
            f"{NAMES.get(c, c)} {c}",
            quantity(d.get("noise"), UNITS.get(c, ""), 3),
            quantity(d.get("rms"), UNITS.get(c, ""), 3),
            number(d.get("ratio"), 3),
            number(d.get("autocorrelation"), 2),
            number(d.get("p_value"), 2),
        ]
        for c, d in a.channels.items()
    ]
    return Card(
        "Is anything missing?",
        (flag,),
        (a.text,),
        (Table(["channel", "noise", "residual", "ratio", "autocorrelation", "p"], rows),),
        () if a.adequate else (("mi.diagnose(fit)", "what is missing"),),
    )


def _missing(m: Any) -> Card:
    tables = [
        Table(["balance", "share of the misfit"], [[k, percent(v, 2)] for k, v in m.shares.items()]),
        Table(["region", "share of the misfit"], [[k, percent(v, 2)] for k, v in m.regions.items()]),
    ]
    best = [[balance, b.against, percent(b.explained, 2)] for balance, bins in m.bins.items() for b in bins[:3]]
    tables.append(Table(["missing", "depends on", "explained"], best))
    return Card(
        "Where the model fails",
        (Flag(m.where, "note"),) if m.where else (),
        (m.text,),
        tables,
        (("mi.plot_missing(missing)", "see it"),),
    )


def _ladder(ladder: Any) -> Card:
    return Card(
        "Ladder of models",
        text=(ladder.text,),
        tables=(ladder_table(ladder),),
        after=(("mi.plot_ladder(ladder)", "see it"), ("ladder.best", "the last fit")),
    )


def _diagnosis(d: Any) -> Card:
    mood = {"adequate": "good", "missing": "note", "unexplained": "bad"}.get(d.verdict, "plain")
    text = [d.text]  # which may say already what these add
    text += [f"Next experiment: {d.suggestion}"] if d.suggestion and d.suggestion not in d.text else []
    alike = [f"These data cannot tell apart: {', '.join(g)}." for g in d.groups if len(g) > 1]
    text += [] if "cannot tell" in d.text else alike
    tables = [ranking_table(d.ranking, 6), ladder_table(d.ladder)] if d.ranking else [ladder_table(d.ladder)]
    if d.after is not d.before:
        tables.append(parameter_table(d.after, d.before, d.std_of))
    return Card(
        "Diagnosis",
        (Flag(d.verdict, mood), *([Flag(d.where)] if d.where else [])),
        text,
        tables,
        (
            ("mi.plot_missing(found)", "where"),
            ("mi.plot_ranking(found)", "which"),
            ("found.after", "the better fit"),
            ('mi.report(found, "report.html")', "the whole story on one page"),
        ),
    )


def _recording(r: Any) -> Card:
    made = r.received + r.lost
    flags = [Flag(r.ended, "good" if r.complete else "bad")]
    flags += [Flag(f"{r.lost} of {made} samples lost", "note")] if r.lost else []
    return Card(f"Recording {r.path.name}", flags, str(r).splitlines(), (),
                ((f'mi.read_runs("{r.path.name}")', "read it"),))  # fmt: skip


_WRITERS: dict[str, Callable[[Any], Card]] = {
    "Experiment": _experiment,
    "Model": _model,
    "Effect": _effect,
    "Fit": _fit,
    "Failure": _failure,
    "Evaluation": _evaluation,
    "Adequacy": _adequacy,
    "Missing": _missing,
    "Ladder": _ladder,
    "Diagnosis": _diagnosis,
    "Recording": _recording,
}
