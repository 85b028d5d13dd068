"""A fitted model back from its JSON file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from motorid import effects as library
from motorid.cli_options import own_effects
from motorid.errors import DataError, ModelError, one_of
from motorid.model import Effect, Model, dc_motor, torque_driven

BASES = {"dc_motor": dc_motor, "torque_driven": torque_driven}


def model_of(path: Path, effects_from: Path | None = None) -> Model:
    """Return the model that ``fit --json`` wrote, at its values.

    Raises
    ------
    DataError
        If the file is not there, or no such JSON.
    """
    try:
        contents = json.loads(Path(path).expanduser().read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror or error}. Write it with: motorid fit RUN... "
                        f"--json {path}") from None
    except ValueError:
        raise DataError(f"{path} is not JSON; expected what `motorid fit RUN... --json {path}` "
                        "writes.") from None
    own = own_effects(effects_from) if effects_from else {}
    try:
        return model_from(contents, own)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise DataError(f"{path} is JSON, but not of a fit (it lacks {error}); expected what `motorid fit "
                        f"RUN... --json {path}` writes.") from None


def model_from(contents: dict[str, Any], own: dict[str, Effect]) -> Model:
    """Return the model of the contents of ``fit --json``."""
    base = contents["model"]["base"]
    if base not in BASES:
        raise ModelError(one_of(str(base), BASES, "base"))
    axis = contents["model"].get("axis", "rotary")
    model = torque_driven(axis=axis) if base == "torque_driven" else dc_motor()
    for name in contents["model"]["effects"]:
        if name not in own and name not in library.LIBRARY:
            known = [*own, *library.LIBRARY]
            raise ModelError(f"{one_of(name, known, 'effect')} If it is one of your own, name its file: "
                             "--effects-from FILE.py")
        model = model + (own[name] if name in own else library.get(name))
    pars = contents["parameters"]
    model = model.fix(**{n: float(p["value"]) for n, p in pars.items() if p["fixed"]})
    return model.replace(**{n: float(p["value"]) for n, p in pars.items() if not p["fixed"]})
