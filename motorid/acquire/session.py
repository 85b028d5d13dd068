"""A recording session: take what comes, keep the device awake, notice every way in which it can end."""

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from motorid.acquire.client import Client, LinkLost
from motorid.acquire.protocol import Header, Message, Sample, frame
from motorid.acquire.record_file import Commanded, RecordFile, Row, Timeline
from motorid.display.cards import Card, Flag, Shown

OVER_LIMIT = 3  # samples in a row beyond a limit that make the computer stop the motor too
EMPTY = 5  # readings in a row without a valid line, at least, that make a silence
LAST_WORDS = 1.5  # s to wait for the device to say how many samples it made
LOOK = 0.25  # s between two reports of progress
# The device's word for why it ended -> ours; else done.
REASONS = {"limit": "limit", "emergency": "emergency", "silent": "watchdog", "stop": "interrupted"}
# Why a recording ended -> the sentence that says so.
SENTENCES = {
    "done": "The excitation ran to its end.",
    "duration": "The time asked for is over; the motor was stopped.",
    "interrupted": "Stopped by hand; the motor was stopped.",
    "limit": "The current limit was reached; the motor was switched off. Lower the voltage or raise the limit.",
    "voltage": "The device reports a voltage beyond the limit; the motor was switched off. Look at its firmware.",
    "emergency": "The emergency stop of the bench was opened; the motor was switched off.",
    "overrun": "The device did not stop at the end of the excitation; the motor was stopped. Look at its firmware.",
    "watchdog": "The device heard nothing from this computer for a second and switched the motor off.",
    "unplugged": "The device is gone (unplugged, or its port was closed). Plug it in again and continue with --resume.",
    "silent": "The device stopped sending. Check its power, then continue with --resume.",
    "restarted": "The device restarted during the run (a reset, or its supply failed). Continue with --resume.",
    "disk": "The disk refused the data; the motor was stopped. Make room, then continue with --resume."}
COMPLETE = ("done", "duration", "interrupted")


@dataclass(eq=False)
class Session:
    """Starts the device, records until something ends it, stops it, says what came of it. Fields are settled before."""

    client: Client
    header: Header  # channels calibrated
    file: RecordFile
    segments: int
    commanded: Commanded
    most: Mapping[str, float]  # V and A: beyond it the computer stops the motor, too
    total: float | None  # s, of the program or until stopped
    duration: float | None  # s after which to stop
    timeout: float
    progress: "Callable[[Progress], None] | None"

    def __post_init__(self) -> None:
        self.ended, self.detail = "", ""
        self.made: int | None = None  # samples that the device made, once it has said so
        self.last: Row | None = None
        names = [c.name for c in self.header.channels]
        self._limits = [(names.index(n), n, most) for n, most in self.most.items() if n in names]
        self._over, self._empty = 0, 0
        self.client.decoder.bad.clear()
        counter, micros = self.client.go(self.segments)
        self._heard = time.monotonic()
        self._reported = self._heard, 0, 0.0  # clock, samples and device time of the last report
        self.timeline = Timeline(self.header, counter, micros, self._heard)

    def run(self) -> "Recording":
        """Record to the end."""
        try:
            with _stop_by_signal(lambda: self._end("interrupted")):
                self._record()
                self._last_words()
        except BaseException:
            with contextlib.suppress(LinkLost):
                self.client.link.write(frame("X"))
            raise
        return self._close()

    def _record(self) -> None:
        items, now = self.client.inbox, self._heard
        try:
            while True:
                self._take(items, now)
                self.file.flush()
                self._watch(now)
                if self.ended:  # only here: what was received is on its way to the disk
                    return
                self.client.keep_alive()
                items, now = self.client.receive(0.05), time.monotonic()
                self._empty = 0 if items else self._empty + 1
        except LinkLost as error:
            self._end("unplugged", str(error))
        except OSError as error:
            self._end("disk", f"{error.strerror}; {self.file.lines} whole lines are in the file")

    def _take(self, items: list[Sample | Message], now: float) -> None:
        for item in items:
            if isinstance(item, Message):
                self._message(item.fields)
            elif rows := self.timeline.accept(item, now):
                self.file.add(rows, self.commanded)
                self.last, self._heard = rows[-1], now
                for row in rows:
                    over = [n for k, n, most in self._limits if abs(row.values[k]) > most]
                    self._over = self._over + 1 if over else 0
                    if self._over >= OVER_LIMIT:
                        self._end("limit" if "i" in over else "voltage")

    def _message(self, fields: list[str]) -> None:
        made = int(fields[2]) if fields[:2] == ["E", "done"] and "".join(fields[2:3]).isdigit() else None
        if fields[0] == "H" or (made is not None and made < self.timeline.next_index):
            self._end("restarted")
        elif made is not None:
            self.made = made
            self._end(REASONS.get("".join(fields[3:4]), "done"))

    def _end(self, why: str, detail: str = "") -> None:
        if not self.ended:
            self.ended, self.detail = why, detail

    def _watch(self, now: float) -> None:
        elapsed = self.last.time if self.last else 0.0
        if self.duration is not None and elapsed >= self.duration - 1.5 / self.header.rate:
            self._end("duration")
        if self.total is not None and elapsed > self.total + self.timeout:
            self._end("overrun")
        # Of a computer that was held up itself nothing can be said; hence the empty readings.
        if now - self._heard > self.timeout and self._empty >= EMPTY:
            self._end("silent", f"no valid line for {self.timeout:g} s")
        self._report()

    def _report(self) -> None:
        """Call the user's function with a `Progress`, a few times a second and at the end."""
        now, (looked, samples, seconds) = time.monotonic(), self._reported
        if self.progress is None or self.last is None or (now - looked < LOOK and not self.ended):
            return
        time_s, received = self.last.time, self.timeline.received
        rate = (received - samples) / (time_s - seconds) if time_s > seconds else 0.0
        self._reported = now, received, time_s
        values = {c.name: y for c, y in zip(self.header.channels, self.last.values, strict=True)}
        self.progress(Progress(time_s, self.total, rate, received, self.timeline.lost, values))

    def _last_words(self) -> None:
        """Switch the motor off and learn how many samples there were."""
        if self.ended in ("unplugged", "restarted"):
            return
        end, ask = time.monotonic() + LAST_WORDS, 0.0
        with contextlib.suppress(LinkLost):
            while self.made is None and time.monotonic() < end:
                if time.monotonic() > ask:
                    self.client.link.write(frame("X"))
                    ask = time.monotonic() + 0.3
                came = self.client.receive(0.05)
                self._take([i for i in came if self.ended != "disk" or isinstance(i, Message)], time.monotonic())

    def _close(self) -> "Recording":
        self.client.decoder.close()
        if self.ended != "disk":
            try:
                self.file.add(self.timeline.finish(self.made), self.commanded)
                self.file.mark_missing(self.made or 0, self.commanded)
                self.file.note(self._outcome().meta)
                self.file.flush()
                self.file.close()
            except OSError as error:
                self.ended, self.detail = "disk", error.strerror or str(error)
        return self._outcome()

    def _outcome(self) -> "Recording":
        timeline, received = self.timeline, self.timeline.received
        lost = max(timeline.lost, (self.made or 0) - received)
        seconds = self.last.time + 1 / self.header.rate if self.last else 0.0
        bad = self.client.decoder.bad + timeline.bad
        return Recording(self.file.out, self.header, self.ended, self.detail, received, lost,
                         self.made is not None, seconds, dict(bad), dict(timeline.clipped))


@contextlib.contextmanager
def _stop_by_signal(stop: Callable[[], None]) -> Iterator[None]:
    """Turn Ctrl-C and a polite kill into an orderly end; a second Ctrl-C is not so patient."""
    # Only the main thread may handle signals.
    names = ("SIGINT", "SIGTERM", "SIGHUP") if threading.current_thread() is threading.main_thread() else ()
    before = {s: signal.getsignal(s) for n in names if (s := getattr(signal, n, None))}
    before = {s: old for s, old in before.items() if s == signal.SIGINT or old is not signal.SIG_IGN}  # nohup

    def handler(number: int, _: object) -> None:
        signal.signal(number, before[signal.Signals(number)])
        stop()

    for number in before:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


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
    """The outcome of `record`; the data are in the file."""

    path: Path
    header: Header  # of the device, as calibrated
    ended: str  # why: a key of `SENTENCES`
    detail: str  # what the system said, where it did
    received: int  # valid samples
    lost: int  # samples that the device made and that never came
    tail_known: bool  # whether the device told how many it made, so that `lost` covers the end of the run too
    seconds: float  # length of the run, device time
    bad: Mapping[str, int]  # lines and bytes not valid or not usable, by reason: they explain losses, and add none
    clipped: Mapping[str, int]  # samples at the end of a converter's range, by channel

    @property
    def complete(self) -> bool:
        """Whether the recording ended the way it was meant to, or by hand."""
        return self.ended in COMPLETE and self.received > 0

    @property
    def sentence(self) -> str:
        """Why it ended, for people."""
        empty = "" if self.received else "Nothing was recorded: the device sent no sample. "
        return empty + SENTENCES[self.ended] + (f" ({self.detail})" if self.detail else "")

    @property
    def meta(self) -> dict[str, object]:
        """The outcome as it is written at the end of the file."""
        lost = str(self.lost) + ("" if self.tail_known else " before the last one received, then unknown")
        return {"ended": self.ended, "samples received": self.received, "samples lost": lost,
                **{k: _list(n) for k, n in (("not valid", self.bad), ("clipped", self.clipped)) if n}}

    def card(self) -> Card:
        """Return how it ended and what was received."""
        flags = [Flag(self.ended, "good" if self.complete else "bad")]
        flags += [Flag(f"{self.lost} of {self.received + self.lost} samples lost", "note")] if self.lost else []
        return Card(f"Recording {self.path.name}", flags, str(self).splitlines(), (),
                    ((f'mi.read_runs("{self.path.name}")', "read it"),))

    def __str__(self) -> str:
        share = 100 * self.lost / max(self.received + self.lost, 1)
        gaps = f"{self.lost} lost ({share:.3g} %), marked as missing" if self.lost else "0 lost, nothing missing"
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
