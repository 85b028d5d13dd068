"""The line protocol between a bench and the computer, version 1.

Everything, both ways, is a frame of printable ASCII on a line of its own::

    $<kind>,<field>,<field>…*<CRC>\\n

with the CRC-16/CCITT-FALSE (polynomial 0x1021, start 0xFFFF, check value 29B1 for "123456789") of the bytes between
``$`` and ``*``, as four upper-case hexadecimal digits. A frame ends with its CRC; the newline is for the eye. A body
has 1 to 240 bytes and holds neither ``$`` nor ``*``, so a reader finds its feet at the next ``$``.

From the device
    ``H,1,<name>,<rate_Hz>,<counter bits>,<timer bits>,<V_max V>,<I_max A>,<most segments>,<channel>…``
        The header. A channel is ``name:unit:scale:offset:kind``, its value in SI ``scale·(raw − offset)``; kind: ``n``
        (a number), ``a12`` (12 bits, whose end values mean *clipped*) or ``w16`` (a counter that wraps after 16 bits).
    ``D,<counter>,<time µs>,<raw>…``
        One sample, raw values in the order of the channels, integer or decimal, empty where missing. ``v`` is the
        voltage commanded *from* this instant on, the other channels are measured *at* it. Counter and timer wrap.
    ``A,<command>,…``
        A command was carried out: ``A,L,<mV>,<mA>`` (the limits now in force), ``A,S,<index>``,
        ``A,G,<counter of the first sample>,<its time µs>``.
    ``E,done,<samples made>,<why>``, why: ``end``, ``stop``, ``limit``, ``emergency``, ``silent``; ``E,refused,<why>``.

From the computer
    ``?`` send the header · ``L,<mV>,<mA>`` set limits and forget the program · ``S,<index>,<segment>`` one
    segment of the excitation (see `motorid.acquire.excitation`) · ``G,<segments>`` go, once per ``L`` · ``X``
    stop · ``K`` still here; a device at rest answers it with its last ``E,done``.

A device that hears no valid frame for one second switches the motor off. A command may be repeated without harm."""

import math
import re
from binascii import crc_hqx
from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

from motorid.channels import MEASURED_INPUTS, UNITS
from motorid.errors import DeviceError, printable

VERSION = 1
LONGEST = 240
SILENCE = 1.0  # s without a word from the computer after which a device switches the motor off
# What drives the motor is a voltage.
PERMITTED = {c: u for c, u in UNITS.items() if c not in MEASURED_INPUTS} | {"v": UNITS["v"][:1]}

_FRAME = re.compile(rb"\$([^$*\r\n]{1,240})\*([0-9A-F]{4})")
_UNFINISHED = re.compile(rb"\$[^$*\r\n]{0,240}(?:\*[0-9A-F]{0,3})?")  # may still become a frame
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,15}")


def crc16(body: bytes) -> int:
    """Return the CRC-16/CCITT-FALSE of `body`."""
    return crc_hqx(body, 0xFFFF)


def frame(*fields: object) -> bytes:
    """Return one line, with CRC and newline; ValueError where too long, or with ``$ *`` or control characters."""
    body = ",".join(map(str, fields)).encode("ascii")
    if not 1 <= len(body) <= LONGEST or any(c < 32 or c in b"$*\x7f" for c in body):
        raise ValueError(f"not a frame of the protocol: {body!r}")
    return b"$%b*%04X\n" % (body, crc16(body))


@dataclass(frozen=True)
class Channel:
    """One measured (or commanded) channel of a device: value = scale·(raw − offset), in `unit`."""

    name: str
    unit: str
    scale: float = 1.0
    offset: float = 0.0
    kind: str = "n"

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise DeviceError(f"'{self.name}' is not a channel name (letters, digits, at most 16 of them).")
        if self.unit not in PERMITTED.get(self.name, (self.unit,)):
            raise DeviceError(f"channel {self.name} must be scaled to {' or '.join(PERMITTED[self.name])}; "
                              f"the device says '{self.unit}'.")
        if not (math.isfinite(self.scale) and self.scale != 0 and math.isfinite(self.offset)):
            raise DeviceError(f"channel {self.name}: scale {self.scale} and offset {self.offset} must be "
                              "finite and the scale not zero.")
        if not re.fullmatch(r"n|[aw]([2-9]|[1-5][0-9]|6[0-4])", self.kind):
            raise DeviceError(f"channel {self.name}: kind '{self.kind}' is none of n, a<bits>, w<bits>.")

    @property
    def span(self) -> int:
        """Number of raw values (2 to the number of bits), 0 for a plain number."""
        return 1 << int(self.kind[1:]) if self.kind != "n" else 0

    @property
    def wraps(self) -> bool:
        """Whether the raw value is a counter that wraps around."""
        return self.kind[0] == "w"


@dataclass(frozen=True)
class Header:
    """What a device says about itself."""

    name: str
    rate: float  # samples per second
    channels: tuple[Channel, ...]
    counter_bits: int = 32
    timer_bits: int = 32
    v_max: float = math.inf
    i_max: float = math.inf
    segments: int = 32

    def __post_init__(self) -> None:
        if not 0 < self.rate <= 1e6 or not (8 <= self.counter_bits <= 64 and 24 <= self.timer_bits <= 64):
            raise DeviceError(f"the header of '{self.name}' makes no sense: {self.rate} samples per second, "
                              f"counter of {self.counter_bits} bits, timer of {self.timer_bits} bits.")
        if not (self.v_max > 0 and self.i_max > 0 and self.segments >= 1):
            raise DeviceError(f"the header of '{self.name}' makes no sense: limits of {self.v_max} V and "
                              f"{self.i_max} A, {self.segments} segments.")
        names = [c.name for c in self.channels]
        if len(set(names)) < len(names) or "v" not in names or len(names) < 2:
            raise DeviceError("a device must send v, the commanded voltage, and something measured, each "
                              f"once; '{self.name}' sends {', '.join(names) or 'nothing'}.")

    @property
    def fields(self) -> tuple[object, ...]:
        """The header as the fields of its frame."""
        return ("H", VERSION, self.name, f"{self.rate:.9g}", self.counter_bits, self.timer_bits,
                f"{self.v_max:.6g}", f"{self.i_max:.6g}", self.segments,
                *(f"{c.name}:{c.unit}:{c.scale:.9g}:{c.offset:.9g}:{c.kind}" for c in self.channels))

    @classmethod
    def read(cls, fields: list[str]) -> "Header":
        """Make a header from the fields of its frame; DeviceError for another version, or what cannot be."""
        if len(fields) < 2 or fields[1] != str(VERSION):
            raise DeviceError(f"the device speaks version {''.join(fields[1:2]) or '?'} of the protocol, "
                              f"this motorid version {VERSION}. Update the older one.")
        try:
            channels = tuple(Channel(name, unit, float(scale), float(offset), kind)
                             for name, unit, scale, offset, kind in (word.split(":") for word in fields[9:]))
            return cls(fields[2], float(fields[3]), channels, int(fields[4]), int(fields[5]), float(fields[6]),
                       float(fields[7]), int(fields[8]))
        except (IndexError, ValueError) as error:
            raise DeviceError(f"the device's header cannot be read ({error}): {','.join(fields)}") from None


class Sample(NamedTuple):
    """One sample as it came: wrapped counter, wrapped time in µs, raw values (NaN where missing)."""

    counter: int
    time: int
    raw: tuple[float, ...]


class Message(NamedTuple):
    """Any other frame: its fields, the first of them the kind."""

    fields: list[str]


@dataclass
class Decoder:
    """Takes bytes in pieces of any size, which makes no difference, and returns the frames in them. Arbitrary bytes
    never raise: what was no valid frame is counted in `bad`: ``wrong CRC`` (frames), ``cut`` (a ``$`` that never became
    a frame), ``not understood`` (a valid CRC around nonsense), and ``stray bytes`` outside of frames."""

    bad: Counter[str] = field(default_factory=Counter)
    seen: int = 0  # bytes
    _rest: bytes = b""

    def feed(self, data: bytes) -> list[Sample | Message]:
        """Return the frames completed by `data`."""
        self.seen += len(data)
        buffer = self._rest + data
        found: list[Sample | Message] = []
        end = 0
        for match in _FRAME.finditer(buffer):
            self._discard(buffer[end:match.start()])
            end = match.end()
            if crc16(match[1]) != int(match[2], 16):
                self.bad["wrong CRC"] += 1
            elif (read := _read(match[1])) is None:
                self.bad["not understood"] += 1
            else:
                found.append(read)
        keep = buffer.rfind(b"$", end)
        keep = keep if keep >= 0 and _UNFINISHED.fullmatch(buffer, keep) else len(buffer)
        self._discard(buffer[end:keep])
        self._rest = buffer[keep:]
        return found

    def close(self) -> None:
        """Count what is left of a frame that will not be finished."""
        self._discard(self._rest)
        self._rest = b""

    def _discard(self, junk: bytes) -> None:
        if stray := len(junk) - junk.count(b"\n") - junk.count(b"\r"):
            self.bad["stray bytes"] += stray
            self.bad["cut"] += junk.count(b"$")


def _read(body: bytes) -> Sample | Message | None:
    try:
        if not body.startswith(b"D,"):
            return Message(printable(body.decode("ascii")).split(","))
        _, counter, time, *raw = body.split(b",")
        values = [float(r) if r else math.nan for r in raw]
    except ValueError:  # no number, too few of them, or not ASCII
        return None
    known = tuple([r if math.isfinite(r) else math.nan for r in values])
    good = counter.isdigit() and time.isdigit() and any(map(math.isfinite, values))
    return Sample(int(counter), int(time), known) if good else None
