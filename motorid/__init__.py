"""Grey-box identification of brushed DC motors and actuators: fit, see where it fails, add what is missing."""

from motorid import effects
from motorid.checks import check_runs
from motorid.datasets import data_path
from motorid.errors import DataError, FitError, ModelError, MotoridError, SimulationError, UsageError
from motorid.experiment import Experiment
from motorid.fit import Failure, Fit, fit, solve
from motorid.integrate import Cvodes, Idas, Rosenbrock
from motorid.least_squares import LevenbergMarquardt
from motorid.model import Effect, Model, dc_motor, effect, torque_driven
from motorid.parameters import P, Parameter
from motorid.problem import Huber, Problem
from motorid.reading import read_csv, read_mat, read_runs
from motorid.simulate import evaluate, simulate
