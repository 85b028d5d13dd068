"""The computer's half of the conversation: ask, wait for the answer, ask again if it got lost."""

from __future__ import annotations

import math
import time

from motorid.acquire.excitation import Program
from motorid.acquire.link import Link, LinkLost
from motorid.acquire.protocol import Decoder, Header, Message, Sample, frame
from motorid.errors import DeviceError

__all__ = ["Client"]

BOOT = 4.0  # s: opening the port resets many boards
AGAIN = 0.4  # s after which an unanswered command is repeated
ANSWER = 3.0  # s after which it is given up
KEEP_ALIVE = 0.2  # s


class Client:
    """Talks to a device over a link."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self.decoder = Decoder()
        self.inbox: list[Sample | Message] = []  # came while an answer was awaited, and is not it
        self._spoken = 0.0

    def receive(self, timeout: float) -> list[Sample | Message]:
        """Return what comes within `timeout` s, sooner if something does."""
        data = self.link.read(timeout)
        return self.decoder.feed(data) if data else []

    def keep_alive(self) -> None:
        """Tell the device, every 0.2 s, that somebody is listening."""
        now = time.monotonic()
        if now - self._spoken > KEEP_ALIVE:
            self.link.write(frame("K"))
            self._spoken = now

    def hello(self) -> Header:
        """Return the header of the device, having stopped whatever it did.

        Raises
        ------
        DeviceError
            If nobody answers in the protocol, with a guess at why.
        """
        try:
            header = Header.read(self.ask("?", "H", within=BOOT))
        except TimeoutError:
            raise DeviceError(self._nobody()) from None
        except LinkLost as error:
            raise DeviceError(f"{error} Nobody had answered yet: is it in use by another recorder?") from None
        self.ask("X", "E,done")
        return header

    def prepare(self, header: Header, v_max: float, i_max: float, program: Program) -> tuple[float, float]:
        """Send limits and program; return the limits now in force, in V and A.

        Raises
        ------
        DeviceError
            If the device refuses, or does not accept the limits.
        """
        v, i = min(v_max, header.v_max), min(i_max, header.i_max)
        _, _, mv, ma = self.ask(f"L,{_milli(v)},{_milli(i)}", "A,L")
        if int(mv) > _milli(v) or int(ma) > _milli(i):
            raise DeviceError(f"the device was told to stay within {v:g} V and {i:g} A and answers with "
                              f"{int(mv) / 1e3:g} V and {int(ma) / 1e3:g} A. Nothing was applied to the "
                              "motor.")
        for k, segment in enumerate(program.segments):
            self.ask(",".join(map(str, ("S", k, *segment.fields))), f"A,S,{k}")
        return int(mv) / 1e3, int(ma) / 1e3

    def go(self, segments: int) -> tuple[int, int]:
        """Start the run; return counter and device time (µs) of its first sample."""
        self.inbox.clear()
        answer = self.ask(f"G,{segments}", "A,G")
        return int(answer[2]), int(answer[3])

    def ask(self, command: str, answer: str, within: float = ANSWER) -> list[str]:
        """Send a command until its answer comes, and return the answer's fields.

        Raises
        ------
        TimeoutError
            If it does not come (a DeviceError for every command but the first).
        DeviceError
            If the device refuses.
        """
        end, wanted = time.monotonic() + within, answer.split(",")
        while (now := time.monotonic()) < end:
            self.link.write(frame(command))
            again = now + AGAIN
            while (left := again - time.monotonic()) > 0:
                got = self.receive(left)
                for k, item in enumerate(got):
                    if isinstance(item, Sample):
                        self.inbox.append(item)
                    elif item.fields[:len(wanted)] == wanted and _complete(item.fields):
                        self.inbox += got[k + 1:]
                        return item.fields
                    elif item.fields[:2] == ["E", "refused"]:
                        raise DeviceError(f"the device refuses '{command}': {','.join(item.fields[2:])}.")
        if command == "?":
            raise TimeoutError
        raise DeviceError(f"the device did not answer '{command}' within {within:g} s.")

    def _nobody(self) -> str:
        seen, bad = self.decoder.seen, sum(self.decoder.bad.values())
        if not seen:
            return (f"nothing answered within {BOOT:g} s. Is it the right port, and does the board run the "
                    "motorid firmware?")
        why = "none of it in the protocol. Is the baud rate right?" if bad else "but no header came."
        return f"no bench answered within {BOOT:g} s: {seen} bytes came, {why}"


def _complete(fields: list[str]) -> bool:
    """Whether an answer carries the whole numbers it has to."""
    numbers = {"L": 2, "S": 1, "G": 2, "done": 1}.get(fields[1] if len(fields) > 1 else "", 0)
    if fields[0] == "H":
        return True
    found = fields[2:2 + numbers]
    return len(found) == numbers and all(f.isdigit() for f in found)


def _milli(value: float) -> int:
    return min(2_000_000_000, math.floor(value * 1e3 + 1e-6)) if math.isfinite(value) else 2_000_000_000
