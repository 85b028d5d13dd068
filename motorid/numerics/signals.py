"""Sampled signals: gaps, integrals, slopes; steps, outliers, noise. Time is the first axis, NaN a missing sample."""

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

WINDOWS = 200  # over which slopes are taken
ORDERS = (2, 3, 4, 5, 6)  # of differences
_SMALLER_HALF = 0.3240277  # mean of |z| over the smaller half, z standard normal: 4·(φ(0) − φ(0.67449))
_FLOOR = 1e-5  # of the channel's own variation: what a noise-free simulation is given
FEWEST_FRESH = 20  # measurements of a sensor that is read more often than it measures
MOST_HELD = 64  # samples for which a sensor is looked at as one that holds its value
HELD = 30.0  # times the noise that its changes are, squared: 130 and more in a trial, 12 at most in 870 other channels
COARSE = 0.01  # of the interval: rounding of time stamps that matters; of that rounding: what is none
_EVEN = 1e-6  # of the interval: samples are evenly spaced if their times wander by less
_FEW, _MOSTLY = 512, 0.8  # jumps of a first look at a step, and the share of them that must be its multiples
_REST = 12  # equal samples in a row that count as standstill
MOST_LEFT_OUT = 3  # samples in a row: what an input did in more nobody knows
CLIP = 6.0  # robust standard deviations beyond which a residual counts as an outlier
_DITHERED = 0.6  # noise that is to be seen through the steps leaves fewer neighbours equal than this


def bridged(t: Array, y: Array) -> Array:
    """Return `y` (N,) with straight lines over its gaps; the same array where there are none."""
    good = np.isfinite(y)
    return y if good.all() else np.interp(t, t[good], y[good])


def integral(t: Array, y: Array, hold: bool = False) -> Array:
    """Return ∫y dt (N,) from the first sample on; straight lines between samples, or each held until the next."""
    return np.concatenate([[0.0], np.cumsum(np.diff(t) * (y[:-1] if hold else (y[1:] + y[:-1]) / 2))])


def slope(t: Array, y: Array, half: int) -> Array:
    """Return dy/dt (N,) over windows of 2·half samples, shorter at the ends."""
    k = np.arange(len(t))
    a, b = np.maximum(k - half, 0), np.minimum(k + half, len(t) - 1)
    return (y[b] - y[a]) / (t[b] - t[a])


def window_slopes(t: Array, y: Array) -> Array:
    """Return the mean slopes of `y` over about 200 windows, one after the other; empty for next to no samples."""
    good = np.isfinite(y)
    y, t = y[good], t[good]
    if len(y) < 4:
        return np.zeros(0)
    step = max(len(y) // WINDOWS, 1)
    return np.diff(y[::step]) / np.diff(t[::step])


def robust_std(r: Array) -> float:
    """Return the standard deviation about zero of what is normal in `r`, from its median size; NaN left out."""
    size = np.abs(r[np.isfinite(r)])
    return 1.4826 * float(np.median(size)) if size.size else 0.0


def winsorised(r: Array) -> Array:
    """Return `r` with zero for what is missing, outliers cut."""
    limit = CLIP * robust_std(r)
    return np.clip(np.nan_to_num(r), -limit, limit) if limit > 0 else np.nan_to_num(r)


def despiked(r: Array) -> Array:
    """Return `r` (N,) without NaN, lone outliers replaced by the middle of three; a few in a row are the model's."""
    r = r[np.isfinite(r)]
    if len(r) < 3:
        return r
    before, after = np.concatenate([r[1:2], r[:-1]]), np.concatenate([r[1:], r[-2:-1]])
    middle = np.maximum(np.minimum(before, r), np.minimum(np.maximum(before, r), after))
    return np.where(np.abs(r - middle) > CLIP * robust_std(r), middle, r)


def quantum(y: ArrayLike) -> float:
    """Return the step in which a channel moves (encoder count, converter bit), or 0.0 if it shows none. Second
    differences of a smooth signal in steps are small whole multiples of one, even if it passes many per sample."""
    whole = np.asarray(y, dtype=float)
    values = whole[np.isfinite(whole)]
    jumps = np.abs(np.diff(whole, 2))  # of neighbours: across a gap a steady motion is one large step
    jumps = jumps[np.isfinite(jumps)]
    jumps = jumps if len(jumps) >= 20 else np.abs(np.diff(values, 2))
    jumps = jumps[jumps > 1e-9 * np.abs(values).max(initial=0.0)]
    if len(jumps) < 20:
        return 0.0
    rounded = 3e-4 * float(np.quantile(np.abs(values), 0.9))  # in a file of four digits
    guesses = np.unique(np.sort(jumps)[np.rint(np.arange(0.02, 0.98, 0.04) * (len(jumps) - 1)).astype(int)])[::-1]
    for guess in guesses[_plausible(jumps, guesses)]:
        step = float(np.median(jumps[np.abs(jumps / guess - 1) < 0.2]))  # rounding in the file blurs it
        steps = jumps / step
        if np.mean((np.abs(steps - steps.round()) < 0.1) & ((steps > 0.5) | (jumps < rounded))) > 0.95:
            return step  # beside a few glitches, too, all else is far less than one, and yet no rounding
    return 0.0


def unrounded(t: Array) -> tuple[Array, float]:
    """Return stamps (N,) of even samples, some left out, as they were before they were rounded, and to how much that
    was; stamps that wander by more than rounding does, or are as good as even, as they are, and 0.0."""
    steps = np.diff(t)
    usual = float(np.median(steps)) if len(steps) else 0.0
    apart = np.diff(np.unique(steps))
    step = float(apart[apart > COARSE * usual].min(initial=np.inf))
    if not step < usual or (np.abs(steps / step - np.rint(steps / step)) > COARSE).any():
        return t, 0.0
    number = np.concatenate([[0.0], np.cumsum(np.rint(steps / steps[steps < 1.5 * usual].mean()))])
    even = np.polynomial.Polynomial.fit(number, t, 1)(number)
    return (even, step) if COARSE < np.ptp(t - even) / step < 1.1 else (t, 0.0)  # a line through few is not exact


def left_out(t: Array) -> NDArray[np.intp]:
    """Return how many samples, if a few, were left out after each but the last, (N-1,)."""
    dt = np.diff(t)
    steps = dt / (np.median(dt) if len(dt) else 1.0)
    few = (steps > 1.5) & (steps < MOST_LEFT_OUT + 1.5) & (np.abs(steps - steps.round()) < 0.1)
    return np.where(few, steps.round() - 1, 0).astype(np.intp)


def going_on(t: Array, u: Array) -> Array:
    """Return which share of its change from one sample to the next what is held between samples, `u` (N, ...), does by
    the way, (N-1, ...): where a few were left out of what changes with every sample, about as much across as beside."""
    more = left_out(t).reshape(-1, *[1] * (u.ndim - 1))
    rates = np.pad(np.abs(np.diff(u, axis=0)) / (1 + more), [(1, 1), *[(0, 0)] * (u.ndim - 1)])
    before, across, after = rates[:-2], rates[1:-1], rates[2:]
    alike = (np.minimum(before, after) > 0) & (across <= 2 * np.maximum(before, after))
    return np.where(alike, more / (1 + more), 0.0)


def repeats(y: Array) -> NDArray[np.bool_]:
    """Tell which samples of `y` (N,) only repeat the one before: the sensor is read more often than it measures.

    None of a channel that changes irregularly, moves in steps, or rests: that is as it was measured. Where all of its
    changes, steps or not, are a multiple of so many samples apart, it was measured then, and no chance would do that.
    """
    changes = np.flatnonzero(np.diff(y, prepend=np.nan) != 0)
    lengths = np.diff(changes, append=len(y))
    if len(lengths) > FEWEST_FRESH + 2 and (apart := np.gcd.reduce(lengths[1:-1])) > 1:
        return np.isfinite(y) & ((np.arange(len(y)) - changes[1]) % apart != 0)
    every = float(np.median(lengths)) if len(lengths) else 0.0
    even = np.abs(lengths - every) <= every / 4
    if len(lengths) < FEWEST_FRESH or every < 2 or np.mean(even) < _MOSTLY or quantum(y) > 0:
        return np.zeros(len(y), bool)
    again = np.isfinite(y) & np.repeat(lengths < 2 * every, lengths)
    again[changes] = False
    return again


def fresh_means(t: Array, y: Array, v: Array) -> Array:
    """Return `y` (N,) with the mean of every P samples at the first of them, the others missing, where it changes at
    every P-th alone and all between is noise: a value that is renewed so rarely, behind a converter; else `y`. Jumps
    with the voltage `v` do not count: what follows that at once is no sensor's."""
    if len(t) < MOST_HELD * FEWEST_FRESH or not t[-1] - t[0] < 2 * len(t) * (dt := float(np.median(np.diff(t)))):
        return y
    place = np.rint((t - t[0]) / dt).astype(int)
    whole, jumped = np.full(place[-1] + 1, np.nan), np.abs(np.diff(v, prepend=v[0])) > 0.02 * np.ptp(v)
    whole[place] = y
    squares = np.diff(whole) ** 2
    squares[np.clip(np.add.outer(place[jumped], (-1, 0)), 0, len(squares) - 1)] = np.nan
    for every in range(MOST_HELD, 2, -1):  # a divisor of the true number would do as well
        change = _means(squares[: len(squares) // every * every].reshape(-1, every).T)
        at = int(change.argmax())
        if 0 < HELD * (between := float(np.delete(change, at).max())) < change[at]:
            held = whole[at + 1: at + 1 + (len(whole) - at - 1) // every * every].reshape(-1, every)
            if _means((held[:, -1:] - held[:, :1]).T ** 2)[0] < 1.5 * between:  # over a hold white noise has no more
                fresh = np.full(len(whole), np.nan)
                fresh[at + 1: at + 1 + held.size: every] = _means(held)
                return fresh[place]
    return y


def _means(y: Array) -> Array:
    """Return the mean of each row of `y` without NaN, NaN where there is nothing else."""
    good = np.isfinite(y)
    return np.where(good, y, 0.0).sum(axis=1) / np.where(good.any(axis=1), good.sum(axis=1), np.nan)


def _plausible(jumps: Array, guesses: Array) -> NDArray[np.bool_]:
    """Tell by a few of the jumps which guesses of a step may be right: most of these are then whole multiples."""
    few = jumps[:: max(len(jumps) // _FEW, 1)] / guesses[:, None]
    near = np.abs(few - 1) < 0.2
    few /= np.where(near.any(axis=1), (few * near).sum(axis=1) / np.maximum(near.sum(axis=1), 1), 1.0)[:, None]
    return (np.mean(np.abs(few - few.round()) < 0.1, axis=1) > _MOSTLY) | ~near.any(axis=1)


def noise_level(y: ArrayLike, t: ArrayLike | None = None) -> float:
    """Return the standard deviation of the measurement noise of samples `y` (N,), NaN where missing, at times `t` in s,
    evenly spaced without them. It is always positive: 1.0 for a channel that is zero throughout.

    High-order differences remove the signal, smooth over a few samples, and keep the noise; a mean of the smaller half
    ignores outliers and the samples after a voltage step. Uneven samples are weighed as in divided differences. The
    order starts at two and grows as long as that removes more signal. Parts in which nothing changes are left out, and
    so is what a sensor that measures every few samples repeats. The result is never below what rounding alone does
    (step/√12, where the channel moves in steps), nor 1e-5 of the channel's variation. Smooth noise is underestimated
    (four times, with a correlation of 0.9 between neighbours), two or three samples per time constant overestimated.
    Gasser, Sroka and Jennen-Steinmetz, Biometrika 73(3), 1986; Hall, Kay and Titterington, Biometrika 77(3), 1990."""
    values = np.asarray(y, dtype=float)
    times = np.arange(values.size, dtype=float) if t is None else np.asarray(t, dtype=float)
    keep, step = np.isfinite(values) & np.isfinite(times), quantum(values)
    values, times = values[keep], times[keep]
    fresh = np.diff(values, prepend=np.nan) != 0
    measured = np.count_nonzero(fresh)
    if step == 0 and FEWEST_FRESH <= measured < 0.5 * fresh.size and np.unique(values).size > 0.5 * measured:
        values, times = values[fresh], times[fresh]  # hardly one comes twice: no levels of a coarse counter
    size = float(np.std(values) or np.abs(values).max()) if values.size else 0.0
    level, gaps, still = np.inf, np.diff(times), np.diff(values) == 0
    even = gaps.size > 0 and np.ptp(gaps) < _EVEN * gaps.mean()
    for order in ORDERS:
        finer = _of_order(values, None if even else times, still, order, step)
        if finer > 0.85 * level:  # no more signal was removed: what is left is noise
            break
        level = finer
    level = level if np.isfinite(level) else 0.0
    return float(max(level, step / np.sqrt(12), _FLOOR * size if size > 0 else 1.0))


def _of_order(values: Array, times: Array | None, still: NDArray[np.bool_], order: int, step: float) -> float:
    """Robust noise level from differences of one order; 0.0 if there are too few. No `times`: evenly spaced."""
    if len(values) < order + 4:
        return 0.0
    if times is None:
        whole, size = slice(None), np.abs(np.correlate(values - values[0], _EVENLY[order], "valid"))
    else:
        t, y = sliding_window_view(times, order + 1), sliding_window_view(values, order + 1)
        span = t[:, -1] - t[:, 0]
        whole = span < 2.5 * np.median(span)  # not across a gap
        size = np.abs(np.sum(_weights(t[whole]) * (y - y[:, :1])[whole], axis=1))
    if not still.any():
        return _typical(size)
    # At rest, where nothing changes at all, lie the windows of order + 1 samples within a standstill.
    stretch = np.r_[0, np.cumsum(~still)]
    first, last = stretch[:-order], stretch[order:]
    live = ((first != last) | (np.bincount(stretch)[first] < _REST))[whole]
    same = sliding_window_view(still, order)[whole]
    return 0.0 if not live.any() else _typical(size if step and same[live].mean() > _DITHERED else size[live])


def _weights(t: Array) -> Array:
    """Return the weights of divided differences, of length one, for windows of times (N, order + 1)."""
    u = (t - t[:, :1]) / (t[:, -1] - t[:, 0])[:, None]
    weights = 1.0 / np.prod(u[:, :, None] - u[:, None, :] + np.eye(t.shape[1]), axis=2)
    return weights / np.linalg.norm(weights, axis=1, keepdims=True)


_EVENLY = {order: _weights(np.arange(order + 1.0)[None])[0] for order in ORDERS}


def _typical(size: Array) -> float:
    # The mean of the smaller half is as robust as the median and smoother where values come in steps.
    half = (len(size) + 1) // 2
    return float(np.partition(size, half - 1)[:half].mean()) / _SMALLER_HALF


def gather(found: Sequence[tuple[Array, NDArray[np.bool_]]]) -> bool:
    """Tell whether samples (N,) of runs stand at other angles of a turn, (N,), than all of these do: Rayleigh's test of
    orders 1 to 12, n·R² above 12. By chance it is so in one record of ten thousand."""
    if not any(chosen.any() for _, chosen in found):
        return False
    waves = [np.exp(1j * np.outer(angle, np.arange(1, 13))) for angle, _ in found]
    some = np.concatenate([w[chosen] for w, (_, chosen) in zip(waves, found, strict=True)])
    return bool(len(some) * np.max(np.abs(some.mean(axis=0) - np.concatenate(waves).mean(axis=0)) ** 2) > 12)
