"""What is known about a recording, while it goes on and afterwards."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from motorid.acquire.protocol import Header
from motorid.display.display import Shown

__all__ = ["COMPLETE", "Progress", "Recording"]

# Why a recording ended -> the sentence that says so.
SENTENCES = {
    "done": "The excitation ran to its end.",
    "duration": "The time asked for is over; the motor was stopped.",
    "interrupted": "Stopped by hand; the motor was stopped.",
    "limit": "The current limit was reached; the motor was switched off. Lower the voltage or raise the "
             "limit.",
    "emergency": "The emergency stop of the bench was opened; the motor was switched off.",
    "watchdog": "The device heard nothing from this computer for a second and switched the motor off.",
    "unplugged": "The device is gone (unplugged, or its port was closed). Plug it in again and go on with "
                 "--resume.",
    "silent": "The device stopped talking. See whether it is powered, then go on with --resume.",
    "restarted": "The device restarted in the middle of the run (a reset, or its supply broke down). Go on "
                 "with --resume.",
    "disk": "The disk refused the data; the motor was stopped. Make room, then go on with --resume.",
}
COMPLETE = ("done", "duration", "interrupted")


@dataclass(frozen=True)
class Progress:
    """A glance at a running recording."""

    elapsed: float  # s of device time
    total: float | None  # s, where the end is known
    rate: float  # samples per second of device time that came, lately
    received: int
    lost: int
    last: Mapping[str, float]  # latest value per channel, SI


@dataclass(frozen=True, eq=False, repr=False)
class Recording(Shown):
    """The outcome of `record`; the data are in the file.

    Attributes
    ----------
    path : Path
    header : Header
        Of the device, as calibrated.
    ended : str
        ``done``, ``duration``, ``interrupted``, ``limit``, ``emergency``, ``watchdog``, ``unplugged``,
        ``silent``, ``restarted`` or ``disk``.
    detail : str
        What the system said, for the last ones.
    received, lost : int
        Valid samples, and samples that the device made and that never came.
    tail_known : bool
        Whether the device told how many samples it made, so that `lost` covers the end of the run too.
    seconds : float
        Length of the run, device time.
    bad : mapping of str to int
        Lines (and bytes) that were not valid or not usable, by reason. They explain losses, they are not
        added to them.
    clipped : mapping of str to int
        Samples at the end of a converter's range, by channel.
    """

    path: Path
    header: Header
    ended: str
    detail: str
    received: int
    lost: int
    tail_known: bool
    seconds: float
    bad: Mapping[str, int]
    clipped: Mapping[str, int]

    @property
    def complete(self) -> bool:
        """Whether the recording ended the way it was meant to, or by hand."""
        return self.ended in COMPLETE

    @property
    def sentence(self) -> str:
        """Why it ended, for people."""
        return SENTENCES[self.ended] + (f" ({self.detail})" if self.detail else "")

    @property
    def meta(self) -> dict[str, object]:
        """The outcome as it is written at the end of the file."""
        lost = str(self.lost) + ("" if self.tail_known else " before the last one received, then unknown")
        return {"ended": self.ended, "samples received": self.received, "samples lost": lost,
                **({"not valid": _list(self.bad)} if self.bad else {}),
                **({"clipped": _list(self.clipped)} if self.clipped else {})}

    def __str__(self) -> str:
        made = self.received + self.lost
        share = f" ({100 * self.lost / made:.3g} %)" if self.lost else ""
        gaps = f"{self.lost} lost{share}, {'marked as missing' if self.lost else 'nothing missing'}"
        lines = [self.sentence, f"{self.path}: {self.received} samples, {self.seconds:.6g} s; {gaps}."]
        if not self.tail_known:
            lines.append("Whether the device made more samples after the last one received is not known.")
        if self.bad:
            lines.append(f"Not valid: {_list(self.bad)}.")
        if self.clipped:
            lines.append(f"At the end of the converter's range: {_list(self.clipped)}. Use a wider range.")
        return "\n".join(lines)


def _list(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{n} {what}" for what, n in counts.items())
