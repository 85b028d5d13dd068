"""A bench made of software: a motor with a hidden effect behind a converter and an encoder, speaking the protocol.

`VirtualDevice` knows no wire or clock, `server` serves it in real time; its plant shares no code with the models."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from motorid.acquire.excitation import Program, Segment
from motorid.acquire.protocol import SILENCE, Channel, Decoder, Header, Message, frame
from motorid.channels import CHANNELS
from motorid.errors import UsageError, among, at_least, one_of, otherwise
from motorid.records.datasets import load_plant

LINES_PER_TURN = 4096  # encoder counts, after quadrature
NOISE = 0.5  # standard deviation of the converters' noise, in counts
BLOCK = 256  # samples whose noise is drawn at once
SIGNED = ("phi", "_0", "k_w", "b_a")  # in names of parameters that may be negative
OVER_LIMIT = 3  # samples in a row beyond the current limit that switch the motor off
STEP = 100  # samples that one reading of the wire makes


class VirtualDevice:
    """A device that answers commands and makes samples of `channels`, ``v`` first, `rate` times a second. Its counters
    begin at `counter0` and `time0`; in every run the shaft of the motor `truth` begins at rest at angle zero."""

    def __init__(self, truth: "Truth", rate: float = 1000.0,
                 channels: tuple[str, ...] = ("v", *CHANNELS), counter_bits: int = 32,
                 timer_bits: int = 32, counter0: int = 0, time0: int = 0, encoder_bits: int = 32) -> None:
        self.truth, m = truth, truth.motor
        # A count of a converter has three significant digits, as a header would say it.
        current, speed = (float(f"{most / 2048:.3g}")
                          for most in (1.25 * max(m.i_max, m.v_max / m.R), 1.3 * m.no_load_speed))
        known = {"v": Channel("v", "V", 1e-3), "i": Channel("i", "A", current, 2048, "a12"),
                 "omega": Channel("omega", "rad/s", speed, 2048, "a12"),
                 "theta": Channel("theta", "rad", 2 * math.pi / LINES_PER_TURN, 0, f"w{encoder_bits}")}
        for name in channels:
            among(name, known, "channel")
        self.header = Header("virtual motor", rate, tuple(known[c] for c in channels), counter_bits,
                             timer_bits, m.v_max, m.i_max)
        self._rng = np.random.default_rng([truth.seed, 1])
        self._decoder = Decoder()
        self._counter, self._time = counter0, time0
        self._limits = m.v_max, m.i_max
        self._segments: list[Segment] = []
        self._armed, self.running = False, False
        self._start: tuple[int, int] = (counter0, time0)
        self._made, self._over, self._why = 0, 0, "end"
        self._noise: list[list[float]] = []
        self._program, self._length = Program(), 0
        self.heard = 0.0  # clock of the computer when the last valid frame came

    def receive(self, data: bytes, now: float = 0.0) -> bytes:
        """Take bytes from the computer at clock `now` (s) and return the answers."""
        messages = [item for item in self._decoder.feed(data) if isinstance(item, Message)]
        self.heard = now if messages else self.heard
        return b"".join([self._answer(m.fields) for m in messages])

    def watch(self, now: float) -> bytes:
        """Switch the motor off if nobody has been heard for a second; return what there is to say."""
        return self._stop("silent") if self.running and now - self.heard > SILENCE else b""

    def run(self, n: int) -> list[bytes]:
        """Make up to n samples and return their frames; the last one is followed by ``E,done``."""
        frames: list[bytes] = []
        while self.running and len(frames) < n:
            frames.append(self._stop("end") if self._made >= self._length and self._segments else self._sample())
            if self._over >= OVER_LIMIT:
                frames.append(self._stop("limit"))
        return frames

    def _sample(self) -> bytes:
        mv = round(1e3 * (self._program.at(self._made, self.header.rate) or 0.0))
        seen = {"v": mv / 1e3, **self._plant.measured()}
        if not self._made % BLOCK:
            self._noise = self._rng.normal(0.0, NOISE, size=(BLOCK, 2)).tolist()
        noise: dict[str, float] = dict(zip(("i", "omega"), self._noise[self._made % BLOCK], strict=True))
        # At the start of a run the shaft stands in the middle of a count; what a converter shows ends with its counts.
        raw = ((c, round(seen[c.name] / c.scale + c.offset + noise.get(c.name, 0.0))) for c in self.header.channels)
        sent = [min(max(n, 0), c.span - 1) if c.span and not c.wraps else n for c, n in raw]
        line = frame("D", self._counter, self._time, *sent)
        self._over = self._over + 1 if abs(seen["i"]) > self._limits[1] else 0
        self._plant.step(mv / 1e3, 1 / self.header.rate)
        self._made += 1
        self._counter = (self._counter + 1) % (1 << self.header.counter_bits)
        self._time = (self._start[1] + round(self._made * 1e6 / self.header.rate)) % (1 << self.header.timer_bits)
        return line

    def _answer(self, fields: list[str]) -> bytes:
        handlers: dict[str, Callable[..., bytes]] = {
            "?": lambda: frame(*self.header.fields), "L": self._set_limits, "S": self._add_segment, "G": self._go,
            "X": lambda: self._stop("stop"), "K": lambda: b"" if self.running else self._done()}
        if (handler := handlers.get(fields[0])) is None:
            return frame("E", "refused", "unknown command")
        no_sense = frame("E", "refused", "the numbers make no sense")
        return otherwise(no_sense, (TypeError, ValueError, UsageError), lambda: handler(*fields[1:]))

    def _set_limits(self, mv: str, ma: str) -> bytes:
        if self.running:
            return frame("E", "refused", "running")
        m = self.truth.motor
        v, i = min(int(mv), round(m.v_max * 1e3)), min(int(ma), round(m.i_max * 1e3))
        self._limits, self._segments, self._armed = (v / 1e3, i / 1e3), [], True
        return frame("A", "L", v, i)

    def _add_segment(self, index: str, shape: str, ms: str, *args: str) -> bytes:
        segment, k = Segment(shape, int(ms), tuple(map(int, args))), int(index)
        if not self._armed or not 0 <= k <= min(len(self._segments), self.header.segments - 1):
            return frame("E", "refused", "segment out of turn")
        if segment.peak > self._limits[0] + 1e-9:
            return frame("E", "refused", "voltage limit")
        self._segments[k:] = [segment]
        return frame("A", "S", k)

    def _go(self, segments: str) -> bytes:
        if self._armed:
            if int(segments) != len(self._segments):
                return frame("E", "refused", "segments are missing")
            self._program = Program(tuple(self._segments))
            self._length = self._program.count(self.header.rate)
            self._plant = load_plant().Plant(self.truth.motor, self.truth.effects)
            self._start, self._made, self._over = (self._counter, self._time), 0, 0
            self._armed, self.running = False, True
        return frame("A", "G", *self._start)

    def _stop(self, why: str) -> bytes:
        if self.running:
            self.running, self._why = False, why
        return self._done()

    def _done(self) -> bytes:
        return frame("E", "done", self._made, self._why)


class VirtualLink:
    """A wire to a virtual device in this process, as fast as it is read."""

    def __init__(self, device: VirtualDevice) -> None:
        self.device, self._out = device, b""

    def write(self, data: bytes) -> None:
        """Send to the device."""
        self._out += self.device.receive(data, time.monotonic())

    def read(self, timeout: float) -> bytes:
        """Return what the device says, after its next samples."""
        data, self._out = self._out + b"".join(self.device.run(STEP)), b""
        if not data:
            time.sleep(min(timeout, 0.002))
        return data

    def simulate(self, t: Any, v: Any) -> dict[str, np.ndarray]:
        """Return what the motor would really do from rest with the voltage `v` (N,), V, constant between times `t` (s).

        Returns
        -------
        dict of str to ndarray, shape (N,)
            ``i`` (A), ``omega`` (rad/s) and ``theta`` (rad) without any sensor; the device itself stays as it is.
        """
        truth = self.device.truth
        done = load_plant().simulate(truth.motor, truth.effects, t, v)
        return {c: done[f"true_{c}"] for c in CHANNELS}

    def close(self) -> None:
        """Leave the device as it is: it can be opened again."""


def virtual_bench(effect: str = "random", motor: str = "lab", seed: int = 0, rate: float = 1000.0) -> VirtualLink:
    """Return a bench made of software, in the place of a port: ``record(virtual_bench("coulomb"), "run.csv", …)``.

    Parameters
    ----------
    effect, motor, seed
        What is hidden in which motor; see `hide`.
    rate : float
        Samples per second.

    Examples
    --------
    >>> bench = mi.virtual_bench("coulomb")
    >>> done = mi.record(bench, "run2.csv", excite="chirp:4:1:20:0.5", limit_voltage=8)
    >>> runs = mi.read_runs("run2.csv")
    >>> omega = bench.simulate(runs[0].t, runs[0].inputs["v"])["omega"]  # the truth, without sensors
    """
    at_least(0, seed=seed)
    return VirtualLink(VirtualDevice(hide(effect, motor, seed), rate))


@dataclass(frozen=True, eq=False)
class Truth:
    """The motor and what is hidden in it."""

    motor: Any
    effects: dict[str, dict[str, float]]
    seed: int

    def __str__(self) -> str:
        m = self.motor
        hidden = [f"{name} ({', '.join(f'{k} = {v:.4g}' for k, v in values.items())})"
                  for name, values in self.effects.items()]
        return (f"hidden: {'; '.join(hidden) or 'nothing'}\nmotor '{m.name}', seed {self.seed}: R = {m.R:.5g} Ω, L = "
                f"{m.L:.5g} H, K = {m.K:.5g} V·s/rad, b = {m.b:.5g} N·m·s/rad, J = {m.J:.5g} kg·m²")


def hide(words: str = "random", motor: str = "lab", seed: int = 0) -> Truth:
    """Choose a motor and what is hidden in it; UsageError for a name or a number that is not known. `words` are
    ``none``, ``random``, or effects joined by commas, each bare (its size is drawn) or with its numbers:
    ``coulomb:tau_c=0.01,brush_drop``. The constants of `motor` are drawn within 10 % of the plant's."""
    plant = load_plant()
    among(motor, plant.MOTORS, "motor")
    rng = np.random.default_rng(seed)
    nominal = plant.MOTORS[motor]
    real = replace(nominal, **{k: getattr(nominal, k) * float(rng.uniform(0.9, 1.1)) for k in "RLKbJ"})

    def draw(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    words = str(rng.choice(list(plant.SIZES))) if words == "random" else words
    effects = dict(_effect(word, real, draw) for word in words.split(",") if word and word != "none")
    try:
        plant.Plant(real, effects)
    except ValueError as error:
        raise UsageError(str(error)) from None
    return Truth(real, effects, seed)


def _effect(word: str, motor: Any, draw: Callable[..., float]) -> tuple[str, dict[str, float]]:
    name, *numbers = word.strip().split(":")
    plant = load_plant()
    known = {**plant.LIBRARY, **plant.BEYOND}
    if name not in known:
        raise UsageError(one_of(name, ["none", "random", *known], "effect"))
    if numbers:
        try:
            given = {k: float(v) for k, v in (n.split("=") for n in numbers)}
        except ValueError:
            raise UsageError(f"'{word}': numbers are given as {name}:name=value:name=value.") from None
        for key, value in given.items():
            if not math.isfinite(value) or (value < 0 and not any(s in key for s in SIGNED)):
                raise UsageError(f"'{word}': {key} must be a size, finite and not negative; got {value:g}.")
        return name, given
    if name not in plant.SIZES:
        raise UsageError(f"no size is drawn for '{name}'; spell its numbers out, as in {name}:name=value. "
                         f"Drawn are: {', '.join(plant.SIZES)}.")
    return name, plant.SIZES[name](motor, draw)
