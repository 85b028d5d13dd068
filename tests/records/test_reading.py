"""Records become runs, whatever their dialect; what is wrong with them is said in one clear message."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.signal
from broken_inputs import BROKEN, GOOD, HEADER, Broken, rows
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from motorid.channels import CHANNELS, UNITS
from motorid.errors import DataError, MissingDependency, UsageError
from motorid.records.checks import check_runs
from motorid.records.experiment import MIN_SAMPLES, Experiment
from motorid.records.headers import parse_pairs
from motorid.records.reading import find_records, read_csv, read_mat, read_runs, write_csv


def write(folder: Path, content: str | bytes, name: str = "run.csv") -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def notes(run: Experiment) -> str:
    return "\n".join(run.meta["notes"])


# -- broken inputs ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("broken", BROKEN, ids=lambda b: b.name)
def test_broken_input_gives_one_clear_error(broken: Broken, tmp_path):
    path = broken.make(tmp_path)
    with pytest.raises((DataError, UsageError)) as caught:
        read_runs(path, columns=broken.columns and parse_pairs(broken.columns, "columns"),
                  units=broken.units and parse_pairs(broken.units, "units"))
    message = str(caught.value)
    assert broken.says in message
    assert Path(path).name in message or not Path(path).exists() or Path(path).is_dir()
    assert "\n" not in message
    assert len(message) < 700
    assert caught.value.__cause__ is None  # no traceback of something inside


def test_the_list_of_broken_inputs_is_long_and_the_good_one_reads(tmp_path):
    assert len({b.name for b in BROKEN}) == len(BROKEN) >= 30
    run = read_csv(write(tmp_path, GOOD))
    assert run.n == 30
    assert run.channels == ("i", "omega")
    assert notes(run) == ""


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.one_of(
    st.binary(max_size=400),
    st.text(alphabet="0123456789.,;-+e \t\n\"'#%tuvwNa∞\r\0", max_size=400).map(str.encode),
    st.lists(st.lists(st.one_of(st.floats().map(repr), st.sampled_from(["", "nan", "x", '"', "1e999", "-"])),
                      max_size=5), max_size=20).map(
        lambda t: ("t,u,w\n" + "\n".join(",".join(r) for r in t)).encode()),
))
@example(b"t,u,w\n" + b"1e308,1e308,1e308\n-1e308,0,0\n" * 9)
def test_any_bytes_give_a_data_error_or_a_run(tmp_path, data):
    path = write(tmp_path, data)
    try:
        run = read_csv(path)
    except DataError:
        return
    assert run.n >= MIN_SAMPLES
    assert np.isfinite(run.t).all()


@pytest.mark.parametrize("kind", [".mat", ".parquet"])
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(start=st.integers(0, 1000), junk=st.binary(min_size=1, max_size=40))
@example(start=649, junk=bytes(13) + b"\xf1\x7f")  # a NaN that signals
def test_damaged_binary_formats_give_a_data_error_or_a_run(tmp_path, kind, start, junk):
    good = tmp_path / f"good{kind}"
    if not good.exists():
        _write_binary(good)
    data = bytearray(good.read_bytes())
    data[start:start + len(junk)] = junk
    path = write(tmp_path, bytes(data), f"bad{kind}")
    told = str(path)  # that of a run that is long enough needs no check
    try:
        assert read_runs(path)[0].n >= MIN_SAMPLES
    except DataError as error:
        told = str(error)
    assert str(path) in told


def test_a_mat_file_that_would_end_the_process_is_refused(tmp_path):
    _write_binary(tmp_path / "run.mat")
    data = (tmp_path / "run.mat").read_bytes()
    numbers = data.index(b"\x09\0\0\0\x90\x01\0\0")  # 50 doubles
    for damage in (b"\x67", b"\x09\0\0\0\x90\x11", b"\x09\0\0\0\0\x01"):
        broken = data[:numbers] + damage + data[numbers + len(damage):]
        with pytest.raises(DataError, match="damaged MATLAB file"):
            read_mat(write(tmp_path, broken, "bad.mat"))
    real = b"\x06\0\0\0\x08\0\0\0\x06\0"  # flags of a double array
    broken = data.replace(real, real[:-1] + b"\x08")  # complex, but no imaginary part follows
    assert broken != data
    with pytest.raises(DataError, match="damaged MATLAB file"):
        read_mat(write(tmp_path, broken, "bad.mat"))


def _write_binary(path: Path) -> None:
    import pandas as pd
    from scipy.io import savemat

    t = np.arange(50) * 0.01
    columns = {"time": t, "voltage": np.sign(np.sin(9 * t)), "speed_rpm": 100 * t}
    if path.suffix == ".mat":
        savemat(path, {"note": "x", "log": columns, "c": np.array(["a", 1.0, t], dtype=object)})
    else:
        pd.DataFrame(columns).to_parquet(path)


# -- dialects -----------------------------------------------------------------------------------------------

PLAIN = "{t:.3f},{v},{i:.3f},{w:.3f}\n"
SEMICOLON = rows(pattern=PLAIN.replace(",", ";"))
GERMAN = SEMICOLON.replace(".", ",")
DIALECTS = {
    "comma": GOOD,
    "semicolon": HEADER.replace(",", ";") + SEMICOLON,
    "semicolon and decimal comma": "Zeit [s];Spannung [V];Strom [A];Winkelgeschwindigkeit [rad/s]\n" + GERMAN,
    "tab": GOOD.replace(",", "\t"),
    "tab and decimal comma": "t\tu\ti\tw\n" + GERMAN.replace(";", "\t"),
    "white space": GOOD.replace(",", "   "),
    "white space and decimal comma": "t u i w\n" + GERMAN.replace(";", "  "),
    "blanks in names": "Time [s]  Voltage [V]  Current [A]  Speed [rad/s]\n" + rows().replace(",", "  "),
    "comma and space": GOOD.replace(",", ", "),
    "comments": "# bench 3\n% warm\n// started, late\n" + GOOD + "# end\n",
    "header in a comment": "# t u i w\n" + rows().replace(",", " "),
    "header after a percent sign": "%time,u,i,w\n" + rows(),
    "byte-order mark": "\ufeff" + GOOD,
    "UTF-16": GOOD.encode("utf-16"),
    "UTF-16 without mark": GOOD.encode("utf-16-be"),
    "UTF-16 the other way round": GOOD.encode("utf-16-le"),
    "Latin-1": ("Zeit_s;Spannung_V;Strom_A;Geschwindigkeit_rad_s;Kühlung_°C\n"
                + rows(pattern="{t:.3f};{v};{i:.3f};{w:.3f};20\n")).encode("latin-1"),
    "row of units": "time;voltage;current;speed\ns;V;A;rad/s\n" + SEMICOLON,
    "long names, units, short names": "Time;Drive;Current;Motor speed\ns;V;A;rad/s\nt;u;i;w\n" + SEMICOLON,
    "row of units in brackets": "Time,Voltage,Current,Speed\n(s),(V),(A),(rad/s)\n" + rows(),
    "JSON above the header": '{"device": "x"}\n' + GOOD,
    "lines above the header": "Scope 7\nSampling rate, 100\nOperator: me\n\n" + GOOD,
    "quoted header": '"time_s","voltage_V","current_A","speed_rad_s"\n' + rows(),
    "quoted cells with decimal comma": '"t","u","i","w"\n' + rows(
        pattern='"{t:.3f}"|"{v}"|"{i:.3f}"|"{w:.3f}"\n').replace(".", ",").replace("|", ","),
    "delimiter at the end": GOOD.replace("\n", ",\n"),
    "delimiter at the end of rows only": HEADER + rows().replace("\n", ",\n"),
    "statements": HEADER + rows().replace("\n", ";\n"),
    "statements of words": GOOD.replace(",", " ").replace("\n", "; \n"),
    "blank lines": "\n\n" + GOOD.replace("\n", "\n\n"),
    "Windows": GOOD.replace("\n", "\r\n"),
    "old Mac": GOOD.replace("\n", "\r"),
    "row numbers": ",".join(["", HEADER]) + "".join(f"{k},{r}\n" for k, r in enumerate(rows().splitlines())),
    "no line end": GOOD.rstrip("\n"),
    "typographic minus": GOOD.replace("-", "−"),
    "blocks of zero bytes": GOOD.encode() + b"\0" * 512,
}


@pytest.mark.parametrize("name", DIALECTS)
def test_every_dialect_gives_the_same_run(name, tmp_path):
    expected = read_csv(write(tmp_path, GOOD, "plain.csv"))
    run = read_csv(write(tmp_path, DIALECTS[name]))
    np.testing.assert_array_equal(run.t, expected.t)
    np.testing.assert_array_equal(run.inputs["v"], expected.inputs["v"])
    assert run.channels == ("i", "omega")
    for channel in run.channels:
        np.testing.assert_array_equal(run.outputs[channel], expected.outputs[channel])


def test_a_table_of_numbers_alone_reads_as_one_with_other_cells(tmp_path, rng):
    """Two parsers: NumPy's where every cell is a number, pandas where one is not."""
    table = rng.standard_normal((40, 4)) * 10.0 ** rng.integers(-9, 9, (40, 4))
    lines = [",".join([f"{0.001 * k:.3f}", *(f"{x:.{k % 15}e}" for x in row)]) for k, row in enumerate(table)]
    plain, mixed = (read_csv(write(tmp_path, "\n".join(["t,v,i,omega,extra", *lines, last]), f"{last[:1]}.csv"))
                    for last in ("0.04,1,2,3,4", "0.04,1,2,3,"))
    assert plain.meta["extra"]["extra"][-1] == 4
    assert np.isnan(mixed.meta["extra"]["extra"][-1])
    for channel in ("v", "i", "omega"):
        read = [{**run.inputs, **run.outputs}[channel] for run in (plain, mixed)]
        np.testing.assert_allclose(*read, rtol=1e-15)
        np.testing.assert_array_equal(read[0][:-1], [float(line.split(",")[1 + ("v", "i", "omega").index(channel)])
                                                     for line in lines])


def test_a_channel_that_is_left_out_need_not_be_told_from_others(tmp_path):
    path = write(tmp_path, "t,v,speed,current_2,current_3\n" + rows(pattern="{t:.3f},{v},{w:.3f},{i:.3f},{i:.3f}\n"))
    with pytest.raises(DataError, match="look equally like the current"):
        read_csv(path)
    assert read_csv(path, columns={"i": None}).channels == ("omega",)
    own = write_csv(read_csv(write(tmp_path, GOOD, "plain.csv")), tmp_path / "own.csv")
    assert read_csv(own, columns={"i": None}).channels == ("omega",)


def test_a_duty_and_the_names_of_control_lectures_are_met_with_the_right_line(tmp_path):
    """Not with an example that names another column as the voltage."""
    body = rows(pattern="{t:.3f},{v},{w:.3f}\n")
    with pytest.raises(DataError, match=r"look equally .* If 'v' is the speed: columns={'v': 'u', 'omega': 'v'}"):
        read_csv(write(tmp_path, "t,u,v\n" + body))
    with pytest.raises(DataError, match=r"a duty cycle; .*'v': 'duty'") as told:
        read_csv(write(tmp_path, "t,duty,speed\n" + body))
    assert "Say which is which" not in str(told.value)


def test_without_a_voltage_what_may_drive_the_motor_is_named(tmp_path):
    body = rows(pattern="{t:.3f},{i:.3f},{w:.3f}\n")
    commands = r"If 'current \[A\]' is what commands .*'v': 'current \[A\]'.*--drive torque"
    with pytest.raises(DataError, match=commands) as told:
        read_csv(write(tmp_path, "time [s],current [A],speed [rad/s]\n" + body))
    assert "'...'" not in str(told.value), "one line to write, and no other"
    with pytest.raises(DataError, match=r"e\.g\. columns={'v': 'plant_input'}") as told:  # and not the angle beside it
        read_csv(write(tmp_path, "t,alpha,plant_input,theta\n" + rows(pattern="{t:.3f},{w:.3f},{v},{w:.3f}\n")))
    assert "torque" not in str(told.value)
    with pytest.raises(DataError, match=r"e\.g\. columns={'v': '\.\.\.'}"):  # what can be none is no example
        read_csv(write(tmp_path, "t,speed_ref,speed_2 [rad/s],omega\n" + rows(pattern="{t:.3f},{v},{w:.3f},{w:.3f}\n")))


def test_units_in_the_header_are_converted(tmp_path):
    run = read_csv(write(tmp_path, "t_ms,voltage_mV,current_mA,speed_rpm,angle_deg\n" + rows(
        pattern="{t:.3f},{v},{i:.3f},{w:.3f},{w:.3f}\n")))
    plain = read_csv(write(tmp_path, GOOD))
    np.testing.assert_allclose(run.t, plain.t * 1e-3)
    np.testing.assert_allclose(run.inputs["v"], plain.inputs["v"] * 1e-3)
    np.testing.assert_allclose(run.outputs["i"], plain.outputs["i"] * 1e-3)
    np.testing.assert_allclose(run.outputs["omega"], plain.outputs["omega"] * 2 * np.pi / 60)
    np.testing.assert_allclose(run.outputs["theta"], plain.outputs["omega"] * np.pi / 180)
    assert run.meta["original_units"] == {"t": "ms", "v": "mV", "i": "mA", "omega": "rpm", "theta": "deg"}


def test_a_row_of_units_overrules_the_default(tmp_path):
    run = read_csv(write(tmp_path, "t;u;n\nms;mV;1/min\n" + rows(pattern="{t:.3f};{v};{w:.3f}\n")))
    assert run.meta["original_units"] == {"t": "ms", "v": "mV", "omega": "1/min"}
    assert run.inputs["v"].max() == pytest.approx(6e-3)


def test_columns_and_units_said_by_the_user_win(tmp_path):
    path = write(tmp_path, "time,u_volt,speed,w\n" + rows())
    run = read_csv(path, columns=parse_pairs("t=time,v=u_volt,omega=speed", "--columns"),
                   units=parse_pairs("omega=rpm", "--units"))
    assert run.meta["columns"] == {"t": "time", "v": "u_volt", "omega": "speed"}
    assert list(run.meta["extra"]) == ["w"]
    plain = read_csv(path, columns={"omega": "speed"})
    np.testing.assert_allclose(run.outputs["omega"] / np.pi * 30, plain.outputs["omega"])


def test_a_sign_and_a_scale_can_be_given_with_the_unit(tmp_path):
    plain = read_csv(write(tmp_path, GOOD))
    run = read_csv(write(tmp_path, GOOD), units={"i": "-1 A", "omega": "0.5 rad/s"})
    np.testing.assert_allclose(run.outputs["i"], -plain.outputs["i"])
    np.testing.assert_allclose(run.outputs["omega"], plain.outputs["omega"] / 2)


def test_a_table_without_header_goes_by_position(tmp_path):
    run = read_csv(write(tmp_path, rows()), columns={"t": 1, "v": "2", "omega": 4})
    np.testing.assert_array_equal(run.outputs["omega"], read_csv(write(tmp_path, GOOD)).outputs["omega"])
    assert list(run.meta["extra"]) == ["3"]


@pytest.mark.parametrize("columns", [None, {"v": 1, "omega": "speed (rad/s)"}])
def test_samples_a_fixed_time_apart_need_no_column_of_time(tmp_path, columns):
    path = tmp_path / "run.csv"
    path.write_text("voltage (V),speed (rad/s)\n" + "".join(f"{k % 7},{k}\n" for k in range(30)))
    with pytest.raises(DataError, match=r"the time \(t\).*dt=0.001"):
        read_csv(path)
    run = read_runs(path, columns=columns, dt=0.004)[0]
    assert run.t == pytest.approx(0.004 * np.arange(30))
    assert run.channels == ("omega",)
    for dt, columns, message in ((-1.0, None, "dt must be positive"), (0.1, {"t": 1}, "leave one of them out")):
        with pytest.raises(DataError, match=message):
            read_runs(path, columns=columns, dt=dt)


def test_encoder_counts_become_an_angle(tmp_path):
    path = write(tmp_path, "t,u,encoder\n" + "".join(f"{k / 100},6,{64 * k}\n" for k in range(30)))
    run = read_csv(path, units={"theta": "counts:2048"})
    np.testing.assert_allclose(run.outputs["theta"], 2 * np.pi * 64 / 2048 * np.arange(30))
    cells = "".join(f"{k / 100},6,{64 * k},{k}\n" for k in range(30))
    with_speed = write(tmp_path, "t,u,encoder,w\n" + cells)
    assert read_csv(with_speed).channels == ("omega",)
    assert "counts:2048" in notes(read_csv(with_speed))


def test_duty_times_supply_is_the_drive_voltage(tmp_path):
    cells = "".join(f"{k / 100},{k},12,{k}\n" for k in range(30))
    run = read_csv(write(tmp_path, "t_s,duty_%,bus_V,speed_rpm\n" + cells))
    np.testing.assert_allclose(run.inputs["v"], 0.12 * np.arange(30))
    assert "'duty_%' times 'bus_V'" in notes(run)


def test_a_force_command_may_drive_a_linear_axis(tmp_path):
    path = write(tmp_path, "t_s,voltage_V,force_N,position_mm,speed\n" + "".join(
        f"{k / 100},1,{k},{k},{k}\n" for k in range(30)))
    run = read_csv(path, columns={"v": "force_N"})
    assert run.units == {"v": "N", "theta": "m", "omega": "m/s"}
    assert run.outputs["theta"][-1] == pytest.approx(0.029)


def test_dates_and_large_clocks_count_from_the_first(tmp_path):
    stamps = [f"2024-05-01 12:00:{0.25 * k:06.3f}" for k in range(20)]
    clock = [f"12:00:{0.25 * k:06.3f}" for k in range(20)]
    epoch = [str(1714550000_000000 + 250000 * k) for k in range(20)]
    for header, times in (("time", stamps), ("time", clock), ("timestamp_us", epoch)):
        run = read_csv(write(tmp_path, f"{header},u,w\n" + "".join(f"{s},1,2\n" for s in times)))
        np.testing.assert_allclose(run.t, 0.25 * np.arange(20), atol=1e-9)
        assert "counted" in notes(run)


@pytest.mark.parametrize(("whole", "fine", "size"), [
    ("header.stamp.sec", "header.stamp.nanosec", 1e-9), ("field.header.stamp.secs", "field.header.stamp.nsecs", 1e-9),
    ("tv_sec", "tv_usec", 1e-6)])
def test_stamps_in_seconds_and_a_fraction_are_one_time(tmp_path, whole, fine, size):
    t = 0.6 + 0.25 * np.arange(20)
    body = [f"{1700000000 + int(s)},{round(s % 1 / size)},1,{k}\n" for k, s in enumerate(t)]
    run = read_csv(write(tmp_path, f"{whole},{fine},u,w\n" + "".join(body)))
    np.testing.assert_allclose(run.t - run.t[0], t - t[0], atol=1e-9)
    assert f"'{whole}' and '{fine}' together are the time" in notes(run)
    other = read_csv(write(tmp_path, f"{whole},{fine},u,w,time\n" + "".join(
        f"{row.strip()},{k}\n" for k, row in enumerate(body))))
    np.testing.assert_allclose(other.t, np.arange(20))  # a plain name goes first


def test_who_says_how_far_samples_are_apart_wants_no_stamps(tmp_path):
    path = write(tmp_path, "stamp.sec,stamp.nanosec,u,w\n" + "".join(f"7,{k},1,{k}\n" for k in range(20)))
    np.testing.assert_allclose(read_csv(path, dt=0.01).t, 0.01 * np.arange(20))


def test_a_time_in_two_units_is_not_added_up(tmp_path):
    rows = "".join(f"{1e-3 * k:.3f},{k},1,{k}\n" for k in range(20))
    run = read_csv(write(tmp_path, "time_s,time_ms,u,w\n" + rows), columns={"t": "time_s"})
    np.testing.assert_allclose(run.t, 1e-3 * np.arange(20))


# -- rows ---------------------------------------------------------------------------------------------------


def table(t, v, w) -> str:
    return "t_s,u_V,w_rad_s\n" + "".join(f"{a},{b},{c}\n" for a, b, c in zip(t, v, w, strict=True))


def test_missing_outputs_stay_missing_and_missing_inputs_are_held(tmp_path):
    v = ["", 4, 5, "", "", 3, 3, 3, 3, 3, 3, 3]
    w = [0, 1, "nan", 3, "-", 5, "ERR", 7, 8, 9, 10, 11]
    run = read_csv(write(tmp_path, table(np.arange(12) / 10, v, w)))
    np.testing.assert_array_equal(run.t, np.arange(1, 12) / 10)
    np.testing.assert_array_equal(run.inputs["v"], [4, 5, 5, 5, 3, 3, 3, 3, 3, 3, 3])
    np.testing.assert_array_equal(run.outputs["omega"], [1, np.nan, 3, np.nan, 5, np.nan, 7, 8, 9, 10, 11])
    for part in ("first 1 row", "missing in 2 of 11 rows", "missing in 3 of 11", "1 cell of 'w_rad_s'"):
        assert part in notes(run)


def test_a_few_cells_missing_from_a_voltage_that_changes_evenly_go_on_and_a_step_waits(tmp_path, rng):
    t = 0.002 * np.arange(400)
    gone = np.zeros(400, bool)
    gone[rng.choice(np.arange(3, 390), 25, replace=False)] = True
    gone[[199, 200, 201]] = True  # around the step
    gone[300:306] = True  # too many in a row to tell
    for v in (6 * np.sin(9 * t), np.where(t < 0.4, 5.0, -2.0)):
        cells = [f"{x:.3f},{'' if lost else f'{u:.6f}'},1" for x, u, lost in zip(t, v, gone, strict=True)]
        found = read_csv(write(tmp_path, "\n".join(["t_s,u_V,omega_rad_s", *cells]))).inputs["v"]
        if v[0]:
            np.testing.assert_array_equal(found, np.where(np.arange(400) < 202, 5.0, -2.0))
        else:
            np.testing.assert_allclose(np.delete(found, np.s_[300:306]), np.delete(v, np.s_[300:306]), atol=2e-3)
            np.testing.assert_allclose(found[300:306], v[299], atol=1e-6)


@pytest.mark.parametrize("mark", [-9999, 9999, -999, 65535, -32768])
def test_the_mark_of_a_missing_sample_is_no_value(mark, tmp_path):
    w = [0, 1, mark, 3, 4, mark, 6, 7, 8, 9]
    run = read_csv(write(tmp_path, table(range(10), [1] * 10, w)))
    np.testing.assert_array_equal(run.outputs["omega"], [0, 1, np.nan, 3, 4, np.nan, 6, 7, 8, 9])
    assert f"'w_rad_s' holds {mark}" in notes(run)
    assert "missing in 2 of 10" in notes(run)
    duty = read_csv(write(tmp_path, table(range(10), [0, mark] * 5, range(10))))
    np.testing.assert_array_equal(duty.inputs["v"], [0, mark] * 5)  # a command may be any number
    near = read_csv(write(tmp_path, table(range(10), [1] * 10, np.linspace(0, mark, 10).round())))
    assert near.outputs["omega"][-1] == mark  # a value like the others


@pytest.mark.parametrize(("t", "dropped", "note"), [
    ([0, 1, 2, 2, 3, 4, 5, 6, 7, 8], {3}, "1 row of 10"),
    ([0, 1, 2, 1.5, 3, 4, 5, 6, 7, 8, 9], {2}, "1 row of 11"),
    ([0, 1, 2, 3, 1.5, 1.6, 4, 5, 6, 7, 8, 9], {4, 5}, "2 rows of 12"),
    ([0, 1, 2, 900, 3, 4, 5, 6, 7, 8], {3}, "jumps ahead"),
    ([*range(5), *range(12)], {*range(5)}, "starts again 1 time; kept the longest stretch, 12 of 17"),
    ([*range(12), *range(5)], {*range(12, 17)}, "12 of 17"),
    ([*range(9), 3, *range(9, 12), *range(5)], {9, *range(13, 18)}, "starts again 1 time"),
    ([0, 1, "", 3, 4, 5, 6, 7, 8, 9], {2}, "1 row of 10: no time"),
    ([*range(8), 20, 21], set(), "a gap in time, 13 s after t = 7 s"),
])
def test_time_is_put_in_order_and_every_loss_is_told(t, dropped, note, tmp_path):
    run = read_csv(write(tmp_path, table(t, [1] * len(t), range(len(t)))))
    kept = [k for k in range(len(t)) if k not in dropped]
    np.testing.assert_array_equal(run.t, [t[k] for k in kept])
    np.testing.assert_array_equal(run.outputs["omega"], kept)
    assert note in notes(run)


@pytest.mark.parametrize(("dt", "left_out"), [(2.62, ()), (1.6, ()), (12.5, (7, 8, 100)), (33.3, ())])
def test_stamps_that_are_even_but_for_their_rounding_are_taken_to_be(dt, left_out, tmp_path):
    """At 2.6 ms whole milliseconds are 2 or 3 ms apart: what a plain motor does per stamp wanders by a third."""
    k = np.delete(np.arange(400), left_out)
    stamps = [f"{s:.0f}" for s in np.round(dt * k)]
    run = read_csv(write(tmp_path, table(stamps, [1] * len(k), k).replace("t_s", "t_ms")))
    np.testing.assert_allclose(np.diff(run.t), 1e-3 * dt * np.diff(k), rtol=1e-3)
    assert abs(run.t - 1e-3 * dt * k).max() < 0.6e-3
    assert "the stamps of 't_ms' are rounded to 1 ms" in notes(run)
    assert f"{np.median(np.diff(run.t)) * 1e3:.4g} ms apart" in notes(run)


@pytest.mark.parametrize("steps", [(2, 3, 3, 2, 9, 2, 3, 5), (4, 4, 7, 4), (5,), (1000, 1001), (10, 10, 3010)])
def test_stamps_that_wander_by_more_or_hardly_are_left_as_they_are(steps, tmp_path):
    stamps = np.cumsum([0, *steps * 40])
    run = read_csv(write(tmp_path, table(stamps, [1] * len(stamps), range(len(stamps))).replace("t_s", "t_ms")))
    np.testing.assert_array_equal(run.t, stamps * 1e-3)
    assert "rounded" not in notes(run)


def test_a_time_that_starts_again_begins_another_run(tmp_path):
    """A logger that appends, and counts turns modulo one anew; too few rows are no run."""
    counts = [*range(60), *range(100, 150), *range(30, 33), *range(9)]
    t = [0.01 * k for n in (60, 50, 3, 9) for k in range(n)]
    turns = "t_s,u_V,theta_rad\n" + "".join(f"{a},1,{0.3 * b % 6.283185307}\n" for a, b in zip(t, counts, strict=True))
    runs = read_runs(write(tmp_path, turns))
    assert [r.n for r in runs] == [60, 50, 9]
    for run in runs:
        np.testing.assert_allclose(np.diff(run.t), 0.01)
        np.testing.assert_allclose(np.diff(run.outputs["theta"]), 0.3, atol=1e-6)
    assert "time starts again 3 times; a run each time, 119 of 122 rows" in notes(runs[0])
    assert "gap" not in notes(runs[0])


def test_a_time_that_starts_again_and_stands_still_begins_none(tmp_path):
    run = read_csv(write(tmp_path, table([*range(20), *[0] * 9], [1] * 29, range(29))))
    np.testing.assert_array_equal(run.t, np.arange(20))
    assert "time starts again 1 time" in notes(run)
    assert "left out 9 rows of 29" in notes(run)


@pytest.mark.parametrize("every", [2, 5, 12])
def test_a_sensor_read_more_often_than_it_measures_counts_once(every, tmp_path, rng):
    """What it repeats meanwhile would be taken for a delay; a rest, steps of a converter, lone equals stay."""
    n = 1200
    live = rng.normal(size=n)
    rests = np.where(np.arange(n) < 400, 0.0, live)
    table = pd.DataFrame({"t": np.arange(n) * 1e-3, "v": 1.0, "speed_rad_s": live[np.arange(n) // every * every],
                          "current_A": rests})
    run = read_runs(_written(table, tmp_path))[0]
    assert np.array_equal(np.flatnonzero(np.isfinite(run.outputs["omega"])), np.arange(0, n, every))
    assert np.array_equal(run.outputs["i"], rests)
    assert f"of 1200 samples {n - n // every} repeat the one before" in " ".join(run.meta["notes"])
    rounded = np.round(np.cumsum(np.full(n, 0.2 / every)) + 0.3 * live, 1)  # counts
    table["speed_rad_s"] = rounded
    assert np.array_equal(read_runs(_written(table, tmp_path))[0].outputs["omega"], rounded)


def test_a_coarse_sensor_read_more_often_than_it_measures_counts_once_too(tmp_path, rng):
    """A bus that brings a speed in steps every 20 samples: what stays the same for two of these is measured twice."""
    n = 3000
    speed = np.round(5 * np.sin(np.arange(n) / 400) + 0.05 * rng.normal(size=n), 1)
    sent = speed[np.arange(n) // 20 * 20]
    lengths = np.diff(np.flatnonzero(np.diff(sent)))
    assert np.mean(lengths > 20) > 0.1
    table = pd.DataFrame({"t": np.arange(n) * 2e-3, "v": 1.0, "speed_rad_s": sent})
    run = read_runs(_written(table, tmp_path))[0]
    assert np.array_equal(np.flatnonzero(np.isfinite(run.outputs["omega"])), np.arange(0, n, 20))
    assert not any("swapped" in told for told in check_runs([run]))
    table["speed_rad_s"] = speed  # as coarse, and measured every time
    assert np.array_equal(read_runs(_written(table, tmp_path))[0].outputs["omega"], speed)


def test_what_a_drive_holds_is_measured_once_behind_noise_too(tmp_path, rng):
    """A speed that a drive renews every 20 ms, behind a converter's noise, was a lag of 9 ms, errors 7 times the noise.
    A current that follows held steps of the voltage at once is no sensor's, a swift motor's speed neither."""
    n = 3000
    k = np.arange(n)
    speed = 100 * np.sin(k / 90) + 20 * np.sin(k / 17)
    table = pd.DataFrame({"t": k * 2e-3, "v": np.repeat(rng.uniform(-9, 9, 20), 150),
                          "speed_rad_s": speed[k // 10 * 10] + 0.5 * rng.normal(size=n)})
    kept = np.sort(rng.choice(n, n - 20, replace=False))  # rows get lost
    run = read_runs(_written(table.iloc[kept], tmp_path))[0]
    fresh = np.isfinite(run.outputs["omega"])
    assert set(np.rint(run.t[fresh] / 2e-3).astype(int) % 10) == {0}
    assert 280 < fresh.sum() <= 300
    error = run.outputs["omega"][fresh] - speed[np.rint(run.t[fresh] / 2e-3).astype(int)]
    assert np.std(error) < 0.25  # the mean of ten
    assert any("behind noise: of 2980 samples" in told for told in run.meta["notes"])
    voltage = np.repeat(rng.uniform(-9, 9, n // 10), 10)
    for column in (voltage / 3, scipy.signal.lfilter([0.4], [1, -0.6], voltage), speed):
        table = table.assign(v=voltage, speed_rad_s=column + 0.5 * rng.normal(size=n))
        assert np.isfinite(read_runs(_written(table, tmp_path))[0].outputs["omega"]).all()


def test_the_pulses_of_a_servo_are_a_command(tmp_path):
    """A bench's "Servo 3 (µs)" was refused: a time, expected a voltage."""
    table = pd.DataFrame({"t": np.arange(20) / 50, "Servo 3 (µs)": np.linspace(1000, 1750, 20), "rpm": np.arange(20.0)})
    path = _written(table, tmp_path)
    run = read_csv(path, columns={"v": "Servo 3 (µs)"})
    assert run.inputs["v"][[0, -1]] == pytest.approx([-1.0, 0.5])
    assert run.units["v"] == "1"
    assert "servo's pulses: 1500 µs is 0, 500 µs more is 1" in notes(run)
    for unit in ("us:1000", "µs:1000"):
        assert read_csv(path, columns={"v": 2}, units={"v": unit}).inputs["v"][[0, -1]] == pytest.approx([0.0, 1.5])
    table["Servo 3 (µs)"] /= 1000
    wide = read_csv(_written(table, tmp_path), columns={"v": 2}, units={"v": "ms"})
    assert wide.inputs["v"] == pytest.approx(run.inputs["v"])
    for unit in ("h", "us:x", "us:1.5.0", "us:."):
        with pytest.raises(DataError, match=r"cannot be in|unknown unit"):
            read_csv(path, columns={"v": 2}, units={"v": unit})
    for header in ("time_ms", "time_us", "Zeit (ms)"):  # the wrong column, and no pulse
        path = _written(table.assign(**{header: table["t"] * 1000}), tmp_path)
        with pytest.raises(DataError, match="that is a time"):
            read_csv(path, columns={"v": header})
    path = _written(table.assign(**{"Servo 3 (s)": 3.0}), tmp_path)
    with pytest.raises(DataError, match="that is a time"):
        read_csv(path, columns={"v": "Servo 3 (s)"})
    assert read_csv(path, columns={"v": "Servo 3 (s)"}, units={"v": "V"}).inputs["v"][0] == 3.0


def _written(table, folder):
    path = folder / "run.csv"
    table.to_csv(path, index=False)
    return path


def test_rows_of_the_wrong_length_are_told(tmp_path):
    run = read_csv(write(tmp_path, GOOD + "0.4,6,1,2,3,4\n0.5,6\n"))
    assert run.n == 31
    assert np.isnan(run.outputs["omega"][-1])
    assert "left out 1 row with more cells" in notes(run)
    assert "1 row shorter" in notes(run)


def test_negative_zero_is_zero_and_uneven_samples_are_kept(tmp_path):
    t = ["-0.0", 0.1, 0.15, 0.4, 0.42, 0.5, 0.6, 0.77, 0.9]
    run = read_csv(write(tmp_path, table(t, [1] * 9, range(9))))
    assert not np.signbit(run.t).any()
    np.testing.assert_array_equal(run.t[1:], t[1:])


def test_other_columns_travel_with_the_run(tmp_path):
    run = read_csv(write(tmp_path, "t,u,w,power_W,state,omega_ref\n" + rows(
        pattern="{t:.3f},{v},{w:.3f},25,on,{w:.3f}\n")))
    assert sorted(run.meta["extra"]) == ["omega_ref", "power_W"]
    assert "columns of text: state" in notes(run)
    np.testing.assert_array_equal(run.meta["extra"]["power_W"], np.full(30, 25.0))
    assert len(run.select(slice(5, 20)).meta["extra"]["power_W"]) == 15


def test_a_channel_that_is_missing_throughout_is_left_out(tmp_path):
    run = read_csv(write(tmp_path, HEADER + rows(pattern="{t:.3f},{v},nan,{w:.3f}\n")))
    assert run.channels == ("omega",)
    assert "left out 'current_A' (i)" in notes(run)


# -- several files ------------------------------------------------------------------------------------------


def test_paths_patterns_and_directories_in_natural_order(tmp_path):
    for k in (10, 2, 1):
        write(tmp_path, GOOD, f"run{k}.csv")
    write(tmp_path, "no record", "notes.md")
    write(tmp_path, "hidden", ".hidden.csv")
    names = ["run1", "run2", "run10"]
    assert [r.name for r in read_runs(tmp_path)] == names
    assert [r.name for r in read_runs(str(tmp_path / "run*.csv"))] == names
    both = [tmp_path / "run10.csv", str(tmp_path / "run*.csv")]
    assert [r.name for r in read_runs(both)] == ["run10", "run1", "run2"]
    assert [f.name for f in find_records(iter([tmp_path]))] == [f"{n}.csv" for n in names]


def test_runs_of_one_name_are_told_apart(tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        write(tmp_path / folder, GOOD)
    assert [r.name for r in read_runs([tmp_path / "a", tmp_path / "b"])] == ["a/run.csv", "b/run.csv"]


def test_a_name_with_pattern_letters_is_taken_as_it_stands(tmp_path):
    assert read_runs(write(tmp_path, GOOD, "run[1].csv"))[0].name == "run[1]"


@pytest.mark.parametrize("paths", [3, None, [3], [b"run.csv"]])
def test_what_is_no_path_is_a_usage_error(paths):
    with pytest.raises(UsageError, match="expected"):
        read_runs(paths)


def test_no_path_at_all_is_a_data_error():
    with pytest.raises(DataError, match="no record"):
        read_runs([])


def test_a_directory_is_no_csv(tmp_path):
    with pytest.raises(DataError, match="read_runs"):
        read_csv(tmp_path)


def test_source_and_fingerprint_are_kept(tmp_path):
    import hashlib

    path = write(tmp_path, GOOD)
    run = read_csv(path)
    assert run.meta["source"] == str(path)
    assert run.meta["sha256"] == hashlib.sha256(GOOD.encode()).hexdigest()


# -- MATLAB and Parquet -------------------------------------------------------------------------------------


def test_matlab_variables_structures_and_matrices(tmp_path):
    from scipy.io import savemat

    t = np.arange(40) * 0.01
    savemat(tmp_path / "a.mat", {"t": t, "u": np.sin(t), "omega": np.cos(t), "note": "x", "K": 3.0,
                                 "other": np.arange(9.0)})
    a = read_mat(tmp_path / "a.mat")
    np.testing.assert_array_equal(a.outputs["omega"], np.cos(t))
    assert "another length than 40: other" in notes(a)
    savemat(tmp_path / "b.mat", {"log": {"time": t, "voltage_V": np.sin(t), "motor": {"speed_rpm": t}}})
    b = read_runs(tmp_path / "b.mat")[0]
    np.testing.assert_allclose(b.outputs["omega"], t * 2 * np.pi / 60)
    savemat(tmp_path / "b.mat", {"log": {"time": t, "voltage_V": np.sin(t), "speed_rpm": t},
                                 "cell": np.array(["a", 1.0], dtype=object), "none": []}, do_compression=True)
    assert read_runs(tmp_path / "b.mat")[0].n == 40
    savemat(tmp_path / "y.mat", {"u": np.sin(t), "i": np.cos(t), "e": t, "y": 2 * t, "T_degC": t})
    (tmp_path / "y.csv").write_text("u,i,e,y,T_degC,note\n" + "".join(f"{a:g},{a:g},1,{a:g},30,warm\n" for a in t))
    for of in ("y.mat", "y.csv"):  # the speed was lost without a word
        lost = read_runs(tmp_path / of, dt=0.01)[0].meta["notes"]
        assert any("not used: e, y; " in n and "name it with columns={'omega': 'y'}" in n for n in lost), of
        left_out = read_runs(tmp_path / of, dt=0.01, columns={"omega": None})[0].meta["notes"]
        assert not any("not used" in n for n in left_out), of
    savemat(tmp_path / "c.mat", {"data": np.column_stack([t, np.sin(t), np.cos(t)])})
    c = read_mat(tmp_path / "c.mat", columns={"t": "data_1", "v": "data_2", "theta": 3})
    np.testing.assert_array_equal(c.outputs["theta"], np.cos(t))


def test_a_table_in_memory_is_cut_at_a_pause_as_its_file_is(tmp_path):
    pd = pytest.importorskip("pandas")
    t = np.concatenate([np.arange(100), np.arange(11000, 11100)]) * 1e-3
    frame = pd.DataFrame({"time_s": t, "voltage_V": np.sign(np.sin(90 * t)), "speed_rad_s": np.cos(9 * t)})
    frame.to_csv(tmp_path / "a.csv", index=False)
    assert [run.n for run in read_runs(frame)] == [run.n for run in read_runs(tmp_path / "a.csv")] == [100, 100]


def test_a_run_that_was_measured_only_before_a_pause_is_not_lost(tmp_path):
    pd = pytest.importorskip("pandas")
    t = np.concatenate([np.arange(5), 5000 + np.arange(500)]) * 1e-3
    seen = np.where(np.arange(505) < 5, t, np.nan)
    frame = pd.DataFrame({"time_s": t, "voltage_V": np.sign(np.sin(9 * t)), "speed_rad_s": seen})
    frame.to_csv(tmp_path / "a.csv", index=False)
    assert [run.n for run in read_runs(tmp_path / "a.csv")] == [505]


def test_a_measured_input_without_a_value_is_left_out_with_a_word():
    pd = pytest.importorskip("pandas")
    t = np.arange(100) * 1e-3
    [run] = read_runs(pd.DataFrame({"time_s": t, "voltage_V": np.sign(np.sin(9 * t)), "speed_rad_s": np.cos(9 * t),
                                    "supply_V": np.nan}))
    assert "v_supply" not in run.inputs
    assert "left out 'supply_V' (v_supply): every sample is missing." in run.meta["notes"]


def test_parquet(tmp_path):
    pd = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    t = np.arange(40) * 0.01
    frame = pd.DataFrame({"voltage_V": np.sin(t), "speed_rpm": t, "state": "on"},
                         index=pd.Index(t, name="time_s"))
    frame.to_parquet(tmp_path / "a.parquet")
    [run] = read_runs(tmp_path / "a.parquet")
    np.testing.assert_array_equal(run.t, t)
    np.testing.assert_allclose(run.outputs["omega"], t * 2 * np.pi / 60)
    stamps = pd.Timestamp("2024-05-01") + pd.to_timedelta(t, unit="s")
    stamped = frame.reset_index(drop=True).assign(time=stamps)
    stamped.to_parquet(tmp_path / "b.parquet")
    np.testing.assert_allclose(read_runs(tmp_path / "b.parquet")[0].t, t, atol=1e-9)


def test_parquet_without_pyarrow_names_the_extra(tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingDependency, match=r"motorid\[parquet\]"):
        read_runs(write(tmp_path, b"PAR1", "a.parquet"))


# -- writing ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("channels", [("i",), ("omega",), ("theta",), CHANNELS])
@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("drive", UNITS["v"])
def test_writing_and_reading_gives_the_same_run(channels, linear, drive, tmp_path, rng):
    n = 25
    outputs = {c: rng.normal(size=n) * 10.0 ** rng.integers(-9, 9) for c in channels}
    outputs[channels[0]][[3, 7]] = np.nan
    units = {c: {"omega": "m/s", "theta": "m"}[c] for c in channels if c in ("omega", "theta") and linear}
    run = Experiment(np.cumsum(rng.uniform(1e-4, 1e-3, n)), {"v": rng.normal(size=n)}, outputs,
                     sigma={channels[-1]: 0.1 + 0.2}, hold="linear" if linear else "zoh",
                     units={"v": drive, **units},
                     meta={"extra": {"temp_C": np.arange(n), "omega": np.ones(n), "time_s": np.zeros(n)}})
    again = read_csv(write_csv(run, tmp_path / "run.csv"))
    assert again.hold == run.hold
    assert again.units == run.units
    assert again.sigma == run.sigma
    assert again.channels == run.channels
    assert notes(again).count("\n") == 0
    for mine, theirs in [(run.t, again.t), (run.inputs["v"], again.inputs["v"]),
                         *((run.outputs[c], again.outputs[c]) for c in channels)]:
        np.testing.assert_allclose(theirs, mine, rtol=1e-15)
    assert set(again.meta["extra"]) == {"temp_C", "omega", "time_s (extra)"}


def test_hold_said_while_reading_wins(tmp_path):
    run = read_csv(write(tmp_path, GOOD)).with_(hold="linear")
    path = write_csv(run, tmp_path / "again.csv")
    assert read_csv(path).hold == "linear"
    assert read_csv(path, hold="zoh").hold == "zoh"
    with pytest.raises(DataError, match="zoh, linear"):
        read_csv(path, hold="spline")


def test_a_place_that_cannot_be_written_is_a_usage_error(tmp_path):
    with pytest.raises(UsageError, match="cannot write"):
        write_csv(read_csv(write(tmp_path, GOOD)), tmp_path / "none" / "run.csv")


# -- real records -------------------------------------------------------------------------------------------

REAL = {
    "emps": ({}, ("theta",), {"v": "V", "theta": "m"}, [24841]),
    "fibo": ({}, ("omega",), {"v": "V", "omega": "rad/s"}, [25502] * 3),
    "frc": ({}, ("omega", "theta"), {"v": "V", "omega": "rad/s", "theta": "rad"}, [1287, 4211]),
    "furuta_base": ({}, CHANNELS, {"v": "V", "i": "A", "omega": "rad/s", "theta": "rad"}, [8001, 5001]),
    "odri_mn4004": ({}, CHANNELS,
                    {"v": "V", "i": "A", "omega": "rad/s", "theta": "rad", "v_supply": "V"}, [3717, 26999]),
    "unmotor": ({"units": {"omega": "deg/s"}}, ("omega",), {"v": "V", "omega": "rad/s"}, [4093, 302]),
    "xl330": ({}, ("omega", "theta"),
              {"v": "V", "omega": "rad/s", "theta": "rad", "v_supply": "V", "temp": "°C"},
              [1510, 1124, 1116, 1116, 1499, 1125, 1131, 1123]),
}


@pytest.mark.parametrize("folder", REAL)
def test_real_records_open_as_they_are(folder, real):
    hints, channels, units, samples = REAL[folder]
    runs = read_runs(real / folder, **hints)
    assert [r.n for r in runs] == samples
    for run in runs:
        assert run.channels == channels
        assert run.units == units
        assert "left out" not in notes(run)


def test_the_speed_of_unmotor_is_in_degrees_per_second(real):
    run = read_runs(real / "unmotor" / "step.csv", units={"omega": "deg/s"})[0]
    assert run.outputs["omega"][0] == pytest.approx(257.14288330 * np.pi / 180)


def test_a_column_that_is_taken_beside_those_that_were_named_is_said(tmp_path):
    path = tmp_path / "wheel.csv"
    path.write_text("t_s,current_A,frame_angle,speed_rad_s\n" + "".join(f"{k},{k % 3},{k},{k % 5}\n" for k in range(9)))
    named = {"t": "t_s", "v": "current_A", "omega": "speed_rad_s"}
    told = "also took 'frame_angle' as the angle (theta); --ignore theta leaves it out."
    assert told in read_csv(path, columns=named).meta["notes"]
    assert told not in read_csv(path, columns={**named, "theta": "frame_angle"}).meta["notes"]
    assert told not in read_csv(path, columns={"v": "current_A"}).meta["notes"], "of the input alone"


# -- what loggers, spreadsheets and oscilloscopes write ------------------------------------------------------


def _body(stamp, sep=",", n=60, decimal="."):
    lines = [sep.join([stamp(k), *(f"{x:.4f}".replace(".", decimal) for x in (k % 7, np.sin(k), k % 5))])
             for k in range(n)]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(("header", "stamp"), [
    ("Zeit", lambda k: f"12:00:00,{k:03d}"),
    ("Uhrzeit", lambda k: f"23:59:59,{970 + k}" if k < 30 else f"00:00:00,{k - 30:03d}"),
    ("timestamp", lambda k: f"2024-03-05 12:00:00,{k:03d}"),  # of Python's logging
    ("Datum", lambda k: f"05.03.2024 12:00:00,{k:03d}"),
    ("Date", lambda k: f"03/05/2024 11:59:58.{k:03d} AM"),
    ("Time", lambda k: f"00:58.{k:03d}"),  # a spreadsheet's minutes and seconds
    ("Time", lambda k: f"12:00:00:{k:03d}"),
])
def test_clock_times_and_dates_as_loggers_write_them(tmp_path, header, stamp):
    """A comma before the milliseconds made them seconds, a thousand times too long."""
    run = read_csv(write(tmp_path, f"{header};U [V];I [A];n [rpm]\n" + _body(stamp, ";", decimal=",")))
    assert run.t == pytest.approx(np.arange(60) * 1e-3, abs=1e-9)
    assert "no known unit stated, assuming t" not in notes(run)


def test_a_unit_that_is_not_known_is_not_called_unstated(tmp_path):
    body = "\n".join(f"{1e-3 * k:.3f},5,{k % 7}" for k in range(60))
    run = read_csv(write(tmp_path, f"time_s,voltage_V,speed (km/h)\n{body}\n"))
    assert "no known unit stated, assuming omega ('speed (km/h)') in rad/s; override with units." in notes(run)


def test_a_time_that_is_none_says_how_to_do_without(tmp_path):
    with pytest.raises(DataError, match=r"neither numbers nor dates.*dt=0\.001"):
        read_csv(write(tmp_path, "t,v,i,omega\n" + _body(lambda k: "soon" * (1 + k % 2))))


@pytest.mark.parametrize(("header", "full"), [
    ("duty_pct", 100), ("pwm_percent", 100), ("pwm", 255), ("duty [‰]", 1000), ("duty", 1)])
def test_a_duty_cycle_times_the_supply_is_taken_as_far_as_it_goes(tmp_path, header, full):
    duty = np.resize([0.0, 1.0, -0.5, 0.25], 60)
    text = "".join(f"{k * 1e-3:.3f},{d * full:.6g},12,{d:.3f}\n" for k, d in enumerate(duty))
    path = write(tmp_path, f"time_s,{header},supply_V,speed_rad_s\n" + text)
    assert read_csv(path).inputs["v"] == pytest.approx(12 * duty, rel=1e-6)
    # Volts of one are said for one supply, and not multiplied by it again; a share still is.
    assert read_csv(path, units={"v": f"{6 / full} V"}).inputs["v"] == pytest.approx(6 * duty, rel=1e-6)
    if header == "duty_pct":
        run = read_csv(path, units={"v": "%"})
        assert run.inputs["v"] == pytest.approx(12 * duty, rel=1e-6)
        assert run.units["v"] == "V"


def test_a_column_that_numbers_runs_begins_a_new_one_where_it_changes(tmp_path):
    text = "".join(f"{1 + k // 30},{k * 1e-3:.3f},{k % 7},{np.sin(k):.3f}\n" for k in range(60))
    runs = read_runs(write(tmp_path, "run,time_s,voltage_V,speed_rad_s\n" + text))
    assert [r.n for r in runs] == [30, 30]
    assert "a new run begins 1 time, where 'run' changes" in notes(runs[0])
    named = re.sub(r"(?m)^1,", "up,", re.sub(r"(?m)^2,", "down,", text))
    assert len(read_runs(write(tmp_path, "test,time_s,voltage_V,speed_rad_s\n" + named))) == 2
    mixed = "".join(f"{1 + k % 2},{k // 2 * 1e-3:.3f},{k % 7},{np.sin(k):.3f}\n" for k in range(120))
    (run,) = read_runs(write(tmp_path, "motor_id,time_s,voltage_V,speed_rad_s\n" + mixed))
    assert "'motor_id' changes in 119 rows: several at once? Split the file by it." in notes(run)


def test_a_time_of_its_own_beside_dt_is_told(tmp_path):
    text = "".join(f"{k * 1e-3},{k % 7},{k % 5}\n" for k in range(60))
    path = write(tmp_path, "time_s,voltage_V,speed_rad_s\n" + text)
    run = read_csv(path, dt=0.01)
    assert run.dt == pytest.approx(0.01)
    assert "'time_s' is not used" in notes(run)
    with pytest.raises(DataError, match="no column looks like the time"):
        read_csv(path, columns={"t": None})


def test_a_header_of_many_rows_of_numbers_is_no_data(tmp_path):
    """As LabVIEW writes it."""
    above = ("LabVIEW Measurement\t\nChannels\t3\t\t\t\nSamples\t60\t60\t60\t\nX0\t0,0\t0,0\t0,0\t\n"
             "Delta_X\t0,001\t0,001\t0,001\t\nX_Value\tVoltage\tCurrent\tSpeed\tComment\n")
    run = read_csv(write(tmp_path, above + _body(lambda k: f"0,{k:03d}", "\t", decimal=",")))
    assert run.n == 60
    assert run.dt == pytest.approx(1e-3)
    assert run.channels == ("i", "omega")


def test_a_unit_amidst_a_header_and_one_of_direct_current(tmp_path):
    body = _body(lambda k: f"{k * 1e-3:.3f}")
    run = read_csv(write(tmp_path, "Time(s),Voltage (V DC),Current(mA) filtered,Speed (x100 rpm)\n" + body))
    assert run.meta["original_units"]["v"] == "V"
    assert run.outputs["i"] == pytest.approx(np.round(np.sin(np.arange(60)), 4) * 1e-3, abs=1e-9)
    assert run.outputs["omega"].max() == pytest.approx(4 * 100 * 2 * np.pi / 60)
    two = "".join(f"{k * 1e-3:.3f},{k % 7},{k % 5},{k % 4}\n" for k in range(60))
    with pytest.raises(DataError, match="look equally like the current"):
        read_csv(write(tmp_path, "Time(s),Voltage(V),Current(mA) filtered,Current(mA) raw\n" + two))


@pytest.mark.parametrize(("voltage", "product"), [(12.0, True), ([12.0, 11.6, 12.1, 11.9], True),
                                                  ([6, -6, 3, 9], False)])
def test_a_voltage_that_hardly_changes_beside_a_duty_cycle_is_the_supply(voltage, product):
    table = pd.DataFrame({"time_s": np.arange(40) * 1e-2, "voltage": np.resize(voltage, 40),
                          "pwm": np.resize([100, -60, 30, 0], 40), "speed": np.arange(40.0)})
    (run,) = read_runs([table])
    duty = table["pwm"].to_numpy() / 100
    assert run.inputs["v"] == pytest.approx(table["voltage"].to_numpy() * (duty if product else 1))
    assert any("took 'pwm'" in note for note in run.meta["notes"]) == product
    (asked,) = read_runs([table], columns={"v": "voltage"})
    assert asked.inputs["v"] == pytest.approx(table["voltage"].to_numpy())  # as the user says
    for key in ("v", "voltage"):
        (scaled,) = read_runs([table], units={key: "mV"})
        assert scaled.inputs["v"] == pytest.approx(1e-3 * table["voltage"].to_numpy())


@pytest.mark.parametrize("header", ["current [counts]", "i [counts]", "motor current (%)", "current [V]"])
def test_a_column_in_a_unit_that_its_name_cannot_have_is_told(tmp_path, header):
    text = f"time_s,voltage_V,{header},speed_rad_s\n" + _body(lambda k: f"{k * 1e-3:.3f}")
    run = read_csv(write(tmp_path, text))
    assert run.channels == ("omega",)
    assert f"not used: '{header}'; it is named like the current" in notes(run)
    run = read_csv(write(tmp_path, text), columns={"i": header}, units={"i": "0.5 A"})
    assert run.outputs["i"] == pytest.approx(0.5 * np.round(np.sin(np.arange(60)), 4), abs=1e-9)


@pytest.mark.parametrize("row", ["t,{t:.3f},PWM,{v},speed,{w}", "t:{t:.3f} PWM:{v} speed:{w}",
                                 "t = {t:.3f}; PWM = {v}; speed = {w}", "t:{t:.3f},\tPWM:{v},\tspeed:{w}"])
def test_rows_of_names_and_numbers_in_turn_are_a_table(tmp_path, row):
    lines = [row.format(t=1e-3 * k, v=k % 7, w=0.5 * k) for k in range(60)]
    run = read_csv(write(tmp_path, "\n".join([*lines[:30], "reset by watchdog", *lines[30:]])), columns={"v": "PWM"})
    assert run.outputs["omega"] == pytest.approx(0.5 * np.arange(60))
    assert run.inputs["v"] == pytest.approx(np.arange(60) % 7)
    assert "left out 1 line without t, PWM, speed" in notes(run)


def test_who_names_a_channel_need_not_tell_others_apart(tmp_path):
    text = "t_s,u_V,Enc0,Enc1,Enc2\n" + "".join(f"{k},1,{k},{2 * k},{3 * k}\n" for k in range(20))
    run = read_csv(write(tmp_path, text), columns={"omega": "Enc0"})
    assert run.channels == ("omega",)
    assert "not used: 'Enc1' and 'Enc2', which look equally like the angle (theta)" in notes(run)
