"""Results as tables of text: for terminals, logs, and wherever a page would be too much."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from motorid.display.numbers import duration, number, percent, quantity, with_error

if TYPE_CHECKING:
    from motorid.estimation.result import Fit
    from motorid.problem.simulate import Evaluation

NAMES = {"i": "current", "omega": "speed", "theta": "angle"}
MOST_RUNS = 12  # shown one by one

Std = Mapping[str, float | None]


@dataclass(frozen=True)
class Table:
    """A title, column heads and rows of text; `str` lays it out, columns in `left` flush left."""

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    left: tuple[int, ...] = (0,)
    note: str = ""

    def __str__(self) -> str:
        lines = [self.heads, *self.rows]
        widths = [max(len(line[k]) for line in lines) for k in range(len(self.heads))]
        body = ["  ".join(cell.ljust(w) if k in self.left else cell.rjust(w)
                          for k, (cell, w) in enumerate(zip(line, widths, strict=True))).rstrip()
                for line in lines]
        body.insert(1, "  ".join("─" * w for w in widths))
        return "\n".join([part for part in (self.title, *body, self.note) if part])


def parameter_table(fit: Fit, std: Std | None = None) -> Table:
    """Return the parameters as value ± standard deviation; held or not determined is said in words.

    `std` gives other standard deviations than the fit's own, which take the residuals as white.
    """
    rows = []
    for name, p in fit.problem.model.parameters.items():
        rows.append((name, parameter_text(fit, name, std), p.doc))
    return Table("Parameters", ("", "value ± std", "meaning"), tuple(rows), left=(0, 1, 2))


def parameter_text(fit: Fit, name: str, std: Std | None = None) -> str:
    """Return one parameter as ``1.302 ± 0.004 Ω``, or with ``(held)``, ``(chosen)``, ``(not determined)``."""
    p = fit.problem.model.parameters[name]
    if name == "sgn_width" and not p.given:
        return f"{quantity(fit.values[name], p.unit, 2)} (chosen from the data)"
    return with_error(fit.values[name], (std or fit.std)[name] if p.vary else 0.0, p.unit)


def error_table(fit: Fit, held_out: Evaluation | None = None) -> Table:
    """Return the errors per channel, in its unit and as a share of its RMS, fitted and held out."""
    units = channel_units(fit.problem.experiments)
    heads = ["channel", "RMSE", "NRMSE", "noise"]
    heads += ["held-out RMSE", "held-out NRMSE"] if held_out else []
    rows = []
    for c in fit.nrmse:
        noise = min(r.sigma[c] for r in fit.problem.runs if c in r.sigma)
        row = [f"{channel_name(c, units[c])} ({c})", quantity(fit.rmse[c], units[c], 3), percent(fit.nrmse[c]),
               quantity(noise, units[c], 2)]
        if held_out:
            known = c in held_out.nrmse
            row += [quantity(held_out.rmse[c], units[c], 3) if known else "–", percent(held_out.nrmse.get(c))]
        rows.append(tuple(row))
    return Table("Errors", tuple(heads), tuple(rows))


def run_table(evaluation: Evaluation, title: str = "NRMSE run by run") -> Table:
    """Return the error of each run per channel."""
    channels = list(evaluation.nrmse)
    shown = list(zip(evaluation.simulations, evaluation.by_run, strict=True))
    rows = [(s.experiment.name, *(percent(e.get(c)) for c in channels)) for s, e in shown[:MOST_RUNS]]
    note = f"and {len(shown) - MOST_RUNS} more runs" if len(shown) > MOST_RUNS else ""
    units = channel_units([s.experiment for s, _ in shown])
    return Table(title, ("run", *(channel_name(c, units[c]) for c in channels)), tuple(rows), note=note)


def derived_table(fit: Fit) -> Table | None:
    """Return time constants, damping ratio and the error at the steady state, as far as there are any."""
    rows = []
    if fit.tau_e is not None:
        rows.append(("electrical time constant", duration(fit.tau_e)))
    if fit.tau_m is not None:
        rows.append(("mechanical time constant", duration(fit.tau_m)))
    if fit.damping is not None:
        rows.append(("damping ratio", number(fit.damping, 3)))
    units = channel_units(fit.problem.experiments)
    for c, error in fit.steady_state_error.items():
        rows.append((f"steady-state error of the {channel_name(c, units[c])}", quantity(error, units[c], 3)))
    return Table("", ("derived", ""), tuple(rows), left=(0, 1)) if rows else None


def constraint_table(fit: Fit, violations: Mapping[str, float]) -> Table | None:
    """Return how far each constraint is violated and, of true constraints, what it costs to keep it."""
    multipliers = {f"{m.name}, {m.unit}": m for m in fit.extra.get("multipliers", ())}
    rows = []
    for name, beyond in violations.items():
        m = multipliers.get(name)
        rows.append((name.rpartition(", ")[0] or name, quantity(beyond, name.rpartition(", ")[2], 3),
                     m.text if m is not None else "weighed, not enforced"))
    heads = ("constraint", "largest violation", "")
    return Table("Constraints", heads, tuple(rows), left=(0, 2)) if rows else None


def comparison_table(fits: Sequence[tuple[str, Fit]], held_out: Sequence[Evaluation | None] = (),
                     std: Callable[[Fit], Std] = lambda fit: fit.std) -> Table:
    """Return models side by side: errors of the fit, held-out errors, parameters."""
    channels = list(fits[0][1].nrmse)
    judged = list(held_out) or [None] * len(fits)
    heads = ("", *(label for label, _ in fits))
    rows = [(f"NRMSE {NAMES[c]}", *(percent(f.nrmse.get(c)) for _, f in fits)) for c in channels]
    if any(judged):
        rows += [(f"held-out {NAMES[c]}", *(percent(e.nrmse.get(c)) if e else "–" for e in judged))
                 for c in channels]
    names = dict.fromkeys(n for _, f in fits for n in f.values if n != "sgn_width")
    stds = [std(f) for _, f in fits]
    rows += [(n, *(parameter_text(f, n, s) if n in f.values else "–" for (_, f), s in zip(fits, stds, strict=True)))
             for n in names]
    return Table("", heads, tuple(rows))


def ranking_table(ranking: Sequence[Any], show: int = 8) -> Table:
    """Return the candidates of a diagnosis, best first."""
    rows = []
    for c in ranking[:show]:
        name = ("→ " if c.accepted else "  ") + c.effect
        rows.append((name, percent(c.predicted_drop), percent(c.refit_drop), c.reason))
    heads = ("effect", "misfit falls by (predicted)", "(refitted)", "")
    return Table("Which effect is missing?", heads, tuple(rows), left=(0, 3))


def ladder_table(ladder: Any) -> Table:
    """Return the rungs of a ladder: what was added, errors of the fit and held out."""
    channels = list(ladder.rungs[0].nrmse)
    checked = any(r.validation_nrmse for r in ladder.rungs)
    heads = ["model", *(f"NRMSE {NAMES[c]}" for c in channels)]
    heads += [f"held-out {NAMES[c]}" for c in channels] if checked else []
    rows = []
    for r in ladder.rungs:
        row = ["+ " + r.added if r.added else " + ".join([r.fit.model.base, *r.fit.model.effect_names])]
        row[0] += "".join(f" − {name}" for name in r.removed)
        row += [percent(r.nrmse.get(c)) for c in channels]
        row += [percent((r.validation_nrmse or {}).get(c)) for c in channels] if checked else []
        rows.append(tuple(row))
    return Table("The error falls", tuple(heads), tuple(rows))


def values_table(title: str, heads: Sequence[str], rows: Mapping[str, Sequence[str]]) -> Table:
    """Return a table with one named row per entry."""
    return Table(title, tuple(heads), tuple((k, *v) for k, v in rows.items()))


def channel_name(channel: str, unit: str) -> str:
    """Return what people call a channel: the angle of a linear axis is its position."""
    return "position" if unit == "m" else NAMES[channel]


def channel_units(runs: Sequence[Any]) -> dict[str, str]:
    """Return the SI unit of each measured channel."""
    return {c: r.units[c] for r in reversed(runs) for c in ("i", "omega", "theta") if c in r.units}
