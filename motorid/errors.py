"""Errors for people: every message says what was expected, what came, and what to do."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np


class MotoridError(Exception):
    """Base of every error that motorid raises on purpose; its text is one clear message for the user."""


class DataError(MotoridError):
    """A record cannot be read or cannot be used (exit status 2 on the command line)."""


class ModelError(MotoridError):
    """A model or an effect is not well formed, or does not fit the measured channels (exit status 2)."""


class UsageError(MotoridError):
    """A word, a name or an option is not known or does not go with another one (exit status 2)."""


class SimulationError(MotoridError):
    """An integration did not reach the end of the record (exit status 1)."""


class FitError(MotoridError):
    """An estimation could not be carried out (exit status 1)."""


class DeviceError(MotoridError):
    """A bench on a serial port does not answer, refuses, or says what cannot be (exit status 1)."""


class MissingDependency(MotoridError):
    """An optional package is needed and not installed; the message names the extra to install."""


# What may go wrong with one of many models without stopping the others.
FAILURES = (FitError, SimulationError, ModelError, np.linalg.LinAlgError)


def one_of(word: str, known: Iterable[object], what: str) -> str:
    """Say that `word` is not among the `known` names of `what`, and which one may have been meant."""
    import difflib

    names = [str(k) for k in known]
    near = difflib.get_close_matches(word, names, n=1, cutoff=0.5)
    hint = f" Did you mean '{near[0]}'?" if near else ""
    return f"unknown {what} '{word}'.{hint} Known: {', '.join(names)}."
