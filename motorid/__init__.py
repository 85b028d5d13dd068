"""Grey-box identification of brushed DC motors: fit, see where the model fails, add what is missing.

Examples everywhere go on from these lines:

>>> import numpy as np
>>> import motorid as mi
>>> runs = mi.read_runs(mi.data_path("hidden_friction") / "run*.csv")
>>> check = mi.read_runs(mi.data_path("hidden_friction") / "check*.csv")
>>> fit = mi.fit(mi.dc_motor(), runs)
>>> better = mi.fit(mi.dc_motor() + mi.effects.coulomb, runs)
>>> found = mi.diagnose(fit, validate=check, effects=["coulomb", "stribeck", "cogging"])
"""

from types import FunctionType as _FunctionType
from types import ModuleType as _ModuleType
from typing import TYPE_CHECKING as _TYPE_CHECKING

from motorid.errors import DataError, FitError, ModelError, MotoridError, SimulationError, UsageError
from motorid.errors import arguments_told as _arguments_told
from motorid.errors import one_of as _one_of

# isort: split
from motorid import effects
from motorid.acquire.recorder import record
from motorid.acquire.virtual import virtual_bench
from motorid.diagnosis.bench_loop import identify_on
from motorid.diagnosis.diagnose import diagnose, improve
from motorid.diagnosis.experiment_design import design_experiment, suggest_experiment
from motorid.diagnosis.locate import locate
from motorid.estimation.fit import fit, solve
from motorid.estimation.result import Failure, Fit, compare
from motorid.estimation.shooting.formulations import compare_formulations
from motorid.estimation.shooting.multiple_shooting import MultipleShooting
from motorid.exporters.export import export, load
from motorid.integrate.rosenbrock import Rosenbrock
from motorid.integrate.sundials import Cvodes, Idas
from motorid.model.definition import Effect, P, Parameter, effect
from motorid.model.model import Model, dc_motor, torque_driven
from motorid.numerics.least_squares import Huber, LevenbergMarquardt
from motorid.problem.constraints import Constraint, CurrentLimit, SteadyState
from motorid.problem.problem import Problem
from motorid.problem.sensitivity import check_derivatives
from motorid.problem.simulate import evaluate, planned, simulate
from motorid.records import datasets
from motorid.records.checks import check_runs
from motorid.records.datasets import data_path
from motorid.records.experiment import Experiment
from motorid.records.reading import read_csv, read_mat, read_runs
from motorid.reports.explorer import explore
from motorid.reports.report import report
from motorid.uncertainty.batch import fit_many, motors_in
from motorid.uncertainty.bootstrap import bootstrap
from motorid.uncertainty.covariance import covariance
from motorid.uncertainty.identifiability import identifiability
from motorid.uncertainty.multistart import multistart
from motorid.uncertainty.profile import intervals, profile, profiles

if _TYPE_CHECKING:
    from motorid.plots import *  # noqa: F403  what `plots` lists

_FIGURES = ("plot_answer", "plot_current_limit", "plot_design", "plot_fit", "plot_formulations", "plot_ladder",
            "plot_missing", "plot_parameters", "plot_profile", "plot_ranking", "plot_residuals", "plot_runs",
            "plot_sensitivities", "plot_singular_values", "plot_waterfall")

for _name, _value in [(n, v) for n, v in globals().items() if not n.startswith("_")]:
    if isinstance(_value, type) and not issubclass(_value, Exception):
        _arguments_told(_value)
    elif isinstance(_value, _FunctionType):
        globals()[_name] = _arguments_told(_value)
        globals()[_name].__module__ = __name__  # where a process pool finds it


def __getattr__(name: str) -> object:
    """Import matplotlib only when a figure is asked for."""
    if name in _FIGURES:
        from motorid import plots

        return getattr(plots, name)
    raise AttributeError(_one_of(name, __dir__(), "name in motorid"))


def __dir__() -> list[str]:
    rooms = [n for n, value in globals().items() if isinstance(value, _ModuleType) and value not in (effects, datasets)]
    return sorted([n for n in globals() if not n.startswith("_") and n not in rooms] + list(_FIGURES))
