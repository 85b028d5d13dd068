"""A fitted model back from its file."""

from __future__ import annotations

from pathlib import Path

from motorid.cli.options import own_effects
from motorid.errors import ModelError
from motorid.exporters.export import load
from motorid.model.model import Model


def model_of(path: Path, effects_from: Path | None = None) -> Model:
    """Return the model that ``fit --json`` or ``export`` wrote, at its values.

    Raises
    ------
    DataError
        If the file is not there, or no such file.
    ModelError
        If it has an effect of the user's own, whose file was not named.
    """
    own = own_effects(effects_from) if effects_from else {}
    try:
        found = load(path, own.values())
        return found if isinstance(found, Model) else found.model
    except ModelError as error:
        if effects_from is not None:
            raise
        raise ModelError(f"{error} On the command line: --effects-from FILE.py") from None
