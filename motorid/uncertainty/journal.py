"""Results on disk as they come, so that an interrupted batch goes on where it was."""

from __future__ import annotations

import hashlib
import json
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from motorid.errors import DataError
from motorid.model.model import Model
from motorid.records.experiment import Experiment
from motorid.records.reading import find_records


class Journal:
    """A file of JSON lines, one result each; a line cut off by a crash is ignored.

    Attributes
    ----------
    rows : dict of str to dict
        Results by fingerprint.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: dict[str, dict[str, Any]] = {}
        if path.is_dir():
            raise DataError(f"the journal '{path}' is a folder; name a file, e.g. batch.jsonl.")
        if path.exists():
            text = path.read_text(encoding="utf-8")
            for line in text.splitlines():
                try:
                    entry = json.loads(line)
                    self.rows[entry["fingerprint"]] = entry["row"]
                except (ValueError, KeyError, TypeError):
                    continue
            if text and not text.endswith("\n"):
                self._append("\n")

    def add(self, rows: Mapping[str, Mapping[str, Any]]) -> None:
        """Write results by fingerprint, at once."""
        lines = (json.dumps({"fingerprint": m, "row": dict(r)}, ensure_ascii=False) for m, r in rows.items())
        self._append("".join(line + "\n" for line in lines))

    def _append(self, text: str) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a", encoding="utf-8") as file:
            file.write(text)


def fingerprint(model: Model, options: Mapping[str, Any], reading: Mapping[str, Any] | None,
                records: Any) -> str:
    """Return a hash of all that a result depends on: model and values, options, contents of the records."""
    mark = hashlib.sha256()
    for e in model.effects:
        code = getattr(e.law, "__code__", None)
        mark.update(repr((e.name, code.co_code if code else None, code.co_consts if code else None)).encode())
    mark.update(repr((model.base, model.axis, sorted(model.parameters.items()))).encode())
    mark.update(repr((sorted(options.items(), key=lambda o: o[0]), sorted((reading or {}).items()))).encode())
    for part in _contents(records):
        mark.update(part)
    return mark.hexdigest()


def _contents(records: Any) -> list[bytes]:
    if isinstance(records, Experiment):
        return [pickle.dumps((records.hold, dict(records.sigma), dict(records.units))),
                *(np.ascontiguousarray(a).tobytes() for a in (records.t, *records.inputs.values())),
                *(c.encode() + np.ascontiguousarray(a).tobytes() for c, a in records.outputs.items())]
    if isinstance(records, str | Path):
        try:
            return [Path(f).read_bytes() for f in find_records(records)]
        except (DataError, OSError):
            return [str(records).encode()]
    return [part for r in records for part in _contents(r)]
