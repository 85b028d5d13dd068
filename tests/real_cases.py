"""The real records: where they are, and how each is parted into runs to fit and runs held out."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import motorid as mi
from motorid.records.experiment import split

Parts = tuple[list[mi.Experiment], list[mi.Experiment]]


def real_folder() -> Path | None:
    """MOTORID_REAL_DATA, or else shared/data/real in a folder above this file; None if there is none."""
    named = os.environ.get("MOTORID_REAL_DATA")
    if named:
        return Path(named) if Path(named).is_dir() else None
    for folder in Path(__file__).resolve().parents:
        place = folder / "shared" / "data" / "real"
        if place.is_dir():
            return place
    return None


@dataclass(frozen=True)
class Case:
    """One question to a diagnosis: what lacks `model` on the fitted runs, judged on the held-out ones.

    `thin`: every how many-th sample a brute-force search may take; its best models are fitted to all samples again.
    """

    name: str
    about: str
    parts: Callable[[Path], Parts]
    model: mi.Model
    thin: int = 1

    def thinned(self, parts: Parts) -> Parts:
        """Return the parts as a brute-force search takes them."""
        fitted, held = ([r.decimate(self.thin) for r in runs] for runs in parts)
        return fitted, held


DEGREES = {"columns": {"t": "t", "v": "u", "omega": "y"}, "units": {"omega": "deg/s"}}
EMPS = {"columns": {"t": "t_s", "v": "voltage_V", "theta": "position_m"}, "units": {"theta": "m"}}
XL330 = {"columns": {"t": "t_s", "v": "voltage_V", "theta": "position_rad"}}
PENDULUM = {"columns": {"t": "time", "v": "torque", "omega": "velocity", "theta": "position"}}


def _read(folder: Path, *files: str, **words: object) -> list[mi.Experiment]:
    return mi.read_runs([folder / f for f in files], **words)


def _halves(runs: list[mi.Experiment]) -> Parts:
    pairs = [split(run) for run in runs]
    return [a for a, _ in pairs], [b for _, b in pairs]


def _furuta(folder: Path, *ignored: str) -> Parts:
    random, step = _read(folder / "furuta_base", "random.csv", "step.csv")
    return [random.without(*ignored)], [step.without(*ignored)]


def _furuta_short(folder: Path) -> Parts:
    """As little as a small bench gives: 650 samples, current and speed."""
    return _halves([_furuta(folder, "theta")[0][0].select(slice(2000, 2650))])


def _unmotor(folder: Path) -> Parts:
    prbs, step = _read(folder / "unmotor", "prbs.csv", "step.csv", **DEGREES)
    return [prbs], [step]


def _unmotor_closed(folder: Path) -> Parts:
    """The profile rises and stays, then goes down; columns in the order t, r, y, u."""
    run = _read(folder / "unmotor_closed", "DCmotor_profile_closed_exp.csv", **DEGREES)[0]
    return [run.select(slice(0, 90))], [run.select(slice(90, None))]


def _fibo(folder: Path) -> Parts:
    chirp, stair, ramp = (r.decimate(5) for r in _read(folder / "fibo", "chirp.csv", "stair.csv", "ramp.csv"))
    return [chirp, stair], [ramp]


def _frc(folder: Path) -> Parts:
    slow, fast = (r.without("theta") for r in _read(folder / "frc", "slow_forward.csv", "fast_forward.csv"))
    return [slow], [fast]


def _frc_back(folder: Path) -> Parts:
    slow, fast = _frc(folder)
    return fast, slow


def _frc_halves(folder: Path) -> Parts:
    return _halves([r for runs in _frc(folder) for r in runs])


def _emps(folder: Path) -> Parts:
    return _halves([r.decimate(4) for r in _read(folder / "emps", "run.csv", **EMPS)])


def _odri_sine(folder: Path) -> Parts:
    sine, rolling = _read(folder / "odri_mn4004", "sine_current.txt", "rolling.txt")
    return [sine.select(slice(7000, 11000))], [rolling]


def _odri_rolling(folder: Path) -> Parts:
    return _halves(_read(folder / "odri_mn4004", "rolling.txt"))


def _xl330(folder: Path) -> Parts:
    kinds = ("sin_sin", "sin_time_square", "up_and_down", "lift_and_drop")
    runs = [r.without("omega") for r in _read(folder / "xl330", *(f"kp100_{k}.csv" for k in kinds), **XL330)]
    return runs[:3], runs[3:]


def _dfki(folder: Path) -> Parts:
    return _halves(_read(folder / "dfki_pendulum", "ddp_measured.csv", **PENDULUM))


MOTOR, SWINGING = mi.dc_motor(), mi.torque_driven() + mi.effects.gravity
AXIS = mi.torque_driven(axis="linear", g=35.15065)
CASES = {
    case.name: case
    for case in (
        Case("unmotor_closed", "closed loop: rise and plateau → plateau and fall", _unmotor_closed, MOTOR),
        Case("furuta_short", "i and omega, samples 2000 to 2650 of random: first half → second", _furuta_short, MOTOR),
        Case("unmotor", "PRBS → step", _unmotor, MOTOR, 2),
        Case("emps", "every 4th sample: first half → second", _emps, AXIS, 2),
        Case("frc", "omega: slow → fast", _frc, MOTOR, 3),
        Case("frc_back", "omega: fast → slow", _frc_back, MOTOR),
        Case("frc_halves", "omega: first halves of both → second halves", _frc_halves, MOTOR, 2),
        Case("furuta_speed", "omega alone: random → step", lambda f: _furuta(f, "i", "theta"), MOTOR, 4),
        Case("fibo", "every 5th sample: chirp and stair → ramp", _fibo, MOTOR, 4),
        Case("dfki_pendulum", "torque drive, gravity in the model: first half → second", _dfki, SWINGING),
        Case("xl330", "gravity in the model, theta, kp100: three motions → lift and drop", _xl330, SWINGING, 2),
        Case("odri_sine", "4 s of sine_current → rolling", _odri_sine, MOTOR, 2),
        Case("odri_rolling", "rolling: first half → second", _odri_rolling, MOTOR),
        Case("furuta_base", "all channels: random → step", _furuta, MOTOR, 4),
    )
}
