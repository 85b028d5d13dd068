"""Sampled signals: arrays of floats with time along the first axis, NaN where a sample is missing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def bridged(t: Array, y: Array) -> Array:
    """Return `y` (N,) with straight lines over its gaps; the same array where there are none."""
    good = np.isfinite(y)
    return y if good.all() else np.interp(t, t[good], y[good])


def integral(t: Array, y: Array, hold: bool = False) -> Array:
    """Return ∫y dt (N,) from the first sample on; straight lines between samples, or each held until the next."""
    steps = np.diff(t) * (y[:-1] if hold else (y[1:] + y[:-1]) / 2)
    return np.concatenate([[0.0], np.cumsum(steps)])


def slope(t: Array, y: Array, half: int) -> Array:
    """Return dy/dt (N,) over windows of 2·half samples, shorter at the ends."""
    k = np.arange(len(t))
    a, b = np.maximum(k - half, 0), np.minimum(k + half, len(t) - 1)
    return (y[b] - y[a]) / (t[b] - t[a])


def window_slopes(t: Array, y: Array, windows: int = 200) -> Array:
    """Return the mean slopes of `y` over about so many windows, one after the other; empty for next to no samples."""
    good = np.isfinite(y)
    y, t = y[good], t[good]
    if len(y) < 4:
        return np.zeros(0)
    step = max(len(y) // windows, 1)
    return np.diff(y[::step]) / np.diff(t[::step])
