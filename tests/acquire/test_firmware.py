"""The example firmware, compiled on this computer against a make-believe board, and spoken to by the
recorder."""

from __future__ import annotations

import csv
import ctypes
import shutil
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from motorid.acquire import record
from motorid.acquire.excitation import program
from motorid.acquire.protocol import Decoder, Header, Message, Sample, crc16, frame
from motorid.errors import DeviceError
from motorid.records.datasets import data_path

COMPILER = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler on this machine")

# Just enough of Arduino for the sketch: a clock that the test sets, pins, and a serial port in two buffers.
ARDUINO = r"""
#pragma once
#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <string>
#include <vector>
using std::min; using std::max;
enum { LOW, HIGH, INPUT_PULLUP, CHANGE };
inline uint32_t clock_us; inline int pins[32], pwm[32], adc[32]; inline void (*handlers[32])();
inline std::string rx, tx; inline int room = 1 << 20;
inline uint32_t micros() { return clock_us; }
inline int digitalRead(int p) { return pins[p]; }
inline int analogRead(int p) { return adc[p]; }
inline void analogWrite(int p, int v) { pwm[p] = v; }
inline void analogWriteFreq(int) {} inline void analogWriteRange(int) {}
inline void analogReadResolution(int) {}
inline void pinMode(int p, int) { pins[p] = LOW; }
inline int digitalPinToInterrupt(int p) { return p; }
inline void attachInterrupt(int p, void (*f)(), int) { handlers[p] = f; }
template <class T, class A, class B> T constrain(T x, A a, B b) {
  return x < (T)a ? (T)a : x > (T)b ? (T)b : x;
}
struct Port {
  void begin(long) {}
  int available() { return (int)rx.size(); }
  int read() { char c = rx[0]; rx.erase(0, 1); return c; }
  int availableForWrite() { return room; }
  void write(const char *s) { tx += s; }
};
inline Port Serial;
"""
SHIM = r"""
#include "Arduino.h"
#include "motorid_bench.ino"
extern "C" {
uint16_t board_crc(const char *s, int n) { return motorid::crc16(s, n); }
void board_setup() { setup(); }
void board_loop(uint32_t us) { clock_us = us; loop(); }
void board_hear(const char *s, int n) { rx.append(s, n); }
int board_say(char *out, int most) {
  int n = (int)tx.copy(out, most); tx.erase(0, n); return n;
}
void board_adc(int counts) { adc[CURRENT] = counts; }
void board_room(int bytes) { room = bytes; }
void board_pin(int pin, int level) { pins[pin] = level; if (handlers[pin]) handlers[pin](); }
int board_pwm(int pin) { return pwm[pin]; }
}
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("firmware")
    (folder / "Arduino.h").write_text(ARDUINO)
    (folder / "shim.cpp").write_text(SHIM)
    out = folder / "board.so"
    sketch = data_path("firmware/motorid_bench")
    done = subprocess.run([COMPILER, "-std=c++17", "-O1", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC",
                           "-I", str(folder), "-I", str(sketch), str(folder / "shim.cpp"), "-o", str(out)],
                          capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return out


class Board:
    """The compiled sketch as a link for the recorder: 1 kHz, its clock advanced by reading."""

    def __init__(self, library: Path, folder: Path, start_us: int = 0, current: int = 2048) -> None:
        copy = folder / f"board{time.monotonic_ns()}.so"  # a copy has globals of its own
        shutil.copy(library, copy)
        self.c, self.us = ctypes.CDLL(str(copy)), start_us
        self.buffer = ctypes.create_string_buffer(1 << 20)
        self.c.board_setup()
        self.c.board_adc(current)
        self.duties: list[tuple[int, int]] = []

    def write(self, data: bytes) -> None:
        self.c.board_hear(data, len(data))

    def read(self, timeout: float) -> bytes:
        for _ in range(20):
            self.us += 500
            self.c.board_loop(ctypes.c_uint32(self.us % 2**32))
            self.duties.append((self.c.board_pwm(2), self.c.board_pwm(3)))
        n = self.c.board_say(self.buffer, len(self.buffer))
        return ctypes.string_at(self.buffer, n)

    def close(self) -> None:
        pass


@pytest.fixture(autouse=True)
def speak_often(monkeypatch):
    """The board's clock runs much faster than that of the computer, so its watchdog does too."""
    monkeypatch.setattr("motorid.acquire.client.KEEP_ALIVE", 0.0)


@pytest.fixture
def board(library, tmp_path) -> Board:
    return Board(library, tmp_path)


def voltages(path: Path) -> np.ndarray:
    lines = [x for x in path.read_text().splitlines() if not x.startswith("#")]
    return np.array([float(r["voltage_V"]) for r in csv.DictReader(lines)])


def test_crc_and_header_are_those_of_the_protocol(board, rng):
    for n in (0, 1, 9, 240):
        body = rng.bytes(n)
        assert board.c.board_crc(body, n) % 2**16 == crc16(body)
    (message,) = Decoder().feed(board.read(0))
    header = Header.read(message.fields)
    assert frame(*message.fields) == frame(*header.fields)  # what it says is what Python would say
    assert (header.rate, header.v_max, header.i_max, len(header.channels)) == (1000, 10, 3, 3)


@pytest.mark.parametrize("words", [
    "rest:0.1,step:6:0.2,coast:0.1", "ramp:-5:5:0.5", "chirp:4:1:60:1:1", "prbs:6:0.013:1:-1:77", "standard",
    "stairs:-9:9:7:0.033"])
def test_the_recorder_and_the_board_mean_the_same_program(board, tmp_path, words):
    done = record(board, tmp_path / "run.csv", excite=words)
    wanted = program(words, 10.0).volts(1000)
    assert (done.ended, done.received, done.lost, done.bad) == ("done", len(wanted), 0, {})
    assert voltages(tmp_path / "run.csv") == pytest.approx(wanted, abs=0.00101)


def test_its_clock_may_wrap(library, tmp_path):
    board = Board(library, tmp_path, start_us=2**32 - 200_000)
    done = record(board, tmp_path / "run.csv", excite="step:2:0.5")
    assert (done.ended, done.received, done.lost) == ("done", 500, 0)
    assert done.seconds == pytest.approx(0.5, abs=0.002)


def test_the_duty_cycle_is_the_voltage_and_the_bridge_opens_at_the_end(board, tmp_path):
    record(board, tmp_path / "run.csv", excite="step:6:0.05,step:-3:0.05")
    forward, back = (4095, 4095 - 4095 // 2), (4095 - 4095 // 4, 4095)
    assert forward in board.duties
    assert back in board.duties
    assert board.duties[-1] == (0, 0)
    assert (4095, 4095) not in board.duties  # never 0 V in this program


def test_its_own_limits_hold_whatever_is_asked(board):
    asked = [
        (frame("L", 99_000, 99_000), "A,L,10000,3000"),
        (frame("S", 0, "R", 100, 0, 10_001), "E,refused,voltage limit"),
        (frame("S", 0, "P", 100, 1, 10_000, 1, 1), "E,refused,voltage limit"),
        (frame("S", 0, "P", 100, 0, 1, 0, 1), "E,refused,segment"),
        (frame("S", 0, "Q", 100, 0, 1), "E,refused,segment"),
        (frame("S", 5, "R", 1, 1, 1), "E,refused,segment out of turn"),
        (frame("G", 1), "E,refused,segments are missing"),
        (frame("Z"), "E,refused,unknown command"),
        (b"$L,1,1*0000\n$" + b"x" * 1000 + frame("K"), "E,done,0,end"),
    ]
    board.read(0)
    for command, answer in asked:
        board.write(command)
        assert board.read(0) == frame(answer)


@pytest.mark.parametrize("current", [2048 + 500, 2048 - 500])  # 2 A, of either sign
def test_it_switches_off_beyond_the_current_limit(library, tmp_path, current):
    board = Board(library, tmp_path, current=current)
    done = record(board, tmp_path / "run.csv", excite="step:2:0.5", limit_current=1.5)
    assert (done.ended, done.received) == ("limit", 3)
    assert board.duties[-1] == (0, 0)


def test_it_switches_off_when_nobody_speaks_to_it(board, tmp_path):
    board.write(frame("L", 5000, 1000) + frame("S", 0, "R", 5000, 2000, 2000) + frame("G", 1))
    got = Decoder().feed(b"".join(board.read(0) for _ in range(150)))  # 1.5 s of silence
    assert [m.fields for m in got if isinstance(m, Message)][-1] == ["E", "done", "1001", "silent"]
    assert sum(isinstance(m, Sample) for m in got) == 1001
    assert board.duties[-1] == (0, 0)


def test_the_emergency_stop_ends_the_run(board, tmp_path):
    class Pressed(Board):
        def read(self, timeout):
            if self.us > 300_000:
                self.c.board_pin(15, 1)
            return super().read(timeout)

    board.__class__ = Pressed
    done = record(board, tmp_path / "run.csv", excite="step:2:5")
    assert done.ended == "emergency"
    assert "emergency stop" in done.sentence
    assert board.duties[-1] == (0, 0)


def test_lines_that_do_not_fit_are_counted_as_lost(board, tmp_path):
    class Slow(Board):
        def read(self, timeout):
            self.c.board_room(0 if 300_000 < self.us < 400_000 else 1000)
            return super().read(timeout)

    board.__class__ = Slow
    done = record(board, tmp_path / "run.csv", excite="step:2:1")
    assert (done.ended, done.received, done.lost) == ("done", 910, 90)  # nine readings of ten samples


def test_the_encoder_counts_both_ways(board):
    for level in range(40):
        a, b = [(0, 0), (1, 0), (1, 1), (0, 1)][level % 4]
        board.c.board_pin(6, a)
        board.c.board_pin(7, b)
    board.write(frame("L", 5000, 1000) + frame("G", 0))
    angles = [s.raw[2] for s in Decoder().feed(board.read(0)) if isinstance(s, Sample)]
    assert abs(angles[0]) == 39
    assert angles[0] == angles[-1]


def test_an_old_recorder_is_told_to_update(board, tmp_path, monkeypatch):
    monkeypatch.setattr("motorid.acquire.protocol.VERSION", 2)
    with pytest.raises(DeviceError, match="version 1 of the protocol, this motorid version 2"):
        record(board, tmp_path / "run.csv")
