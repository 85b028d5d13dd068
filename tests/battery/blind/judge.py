"""What a diagnosis got right, by the rules that were written down with the cases, and the summary of a battery."""

from __future__ import annotations

import math
from typing import Any

NEAR = 1.15  # of the floor: as good as the true model
ANGLE = 0.005  # an angle is not asked to be better than this share of its spread: an encoder is finer than any model
CLAIMS = ("named", "group")  # grades that claim an effect; an approximation does not


def ratio(floor: dict[str, float], error: dict[str, float] | None) -> float | None:
    """Return the worst channel's held-out error over the error of the true model."""
    if not error:
        return None
    each = [error[c] / max(f, ANGLE if c == "theta" else 1e-6) for c, f in floor.items() if error.get(c) is not None]
    return max(each) if each and all(map(math.isfinite, each)) else math.inf


def judge(d: dict[str, Any]) -> dict[str, Any]:
    """Add what was right to the result of a case."""
    if "verdict" not in d:
        return d | {"failed": True}
    named, truth = d["effects"], d["truth"]
    order = [n for n in d["order"] if n in named] + [n for n in named if n not in d["order"]]
    alternatives = {t: {t, *d["alternatives"].get(t, ())} for t in truth}

    def stands_for(name: str, true: str) -> bool:
        """Whether `name` is the truth, a twin of it, or in a group with it."""
        return name in alternatives[true] or any(name in g and true in g for g in d["groups"])

    floor = d["floor"]
    out = d | {"named": order, "ratio_before": ratio(floor, d["held_before"]), "ratio": ratio(floor, d["held_after"]),
               "ratio_remainder": ratio(floor, d.get("held_remainder"))}
    claimed = [n for n in order if d["grades"].get(n, "named") in CLAIMS]
    if d["kind"] in ("single", "pair"):
        as_a_set = any(set(named) == set(w) for w in d["whole"])
        part = set().union(*d["whole"]) if as_a_set else set()
        out["first_right"] = bool(order) and (order[0] in part or any(stands_for(order[0], t) for t in truth))
        out["first_claimed"] = out["first_right"] and order[0] in claimed
        out["whole_right"] = as_a_set or all(any(stands_for(n, t) for n in named) for t in truth)
        out["extra"] = 0 if as_a_set else sum(not any(stands_for(n, t) for t in truth) for n in named)
        out["exact"] = out["whole_right"] and not out["extra"]
    else:
        wrong = [n for n in dict.fromkeys([*order, *d["order"]]) if n not in d["acceptable"]]  # rungs, too
        out["wrong"], out["wrong_claimed"] = wrong, [n for n in wrong if n in claimed]
    last = out["ratio"] if out["ratio_remainder"] is None else out["ratio_remainder"]
    out["near"] = last is not None and last <= NEAR
    return out


def mark(d: dict[str, Any]) -> str:
    """Return one word for a judged case."""
    if d.get("failed"):
        return "FAILED"
    if d["kind"] in ("none", "outside"):
        word = "ALARM" if d["kind"] == "none" else "FORCED"
        return word if d["wrong_claimed"] else "approximate" if d["wrong"] else "fine"
    if d["exact"]:
        return "right"
    return "whole" if d["whole_right"] else "first" if d["first_right"] else "WRONG"


def summary(results: list[dict[str, Any]]) -> str:
    """Return the table of all cases and the figures; what failed counts as wrong."""
    cases = [judge(d) for d in results]
    lines = [_line(d) for d in cases]
    kind = {k: [d for d in cases if d["kind"] == k] for k in ("single", "pair", "none", "outside")}

    def share(words: str, of: str, true) -> None:
        n, total = sum(not d.get("failed") and bool(true(d)) for d in kind[of]), len(kind[of])
        lines.append(f"{words:72s} {n}/{total}" + (f" ({100 * n / total:.1f} %)" if total else ""))

    lines += ["", f"failed (counted as wrong): {sum(bool(d.get('failed')) for d in cases)} of {len(cases)}"]
    for k in ("single", "pair"):
        share(f"{k}s: first effect right", k, lambda d: d["first_right"])
        share("  … and claimed, not only as an approximation", k, lambda d: d["first_claimed"])
        share("  whole", k, lambda d: d["whole_right"])
        share("  whole and nothing besides", k, lambda d: d["exact"])
        share("  held-out error within 15 % of the floor", k, lambda d: d["near"])
    share("nothing there: alarms (an effect claimed)", "none", lambda d: d["wrong_claimed"])
    share("  an effect at all, approximations included", "none", lambda d: d["wrong"])
    share("  verdict other than adequate", "none", lambda d: d["verdict"] != "adequate")
    share("outside: forced (an effect claimed)", "outside", lambda d: d["wrong_claimed"])
    share("  an effect at all, approximations included", "outside", lambda d: d["wrong"])
    share("  held-out error with the remainder within 15 % of the floor", "outside", lambda d: d["near"])
    share("  without the remainder", "outside", lambda d: d["ratio"] is not None and d["ratio"] <= NEAR)
    cpu = sorted(d["cpu"] for d in cases if "cpu" in d)
    if cpu:
        lines.append(f"processor time of fit and diagnosis: median {cpu[len(cpu) // 2]:.1f} s, 90 % "
                     f"{cpu[int(0.9 * (len(cpu) - 1))]:.1f} s, worst {cpu[-1]:.1f} s, sum {sum(cpu):.0f} s")
    return "\n".join(lines)


def _line(d: dict[str, Any]) -> str:
    if d.get("failed"):
        return f"{d['name']:28s} FAILED      {d.get('error', '')[:150]}"
    ratios = " → ".join("-" if r is None else f"{r:.2f}" for r in (d["ratio_before"], d["ratio"], d["ratio_remainder"]))
    found = "+".join(f"{n}({d['grades'].get(n, '?')})" for n in d["named"]) or "-"
    groups = f"  groups {d['groups']}" if d["groups"] else ""
    late = f"  {d['error'][:90]}" if "error" in d else ""
    return (f"{d['name']:28s} {mark(d):11s} {d['verdict']:11s} {found:44s} truth {'+'.join(d['truth']):36s} "
            f"held-out/floor {ratios}  {d['cpu']:.1f} s{groups}{late}")
