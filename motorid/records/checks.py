"""Are units, signs and columns right, and will these runs show what a fit has to know? See `check_runs`."""

from collections.abc import Callable, Sequence
from itertools import pairwise, permutations, product

import numpy as np
from numpy.typing import NDArray

from motorid.channels import NAMES, channel_name, worded
from motorid.display.numbers import number, quantity
from motorid.numerics.signals import FEWEST_FRESH, WINDOWS, Array, bridged, integral, noise_level, quantum, slope
from motorid.records.experiment import Experiment, units_of
from motorid.records.headers import parse_unit

Check = Callable[[Experiment], str | None]
Reading = tuple[tuple[int, ...], tuple[int, int]]  # order of v, i, omega; signs of i and omega
_BLOCKS = 40
EXPLAINED = 0.1  # share of either balance that a reading with exchanged columns may leave unexplained
ALONG = 0.5  # cosine of voltage and speed beyond which neither is turned, whatever a driver that saturates does
CLEAR = 0.15  # of what the stated columns leave, so much at most
RESOLVED = 1e-3  # share that noise and the integration from sample to sample leave of any balance
LOAD = 2.0  # largest torque of a load, as a multiple of the largest current
STILL = 0.02  # of the largest speed: standstill
RUNNING = 0.92  # cosine of |v| and |omega|: runs under its voltage; of what swings under a constant one it is 0.90
OTHER_SCALE = 5.0  # times the speed per voltage: a wrong unit makes 6 and more, a duty cycle for the voltage at least 5
ROUGH = 0.05  # of the speed: sampled so slowly that its balance cannot be integrated
BALANCE_BLOCKS = 150
BEGUN, RISEN = 0.1, 0.63  # of its range, a step of the voltage; of their change, where outputs begin and a lag has come
PART, LEVELS = 20, 16  # samples of a voltage that are looked at together; levels that a stair may have
FAST, WHITE = 0.6, 0.25  # cosine of the phase from sample to sample: sines of 0.3 or 0.7 Nyquist; noise: about 0
# Ratio of the angle's rate to the speed, and what was then mistaken for SI.
_RATIOS = {
    2 * np.pi / 60: "the speed in rpm: units={'omega': 'rpm'}",
    60 / (2 * np.pi): "the speed already in rad/s although rpm is stated: units={'omega': 'rad/s'}",
    np.pi / 180: "the speed in deg/s: units={'omega': 'deg/s'}",
    180 / np.pi: "the angle in degrees: units={'theta': 'deg'}",
    2 * np.pi: "the speed in turns per second: units={'omega': 'rev/s'}",
    1 / (2 * np.pi): "the angle in turns: units={'theta': 'rev'}",
    6.0: "the speed in rpm and the angle in degrees: units={'omega': 'rpm', 'theta': 'deg'}",
    1 / 60: "the speed in rpm and the angle in turns: units={'omega': 'rpm', 'theta': 'rev'}",
    **dict.fromkeys((1000.0, 1e-3), "one of them in thousandths")}


def check_runs(runs: Sequence[Experiment], held_out: Sequence[Experiment] = ()) -> list[str]:
    """Look for what is wrong with records, and for what they cannot show.

    Swapped signs and columns, wrong units, clipped or coarse channels, spikes, too slow sampling, missing samples, a
    motor that never settles or is never excited, a drive that is off, a voltage that never reverses or acts late.

    Parameters
    ----------
    runs : sequence of Experiment
        Runs that will be used together.
    held_out : sequence of Experiment
        Runs that these will be judged by: only whether their scales agree.

    Returns
    -------
    list of str
        One sentence or two per finding, naming the runs; empty if there is nothing to say.

    Examples
    --------
    >>> for remark in mi.check_runs(runs):
    ...     print(remark)
    """
    plain, late = _plain(runs)
    remarks = [text for check in _CHECKS if (text := _said(check, runs if check in (_missing, _spikes) else plain))]
    scales = _other_scale([*plain, *(run.without_spikes() for run in held_out)])
    if late:
        remarks.append(f"what was measured follows a step of the voltage only after {span(late)} and then in less time "
                       f"than that: does it act later than it was logged? If so: --delay {min(late):.3g}, "
                       f"run.delayed({min(late):.3g}).")
    more = _the_same_twice(runs), scales, _never_reverses(runs)
    return [worded(text, units_of(runs), [r.name for r in (*runs, *held_out)]) for text in (*remarks, *more) if text]


def contradictions(runs: Sequence[Experiment]) -> str:
    """Say how channels of these runs contradict one another; empty if they do not."""
    plain, late = _plain(runs)
    # What one run of several says of signs an effect may have done: a current of the supply, a load that drives.
    some = {c for c in (signs, swapped_columns) if 2 * sum(c(run) is not None for run in plain) <= len(plain)}
    found = [*(_said(check, plain) for check in _CONTRADICTIONS if check not in some), _other_scale(plain)]
    if late and max(late) > (1 + BEGUN) * min(late) + 3 * max(run.dt for run in runs):  # by more than is read off
        found.append(f"what was measured follows a step of the voltage after {span(late)} which no one delay mends: "
                     "log the voltage when it takes effect.")
    return worded(" ".join(text for text in found if text), units_of(runs), [run.name for run in runs])


def as_command(run: Experiment) -> Experiment:
    """Return a run as a torque-driven axis has it: its input is no voltage, in volts or not, and no current is used."""
    kept = {c: y for c, y in run.outputs.items() if c != "i"} or run.outputs
    return run.with_(units={**run.units, "v": run.units["v"].replace("V", "1")}, outputs=kept)


def _plain(runs: Sequence[Experiment]) -> tuple[list[Experiment], list[float]]:
    """Return runs without what looks like another fault: wild samples, channels without any, dead times; and these."""
    plain = [run.without(*(c for c, y in run.outputs.items() if np.isnan(y).all())).without_spikes() for run in runs]
    late = dead_times(plain)
    return [run.delayed(min(dead_times([run]) or [0.0])) for run in plain] if late else plain, late


def _said(check: Check, runs: Sequence[Experiment]) -> str | None:
    """Return what a check says of runs, naming them. Who logs one negative voltage logs signs."""
    signed = check is unsigned_voltage and any(run.inputs["v"].min() < 0 for run in runs)
    hits = [] if signed else [(run.name, text) for run in runs if (text := check(run))]
    return _told_once(hits[0][1], [name for name, _ in hits]) if hits else None


def dead_times(runs: Sequence[Experiment]) -> list[float]:
    """Return how long nothing follows each step of the voltage, s, and then all comes in less time, as not even behind
    six equal lags; none where any step is followed sooner. At rest friction and a soft start may do so to the speed."""
    found = list[float]()
    for run in runs:
        v, seen = run.inputs["v"], {c: bridged(run.t, run.outputs[c]) for c in ("i", "omega") if c in run.outputs}
        edges = [0, *(np.flatnonzero(np.abs(np.diff(v)) > BEGUN * np.ptp(v)) + 1).tolist(), run.n]
        for first, a, end in zip(edges, edges[1:], edges[2:], strict=False):
            last, level = a - (a - first) // 4, BEGUN * abs(v[a] - v[a - 1])
            if min((a - first) // 2, end - a) < FEWEST_FRESH or max(np.ptp(v[first:a]), np.ptp(v[a:end])) > level:
                continue
            turns = any(abs(np.median(y[last:a])) > STILL * np.abs(y).max() for y in seen.values())
            if (ways := [_way(y[last:a], y[a:end]) for y in seen.values() if "i" in seen or turns]) and all(ways):
                waits, comes = min(way for way in ways if way)
                found.append(float(run.t[a + waits] - run.t[a]) if waits > comes - waits else 0.0)
    return found if all(found) else []


def _way(before: Array, after: Array) -> tuple[int, int] | None:
    """Return after how many samples a channel still is as it was, and when most of its way is done; None for noise, for
    what still moved before, and where the sensor may only have waited for its next measurement."""
    way, noise = np.abs(after - np.median(before)), 4 * float(np.std(before))
    early, late = np.array_split(before, 2)
    top, moved = float(np.quantile(way, 0.9)), abs(float(np.median(late) - np.median(early)))
    begun, most = (int(np.argmax(way > max(share * top, noise))) for share in (BEGUN, RISEN))
    fresh = np.diff(np.flatnonzero(np.diff(after)))  # samples between measurements
    told = begun - 1 > (float(np.median(fresh)) if len(fresh) else 0.0) or begun < 3
    return (begun - 1, most) if 6 * noise < top and moved < 0.5 * BEGUN * top and told else None


def span(dead: Sequence[float]) -> str:
    """Say how long dead times are, and whether they differ."""
    least, most = (number(1e3 * s, 3) for s in (min(dead), max(dead)))
    return f"{least} ms" if max(dead) < (1 + BEGUN) * min(dead) else f"{least} to {most} ms, another time at each step,"


def reading_notes(runs: Sequence[Experiment]) -> list[str]:
    """Return what was noted while reading, each note once, naming the runs."""
    names: dict[str, list[str]] = {}
    for run in runs:
        for note in run.meta.get("notes", ()):
            names.setdefault(note, []).append(run.name)
    return [_told_once(note, of) for note, of in names.items()]


def _told_once(text: str, names: Sequence[str]) -> str:
    others = ", ".join(names[1:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
    return f"{names[0]}: {text}" + (f" (The same in {others}.)" if others else "")


def _the_same_twice(runs: Sequence[Experiment]) -> str | None:
    """The same samples in two runs count as twice as much evidence."""
    seen: dict[tuple[bytes, ...], str] = {}
    for run in runs:
        first = seen.setdefault(tuple(y.tobytes() for y in (run.inputs["v"], *run.outputs.values())), run.name)
        if first != run.name:
            return (f"{first} and {run.name} hold the very same samples: a copy adds nothing, and makes standard "
                    "deviations too small. Leave one out.")
    return None


def _other_scale(runs: Sequence[Experiment]) -> str | None:
    """Compare what the speed per voltage is at least (RMS over the largest voltage) with what another's is at most.

    That is its largest speed over the mean of the best tenth of its voltage, which a fast excitation makes small."""
    gains = []
    for run in runs:
        v, omega, tenth = run.inputs["v"], _speed(run), run.n // 10
        if omega is None or not tenth or run.units["v"] != "V" or _cosine(np.abs(v), np.abs(omega)) < RUNNING:
            continue
        volts = np.cumsum(np.r_[0.0, v])
        lasting = float(np.abs(volts[tenth:] - volts[:-tenth]).max()) / tenth
        gains.append((float(np.sqrt(np.mean(omega**2)) / np.abs(v).max()),
                      float(np.abs(omega).max() / max(lasting, 1e-300)), run.name, np.abs(v).max()))
    if len(gains) < 2:
        return None
    (fast, _, one, volts), (_, slow, other, more) = max(gains), min(gains, key=lambda g: g[1])
    return (f"the same voltage gives at least {fast / slow:.0f} times the speed in {one} as in {other}: do their units "
            "differ (volts and a duty cycle, turns and radians)? Read each in its own, or leave one out."
            ) if fast > OTHER_SCALE * slow and volts < 1.1 * more else None  # friction holds what little drives


def _speed(run: Experiment) -> Array | None:
    """Return the speed (N,), the slope of the angle where it was not measured; None where neither was."""
    known = {c: bridged(run.t, y) for c, y in run.outputs.items() if np.isfinite(y).any()}
    if "omega" in known or "theta" not in known:
        return known.get("omega")
    return slope(run.t, known["theta"], max(run.n // WINDOWS, 1))


def _one_column_for_two(run: Experiment) -> str | None:
    """Two channels of the very same numbers are one column, taken twice."""
    seen: dict[bytes, str] = {}
    for channel, y in {**run.inputs, **run.outputs}.items():
        first = seen.setdefault(y.tobytes(), channel)
        if first != channel and np.nanmin(y) < np.nanmax(y):
            return (f"{NAMES[first]} and {NAMES[channel]} are the very same numbers: one column twice? Say "
                    f"which columns hold them: columns={{'{first}': ..., '{channel}': ...}}.")
    return None


def _excitation(run: Experiment) -> str | None:
    v, omega = run.inputs["v"], _speed(run)
    if not v.any() and omega is not None and "tau_load" not in run.inputs:
        omega = omega * np.sign(omega[np.argmax(np.abs(omega))])
        start, late, top = np.median(omega[:run.n // 20 + 1]), np.median(omega[run.n // 2:]), omega.max()
        if max(start, -omega.min()) < 0.5 * top < late:  # set off, and neither swings nor runs down
            return ("the voltage is 0 from beginning to end, yet the motor accelerates by itself: is it the wrong "
                    "column, was it not logged, or does a load drive it? Say which one holds it, columns={'v': ...}, "
                    "or leave the run out.")
    return (f"the voltage is {quantity(v[0], run.units['v'])} from beginning to end: such a run shows one "
            "steady speed, and the way there at most. Add runs with steps or a sweep of the voltage."
            ) if np.ptp(v) <= 1e-6 * np.abs(v).max() else None


def _still(run: Experiment) -> str | None:
    """Under one voltage a motor may run steadily, but neither its angle nor what reads zero may stay."""
    v = run.inputs["v"]
    still = [c for c, y in run.outputs.items() if np.nanmax(y) == np.nanmin(y) and v.any()
             and (np.ptp(v) > 0 or c == "theta" or not np.nanmax(y))]
    return (f"the {NAMES[still[0]]} never changes although there is a voltage; a dead sensor, a locked rotor, or too "
            "little voltage to move?") if still else None


def _disabled(run: Experiment) -> str | None:
    """At standstill a winding draws most per volt; where it draws next to nothing, it is not driven."""
    v, i, omega = run.inputs["v"], run.outputs.get("i"), _speed(run)
    if i is None or omega is None or run.units["v"] != "V" or not v.any() or run.n < 300:
        return None
    edges, i = np.linspace(0, run.n, 101).astype(int), bridged(run.t, i)
    volts, drawn, along, ahead = (np.add.reduceat(y, edges[:-1]) / np.diff(edges)
                                  for y in (np.abs(v), np.abs(i), i * np.sign(v), omega * np.sign(v)))
    top, on = np.maximum.reduceat(np.abs(v), edges[:-1]), volts > 0.1 * volts.max()
    usual, slow = np.quantile(along[on] / volts[on], 0.9) * volts, STILL * np.abs(ahead).max()
    off = on & (drawn < 0.2 * np.minimum(usual, drawn.max())) & (np.abs(ahead) < slow)
    least = top[on & (along > 0.5 * usual) & (ahead > -slow)].min(initial=np.inf)  # braking needs no drive
    ends = np.flatnonzero(np.diff(off.astype(int), prepend=0, append=0))
    parts = [f"{run.t[edges[a]]:.3g} to {run.t[edges[b] - 1]:.3g} s" for a, b in zip(ends[::2], ends[1::2], strict=True)
             if b - a >= 3 and top[a:b].max() >= least]  # shorter ones may be chance
    return (f"neither current nor motion follows the voltage from {' and from '.join(parts)}, while elsewhere the same "
            "voltage drives both: was the drive disabled? Leave these samples out, in the file or with run.select()."
            ) if parts else None


def _missing(run: Experiment) -> str | None:
    there = {c: np.flatnonzero(np.isfinite(y)) for c, y in run.outputs.items()}
    slower = {c: float(np.median(np.diff(rows))) if len(rows) > 1 else 1.0 for c, rows in there.items()}  # lacks none
    share = {c: 1 - len(rows) * slower[c] / run.n for c, rows in there.items()}
    worst = max(share, key=lambda c: share[c])
    return (f"{100 * share[worst]:.0f} % of the {NAMES[worst]} samples are missing; the fit uses the others. Look "
            "whether the logger drops them at certain moments.") if share[worst] > 0.2 else None


def _clipped(run: Experiment) -> str | None:
    for channel in (c for c in ("i", "omega") if c in run.outputs):
        y = run.outputs[channel][np.isfinite(run.outputs[channel])]
        for top in (y.max(), y.min()):
            others = np.diff(y[(y > y.min()) & (y < y.max())])
            repeats = np.count_nonzero(others == 0) > 0.5 * len(others)  # a sensor read more often than it measures
            if _at_stop(y, float(top)) and not repeats:
                share = 100 * float(np.mean(y == top))
                return (f"the {NAMES[channel]} stays at exactly {top:.4g} {run.units[channel]} in "
                        f"{share:.2g} % of the samples: clipped at the limit of the sensor or the drive. Use "
                        "a lower voltage, or mark these samples as missing.")
    return None


def current_limit(run: Experiment) -> str | None:
    """Say so where the current stays while the voltage does and the speed changes: not the winding holds it there."""
    i, omega, v = run.outputs.get("i"), run.outputs.get("omega"), run.inputs["v"]
    if i is None or omega is None or run.units["v"] != "V" or _clipped(run):
        return None
    top = float(np.nanmedian(np.abs(i)[np.abs(i) >= 0.95 * np.nanquantile(np.abs(i), 0.995)]))
    if (near := 4 * noise_level(i, run.t)) > 0.1 * top:
        return None
    ends = np.flatnonzero(np.diff((np.abs(np.abs(i) - top) < near).astype(int), prepend=0, append=0))
    clear = 0.2 * np.nanmax(np.abs(omega))  # no range with a missing sample is larger
    held = sum(b - a for a, b in zip(ends[::2], ends[1::2], strict=True)
               if b - a >= 10 and np.ptp(v[a:b]) < 0.02 * np.ptp(v) and np.ptp(omega[a:b]) > clear)
    if held < 0.02 * run.n:
        return None
    return (f"the current stays at {top:.3g} {run.units['i']} while the voltage stays and the speed changes "
            f"({100 * held / run.n:.0f} % of the samples): a current limit of the driver? Then the motor does not get "
            "the voltage that was logged. Use a lower voltage, log the voltage at the motor's terminals, or model it: "
            "mi.effects.driver_current_limit.")


def _at_stop(y: Array, top: float) -> bool:
    """Tell a channel that has run into a limit from one that rests, or reaches a level by itself."""
    there = y == top
    if top == 0 or there.sum() < 3 or there.all():
        return False
    if np.count_nonzero(y == y[~there][np.argmin(np.abs(y[~there] - top))]) >= there.sum():
        return False  # levels of a counter, wide apart where it times its pulses
    reach = np.ptp(y)
    step = quantum(y)
    entries = np.abs(y[np.flatnonzero(there[1:] & ~there[:-1])] - top)
    if there.sum() >= max(10, 0.01 * len(y)) and entries.size and np.median(entries) > max(3 * step, 0.005 * reach):
        return True
    if noise_level(y[~there]) <= max(1e-4 * reach, step) or (step and abs(top) < 0.1 * reach):  # a coarse one at rest
        return False
    between = np.sort(y[(y > y.min()) & (y < y.max())])
    stays = there.sum() > 3 and float(np.mean(there[1:][there[:-1]])) > 0.5  # where noise moves all others
    return stays or not (step or (np.diff(between) == 0).any())  # noise that is not rounded makes no two samples alike


def _coarse(run: Experiment) -> str | None:
    for channel, y in run.outputs.items():
        step, reach = quantum(y), float(np.nanmax(y) - np.nanmin(y))
        if 0 < reach < 16 * step:
            return (f"the {NAMES[channel]} moves in steps of {step:.3g} {run.units[channel]} and covers only "
                    f"{reach / step:.0f} of them, too few counts to fit well. Use more of the range, a finer sensor or "
                    "a longer counting time.")
    return None


def _spikes(run: Experiment) -> str | None:
    left = run.without_spikes()
    for channel, y in run.outputs.items():
        kept = np.isfinite(left.outputs[channel])
        if (far := np.flatnonzero(np.isfinite(y) & ~kept)).size:
            size = float(np.median(np.abs(y[far] - np.interp(run.t[far], run.t[kept], y[kept]))))
            return (f"{far.size} samples of the {NAMES[channel]} stand about {size:.2g} {run.units[channel]} "
                    "away from their neighbours: spikes of the sensor or the logger. Leave them out (--no-spikes, "
                    "run.without_spikes()), or fit with a loss that forgives outliers (--loss huber, loss=mi.Huber()).")
    return None


def unresolved(run: Experiment) -> str | None:
    """Say so where the voltage changed faster than its log: noise that no speed follows, or a sweep that folds back."""
    v, n = run.inputs["v"], run.n // PART
    if n < 4 or len(np.unique(v)) < LEVELS:
        return None
    parts = v[:n * PART].reshape(n, PART) - v[:n * PART].reshape(n, PART).mean(axis=1, keepdims=True)
    power = np.sum(parts**2, axis=1)
    strong = np.flatnonzero(power > 0.1 * power.max())
    turns = np.sum(parts[strong, 1:] * parts[strong, :-1], axis=1) / power[strong]  # cosine of its phase per sample
    what = next((f"the voltage seems to change faster than its samples can show from {run.t[strong[k] * PART]:.3g} s on"
                 for k in range(3, len(turns)) if turns[k] < -FAST and (np.diff(turns[k - 3:k + 1]) < 0).all()
                 and min(turns[:k].max(), turns[k:].max()) > FAST), "")
    if not what and len(turns) > 2 and abs(np.median(turns)) < WHITE and power.sum() > 0.5 * v @ v and _unanswered(run):
        what = "the voltage seems to change faster than its samples can show, at random: no speed follows it"
    return (f"{what}. The column does not tell what acted between its samples: log faster, or leave these samples out, "
            "in the file or with run.select().") if what else None


def _unanswered(run: Experiment) -> bool:
    """Tell whether means of the voltage, where noise is small, say next to nothing of those of the speed.

    A current would answer where friction or a heavy load lets no speed, and the slopes of an angle are mostly noise."""
    y = bridged(run.t, run.outputs["omega"]) if {"i", "omega"} & {*run.outputs} == {"omega"} else np.empty(0)
    if len(y) < PART**2 or abs(y.mean()) > 0.5 * y.std():  # it runs by itself
        return False
    a, b = (x[:len(x) // 10 * 10].reshape(-1, 10).mean(axis=1) for x in (run.inputs["v"], y))
    causes = np.column_stack([b[1:-1], b[:-2], np.ones(len(b) - 2), a[2:], a[1:-1], a[:-2]])
    own, all_ = (np.var(b[2:] - x @ np.linalg.lstsq(x, b[2:], rcond=None)[0]) for x in (causes[:, :3], causes))
    return bool(all_ > 0.75 * own)


def _noisy(run: Experiment) -> str | None:
    for channel, y in run.outputs.items():
        pairs = (seen := y[np.isfinite(y)])[:len(seen) // 2 * 2].reshape(-1, 2).mean(axis=1)  # none alternates
        alone = min(noise_level(y, run.t), 2**0.5 * noise_level(pairs) if len(pairs) > FEWEST_FRESH else np.inf)
        size, noise = float(np.nanstd(y)), min(alone, _beside_voltage(run, y))
        if noise > 0.5 * size > 0:
            return (f"the {NAMES[channel]} is mostly noise (RMS {min(noise, size):.2g} of {size:.2g} "
                    f"{run.units[channel]}) and tells a fit little. Drive the motor harder, or filter before "
                    "sampling" + (f"; or leave it out: --ignore {channel}." if len(run.outputs) > 1 else "."))
    return None


def _beside_voltage(run: Experiment, y: Array) -> float:
    """Return the standard deviation of what the voltage, now or two measurements before, does not explain of `y` (N,).

    What follows a voltage that jumps with every measurement looks like noise, and is none."""
    at = np.flatnonzero(np.isfinite(y))
    at = at[np.diff(y[at], prepend=np.nan) != 0]
    if len(at) < FEWEST_FRESH:
        return np.inf
    v = run.inputs["v"][at]
    causes = np.column_stack([v[2:], v[1:-1], v[:-2], np.ones(len(at) - 2)])
    return float(np.std(y[at[2:]] - causes @ np.linalg.lstsq(causes, y[at[2:]], rcond=None)[0]))


def _uneven(run: Experiment) -> str | None:
    low, high = np.quantile(steps := np.diff(run.t), (0.02, 0.98))
    return (f"sampling is uneven, {1e3 * low:.3g} to {1e3 * high:.3g} ms apart. Each sample is used at its own time; "
            "make sure that the stamps say when it was taken, not when it arrived."
            ) if np.mean(np.abs(steps - run.dt) > 0.25 * run.dt) > 0.05 else None


def _slow_sampling(run: Experiment) -> str | None:
    """After a voltage step the current must not be there at the next sample already."""
    if "i" not in run.outputs or run.units["v"] != "V":
        return None
    v, i = run.inputs["v"], run.outputs["i"]
    jumps = np.flatnonzero(np.abs(np.diff(v)) > 0.3 * np.ptp(v)) + 1
    jumps = jumps[jumps + 3 < run.n]
    rise = np.abs(i[jumps[:, None] + np.arange(4)] - i[jumps - 1][:, None])
    first, full = rise[:, :2].max(axis=1), rise.max(axis=1)  # the step itself may lie between two samples
    clear = full > 10 * noise_level(i, run.t)
    return (f"the current follows a voltage step within one sample ({1e3 * run.dt:.3g} ms): the sampling is too slow "
            "for the inductance, so L will be uncertain. Sample faster, or fix L at its data-sheet value."
            ) if clear.any() and float(np.median(first[clear] / full[clear])) > 0.9 else None


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
    return (f"the {NAMES[channel]} never settles while the voltage is constant; friction and steady state will be "
            "uncertain. Hold the voltage longer in at least one run."
            ) if drifts and min(drifts) > max(0.05 * reach, spread) else None


def _never_reverses(runs: Sequence[Experiment]) -> str | None:
    ends = [end for r in runs for end in (r.inputs["v"].min(), r.inputs["v"].max())] or [0.0]
    low, high = min(ends), max(ends)
    return ("the voltage never reverses in any run: effects that depend on the direction (dry friction against a "
            "constant load, asymmetry, backlash) cannot be distinguished. Add a run with both signs."
            ) if low > -0.02 * high or high < -0.02 * low else None


def signs(run: Experiment) -> str | None:
    """Positive voltage must drive positive current and, on the whole, positive speed."""
    if run.units["v"] != "V" and _speed_is_that_of_the_angle(run):
        return _accelerates_backwards(run)
    if "omega" in run.outputs:  # a motor that brakes goes against its voltage, too: the balances know
        order, turned = _as_balances_want(run)
        if order != (0, 1, 2):
            return None
    else:
        turned = [-1 if cosine < -0.4 else 1
                  for cosine in (_cosine(run.inputs["v"], run.outputs.get("i")), _speed_cosine(run))]
    against = [name for name, sign in zip(("current", "speed"), turned, strict=True) if sign < 0]
    measured = ["current"] * ("i" in run.outputs) + ["speed"] * bool({"omega", "theta"} & set(run.outputs))
    if not against:
        return None
    if len(against) == 2:
        return ("a positive voltage goes with a negative current and a negative speed: the sign of the "
                f"voltage is probably swapped. Turn it round, e.g. units={{'v': '-1 {_told(run, 'v')}'}}.")
    channel = "i" if against == ["current"] else "omega" if "omega" in run.outputs else "theta"
    else_ = " (or of the voltage)" if measured == against else ""
    what = channel_name("theta", run.units["theta"]) if channel == "theta" else against[0]
    goes = f"moves the {what} backwards" if channel == "theta" else f"goes with a negative {what}"
    return (f"a positive voltage {goes}: the sign of the {what}{else_} "
            f"is probably swapped. Turn it round, e.g. units={{'{channel}': '-1 {_told(run, channel)}'}}.")


def _speed_is_that_of_the_angle(run: Experiment) -> bool:
    """Tell whether a speed was measured, or slopes of the angle add up to it: of what is fast they turn the phase."""
    if "omega" in run.outputs or (speed := _speed(run)) is None:
        return True
    moved, added = (np.diff(y[::3]) for y in (bridged(run.t, run.outputs["theta"]), integral(run.t, speed)))
    return bool(np.std(moved - added) < 0.5 * np.std(moved))


def _accelerates_backwards(run: Experiment) -> str | None:
    """A commanded torque accelerates, but for friction and for what loads do: a constant one, a weight, a spring."""
    if (omega := _speed(run)) is None or run.n < 30:
        return None
    b = _Balances(run, [run.inputs["v"], omega])
    drive, drag, dry, *loads = (np.diff(y) for y in (b.sums[0], b.sums[2], b.signs[2], *b.loads[2]))
    others = [-drag, -dry, *(s * x for x in (b.sums[2][1:], *loads) for s in (1, -1))]
    left, turned = (_share_left(np.diff(b.at[2]), s * drive, *others) for s in (1, -1))
    return ("a positive voltage accelerates the axis backwards: the sign of the voltage (or of what was measured) is "
            f"probably swapped. Turn it round, e.g. units={{'v': '-1 {_told(run, 'v')}'}}."
            ) if turned < 0.5 * left else None


def _told(run: Experiment, channel: str) -> str:
    """Return the unit of a channel as its file has it: a sign that is turned round must not lose a scale."""
    return run.meta.get("original_units", {}).get(channel) or run.units[channel]


def unsigned(run: Experiment) -> str | None:
    """A motor that is driven both ways draws current both ways."""
    v = run.inputs["v"]
    both_ways = min(-v.min(), v.max()) >= 0.2 * np.abs(v).max()
    for c in (c for c in ("i", "omega") if both_ways and c in run.outputs):
        y, backward = run.outputs[c], v < -0.2 * np.abs(v).max()
        noise, runs = noise_level(y, run.t), c == "i" or _cosine(np.abs(v), y) > RUNNING  # not shaken
        if runs and np.nanmin(y) > -2 * noise and np.mean(backward) > 0.05 and np.nanmedian(y[backward]) > 5 * noise:
            return (f"the {NAMES[c]} is never negative although the voltage is in {100 * np.mean(v < 0):.0f} % of the "
                    f"samples: logged without its sign? A fit needs the sign; leave it out with --ignore {c}.")
    return None


def unsigned_voltage(run: Experiment) -> str | None:
    """A positive voltage that is switched on at rest turns the motor one way; a duty cycle without its sign, both."""
    v, turning = run.inputs["v"], run.outputs.get("theta", run.outputs.get("omega"))
    if turning is None or v.min() < 0 or not np.isfinite(turning).any():
        return None
    known = bridged(run.t, turning)
    angle = known if "theta" in run.outputs else integral(run.t, known)
    switched = np.flatnonzero(np.diff((v > 0.1 * v.max()).astype(int), prepend=0, append=0))
    on, off = switched[::2], np.minimum(switched[1::2], len(v) - 1)
    travel, before = angle[off] - angle[on], angle[on] - angle[np.maximum(on - 5, 0)]
    most = np.abs(travel).max(initial=0.0)
    travel = travel[(np.abs(before) < 0.02 * most) & (np.abs(travel) > 0.1 * most)]
    if not travel.size or travel.min() > 0 or travel.max() < 0:
        return _reverses_alone(run)
    return ("the voltage is never negative, yet switched on at rest it turns the motor backwards "
            f"{np.sum(travel < 0)} of {travel.size} times: logged without its sign? Give it that of the direction.")


def _reverses_alone(run: Experiment) -> str | None:
    """As fast backwards, under as much voltage, for more than a slip: no load does so, what swings is not `RUNNING`."""
    v, omega = run.inputs["v"], np.asarray(_speed(run))
    back, ahead = np.maximum(-omega, 0), np.maximum(omega, 0)
    short = any(min(f(back), f(ahead)) < share * f(np.abs(omega)) for f, share in ((np.max, 0.5), (np.sum, 0.02)))
    if short or _cosine(v, np.abs(omega)) < RUNNING or v @ back / back.sum() < 0.9 * (v @ ahead / ahead.sum()):
        return None
    return ("the speed reverses although the voltage never does, and is as fast both ways under as much of it: is the "
            "voltage without its sign (a duty cycle beside a direction)? Give it that of the direction.")


def angle_against_speed(run: Experiment) -> str | None:
    """The angle must advance by the integral of the speed."""
    if not {"omega", "theta"} <= set(run.outputs):
        return None
    theta, omega = run.outputs["theta"], run.outputs["omega"]
    edges = _block_edges(theta)
    if len(edges) < 6 or np.isfinite(omega).sum() < 2:
        return None
    travel, turned = np.diff(theta[edges]), np.diff(integral(run.t, bridged(run.t, omega))[edges])
    agree = _cosine(travel, turned)
    if np.std(travel) < 5 * noise_level(theta, run.t) or 0.5 < agree**2 < 0.8:  # beyond: most of one is not the other
        return None
    if abs(agree) < 0.9:
        name = channel_name("theta", run.units.get("theta", ""))
        return (f"the {name} does not follow from the speed (correlation of their changes {agree:.2g}): do both belong "
                "to the same axis? Leave one out, e.g. with --ignore theta.")
    if agree < 0:
        return ("the angle falls while the speed is positive: the sign of one of them is swapped. "
                f"Turn it round, e.g. units={{'theta': '-1 {_told(run, 'theta')}'}}.")
    ratio = float(np.sum(travel * turned) / np.sum(turned**2))
    if 0.8 < ratio < 1.25:
        return None
    nearest = min(_RATIOS, key=lambda r: abs(ratio / r - 1))
    known = abs(ratio / nearest - 1) < 0.08
    guess = f"as if {_RATIOS[nearest]}" if known else "a gear between the two sensors, or wrong counts per turn"
    return f"the angle advances {ratio:.4g} times as fast as the speed says: {guess}?"


TIMERS = (1023.0, 4095.0, 65535.0)  # whole duty cycles in counts of 10 to 16 bits


def magnitudes(run: Experiment) -> str | None:
    """Sizes no laboratory motor has point to a wrong unit."""
    stated = run.meta.get("original_units", {})
    limits = {"v": (1000.0, "V", "mV"), "i": (1000.0, "A", "mA"),
              "omega": (800.0 if "omega" in run.meta.get("assumed_units", ()) else 3000.0, "rad/s", "rpm")}
    for channel, (limit, unit, likely) in limits.items():
        values = run.inputs.get(channel, run.outputs.get(channel))
        if values is not None and run.units[channel] == unit and (top := float(np.nanmax(np.abs(values)))) > limit:
            was = f" (read as {stated[channel]})" if channel in stated else ""
            if channel == "v" and (top in TIMERS or stated.get(channel, "")[:1].isdigit()):
                one = 12 / top if top in TIMERS else 0.12
                return (f"v reaches {top:.5g} V{was}: is the column a duty cycle, in per cent or in counts of a timer? "
                        f"Then give the voltage of one: units={{'v': '{one:.2g} V'}}.")
            return f"{channel} reaches {top:.4g} {unit}{was}; {_remedy(run, channel, likely)}"
    if 1e-6 <= run.dt <= 0.2:
        return None
    raw = run.dt / (known.factor if (known := parse_unit(stated.get("t", "s"))) else 1.0)
    unit = next((u for u, size in (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)) if 1e-5 < raw * size < 0.2), "")
    asked = f"is the time in {unit}? If so: units={{'t': '{unit}'}}." if unit else "is the unit of the time right?"
    return f"there are {'only ' * (run.dt < 1e-6)}{run.dt:.3g} s between samples, which suits no motor; {asked}"


def _remedy(run: Experiment, channel: str, likely: str) -> str:
    """Ask for the likely unit of a channel that is too large; for its scale if it was read in that unit already."""
    stated, unit = parse_unit(_told(run, channel)), parse_unit(likely)
    if stated and unit and np.isclose(abs(stated.factor), unit.factor):
        return (f"it is read in {likely} already: is its scale right (of a speed: the counts per turn, the time over "
                f"which they were counted)? A factor can be given: units={{'{channel}': '0.01 {likely}'}}.")
    return f"is it in {likely}? If so: units={{'{channel}': '{likely}'}}."


def implied_constants(run: Experiment) -> str | None:
    """R and K from v = R·i + K·omega must be of a size that motors have."""
    if run.units["v"] != "V" or run.units.get("omega", "rad/s") != "rad/s":
        return None
    names = [c for c in ("i", "omega") if c in run.outputs]
    good = np.all([np.isfinite(run.outputs[c]) for c in names], axis=0) & np.ones(run.n, bool)
    if not names or good.sum() < 20 or np.std(run.inputs["v"]) == 0:
        return None
    rows = np.column_stack([run.outputs[c][good] for c in names])
    if not (size := np.abs(rows).max(axis=0)).all() or np.linalg.cond(rows / size) > 100:
        return None
    found = dict(zip(names, np.linalg.lstsq(rows, run.inputs["v"][good], rcond=None)[0], strict=True))
    K, R = found.get("omega", 1.0), found.get("i", 1.0)
    if 0 < K < 1e-3:
        return f"voltage over speed is {K:.2g} V·s/rad, far less than usual: the speed, {_remedy(run, 'omega', 'rpm')}"
    if 0 < R < 0.01:
        return f"voltage over current is {R:.2g} Ω, far less than usual: the current, {_remedy(run, 'i', 'mA')}"
    return (f"voltage over current is about {R:.2g} Ω, far more than motors have; is the current in A and not in mA, "
            "or the voltage in mV?") if R > 3000 else None


def _offset(run: Experiment) -> str | None:
    """At rest and without a voltage no current flows."""
    i, omega, v = run.outputs.get("i"), run.outputs.get("omega"), run.inputs["v"]
    if i is None or omega is None or run.units["v"] != "V":
        return None
    rest = (v == 0) & np.isfinite(i) & (np.abs(omega) <= 3 * noise_level(omega, run.t))
    level, most = float(np.median(i[rest])) if rest.sum() >= 20 else 0.0, float(np.nanmax(np.abs(i)))
    if abs(level) <= max(0.01 * most, 5 * noise_level(i, run.t) / np.sqrt(max(rest.sum(), 1))):
        return None
    return (f"the current reads {level:.2g} {run.units['i']} at rest without a voltage, where none flows: an offset of "
            "the sensor? Subtract it, or let the fit find it: mi.effects.current_offset.")


def swapped_columns(run: Experiment) -> str | None:
    """Columns that fit the balances of a motor in another order; a speed that jumps and holds still."""
    if (omega := run.outputs.get("omega")) is None:
        return None
    order, _ = _as_balances_want(run)
    if moved := [c for k, c in enumerate(("v", "i", "omega")) if order[k] != k]:
        what = " and ".join(NAMES[c] for c in moved)
        return (f"{what} fit the equations of a motor far better if their columns are exchanged. Say which is which: "
                f"columns={{{', '.join(f'{c!r}: ...' for c in moved)}}}.")
    known = omega[np.isfinite(omega)]
    jump, reach = float(np.abs(np.diff(known)).max(initial=0.0)), float(np.ptp(known))
    stays = _holds(omega) > 0.8 and _holds(run.inputs["v"]) < 0.3 and jump > 0.3 * reach > 0
    return ("the speed jumps and then stays exactly the same, while the voltage changes smoothly: are the two columns "
            "swapped? Say which is which: columns={'v': ..., 'omega': ...}."
            ) if stays and _follows(run.inputs["v"], omega) > 0.1 else None


def _as_balances_want(run: Experiment) -> Reading:
    """Return the order of v, i, omega, and the signs of i and omega, with which they fit the balances of a motor.

    What is stated stands, unless another reading leaves less than half unexplained, see `_Balances`. Columns are called
    exchanged only where the exchange explains both balances, and the sampling resolves them: of a record with gaps or a
    dead sensor anything explains a little more, of one sampled slowly nearly any reading explains all."""
    known = [c for c in ("i", "omega") if c in run.outputs and np.isfinite(run.outputs[c]).sum() > 1]
    stated: Reading = (0, 1, 2), (1, 1)
    if "omega" not in known or run.n < 30 or run.units["v"] != "V":  # a commanded torque or current obeys others
        return stated
    readings: list[Reading] = list(product(permutations(range(3)), product((1, -1), (1, -1))))
    if "i" not in known:  # the voltage drives in its place, and its own balance says nothing
        if _cosine(run.inputs["v"], run.outputs["omega"]) > ALONG:
            return stated
        readings = [stated, ((0, 1, 2), (1, -1))]
    balances = _Balances(run, [run.outputs["i"] if "i" in known else run.inputs["v"], run.outputs["omega"]])
    shares = {r: balances.unexplained(*r) for r in readings}
    left = {r: (voltage + RESOLVED if "i" in known else 1.0) * float(np.sqrt((speed + RESOLVED) * (drive + RESOLVED)))
            for r, (voltage, speed, drive) in shares.items()}
    if (best := min(left, key=lambda r: left[r]))[0] != stated[0]:
        speed = balances.y[best[0][2]]  # one less its correlation with the next sample: of white noise 1, of a motion 0
        coarse = float(np.mean(np.diff(speed) ** 2) / max(2 * np.var(speed), 1e-300)) > ROUGH
        if not coarse and max(shares[best]) <= EXPLAINED and left[best] < CLEAR * left[stated]:
            return best
        turned = min((r for r in left if r[0] == stated[0]), key=lambda r: left[r])
        best = stated if coarse and left[best] < CLEAR * left[turned] else turned
    return best if left[best] < 0.5 * left[stated] else stated


class _Balances:
    """Both balances of a motor, integrated over blocks, for any reading of the columns v, i, omega.

    The voltage: ∫v = R∫i + LΔi + K∫ω ± V·t, less of K∫ω where v is zero and the driver may have let go. The torque,
    from the first sample on since noise hides small steps of the speed: ω = ω₀ + k∫(i − load) − b∫ω − c∫sgn ω, solved
    for ω and for ∫i, as either may be the small difference of large terms: the speed of a motor that lifts slowly is.
    The load is a constant, a weight (sin θ, cos θ with θ = ∫ω), of `LOAD` times the largest current at most, and what
    friction takes up at standstill. A weight without limit is a spring, to the current what an inertia is to the speed.
    """

    def __init__(self, run: Experiment, outputs: Sequence[Array]) -> None:
        n = min(BALANCE_BLOCKS, run.n // 3)
        edges = np.linspace(0, run.n - 1, n + 1).astype(int)
        self.y = [run.inputs["v"], *(bridged(run.t, a) for a in outputs)]
        self.top = [max(float(np.abs(a).max()), 1e-300) for a in self.y]
        angles = [integral(run.t, a, k == 0 and run.hold == "zoh") for k, a in enumerate(self.y)]
        self.sums = [a[edges] for a in angles]
        self.signs = [integral(run.t, np.tanh(50 * a / top))[edges] for a, top in zip(self.y, self.top, strict=True)]
        self.t, self.one = run.t[edges] - run.t[0], np.ones(n + 1)
        self.loads = [(self.t, *(integral(run.t, f(a))[edges] for f in (np.sin, np.cos))) for a in angles]
        self.rest = {(w, i): integral(run.t, np.where(np.abs(self.y[w]) < STILL * self.top[w], self.y[i], 0.0))[edges]
                     for w, i in permutations(range(3), 2)}
        self.at = [a[edges] for a in self.y]
        self.driven = [np.add.reduceat(np.abs(a), edges[:-1]) > 0 for a in self.y]

    def unexplained(self, order: tuple[int, ...], turned: tuple[int, int]) -> tuple[float, float, float]:
        """Return the shares of the voltage, of the speed and of the drive that a reading leaves unexplained."""
        (v, i, w), (a, b) = order, turned
        terms = self.sums[v], a * self.sums[i], a * self.at[i], b * self.sums[w], self.t, -self.t
        blocks = [np.diff(y) for y in terms]
        blocks.append(np.where(self.driven[v], 0.0, -blocks[3]))
        drive, rest, most = a * b * self.sums[i], a * b * self.rest[w, i], LOAD * self.top[i]
        speed, losses = self.at[w] - self.at[w][0], [self.sums[w], self.signs[w]]
        loads = [sign * most * load for load in self.loads[w] for sign in (1, -1)]
        caused = [drive, drive - rest, *(drive + load for load in loads), *(-x for x in losses), self.one, -self.one]
        return (_share_left(*blocks), _share_left(speed, *caused),
                _share_left(drive, speed, *losses, rest, *loads, most=[np.inf] * 3 + [1.0] * (1 + len(loads))))


def _share_left(y: Array, *terms: Array, most: Sequence[float] | None = None) -> float:
    """Return the share of y² (N,) that no sum of positive multiples of `terms`, each up to `most`, explains."""
    from scipy.optimize import lsq_linear, nnls

    A, size = np.column_stack(terms), np.linalg.norm(y)
    norms = np.maximum(np.linalg.norm(A, axis=0), 1e-300)
    if size == 0:
        return 1.0
    if most is None:  # Lawson & Hanson 1974
        return float(nnls(A / norms, y / size)[1] ** 2)
    return float(2 * lsq_linear(A / norms, y / size, (0, np.asarray(most) * norms / size), method="bvls").cost)


def _cosine(a: Array, b: Array | None) -> float:
    if b is None:
        return 0.0
    good = np.isfinite(b)
    scale = np.sqrt(np.sum(a[good] ** 2) * np.sum(b[good] ** 2))
    return float(np.sum(a[good] * b[good]) / scale) if scale > 0 else 0.0


def _speed_cosine(run: Experiment) -> float:
    """Return the cosine of the integral of the voltage and the travel, where no speed was measured.

    Against a spring the angle itself follows the voltage: if only where it has come to rest under several of them."""
    if (theta := run.outputs.get("theta")) is None or len(edges := _block_edges(theta)) < 6:
        return 0.0
    v, angle = run.inputs["v"], bridged(run.t, theta)
    begins = np.r_[0, np.flatnonzero(np.abs(np.diff(v)) > 0.02 * np.ptp(v)) + 1, run.n]
    late = [slice(b - (b - a) // 3, b) for a, b in pairwise(begins.tolist()) if b - a >= 30]
    places = np.array([(v[s].mean(), angle[s].mean()) for s in late if np.ptp(angle[s]) < 0.1 * np.ptp(angle)])
    apart = len(places) > 3 and np.ptp(places[:, 0]) > 0.3 * np.ptp(v)
    against = _cosine(*(places - places.mean(axis=0)).T) if apart else 0.0
    # A controller stops against friction, too, and one of two voltages turns with its reference.
    against = max(against, _cosine(v - v.mean(), angle - angle.mean()), _follows(angle, v, 0.3 * np.ptp(v)))
    return min(_cosine(np.diff(integral(run.t, v)[edges]), np.diff(theta[edges])), against)


def _block_edges(theta: Array) -> NDArray[np.intp]:
    """Return the edges of blocks long enough to average noise and delay, at samples that are not missing."""
    known = np.flatnonzero(np.isfinite(theta))
    return known[np.unique(np.linspace(0, len(known) - 1, min(_BLOCKS, len(known) // 5) + 1).astype(int))]


def _follows(y: Array, cause: Array, least: float = 0.0) -> float:
    """Return the cosine of the jumps of a cause and the bends of y there; if only `least` jumps, of those that last.

    Near 1 where a speed follows a voltage, near -1 where a controller's voltage follows a speed that is sampled slowly.
    """
    at = np.flatnonzero(np.abs(np.diff(cause)) > least) + 1
    stays = np.diff(np.r_[0, at, len(cause)])
    near = np.maximum(np.minimum(stays[:-1], stays[1:]) // 4, 1)
    at, near = (x[near > 2 * (least > 0)] for x in (at, near))
    before = (y[at - 1] - y[np.maximum(at - 1 - near, 0)]) / near
    return _cosine(cause[at] - cause[at - 1], (y[np.minimum(at + near, len(y) - 1)] - y[at - 1]) / (near + 1) - before)


def _holds(values: Array) -> float:
    """Share of neighbours that are exactly equal, standstill apart."""
    live = np.isfinite(values[1:]) & (values[1:] != 0)
    return float(np.mean(np.diff(values)[live] == 0)) if live.sum() > 20 else 0.0


_CHECKS: tuple[Check, ...] = (signs, unsigned, unsigned_voltage, _disabled, angle_against_speed, magnitudes,
                              implied_constants, _one_column_for_two, swapped_columns, _offset, _excitation, _still,
                              _missing, _clipped, current_limit, _coarse, _spikes, _noisy, unresolved, _uneven,
                              _slow_sampling, _never_settles)
_CONTRADICTIONS: tuple[Check, ...] = (signs, unsigned, unsigned_voltage, angle_against_speed, swapped_columns)
