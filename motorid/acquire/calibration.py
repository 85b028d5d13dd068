"""The user's calibration of a bench: per channel scale, offset, gain, zero and sign, from a TOML file."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from pathlib import Path

from motorid.acquire.protocol import Channel, Header
from motorid.errors import DataError, one_of

_ENTRIES = ("scale", "offset", "gain", "zero", "sign")


def read_calibration(path: str | Path) -> dict[str, dict[str, float]]:
    """Read a calibration file: entries by channel.

    Raises
    ------
    DataError
        If it cannot be read, or holds an entry that is not known or not a finite number.
    """
    try:
        tables = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"the calibration file {path} cannot be read: {error.strerror}.") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DataError(f"the calibration file {path} is not TOML: {error}.") from None
    for channel, entries in tables.items():
        if not isinstance(entries, dict):
            raise DataError(f"{path}: expected a table [channel] with entries; '{channel}' stands alone.")
        for name, value in entries.items():
            if name not in _ENTRIES:
                raise DataError(f"{path}, [{channel}]: {one_of(name, _ENTRIES, 'entry')}")
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise DataError(f"{path}, [{channel}]: {name} must be a number; got {value!r}.")
            if name == "sign" and value not in (1, -1):
                raise DataError(f"{path}, [{channel}]: sign is 1 or -1; got {value}.")
            if name in ("scale", "gain") and value == 0:
                raise DataError(f"{path}, [{channel}]: {name} must not be zero.")
    return tables


def calibrate(header: Header, calibration: dict[str, dict[str, float]]) -> Header:
    """Return the header with the channels' scales and offsets as the calibration wants them."""
    names = [c.name for c in header.channels]
    for name in calibration:
        if name not in names:
            raise DataError(f"the calibration speaks of a channel that the device does not send: "
                            f"{one_of(name, names, 'channel')}")
    channels = tuple(_calibrated(c, calibration.get(c.name, {})) for c in header.channels)
    return replace(header, channels=channels)


def _calibrated(channel: Channel, entries: dict[str, float]) -> Channel:
    offset = entries.get("offset", channel.offset)
    scale = entries.get("scale", channel.scale) * entries.get("gain", 1.0) * entries.get("sign", 1)
    # zero + scale·(raw − offset) is scale·(raw − (offset − zero/scale)).
    return replace(channel, scale=scale, offset=offset - entries.get("zero", 0.0) / scale)
