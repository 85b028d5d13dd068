"""Make the shipped records from seeds, or check that the shipped ones are what the seeds give.

    python data/make_data.py [--out DIR] [--only SET ...]     write the records and truth.json
    python data/make_data.py --check                          compare with the shipped files, bit for bit
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path

HERE = Path(__file__).resolve().parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

from sets import SETS, Files  # noqa: E402  (beside this file, as is the plant)


def make(only: list[str] | None = None) -> Iterator[tuple[str, Files, dict]]:
    """Every set as (name, {relative path: text}, truth)."""
    for name, build in SETS.items():
        if not only or name in only:
            runs, truth = build()
            files = {f"{name}/{run}.csv": text for run, text in runs.items()}
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
    pairs = zip_longest(old.splitlines(), text.splitlines(), fillvalue="")
    other = ((k, p, q) for k, (p, q) in enumerate(pairs, start=1) if p != q)
    k, shipped, made = next(other, (0, "other line ends", ""))
    return f"{path.parent.name}/{path.name}: differs at line {k}: {shipped!r} shipped, {made!r} made"


def _json(truth: dict) -> str:
    return json.dumps(truth, indent=1, ensure_ascii=False) + "\n"


def main() -> int:
    """Write or check; the exit status is 1 when a shipped file differs."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--out", type=Path, default=HERE, help="folder of the records (default: this one)")
    parser.add_argument("--only", nargs="+", choices=SETS, help="these sets only")
    parser.add_argument("--check", action="store_true", help="write nothing, compare")
    args = parser.parse_args()
    if not args.check:
        write(args.out, args.only)
        return 0
    bad = differences(args.out, args.only)
    print("\n".join(bad) or f"every file in {args.out} is what the seeds give")
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
