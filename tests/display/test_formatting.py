"""Numbers in tables: rounded to the error, readable in every decade, never a false digit."""

import math

import pytest

from motorid.display.numbers import arrow, duration, factor, number, percent, quantity, with_error


@pytest.mark.parametrize(("value", "std", "unit", "text"), [
    (1.30243, 0.00412, "Ω", "1.302 ± 0.004 Ω"),
    (2.0344e-5, 1.23e-7, "kg·m²", "(2.034 ± 0.012)·10⁻⁵ kg·m²"),
    (1234.5, 234, "K/W", "1230 ± 230 K/W"),
    (123456, 2345, "", "(1.235 ± 0.023)·10⁵"),
    (-1.23456, 0.0953, "N", "−1.235 ± 0.095 N"),
    (5, 9.7, "", "5.0 ± 9.7"),
    (0.39, 12, "N·m", "0.4 ± 12.0 N·m"),
    (-1e-4, 0.2, "N", "0.00 ± 0.20 N"),
    (0.0, 0.02, "", "0.000 ± 0.020"),
    (1.3, 0, "Ω", "1.3 Ω (fixed)"),
    (1.3, None, "Ω", "1.3 Ω (not determined)"),
    (1.3, math.nan, "Ω", "1.3 Ω (not determined)"),
    (math.inf, 0.1, "A", "∞ A"),
])
def test_value_and_error_are_rounded_to_the_same_place(value, std, unit, text):
    assert with_error(value, std, unit) == text


@pytest.mark.parametrize("std", [10.0**k * f for k in range(-12, 7) for f in (1.0, 3.54, 3.55, 9.49, 9.5)])
def test_what_is_printed_is_within_a_tenth_of_the_error_of_the_value(std):
    value = 3.14159265e-3
    text = with_error(value, std)
    mantissa, _, power = text.partition(")·10")
    exponent = int(power.translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789"))) if power else 0
    shown, error = (float(w.strip(" (").replace("−", "-")) * 10.0**exponent for w in mantissa.split("±"))
    # One digit kept of an error that begins with 355 or more: half a unit there is 14 % at most.
    assert abs(shown - value) <= 0.15 * std
    assert error == pytest.approx(std, rel=0.15)


@pytest.mark.parametrize(("value", "text"), [
    (1.2345e-5, "1.234·10⁻⁵"), (-0.5, "−0.5"), (99999.7, "1·10⁵"), (0.000999999, "0.001"), (12.0, "12"),
    (100.0, "100"),
    (0, "0"), (None, "–"), (math.nan, "–"), (-math.inf, "−∞"), (1234.0, "1234"), (12345.0, "12340"),
])
def test_numbers_keep_four_significant_digits(value, text):
    assert number(value) == text


def test_words_for_shares_units_and_times():
    assert percent(0.0123) == "1.23 %"
    assert percent(None) == "–"
    assert [percent(s) for s in (10.0, 155.0, -155.0, math.inf)] == ["1000 %", "over 1000 %", "below −1000 %",
                                                                     "over 1000 %"]
    assert [factor(r, "up to ") for r in (16.4, 1000, 17000)] == ["up to 16", "up to 1000", "over 1000"]
    assert quantity(None, "Ω") == "–"
    assert quantity(5e-3, "N·m") == "0.005 N·m"
    assert quantity(0.4, "1") == "0.4"  # a duty
    assert [duration(s) for s in (0.0352, 1.234, 59.99, 200)] == ["35 ms", "1.23 s", "1 min", "3 min 20 s"]


def test_a_change_between_two_large_errors_is_told():
    assert arrow(50.0, 12.0) == "5000 → 1200 %"
    assert arrow(float("nan"), 0.01) == "– → 1 %"
