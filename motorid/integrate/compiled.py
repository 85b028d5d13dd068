"""Generated C, compiled once per model and kept on disk by content; never needed, only faster.

The library holds CasADi's code of one step and a short driver that walks over a record of any length, so
nothing is compiled again for another run length, number of sub-steps or set of free parameters.
"""

import ctypes
import hashlib
import os
import platform
import re
import shutil
import stat
import subprocess
import sys
import tempfile
import threading
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import casadi as ca

from motorid.integrate.rodas3 import StepFunctions

# -Bsymbolic: a name of ours must never be taken from another library. Nothing here changes a rounding: results are
# those of the virtual machine to the last bit, and so the same whether a step was compiled before, now or never.
FLAGS = ("-Og", "-fPIC", "-shared", *(() if sys.platform == "darwin" else ("-Wl,-Bsymbolic",)),
         "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math")
GCC_FLAGS = ("--param", "ira-max-conflict-table-size=0")  # a third of the time for a step of 5,000 instructions less

# What walks over a record with the code of a step, and where that ends in half the steps.
DRIVER = "\n" + Path(__file__).with_name("driver.c").read_text("utf-8")


def cache_dir() -> Path | None:
    """Return the folder of compiled steps, ``$MOTORID_CACHE``, else one in the user's cache folder, made if need be.

    What is in it is loaded and so can do anything: None (said once) where it belongs to another user, or others may
    write to it or to the folder it is in (unless that is sticky, like /tmp).
    """
    try:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(os.environ.get("MOTORID_CACHE") or Path(base) / "motorid").expanduser().resolve()
        folder.parent.mkdir(parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        own, above = folder.stat(), folder.parent.stat()
    except (OSError, RuntimeError) as error:  # RuntimeError: no home, or a loop of links
        return _without(f"cannot compile: no folder to write to ({error})")
    if not hasattr(os, "getuid"):
        return folder
    loose = above.st_mode & 0o002 and not above.st_mode & stat.S_ISVTX
    if own.st_uid != os.getuid() or own.st_mode & 0o022 or loose:
        return _without(f"cannot compile into {folder}: others can write there (chmod go-w, or name another one with "
                        "MOTORID_CACHE)")
    if own.st_mode & 0o077:  # made by an older version, or by hand
        with suppress(OSError):
            folder.chmod(0o700)
    return folder


@lru_cache(maxsize=1)
def compiler() -> tuple[str, str] | None:
    """Return (path, version line) of a C compiler, or None; ``$MOTORID_CC`` names one; ``none``: none."""
    wanted = os.environ.get("MOTORID_CC")
    if wanted == "none" or sys.platform == "win32":
        return None
    for name in (wanted,) if wanted else ("cc", "gcc", "clang"):
        if path := shutil.which(name):
            with suppress(OSError, subprocess.SubprocessError):
                done = subprocess.run([path, "--version"], capture_output=True, text=True, timeout=20, check=True)
                return path, (done.stdout.splitlines() or [""])[0]
    return None


def flags() -> tuple[str, ...]:
    """Return what the compiler is asked for."""
    cc = compiler()
    gcc = cc is not None and re.match(r"(\S*-)?g?cc(-\d+)? \(", cc[1])  # clang and tcc say "version" there
    return (*FLAGS, *GCC_FLAGS) if gcc else FLAGS


@lru_cache(maxsize=64)
def say_once(text: str) -> None:
    """Print one line on standard error, the first time only."""
    print(text, file=sys.stderr)


def generate(functions: StepFunctions) -> str:
    """Return the C source of the step functions and the driver."""
    code = ca.CodeGenerator("motorid_code", {"casadi_int": "long long", "with_header": False})
    every = _, f, _ = functions.light, functions.full, functions.out
    for function in every:
        code.add(function)
    sizes = {"NX": f.size1_in(0), "NU": f.size1_in(1), "NP": f.size1_in(4), "NY": functions.out.size1_out(0)}
    sizes |= {f"N_{n.upper()}": max(getattr(e, f"sz_{n}")() for e in every) for n in ("arg", "res", "iw", "w")}
    return code.dump() + "".join(f"#define {k} {max(v, 1)}\n" for k, v in sizes.items()) + DRIVER


def mark_of(key: str) -> str | None:
    """Return the name of the library for the content `key`, by all that goes in; None without a compiler."""
    cc = compiler()
    if cc is None:
        return None
    parts = "\0".join([key, *cc, *flags(), DRIVER, platform.machine(), ca.CasadiMeta.version()])
    return "step-" + hashlib.sha256(parts.encode()).hexdigest()[:32]


def find(mark: str) -> Path | None:
    """Return the library called `mark` in the cache, if it is there and whole.

    It is alone in its folder, where no other is looked at; its name is a digest, as half a file would end the process.
    """
    folder = cache_dir()
    for path in (folder / mark).glob("*.so") if folder else ():
        with suppress(OSError):
            if path.stem == _digest(path.read_bytes()):
                return path
            path.unlink(missing_ok=True)
    return None


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


def build(functions: StepFunctions, mark: str) -> Path | None:
    """Compile into the cache, atomically, and return the library; None (said once) if that does not work."""
    cc, cache = compiler(), cache_dir()
    if cc is None or cache is None:
        return None
    try:
        with tempfile.TemporaryDirectory(dir=cache, ignore_cleanup_errors=True) as folder:
            return _compiled(functions, cc[0], Path(folder), cache / mark)
    except (OSError, subprocess.SubprocessError) as error:
        return _without(f"cannot compile: {error}")


def _compiled(functions: StepFunctions, cc: str, here: Path, to: Path) -> Path:
    """Return the library compiled in the folder `here`, then in `to`. Raises OSError or SubprocessError."""
    (here / "step.c").write_text(generate(functions))
    with subprocess.Popen([cc, *flags(), "step.c", "-o", "step.so", "-lm"], cwd=here, stdin=subprocess.DEVNULL,
                          stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as process:
        hangs = threading.Timer(300, process.kill)  # with a timeout of its own it would look again every now and then
        hangs.start()
        try:
            said = process.communicate()[0]
        finally:
            hangs.cancel()
    if process.returncode:
        first = said.decode(errors="replace").splitlines() or ["no message"]
        raise OSError(f"the C compiler failed ({first[0]})")
    path = to / f"{_digest((here / 'step.so').read_bytes())}.so"
    to.mkdir(mode=0o700, exist_ok=True)
    os.replace(here / "step.so", path)
    return path


def load(path: Path) -> tuple[Any, Any] | None:
    """Return the drivers in the library at `path`; None (said once) if it cannot be loaded."""
    try:
        library = ctypes.CDLL(str(path))
        run, halved = library.motorid_run, library.motorid_halved
    except (OSError, AttributeError) as error:
        return _without(f"cannot load {path} ({error}; MOTORID_CACHE names another folder)")
    pointer, integer = ctypes.c_void_p, ctypes.c_longlong
    run.restype = integer
    run.argtypes = [integer, *[pointer] * 7, integer, *[pointer] * 7]
    halved.restype, halved.argtypes = None, [integer, *[pointer] * 8]
    return run, halved


def _without(why: str) -> None:
    say_once(f"motorid: {why}; going on with CasADi's virtual machine, same results, slower.")
