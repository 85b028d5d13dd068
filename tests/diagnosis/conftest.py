"""What the tests of the diagnosis share."""

from __future__ import annotations

import pytest

from motorid.diagnosis import remainder


@pytest.fixture(autouse=True)
def _no_hurry(monkeypatch):
    """A slow or busy machine, where the search for a curve would run out of its two minutes, changes no answer."""
    monkeypatch.setattr(remainder, "SECONDS", 600.0)
