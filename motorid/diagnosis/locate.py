"""Where does the model fail? The missing voltage and torque over time, by balance, by region, by quantity."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from motorid.channels import UNITS
from motorid.diagnosis.free_forms import WHERE, Form
from motorid.diagnosis.results import Binned, Missing
from motorid.estimation.linearisation import linear_steps, parameter_vector, shown
from motorid.estimation.result import Fit
from motorid.numerics.autoregression import effective_samples
from motorid.numerics.parallel import one_thread
from motorid.numerics.signals import Array, bridged, integral
from motorid.problem.runs import angle_signal, natural_sizes

WALKS = (0.03, 0.1, 0.3, 1.0, 3.0)  # of the natural size per √s, the smallest that explains the data is taken
BINS = 24
WORDS = {"i": "the current", "omega": "the speed", "theta": "the angle within a turn", "t": "the time",
         "heat": "the heat dissipated so far"}
REGIONS = ("standstill", "reversal", "acceleration", "high current", "steady")


@one_thread
def locate(fit: Fit) -> Missing:
    """Estimate the unknown voltage and torque that would make the model match, and say where they act.

    Returns
    -------
    Missing
        Per run the missing voltage (V) and torque (N·m, N for a linear axis), their dependence on i, omega,
        theta, heat and t with 95 % bands, the share of the misfit by balance and by region.

    Examples
    --------
    >>> missing = mi.locate(fit)
    >>> missing.where
    'mechanical'
    """
    natural = natural_sizes(fit.problem.experiments, fit.values)
    unit = "N" if fit.problem.model.axis == "linear" else "N·m"
    electrical = "i" in fit.problem.system.states
    apart = "i" in fit.problem.outputs and len(fit.problem.outputs) > 1  # else the torque stands for both
    size = np.array([natural["V"] if electrical and apart else 0.0, natural[unit]])
    begun = [begin(fit, k) for k in range(len(fit.problem.runs))]
    for share in WALKS:
        walk = share * size
        both = [smooth(fit, k, walk, at) for k, at in enumerate(begun)]
        if (left := float(np.mean([s.chi2 for s in both]))) <= 1.0:
            break
    if apart:  # what one unknown input alone leaves, the other has to explain
        alone = [[smooth(fit, k, walk * keep, at).chi2 for k, at in enumerate(begun)] for keep in np.eye(2)]
        missed = [max(float(np.mean(chi2)) - max(left, 1.0), 0.0) + 1e-3 for chi2 in alone]
        shares = {"electrical": missed[1] / sum(missed), "mechanical": missed[0] / sum(missed)}
        where = max(shares, key=lambda s: shares[s])
    else:
        shares = {"electrical": 0.5, "mechanical": 0.5} if electrical else {"mechanical": 1.0}
        where = None if electrical else "mechanical"
    signals = tuple(_signals(fit, k, s) for k, s in enumerate(both))
    voltage, torque = tuple(s.d[:, 0] for s in both), tuple(s.d[:, 1] for s in both)
    bins = {name: _against(d, signals)
            for name, d in (("voltage", voltage), ("torque", torque)) if any(x.any() for x in d)}
    regions = _regions(fit, signals)
    return Missing(where, tuple(r.experiment.t for r in fit.problem.runs), voltage, torque, signals, shares, regions,
                   bins, _text(where, shares, regions, bins), unit)


def acting_like(missing: Missing, form: Form) -> Missing:
    """Return `missing` with what is known of its form: which balance it acts in, and what it changes with."""
    apart = missing.where is not None or form.balance == "sensor"
    fails = {"both": "Both balances fail.", "sensor": "The measurement fails.", "voltage": "The voltage balance fails."}
    lead = fails.get(form.balance, "The torque balance fails.") if apart else missing.text.split(".")[0] + "."
    text = f"{lead} What is missing acts like {form.text}. {_region(missing.regions)}"
    return replace(missing, where=WHERE[form.balance] if apart else None, acts_like=form.text, text=text)


def _region(regions: Mapping[str, float]) -> str:
    first = max(regions, key=lambda r: regions[r])
    place = "steady motion" if first == "steady" else first
    return f"{100 * regions[first]:.0f} % of the squared error lies in {place}."


def _signals(fit: Fit, k: int, s: "Smoothed") -> Mapping[str, Array]:
    run, states = fit.problem.experiments[k], fit.problem.system.states
    told = ("i", "omega") if "i" in fit.problem.outputs else ("omega",)  # a current that was not measured tells nothing
    found = {"t": run.t - run.t[0], "v": run.inputs["v"], **{c: s.x[:, states.index(c)] for c in told if c in states}}
    if "theta" in run.outputs or "omega" in run.outputs:
        found["theta"] = angle_signal(run)
    if "i" in found:
        found["heat"] = integral(run.t, fit.values["R"] * found["i"] ** 2)
    return found


def _against(unknown: Sequence[Array], signals: Sequence[Mapping[str, Array]]) -> tuple[Binned, ...]:
    """Bin an unknown input over every quantity, the best explanation first."""
    d = np.concatenate(list(unknown))
    worth = sum(effective_samples(x - x.mean()) for x in unknown) / len(d)
    found = []
    for name in (n for n in ("omega", "i", "theta", "heat", "t") if all(n in s for s in signals)):
        z = np.concatenate([s[name] for s in signals])
        z = np.mod(z, 2 * np.pi) if name == "theta" else z
        if np.ptp(z) > 0:
            found.append(binned(name, z, d, worth))
    return tuple(sorted(found, key=lambda b: -b.explained))


def binned(name: str, z: Array, d: Array, worth: float = 1.0, bins: int = BINS) -> Binned:
    """Bin `d` (N,) over the quantity `name`, `z` (N,); each sample counts as `worth` independent ones."""
    # Half of the edges by count, half by distance: rest is one value, and rare speeds matter too.
    half = bins // 2 + 1
    edges = np.union1d(np.quantile(z, np.linspace(0, 1, half)), np.linspace(z.min(), z.max(), half))
    label = np.searchsorted(edges[1:-1], z, side="right")
    count = np.bincount(label, minlength=len(edges) - 1)
    keep = count >= 3
    n = np.maximum(count, 1)
    centre, mean, square = (np.bincount(label, w, len(edges) - 1) / n for w in (z, d, d**2))
    half = 1.96 * np.sqrt(np.maximum(square - mean**2, 0.0)) / np.sqrt(np.maximum(n * worth, 1.0))
    total = float(np.sum((d - d.mean()) ** 2))
    between = float(np.sum(count * (mean - d.mean()) ** 2))
    explained = max(between - keep.sum() * ((total - between) / max(len(d) - keep.sum(), 1)), 0.0) / max(total, 1e-300)
    return Binned(name, "J" if name == "heat" else UNITS[name][0], centre[keep], mean[keep], (mean - half)[keep],
                  (mean + half)[keep], count[keep].astype(float), float(min(explained, 1.0)))


def _regions(fit: Fit, signals: Sequence[Mapping[str, Array]]) -> dict[str, float]:
    """Share of the squared, whitened misfit by region of operation."""
    top_speed = max((float(np.abs(s["omega"]).max()) for s in signals if "omega" in s), default=0.0) or 1.0
    top_current = max((float(np.abs(s["i"]).max()) for s in signals if "i" in s), default=0.0) or np.inf
    region = np.concatenate([_region_of_samples(s, top_speed, top_current) for s in signals])
    r2 = np.concatenate([np.sum([np.nan_to_num(sim.residual(c) / run.sigma[c]) ** 2 for c in run.sigma], axis=0)
                         for sim, run in zip(fit.simulations, fit.problem.runs, strict=True)])
    return {name: float(np.sum(r2[region == name])) / (float(np.sum(r2)) or 1.0) for name in REGIONS}


def _region_of_samples(s: Mapping[str, Array], top_speed: float, top_current: float) -> NDArray[np.str_]:
    omega = s.get("omega", np.zeros_like(s["t"]))
    n = len(omega)
    still = np.abs(omega) < 0.02 * top_speed
    moving = np.where(still, 0, omega)
    reversal = np.zeros(n, bool)
    window = max(n // 200, 2)
    for c in np.flatnonzero(np.diff(np.sign(moving))):
        if moving[max(c - window, 0)] * moving[min(c + window, n - 1)] < 0:
            reversal[max(c - window, 0) : c + window] = True
    rate = np.abs(np.gradient(omega, s["t"]))
    fast = rate > 0.2 * max(np.quantile(rate, 0.99), 1e-300)
    strong = np.abs(s["i"]) > 0.6 * top_current if "i" in s else np.zeros(n, bool)
    masks = {"reversal": reversal, "standstill": still, "high current": strong, "acceleration": fast}
    return np.select(list(masks.values()), [np.array(name) for name in masks], np.array("steady"))


def _text(where: str | None, shares: Mapping[str, float], regions: Mapping[str, float],
          bins: Mapping[str, Sequence[Binned]]) -> str:
    region, name = _region(regions), "voltage" if where == "electrical" else "torque"
    lead = (f"The {name} balance fails ({100 * shares[where]:.0f} % of the squared error)." if where else
            "Without current and speed both measured, a missing voltage and a missing torque look the same.")
    if (best := bins.get(name, ())) and best[0].explained > 0.2:
        what = WORDS[best[0].against]
        share = f"{100 * best[0].explained:.0f} % of the missing {name}"
        return f"{lead} {what[0].upper()}{what[1:]} explains {share}. {region}"
    return f"{lead} {region}"


def accounted(before: Fit, after: Fit) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Return per run the voltage (V) and torque (N·m) missing in `before` that `after` has: what the balances of
    `before` lack along its motion. A current that was not measured is each model's own; the torque stands for both."""
    every, own = [], "i" in before.problem.system.states and "i" not in before.problem.outputs
    scale = {"i": 0.0 if own else before.values.get("L", 0.0), "omega": before.values["J"]}
    for k, run in enumerate(after.problem.runs):
        moved = alone = after.simulations[k].states
        if own:
            drive = run.experiment.inputs["v"] - before.values["K"] * moved["omega"]
            alone = {**moved, "i": drive / before.values["R"]}
        new, old = _rates(after, k, moved), _rates(before, k, alone)
        every.append([f * (new[n] - old[n]) if n in old else np.zeros(run.experiment.n) for n, f in scale.items()])
    voltages, torques = zip(*every, strict=True)
    return voltages, torques


def _rates(fit: Fit, k: int, states: Mapping[str, Array]) -> dict[str, Array]:
    system, run = fit.problem.system, fit.problem.runs[k]
    x = np.vstack([states.get(n, np.zeros(run.experiment.n)) for n in system.states])
    f = np.asarray(system.rhs(x, run.grid.u.T, parameter_vector(fit, k)))
    return {n: f[j] for j, n in enumerate(system.states) if n != "i" or system.stored[j]}


STEPS = 4  # Gauss-Newton iterations
MODEL_ERROR = 1e-5  # of a state's size: how exactly one step of the model must hold


class Smoothed(NamedTuple):
    """Unknown inputs (N, 2), states (N, nx), chi² of the measurements per sample."""

    d: Array
    x: Array
    chi2: float


class Linear(NamedTuple):
    """A model linearised at states x (N, nx): a step from each sample, x⁺ (N-1, nx), and outputs (N, ny), by slopes."""

    x: Array
    x_next: Array
    a: Array
    b: Array
    out: Array
    c: Array


def smooth(fit: Fit, k: int, walk: Array, linear: Linear) -> Smoothed:
    """Return the smoothed run `k`; `walk` is the step of the random walk, V/√s and N·m/√s (0: none), from `linear`."""
    run, y = fit.problem.runs[k], fit.problem.measured[k].y
    weights = np.array([1.0 / run.sigma[c] if c in run.sigma else 0.0 for c in fit.problem.outputs])
    x = linear.x
    n, nx = x.shape
    d = np.zeros((n, 2))
    size = np.maximum(np.abs(x).max(axis=0), 1e-9)
    hold = np.where(walk > 0, 1.0 / np.maximum(walk, 1e-300), 0.0)
    model = MODEL_ERROR * size * np.sqrt(np.median(run.grid.dt) / run.grid.dt.sum() * 100)
    for again in range(STEPS):
        if again:
            linear = _linear(fit, k, x, d)
        step = _banded_step(n, nx, (y - linear.out) * weights, linear.c * weights[None, :, None], linear.x_next - x[1:],
                            linear.a, linear.b, model, d, hold, run.grid.dt, walk > 0)
        x, d = x + step[:, :nx], d + step[:, nx:]
        if np.max(np.abs(step[:, :nx]) / size) < 1e-4:
            break
    out, _ = shown(fit.problem.system, run.grid, x, parameter_vector(fit, k))
    return Smoothed(d, x, float(np.nanmean(((y - out) * weights)[:, weights > 0] ** 2)))


def begin(fit: Fit, k: int) -> Linear:
    """Return the model linearised where to begin: at what was measured, and simulated where it was not."""
    run, simulated = fit.problem.runs[k].experiment, fit.simulations[k].states
    x = np.column_stack([bridged(run.t, run.outputs[s]) if s in run.outputs else simulated[s]
                         for s in fit.problem.system.states])
    return _linear(fit, k, x, np.zeros((len(x), 2)))


def _linear(fit: Fit, k: int, x: Array, d: Array) -> Linear:
    """Return the model linearised at the states `x` and the inputs `d`."""
    grid, system, p = fit.problem.runs[k].grid, fit.problem.system, parameter_vector(fit, k)
    return Linear(x, *linear_steps(system, grid, x, p, d[:-1]), *shown(system, grid, x, p))


def _banded_step(n, nx, misfit, c, defect, a, b, model, d, hold, dt, free) -> Array:
    """Solve one Gauss-Newton step for (δx, δd), (n, nx+2), by a banded Cholesky factorisation."""
    m = nx + 2
    diagonal, rhs = np.zeros((n, m, m)), np.zeros((n, m))
    e = np.where(np.isfinite(misfit), misfit, 0.0)
    cc = np.where(np.isfinite(misfit)[:, :, None], c, 0.0)
    diagonal[:, :nx, :nx] += np.einsum("nyi,nyj->nij", cc, cc)
    rhs[:, :nx] += np.einsum("nyi,ny->ni", cc, e)
    # defect_k = Φ(x_k, d_k) - x_{k+1}:  A δx_k + B δd_k - δx_{k+1} + defect = 0, weighed by 1/model
    g = np.concatenate([a, b * free], axis=2) / model[None, :, None]
    back = -np.eye(nx, m) / model[:, None]
    w = defect / model
    diagonal[:-1] += np.einsum("nki,nkj->nij", g, g)
    diagonal[1:] += back.T @ back
    below = np.einsum("ki,nkj->nij", back, g)
    rhs[:-1] -= np.einsum("nki,nk->ni", g, w)
    rhs[1:] -= w @ back
    # (d_{k+1} - d_k)·hold/√dt
    h = hold[None, :] ** 2 / dt[:, None]
    j = np.arange(nx, m)
    diagonal[:-1, j, j] += h
    diagonal[1:, j, j] += h
    below[:, j, j] -= h
    jump = d[1:] - d[:-1]
    rhs[:-1, nx:] += h * jump
    rhs[1:, nx:] -= h * jump
    diagonal[:, j, j] += np.where(free, 1e-12 * hold**2, 1.0)
    return _solve_blocks(diagonal, below, rhs)


def _solve_blocks(diagonal: Array, below: Array, rhs: Array) -> Array:
    n, m, _ = diagonal.shape
    scale = 1.0 / np.sqrt(np.maximum(np.einsum("nii->ni", diagonal), 1e-300))
    diagonal = diagonal * scale[:, :, None] * scale[:, None, :]
    below = below * scale[1:, :, None] * scale[:-1, None, :]
    band = np.zeros((2 * m, n * m))  # lower form: band[i - j, j]
    for r, c in np.ndindex(m, m):
        if r >= c:
            band[r - c, c::m] = diagonal[:, r, c]
        band[m + r - c, c : (n - 1) * m : m] = below[:, r, c]
    band[0] += 1e-12
    try:
        z = scipy.linalg.solveh_banded(band, (rhs * scale).ravel(), lower=True, check_finite=False)
    except np.linalg.LinAlgError:
        band[0] += 1e-6
        z = scipy.linalg.solveh_banded(band, (rhs * scale).ravel(), lower=True, check_finite=False)
    return z.reshape(n, m) * scale
