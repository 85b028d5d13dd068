"""Cards of what says how far a fit can be trusted, and of fits side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from motorid.display._html_tables import NAMES, channel_name, counted
from motorid.display.cards import Card, Flag, Table
from motorid.display.numbers import duration, number, percent, quantity, with_error
from motorid.uncertainty.covariance import interval_text


def _comparison(c: Any) -> Card:
    channels = list(dict.fromkeys(k for e in c.nrmse for k in e))
    units = {k: u for r in c.fits[0].problem.experiments for k, u in r.units.items()}
    titles = [name.replace("dc_motor", "DC motor").replace("torque_driven", "drive") for name in c.names]
    rows: list[Sequence[str | Flag]] = [
        [f"NRMSE {channel_name(k, units)}", *(percent(e.get(k)) for e in c.nrmse)] for k in channels
    ]
    if any(c.validation_nrmse):
        rows += [
            [f"held-out {channel_name(k, units)}", *(percent((e or {}).get(k)) for e in c.validation_nrmse)]
            for k in channels
        ]
    for name, entries in c.parameters.items():
        unit = next(f.model.parameters[name].unit for f in c.fits if name in f.values)
        rows.append([name, *(_entry(e, unit) for e in entries)])
    return Card(
        f"Comparison of {counted(len(c.fits), 'fit')}",
        tables=(Table(["", *titles], rows),),
        after=(("mi.plot_parameters(*comparison.fits)", "how the parameters moved"),),
    )


def _entry(entry: tuple[float, float | None] | None, unit: str) -> str | Flag:
    if entry is None:
        return "–"
    text = with_error(*entry, unit)
    return Flag(text, "note") if entry[1] is None else text


def _suggestion(s: Any) -> Card:
    best = sorted(s.discrimination.items(), key=lambda p: -p[1])
    rows: list[Sequence[str | Flag]] = []
    rows += [[Flag(n, "good") if n == s.name else n, number(v, 3)] for n, v in best]
    table = Table(["experiment", "expected χ² per sample between the models"], rows)
    return Card(
        "Next experiment",
        (Flag(s.name, "good"),),
        (s.text,),
        (table,),
        (("mi.plot_runs(suggestion.experiment)", "see it"),),
    )


def _multistart(m: Any) -> Card:
    n = len(m.endings)
    flags = [Flag(f"{m.good} good", "good"), *([Flag(f"{m.poor} poor", "note")] if m.poor else [])]
    flags += [Flag(f"{m.failed} failed", "bad")] if m.failed else []
    text = [f"{counted(n, 'start')}, off by up to {m.spread:g} times in every parameter, {duration(m.seconds)}."]
    text.append(f"{m.interrupted[0].upper()}{m.interrupted[1:]}." if m.interrupted else "")
    units = m.reference.model.parameters
    rows = [
        [
            name,
            *(quantity(s[k], units[name].unit, 5) for k in ("reference", "mean")),
            quantity(s["std"], units[name].unit, 2),
        ]
        for name, s in m.statistics().items()
    ]
    table = Table(["parameter", "reference", "mean of the good fits", "spread"], rows)
    return Card(
        "Fits from random starts",
        flags,
        text,
        (table,),
        (("mi.plot_waterfall(study)", "see it"),),
        "plot_waterfall",
    )


def _identifiability(r: Any) -> Card:
    k = len(r.names)
    flag = Flag("all determined", "good") if r.full else Flag(f"{r.rank} of {k} directions determined", "note")
    rows: list[Sequence[str | Flag]] = []
    for name, value, unit, size in zip(r.names, r.values, r.units, r.sizes, strict=True):
        std = r.std[name]
        share: str | Flag = Flag("not determined", "note") if std is None else percent(std / size, 2)
        rows.append([name, quantity(float(value), unit), quantity(std, unit, 2), share])
    table = Table(["parameter", "value", "std in a fit", "relative"], rows)
    after = [("mi.plot_singular_values(result)", "see it")]
    return Card("What the data determine", (flag,), (r.text,), (table,), after, "plot_singular_values")


def _covariance(c: Any) -> Card:
    rows: list[Sequence[str | Flag]] = []
    for name, value, unit in zip(c.names, c.values, c.units, strict=True):
        limits, std = c.interval(name), c.std[name]
        said: str | Flag = with_error(float(value), std, unit)
        if std is None:
            said = Flag(f"{quantity(float(value), unit, 3)} ({c.status[name]})", "note")
        rows.append(
            [
                name,
                said,
                interval_text(limits),
                *(_correlation(x) for x in c.correlation[c.names.index(name)]),
            ]
        )
    table = Table(["unknown", "value ± std", "95 %", *(f"ρ {n}" for n in c.names)], rows)
    share = ", ".join(f"{NAMES.get(k, k)} {percent(v.effective_share, 2)}" for k, v in c.colours.items())
    text = (f"Effective samples per sample: {share}.",) if share else ()
    return Card("Uncertainty", (Flag(f"{c.method} residuals"),), text, (table,), (("mi.bootstrap(fit)", "check it"),))


def _correlation(value: float) -> str | Flag:
    if value != value:
        return "–"
    text = f"{value:+.2f}".replace("-", "−")
    return Flag(text, "note") if 0.95 < abs(value) < 0.9999 else text


def _bootstrap(b: Any) -> Card:
    rows: list[Sequence[str | Flag]] = []
    for name, value, unit in zip(b.names, b.reference, b.units, strict=True):
        said: str | Flag = with_error(float(value), b.std[name], unit)
        if b.std[name] is None:
            said = Flag(f"{quantity(float(value), unit, 3)} ({b.status[name]})", "note")
        limited = b.limited[name]
        rows.append(
            [
                name,
                said,
                interval_text(b.interval(name)),
                Flag(percent(limited, 2), "note") if limited else "none",
            ]
        )
    flags = [Flag(f"{len(b.samples)} refits")]
    flags += [Flag(f"{len(b.failures)} failed", "bad")] if b.failures else []
    header = ["parameter", "value ± std", "95 %", "at its limit"]
    words = {"blocks": "Blocks of the residuals, put back in random order on the model's curves."}
    text = [words.get(b.kind, f"Resampled: {b.kind}."), b.interrupted]
    return Card("Bootstrap", flags, text, (Table(header, rows),), (("mi.plot_profile(mi.intervals(fit))", "compare"),))


def _profile(p: Any) -> Card:
    low, high = p.interval()
    row = [p.name, quantity(p.value, p.unit, 5), number(low), number(high)]
    flags = [Flag("the profile found a better fit than the one given", "bad")] if p.best < -1.0 else []
    table = Table(["parameter", "value", "95 %, from", "to"], [row])
    return Card(f"Profile of {p.name}", flags, (), (table,), (("mi.plot_profile(profile)", "see it"),), "plot_profile")


def _intervals(r: Any) -> Card:
    rows: list[Sequence[str | Flag]] = []
    for name, p in r.profiles.items():
        known = r.covariance.interval(name, r.level)
        first = interval_text(known) if known else Flag(r.covariance.status[name], "note")
        others = (r.bootstrap.interval(name, r.level), p.interval(r.level))
        rows.append([name, quantity(p.value, p.unit), first, *(interval_text(x) for x in others)])
    header = ["parameter", "value", "covariance", f"bootstrap ({r.bootstrap.kind})", "profile"]
    text = ("Where the three agree, any will do; where they do not, believe the profile.",)
    return Card(f"Intervals of {percent(r.level)}", (), text, (Table(header, rows),),
                (("mi.plot_profile(intervals)", "see them"),), "plot_profile")  # fmt: skip


def _formulations(r: Any) -> Card:
    table = r.table
    failed = [Flag(f"{f.name} failed", "bad") for f in r.all if f.fit is None]
    shown = Table([h or "quantity" for h in table.heads], table.rows)
    after = [("mi.plot_formulations(three)", "see it")]
    if any(name.startswith("CurrentLimit") for f in r.all for name in f.violations):
        after.append(("mi.plot_current_limit(three)", "the current and its limit"))
    return Card(
        "Plain, penalties, hard constraints",
        failed,
        (table.note,),
        (shown,),
        after,
        "plot_formulations",
    )


WRITERS: dict[str, Callable[[Any], Card]] = {
    "Comparison": _comparison,
    "Suggestion": _suggestion,
    "Multistart": _multistart,
    "Identifiability": _identifiability,
    "Covariance": _covariance,
    "Bootstrap": _bootstrap,
    "Profile": _profile,
    "Intervals": _intervals,
    "Formulations": _formulations,
}
