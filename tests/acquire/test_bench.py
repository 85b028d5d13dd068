"""The recorder against the virtual motor: in memory with every fault, and over real pseudo-terminals."""

from __future__ import annotations

import csv
import json
import math
import os
import re
import select
import signal
import subprocess
import sys
import threading
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from memory_link import MemoryLink

import motorid as mi
from motorid.acquire import record
from motorid.acquire.excitation import program
from motorid.acquire.protocol import frame
from motorid.acquire.server import Faults, Wire
from motorid.acquire.virtual import VirtualDevice, hide
from motorid.errors import DataError, DeviceError, UsageError
from motorid.records.datasets import load_plant

needs_pty = pytest.mark.skipif(not hasattr(os, "openpty"), reason="this system has no pseudo-terminals")
SHORT = "rest:0.01,step:4:0.02,coast:0.01"
QUIET = hide("none", seed=1)


@pytest.fixture
def out(tmp_path) -> Path:
    return tmp_path / "run.csv"


def rows(path: Path) -> list[dict[str, str]]:
    lines = [x for x in path.read_text().splitlines() if not x.startswith("#")]
    return list(csv.DictReader(lines))


def device(**options) -> VirtualDevice:
    return VirtualDevice(QUIET, **options)


# ---------------------------------------------------------------------------------- the recorder, in memory


def test_a_run_is_recorded_as_it_was_made(out):
    dev = device()
    dev.run(1)
    done = record(MemoryLink(dev), out, excite="rest:0.1,step:6:0.5", meta={"who": "me"})
    assert (done.ended, done.received, done.lost, done.complete) == ("done", 600, 0, True)
    got = rows(out)
    assert [float(r["time_s"]) for r in got] == pytest.approx([k / 1000 for k in range(600)])
    assert [float(r["voltage_V"]) for r in got] == [0.0] * 100 + [6.0] * 500
    m = QUIET.motor
    steady = 6.0 / (m.K + m.R * m.b / m.K)
    assert float(got[-1]["speed_rad_s"]) == pytest.approx(steady, rel=0.01)
    assert float(got[-1]["current_A"]) == pytest.approx(m.b * steady / m.K, abs=0.03)
    angle = np.array([float(r["angle_rad"]) for r in got])
    assert np.diff(angle)[-50:].mean() * 1000 == pytest.approx(steady, rel=0.01)
    text = out.read_text()
    assert "# who: me\n" in text
    assert "# ended: done\n# samples received: 600\n# samples lost: 0\n" in text


def inject(seed: int, folder: Path) -> None:
    """One recording with faults drawn from the seed; every line that came through whole must be there."""
    rng = np.random.default_rng(seed)
    faults = Faults(*(rng.uniform(0, 0.2, 7) * (rng.random(7) < 0.5)))
    dev = device(rate=5000.0, counter_bits=int(rng.choice([16, 32])), encoder_bits=int(rng.choice([16, 32])),
                 counter0=int(rng.integers(65_400, 65_536)), time0=2**32 - int(rng.integers(1, 20_000)))
    n = 100
    unplug = int(rng.integers(300, 5000)) if rng.random() < 0.2 else None
    start = dev._counter
    link = MemoryLink(dev, Wire(faults, rng), int(rng.integers(1, 60)), unplug)
    out = folder / f"{seed}.csv"
    done = record(link, out, excite="step:3:0.01,coast:0.01")
    whole = [x for x in link.made if x in link.passed]  # what a perfect reader finds in the bytes that came
    unwrapped = [(int(x.split(b",")[1]) - start) % (1 << dev.header.counter_bits) for x in whole]
    got = rows(out)
    here = [int(r["sample"]) for r in got if r["current_A"]]
    if done.ended == "unplugged":  # nobody knows what came after
        assert not done.tail_known
        end = unwrapped[-1] + 1 if whole else 0
    else:
        assert done.ended == "done"
        end = n
    assert (done.received, done.lost) == (len(whole), end - len(whole))
    assert [int(r["sample"]) for r in got] == list(range(end))  # gaps are marked, nothing twice
    assert here == unwrapped
    volts = np.round(np.repeat([3.0, 0.0], 50), 3)
    assert [float(r["voltage_V"]) for r in got] == volts[:end].tolist()
    out.unlink()


@pytest.mark.slow
@pytest.mark.parametrize("block", range(4))
def test_two_thousand_fault_injections_lose_no_valid_line_and_count_every_loss(block, tmp_path):
    for seed in range(500 * block, 500 * (block + 1)):
        inject(seed, tmp_path)


def test_lost_commands_and_answers_are_asked_again(out, monkeypatch):
    monkeypatch.setattr("motorid.acquire.client.AGAIN", 0.005)
    rng = np.random.default_rng(4)
    link = MemoryLink(device(), Wire(Faults(), rng), deaf=0.5)
    done = record(link, out, excite="stairs:1:4:10:0.002")
    assert (done.received, done.lost) == (20, 0)
    assert len(link.commands) > 20  # it did have to repeat


def test_a_lost_answer_to_go_does_not_start_a_second_run(out):
    class Mute(MemoryLink):
        first = True

        def read(self, timeout):
            data = super().read(timeout)
            if b"$A,G" in data and self.first:
                self.first = False
                return re.sub(rb"\$A,G[^\n]*\n", b"", data)
            return data

    done = record(Mute(device(), step=500), out, excite=SHORT)
    assert (done.ended, done.received, done.lost) == ("done", 40, 0)


def test_commands_lost_in_a_run_are_no_harm(out):
    done = record(MemoryLink(device(), step=3), out, excite="rest:0.3", duration=0.2)
    assert done.ended == "duration"
    assert 0.2 <= done.seconds < 0.25


def test_without_an_excitation_the_motor_is_held_at_zero_volts(out):
    done = record(MemoryLink(device(), step=10), out, duration=0.05)
    assert done.ended == "duration"
    assert {r["voltage_V"] for r in rows(out)} == {"0"}


@pytest.mark.parametrize("excite", ["step:13:0.1", "chirp:8:1:2:1:5"])
def test_excitation_beyond_the_devices_limit_moves_nothing(out, excite):
    link = MemoryLink(device())
    with pytest.raises(UsageError, match="the device's own limit is 12 V"):
        record(link, out, excite=excite)
    assert not any(c.startswith((b"$G", b"$S")) for c in link.commands)
    assert not out.exists()
    assert link.closed


def test_excitation_beyond_the_stated_limit_is_refused_before_the_port_opens(out):
    with pytest.raises(UsageError, match="the limit you gave is 5 V"):
        record("/dev/none", out, excite="step:6:0.1", limit_voltage=5.0)


def test_standard_is_scaled_to_the_lower_limit(out):
    record(MemoryLink(device(rate=200.0)), out, excite="standard", limit_voltage=5.0)
    assert max(float(r["voltage_V"]) for r in rows(out)) == pytest.approx(3.0)


def test_the_device_refuses_what_the_computer_should_not_have_sent():
    dev = device()
    assert b"A,L,6000,2000" in dev.receive(frame("L", 6000, 2000))
    assert b"E,refused,voltage limit" in dev.receive(frame("S", 0, "R", 100, 0, 6001))
    assert b"E,refused,segment out of turn" in dev.receive(frame("S", 1, "R", 100, 0, 600))
    assert b"E,refused,segments are missing" in dev.receive(frame("G", 1))
    assert b"E,refused" in dev.receive(frame("S", 0, "R", "x", 0, 0))
    assert b"E,refused,unknown command" in dev.receive(frame("Z"))
    assert not dev.running
    assert b"A,L,12000,8000" in dev.receive(frame("L", 99_000, 99_000))  # never above its own


def test_the_device_switches_off_at_the_current_limit(out):
    done = record(MemoryLink(device()), out, excite="rest:0.01,step:9:0.3", limit_current=2.0)
    assert (done.ended, done.complete) == ("limit", False)
    assert done.received < 30
    assert "current limit" in done.sentence


def test_the_computer_stops_a_device_that_does_not_keep_the_limit(out):
    dev = device()
    dev_limits = dev._set_limits

    def deaf_to_limits(mv, ma):
        answer = dev_limits(mv, ma)
        dev._limits = (12.0, 1e9)
        return answer

    dev._set_limits = deaf_to_limits
    done = record(MemoryLink(dev, step=5), out, excite="rest:0.01,step:9:0.3", limit_current=2.0)
    assert done.ended == "limit"
    assert not dev.running
    assert done.received < 60


def test_the_computer_stops_a_device_that_applies_more_than_the_voltage_limit(out):
    dev = device()
    go = dev._go

    def other_program(segments):
        answer = go(segments)
        dev._program = program("rest:0.01,step:9:0.3")
        return answer

    dev._go = other_program
    done = record(MemoryLink(dev, step=5), out, excite="rest:0.01,step:3:0.3", limit_voltage=4.0)
    assert done.ended == "voltage"
    assert not dev.running


def test_a_device_that_does_not_accept_the_limit_is_not_started(out):
    dev = device()
    dev._set_limits = lambda mv, ma: frame("A", "L", 12000, 8000)
    with pytest.raises(DeviceError, match="answers with 12 V"):
        record(MemoryLink(dev), out, limit_voltage=6.0, excite="step:5:0.1")


def test_nobody_there_and_the_wrong_baud_rate_are_told_apart(out, monkeypatch, rng):
    monkeypatch.setattr("motorid.acquire.client.BOOT", 0.05)

    class Silent(MemoryLink):
        noise = b""

        def write(self, data):
            pass

        def read(self, timeout):
            time.sleep(0.005)
            return self.noise

    with pytest.raises(DeviceError, match="nothing answered"):
        record(Silent(device()), out)
    link = Silent(device())
    link.noise = rng.bytes(40)
    with pytest.raises(DeviceError, match="baud rate"):
        record(link, out)
    assert not out.exists()


def test_a_device_that_stops_talking_ends_the_run_with_the_data_intact(out):
    class Stuck(MemoryLink):
        def read(self, timeout):
            if self.device.running and self.device._made > 30:
                time.sleep(0.01)
                return b""
            return super().read(timeout)

    done = record(Stuck(device(), step=10), out, excite="rest:1", timeout=0.1)
    assert done.ended == "silent"
    assert done.received == len(rows(out)) == 40
    assert "--resume" in done.sentence


def test_a_restart_of_the_device_is_noticed(out):
    class Reset(MemoryLink):
        def read(self, timeout):
            data = super().read(timeout)
            if self.device.running and self.device._made > 30:
                self.device = device()
                return data + frame(*self.device.header.fields)
            return data

    done = record(Reset(device(), step=10), out, excite="rest:1")
    assert (done.ended, done.received) == ("restarted", 40)


def test_a_restart_is_noticed_even_if_the_header_is_lost(out):
    class Reset(MemoryLink):
        def read(self, timeout):
            data = super().read(timeout)
            if self.device.running and self.device._made > 30:
                self.device = device()
            return data

    done = record(Reset(device(), step=10), out, excite="rest:1", timeout=5.0)
    assert (done.ended, done.received) == ("restarted", 40)


def test_a_full_disk_ends_the_run_and_stops_the_motor(out, monkeypatch):
    real, budget = os.write, [20_000]

    def write(fd, data):
        if os.fstat(fd).st_ino != out.stat().st_ino:
            return real(fd, data)
        if budget[0] < len(data):
            done, budget[0] = real(fd, data[:budget[0]]), 0
            if not done:
                raise OSError(28, "No space left on device")
            return done
        budget[0] -= len(data)
        return real(fd, data)

    monkeypatch.setattr(os, "write", write)
    link = MemoryLink(device())
    done = record(link, out, excite="rest:2")
    assert done.ended == "disk"
    lines = out.read_text().count("\n")
    assert done.detail == f"No space left on device; {lines} whole lines are in the file"
    assert not link.device.running
    got = rows(out)
    assert out.read_text().endswith("\n")
    assert [int(r["sample"]) for r in got] == list(range(len(got)))
    assert 19_900 < out.stat().st_size <= 20_000


def test_a_disk_that_fails_at_the_very_end_is_told(out, monkeypatch):
    def broken(fd):
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fsync", broken)
    done = record(MemoryLink(device()), out, excite=SHORT)
    assert (done.ended, done.detail, done.complete) == ("disk", "Input/output error", False)


def test_ctrl_c_stops_the_motor_and_keeps_the_data(out):
    link = MemoryLink(device(), step=5)

    def interrupt(progress):
        os.kill(os.getpid(), signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    done = record(link, out, excite="rest:60", progress=interrupt)
    assert (done.ended, done.complete) == ("interrupted", True)
    assert not link.device.running
    assert done.tail_known
    assert done.lost == 0
    assert len(rows(out)) == done.received > 100
    assert signal.getsignal(signal.SIGINT) is before


def test_a_bug_in_the_progress_function_stops_the_motor(out):
    link = MemoryLink(device(), step=5)

    def bad(progress):
        raise RuntimeError("boom")

    with pytest.raises(RuntimeError, match="boom"):
        record(link, out, excite="rest:60", progress=bad)
    assert not link.device.running


def test_progress_tells_rate_losses_and_last_values(out, monkeypatch):
    monkeypatch.setattr("motorid.acquire.session.LOOK", 0.0)
    seen = []
    wire = Wire(Faults(drop=0.1), np.random.default_rng(0))
    record(MemoryLink(device(), wire, step=20), out, excite="step:6:0.5", progress=seen.append)
    assert seen[-1].total == 0.5
    assert seen[-1].lost == pytest.approx(50, abs=20)
    assert seen[-1].last["omega"] > 50
    assert np.mean([p.rate for p in seen]) == pytest.approx(900, abs=60)


def test_resume_goes_on_where_the_cable_was_pulled(out):
    whole = "rest:0.05,step:4:0.2,coast:0.1"
    cut = record(MemoryLink(device(), step=10, unplug_after=3500), out, excite=whole)
    assert cut.ended == "unplugged"
    before = rows(out)
    done = record(MemoryLink(device()), out, resume=True)  # its excitation is in the file
    assert (done.ended, done.received) == ("done", 300)  # the interrupted step from its start, and the coast
    after = rows(out)
    assert after[:len(before)] == before
    pause = after[len(before)]
    assert (pause["voltage_V"], pause["current_A"]) == ("0", "")
    t = [float(r["time_s"]) for r in after]
    assert all(b > a for a, b in pairwise(t))
    assert {float(r["voltage_V"]) for r in after[len(before) + 1:]} == {4.0, 0.0}
    with pytest.raises(UsageError, match="complete"):
        record(MemoryLink(device()), out, resume=True)


def test_resume_twice_still_knows_what_is_left(out):
    whole = "step:1:0.1,step:2:0.1,step:3:0.1"
    record(MemoryLink(device(), step=10, unplug_after=1000), out, excite=whole)
    record(MemoryLink(device(), step=10, unplug_after=5000), out, resume=True)
    done = record(MemoryLink(device()), out, resume=True)
    assert done.ended == "done"
    volts = [float(r["voltage_V"]) for r in rows(out)]
    assert [v for v in (1.0, 2.0, 3.0) if volts.count(v) < 100] == []
    assert volts[-100:] == [3.0] * 100


@pytest.mark.parametrize(("was", "is_"), [(r"# started: \S+", "# started: yesterday"),
                                          ("# segments done: 0", "# segments done: some")])
def test_a_record_with_damaged_notes_is_not_resumed_and_nothing_moves(out, was, is_):
    record(MemoryLink(device(), step=10, unplug_after=1000), out, excite="step:1:0.1,step:2:0.1")
    record(MemoryLink(device(), step=10, unplug_after=1000), out, resume=True)
    out.write_text(re.sub(was, is_, text := out.read_text()))
    assert out.read_text() != text
    motor = device()
    with pytest.raises(DataError, match=f"'{is_}' is damaged"):
        record(MemoryLink(motor), out, resume=True)
    assert not motor.running


def test_a_start_without_a_time_zone_is_of_this_computer_s(out):
    record(MemoryLink(device(), step=10, unplug_after=1000), out, excite="step:1:0.1,step:2:0.1")
    out.write_text(re.sub(r"(# started: [^+\n]+)\S*", r"\1", out.read_text()))
    assert record(MemoryLink(device()), out, resume=True).ended == "done"


def test_resume_without_a_file_just_records(out):
    assert record(MemoryLink(device()), out, excite=SHORT, resume=True).received == 40


def test_force_replaces_only_once_the_device_has_answered(out, monkeypatch):
    out.write_text("precious\n")
    with pytest.raises(UsageError, match="left alone"):
        record(MemoryLink(device()), out, excite=SHORT)
    with pytest.raises(DeviceError):
        record("/dev/none", out, excite=SHORT, force=True)
    assert out.read_text() == "precious\n"
    record(MemoryLink(device()), out, excite=SHORT, force=True)
    assert "precious" not in out.read_text()


def test_calibration_is_applied_to_lost_samples_too(out):
    wire = Wire(Faults(drop=0.3), np.random.default_rng(1))
    calibration = {"v": {"gain": 0.5, "zero": 1.0}}
    record(MemoryLink(device(), wire), out, excite="step:4:0.1", calibration=calibration)
    got = rows(out)
    assert {r["voltage_V"] for r in got} == {"3"}
    assert sum(not r["current_A"] for r in got) > 10


@pytest.mark.parametrize("bad", [{"duration": 0}, {"limit_voltage": -1}, {"timeout": 0},
                                 {"limit_current": math.nan}])
def test_numbers_that_make_no_sense_are_refused(out, bad):
    with pytest.raises(UsageError, match="must be positive"):
        record(MemoryLink(device()), out, **bad)


# ------------------------------------------------------------------------------------------ the virtual motor


@pytest.mark.parametrize("name", sorted(load_plant().SIZES))
@pytest.mark.parametrize("motor", ["micro", "big"])
def test_every_drawn_effect_changes_the_record_and_lets_the_motor_turn(name, motor, out):
    truth, plain = hide(name, motor, seed=3), hide("none", motor, seed=3)
    assert truth.motor == plain.motor
    traces = []
    for t in (truth, plain):
        v = 0.6 * t.motor.v_max
        record(MemoryLink(VirtualDevice(t)), out, excite=f"step:{v}:0.15,step:{-v}:0.15", force=True)
        traces.append(np.array([[float(r["current_A"]), float(r["speed_rad_s"])] for r in rows(out)]))
    changed = np.abs(traces[0] - traces[1]).max(axis=0) / np.ptp(traces[1], axis=0)
    assert changed.max() > 0.01
    assert np.ptp(traces[0][:, 1]) > 0.3 * np.ptp(traces[1][:, 1])


def test_a_seed_gives_the_same_truth_and_the_same_record(out):
    texts = []
    for _ in range(2):
        record(MemoryLink(VirtualDevice(hide("random", seed=11))), out, excite=SHORT, force=True)
        texts.append([tuple(r.values()) for r in rows(out)])
    assert texts[0] == texts[1]
    assert len({next(iter(hide("random", seed=s).effects)) for s in range(40)}) > 8


@pytest.mark.parametrize(("words", "motor", "said"), [
    ("colomb", "lab", "Did you mean 'coulomb'"), ("coulomb:tau=1", "lab", "unexpected"),
    ("coulomb:1", "lab", "name=value"), ("lugre", "lab", "spell its numbers out"),
    ("none", "lap", "Did you mean 'lab'")])
def test_a_wrong_effect_or_motor_is_refused_with_the_reason(words, motor, said):
    with pytest.raises(UsageError, match=said):
        hide(words, motor)


def test_nothing_in_the_record_gives_the_secret_away(out):
    record(MemoryLink(VirtualDevice(hide("cogging", seed=5))), out, excite=SHORT)
    assert "cogging" not in out.read_text()
    assert "seed" not in out.read_text()


# --------------------------------------------------------------------- processes and real pseudo-terminals

MAIN = (sys.executable, "-W", "error", "-m", "motorid")


def start(*words: object) -> subprocess.Popen[str]:
    """Start a command that hears Ctrl-C, even where the tests run in the background of a shell, which silences it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return subprocess.Popen([*MAIN, *map(str, words)], text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    finally:
        signal.signal(signal.SIGINT, before)


def finish(process: subprocess.Popen[str], seconds: float = 120) -> tuple[int, str, str]:
    stdout, stderr = process.communicate(timeout=seconds)
    return process.returncode, stdout, stderr


class Bench:
    """A `bench` process, and the port it printed."""

    def __init__(self, *words: object) -> None:
        hidden = () if "--effect" in words else ("--effect", "none", "--seed", 1)
        self.process = start("bench", *hidden, *words)
        assert self.process.stdout is not None
        self.first = self.process.stdout.readline()
        if not self.first.startswith("port: "):
            raise AssertionError(self.process.communicate(timeout=10))
        self.port = self.first.split()[1]

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        self.said = finish(self.process)


def wait_for(condition, seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)


@needs_pty
def test_bench_and_record_over_a_pseudo_terminal_in_real_time(out):
    with Bench("--rate", 5000) as bench:
        begun = time.monotonic()
        done = record(bench.port, out, excite="rest:0.1,step:6:1,coast:0.4")
        assert time.monotonic() - begun > 1.4
    assert (done.ended, done.received, done.lost, done.bad) == ("done", 7500, 0, {})
    assert bench.said[0] == 0
    assert "seed: 1" in bench.said[1]
    assert "hidden:" not in bench.said[1]


@needs_pty
@pytest.mark.slow
def test_a_slow_disk_holds_up_nothing(out, monkeypatch):
    real, calls = os.fsync, []

    def slow(fd):
        calls.append(time.sleep(1.5))
        real(fd)

    monkeypatch.setattr(os, "fsync", slow)
    with Bench() as bench:
        done = record(bench.port, out, excite="rest:2.5", timeout=1.0)
    assert (done.ended, done.received, done.lost) == ("done", 2500, 0)
    assert len(calls) >= 2


@needs_pty
@pytest.mark.slow
def test_a_recorder_that_was_held_up_itself_blames_nobody(out):
    with Bench() as bench:
        process = start("record", "--port", bench.port, "--out", out, "--excite", "rest:2", "--quiet",
                        "--timeout", 0.2)
        wait_for(lambda: out.exists() and len(rows(out)) > 100)
        process.send_signal(signal.SIGSTOP)
        time.sleep(0.7)  # longer than the timeout, shorter than the device's patience
        process.send_signal(signal.SIGCONT)
        code, said, _ = finish(process)
    assert code == 0
    assert "2000 samples" in said
    assert "0 lost" in said


@needs_pty
def test_lines_are_in_the_file_while_the_run_goes_on(out):
    with Bench() as bench:
        process = start("record", "--port", bench.port, "--out", out, "--excite", "rest:30", "--quiet")
        wait_for(lambda: out.exists() and len(out.read_text()) > 2000)
        for _ in range(3):
            here = len(rows(out))
            wait_for(lambda n=here: len(rows(out)) > n + 100)  # far fewer than the 30 s hold
        process.send_signal(signal.SIGINT)
        code, said, _ = finish(process)
    assert code == 130
    assert "Stopped by hand" in said
    n = len(rows(out))
    assert f"{n} samples" in said
    assert "0 lost" in said


@needs_pty
@pytest.mark.slow
def test_a_killed_recorder_leaves_a_record_and_a_motor_that_stops(out):
    with Bench() as bench:
        process = start("record", "--port", bench.port, "--out", out, "--excite", "step:6:30", "--quiet")
        wait_for(lambda: out.exists() and len(out.read_text()) > 20_000)
        process.kill()
        finish(process)
        before = len([x for x in out.read_text().splitlines() if x[0] not in "#t"])
        time.sleep(1.2)  # the watchdog of the device
        done = record(bench.port, out, resume=True, duration=0.2)
    got = rows(out)
    assert done.lost == 0
    assert (got[before]["current_A"], got[before]["voltage_V"]) == ("", "0")
    assert abs(float(got[before + 1]["speed_rad_s"])) < 1
    assert float(got[before + 1]["time_s"]) > float(got[before]["time_s"]) + 0.8


@needs_pty
@pytest.mark.slow
def test_a_second_recorder_on_the_same_port_is_turned_away(tmp_path):
    with Bench() as bench:
        a = tmp_path / "a.csv"
        first = start("record", "--port", bench.port, "--out", a, "--excite", "rest:60", "--quiet")
        wait_for(a.exists)
        code, _, said = finish(start("record", "--port", bench.port, "--out", tmp_path / "b.csv"))
        assert code == 1
        assert "is in use, perhaps by another recorder" in said
        assert "Traceback" not in said
        here = len(rows(a))
        wait_for(lambda: len(rows(a)) > here + 100)  # the first one has not noticed
        first.send_signal(signal.SIGINT)
        assert finish(first)[0] == 130
    assert not (tmp_path / "b.csv").exists()


@needs_pty
@pytest.mark.slow
def test_unplugged_plugged_in_again_and_resumed(out, tmp_path):
    port = tmp_path / "motor"
    with Bench("--link", port, "--unplug-after", 0.5, "--plug-after", 0.5, "--speed", 2) as bench:
        assert bench.port == str(port)
        words = ("record", "--port", port, "--out", out, "--excite", "rest:0.2,step:6:0.8", "--quiet")
        code, _, said = finish(start(*words))
        assert code == 1
        assert "unplugged" in said
        assert "--resume" in said
        assert len(rows(out)) == 500  # every line that went into the cable
        wait_for(port.exists)
        code, said, _ = finish(start(*words[:5], "--resume", "--quiet"))
        assert code == 0, said
    got = rows(out)
    assert [r["voltage_V"] for r in got[-800:]] == ["6"] * 800
    assert "# resumed: " in out.read_text()


@needs_pty
def test_faults_on_the_wire_are_counted_over_the_pseudo_terminal_too(out):
    with Bench("--drop", 0.02, "--garbage", 0.05, "--flip", 0.02, "--cut", 0.02, "--speed", 0) as bench:
        done = record(bench.port, out, excite="rest:2", timeout=10)
    assert done.ended == "done"
    assert done.received + done.lost == 2000
    assert done.lost == pytest.approx(120, abs=40)
    assert [int(r["sample"]) for r in rows(out)] == list(range(2000))
    assert sum(not r["current_A"] for r in rows(out)) == done.lost


def test_where_there_are_no_pseudo_terminals_a_loopback_socket_serves(out, monkeypatch):
    from motorid.acquire.server import LOOPBACK, Pace, Socket, open_transport, serve

    monkeypatch.delattr(os, "openpty", raising=False)
    end = open_transport()
    assert isinstance(end, Socket)
    assert end._server.getsockname()[0] == LOOPBACK == "127.0.0.1"
    stop = threading.Event()
    thread = threading.Thread(target=serve, args=(device, end, Wire(Faults(), np.random.default_rng(0)),
                                                  Pace(speed=0), stop.is_set))
    thread.start()
    try:
        first = record(end.name, out, excite="rest:0.3")
        assert (first.received, first.lost) == (300, 0)
    finally:
        stop.set()
        thread.join()


@pytest.mark.slow
def test_a_second_recorder_on_the_socket_is_turned_away(tmp_path):
    with Bench("--socket", 0) as bench:
        assert bench.port.startswith("socket://127.0.0.1:")
        a = tmp_path / "a.csv"
        first = start("record", "--port", bench.port, "--out", a, "--excite", "rest:60", "--quiet")
        wait_for(a.exists)
        with pytest.raises(DeviceError, match="in use by another recorder"):
            record(bench.port, tmp_path / "b.csv")
        here = len(rows(a))
        wait_for(lambda: len(rows(a)) > here + 100)
        first.send_signal(signal.SIGINT)
        assert finish(first)[0] == 130


@needs_pty
def test_once_ends_the_bench_and_reveal_tells_the_truth(out):
    hidden = ("--effect", "coulomb:tau_c=0.01", "--seed", 7)
    process = start("bench", *hidden, "--once", "--reveal", "--speed", 0)
    port = process.stdout.readline().split()[1]
    record(port, out, excite=SHORT)
    code, said, _ = finish(process)
    assert code == 0
    assert "hidden: coulomb (tau_c = 0.01)" in said


@needs_pty
def test_ctrl_c_while_nobody_answers_is_one_sentence(tmp_path):
    master, slave = os.openpty()
    process = start("record", "--port", os.ttyname(slave), "--out", tmp_path / "x.csv")
    assert select.select([master], [], [], 60)[0], "it does not ask"
    process.send_signal(signal.SIGINT)
    code, _, said = finish(process)
    os.close(master)
    os.close(slave)
    assert (code, said.splitlines()[0]) == (130, "Stopped before anything was recorded.")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("words", "code", "said"), [
    (("record", "--port", "/dev/none", "--out", "x.csv"), 1, "no port /dev/none"),
    (("record", "--port", "/dev/none", "--out", "x.csv", "--excite", "stop:1"), 2, "Did you mean 'step'"),
    (("record", "--port", "/dev/null", "--out", "x.csv"), 1, "/dev/null cannot be opened"),
    (("record", "--port", "socket://127.0.0.1:1", "--out", "x.csv"), 1, "refused"),
    (("record", "--port", "socket://nonsense", "--out", "x.csv"), 1, "cannot be opened"),
    (("bench", "--effect", "colomb"), 2, "Did you mean 'coulomb'"),
    (("bench", "--channels", "v,speed"), 2, "unknown channel 'speed'"),
    (("bench", "--drop", "2"), 2, "drop"),
])
def test_a_users_mistake_is_one_sentence_and_a_status(words, code, said, tmp_path):
    process = subprocess.run([*MAIN, *words], capture_output=True, text=True, timeout=60,
                             cwd=tmp_path, check=False)
    assert process.returncode == code
    assert said in process.stderr
    assert "Traceback" not in process.stderr
    assert list(tmp_path.iterdir()) == []


@needs_pty
@pytest.mark.slow
def test_from_the_bench_to_the_verdict_the_hidden_effect_is_found(tmp_path):
    hidden = ("--effect", "coulomb", "--seed", 3, "--reveal")
    run, check, found = tmp_path / "run.csv", tmp_path / "check.csv", tmp_path / "found.json"
    with Bench(*hidden, "--rate", 250, "--speed", 0, "--drop", 0.01) as bench:
        for out, excite in ((run, "rest:0.1,step:6:0.4,coast:0.3,step:-5:0.4,coast:0.2,prbs:4:0.05:0.8"),
                            (check, "rest:0.1,chirp:5:1:6:1,coast:0.2")):
            code, _, said = finish(start("record", "--port", bench.port, "--out", out, "--excite", excite,
                                         "--timeout", 20, "--quiet"))  # a busy machine may let the bench wait
            assert code == 0, said
        assert "coulomb" not in run.read_text()
    code, _, said = finish(start("diagnose", run, "--validate", check, "--max-effects", 1, "--json", found),
                           seconds=500)
    assert code == 0, said
    told = json.loads(found.read_text())
    assert (told["verdict"], told["effects"]) == ("missing", ["coulomb"])
    truth = dict(re.findall(r"(\w+) = ([\d.e-]+)", bench.said[1]))
    for name in ("tau_c", "R", "K", "J"):
        assert told["parameters_after"][name] == pytest.approx(float(truth[name]), rel=0.01)


def test_a_virtual_bench_tells_what_its_motor_really_does(tmp_path):
    bench = mi.virtual_bench("coulomb", seed=3)
    mi.record(bench, tmp_path / "run.csv", excite="step:6:0.2,step:-3:0.2,coast:0.1", limit_voltage=8)
    run = mi.read_runs(tmp_path / "run.csv")[0]
    real = bench.simulate(run.t, run.inputs["v"])
    for channel, y in run.outputs.items():
        assert np.sqrt(np.mean((y - real[channel]) ** 2)) < 0.02 * np.abs(y).max()
