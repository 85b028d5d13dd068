"""Make the shipped records from seeds, or check that the shipped ones are what the seeds give.

    python data/make_data.py [--out DIR] [--only SET ...]     write the records and truth.json
    python data/make_data.py --check                          compare with the shipped files, bit for bit
"""

from __future__ import annotations

import argparse
import io
import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

import plant as P  # noqa: E402  (the package beside this file)

Files = dict[str, str]  # path relative to the data folder -> text
SETS: dict[str, Callable[[], tuple[Files, dict]]] = {}


def _set(make: Callable[[], tuple[Files, dict]]) -> Callable[[], tuple[Files, dict]]:
    SETS[make.__name__] = make
    return make


def table(columns: dict[str, tuple[np.ndarray, str]], comments: tuple[str, ...] = (), sep: str = ",") -> str:
    """Text of a table: header -> (values, format); NaN becomes an empty cell."""
    out = io.StringIO()
    for line in comments:
        out.write(f"# {line}\n")
    out.write(sep.join(columns) + "\n")
    for row in zip(*(values for values, _ in columns.values())):
        cells = (_cell(x, form) for x, (_, form) in zip(row, columns.values()))
        out.write(sep.join(cells) + "\n")
    return out.getvalue()


def _cell(x: float, form: str) -> str:
    return "" if np.isnan(x) else format(x + 0.0, form)


def facts(motor: P.Motor, effects: dict, seed: int | None, sigma: dict[str, float], **more: object) -> dict:
    """What truth.json says of one set."""
    return {
        "motor": motor.name,
        "parameters": {k: getattr(motor, k) for k in ("R", "L", "K", "b", "J")},
        "effects": effects,
        "sigma": sigma,
        "seed": seed,
        **more,
    }


# ---------------------------------------------------------------- sets


@_set
def two_step() -> tuple[Files, dict]:
    """Two noise-free voltage steps of the plain motor, twelve digits."""
    motor, files = P.MOTORS["lab"], {}
    for level in (6, 8):
        r = P.simulate_linear(motor, *P.step(level))
        files[f"two_step/step_{level}V.csv"] = table({
            "t_s": (r["t"], ".3f"),
            "voltage_V": (r["v"], "g"),
            "current_A": (r["i"], ".12g"),
            "speed_rad_s": (r["omega"], ".12g"),
        })
    return files, facts(motor, {}, None, {})


@_set
def hidden_friction() -> tuple[Files, dict]:
    """Dry friction, seen in reversals and at low speed."""
    seed, motor, effects = 20, P.MOTORS["lab"], {"coulomb": {"tau_c": 8.0e-3}}
    rng = np.random.default_rng(seed)
    sigma = {"i": 0.004, "omega": 0.15}
    excitations = {
        "run1": P.staircase([2, -1, 1, -2, 0.6, 0], 0.3),
        "run2": P.triangle(1.5, 2.0, 1.0),
        "check1": P.multisine(2.2, 1.5, [0.7, 1.9, 3.1, 5.3, 8.7], rng),
    }
    files = {}
    for name, (t, v) in excitations.items():
        r = P.simulate(motor, effects, t, v)
        files[f"hidden_friction/{name}.csv"] = table({
            "time_s": (t, ".3f"),
            "voltage_V": (v, ".4f"),
            "current_A": (P.adc(P.white(r["i"], sigma["i"], rng), 8.0), ".5f"),
            "speed_rad_s": (P.white(r["omega"], sigma["omega"], rng), ".3f"),
        })
    return files, facts(motor, effects, seed, sigma, current_adc={"bits": 12, "full_scale_A": 8.0})


# ---------------------------------------------------------------- writing and checking


def make(only: list[str] | None = None) -> Iterator[tuple[str, Files, dict]]:
    """Every set as (name, files, truth)."""
    for name, build in SETS.items():
        if not only or name in only:
            files, truth = build()
            yield name, files, {"what": (build.__doc__ or "").strip(), **truth, "files": sorted(files)}


def write(out: Path, only: list[str] | None = None) -> None:
    """Write the sets and truth.json under `out`; other sets already in truth.json stay."""
    path = out / "truth.json"
    truth = json.loads(path.read_text(encoding="utf-8")) if only and path.exists() else {}
    for name, files, known in make(only):
        for relative, text in files.items():
            (out / relative).parent.mkdir(parents=True, exist_ok=True)
            (out / relative).write_text(text, encoding="utf-8", newline="\n")
        truth[name] = known
        print(f"{name}: {len(files)} files, {sum(map(len, files.values())) / 1024:.0f} kB")
    path.write_text(_json(truth), encoding="utf-8", newline="\n")


def differences(shipped: Path, only: list[str] | None = None) -> list[str]:
    """One line for every shipped file that is not what the seeds give; empty when all is well."""
    bad, truth = [], {}
    for name, files, known in make(only):
        truth[name] = known
        bad += [d for rel, text in files.items() if (d := _difference(shipped / rel, text))]
    told = json.loads((shipped / "truth.json").read_text(encoding="utf-8"))
    bad += [f"truth.json: set '{n}' differs" for n in truth if told.get(n) != json.loads(_json(truth))[n]]
    return bad


def _difference(path: Path, text: str) -> str | None:
    if not path.exists():
        return f"{path.name}: missing in {path.parent}"
    old = path.read_bytes().decode("utf-8")
    if old == text:
        return None
    a, b = old.splitlines(), text.splitlines()
    k = next((k for k, (p, q) in enumerate(zip(a, b)) if p != q), min(len(a), len(b)))
    where = f"first at line {k + 1}: {(a + [''])[k]!r} shipped, {(b + [''])[k]!r} made" if a != b else "in line ends"
    return f"{path.parent.name}/{path.name}: differs, {where}"


def _json(truth: dict) -> str:
    return json.dumps(truth, indent=1, ensure_ascii=False) + "\n"


def main() -> int:
    """Write or check; the exit status is 1 when a shipped file differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=HERE, help="folder to write to (default: beside this file)")
    parser.add_argument("--only", nargs="+", choices=SETS, help="these sets only")
    parser.add_argument("--check", action="store_true", help="write nothing, compare with the files in --out")
    args = parser.parse_args()
    if not args.check:
        write(args.out, args.only)
        return 0
    bad = differences(args.out, args.only)
    print("\n".join(bad) or f"every file in {args.out} is what the seeds give")
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
