"""Grey-box identification of brushed DC motors: fit, see where the model fails, add what is missing."""

from typing import TYPE_CHECKING as _TYPE_CHECKING

from motorid import effects
from motorid.acquire import record
from motorid.batch import fit_many, motors_in
from motorid.bootstrap import bootstrap
from motorid.checks import check_runs
from motorid.comparison import compare
from motorid.constraints import Constraint, CurrentLimit, SteadyState
from motorid.datasets import data_path
from motorid.derivatives import check_derivatives
from motorid.diagnosis import diagnose, improve, locate, suggest_experiment
from motorid.errors import DataError, FitError, ModelError, MotoridError, SimulationError, UsageError
from motorid.experiment import Experiment
from motorid.explore import explore
from motorid.export import export, load
from motorid.fit import Failure, Fit, fit, solve
from motorid.formulations import compare_formulations
from motorid.identifiability import identifiability
from motorid.integrate import Cvodes, Idas, Rosenbrock
from motorid.intervals import intervals
from motorid.least_squares import LevenbergMarquardt
from motorid.model import Effect, Model, dc_motor, effect, torque_driven
from motorid.multistart import multistart
from motorid.parameters import P, Parameter
from motorid.problem import Huber, Problem
from motorid.profiling import profile, profiles
from motorid.reading import read_csv, read_mat, read_runs
from motorid.remedies import planned
from motorid.report import report
from motorid.shooting import MultipleShooting
from motorid.simulate import evaluate, simulate
from motorid.uncertainty import covariance

if _TYPE_CHECKING:
    from motorid.plots import (
        plot_current_limit,
        plot_fit,
        plot_formulations,
        plot_ladder,
        plot_missing,
        plot_parameters,
        plot_profile,
        plot_ranking,
        plot_residuals,
        plot_runs,
        plot_sensitivities,
        plot_singular_values,
        plot_waterfall,
    )

_FIGURES = (
    "plot_current_limit",
    "plot_fit",
    "plot_formulations",
    "plot_ladder",
    "plot_missing",
    "plot_parameters",
    "plot_profile",
    "plot_ranking",
    "plot_residuals",
    "plot_runs",
    "plot_sensitivities",
    "plot_singular_values",
    "plot_waterfall",
)


def __getattr__(name: str) -> object:
    """Import matplotlib only when a figure is asked for."""
    if name in _FIGURES:
        from motorid import plots

        return getattr(plots, name)
    raise AttributeError(f"module 'motorid' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([n for n in globals() if not n.startswith("_")] + list(_FIGURES))
