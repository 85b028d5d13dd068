"""Why a refit must not be believed, whatever its error: signs, limits, phases, what the data leave open."""

from collections.abc import Sequence

import numpy as np
import scipy

from motorid.diagnosis.model_comparison import far
from motorid.diagnosis.thresholds import MATERIAL
from motorid.display.numbers import listed, number, percent
from motorid.estimation.covariance import UNDETERMINED
from motorid.estimation.fit import leaves_noise
from motorid.estimation.result import Fit
from motorid.model.definition import Effect, Parameter
from motorid.numerics.signals import Array, integral, noise_level, quantum, window_slopes
from motorid.problem.runs import angle_signal

KNOWN = 0.3  # of a parameter, its standard deviation: determined
MOST_LOST = 0.6  # of the largest voltage that a drop or a dead band may be
MOST_OFFSET = 0.3  # and an offset, which turns the motor by itself
HOTTEST = 300.0  # K above the surroundings: enamel of the best class ends at 220 °C, magnets' use at 350
MELTS = 1060.0  # K above the surroundings: copper
READ_BACK = 0.5  # of the noise of the angle: 0.02 on a real arm that hung from an elastic shaft, at most 1 elsewhere
RUNS_ON = 0.1  # of its highest speed: slower is near enough to a stop; and of the travel: an impact is less deep
EMPTY = "{} goes to zero with it, although the data determine it without it"
EMPTIED = 1e-2  # of its value before: it has vanished
LENGTHS = ("rad", "m")  # a gap that runs to its limit is none


def objections(fit: Fit, added: Effect, before: Fit | None = None) -> str:
    """Say why the refit must not be believed: a wrong sign, a shape at its limit; empty if it may be.

    `before` is the fit without the effect."""
    pars = [fit.problem.model.parameters[p.name] for p in added.parameters]
    for p, declared in zip(pars, added.parameters, strict=True):
        if p.at_least and fit.values[p.name] < 0.98 * fit.values[p.at_least]:
            return f"{p.name} < {p.at_least}, which is not physical"
        shaped = (added.includes and added.balance != "voltage") or p.unit in LENGTHS  # a driver's ramp may be any
        if p.grid and p.vary and shaped and not 1.02 * p.lower < fit.values[p.name] < 0.98 * p.upper:
            return f"{p.name} runs to its limit: nothing of this shape is in the records"
        if p.vary and p.null is not None and not p.positive and fit.values[p.name] <= p.lower == p.null:
            return f"{p.name} goes to {p.null:g}: the records show none of it, or only with the wrong sign"
        others = fit.per_run.get(p.name, {}).values() if p.per_run else ()
        values = [fit.values[p.name], *(own["value"] for own in others)]
        for limit, sign in ((p.upper, 1), (p.lower, -1)):
            physical = np.isfinite(limit) and limit in (declared.upper, declared.lower)  # not set for these records
            if p.vary and physical and sign * limit > 0 and max(sign * v for v in values) > 0.98 * sign * limit:
                return f"{p.name} runs to {limit:g}, the limit of what is physical"
    why = (_too_large(fit, pars) or _alike(fit, added) or unresolved(fit, added) or _belied(fit, added)
           or _blurred(fit, added))
    return why or (_emptied(fit, added, before) if before else "")


def _alike(fit: Fit, added: Effect) -> str:
    """Say so where the sizes that tell an effect from a simpler one differ by a trifle, as a smooth sgn makes too."""
    sizes = [fit.values[p.name] for p in added.parameters if p.null == 0 and p.unit in ("N·m", "N")]
    if added.includes and len(sizes) > 1 and max(sizes) - min(sizes) < MATERIAL * max(sizes):
        return f"its sizes differ by less than {percent(MATERIAL, 1)}: no more than {added.includes[0]}"
    return ""


def run_through(fit: Fit, added: Effect) -> str:
    """Say so where the motor runs on through a stop; what the end of a record cuts off may be an impact."""
    for p in (p for p in added.parameters if p.name in ("theta_lo", "theta_hi")):
        sign = 1 if p.name == "theta_hi" else -1
        for s in (s for s in fit.simulations if "theta" in s.states):
            omega, depth = sign * s.states["omega"], sign * (s.states["theta"] - fit.values[p.name])
            for k in np.split(np.arange(len(depth)), np.flatnonzero(np.diff(depth > 0)) + 1):
                far = k[-1] + 1 < len(depth) or np.max(depth[k]) > RUNS_ON * np.ptp(depth)
                if depth[k[0]] > 0 and far and np.min(omega[k[0] : k[-1] + 2]) > RUNS_ON * np.max(np.abs(omega)):
                    return f"the motor runs on through {p.name} = {number(fit.values[p.name], 3)} {p.unit}"
    return ""


def certain(fit: Fit) -> dict[str, float | None]:
    """Return one standard deviation per parameter; None for a size within two of them from zero: that is no answer."""
    sizes = {n for n, p in fit.model.parameters.items() if p.positive or p.null == 0}
    return {n: None if n in sizes and s is not None and s > UNDETERMINED * abs(fit.values[n]) else s
            for n, s in fit.std.items()}


def undetermined(fit: Fit, effect: Effect, wholly: bool = False) -> str:
    """Say which parameters of an effect the records leave open, as voltages too, `wholly` only if it has no others."""
    own = [p for p in effect.parameters if fit.problem.model.parameters[p.name].vary]
    known = {n for n, s in (certain(fit) if wholly else fit.std).items() if s is not None}
    found = [p.name for p in own if not p.per_run and not {p.name, f"{p.name}_voltage"} & {*known, *fit.determined}]
    least, left = (max(len(own), 1), "") if wholly else (1, ", and the rest is not noise")
    return f"{listed(found)} {'are' if found[1:] else 'is'} not determined{left}" if len(found) >= least else ""


def _blurred(fit: Fit, added: Effect) -> str:
    """Say so where the measured angle that leads effects is read back, or uncertain by a radian of a phase."""
    if fit.problem.model.angle_input and fit.misfit.get("theta", 1.0) < READ_BACK:  # no prediction errs so little
        return "with it the measured angle, which leads effects, predicts itself"
    if not (fit.problem.model.angle_input and any(p.periodic for p in added.parameters)):
        return ""
    order = max((fit.values[p.name] for p in added.parameters if p.order), default=1.0)
    noise = min(r.sigma.get("theta", 0.0) for r in fit.problem.runs)  # 0 where it is the integral of the speed
    return f"the angle that it follows is measured to {number(noise, 2)} rad" if order * noise > 1 else ""


def _too_large(fit: Fit, pars: Sequence[Parameter]) -> str:
    """Say so where a size is more than the motor has: voltage, torque, or heat, for which others have paid."""
    top = max(float(np.abs(r.inputs["v"]).max()) for r in fit.problem.experiments)
    if any(p.unit in ("K", "K/W") for p in pars) and (rise := hottest(fit)) > HOTTEST:
        what = f"{'magnets' if pars[0].name == 'alpha_m' else 'winding'} would be {'over ' if rise > MELTS else ''}"
        return f"the {what}{min(rise, MELTS):.0f} K warmer, which none stands"
    for p in pars:
        if p.vary and p.unit in ("N·m", "N") and any(q.order for q in pars):
            made = max(fit.values["g"] * top if "g" in fit.values else
                       fit.values["K"] * float(np.abs(s.states["i"]).max()) for s in fit.simulations)
            if fit.values[p.name] > made > 0:
                return f"{p.name} is {number(fit.values[p.name] / made, 2)} times the largest torque of the motor"
        holds = fit.values.get("g", fit.values.get("K", 0.0) / max(fit.values.get("R", 1.0), 1e-300)) * top
        beside = {"tau_cp": "tau_cn", "tau_cn": "tau_cp"}.get(p.name)  # it turns that way; what coasts, either
        stalls = fit.values[beside] < holds if beside else p.name == "tau_0" and far(fit)  # a load may drag it
        if stalls and p.vary and abs(fit.values[p.name]) > holds > 0:
            share = number(abs(fit.values[p.name]) / holds, 2)
            return f"{p.name} is {share} times what the motor holds at the largest voltage"
        most = MOST_OFFSET if p.lower < 0 else MOST_LOST
        if p.vary and p.unit == "V" and p.null == 0 and abs(fit.values[p.name]) > most * top:
            size = f"{percent(abs(fit.values[p.name]) / top, 2)} of" if top else "more than"
            return f"{p.name} = {fit.values[p.name]:.3g} V is {size} the largest voltage, which is not plausible"
    return ""


def hottest(fit: Fit) -> float:
    """Return by how much winding or magnets heat up at most, K; beyond `MELTS` resistance is that of nothing."""
    return max((np.abs(s.states[n]).max() for s in fit.simulations for n in s.states if n[:2] == "dT"), default=0.0)


def _emptied(fit: Fit, added: Effect, before: Fit) -> str:
    """Say so where a sensor's effect does away with a parameter of the motor that the data had determined.

    Friction of another kind may well take the place of all of the viscous one; a sensor cannot take the place of an
    inductance, it only buys its gain there, unless that is all: a model far from its data determines what is not there.
    """
    if added.balance != "sensor":
        return ""
    known = zip(before.problem.unknown, before.certainty("white").std, strict=True)
    for p, std in () if leaves_noise(fit) and far(before) else known:
        was, now = (f.values.get(p.name, 0.0) for f in (before, fit))
        told = (fit.std.get(p.name) or np.inf) < KNOWN * now  # small, but not zero: what was missing had made it large
        if p.positive and std is not None and std < KNOWN * was and now < EMPTIED * was and not told:
            return EMPTY.format(p.name)
    own = before.determined.get("time_constant")  # of records without a current J alone is open
    if own is None or own.std > KNOWN * own.value or "time_constant" in fit.determined:
        return ""
    return EMPTY.format("the motor's own lag") if (fit.tau_m or np.inf) < EMPTIED * own.value else ""


def _belied(fit: Fit, added: Effect) -> str:
    """Say so where the speed and the angle, as measured, agree better without an effect of the speed's sensor.

    What a sensor, late by T, makes of a turn Δθ adds up to (1 + k_w)·Δθ − T·Δω + w_0·Δt, whatever moves the motor."""
    known = {"k_w": 1.0, "w_0": 1.0, "T_w": 1.0, "T_d": 1.0, "T_a": 0.5}
    own, errors = {p.name for p in added.parameters} & set(known), {True: 0.0, False: 0.0}
    for run in (r for r in fit.problem.experiments if own and {"omega", "theta"} <= set(r.outputs)):
        good = np.isfinite(run.outputs["omega"]) & np.isfinite(run.outputs["theta"])
        t, omega, theta = run.t[good], run.outputs["omega"][good], run.outputs["theta"][good]
        step = max(len(t) // PARTS, 1)
        told, turn, change, time = (np.diff(y[::step]) for y in (integral(t, omega), theta, omega, t))
        for present in errors:
            at = {n: known[n] * fit.values.get(n, 0.0) * (present or n not in own) for n in known}
            late = at["T_w"] + at["T_d"] + at["T_a"]
            errors[present] += float(np.sum((told - (1 + at["k_w"]) * turn + late * change - at["w_0"] * time) ** 2))
    return "speed and angle, as measured, agree better without it" if errors[True] > errors[False] else ""


PARTS = 200  # of a run, in which a turn and the speed meanwhile are compared
PASSAGE = 10  # samples that a motion through the shape must give
FINEST = 4.0  # steps or standard deviations of the angle that it must be wide
OFTEN = 0.75  # of the passages may be faster
STARTED = 0.1  # of the width that counts as having left the turning point


def unresolved(fit: Fit, effect: Effect) -> str:
    """Say which shape of a friction that takes a simpler one's place these samples cannot show; empty if none."""
    if not effect.includes or effect.balance != "torque":
        return ""  # a gap shows in how its far side strikes, however quickly the near side passes through it
    for p in (fit.problem.model.parameters[q.name] for q in effect.parameters):
        value, std = fit.values[p.name], fit.std.get(p.name)
        known = std is not None and std < KNOWN * value and not far(fit)  # a fit that leaves noise alone determines it
        if known or not (p.positive and p.vary and p.null is None):
            continue
        if why := (_too_fine(fit, value) or _too_quick(fit, value) if p.unit in LENGTHS else
                   _too_slow(fit, value) if p.unit in ("rad/s", "m/s") else ""):
            return f"{p.name} = {value:.3g} {p.unit} cannot be seen in these samples: {why}"
    return ""


def _too_fine(fit: Fit, width: float) -> str:
    seen = [r for r in fit.problem.experiments if "theta" in r.outputs]
    steps = [max(quantum(r.outputs["theta"]), noise_level(r.outputs["theta"], r.t)) for r in seen]
    return "the angle is not measured so finely" if steps and width < FINEST * min(steps) else ""


def _too_quick(fit: Fit, width: float) -> str:
    passages = [n for r in fit.problem.experiments for n in samples_within(angle_signal(r), 2 * width)]
    usual = float(np.quantile(passages, OFTEN)) if passages else 0.0
    return f"the motion passes through it within {usual:.0f} samples" if usual < PASSAGE else ""


def _too_slow(fit: Fit, speed: float) -> str:
    seen = [(r, r.outputs.get("omega")) for r in fit.problem.experiments]
    speeds = [np.abs(window_slopes(r.t, angle_signal(r)) if y is None else y[np.isfinite(y)]) for r, y in seen]
    below = sum(int(((s < 2 * speed) & (s > 1e-6 * s.max(initial=0.0))).sum()) for s in speeds)
    return f"only {below} samples in motion are so slow" if below < PASSAGE else ""


def samples_within(angle: Array, width: float) -> list[int]:
    """Count, for each turning point of `angle` (N,), the samples on the way from it to a distance of `width`."""
    peaks, valleys = (scipy.signal.find_peaks(side, prominence=width)[0].tolist() for side in (angle, -angle))
    turns, found = sorted([0, *peaks, *valleys]), []
    for a, b in zip(turns, [*turns[1:], len(angle)], strict=True):
        away = np.abs(angle[a:b] - angle[a]) / width
        left = np.flatnonzero(away > 1)
        found.append(int((away[: left[0] if len(left) else b - a] > STARTED).sum()))
    return found
