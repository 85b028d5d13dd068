"""From a case as it is written down to its records: plant, sensors, floor; and how far a plain motor is from them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.linalg import expm
from scipy.optimize import least_squares
from scipy.signal import lfilter

from battery.blind.plant import LINEAR, measure, motor, run, seed

CHANNELS = {"i": "i", "w": "omega", "t": "theta"}
# Effects of the speed sensor that an encoder's counts would have to go through.
OF_SPEED = {"speed_lag", "speed_delay", "speed_gain", "speed_offset", "x_eccentric", "x_tacho_curve", "x_tacho_dead"}


@dataclass(frozen=True)
class Case:
    """A case as written down before any run.

    `truth`: effects that act (in words, if the library has none). `alternatives`: per effect, others that these records
    cannot distinguish from it. `acceptable`: what may be named besides. `whole`: sets that are right as a whole.
    `fixed`: parameters that are known and given to the model.
    """

    name: str
    kind: str
    motor: str
    effects: dict[str, Any]
    train: tuple[str, ...]
    check: tuple[str, ...]
    channels: tuple[str, ...]
    truth: tuple[str, ...]
    acceptable: frozenset[str]
    alternatives: dict[str, frozenset[str]]
    whole: tuple[frozenset[str], ...]
    fixed: tuple[str, ...] = ()
    options: dict[str, Any] = field(default_factory=dict)
    plant: Any = None  # a module with a `build` of its own


class Battery(dict[str, Case]):
    """Cases by name; one method per kind adds one. `plant`: a module that builds them instead of this one."""

    def __init__(self, plant: Any = None):
        super().__init__()
        self.plant = plant

    def single(self, name, mot, eff, train, check, **more):
        """One effect of the library acts."""
        self._add("s_" + name, "single", mot, eff, train, check, **more)

    def pair(self, name, mot, eff, train, check, **more):
        """Two effects act."""
        assert len(eff) == 2
        self._add("p_" + name, "pair", mot, eff, train, check, **more)

    def none(self, name, mot, train, check, **more):
        """Nothing acts: noise, quantisation, feedback and the like."""
        self._add("n_" + name, "none", mot, {}, train, check, **more)

    def outside(self, name, mot, eff, train, check, words, now=None, **more):
        """Something acts; `now`: the effect that the library has gained for it since this was written down."""
        kind, truth = ("single", [now]) if now else ("outside", [words])
        self._add("x_" + name, kind, mot, eff, train, check, truth=truth, **more)

    def _add(self, name, kind, mot, eff, train, check, ch="iw", acc=(), alts=None, whole=(), fixed=(), truth=None,
             angle=False, **options):
        assert name not in self, name
        truth = tuple(truth or eff)
        alternatives = {k: frozenset(v) for k, v in (alts or {}).items()}
        if kind == "single":
            alternatives[truth[0]] = alternatives.get(truth[0], frozenset()) | frozenset(acc)
        acceptable = frozenset(acc).union(*alternatives.values())
        self[name] = Case(name, kind, mot, eff, tuple(train.split()), tuple(check.split()),
                          tuple(CHANNELS[c] for c in ch), truth, acceptable, alternatives,
                          tuple(frozenset(x) for x in whole), tuple(fixed), options, self.plant)


def build(case: Case, halve: int = 1) -> dict[str, Any]:
    """Return the records of `case`: train, check, noise and floor per channel. `halve` divides the plant's step."""
    if case.plant:
        return case.plant.build(case, halve)
    rng = np.random.default_rng(seed(case.name))
    m = motor(case.motor, rng)
    o = dict(case.options)
    m["h"] = o.get("h_", m["h"])
    m["b"] *= o.get("b_mul", 1.0)
    o.setdefault("dt", m["dt"])
    o.setdefault("T", m["T"])
    turn = 1.0 if case.motor in LINEAR else 2 * np.pi
    raw = []
    for j, kind in enumerate(case.train + case.check):
        length = o["T"] * (1.0, 0.75, 1.2, 1.0)[(seed(case.name) + j) % 4]  # runs of different length
        raw.append(run(m, case.effects, kind, np.random.default_rng([seed(case.name), j]), dict(o, T=length), halve))
    n = len(case.train)
    scale = {c: float(np.std(np.concatenate([r[2][c] for r in raw[:n]]))) for c in raw[0][2]}
    runs, noise = [], {c: [] for c in case.channels}
    square = {c: [0.0, 0.0] for c in case.channels}
    for j, (t, v, y, states, more) in enumerate(raw):
        o["_enc"] = float(rng.random())
        y = {c: y[c] for c in case.channels}
        seen = dict(y)
        seen["_w_int"] = states["th"]
        if OF_SPEED & set(case.effects):
            w = y.get("omega", states["w"])
            seen["_w_int"] = np.concatenate([[0], np.cumsum(0.5 * (w[1:] + w[:-1]) * np.diff(t))])
        noisy = np.random.default_rng([seed(case.name), 100 + j])
        measured = measure(noisy, o, scale, t, seen, turn)
        measured = {c: measured[c] for c in case.channels}
        for c in case.channels:
            e = measured[c] - y[c]
            ok = np.isfinite(e)
            if j < n:
                noise[c].append(e[ok])
            else:
                square[c][0] += float(np.sum(e[ok] ** 2))
                square[c][1] += float(np.sum((measured[c][ok] - np.mean(measured[c][ok])) ** 2))
        unit = {"omega": "m/s", "theta": "m"} if case.motor in LINEAR else {}
        kind = (case.train + case.check)[j].replace(":", "_")
        runs.append({"name": f"{'run' if j < n else 'check'}{j}_{kind}", "t": t, "outputs": measured, "true": y,
                     "inputs": {"v": v, **_logged(o.get("log", ()), more, noisy, t, m)}, "hold": o.get("hold", "zoh"),
                     "units": {k: u for k, u in unit.items() if k in case.channels},
                     "start": (states["i"][0], states["w"][0], y["theta"][0] if "theta" in y else 0.0)})
    return {"motor": m, "train": runs[:n], "check": runs[n:],
            "floor": {c: float(np.sqrt(a / b)) for c, (a, b) in square.items()},
            "noise": {c: max(float(np.sqrt(np.mean(np.concatenate(noise[c]) ** 2))), 1e-9) for c in case.channels}}


def _logged(kinds, more, rng, t, m):
    """Return further columns of the log: a supply that acts, or a supply, a load cell, a thermometer that do not."""
    out = {}
    for kind in kinds.split() if kinds else ():
        slow = np.interp(t, np.linspace(0, t[-1], 9), rng.normal(size=9))
        if kind == "supply":
            level = more.get("v_supply", m["V"] * (1.1 + 0.02 * slow))  # without a bus: measured, and of no influence
            out["v_supply"] = level + rng.normal(size=len(t)) * 0.003 * m["V"]
        if kind == "load":
            out["tau_load"] = 0.01 * m["ts"] * (rng.normal(size=len(t)) + slow)
        if kind == "temp":
            out["temp"] = 24 + 2 * slow + 0.1 * rng.normal(size=len(t))
    return out


# How far a plain motor is from the records, to judge the sizes of the effects; by matrix exponentials.
def plain_sim(p, torque, t, v, x0, hold):
    """Return i, omega, theta (N, 3) of the plain motor with parameters `p`."""
    if torque:
        A = np.array([[-p["b"] / p["J"], 0.0], [1.0, 0.0]])
        B = np.array([p["K"] / p["J"], 0.0])
    else:
        A = np.array([[-p["R"] / p["L"], -p["K"] / p["L"], 0.0], [p["K"] / p["J"], -p["b"] / p["J"], 0.0], [0, 1.0, 0]])
        B = np.array([1 / p["L"], 0.0, 0.0])
    n = len(B)
    d = np.diff(t)
    M = np.zeros((n + 2, n + 2))
    M[:n, :n], M[:n, n], M[n, n + 1] = A, B, 1.0
    if np.ptp(d) < 1e-6 * d[0]:  # even steps: modes as first-order filters
        E = expm(M * d[0])
        lam, V = np.linalg.eig(A)
        Vi = np.linalg.inv(V)
        G, H, z0 = Vi @ E[:n, n], Vi @ (E[:n, n + 1] / d[0]), Vi @ np.array(x0[-n:], float)
        Z = []
        for j in range(n):
            f = G[j] * v[:-1] + (H[j] * np.diff(v) if hold == "linear" else 0.0)
            Z.append(lfilter([1.0 + 0j], [1.0, -np.exp(lam[j] * d[0])], np.concatenate([[z0[j]], f])))
        X = np.real(np.array(Z).T @ V.T)
    else:
        X = np.empty((len(t), n))
        X[0] = x0[-n:]
        known = {k: expm(M * k) for k in set(np.round(d, 9))}
        for k, step in enumerate(np.round(d, 9)):
            E = known[step]
            X[k + 1] = E[:n, :n] @ X[k] + E[:n, n] * v[k]
            if hold == "linear":
                X[k + 1] += E[:n, n + 1] / d[k] * (v[k + 1] - v[k])
    return np.column_stack([v, X]) if torque else X


def plain_excess(case: Case, built: dict[str, Any]) -> dict[str, float]:
    """Return, per channel, the error of the fitted plain motor over the noise on the training runs (1: it suffices)."""
    m = built["motor"]
    torque = m["torque"]
    names = [n for n in (("K", "b") if torque else ("R", "L", "K", "b", "J")) if n not in case.fixed]
    where = {"i": 0, "omega": 1, "theta": 2}
    noise = {}
    for c in case.channels:  # an encoder is finer than any model: an angle is judged at 0.5 % of its spread at best
        spread = np.std(np.concatenate([q["true"][c] for q in built["train"]]))
        noise[c] = max(built["noise"][c], 0.005 * spread if c == "theta" else 0.0)

    def residuals(logs):
        p = {k: m[k] for k in ("R", "L", "K", "b", "J")} | {k: math.exp(a) for k, a in zip(names, logs, strict=True)}
        out = []
        for q in built["train"]:
            X = plain_sim(p, torque, q["t"], q["inputs"]["v"], q["start"], q["hold"])
            for c in case.channels:
                e = (X[:, where[c]] - q["outputs"][c]) / noise[c]
                out.append(np.where(np.isfinite(e), e, 0.0))
        return out

    p0 = np.array([math.log(m[k]) for k in names])
    s = least_squares(lambda x: np.clip(np.concatenate(residuals(x)), -1e6, 1e6), p0, x_scale=0.2, max_nfev=25,
                      bounds=(p0 - 4, p0 + 4))
    r = residuals(s.x)
    n = len(case.channels)
    return {c: float(np.sqrt(np.mean(np.concatenate(r[j::n]) ** 2))) for j, c in enumerate(case.channels)}
