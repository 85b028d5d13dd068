"""Tables that cards and the report share: parameters, errors, ranking, ladder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from motorid.display.cards import Flag, Table
from motorid.display.numbers import number, percent, quantity, with_error
from motorid.display.tables import Std

NAMES = {"v": "voltage", "i": "current", "omega": "speed", "theta": "angle"}
UNITS = {"i": "A", "omega": "rad/s", "theta": "rad"}


def model_name(model: Any) -> str:
    """Return ``DC motor + coulomb``."""
    base = {"dc_motor": "DC motor", "torque_driven": "torque-driven axis"}[model.base]
    return " + ".join([base, *model.effect_names])


def channel_name(channel: str, units: Mapping[str, str]) -> str:
    """Return what a channel is called: the angle of a linear axis is a position."""
    return "position" if channel == "theta" and units.get("theta") == "m" else NAMES[channel]


def counted(n: int, noun: str) -> str:
    """Return ``1 run``, ``2 runs``."""
    return f"{n} {noun}" + ("" if n == 1 else "s")


def parameter_table(fit: Any, before: Any = None, std: Callable[[Any], Std] = lambda fit: fit.std) -> Table:
    """Values with standard deviations as `std` tells them; beside them those of another fit."""
    rows, known = [], std(fit)
    earlier = {} if before is None else std(before)
    for name, p in fit.model.parameters.items():
        if name == "sgn_width":
            continue
        was = [] if before is None else [_value(before, name, earlier)]
        rows.append([name, *was, _value(fit, name, known), p.doc])
    header = ["parameter", *(["before", "after"] if before is not None else ["value ± std"]), "meaning"]
    return Table(header, rows)


def _value(fit: Any, name: str, known: Std) -> str | Flag:
    if name not in fit.values:
        return "–"
    p = fit.model.parameters[name]
    std = known.get(name, 0.0) if p.vary else 0.0
    text = with_error(fit.values[name], std, p.unit)
    return Flag(text, "note") if std is None else text


def error_table(evaluations: Sequence[tuple[str, Any]], units: Mapping[str, str]) -> Table:
    """RMSE and NRMSE per channel, for each (title, fit or evaluation)."""
    channels = dict.fromkeys(c for _, e in evaluations for c in e.nrmse)
    header = [
        "channel",
        *(f"{what}, {title}" if title else what for title, _ in evaluations for what in ("NRMSE", "RMSE")),
    ]
    rows = [
        [
            f"{channel_name(c, units)} {c}",
            *(
                text
                for _, e in evaluations
                for text in (percent(e.nrmse.get(c)), quantity(e.rmse.get(c), units.get(c, UNITS[c]), 3))
            ),
        ]
        for c in channels
    ]
    return Table(header, rows)


def ranking_table(candidates: Sequence[Any], most: int = 10) -> Table:
    """The effects tried, best first; the held-out error only where there is one."""
    held_out = any(c.held_out_gain is not None for c in candidates[:most])
    header = [
        "effect",
        "predicted drop",
        "drop after a refit",
        *(["held-out error falls by"] if held_out else []),
    ]
    rows = []
    for c in candidates[:most]:
        # Non-breaking blanks: a line may end between parameters only.
        sizes = [f"{n}\u00a0=\u00a0{number(v, 3)}" for n, v in c.parameters.items() if n != "sgn_width"]
        gain = [percent(c.held_out_gain)] if held_out else []
        verdict = Flag("accepted", "good") if c.accepted else (c.reason or "not refitted")
        rows.append([c.effect, percent(c.predicted_drop), percent(c.refit_drop), *gain, ", ".join(sizes), verdict])
    return Table([*header, "size (SI)", "verdict"], rows, "Drop: share of the misfit that the effect takes away.")


def ladder_table(ladder: Any) -> Table:
    """Errors of the model on each rung."""
    first = ladder.rungs[0]
    channels = list(first.nrmse)
    held_out = any(r.validation_nrmse for r in ladder.rungs)
    header = [
        "model",
        *(f"{NAMES[c]}, fitted" for c in channels),
        *(f"{NAMES[c]}, held out" for c in channels if held_out),
    ]
    rows = []
    for r in ladder.rungs:
        held = [percent((r.validation_nrmse or {}).get(c)) for c in channels] if held_out else []
        name = model_name(first.fit.model) if r.added is None else f"+ {r.added}"
        name += "".join(f" − {gone}" for gone in r.removed)
        rows.append([name, *(percent(r.nrmse[c]) for c in channels), *held])
    return Table(header, rows)
