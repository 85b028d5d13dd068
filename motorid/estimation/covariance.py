"""What data determine: the covariance of the unknowns for coloured residuals, and combinations of them.

``H⁻¹ M H⁻¹`` with ``H = JᵀJ`` (Gauss-Newton) and ``M`` the covariance of ``Jᵀr``: the residuals of each channel are
taken as stationary, with the variance they have and the autocovariance of an autoregression fitted to them, so neither
the assumed noise level nor its whiteness matters (sandwich: White, Econometrica 50, 1982; Newey & West, Econometrica
55, 1987; Γ is parametric, since transients leave few samples). Residuals of a model that lacks something are no noise.
`Fit.std` is made here; `motorid.uncertainty.covariance` shows all of it.

A quantity is determined if two things hold. It stays where it is along every direction that has no influence on the
outputs: what such a direction carries away could be anything. Both are measured in relative changes (natural sizes for
what may be zero), in which symmetries of the equations are plain numbers such as R, L, 1/J, 1/b; in records without a
current, shipped and real, what it carries away shifts by 0.01 to 1 along it, and what stays by less than 0.0001. And
its 95 % interval does not reach zero; where zero is a value like others, the deviation is below half the natural size.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from motorid.channels import channel_name
from motorid.errors import among
from motorid.numerics.autoregression import Colour, colour_of, weighed
from motorid.numerics.least_squares import seen_directions
from motorid.numerics.signals import Array
from motorid.problem.problem import Problem
from motorid.problem.runs import natural_sizes

UNDETERMINED = 0.5  # relative standard deviation: beyond it the 95 % interval of a size reaches zero
WIDEST = 10.0  # of a solver coordinate, most of them logarithms: beyond a factor of 20,000 slopes mean nothing
ROUNDING = 1e-13  # of the largest influence on the outputs: a smaller one is an error of the arithmetic
BLIND = 1e-3  # of a relative change: a quantity that shifts so much along a direction without influence is as open
Law = Callable[[Mapping[str, float]], float]
Blocks = Mapping[str, Sequence[tuple[Array, Array]]]


@dataclass(frozen=True, eq=False)
class Certainty:
    """What residuals and Jacobian say of the unknowns."""

    matrix: Array  # (k, k), covariance in physical units, along the directions that the data determine
    status: tuple[str, ...]  # "determined", "not determined", "at its lower limit" or "at its upper limit"
    dof: float  # effective degrees of freedom of the residuals
    colours: Mapping[str, Colour]  # per channel, of the whitened residuals
    blind: Array  # (k, m), directions without influence on the outputs: orthonormal, in relative changes
    unit: Array  # (k,), what a relative change is one of: the value, or the natural size where that is larger

    @property
    def std(self) -> tuple[float | None, ...]:
        """One standard deviation per unknown; None where it is not determined or at a limit."""
        sizes = np.sqrt(np.maximum(np.diag(self.matrix), 0.0))
        return tuple(float(v) if s == "determined" else None for s, v in zip(self.status, sizes, strict=True))

    def std_of(self, slope: Array) -> float | None:
        """Return one standard deviation of a quantity with gradient `slope` (k,); None where it is not determined."""
        return None if _shifts(self.blind, self.unit * slope) else float(np.sqrt(slope @ self._linear @ slope))

    @cached_property
    def _linear(self) -> Array:
        """The covariance, (k, k), no direction wider than slopes hold: what trades off along it does so at its ends."""
        sizes, ways = np.linalg.eigh(self.matrix / self.unit / self.unit[:, None])  # one by one: tiny² is 0
        return (self.unit[:, None] * ways * np.clip(sizes, 0, WIDEST**2)) @ (self.unit[:, None] * ways).T


def certainty(problem: Problem, q: Array, residuals: Array, jacobian: Array, free: Array | None = None,
              method: str = "coloured") -> Certainty:
    """Return what `residuals` (n,) and `jacobian` (n, k) at solver coordinates `q` say of the unknowns. `free` (k, m)
    are the directions that active constraints leave; ``method="white"`` takes samples as independent."""
    among(method, ("coloured", "white"), "method")
    physical = problem.scaling.physical(q)
    limits = ["at its lower limit" if v <= p.lower else "at its upper limit" if v >= p.upper else ""
              for p, v in zip(problem.unknown, physical, strict=True)]
    loose = np.array([not s for s in limits], bool)
    basis = np.eye(len(loose))[:, loose] if free is None else free
    runs = list(zip(problem.runs, problem.unstack(residuals), problem.unstack(jacobian, 0.0), strict=True))
    # Per channel and run the whitened residual (N,), NaN where missing, and its Jacobian (N, k), 0 there.
    blocks = {c: [(r[:, j], jac[:, j]) for run, r, jac in runs if c in run.sigma]
              for j, c in enumerate(problem.outputs)}
    colours = {c: colour_of([r for r, _ in parts], basis.shape[1] / len(blocks)) for c, parts in blocks.items()}
    if method != "coloured":
        colours = {c: Colour(np.zeros(0), k.variance, k.variance) for c, k in colours.items()}
    unit = np.maximum(problem.scaling.slope(q), np.abs(physical))
    influence = np.linalg.norm(jacobian * unit, axis=0)
    jacobian = np.where(influence > ROUNDING * influence.max(initial=0.0), jacobian, 0.0)
    half, blind = seen_directions(jacobian @ basis)
    through = basis @ half
    matrix = through @ _meat(problem, jacobian, blocks, colours, through) @ through.T
    blind = np.linalg.qr((blind @ basis.T / unit).T)[0]
    # Vague: a deviation of half the value, or half the natural size where it may be zero.
    sizes = natural_sizes(problem.experiments, problem.values(q))
    least = np.array([0.0 if p.positive else sizes.get(p.unit, np.inf) for p in problem.unknown])
    vague = np.sqrt(np.maximum(np.diag(matrix), 0.0)) > UNDETERMINED * np.maximum(np.abs(physical), least)
    open_ = np.array([_shifts(blind, e) for e in np.eye(len(loose))], bool) | vague
    status = tuple(s or ("not determined" if no else "determined") for s, no in zip(limits, open_, strict=True))
    samples = {c: sum(int(np.isfinite(r).sum()) for r, _ in parts) for c, parts in blocks.items()}
    effective = sum(n * colours[c].effective_share for c, n in samples.items())
    return Certainty(matrix, status, max(float(effective) - basis.shape[1], 1.0), colours, blind, unit)


def _shifts(blind: Array, slope: Array) -> bool:
    """Tell whether a quantity of gradient `slope` (k,), to relative changes, changes along `blind` (k, m)."""
    return bool(np.linalg.norm(slope @ blind) > BLIND * np.linalg.norm(slope))


def _meat(problem: Problem, jacobian: Array, blocks: Blocks, colours: Mapping[str, Colour], along: Array) -> Array:
    """Covariance of (J along)ᵀr: outputs with their colour, priors as observations of variance 1, penalties fixed.
    `along` (k, m) comes first: afterwards, what far weaker directions have would be rounding."""
    total = sum((weighed(jac @ along, colours[c].autocovariance(len(jac))) for c, parts in blocks.items()
                 for _, jac in parts), np.zeros((along.shape[1],) * 2))
    n, unknown = problem.n_outputs, {p.name for p in problem.unknown}
    prior = jacobian[n:n + len(unknown & set(problem.priors))] @ along
    return total + prior.T @ prior


@dataclass(frozen=True)
class Quantity:
    """A combination of parameters with its standard deviation; `text` is what people call it."""

    value: float
    std: float
    unit: str
    text: str


def combinations(problem: Problem, q: Array, known: Certainty) -> dict[str, Quantity]:
    """Return what engineers ask of a motor, as far as the data determine it, even where single parameters stay open."""
    values, found = problem.values(q), {}
    for name, (unit, text, law) in _laws(problem, values).items():
        value, std = law(values), known.std_of(np.array([_slope(law, values, p.name) for p in problem.unknown]))
        if std is not None and np.isfinite(value) and std < UNDETERMINED * abs(value):
            found[name] = Quantity(value, std, unit, text)
    return found


def _slope(law: Law, values: Mapping[str, float], name: str) -> float:
    h = 1e-5 * abs(values.get(name, 0.0))
    return (law({**values, name: values[name] + h}) - law({**values, name: values[name] - h})) / (2 * h) if h else 0.0


def _laws(problem: Problem, values: Mapping[str, float]) -> dict[str, tuple[str, str, Law]]:
    """Return unit, words and law of the combinations that the model has: of ``ω/v = K/((L s + R)(J s + b) + K²)`` gain
    and poles; every torque as the voltage R·τ/K that overcomes it; with dry friction alone the no-load speed."""
    model, runs, motor = problem.model, problem.experiments, problem.model.base == "dc_motor"
    volt, speed, drive = (u := runs[0].units["v"]), "m/s" if problem.linear else "rad/s", channel_name("v", u)

    def gain(p: Mapping[str, float]) -> float:
        return p["K"] / (p["K"] ** 2 + p["R"] * p["b"]) if motor else p["g"] / (p["b"] or np.nan)

    def times(p: Mapping[str, float]) -> tuple[float, float]:
        """Half the sum of the time constants, and their product."""
        if not motor:
            return p["J"] / (p["b"] or np.nan) / 2, 0.0
        stiff = p["K"] ** 2 + p["R"] * p["b"]
        return (p["R"] * p["J"] + p["L"] * p["b"]) / (2 * stiff), p["L"] * p["J"] / stiff

    def as_voltage(name: str) -> Law:
        return lambda p: p[name] * (p["R"] / p["K"] if motor else 1 / p["g"])

    laws: dict[str, tuple[str, str, Law]] = {"gain": (f"{speed} per {volt}", f"speed per {drive}, steady", gain)}
    half, product = times(values)
    if product <= half**2:
        laws["time_constant"] = "s", "time constant, slow (mechanical)", lambda p: (
            (m := times(p))[0] + np.sqrt(max(m[0] ** 2 - m[1], 0.0)))
        if product > 0:
            laws["time_constant_fast"] = "s", "time constant, fast (electrical)", lambda p: (
                (m := times(p))[1] / (m[0] + np.sqrt(max(m[0] ** 2 - m[1], 0.0))))
    else:
        laws["natural_frequency"] = "rad/s", "natural frequency", lambda p: times(p)[1] ** -0.5
    if product > 0:
        laws["damping"] = "", "damping ratio", lambda p: times(p)[0] / np.sqrt(times(p)[1])
    force = "N" if model.axis == "linear" else "N·m"
    for n in (p.name for e in model.effects for p in e.parameters):  # torques, and what makes one of speed or angle
        if (p := model.parameters[n]).unit.startswith(force):
            words = f"{p.doc or n} as a {drive}, {'R·' * motor}{n}/{'K' if motor else 'g'}"
            laws[f"{n}_voltage"] = p.unit.replace(force, volt, 1), words, as_voltage(n)
    if model.effect_names in ((), ("coulomb",)):
        most = max(float(np.abs(run.inputs["v"]).max()) for run in runs)
        lost = as_voltage("tau_c") if "tau_c" in values else lambda p: 0.0
        laws["no_load_speed"] = speed, f"no-load speed at {most:.3g} {volt}", lambda p: gain(p) * (most - lost(p))
    return laws
