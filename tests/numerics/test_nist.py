"""The least-squares core on the certified problems of NIST: values to six digits, standard errors to four."""

from dataclasses import dataclass, replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from motorid.errors import SimulationError
from motorid.model.definition import Parameter
from motorid.numerics.least_squares import MANY, ROWS, LevenbergMarquardt, _reduce, levenberg_marquardt, seen_directions
from motorid.problem.unknowns import Scaling

FOLDER = Path(__file__).parent / "nist"
POSITIVE = {"MGH10"}  # lives on the logarithmic scale, as resistances and time constants do in a motor
STRICT = LevenbergMarquardt(max_iterations=2000, ftol=1e-15, xtol=1e-13)


def gauss(b, x):
    return b[0] * ca.exp(-b[1] * x) + sum(b[k] * ca.exp(-(((x - b[k + 1]) / b[k + 2]) ** 2)) for k in (2, 5))


def lanczos(b, x):
    return sum(b[k] * ca.exp(-b[k + 1] * x) for k in (0, 2, 4))


def cubic(b, x):
    return (b[0] + b[1] * x + b[2] * x**2 + b[3] * x**3) / (1 + b[4] * x + b[5] * x**2 + b[6] * x**3)


def chwirut(b, x):
    return ca.exp(-b[0] * x) / (b[1] + b[2] * x)


def saturating(b, x):
    return b[0] * (1 - ca.exp(-b[1] * x))


def enso(b, x):
    turns = [(b[1], b[2], 12), (b[4], b[5], b[3]), (b[7], b[8], b[6])]
    return b[0] + sum(c * ca.cos(2 * np.pi * x / p) + s * ca.sin(2 * np.pi * x / p) for c, s, p in turns)


MODELS = {
    "Bennett5": lambda b, x: b[0] * (b[1] + x) ** (-1 / b[2]),
    "BoxBOD": saturating,
    "Chwirut1": chwirut,
    "Chwirut2": chwirut,
    "DanWood": lambda b, x: b[0] * x ** b[1],
    "ENSO": enso,
    "Eckerle4": lambda b, x: b[0] / b[1] * ca.exp(-0.5 * ((x - b[2]) / b[1]) ** 2),
    "Gauss1": gauss,
    "Gauss2": gauss,
    "Gauss3": gauss,
    "Hahn1": cubic,
    "Kirby2": lambda b, x: (b[0] + b[1] * x + b[2] * x**2) / (1 + b[3] * x + b[4] * x**2),
    "Lanczos1": lanczos,
    "Lanczos2": lanczos,
    "Lanczos3": lanczos,
    "MGH09": lambda b, x: b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3]),
    "MGH10": lambda b, x: b[0] * ca.exp(b[1] / (x + b[2])),
    "MGH17": lambda b, x: b[0] + b[1] * ca.exp(-x * b[3]) + b[2] * ca.exp(-x * b[4]),
    "Misra1a": saturating,
    "Misra1b": lambda b, x: b[0] * (1 - (1 + b[1] * x / 2) ** (-2)),
    "Misra1c": lambda b, x: b[0] * (1 - (1 + 2 * b[1] * x) ** (-0.5)),
    "Misra1d": lambda b, x: b[0] * b[1] * x / (1 + b[1] * x),
    "Nelson": lambda b, x: b[0] - b[1] * x[:, 0] * ca.exp(-b[2] * x[:, 1]),
    "Rat42": lambda b, x: b[0] / (1 + ca.exp(b[1] - b[2] * x)),
    "Rat43": lambda b, x: b[0] / (1 + ca.exp(b[1] - b[2] * x)) ** (1 / b[3]),
    "Roszman1": lambda b, x: b[0] - b[1] * x - ca.atan(b[2] / (x - b[3])) / np.pi,
    "Thurber": cubic,
}


@dataclass
class Certified:
    starts: np.ndarray
    values: np.ndarray
    errors: np.ndarray
    squares: float
    y: np.ndarray
    x: np.ndarray


def certified(name):
    lines = (FOLDER / f"{name}.txt").read_text().splitlines()
    table = np.array([line.split()[2:] for line in lines if line.startswith("# b ")], float).T
    squares = next(float(line.split()[-1]) for line in lines if line.startswith("# residual sum"))
    data = np.array([line.split() for line in lines if not line.startswith("#")], float)
    y = np.log(data[:, 0]) if name == "Nelson" else data[:, 0]
    return Certified(table[:2], table[2], table[3], squares, y, data[:, 1:])


def solved(name, problem, start):
    """Solve from `start` in solver coordinates; return values, standard errors, sum of squares."""
    b, x = ca.SX.sym("b", len(start)), ca.DM(problem.x)
    r = MODELS[name](b, x) - ca.DM(problem.y)
    f = ca.Function("f", [b], [r, ca.densify(ca.jacobian(r, b))])
    scaling = Scaling.of([Parameter(f"b{k}", v, positive=name in POSITIVE) for k, v in enumerate(start)])

    def both(q):
        out = [np.asarray(a) for a in f(scaling.physical(q))]
        if not np.isfinite(out[0]).all() or not np.isfinite(out[1]).all():
            raise SimulationError("not finite")
        return out[0].ravel(), out[1] * scaling.slope(q)

    found = levenberg_marquardt(lambda q: both(q)[0], both, scaling.scaled(start), options=STRICT,
                                log=scaling.log)
    assert found.status == "converged", found.message
    squares = float(found.residual @ found.residual)
    jac = found.jac / scaling.slope(found.q)
    half, left_out = seen_directions(jac)
    assert not len(left_out)
    variance = squares / (len(problem.y) - len(start))
    return scaling.physical(found.q), np.sqrt(variance * np.diag(half @ half.T)), squares


@pytest.mark.parametrize("start", [0, 1], ids=["far", "near"])
@pytest.mark.parametrize("name", sorted(MODELS))
def test_certified_values_and_standard_errors(name, start):
    problem = certified(name)
    values, errors, squares = solved(name, problem, problem.starts[start])
    np.testing.assert_allclose(values, problem.values, rtol=1e-6)
    if name == "Lanczos1":  # the residuals are rounding errors of the data, 1e-13
        assert squares < 1e-20
        return
    np.testing.assert_allclose(squares, problem.squares, rtol=1e-6)
    np.testing.assert_allclose(errors, problem.errors, rtol=1e-4)


def test_an_end_far_from_a_minimum_is_not_called_converged():
    # Without the logarithmic scale the far start of MGH10 leads to a pole, where no step lowers the cost.
    problem = certified("MGH10")
    b, x = ca.SX.sym("b", 3), ca.DM(problem.x)
    r = MODELS["MGH10"](b, x) - ca.DM(problem.y)
    f = ca.Function("f", [b], [r, ca.densify(ca.jacobian(r, b))])
    start = problem.starts[0]

    def both(q):
        out = [np.asarray(a) for a in f(start * q)]
        if not np.isfinite(out[0]).all() or not np.isfinite(out[1]).all():
            raise SimulationError("not finite")
        return out[0].ravel(), out[1] * start

    found = levenberg_marquardt(lambda q: both(q)[0], both, np.ones(3), options=STRICT)
    assert 2 * found.history[-1] > 10 * problem.squares
    assert found.status == "stalled"
    assert "Try another start" in found.message


def test_slopes_that_overflow_where_outputs_do_not_shorten_the_step():
    """As of a model that is unstable there."""
    def residual(q):
        return np.array([q[0] - 3.0, 0.1 * (q[0] - 3.0) ** 2])

    def both(q):
        if 0.5 < q[0] < 2.5:
            raise SimulationError("the slopes left the finite numbers")
        return residual(q), np.array([[1.0], [0.2 * (q[0] - 3.0)]])

    steps = levenberg_marquardt(residual, both, np.array([0.0]), options=LevenbergMarquardt(longest_step=2.0))
    assert 0.4 < steps.q[0] < 0.5, "as near as it can come in steps that are trusted"
    over = levenberg_marquardt(residual, both, np.array([0.0]), options=LevenbergMarquardt(damping=0, longest_step=9))
    assert over.q[0] == pytest.approx(3.0, abs=1e-6), "in one step it comes to the other side"


@pytest.mark.parametrize(("patience", "crawl", "fewer"), [(5, 3e4, True), (5, 1e2, False)])
def test_a_descent_that_crawls_ends_when_patience_does(patience, crawl, fewer):
    """Rosenbrock's valley, strongly damped: many small steps that all lower the cost."""
    def both(q):
        return np.array([10 * (q[1] - q[0] ** 2), 1 - q[0]]), np.array([[-20 * q[0], 10.0], [-1.0, 0.0]])

    begin, short = np.array([-1.2, 1.0]), LevenbergMarquardt(longest_step=0.01, ftol=1e-6)
    whole = levenberg_marquardt(lambda q: both(q)[0], both, begin, options=replace(short, patience=1000))
    found = levenberg_marquardt(lambda q: both(q)[0], both, begin,
                                options=replace(short, patience=patience, crawl=crawl))
    assert (len(found.history) < len(whole.history)) is fewer
    if fewer:
        assert found.status == "stalled"
        assert f"less than {100 * patience * crawl * 1e-6:.2g} % in {patience} steps" in found.message


def test_what_acts_on_a_few_rows_only_is_reduced_there_first():
    """First states of many runs beside a few parameters of all: the same RᵀR and RᵀQᵀr as of all rows at once."""
    rng, runs, each = np.random.default_rng(0), MANY, ROWS // 3 + 7  # ends of runs are no ends of lots of rows
    jac = np.hstack([rng.standard_normal((runs * each, 3)), np.zeros((runs * each, runs))])
    for k in range(runs):
        jac[k * each : (k + 1) * each, 3 + k] = rng.standard_normal(each)
    jac[:, 5] = 0.0  # what acts nowhere
    r = rng.standard_normal(runs * each)
    triangle, rotated = _reduce(jac, r)
    assert triangle.shape == (3 + runs, 3 + runs)
    np.testing.assert_array_equal(triangle, np.triu(triangle))
    np.testing.assert_allclose(triangle.T @ triangle, jac.T @ jac, atol=1e-9)
    np.testing.assert_allclose(triangle.T @ rotated, jac.T @ r, atol=1e-9)
