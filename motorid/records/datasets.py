"""Where the shipped records are, what is hidden in them, and the plant they come from."""

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from motorid.errors import DataError, among, one_of

_PLANT = "motorid_plant"


def _root() -> Path:
    """The data folder of a checkout (beside the package) or of an installed wheel (inside it)."""
    package = Path(__file__).resolve().parents[1]
    places = (package.parent / "data", package / "data")
    if found := next((place for place in places if (place / "truth.json").is_file()), None):
        return found
    raise DataError(f"the shipped records were not found; looked for truth.json in {' and '.join(map(str, places))}. "
                    "Install motorid from a wheel, or work in a checkout that has its data folder.")


def data_path(name: str = "") -> Path:
    """Path of a shipped set or file.

    Parameters
    ----------
    name : str
        As ``"hidden_friction"`` or ``"two_step/step_6V.csv"``; empty for the data folder itself.

    Raises
    ------
    DataError
        If there is no such set or file.

    Examples
    --------
    >>> mi.data_path("hidden_friction/run1.csv").name
    'run1.csv'
    """
    if not (path := _root() / name).exists():
        files = sorted(f for known in _truths().values() for f in known["files"])
        raise DataError(one_of(name, files if "/" in name else datasets(), "shipped data"))
    return path


def datasets() -> list[str]:
    """Names of the shipped sets."""
    return sorted(_truths())


def truth(name: str) -> dict[str, Any]:
    """What is true of a shipped set: motor, parameters in SI, hidden effects, noise, seed."""
    known = _truths()
    among(name, sorted(known), "shipped set", DataError)
    return known[name]


def load_plant() -> ModuleType:
    """The independent motor plant in ``data/plant``: Motor, MOTORS, Plant, simulate, excitations and sensors. It is
    loaded by path, since it is data, not part of the library: it shares no code with the models."""
    if _PLANT in sys.modules:
        return sys.modules[_PLANT]
    path = _root() / "plant" / "__init__.py"
    spec = importlib.util.spec_from_file_location(_PLANT, path)  # a package, as its name says
    if not path.is_file() or spec is None or spec.loader is None:
        raise DataError(f"the motor plant was expected at {path} and is not there; reinstall motorid.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[_PLANT] = module  # before running it: its parts import each other relatively
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[_PLANT]
        raise
    return module


def _truths() -> dict[str, Any]:
    return json.loads((_root() / "truth.json").read_text(encoding="utf-8"))
