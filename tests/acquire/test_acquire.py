"""Protocol, account of losses, excitation, calibration and the record on disk."""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
from binascii import crc_hqx

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from motorid.acquire import excitation
from motorid.acquire.excitation import Program, Segment, lfsr_bits, program
from motorid.acquire.protocol import Channel, Decoder, Header, Message, Sample, crc16, frame
from motorid.acquire.record_file import RecordFile, Row, Timeline, check_target, column, read_tail
from motorid.acquire.recorder import calibrate, read_calibration
from motorid.errors import DataError, DeviceError, UsageError

CHANNELS = (Channel("v", "V", 1e-3), Channel("i", "A", 0.005, 2048, "a12"),
            Channel("theta", "rad", 0.01, 0, "w16"))
HEADER = Header("bench", 1000.0, CHANNELS, 16, 32, 12.0, 5.0)

quick = settings(max_examples=200, deadline=None, derandomize=True)
pieces = st.sampled_from([b"$", b"*", b"D,", b"1,2,3", b"\n", b"\r", b"12AB", b"K"])
noise = st.binary(max_size=60) | st.lists(pieces, max_size=12).map(b"".join)
samples = st.builds(Sample, st.integers(0, 2**16 - 1), st.integers(0, 2**32 - 1),
                    st.lists(st.integers(-(2**31), 2**31 - 1).map(float), min_size=1, max_size=6).map(tuple))


def line(sample: Sample) -> bytes:
    return frame("D", sample.counter, sample.time, *(f"{r:.0f}" for r in sample.raw))


# ------------------------------------------------------------------------------------------------- protocol


def test_crc_is_ccitt_false():
    assert crc16(b"123456789") == 0x29B1
    assert frame("K") == b"$K*%04X\n" % crc16(b"K")


@pytest.mark.parametrize("fields", [("D", "a$b"), ("D", "a*b"), ("D", "a\nb"), ("",), ("x" * 241,), ("é",)])
def test_a_frame_that_would_not_be_read_back_is_refused(fields):
    with pytest.raises(ValueError, match=r"not a frame|ascii"):
        frame(*fields)


@quick
@given(st.lists(noise), st.data())
def test_arbitrary_bytes_never_raise_and_pieces_make_no_difference(parts, data):
    stream = b"".join(parts)
    whole, pieces = Decoder(), Decoder()
    found, start = [], 0
    while start < len(stream):
        n = data.draw(st.integers(1, 40))
        found += pieces.feed(stream[start:start + n])
        start += n
    assert repr(found) == repr(whole.feed(stream))  # NaN differs from itself
    whole.close()
    pieces.close()
    assert whole.bad == pieces.bad
    assert whole.seen == pieces.seen == len(stream)


@quick
@given(st.lists(st.tuples(noise.filter(lambda b: b"*" not in b), samples)))
def test_every_valid_line_is_found_whatever_stands_between(parts):
    decoder = Decoder()
    found = decoder.feed(b"".join(junk + line(sample) for junk, sample in parts))
    assert found == [sample for _, sample in parts]


@quick
@given(samples, st.data())
def test_a_damaged_byte_is_never_believed(sample, data):
    damaged = bytearray(line(sample)[:-1])
    damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))
    decoder = Decoder()
    assert decoder.feed(bytes(damaged) + b"\n") == []
    decoder.close()
    assert sum(decoder.bad.values()) > 0


@quick
@given(st.text(st.characters(codec="ascii", exclude_characters="$*", exclude_categories=["Cc"]), min_size=1,
               max_size=200))
def test_nonsense_with_a_valid_crc_does_not_raise(body):
    decoder = Decoder()
    found = decoder.feed(frame("D", body)) + decoder.feed(frame("H", body))
    for item in found:
        if isinstance(item, Message) and item.fields[0] == "H":
            with pytest.raises(DeviceError):
                Header.read(item.fields)


def test_missing_and_infinite_values_are_missing():
    (sample,) = Decoder().feed(frame("D", 1, 2, "", "nan", "inf", "1e999", "0.5"))
    assert all(math.isnan(r) for r in sample.raw[:4])
    assert sample.raw[4] == 0.5


def test_header_survives_the_line():
    (message,) = Decoder().feed(frame(*HEADER.fields))
    assert Header.read(message.fields) == HEADER


@pytest.mark.parametrize(("field", "value", "said"), [
    (1, "2", "version"), (3, "0", "samples per second"), (3, "nan", "makes no sense"),
    (4, "x", "cannot be read"), (6, "-1", "limits"), (9, "v:V:0:0:n", "scale"),
    (9, "v:rpm:1:0:n", "scaled to V"), (9, "v:V:1:0:q", "kind"), (9, "w:V:1:0:n", "must send v"),
    (9, "v:V", "cannot be read"), (9, "!:V:1:0:n", "channel name")])
def test_a_header_that_cannot_be_is_refused_with_the_reason(field, value, said):
    fields = [str(f) for f in HEADER.fields]
    fields[field] = value
    with pytest.raises(DeviceError, match=said):
        Header.read(fields)


# --------------------------------------------------------------------------------------------------- timeline


def told(timeline: Timeline, *marks: tuple[int, int], host: float = 0.0) -> list[Row]:
    """Feed samples by unwrapped counter and time."""
    out = []
    for counter, micros in marks:
        wrapped = Sample(counter % 2**16, micros % 2**32, (1000.0, 2048.0, 0.0))
        out += timeline.accept(wrapped, host)
    return out


def test_counter_and_timer_wrap_without_a_trace():
    c0, t0 = 2**16 - 3, 2**32 - 2500
    timeline = Timeline(HEADER, c0, t0)
    rows = told(timeline, *((c0 + k, t0 + 1000 * k) for k in range(10)))
    assert [r.index for r in rows] == list(range(10))
    assert [r.time for r in rows] == pytest.approx([k * 1e-3 for k in range(10)])
    assert timeline.lost == 0


@quick
@given(st.sets(st.integers(0, 400), min_size=1), st.integers(0, 2**16 - 1), st.integers(0, 2**32 - 1))
def test_every_gap_is_counted_and_every_row_in_its_place(kept, c0, t0):
    timeline = Timeline(HEADER, c0, t0)
    rows = told(timeline, *((c0 + k, t0 + 1000 * k) for k in sorted(kept)))
    rows += timeline.finish()
    assert [r.index for r in rows] == sorted(kept)
    assert timeline.lost == max(kept) + 1 - len(kept)


def test_a_gap_of_several_turns_of_the_counter_is_told_by_the_timer():
    timeline = Timeline(HEADER, 0, 0)
    rows = told(timeline, (0, 0), (200_000, 200_000_000), (200_001, 200_001_000))
    assert [r.index for r in rows] == [0, 200_000, 200_001]


def test_a_gap_of_more_than_a_turn_of_the_timer_is_told_by_the_computers_clock():
    hours = 3 * 3600
    timeline = Timeline(HEADER, 0, 0, host=10.0)
    told(timeline, (0, 0), host=10.0)
    n = hours * 1000
    rows = told(timeline, (n, n * 1000), (n + 1, n * 1000 + 1000), host=10.0 + hours)
    assert [r.index for r in rows] == [n, n + 1]
    assert rows[0].time == pytest.approx(hours)


def test_repeated_and_late_lines_are_dropped_and_counted():
    timeline = Timeline(HEADER, 0, 0)
    rows = told(timeline, (0, 0), (1, 1000), (1, 1000), (2, 2000), (0, 0), (3, 3000))
    assert [r.index for r in rows] == [0, 1, 2, 3]
    assert timeline.bad == {"repeated": 1, "out of order": 1}
    assert timeline.lost == 0


def test_a_false_line_with_a_valid_crc_opens_no_gap():
    timeline = Timeline(HEADER, 0, 0)
    rows = told(timeline, (0, 0), (1, 1000), (30_000, 2000), (2, 2000), (3, 3000))
    assert [r.index for r in rows] == [0, 1, 2, 3]
    assert timeline.bad == {"implausible": 1}


def test_a_device_that_paused_is_believed_when_it_goes_on():
    timeline = Timeline(HEADER, 0, 0)
    rows = told(timeline, (0, 0), (1, 1000), (2, 900_000), (3, 901_000))
    assert [r.time for r in rows] == pytest.approx([0, 1e-3, 0.9, 0.901])


def test_the_last_line_is_not_lost_for_being_odd():
    timeline = Timeline(HEADER, 0, 0)
    assert len(told(timeline, (0, 0), (1, 900_000))) == 1
    assert [r.index for r in timeline.finish(2)] == [1]
    assert timeline.lost == 0


def test_encoder_wraps_at_speed_and_across_gaps(rng):
    timeline = Timeline(HEADER, 0, 0)
    angle = np.cumsum(np.full(3000, 9_000.0) + rng.normal(0, 50, 3000)).round()  # 7 samples a turn of 16 bits
    rows = []
    for k in range(3000):
        if not 1000 <= k < 1040:  # the angle turns five times in the gap
            raw = (angle[k] + 2**15) % 2**16 - 2**15 if k % 2 else angle[k] % 2**16  # signed or not
            rows += timeline.accept(Sample(k % 2**16, k * 1000, (0.0, 2048.0, raw)))
    got = np.array([r.values[2] for r in rows]) / 0.01
    kept = np.r_[0:1000, 1040:3000]
    assert got == pytest.approx(angle[kept])


def test_clipped_samples_are_counted():
    timeline = Timeline(HEADER, 0, 0)
    for k, raw in enumerate((0.0, 1.0, 4094.0, 4095.0, math.nan)):
        timeline.accept(Sample(k, k * 1000, (0.0, raw, 0.0)))
    assert timeline.clipped == {"i": 2}


def test_a_line_with_the_wrong_number_of_values_is_not_understood():
    timeline = Timeline(HEADER, 0, 0)
    assert timeline.accept(Sample(0, 0, (1.0, 2.0))) == []
    assert timeline.accept(Sample(2**16, 0, (1.0, 2.0, 3.0))) == []
    assert timeline.bad == {"not understood": 2}


# ----------------------------------------------------------------------------------------------- excitation
def test_the_words_of_an_excitation_are_a_line_each_in_the_docstring():
    told = re.findall(r"^    (\w+)[: ]", str(excitation.__doc__), re.MULTILINE)
    assert told == ["rest", "step", "stairs", "ramp", "chirp", "prbs", "coast", "standard"]




def test_words_become_the_voltage_they_say():
    volts = program("rest:0.002,step:6:0.003,ramp:0:4:0.004,coast:0.001").volts(1000)
    assert volts.tolist() == [0, 0, 6, 6, 6, 0, 1, 2, 3, 0]
    assert program("stairs:1:3:3:0.001").volts(1000).tolist() == [1, 2, 3]


def test_one_sample_of_a_program_is_that_of_the_whole():
    some = program("rest:0.003,chirp:2:5:50:0.1,prbs:3:0.01:0.05")
    volts = some.volts(1000)
    assert [some.at(k, 1000) for k in range(len(volts))] == volts.tolist()
    assert some.at(len(volts), 1000) is None


def test_chirp_goes_from_one_frequency_to_the_other():
    volts = program("chirp:2:5:50:10:1").volts(1000)
    assert volts.mean() == pytest.approx(1, abs=0.02)
    assert np.ptp(volts) == pytest.approx(4, abs=0.01)
    crossings = np.flatnonzero(np.diff(np.signbit(volts - 1))) / 1000
    assert np.sum(crossings < 1) == pytest.approx(2 * (5 + 0.5 * 4.5), abs=2)
    assert np.sum(crossings > 9) == pytest.approx(2 * (50 - 0.5 * 4.5), abs=2)


def test_prbs_has_two_levels_and_full_length():
    volts = program("prbs:3:0.01:5:1").volts(1000)
    assert set(volts) == {-2.0, 4.0}
    assert np.all(volts.reshape(-1, 10) == volts.reshape(-1, 10)[:, :1])  # clocked every 10 samples
    bits = list(lfsr_bits(1, 2 * 32767))
    assert bits[:32767] == bits[32767:]
    assert sum(bits[:32767]) == 16384


@quick
@given(st.sampled_from("RCP"), st.integers(1, 500), st.integers(-20_000, 20_000),
       st.integers(-20_000, 20_000), st.integers(1, 100_000), st.integers(1, 32_767),
       st.sampled_from([100.0, 1000.0, 4999.0]))
def test_no_sample_exceeds_the_peak_that_is_checked(shape, ms, a, b, c, d, rate):
    segment = Segment(shape, ms, (a, b) if shape == "R" else (a, b, c, d))
    volts = segment.volts(rate)
    assert len(volts) == segment.count(rate)
    assert np.abs(volts).max() <= segment.peak + 1e-12


def test_standard_stays_within_the_limit_and_moves_both_ways():
    volts = program("standard", 12.0).volts(1000)
    assert np.abs(volts).max() == pytest.approx(7.2)
    assert volts.min() == pytest.approx(-7.2)
    assert len(volts) == pytest.approx(8200)


@pytest.mark.parametrize(("words", "said"), [
    ("stop:1", "unknown excitation 'stop'"), ("step:6", "takes 2 numbers"), ("step:x:1", "not a usable number"),
    ("step:inf:1", "not a usable number"), ("step:6:-1", "1 ms to an hour"), ("prbs:6:0:1", "positive bit time"),
    ("stairs:1:6:1:0.3", "levels"), ("chirp:1:-1:5:1", "negative"), ("standard", "limit-voltage"),
    ("step:6:1,,", "unknown excitation"), ("rest:1e9", "not a usable number"), ("step:6:3601", "an hour")])
def test_words_that_make_no_sense_are_refused_with_the_reason(words, said):
    if words == "step:6:1,,":
        words = "step:6:1,,rest:1"
    with pytest.raises(UsageError, match=said):
        program(words)


@pytest.mark.parametrize("words", ["step:6.1:1", "step:-6.1:1", "ramp:0:-7:1", "chirp:4:1:2:1:2.5",
                                   "prbs:4:0.1:1:-2.5", "stairs:1:7:3:1"])
def test_excitation_beyond_the_limit_is_refused(words):
    with pytest.raises(UsageError, match=r"but the limit is 6 V\. Nothing was applied"):
        program(words).check(6.0, 32)


def test_too_many_segments_are_refused():
    with pytest.raises(UsageError, match="33 segments, the device takes at most 32"):
        program("stairs:0:1:33:0.1").check(6.0, 32)


def test_what_is_left_begins_with_the_interrupted_segment():
    whole = program("rest:1,step:1:1,step:2:1")
    assert whole.after(1.5).segments == whole.segments[1:]
    assert whole.after(3.0) == Program((), whole.words)


# ---------------------------------------------------------------------------------------------- calibration


def test_calibration_replaces_and_corrects(tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text("[i]\noffset = 2000\nscale = 0.01\nsign = -1\n[v]\ngain = 0.5\nzero = 0.25\n")
    header = calibrate(HEADER, read_calibration(path))
    row = Timeline(header, 0, 0).accept(Sample(0, 0, (8000.0, 2100.0, 7.0)))[0]
    assert row.values == pytest.approx((0.5 * 8 + 0.25, -1.0, 0.07))


@pytest.mark.parametrize(("text", "said"), [
    ("[i\n", "not TOML"), ("offset = 1", "is in none"), ("[i]\nofset = 1", "Did you mean 'offset'"),
    ("[i]\nscale = 0", "must not be zero"), ("[i]\nscale = true", "must be a number"),
    ("[i]\nsign = 2", "1 or -1"),
    ("[i]\ngain = inf", "must be a number"), ("[omega]\nscale = 1", "does not send")])
def test_a_wrong_calibration_is_refused_with_the_reason(tmp_path, text, said):
    path = tmp_path / "bench.toml"
    path.write_text(text)
    with pytest.raises(DataError, match=said):
        calibrate(HEADER, read_calibration(path))


def test_a_missing_calibration_file_is_named(tmp_path):
    with pytest.raises(DataError, match="cannot be read"):
        read_calibration(tmp_path / "none.toml")


# --------------------------------------------------------------------------------------------------- record


def rows(*indices: int) -> list[Row]:
    return [Row(k, k * 1e-3, (6.0, 0.5, 0.01 * k)) for k in indices]


def data_lines(path) -> list[str]:
    return [x for x in path.read_text().splitlines() if not x.startswith("#")]


def test_gaps_become_rows_with_the_command_and_nothing_measured(tmp_path):
    file = RecordFile(tmp_path / "run.csv", CHANNELS, 1000.0, {"device": "a\nb"})
    file.add(rows(0, 1, 4), lambda k: {2: 3.0}.get(k))
    file.mark_missing(6)
    file.flush()
    file.close()
    assert (tmp_path / "run.csv").read_text().startswith("# device: a b\n")
    assert data_lines(tmp_path / "run.csv") == [
        "time_s,voltage_V,current_A,angle_rad,sample", "0.000000,6,0.5,0,0", "0.001000,6,0.5,0.01,1",
        "0.002000,3,,,2", "0.003000,3,,,3", "0.004000,6,0.5,0.04,4", "0.005000,6,,,5"]


def test_a_gap_at_the_very_start_is_marked_too(tmp_path):
    file = RecordFile(tmp_path / "run.csv", CHANNELS, 1000.0, {})
    file.add(rows(2), lambda k: 1.5)
    file.flush()
    file.close()
    lines = data_lines(tmp_path / "run.csv")[1:]
    assert lines == ["0.000000,1.5,,,0", "0.001000,1.5,,,1", "0.002000,6,0.5,0.02,2"]


def test_a_gap_of_hours_is_marked_by_its_ends(tmp_path):
    file = RecordFile(tmp_path / "run.csv", CHANNELS, 1000.0, {})
    file.add(rows(0, 10_000_000))
    file.flush()
    file.close()
    indices = [x.split(",")[-1] for x in data_lines(tmp_path / "run.csv")[1:]]
    assert indices == ["0", "1", "9999999", "10000000"]


def test_nothing_is_overwritten_unasked(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("precious")
    with pytest.raises(UsageError, match="exists and is left alone"):
        check_target(path, resume=False, force=False)
    with pytest.raises(UsageError, match="appeared meanwhile"):
        RecordFile(path, CHANNELS, 1000.0, {})
    assert path.read_text() == "precious"
    for out, resume, force, said in ((path, True, True, "give one"), (tmp_path, False, True, "not a file"),
                                     (tmp_path / "a" / "b.csv", False, False, "folder")):
        with pytest.raises(UsageError, match=said):
            check_target(out, resume, force)


def test_two_recorders_cannot_write_one_file(tmp_path):
    first = RecordFile(tmp_path / "run.csv", CHANNELS, 1000.0, {})
    with pytest.raises(UsageError, match="another recorder"):
        RecordFile(tmp_path / "run.csv", CHANNELS, 1000.0, {}, "resume")
    first.close()


def test_trouble_in_the_background_is_told_at_the_next_line(tmp_path, monkeypatch):
    def broken(fd):
        raise OSError(5, "Input/output error")

    monkeypatch.setattr("motorid.acquire.record_file.SYNC_EVERY", 0.01)
    file = RecordFile(tmp_path / "run.csv", CHANNELS, 1000.0, {})
    monkeypatch.setattr(os, "fsync", broken)
    file.add(rows(0))
    file.flush()
    file._thread.join(timeout=10)
    file.add(rows(1))
    with pytest.raises(OSError, match="Input/output"):
        file.flush()
    monkeypatch.undo()
    file.close()


def test_a_line_cut_off_by_a_power_cut_is_cut_away_on_resuming(tmp_path):
    path = tmp_path / "run.csv"
    file = RecordFile(path, CHANNELS, 1000.0, {"started": "2024-01-01T00:00:00+00:00"})
    file.add(rows(0, 1))
    file.flush()
    file.close()
    with open(path, "a") as cut:
        cut.write("0.002000,6,0.")
    tail = read_tail(path)
    assert (tail.index, tail.time) == (1, 0.001)
    file = RecordFile(path, CHANNELS, 1000.0, {}, "resume")
    file.pause(tail, 5.0)
    file.add(rows(0))
    file.flush()
    file.close()
    assert data_lines(path)[-3:] == ["0.001000,6,0.5,0.01,1", "0.002000,0,,,2", "5.000000,6,0.5,0,5000"]


def test_only_a_record_of_ours_is_continued(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("t,v\n0,1\n")
    with pytest.raises(DataError, match="not a record that motorid made"):
        read_tail(path)
    path.unlink()
    RecordFile(path, CHANNELS[:2], 1000.0, {}).close()
    with pytest.raises(DataError, match="has the columns"):
        RecordFile(path, CHANNELS, 1000.0, {}, "resume")


FULL_DISK = """
import resource, signal, sys
from pathlib import Path
from motorid.acquire.record_file import Row
from motorid.acquire.protocol import Channel
from motorid.acquire.record_file import RecordFile
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
file = RecordFile(Path(sys.argv[1]), (Channel("v", "V"), Channel("i", "A")), 1000.0, {})
try:
    for k in range(1000):
        file.add([Row(k, k * 1e-3, (6.0, 0.123456))])
        if k % 7 == 0:
            file.flush()
except OSError as error:
    print(error.strerror, file.lines)
"""


def test_a_disk_that_refuses_leaves_whole_lines_only(tmp_path):
    pytest.importorskip("resource", reason="limits on file sizes exist on POSIX systems only")
    path = tmp_path / "run.csv"
    done = subprocess.run([sys.executable, "-c", FULL_DISK, str(path)], capture_output=True, text=True,
                          timeout=60, check=False)
    assert done.stdout.startswith("File too large"), done.stderr
    text = path.read_text()
    assert 970 < len(text) <= 1000  # as much as fits
    assert text.endswith("\n")
    assert int(done.stdout.split()[-1]) == text.count("\n")
    assert [x.split(",")[-1] for x in data_lines(path)[1:]] == [str(k) for k in range(text.count("\n") - 1)]


def test_columns_have_names_that_are_recognised():
    assert [column(c) for c in CHANNELS] == ["voltage_V", "current_A", "angle_rad"]
    assert column(Channel("theta", "m")) == "position_m"
    assert column(Channel("temp", "degC")) == "temp_degC"


def test_crc_agrees_with_the_definition(rng):
    def slow(body: bytes) -> int:
        crc = 0xFFFF
        for byte in body:
            crc ^= byte << 8
            for _ in range(8):
                crc = ((crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
        return crc

    for n in (0, 1, 17, 240):
        body = rng.bytes(n)
        assert crc16(body) == slow(body) == crc_hqx(body, 0xFFFF)
