"""Column names and units are understood as people write them, and nothing is mistaken for a measurement."""

from __future__ import annotations

import math

import pytest

from motorid.errors import DataError, UsageError
from motorid.records.headers import assign, classify, is_duty, is_supply, parse_pairs, parse_unit, require_unit

KNOWN = {
    "t": "t|time|time_s|t_ms|Time [s]|timestamp_us|Zeit|Zeit in ms|t / s|time (ms)|Timestamp(us)|"
         "T|Temps (s)|x (s)|timeStamp|elapsed_ms|seconds|ms",
    "v": "v|u|V|U|volt|Voltage (V)|voltage_mV|u_volt|Uq|Spannung|Spannung / V|U [V]|u_a|v_motor|"
         "motorVoltage|motor_voltage_v|voltage_cmd|command|command_N|input|Vin|CH1 (V)|"
         "Ankerspannung [V]|drive voltage|volts|Tension (V)|u(t)",
    "i": "i|I_A|current_mA|current|Iq|i_q|Strom|Strom [A]|motor current (A)|i_a|ia|Courant (A)|"
         "CH2 [A]|current_A|curr_mA|amps|I in mA|phase_current_A",
    "omega": "omega|w|speed|speed_rpm|speed_rad_s|Velocity|velocity_rad_per_s|rpm|n_rpm|N [rpm]|"
             "Drehzahl|Drehzahl [1/min]|Drehzahl in U/min|vel_deg_s|omega_rev_s|speed (krpm)|"
             "theta_dot|thetadot|dtheta_dt|angular velocity [rad/s]|v_m_s|v [m/s]|speed_m_s|"
             "Vitesse (tr/min)|speedRPM|velo|motor_spd|speed_dps|encoder_speed|angle_rate|ω [rad/s]|qd",
    "theta": "theta|angle_deg|position_rad|position_m|pos|Position|Winkel|Winkel [°]|encoder|"
             "encoder_counts|position_counts|theta_m|x_m|x [mm]|phi|q|angle|angular position|"
             "positionDeg|Weg in mm|rotor_angle_rad",
    "v_supply": "bus_V|Vsupply|Vbat|battery_voltage|supply_mV|v_bus",
    "tau_load": "tau_load|load_torque_Nm|brake_torque [mNm]|Lastmoment_Nm|load force (N)",
    "temp": "temp_C|temperature|winding temperature (°C)|motor_temp_K|T (K)|case [degC]",
    None: "position_ref_m|goal_rad|battery_current|mcu_temp|bridge_temperature|torque_Nm|duty|pwm|"
          "torque_enable|force_N|"
          "speed_ref|speedRef|omega_ref|Solldrehzahl_soll|soll_drehzahl|Drehzahl_soll|"
          "current_limit|current_cmd|Id|Ud|T_motor|n|sample|index|target_speed|setpoint|"
          "supply_current|y|status|phase_deg|x|current_mV|power_W|vref|"
          "accel_rad_s2|position_error|time_voltage|speed_V",
}
CASES = [(channel, header) for channel, text in KNOWN.items() for header in text.split("|")]


@pytest.mark.parametrize(("channel", "header"), CASES)
def test_a_header_is_taken_for_the_right_channel(channel, header):
    found = classify(header)
    assert (found.channel if found else None) == channel


@pytest.mark.parametrize(("header", "unit", "factor"), [
    ("t_ms", "s", 1e-3), ("timestamp_us", "s", 1e-6), ("voltage_mV", "V", 1e-3), ("Strom [mA]", "A", 1e-3),
    ("speed_rpm", "rad/s", math.pi / 30), ("Drehzahl in 1/min", "rad/s", math.pi / 30),
    ("speed (krpm)", "rad/s", 1e3 * math.pi / 30), ("omega_rev_s", "rad/s", 2 * math.pi),
    ("vel_deg_s", "rad/s", math.pi / 180), ("v [m/s]", "m/s", 1.0), ("angle_deg", "rad", math.pi / 180),
    ("Winkel [°]", "rad", math.pi / 180), ("x [mm]", "m", 1e-3), ("speed_rad_s", "rad/s", 1.0),
])
def test_the_unit_in_a_header_is_understood(header, unit, factor):
    found = classify(header)
    assert found is not None
    assert found.unit is not None
    assert (found.unit.symbol, found.unit.factor) == (unit, pytest.approx(factor))


@pytest.mark.parametrize(("header", "per_turn"), [
    ("angle_counts:40000", 40000), ("angle [counts:40000]", 40000), ("Winkel counts:512", 512),
    ("speed_counts/s:2048", 2048), ("angle_counts", None), ("theta_counts_4096", None), ("angle_counts_raw", None),
    ("Winkel_Inkremente", None), ("Winkel_Inkremente_roh", None), ("speed_ticks_raw", None)])
def test_an_angle_in_counts_is_in_no_radians(header, per_turn):
    found = classify(header)
    assert found is not None
    assert found.unit is not None
    assert found.unit.factor == pytest.approx(2 * math.pi / (per_turn or math.nan), nan_ok=True)
    layout = assign(["time_s", "voltage_V", "current_A", header])
    assert (found.channel in layout.places) == bool(per_turn)
    assert any("encoder counts" in n for n in layout.notes) == (not per_turn)
    assert not any("not used" in n for n in layout.notes)  # how to use it is said


def test_a_step_or_an_inclination_is_no_count():
    for header in ("step_angle_cmp", "inc_angle"):
        assert classify(header) == ("theta", None, 2.0)


@pytest.mark.parametrize(("header", "unit"), [("time ms:1", "ms"), ("voltage mV:2", "mV"), ("current [mA]:3", "mA"),
                                              ("current_mA:1", "mA"), ("speed rpm:4", "rpm"), ("n_rpm:2", "rpm")])
def test_a_number_of_the_logger_s_channel_hides_no_unit(header, unit):
    assert classify(header).unit.label == unit


@pytest.mark.parametrize("header", ["speed pulse response", "motor speed - pulse test", "speed: steps test"])
def test_the_name_of_a_test_is_no_count(header):
    assert classify(header) == ("omega", None, 2.0)


def test_supply_and_duty_are_told_apart():
    assert all(map(is_supply, ["bus_V", "Vsupply", "Vbat", "dc_link", "v_bus"]))
    assert not any(map(is_supply, ["supply_current", "voltage", "v"]))
    assert all(map(is_duty, ["duty", "pwm_pct", "duty cycle (%)", "pwmDuty"]))
    assert not is_duty("pwm_voltage")


@pytest.mark.parametrize(("text", "symbol", "factor"), [
    ("rpm", "rad/s", math.pi / 30), ("[deg/s]", "rad/s", math.pi / 180), ("°/s", "rad/s", math.pi / 180),
    ("min⁻¹", "rad/s", math.pi / 30), ("min^-1", "rad/s", math.pi / 30), ("U/min", "rad/s", math.pi / 30),
    ("rad per s", "rad/s", 1), ("rad·s^-1", "rad/s", 1), ("µs", "s", 1e-6), ("N·m", "N·m", 1),
    ("mN*m", "N·m", 1e-3),
    ("counts:2048", "rad", 2 * math.pi / 2048), ("ticks/s:100", "rad/s", 2 * math.pi / 100),
    ("-1 A", "A", -1),
    ("0.0049 A", "A", 0.0049), ("1e3 rpm", "rad/s", 1e3 * math.pi / 30), ("%", "1", 0.01), ("12 V", "V", 12),
])
def test_units_are_read_as_people_write_them(text, symbol, factor):
    unit = parse_unit(text)
    assert unit is not None
    assert (unit.symbol, unit.factor) == (symbol, pytest.approx(factor))


def test_a_scaled_kelvin_keeps_its_zero():
    """298.2 K in tenths were 298.2 °C."""
    assert [parse_unit(u).offset for u in ("K", "0.1 K", "0.1 degC")] == [-273.15, -273.15, 0.0]


@pytest.mark.parametrize("text", ["", "foo", "rpmm", "0 A", "1e99 A", "V/s", "inf V", "2"])
def test_what_is_no_unit_is_none(text):
    assert parse_unit(text) is None


def test_a_number_may_touch_the_unit_that_a_user_gives():
    assert require_unit("0.047V", "v").factor == 0.047
    assert [require_unit(u, "theta").factor for u in ("6.5e-5 m", "6.5e-5m", "-2E+1 mm")] == [6.5e-5, 6.5e-5, -0.02]
    assert require_unit("-1rad/s", "omega").factor == -1
    assert parse_unit("12V") is None, "in a header that is a name"


@pytest.mark.parametrize(("text", "channel", "says"), [
    ("rmp", "omega", "Did you mean 'rpm'"), ("V", "omega", "that is a voltage"),
    ("rpm", "theta", "that is a speed"),
    ("counts", "theta", "counts:2048"), ("counts:x", "theta", "positive number"),
    ("ms", "i", "that is a time"),
])
def test_a_wrong_unit_is_refused_with_what_was_expected(text, channel, says):
    with pytest.raises(DataError, match=says):
        require_unit(text, channel)


def columns(header: str, **kw) -> dict[str, str]:
    return {c: p.column for c, p in assign(header.split(","), **kw).places.items()}


@pytest.mark.parametrize(("header", "expected"), [
    ("t,u,y", {"t": "t", "v": "u", "omega": "y"}),
    ("t,u,y,w", {"t": "t", "v": "u", "omega": "w"}),
    ("t_s,voltage_V,force_N,position_m,position_ref_m",
     {"t": "t_s", "v": "voltage_V", "theta": "position_m"}),
    ("Time,Position,Velocity,Iq,Uq,Vsupply", {"t": "Time", "v": "Uq", "i": "Iq", "omega": "Velocity",
                                              "theta": "Position", "v_supply": "Vsupply"}),
    ("time,T,u,w", {"t": "time", "v": "u", "omega": "w"}),
    ("t,u,speed_rpm,speed_rad_s", {"t": "t", "v": "u", "omega": "speed_rad_s"}),
    ("t,u_cmd,u,w", {"t": "t", "v": "u", "omega": "w"}),
    ("t,u,encoder,position_deg", {"t": "t", "v": "u", "theta": "position_deg"}),
])
def test_the_columns_of_a_file_are_found(header, expected):
    assert columns(header) == expected


def test_what_was_assumed_is_told():
    told = "\n".join(assign(["t", "u", "w", "y"]).notes)
    assert "t ('t') in s" in told
    assert "omega ('w') in rad/s" in told
    assert assign(["t_s", "u_V", "w_rad_s"]).notes == []
    assert "a guess from the headers" in "\n".join(assign(["t_s", "CH1 (V)", "w_rad_s"]).notes)


def test_columns_by_name_whatever_the_case_and_by_position():
    assert columns("Time,Volt,Speed", columns={"t": "time", "v": "VOLT", "omega": 3})["omega"] == "Speed"
    with pytest.raises(DataError, match="unknown column '0'"):
        columns("a,b,c", columns={"t": 0})
    with pytest.raises(DataError, match="that is a length"):
        columns("t,u,position_m", columns={"omega": "position_m"})
    assert columns("t,u,position_m", columns={"omega": "position_m"}, units={"omega": "m/s"})["omega"]


def test_units_go_by_channel_or_column():
    for key in ("omega", "y"):
        place = assign(["t", "u", "y"], units={key: "deg/s"}).places["omega"]
        assert place.unit.factor == pytest.approx(math.pi / 180)
        assert place.stated
    with pytest.raises(DataError, match="not used as a channel"):
        assign(["t", "u", "w", "power"], units={"power": "V"})


@pytest.mark.parametrize(("text", "pairs"), [
    ("t=time,v=u_volt,omega=speed", {"t": "time", "v": "u_volt", "omega": "speed"}),
    (" t = time , v = Voltage (V),", {"t": "time", "v": "Voltage (V)"}),
    ("theta=counts:2048", {"theta": "counts:2048"}),
    ("v=a=b", {"v": "a=b"}),
])
def test_pairs_are_read(text, pairs):
    assert parse_pairs(text, "--columns") == pairs


@pytest.mark.parametrize("text", ["", " , ", "t", "t=", "=time", "t=time,v", "t=a,t=b"])
def test_pairs_that_are_none_are_a_usage_error_naming_the_option(text):
    with pytest.raises(UsageError, match="--columns"):
        parse_pairs(text, "--columns")
