"""Check the sizes: ``python tests/battery/blind/size.py [first|second|third|fourth] [part of a name]``; builds only.

Prints per case the error of a fitted plain motor over the noise (an effect should stand out, nothing should not), the
floor, and the change when the plant's step is halved (over the noise), with ``--halve``.
"""

from __future__ import annotations

import importlib
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from battery.blind.build import build, plain_excess

MODEST = (1.3, 60.0)  # of the plain motor's error over the noise, where something acts


def main() -> None:
    words = [w for w in sys.argv[1:] if not w.startswith("-")]
    cases = importlib.import_module(f"battery.blind.{words.pop(0) if words else 'second'}").B
    for case in cases.values():
        if words and not any(w in case.name for w in words):
            continue
        start = time.process_time()
        built = build(case)
        seconds = time.process_time() - start
        excess = plain_excess(case, built)
        most = max(excess.values())
        fine = most < 1.08 if case.kind == "none" else MODEST[0] <= most <= MODEST[1]
        line = f"{case.name:28s} {seconds:4.1f} s  plain/noise " + " ".join(f"{c} {e:.2f}" for c, e in excess.items())
        line += "  floor " + " ".join(f"{c} {100 * f:.2f}%" for c, f in built["floor"].items())
        if "--halve" in sys.argv:
            finer = build(case, 2)
            change = max(
                np.sqrt(np.mean((r["true"][c] - s["true"][c]) ** 2)) / built["noise"][c]
                for r, s in zip(built["train"], finer["train"], strict=True) for c in r["true"])
            line += f"  halved {change:.3f}"
        print(line + ("" if fine else "  <--"), flush=True)


if __name__ == "__main__":
    main()
