"""Does a run make physical sense? Signs, units and swapped columns, told in plain words with what to do."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motorid.channels import NAMES
from motorid.numerics.noise import noise_level
from motorid.numerics.signals import Array, bridged, integral
from motorid.records.experiment import Experiment

_BLOCKS = 40
# Ratio of the angle's rate to the speed, and what was then mistaken for SI.
_RATIOS = {
    2 * np.pi / 60: "the speed in rpm: units={'omega': 'rpm'}",
    60 / (2 * np.pi): "the speed already in rad/s although rpm is stated: units={'omega': 'rad/s'}",
    np.pi / 180: "the speed in deg/s: units={'omega': 'deg/s'}",
    180 / np.pi: "the angle in degrees: units={'theta': 'deg'}",
    2 * np.pi: "the speed in turns per second: units={'omega': 'rev/s'}",
    1 / (2 * np.pi): "the angle in turns: units={'theta': 'rev'}",
    6.0: "the speed in rpm and the angle in degrees: units={'omega': 'rpm', 'theta': 'deg'}",
    1000.0: "one of them in thousandths",
    1e-3: "one of them in thousandths",
}


def signs(run: Experiment) -> str | None:
    """Positive voltage must drive positive current and, on the whole, positive speed."""
    v = run.inputs["v"]
    against = [name for name, cosine in (("current", _cosine(v, run.outputs.get("i"))),
                                         ("speed", _speed_cosine(run))) if cosine < -0.4]
    measured = [n for n, here in (("current", "i" in run.outputs), ("speed", _has_speed(run))) if here]
    if not against:
        return None
    if len(against) == 2:
        return ("a positive voltage goes with a negative current and a negative speed: the sign of the "
                "voltage is probably swapped. Turn it round, e.g. units={'v': '-1 V'}.")
    channel, unit = ("i", "A") if against == ["current"] else ("omega" if "omega" in run.outputs else "theta",
                                                               "rad/s" if "omega" in run.outputs else "rad")
    else_ = " (or of the voltage)" if measured == against else ""
    return (f"a positive voltage goes with a negative {against[0]}: the sign of the {against[0]}{else_} "
            f"is probably swapped. Turn it round, e.g. units={{'{channel}': '-1 {unit}'}}.")


def unsigned(run: Experiment) -> str | None:
    """A motor that is driven both ways draws current both ways."""
    v = run.inputs["v"]
    for c in ("i", "omega"):
        y = run.outputs.get(c)
        if y is None or min(-v.min(), v.max()) < 0.2 * np.abs(v).max():
            continue
        backward, noise = v < -0.2 * np.abs(v).max(), noise_level(y, run.t)
        if np.nanmin(y) > -2 * noise and np.mean(backward) > 0.05 and np.nanmedian(y[backward]) > 5 * noise:
            return (f"the {NAMES[c]} is never negative although the voltage is in {100 * np.mean(v < 0):.0f} % of the "
                    f"samples: logged without its sign? A fit needs the sign; leave it out with --ignore {c}.")
    return None


def angle_against_speed(run: Experiment) -> str | None:
    """The angle must advance by the integral of the speed."""
    if not {"omega", "theta"} <= set(run.outputs):
        return None
    travel, integral = _block_travel(run)
    if len(travel) < 5 or np.std(travel) < 5 * noise_level(run.outputs["theta"], run.t):
        return None
    scale = float(np.sqrt(np.sum(travel**2) * np.sum(integral**2)))
    if scale == 0 or abs(agree := float(np.sum(travel * integral)) / scale) < 0.9:
        return None
    if agree < 0:
        return ("the angle falls while the speed is positive: the sign of one of them is swapped. "
                "Turn it round, e.g. units={'theta': '-1 rad'}.")
    ratio = float(np.sum(travel * integral) / np.sum(integral**2))
    if 0.8 < ratio < 1.25:
        return None
    known = next((text for r, text in _RATIOS.items() if abs(ratio / r - 1) < 0.08), None)
    guess = f"as if {known}" if known else "a gear between the two sensors, or wrong counts per turn"
    return f"the angle advances {ratio:.4g} times as fast as the speed says: {guess}?"


def magnitudes(run: Experiment) -> str | None:
    """Sizes no laboratory motor has point to a wrong unit."""
    stated = run.meta.get("original_units", {})
    assumed = "omega" in run.meta.get("assumed_units", ())
    limits = {"v": (1000.0, "V", "mV"), "i": (1000.0, "A", "mA"),
              "omega": (800.0 if assumed else 3000.0, "rad/s", "rpm")}
    for channel, (limit, unit, likely) in limits.items():
        values = run.inputs.get(channel, run.outputs.get(channel))
        if values is None or run.units[channel] != unit:
            continue
        top = float(np.nanmax(np.abs(values)))
        if top > limit:
            was = f" (read as {stated[channel]})" if channel in stated else ""
            return (f"{channel} reaches {top:.4g} {unit}{was}; is it in {likely}? "
                    f"If so: units={{'{channel}': '{likely}'}}.")
    if run.dt > 0.2:
        return (f"there are {run.dt:.3g} s between samples, too long for a motor; is the time in ms? "
                "If so: units={'t': 'ms'}.")
    if run.dt < 1e-6:
        return f"there are only {run.dt:.3g} s between samples; is the unit of the time right?"
    return None


def implied_constants(run: Experiment) -> str | None:
    """R and K from v = R·i + K·omega must be of a size that motors have."""
    if run.units["v"] != "V" or run.units.get("omega", "rad/s") != "rad/s":
        return None
    names = [c for c in ("i", "omega") if c in run.outputs]
    good = np.all([np.isfinite(run.outputs[c]) for c in names], axis=0) & np.ones(run.n, bool)
    if not names or good.sum() < 20 or np.std(run.inputs["v"]) == 0:
        return None
    rows = np.column_stack([run.outputs[c][good] for c in names])
    size = np.abs(rows).max(axis=0)
    if not size.all() or np.linalg.cond(rows / size) > 100:
        return None
    found = dict(zip(names, np.linalg.lstsq(rows, run.inputs["v"][good], rcond=None)[0], strict=True))
    K, R = found.get("omega", 1.0), found.get("i", 1.0)
    if 0 < K < 1e-3:
        return (f"voltage over speed is about {K:.2g} V·s/rad, far less than motors have; is the speed "
                "in rpm or deg/s? If so: units={'omega': 'rpm'}.")
    if 0 < R < 0.01:
        return (f"voltage over current is about {R:.2g} Ω, far less than motors have; is the current in "
                "mA? If so: units={'i': 'mA'}.")
    if R > 3000:
        return (f"voltage over current is about {R:.2g} Ω, far more than motors have; is the current in "
                "A and not in mA, or the voltage in mV?")
    return None


def swapped_columns(run: Experiment) -> str | None:
    """A commanded voltage may jump and then hold still; a speed cannot."""
    omega = run.outputs.get("omega")
    if omega is None:
        return None
    if _holds(omega) > 0.8 and _holds(run.inputs["v"]) < 0.3 and _jumps(omega):
        return ("the speed jumps and then stays exactly the same, while the voltage changes smoothly: "
                "are the two columns swapped? Say which is which: columns={'v': ..., 'omega': ...}.")
    return None


def _cosine(a: Array, b: Array | None) -> float:
    if b is None:
        return 0.0
    good = np.isfinite(b)
    scale = np.sqrt(np.sum(a[good] ** 2) * np.sum(b[good] ** 2))
    return float(np.sum(a[good] * b[good]) / scale) if scale > 0 else 0.0


def _has_speed(run: Experiment) -> bool:
    return bool({"omega", "theta"} & set(run.outputs))


def _speed_cosine(run: Experiment) -> float:
    if "omega" in run.outputs:
        return _cosine(run.inputs["v"], run.outputs["omega"])
    if "theta" not in run.outputs or len(edges := _edges(run, "theta")) < 6:
        return 0.0
    travel = np.diff(run.outputs["theta"][edges])
    pushed = np.diff(integral(run.t, run.inputs["v"])[edges])
    return _cosine(pushed, travel)


def _block_travel(run: Experiment) -> tuple[Array, Array]:
    """Advance of the angle and integral of the speed over blocks long enough to average noise and delay."""
    edges = _edges(run, "theta")
    omega = run.outputs["omega"]
    if np.isfinite(omega).sum() < 2:
        return np.empty(0), np.empty(0)
    filled = bridged(run.t, omega)
    return np.diff(run.outputs["theta"][edges]), np.diff(integral(run.t, filled)[edges])


def _edges(run: Experiment, channel: str) -> NDArray[np.intp]:
    known = np.flatnonzero(np.isfinite(run.outputs[channel]))
    return known[np.unique(np.linspace(0, len(known) - 1, min(_BLOCKS, len(known) // 5) + 1).astype(int))]


def _holds(values: Array) -> float:
    """Share of neighbours that are exactly equal, standstill apart."""
    live = np.isfinite(values[1:]) & (values[1:] != 0)
    return float(np.mean(np.diff(values)[live] == 0)) if live.sum() > 20 else 0.0


def _jumps(values: Array) -> bool:
    return float(np.nanmax(np.abs(np.diff(values)))) > 0.3 * float(np.nanmax(values) - np.nanmin(values)) > 0
