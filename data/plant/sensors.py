"""What sensors and loggers do to a signal; random parts draw from the numpy Generator that is passed in."""

from __future__ import annotations

import cmath
from bisect import bisect_right
from math import cos, exp, sin

import numpy as np


def white(x: np.ndarray, sigma: float, rng: np.random.Generator) -> np.ndarray:
    """Add white Gaussian noise of standard deviation sigma."""
    return x + sigma * rng.standard_normal(len(x))


def coloured(x: np.ndarray, sigma: float, rho: float, rng: np.random.Generator) -> np.ndarray:
    """Add first-order autoregressive noise of standard deviation sigma and lag-one correlation rho."""
    draws = rng.standard_normal(len(x))
    e = np.empty(len(x))
    e[0] = draws[0]
    for k in range(1, len(x)):
        e[k] = rho * e[k - 1] + np.sqrt(1 - rho**2) * draws[k]
    return x + sigma * e


def adc(x: np.ndarray, full_scale: float, bits: int = 12) -> np.ndarray:
    """Quantise to 2**bits levels over ±full_scale, and clip there."""
    lsb = 2 * full_scale / 2**bits
    return np.clip(np.round(x / lsb), -(2 ** (bits - 1)), 2 ** (bits - 1) - 1) * lsb


def encoder(theta: np.ndarray, counts: int) -> np.ndarray:
    """Angle as an incremental encoder with so many counts per turn gives it."""
    return np.floor(theta * counts / (2 * np.pi) + 1e-9) * (2 * np.pi / counts)


def encoder_speed(theta: np.ndarray, t: np.ndarray, counts: int, average: int = 1) -> np.ndarray:
    """Speed from differences of encoder counts, with a causal moving average over `average` samples."""
    raw = np.diff(encoder(theta, counts)) / np.diff(t)
    raw = np.concatenate([raw[:1], raw])
    total = np.cumsum(np.concatenate([np.full(average, raw[0]), raw]))
    return (total[average:] - total[:-average]) / average


def outliers(x: np.ndarray, share: float, size: float, rng: np.random.Generator) -> np.ndarray:
    """Replace a share of the samples by spikes of ±size on top of them."""
    hit = rng.random(len(x)) < share
    return x + np.where(hit, size * (rng.integers(0, 2, len(x)) * 2 - 1), 0.0)


def dropouts(x: np.ndarray, share: float, rng: np.random.Generator, length: int = 1) -> np.ndarray:
    """Replace about this share of the samples by NaN, in gaps of `length`."""
    y = np.array(x, float)
    for start in np.flatnonzero(rng.random(len(x)) < share / length):
        y[start : start + length] = np.nan
    return y


def uneven(t: np.ndarray, jitter: float, rng: np.random.Generator) -> np.ndarray:
    """Time stamps moved by up to ±jitter of the sampling step (below 0.5, so that they stay in order)."""
    if not 0 <= jitter < 0.5:
        raise ValueError(f"jitter is a share of the step below 0.5, not {jitter}")
    moved = t + rng.uniform(-jitter, jitter, len(t)) * np.median(np.diff(t))
    moved[0] = t[0]
    return moved


def resample(t_new: np.ndarray, t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Values of x(t) at other times by straight lines."""
    return np.interp(t_new, t, x)


class Chain:
    """What happens between the shaft and the logger: lags, a pure delay, a mean, gains, offsets, the duty."""

    def __init__(self, hooks: list[dict], omega0: float) -> None:
        has = dict(h["sensor"] for h in hooks if "sensor" in h)
        self.lag_i, self.lag_w, self.lag_th = (has.get(f"{c}_lag") for c in ("current", "speed", "angle"))
        self._behind = float(omega0)  # the speed behind the angle's lag; that times the lag the angle is late
        self.filter, self._rate = has.get("speed_filter"), 0.0
        self.delay, self.gain = has.get("speed_delay", 0.0), has.get("speed_gain", 1.0)
        self.offset, self.window = has.get("current_offset", 0.0), has.get("speed_average", 0.0)
        self.window_i = has.get("current_average", 0.0)
        self.speed_offset, self.current_gain = has.get("speed_offset", 0.0), has.get("current_gain", 1.0)
        self.ripple = has.get("speed_ripple", (0.0, 1.0, 0.0, 0.0))
        self.duty = has.get("duty", lambda v: 1.0)
        self.i, self.w = 0.0, float(omega0)
        self._last = (0.0, float(omega0))
        self._keeps = bool(self.delay or self.window or self.window_i)
        self._at_once = not (self.lag_i or self.lag_w or self.lag_th or self.filter or self._keeps)
        self._turned, self._omega0 = 0.0, float(omega0)  # the integral of the speed
        self._charge = 0.0
        self._times, self._speeds, self._charges = [0.0], [0.0 if self.window else float(omega0)], [0.0]

    def sample(self, t: float, h: float, i: float, w: float) -> None:
        """Follow the true current and speed, taken as straight lines over the last step of h seconds."""
        if self._at_once:
            self.i, self.w = i, w
            return
        self.i = _lag(self.i, self._last[0], i, h, self.lag_i)
        self._behind = _lag(self._behind, self._last[1], w, h, self.lag_th)
        if self.filter:
            self.w, self._rate = _filtered(self.w, self._rate, self._last[1], w, h, *self.filter)
        else:
            self.w = _lag(self.w, self._last[1], w, h, self.lag_w)
        if self.window:  # what is kept and looked up is the angle
            self._turned += 0.5 * h * (self._last[1] + w)
        if self.window_i:
            self._charge += 0.5 * h * (self._last[0] + i)
        self._last = (i, w)
        if self._keeps:
            self._times.append(t)
            self._speeds.append(self._turned if self.window else self.w)
            self._charges.append(self._charge)
            if len(self._times) > 4096 and self._times[2048] < t - self.delay - self.window - self.window_i:
                del self._times[:2048], self._speeds[:2048], self._charges[:2048]

    def read(self, t: float, theta: float, v: float) -> dict[str, float]:
        """Return what is seen at the time t of the angle theta, with v volts commanded."""
        w = self._before(self._speeds, t - self.delay) if self.delay else self.w
        if self.window:
            begun = self._omega0 * min(t - self.window, 0.0)
            w = (self._turned - begun - self._before(self._speeds, t - self.window)) / self.window
        i = (self._charge - self._before(self._charges, t - self.window_i)) / self.window_i if self.window_i else self.i
        i = self.current_gain * self.duty(v) * i + self.offset
        part, periods, phase, angle = self.ripple
        w *= 1 + part * sin(periods * theta + phase)
        read = theta - angle * part / periods * cos(periods * theta + phase) - (self.lag_th or 0.0) * self._behind
        return {"i": i, "omega": self.gain * w + self.speed_offset, "theta": read}

    def _before(self, kept: list[float], t: float) -> float:
        """Return what was kept of the time t, or of the start before it."""
        k = bisect_right(self._times, t + 1e-12)
        if k in (0, len(self._times)):
            return kept[-min(k, 1)]
        part = max(0.0, (t - self._times[k - 1]) / (self._times[k] - self._times[k - 1]))
        return kept[k - 1] + part * (kept[k] - kept[k - 1])


def _lag(z: float, u0: float, u1: float, h: float, tau: float | None) -> float:
    """First-order lag over h, exact for an input straight from u0 to u1."""
    if not tau:
        return u1
    slope = (u1 - u0) / h
    return (u1 - slope * tau) + (z - u0 + slope * tau) * exp(-h / tau)


def _filtered(z: float, rate: float, u0: float, u1: float, h: float, T: float, zeta: float) -> tuple[float, float]:
    """Second-order filter over h, T²z″ + 2ζTz′ + z = u, exact for an input straight from u0 to u1."""
    slope = (u1 - u0) / h
    a, b = z - (u0 - 2 * zeta * T * slope), rate - slope  # off the straight line that is left at last
    root = cmath.sqrt(zeta * zeta - 1) or 1e-6
    fast, slow = (-zeta - root) / T, (-zeta + root) / T
    p = (b - slow * a) / (fast - slow)
    one, two = p * cmath.exp(fast * h), (a - p) * cmath.exp(slow * h)
    return (one + two).real + u1 - 2 * zeta * T * slope, (fast * one + slow * two).real + slope
