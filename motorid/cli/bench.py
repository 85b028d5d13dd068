"""The commands `record`, which records from a bench, and `bench`, which serves a virtual one."""

import math
import secrets
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from motorid.acquire.recorder import record
from motorid.acquire.server import Faults, Pace, Wire, open_transport, serve
from motorid.acquire.session import Progress
from motorid.acquire.virtual import VirtualDevice, hide
from motorid.cli.console import FAILED, INTERRUPTED
from motorid.errors import UsageError, printable

Port = Annotated[str, typer.Option(
    metavar="PORT", help="Serial port of the bench: /dev/ttyACM0, COM3, socket://127.0.0.1:7000.")]
Out = Annotated[Path, typer.Option(metavar="RUN.csv", help="The CSV to write.")]
Baud = Annotated[int, typer.Option(metavar="N", min=300, help="Bits per second; a board on USB ignores it.")]
Excite = Annotated[str | None, typer.Option(
    metavar="PARTS", help="Voltage to apply, in parts joined by commas: rest:s step:volt:s stairs:from:to:levels:s "
    "ramp:from:to:s chirp:volt:Hz:Hz:s prbs:volt:bit:s coast:s standard. By default 0 V.")]
Duration = Annotated[float | None, typer.Option(metavar="S", help="Stop after so many seconds.")]
Volts = Annotated[float | None, typer.Option(metavar="V", help="Largest voltage, of either sign.")]
Amperes = Annotated[float | None, typer.Option(metavar="A", help="Switch the motor off above this current.")]
CalibrationFile = Annotated[Path | None, typer.Option(metavar="FILE.toml", help="Scale, offset, gain … per channel.")]
Resume = Annotated[bool, typer.Option("--resume", help="Continue a record that was cut short.")]
Force = Annotated[bool, typer.Option("--force", help="Replace a file that exists.")]
Timeout = Annotated[float, typer.Option(metavar="S", help="End the recording after so many seconds of silence.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="No live progress.")]

HiddenEffect = Annotated[str, typer.Option(metavar="a,b",
    help="What is hidden: none, random, or effects joined by commas, with or without values: coulomb:tau_c=0.01.")]
MotorName = Annotated[str, typer.Option(metavar="NAME", help="Which motor: micro, lab, servo, wheel, big.")]
Seed = Annotated[int | None, typer.Option(
    metavar="N", min=0, help="Seed of the hidden effect, the motor's constants, the noise and the faults.")]
Rate = Annotated[float, typer.Option(metavar="HZ", min=1.0, max=20_000.0, help="Samples per second.")]
SentChannels = Annotated[str, typer.Option(metavar="v,i", help="Channels to send.")]
Speed = Annotated[float, typer.Option(metavar="FACTOR", min=0.0, help="Times real time; 0: as fast as it is read.")]
Probability = Annotated[float, typer.Option(metavar="P", min=0.0, max=1.0, help="Probability of this fault, per line.")]
UnplugAfter = Annotated[float | None, typer.Option(metavar="S", help="Unplug the bench so long into a run.")]
PlugAfter = Annotated[float | None, typer.Option(metavar="S", help="Plug it in again after so long.")]
LinkName = Annotated[Path | None, typer.Option(metavar="PATH", help="A name for the port that stays the same.")]
SocketPort = Annotated[int | None, typer.Option(metavar="PORT", min=0, max=65_535,
    help="Serve socket:// on this port of the loopback address (0: any) instead of a pseudo-terminal.")]
Once = Annotated[bool, typer.Option("--once", help="End after the first run.")]
Reveal = Annotated[bool, typer.Option("--reveal", help="At the end, show what was hidden.")]


def record_command(port: Port, out: Out, baud: Baud = 115_200, excite: Excite = None, duration: Duration = None,
                   limit_voltage: Volts = None, limit_current: Amperes = None, calibration: CalibrationFile = None,
                   resume: Resume = False, force: Force = False, timeout: Timeout = 2.0, quiet: Quiet = False) -> None:
    """Record a run from a bench on a serial port. KEEP CLEAR OF THE SHAFT: the motor will move.

    Ctrl-C stops the motor and keeps the data. Limits are checked here and enforced by the device.

    Example: motorid record --port /dev/ttyACM0 --out run.csv --excite standard --limit-voltage 9"""
    with _live(quiet) as progress:
        try:
            volts, amperes = (math.inf if limit is None else limit for limit in (limit_voltage, limit_current))
            outcome = record(port, out, baud=baud, excite=excite, duration=duration,
                             limit_voltage=volts, limit_current=amperes,
                             calibration=calibration, resume=resume, force=force, timeout=timeout, progress=progress)
        except KeyboardInterrupt:
            typer.echo("Stopped before anything was recorded.", err=True)
            raise typer.Exit(INTERRUPTED) from None
    typer.echo(printable(str(outcome)), err=not outcome.complete)
    if outcome.ended == "interrupted" or not outcome.complete:
        raise typer.Exit(INTERRUPTED if outcome.ended == "interrupted" else FAILED)
    typer.echo(printable(f"Now: motorid diagnose {outcome.path}"))


@contextmanager
def _live(quiet: bool) -> Iterator[Callable[[Progress], None] | None]:
    """Progress on one line of the terminal, or a line every few seconds where there is none."""
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    console, due = Console(stderr=True), 0.0

    def show(p: Progress) -> None:
        nonlocal due
        if p.elapsed >= due:
            typer.echo(_line(p), err=True)
            due = p.elapsed + 5.0

    if quiet:
        yield None
    elif not console.is_terminal:
        yield show
    else:
        with Live(console=console, refresh_per_second=4, transient=True) as live:
            yield lambda p: live.update(Text(_line(p)))


def _line(p: Progress) -> str:
    end = f" of {p.total:.4g}" if p.total else ""
    values = "  ".join(f"{name} {value:.4g}" for name, value in p.last.items())
    return f"{p.elapsed:7.2f}{end} s  {p.rate:.0f} samples/s  {p.lost} lost  {values}"


def bench_command(effect: HiddenEffect = "random", motor: MotorName = "lab", seed: Seed = None, rate: Rate = 1000.0,
                  channels: SentChannels = "v,i,omega,theta", speed: Speed = 1.0, drop: Probability = 0.0,
                  garbage: Probability = 0.0, cut: Probability = 0.0, flip: Probability = 0.0,
                  unplug_after: UnplugAfter = None, plug_after: PlugAfter = None, link: LinkName = None,
                  socket: SocketPort = None, once: Once = False, reveal: Reveal = False) -> None:
    """Serve a virtual motor with a hidden effect, for `motorid record` to be tried on without hardware.

    --drop, --garbage, --cut and --flip are probabilities, per line, of faults on the wire.

    Example: motorid bench --effect random --seed 7 --reveal"""
    for name, value in (("speed", speed), ("unplug-after", unplug_after), ("plug-after", plug_after)):
        if value is not None and not 0 <= value < math.inf:
            raise UsageError(f"--{name} takes a number that is finite and not negative; got {value:g}.")
    seed = secrets.randbelow(1_000_000) if seed is None else seed
    truth, names = hide(effect, motor, seed), tuple(channels.replace(" ", "").split(","))
    VirtualDevice(truth, rate, names)  # complain before anything opens
    wire = Wire(Faults(drop, garbage, cut, flip), np.random.default_rng([seed, 2]))
    end = open_transport(link, socket)
    typer.echo(f"port: {end.name}\nA virtual motor '{motor}' at {rate:g} samples per second; now, in another "
               f"terminal:\n  motorid record --port {end.name} --out run.csv --excite standard\nCtrl-C ends it.")
    stopped: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda n, _: stopped.append(n))
    serve(lambda: VirtualDevice(truth, rate, names), end, wire, Pace(speed, unplug_after, plug_after, once),
          lambda: bool(stopped))
    typer.echo(str(truth) if reveal else f"seed: {seed} (the same seed with --reveal tells what was hidden)")
    if signal.SIGINT in stopped:
        raise typer.Exit(INTERRUPTED)
