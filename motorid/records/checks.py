"""Will these runs show what a fit has to know? Remarks in plain words, each with what to do."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from motorid.channels import NAMES
from motorid.numerics.noise import noise_level, quantum
from motorid.numerics.signals import Array
from motorid.records.experiment import Experiment
from motorid.records.plausibility import (
    angle_against_speed,
    implied_constants,
    magnitudes,
    signs,
    swapped_columns,
    unsigned,
)

Check = Callable[[Experiment], str | None]


def check_runs(runs: Sequence[Experiment]) -> list[str]:
    """Look for what is wrong with records, and for what they cannot show.

    Swapped signs and columns, wrong units, clipped or coarse channels, spikes, too slow sampling, missing samples, a
    motor that never settles or is never excited, a voltage that never reverses.

    Parameters
    ----------
    runs : sequence of Experiment
        Runs that will be used together.

    Returns
    -------
    list of str
        One sentence or two per finding, naming the runs; empty if there is nothing to say.
    """
    remarks = []
    for check in _CHECKS:
        hits = [(run.name, text) for run in runs if (text := check(run))]
        if hits:
            others = ", ".join(name for name, _ in hits[1:4])
            others += f" and {len(hits) - 4} more" if len(hits) > 4 else ""
            remarks.append(f"{hits[0][0]}: {hits[0][1]}" + (f" (The same in {others}.)" if others else ""))
    return remarks + [text for text in (_never_reverses(runs),) if text]


def _excitation(run: Experiment) -> str | None:
    v = run.inputs["v"]
    if np.ptp(v) <= 1e-6 * np.abs(v).max():
        return (f"the voltage is {v[0]:.4g} {run.units['v']} from beginning to end; such a run alone "
                "cannot tell the parameters apart. Add runs with steps or a sweep of the voltage.")
    still = [c for c, y in run.outputs.items() if np.nanmax(y) == np.nanmin(y)]
    if still:
        return (f"the {NAMES[still[0]]} never changes although the voltage does; a dead sensor, a "
                "locked rotor, or too little voltage to move?")
    return None


def _missing(run: Experiment) -> str | None:
    share = {c: float(np.mean(np.isnan(y))) for c, y in run.outputs.items()}
    worst = max(share, key=lambda c: share[c])
    if share[worst] > 0.2:
        return (f"{100 * share[worst]:.0f} % of the {NAMES[worst]} samples are missing; the fit uses "
                "the others. Look whether the logger drops them at certain moments.")
    return None


def _clipped(run: Experiment) -> str | None:
    for channel in ("i", "omega"):
        y = run.outputs.get(channel)
        if y is None:
            continue
        y = y[np.isfinite(y)]
        for top in (y.max(), y.min()):
            if _at_stop(y, float(top)):
                share = 100 * float(np.mean(y == top))
                return (f"the {NAMES[channel]} stays at exactly {top:.4g} {run.units[channel]} in "
                        f"{share:.0f} % of the samples: clipped at the limit of the sensor or the drive. Use "
                        "a lower voltage, or mark these samples as missing.")
    return None


def current_limit(run: Experiment) -> str | None:
    """Say so where the current stays while the voltage does and the speed changes: not the winding holds it there."""
    i, omega, v = run.outputs.get("i"), run.outputs.get("omega"), run.inputs["v"]
    if i is None or omega is None or run.units["v"] != "V" or _clipped(run):
        return None
    top = float(np.nanmedian(np.abs(i)[np.abs(i) > 0.95 * np.nanquantile(np.abs(i), 0.995)]))
    near = 4 * noise_level(i, run.t)
    if near > 0.1 * top:
        return None
    flat = np.abs(np.abs(i) - top) < near
    ends = np.flatnonzero(np.diff(np.r_[0, flat.astype(int), 0]))
    held = 0
    for a, b in zip(ends[::2], ends[1::2], strict=True):
        steady = np.ptp(v[a:b]) < 0.02 * np.ptp(v)
        if b - a >= 10 and steady and np.isfinite(omega[a:b]).all() and np.ptp(omega[a:b]) > 0.2 * np.nanmax(
                np.abs(omega)):
            held += b - a
    if held < 0.02 * run.n:
        return None
    return (f"the current is held at {top:.3g} {run.units['i']} while the voltage stays and the speed changes "
            f"({100 * held / run.n:.0f} % of the samples): a current limit of the driver? Then the motor does not get "
            "the voltage that was logged. Use a lower voltage, or log the voltage at the motor's terminals.")


def _at_stop(y: Array, top: float) -> bool:
    """Tell a channel that has run into a limit from one that rests, or reaches a level by itself."""
    there = y == top
    if top == 0 or there.sum() < max(10, 0.01 * len(y)) or there.all():
        return False
    below = y[~there]
    reach = np.ptp(y)
    step = quantum(y)
    entries = np.abs(y[np.flatnonzero(there[1:] & ~there[:-1])] - top)
    if entries.size and float(np.median(entries)) > max(3 * step, 0.005 * reach):
        return True
    noise = noise_level(below)
    return step == 0 and noise > 1e-4 * reach and float(np.mean(there[1:][there[:-1]])) > 0.5


def _coarse(run: Experiment) -> str | None:
    for channel, y in run.outputs.items():
        step, reach = quantum(y), float(np.nanmax(y) - np.nanmin(y))
        if 0 < reach < 16 * step:
            return (f"the {NAMES[channel]} moves in steps of {step:.3g} {run.units[channel]} and "
                    f"covers only {reach / step:.0f} of them, too few counts to fit well. Use more of "
                    "the range, a finer sensor or a longer counting time.")
    return None


def _spikes(run: Experiment) -> str | None:
    left = run.without_spikes()
    for channel, y in run.outputs.items():
        kept = np.isfinite(left.outputs[channel])
        far = np.flatnonzero(np.isfinite(y) & ~kept)
        if far.size:
            size = float(np.median(np.abs(y[far] - np.interp(run.t[far], run.t[kept], y[kept]))))
            return (f"{far.size} single samples of the {NAMES[channel]} stand about {size:.2g} {run.units[channel]} "
                    "away from both neighbours: spikes of the sensor or the logger. Leave them out (--no-spikes, "
                    "run.without_spikes()), or fit with a loss that forgives outliers (--loss huber, "
                    "loss=mi.Huber()).")
    return None


def _noisy(run: Experiment) -> str | None:
    for channel, y in run.outputs.items():
        size, noise = float(np.nanstd(y)), noise_level(y, run.t)
        if noise > 0.5 * size > 0:
            return (f"the {NAMES[channel]} is mostly noise ({noise:.2g} of {size:.2g} {run.units[channel]}) "
                    "and will tell the fit little. Drive the motor harder or filter before sampling.")
    return None


def _uneven(run: Experiment) -> str | None:
    steps = np.diff(run.t)
    share = float(np.mean(np.abs(steps - run.dt) > 0.25 * run.dt))
    if share > 0.05:
        low, high = np.quantile(steps, (0.02, 0.98))
        return (f"sampling is uneven, {1e3 * low:.3g} to {1e3 * high:.3g} ms apart. Each sample is used "
                "at its own time; make sure that the stamps say when it was taken, not when it arrived.")
    return None


def _slow_sampling(run: Experiment) -> str | None:
    """After a voltage step the current must not be there at the next sample already."""
    if "i" not in run.outputs or run.units["v"] != "V":
        return None
    v, i = run.inputs["v"], run.outputs["i"]
    jumps = np.flatnonzero(np.abs(np.diff(v)) > 0.3 * np.ptp(v)) + 1
    jumps = jumps[(jumps >= 1) & (jumps + 3 < run.n)]
    if not jumps.size:
        return None
    rise = np.abs(i[jumps[:, None] + np.arange(4)] - i[jumps - 1][:, None])
    first, full = rise[:, :2].max(axis=1), rise.max(axis=1)  # the step itself may lie between two samples
    clear = full > 10 * noise_level(i, run.t)
    if clear.any() and float(np.median(first[clear] / full[clear])) > 0.9:
        return (f"after a voltage step the current is there within one sample ({1e3 * run.dt:.3g} ms): "
                "the sampling is too slow for the inductance, so L will be uncertain. Sample faster, or "
                "fix L: it hardly matters here.")
    return None


def _never_settles(run: Experiment) -> str | None:
    channel = next((c for c in ("omega", "i") if c in run.outputs), None)
    v = run.inputs["v"]
    changes = np.flatnonzero(np.abs(np.diff(v)) > 0.02 * np.ptp(v)) + 1
    if channel is None or np.ptp(v) == 0 or len(changes) > run.n / 50:
        return None
    y, drifts = run.outputs[channel], []
    reach = float(np.nanmax(y) - np.nanmin(y))
    for start, end in pairwise([0, *changes, run.n]):
        length = end - start
        if length < 40 or abs(v[start]) < 0.05 * np.abs(v).max() or np.ptp(v[start:end]) > 0.05 * np.ptp(v):
            continue
        early, late = y[end - 3 * length // 10:end - length // 5], y[end - length // 10:end]
        if np.isfinite(early).any() and np.isfinite(late).any():
            drifts.append(abs(float(np.nanmean(late) - np.nanmean(early))))
    spread = 5 * noise_level(y, run.t) / np.sqrt(run.n / 10 / (len(drifts) + 1))
    if drifts and min(drifts) > max(0.05 * reach, spread):
        return (f"the {NAMES[channel]} never settles while the voltage is constant; friction and "
                "steady state will be uncertain. Hold the voltage longer in at least one run.")
    return None


def _never_reverses(runs: Sequence[Experiment]) -> str | None:
    if not runs:
        return None
    low, high = min(r.inputs["v"].min() for r in runs), max(r.inputs["v"].max() for r in runs)
    if low > -0.02 * high or high < -0.02 * low:
        return ("the voltage never reverses in any run: effects that depend on the direction (dry "
                "friction against a constant load, asymmetry, backlash) cannot be told apart. Add a run "
                "with both signs.")
    return None


_CHECKS: tuple[Check, ...] = (
    signs, unsigned, angle_against_speed, magnitudes, implied_constants, swapped_columns,
    _excitation, _missing, _clipped, current_limit, _coarse, _spikes, _noisy, _uneven, _slow_sampling, _never_settles,
)
