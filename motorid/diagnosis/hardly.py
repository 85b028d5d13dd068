"""Effects that leave one channel's error where it was, many times its noise, have not explained it.

An effect in a balance shows in every channel. One that mends the speed alone, with the motor's own parameters bent to
suit, is the nearest that the library has, and not what is missing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from motorid.diagnosis.model_comparison import Node
from motorid.diagnosis.residual_analysis import Errors, astray, despiked
from motorid.display.numbers import number

STAYS = 5.0  # times the noise, held out
HARDLY = 0.2  # fall of the error


def hardly_moved(path: Sequence[Node], noise: dict[str, float]) -> str:
    """Say which channel's held-out error the effects of the last model leave as it is; empty if none.

    Held-out runs that both lose say nothing; there the error on the fitted runs counts.

    Parameters
    ----------
    path : sequence of Node
        From the first model to the last.
    noise : dict of str to float
        Per channel, SI.
    """
    first, last = path[0], path[-1]
    added = [e for e in last.fit.model.effects if e.name not in first.key]
    if not any(e.balance != "sensor" for e in added):
        return ""  # a sensor's effect need not show in other channels
    before, after = _sizes(first.held), _sizes(last.held)
    for c in astray(first.held.nrmse(), last.held.nrmse()):
        before[c], after[c] = _sizes(first.train)[c], _sizes(last.train)[c]
    for c in before:
        far = after.get(c, 0.0) / noise.get(c, np.inf)
        if far > STAYS and after[c] > (1 - HARDLY) * before[c]:
            return f"leaves the error of {c} at {number(far, 2)} times its noise, where it hardly falls"
    return ""


def _sizes(errors: Errors) -> dict[str, float]:
    found = {}
    for c, parts in errors.residuals.items():
        r = np.concatenate([despiked(p) for p in parts])
        found[c] = float(np.sqrt(np.mean(r**2))) if r.size else 0.0
    return found
