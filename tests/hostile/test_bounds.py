"""What has no end, or unpacks to more than a machine holds, is one sentence in bounded time and memory."""

from __future__ import annotations

import io
import os
import re
import signal
import struct
import subprocess
import sys
import threading
import time
import zlib

import pytest
from command import motorid

import motorid as mi
from motorid.acquire.protocol import Channel, frame
from motorid.acquire.record_file import RecordFile, Row
from motorid.records.datasets import data_path

RUN = data_path("two_step") / "step_6V.csv"


def refused(*words: object, says: str) -> None:
    began = time.process_time()
    done = motorid(*words)
    assert (done.status, done.out, len(done.err.splitlines())) == (2, "", 1), done
    assert says in done.err
    assert time.process_time() - began < 30, "refused only after it was read"


def test_a_pipe_or_a_device_is_no_record(tmp_path):
    os.mkfifo(tmp_path / "run.csv")
    refused("fit", tmp_path / "run.csv", says="which may have no end")
    refused("fit", "/dev/urandom", says="which may have no end")
    refused("simulate", "/dev/zero", RUN, says="which may have no end")
    for endless in ("/dev/zero", tmp_path / "run.csv"):
        refused("record", "--port", "/dev/null", "--out", tmp_path / "out.csv", "--calibration", endless,
                says="no file")


def test_a_sparse_file_of_gigabytes(tmp_path):
    with (tmp_path / "run.csv").open("wb") as file:
        file.truncate(2_000_000_000)
    refused("fit", tmp_path / "run.csv", says="at most 256 MB")


def test_a_million_columns(tmp_path):
    (tmp_path / "run.csv").write_text("\n".join(",".join(["1.5"] * 1_000_000) for _ in range(3)), encoding="utf-8")
    refused("fit", tmp_path / "run.csv", says="at most 5000 columns")


def test_a_matlab_file_that_unpacks_to_gigabytes(tmp_path):
    """600 MB of zeros in less than one; read in a process that may not have much more memory."""
    squeeze, packed = zlib.compressobj(9), io.BytesIO()
    for _ in range(600):
        packed.write(squeeze.compress(bytes(1_000_000)))
    packed.write(squeeze.flush())
    body = packed.getvalue()
    path = tmp_path / "run.mat"
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + struct.pack("<II", 15, len(body)) + body)
    refused("fit", path, says="unpacks to more than 512 MB")


def test_a_parquet_file_of_too_many_numbers(tmp_path):
    pa = pytest.importorskip("pyarrow")
    import pyarrow.parquet as pq

    column = pa.array([0.0]).take(pa.array([0] * 1000, pa.int32()))
    table = pa.table({f"c{k}": column for k in range(6000)})
    pq.write_table(table, tmp_path / "run.parquet")
    refused("fit", tmp_path / "run.parquet", says="more than can be read at once")


def test_a_device_that_jumps_ahead_fills_no_gigabytes(tmp_path):
    channels = (Channel("v", "V"), Channel("i", "A"))
    file = RecordFile(tmp_path / "run.csv", channels, 1e6, {})
    file.add([Row(0, 0.0, (1.0, 0.1)), Row(59_000_000, 59.0, (1.0, 0.1))])
    file.flush()
    file.close()
    assert (tmp_path / "run.csv").stat().st_size < 1000


class Stubborn:
    """A device that does not stop at the end of its program."""

    pace = 0.0

    def __init__(self, *values: object) -> None:
        self.values, self.out, self.made, self.going = values, b"", 0, False

    def write(self, data: bytes) -> None:
        for body in re.findall(rb"\$([^*]*)\*", data):
            kind, *rest = body.decode().split(",")
            answer = {"?": ("H", 1, "d", 100, 32, 32, 12, 5, 8, "v:V:1:0:n", "i:A:1:0:n"), "G": ("A", "G", 0, 0),
                      "X": ("E", "done", self.made, "stop")}.get(kind, ("A", kind, *rest[:2 if kind == "L" else 1]))
            self.out += frame(*answer)
            self.going = kind == "G" or (self.going and kind != "X")

    def read(self, timeout: float) -> bytes:
        for k in range(self.made, self.made + 10 * self.going):
            self.out += frame("D", k, 10_000 * k, *self.values)
        self.made += 10 * self.going
        sent, self.out = self.out, b""
        time.sleep(self.pace if sent else timeout)
        return sent

    def close(self) -> None:
        self.going = False


def test_a_device_that_does_not_stop_is_stopped(tmp_path):
    done = mi.record(Stubborn(0.5, 0.1), tmp_path / "run.csv", excite="rest:1", timeout=0.5)
    assert (done.ended, done.complete) == ("overrun", False)
    assert 100 <= done.received < 300


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no such signal there")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_terminal_that_is_closed_stops_the_motor_and_keeps_the_data(tmp_path, name, monkeypatch):
    number = getattr(signal, name)
    before = signal.signal(number, lambda *_: None)
    kill = threading.Timer(0.3, os.kill, (os.getpid(), number))
    kill.start()
    try:
        device = Stubborn(0.5, 0.1)
        device.pace = 0.02
        done = mi.record(device, tmp_path / "run.csv", excite="rest:100", duration=20.0)
    finally:
        kill.cancel()
        signal.signal(number, before)
    assert (done.ended, device.going) == ("interrupted", False)
    assert "# ended: interrupted" in (tmp_path / "run.csv").read_text(encoding="utf-8")


def test_a_device_that_knows_no_number_sent_no_sample(tmp_path):
    """It said: 0 lost, nothing missing."""
    done = mi.record(Stubborn("nan", "1e400"), tmp_path / "run.csv", excite="rest:1", timeout=0.2)
    assert (done.received, done.complete) == (0, False)
    assert done.bad["not understood"] > 0


@pytest.mark.parametrize("words", [
    ("--effect", "coulomb:tau_c=nan"), ("--effect", "coulomb:tau_c=-0.01"), ("--effect", "coulomb:tau_c=inf"),
    ("--speed", "nan"), ("--rate", "nan"), ("--drop", "nan"), ("--unplug-after", "nan"), ("--plug-after", "-1")],
    ids=" ".join)
def test_a_bench_takes_sizes_that_are_sizes(words):
    command = [sys.executable, "-m", "motorid", "bench", *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode in (1, 2)
    assert len(done.stderr.splitlines()) == 1, done.stderr


def test_advice_about_effects_stands_where_an_effect_is_missing_only(tmp_path):
    path = tmp_path / "fit.json"
    path.write_text('{"model": {"base": "dc_motor", "effects": []}, "parameters": {"R": {"value": -1, "fixed": false}, '
                    '"L": {"value": 1, "fixed": false}, "K": {"value": 1, "fixed": false}, '
                    '"b": {"value": 1, "fixed": false}, "J": {"value": 1, "fixed": false}}}', encoding="utf-8")
    done = motorid("simulate", path, RUN)
    assert done.status == 2
    assert "--effects-from" not in done.err
