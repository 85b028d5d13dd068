"""Numbers for people: values with errors, per cent, durations. One place, so that every table agrees."""

import math
import re
from collections.abc import Sequence
from decimal import ROUND_HALF_EVEN, Decimal

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
NO_BREAK = "\u00a0"
_LARGEST = 5  # decades below it are written out, from 1e-3 on (with an error: from 1e-2 on)


def with_error(value: float, std: float | None, unit: str = "", why: str = "not determined") -> str:
    """Return a value with its standard deviation, both rounded to what the error allows.

    The error keeps one or two digits by the rule of the Particle Data Group (Review of Particle Physics):
    two where its first digits are 10–35, one from 36–94; the value is rounded to the same place. A deviation of 0
    means fixed, not estimated; for None (or not finite) `why` is said: the data do not determine the value.

    Examples
    --------
    >>> with_error(1.30243, 0.00412, "Ω")
    '1.302 ± 0.004 Ω'
    >>> with_error(2.0344e-5, 1.23e-7, "kg·m²")
    '(2.034 ± 0.012)·10⁻⁵ kg·m²'
    """
    tail = f" {unit}" if unit else ""
    if not math.isfinite(value):
        return number(value) + tail
    if std is None or not math.isfinite(std) or std < 0:
        return f"{number(value, 3)}{tail} ({why})"
    if std == 0:
        return f"{number(value, 6)}{tail} (fixed)"
    place = _place(std)
    if 0.01 * std < abs(value) < std:  # rounded to so large an error, nothing of it would be left
        place = max(min(place, _place(abs(value))), place - 2)
    power = _power(max(abs(value), std), -2)
    exact, error = _rounded(value, place, power), _rounded(std, place, power)
    return f"({exact} ± {error})·10{raised(power)}{tail}" if power else f"{exact} ± {error}{tail}"


def number(value: float | None, digits: int = 4) -> str:
    """Return a number with `digits` significant digits, no trailing zeros: ``0.01234``, ``2.03·10⁻⁵``."""
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if value == 0:
        return "0"
    value = float(f"{value:.{digits - 1}e}")
    power = _power(abs(value))
    text = _rounded(value, math.floor(math.log10(abs(value))) - digits + 1, power)
    text = text.rstrip("0").rstrip(".") if "." in text else text
    return f"{text}·10{raised(power)}" if power else text


def quantity(value: float | None, unit: str = "", digits: int = 4) -> str:
    """Return a number with its unit; what is not known, and a ratio ("1"), has none."""
    if value is None or math.isnan(value) or unit == "1":
        return number(value, digits)
    return f"{number(value, digits)} {unit}".rstrip()


def percent(share: float | None, digits: int = 3) -> str:
    """Return a share as per cent: ``0.0123`` is ``1.23 %``, 155 is ``over 1000 %``."""
    return "–" if share is None or math.isnan(share) else f"{factor(100 * share, '', digits)} %"


def factor(ratio: float, lead: str = "", digits: int = 2) -> str:
    """Return ``up to 16``, after `lead`; or ``over 1000``: beyond, it says how small the measure is, no more."""
    return f"{lead}{number(ratio, digits)}" if not abs(ratio) > 1000 else f"{('over ', 'below −')[ratio < 0]}1000"


def arrow(before: float, after: float) -> str:
    """Return how a share changed: ``12.7 → 1.02 %``, however large it is."""
    first, last = ("–" if math.isnan(share) else number(100 * share, 3) for share in (before, after))
    return f"{first} → {last}{' %' * (last != '–')}"


def duration(seconds: float) -> str:
    """Return a time for people: ``35 ms``, ``1.2 s``, ``3 min 20 s``."""
    if not math.isfinite(seconds):
        return "–"
    if seconds < 0.9995:
        return f"{number(1e3 * seconds, 2)} ms"
    if seconds < 59.95:
        return f"{number(seconds, 3)} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if rest else f"{minutes} min"


def interval_text(limits: tuple[float, float] | None) -> str:
    """Return an interval with the digits that its width asks for; an unknown one as a dash."""
    if limits is None:
        return "–"
    low, high = limits
    finite = [abs(x) for x in limits if math.isfinite(x)]
    width = (high - low) / max(finite) if math.isfinite(high - low) and any(finite) else 1.0
    digits = min(max(2 - math.floor(math.log10(max(width, 1e-12))), 3), 10)
    return f"{number(low, digits)} … {number(high, digits)}"


def glued(text: str) -> str:
    """Return a text in which no line ends within a value, its error and its unit, or between = and a value."""
    text = re.sub(r"(?<=\d) ([±→]) (?=\d)|(?<=\w) (=) (?=[(\d−])", lambda m: NO_BREAK + (m[1] or m[2]) + NO_BREAK, text)
    return re.sub(r"(?<=[\d⁰¹²³⁴⁵⁶⁷⁸⁹]) (?=[%a-zA-ZΩ°µ])(?!(and|or|to|of|the|times|in)\b)", NO_BREAK, text)


def counted(n: int, noun: str) -> str:
    """Return ``1 run``, ``2 runs``."""
    return f"{n} {noun}" + ("" if n == 1 else "s")


def listed(names: Sequence[str], last: str = "and") -> str:
    """Return ``a, b and c``."""
    return f" {last} ".join(", ".join(names).rsplit(", ", 1))


def sentence(text: str) -> str:
    """Return a message as a sentence: a capital first, a full stop last."""
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", "!", "?")) else ".") if text else ""


def _place(std: float) -> int:
    """Decimal place to which an error is rounded."""
    decade = math.floor(math.log10(std))
    first = round(std / 10.0 ** (decade - 2))  # its first three digits
    return decade - 1 if first < 355 or first >= 950 else decade


def _power(size: float, smallest: int = -3) -> int:
    decade = math.floor(math.log10(size))
    return 0 if smallest <= decade < _LARGEST else decade


def _rounded(value: float, place: int, power: int) -> str:
    shifted = Decimal(repr(float(value))).scaleb(-power)
    text = f"{shifted.quantize(Decimal(1).scaleb(place - power), ROUND_HALF_EVEN):f}"  # of tens or more, with zeros
    return text.replace("-", "−") if text.strip("-0.") else text.replace("-", "")


def raised(power: int) -> str:
    """Return an exponent as it stands above the line."""
    return str(power).translate(_RAISED)
