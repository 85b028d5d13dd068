"""Record from the virtual bench in real time and say what was lost and what it cost.

    python tests/benchmarks/bench_recording.py [--seconds 60] [--rates 1000 5000]

Bench and recorder are two processes, as in use, joined by a pseudo-terminal.
"""

from __future__ import annotations

import argparse
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

MAIN = (sys.executable, "-m", "motorid")


def cpu(pid: int) -> float:
    """Seconds of processor time that a running process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(rate: int, seconds: float, folder: Path) -> str:
    """Record once; return a line of figures."""
    words = ("bench", "--effect", "coulomb", "--seed", "1", "--rate", str(rate))
    bench = subprocess.Popen([*MAIN, *words], stdout=subprocess.PIPE, text=True)
    assert bench.stdout is not None
    port, out = bench.stdout.readline().split()[1], folder / f"{rate}.csv"
    before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    words = ("record", "--port", port, "--out", str(out), "--quiet", "--excite", f"prbs:6:0.05:{seconds}")
    done = subprocess.run([*MAIN, *words], capture_output=True, text=True, check=False)
    wall, after = time.monotonic() - begun, resource.getrusage(resource.RUSAGE_CHILDREN)
    used, bench_used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, cpu(bench.pid)
    bench.send_signal(signal.SIGTERM)
    bench.wait()
    samples = [x.split(",") for x in out.read_text().splitlines() if x[0].isdigit()]
    empty = sum("" in x for x in samples)
    return (f"{rate} Hz, {seconds:g} s: {len(samples)} rows of {round(rate * seconds)}, {empty} empty; "
            f"wall {wall:.2f} s; CPU recorder {100 * used / wall:.1f} %, "
            f"bench {100 * bench_used / wall:.1f} % of one core; {out.stat().st_size / 1e6:.1f} MB\n"
            f"  {done.stdout.splitlines()[1]}")


def main() -> None:
    """Measure at every rate."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--seconds", type=float, default=60.0)
    options.add_argument("--rates", type=int, nargs="+", default=[1000, 5000])
    given = options.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for rate in given.rates:
            print(measure(rate, given.seconds, Path(folder)), flush=True)


if __name__ == "__main__":
    main()
