"""What has no end, or unpacks to more than a machine holds, is one sentence in bounded time and memory."""

from __future__ import annotations

import io
import os
import struct
import subprocess
import sys
import time
import zlib

import pytest
from command import motorid

from motorid.acquire.protocol import Channel
from motorid.acquire.record_file import RecordFile
from motorid.acquire.timeline import Row
from motorid.records.datasets import data_path

RUN = data_path("two_step") / "step_6V.csv"


def refused(*words: object, says: str) -> None:
    began = time.process_time()
    done = motorid(*words)
    assert (done.status, done.out, len(done.err.splitlines())) == (2, "", 1), done
    assert says in done.err
    assert time.process_time() - began < 5


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
