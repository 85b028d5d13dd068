"""Engines: Rosenbrock (fast, compiled) and SUNDIALS' CVODES and IDAS (reference); `engine_of` gives one by name."""

from dataclasses import replace

from motorid.errors import among
from motorid.integrate.engine import Engine, Grid, Trajectory
from motorid.integrate.rosenbrock import Rosenbrock
from motorid.integrate.sundials import Cvodes, Idas

ENGINES = {"rosenbrock": Rosenbrock, "cvodes": Cvodes, "idas": Idas}


def engine_of(engine: str | Engine) -> Engine:
    """Return the engine of that name, or the engine itself; UsageError if the name is not known."""
    if isinstance(engine, str):
        among(engine, ENGINES, "engine")
        return ENGINES[engine]()
    return engine


def limited(engine: Engine, steps: int) -> Engine:
    """Return the engine, one that gives up preparing a record that takes more than so many of its sub-steps."""
    return replace(engine, most_steps=steps) if isinstance(engine, Rosenbrock) else engine


__all__ = ["ENGINES", "Cvodes", "Engine", "Grid", "Idas", "Rosenbrock", "Trajectory", "engine_of", "limited"]
