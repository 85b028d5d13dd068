"""The plant: motor plus hidden effects, integrated by RK4 with fine steps and true stick-slip.

Dry friction is discontinuous. Its direction s is frozen during a step; when the speed changes sign the step
is cut at that instant, the speed is set to exactly zero, and the shaft either sticks (net torque within the
breakaway level) or slides on. A stuck shaft stays at exactly zero speed until the net torque exceeds it.
"""

from __future__ import annotations

from collections.abc import Callable
from math import ceil, copysign, exp, inf

import numpy as np

from .effects import build
from .motors import Motor
from .sensors import Chain

Effects = dict[str, dict[str, float]]
FREE = 2  # no dry friction: there is no direction to keep track of


class Plant:
    """One motor on the bench.

    Parameters
    ----------
    motor : Motor
    effects : dict of name -> dict of numbers, see `effects.py`
    omega0, theta0 : initial speed in rad/s and angle in rad
    substep : integration step in s; default the lesser of 50 µs and a quarter of the fastest time constant

    Attributes
    ----------
    t, i, omega, theta, dT : the true state; `measured()` gives what the sensors say
    stuck : whether dry friction holds the shaft
    """

    def __init__(
        self,
        motor: Motor,
        effects: Effects | None = None,
        omega0: float = 0.0,
        theta0: float = 0.0,
        substep: float | None = None,
    ) -> None:
        self.motor = motor
        self.effects = dict(effects or {})
        hooks = build(motor, self.effects)
        fastest = max([motor.R / motor.L, *(h["rate"] for h in hooks if "rate" in h)])
        self.substep = substep or min(50e-6, 0.25 / fastest)
        self.t = 0.0
        self._rates, self._level, x0 = _physics(motor, hooks, omega0, theta0)
        self._y = [0.0, float(omega0), float(theta0), 0.0, *x0]  # i, omega, theta, dT, and states of parts
        self._s = (0 if omega0 == 0 else 1 if omega0 > 0 else -1) if self._level else FREE
        self._sensors, self._sensed = Chain(hooks, omega0), _sensed(hooks)
        self._v, self._coasts = 0.0, any("diodes" in h for h in hooks)
        self._one_way = next((h["diodes"] for h in hooks if "one way" in h), 0.0)
        self._limit = min((h["limit"] for h in hooks if "limit" in h), default=inf)
        self._lag = sum(h["lag"] for h in hooks if "lag" in h)
        self._slew = min((h["slew"] for h in hooks if "slew" in h), default=inf)
        self._driven = motor.K * omega0  # what the driver makes of the command: at first what holds the motor

    i = property(lambda self: self._y[0])
    omega = property(lambda self: self._y[1])
    theta = property(lambda self: self._y[2])
    dT = property(lambda self: self._y[3])
    stuck = property(lambda self: self._s == 0)

    def step(self, v: float, dt: float, v_end: float | None = None) -> dict[str, float]:
        """Advance by dt seconds with v volts held (or going straight to v_end); return `measured()`."""
        n = max(1, ceil(dt / self.substep - 1e-6))
        h = dt / n
        slope = 0.0 if v_end is None else (v_end - v) / n
        t0 = self.t
        self._v = v + n * slope
        for k in range(n):
            i, a, b = self._y[0], v + k * slope, v + (k + 1) * slope
            a, b = self._behind(a, b, h) if self._lag or self._slew < inf else (a, b)
            if self._one_way:
                self._carry(a)
            before, moved = self._y, self._s
            self._advance(a, b, h)
            if self._one_way and i * self._y[0] < 0:  # to where the current ends, and on from there
                low, part, high = 0.0, 0.5, 1.0
                for _ in range(40):
                    self._y, self._s, part = before, moved, 0.5 * (low + high)
                    self._advance(a, a + part * (b - a), part * h)
                    low, high = (part, high) if i * self._y[0] > 0 else (low, part)
                self._y[0] = 0.0
                self._carry(b)
                self._advance(a + part * (b - a), b, (1 - part) * h)
            if self._coasts and v == 0 == slope and i * self._y[0] <= 0:
                self._y[0] = 0.0  # the diodes let no current turn round
            if abs(i) <= self._limit < abs(self._y[0]):
                self._y[0] = copysign(self._limit, i)  # it is reached within the step
            self.t = t0 + (k + 1) * h
            self._sensors.sample(self.t, h, self._y[0], self._y[self._sensed])
        return self.measured()

    def _carry(self, v: float) -> None:
        """Say what is across a winding whose current flows along the command v alone."""
        i, w = self._y[:2]
        if i:
            self._rates.carried[0] = None if i * v > 0 else -copysign(self._one_way, i)
        else:
            self._rates.carried[0] = None if (v - self.motor.K * w) * v > 0 else 0.0

    def _behind(self, v0: float, v1: float, h: float) -> tuple[float, float]:
        """Voltage of the driver at both ends of a step of h seconds, exact for a command that goes straight."""
        before, after, most = self._driven, v1, self._slew * h
        if self._lag:
            late = (v1 - v0) / h * self._lag  # a ramp is followed that much behind
            after = v1 - late + (before - v0 + late) * exp(-h / self._lag)
        self._driven = before + max(-most, min(most, after - before))
        return before, self._driven

    def measured(self, v: float | None = None) -> dict[str, float]:
        """Current, speed and angle as the sensors give them (no noise; see `sensors.py` for that).

        With v volts commanded meanwhile, which a sensor before the bridge sees; by default the latest.
        """
        return self._sensors.read(self.t, self._y[self._sensed + 1], self._v if v is None else v)

    def _advance(self, v0: float, v1: float, h: float) -> None:
        if self._s == FREE:
            self._y = _rk4(self._rates, self._y, v0, v1, h, FREE, self.t)
            return
        left = h
        for _ in range(8):  # more events than that in one step is chatter: the shaft is as good as stuck
            a, b = v1 - (v1 - v0) * left / h, v1
            if self._s == 0:
                self._release(a)
            y = _rk4(self._rates, self._y, a, b, left, self._s, self.t)
            if self._s == 0 or y[1] * self._s >= 0:
                self._y = y
                return
            left -= self._reverse(a, b, left)
            if left <= 1e-12:
                return
        self._s = 0
        self._y = _rk4(self._rates, self._y, v1, v1, left, 0, self.t)

    def _reverse(self, v0: float, v1: float, h: float) -> float:
        """Go to the instant within h at which the speed is zero and stop there; return the time it took."""
        low, high, w_low, w_high = 0.0, h, self._y[1], None
        y, at = self._y, 0.0
        for _ in range(60):
            at = 0.5 * (low + high) if w_high is None else low + (high - low) * w_low / (w_low - w_high)
            y = _rk4(self._rates, self._y, v0, v0 + (v1 - v0) * at / h, at, self._s, self.t)
            if abs(y[1]) < 1e-12 * self.motor.no_load_speed or high - low < 1e-13:
                break
            if y[1] * self._s > 0:
                low, w_low = at, y[1]
            else:
                high, w_high = at, y[1]
        y[1] = 0.0
        self._y, self._s = y, 0
        return at

    def _release(self, v: float) -> None:
        """Let the stuck shaft go if the net torque exceeds the breakaway level."""
        y = self._y
        net = self._rates(y, v, FREE, self.t)[1] * self.motor.J
        s = 1 if net > 0 else -1
        if abs(net) > self._level(y[0], 0.0, y[2], s, self.t):
            self._s = s


def _rk4(f: Callable, y: list[float], v0: float, v1: float, h: float, s: int, t: float) -> list[float]:
    half, mid, sixth = 0.5 * h, 0.5 * (v0 + v1), h / 6
    k = f(y, v0, s, t)
    if len(y) == 4:  # by far the most, and twice as fast
        a, b, c, d = y
        q = f([a + half * k[0], b + half * k[1], c + half * k[2], d + half * k[3]], mid, s, t)
        r = f([a + half * q[0], b + half * q[1], c + half * q[2], d + half * q[3]], mid, s, t)
        u = f([a + h * r[0], b + h * r[1], c + h * r[2], d + h * r[3]], v1, s, t)
        return [a + sixth * (k[0] + 2 * (q[0] + r[0]) + u[0]), b + sixth * (k[1] + 2 * (q[1] + r[1]) + u[1]),
                c + sixth * (k[2] + 2 * (q[2] + r[2]) + u[2]), d + sixth * (k[3] + 2 * (q[3] + r[3]) + u[3])]
    q = f(_moved(y, half, k), mid, s, t)
    r = f(_moved(y, half, q), mid, s, t)
    u = f(_moved(y, h, r), v1, s, t)
    return [a + sixth * (p + 2 * (b + c) + d) for a, p, b, c, d in zip(y, k, q, r, u)]  # noqa: B905  (fast)


def _sensed(hooks: list[dict]) -> int:
    """Which state is the speed that sensors see; their angle is the next."""
    first = 4
    for h in hooks:
        if "sensed" in h:
            return first
        first += len(h["x0"](0.0, 0.0)) if "part" in h else 0
    return 1


def _moved(y: list[float], h: float, k: list[float]) -> list[float]:
    return [a + h * r for a, r in zip(y, k, strict=True)]


def _physics(m: Motor, hooks: list[dict], omega0: float, theta0: float) -> tuple:
    """The rates of (i, omega, theta, dT, parts), the level of dry friction or None, the parts' start."""

    def every(kind: str) -> list:
        return [h[kind] for h in hooks if kind in h]

    drives, drops, torques, dries, heats = (every(k) for k in ("drive", "drop", "torque", "dry", "heat"))
    f_R, f_L, f_K, f_Kt, f_Ke, bridges = (every(k) for k in ("R", "L", "K", "Kt", "Ke", "bridge"))
    diodes, limit = every("diodes"), min(every("limit"), default=None)
    one_way, carried = bool(every("one way")), [None]  # the voltage while the command does not act, 0.0: no current
    parts, fluxes, x0 = [], [], []
    for h in hooks:
        if "part" in h:
            start = h["x0"](omega0, theta0)
            first = 4 + len(x0)
            parts.append((h["part"], first, first + len(start)))
            fluxes += [(h["flux"], first, first + len(start))] if "flux" in h else []
            x0.extend(start)
    R0, L0, K0, b, J = m.R, m.L, m.K, m.b, m.J
    shaped, changed = drives or bridges or drops, f_L or f_K or fluxes or f_Kt or f_Ke  # empty loops take time
    plain = not (shaped or changed or f_R or diodes)

    def every_level(i: float, w: float, th: float, s: int, t: float) -> float:
        return sum([f(i, w, th, s, t) for f in dries])

    level = dries[0] if len(dries) == 1 else every_level

    def circuit(y: list[float], v: float) -> tuple[float, ...]:
        """Voltage across the winding and what the effects make of R, L, K, Kt, Ke."""
        i, w, th, dT = y[0], y[1], y[2], y[3]
        R, L, K, Kt, Ke = R0, L0, K0, 1.0, 1.0
        opened = diodes and v == 0 and not one_way
        if shaped:
            for f in drives:
                v = f(v, w)
            for f in bridges:
                v = f(v, i)
            for f in drops:
                v -= f(i)
        for f in f_R:
            R *= f(dT)
        if changed:
            for f in f_L:
                L *= f(i)
            for f in f_K:
                K *= f(i)
            for f, a, z in fluxes:
                K *= f(y[a:z])
            for f in f_Kt:
                Kt *= f(th)
            for f in f_Ke:
                Ke *= f(th)
        if opened:
            v = -diodes[0] if i > 0 else diodes[0] if i < 0 else K * Ke * w  # no current, no voltage across the winding
        if one_way and carried[0] is not None:
            v = carried[0] if carried[0] else K * Ke * w
        return v, R, L, K, Kt, Ke

    def rates(y: list[float], v: float, s: int, t: float) -> list[float]:
        i, w, th, dT = y[0], y[1], y[2], y[3]
        v, R, L, K, Kt, Ke = (v, R0, L0, K0, 1.0, 1.0) if plain else circuit(y, v)
        torque = K * Kt * i - b * w
        for f in torques:
            torque += f(i, w, th, t)
        out = [(v - R * i - K * Ke * w) / L, 0.0, w, 0.0]
        if limit is not None and abs(i) >= limit and out[0] * i > 0:
            out[0] = 0.0
        for f in heats:
            out[3] += f(i, dT)
        for f, a, z in parts:
            extra, more = f(i, w, th, y[a:z])
            torque += extra
            out += more
        if s:
            out[1] = (torque if s == FREE else torque - s * level(i, w, th, s, t)) / J
        return out

    rates.carried = carried
    return rates, level if dries else None, x0


def simulate(
    motor: Motor,
    effects: Effects | None,
    t: np.ndarray,
    v: np.ndarray,
    hold: str = "zoh",
    omega0: float = 0.0,
    theta0: float = 0.0,
    substep: float | None = 20e-6,
) -> dict[str, np.ndarray]:
    """Run the plant over the samples t (N,) with the voltage v (N,), held ("zoh") or ramped ("linear").

    Returns arrays (N,): t, v; the **sensed** i, omega, theta; the truth behind them true_i, true_omega,
    true_theta and dT. The step is the lesser of `substep` and the plant's own choice.
    """
    t, v = np.asarray(t, float), np.asarray(v, float)
    if t.shape != v.shape or t.ndim != 1 or np.any(np.diff(t) <= 0):
        raise ValueError(f"t must increase and v be as long: t {t.shape}, v {v.shape}")
    if hold not in ("zoh", "linear"):
        raise ValueError(f"hold is 'zoh' or 'linear', not {hold!r}")
    plant = Plant(motor, effects, omega0, theta0)
    plant.substep = min(plant.substep, substep) if substep else plant.substep
    rows = [_row(plant, float(v[0]))]
    for k in range(len(t) - 1):
        plant.step(float(v[k]), float(t[k + 1] - t[k]), float(v[k + 1]) if hold == "linear" else None)
        rows.append(_row(plant, float(v[k + 1])))
    names = ("i", "omega", "theta", "true_i", "true_omega", "true_theta", "dT")
    columns = np.array(rows).T
    return {"t": t, "v": v} | dict(zip(names, columns, strict=True))


def _row(plant: Plant, v: float) -> tuple[float, ...]:
    return (*plant.measured(v).values(), plant.i, plant.omega, plant.theta, plant.dT)
