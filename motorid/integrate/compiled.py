"""Generated C, compiled once per model and kept on disk by content; never needed, only faster.

A library holds CasADi's code of one step, another the driver that walks over a record of any length with any step, so
nothing is compiled again for another run length, number of sub-steps or set of free parameters."""

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
from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import casadi as ca

from motorid.integrate.rodas3 import StepFunctions

# -Bsymbolic: a name of ours must never be taken from another library. Nothing here changes a rounding: results are
# those of the virtual machine to the last bit, and so the same whether a step was compiled before, now or never.
FLAGS = ("-Og", "-fPIC", "-shared", *(() if sys.platform == "darwin" else ("-Wl,-Bsymbolic",)),
         "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math")
GCC_FLAGS = ("--param", "ira-max-conflict-table-size=0")  # a third of the time for a step of 5,000 instructions less

# What walks over a record with the code of a step, and where that ends in half the steps: built once, and so for speed.
DRIVER, DRIVER_FLAGS = Path(__file__).with_name("driver.c").read_text("utf-8"), ("-O3",)
MAKER = Path(__file__).with_name("rodas3.py").read_text("utf-8")  # what a step is made by
ABOUT = re.compile(r"^\S+ int \w+_checkout\(.*?(?=^/\* motorid_|\Z)", re.DOTALL | re.MULTILINE)  # what nobody asks


def cache_dir() -> Path | None:
    """Return the folder of compiled steps, ``$MOTORID_CACHE``, else one in the user's cache folder, made if need be.

    What is in it is loaded and so can do anything: None (said once) where it belongs to another user, or others may
    write to it or to the folder it is in (unless that is sticky, like /tmp)."""
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
    if (wanted := os.environ.get("MOTORID_CC")) == "none" or sys.platform == "win32":
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
    """Return the C source of the step functions."""
    code = ca.CodeGenerator("motorid_code", {"casadi_int": "long long", "with_header": False})
    for function in (functions.light, functions.full, functions.out):
        code.add(function)
    return ABOUT.sub("", code.dump())


def mark_of(key: str, kind: str = "step") -> str | None:
    """Return the name of the library for the content `key`, by all that goes in; None without a compiler."""
    if (cc := compiler()) is None:
        return None
    parts = [key, *cc, *flags(), MAKER, platform.machine(), ca.CasadiMeta.version()]
    return f"{kind}-{hashlib.sha256(chr(0).join(parts).encode()).hexdigest()[:32]}"


def find(mark: str) -> Path | None:
    """Return the library called `mark` in the cache, if it is there and, by its name, a digest, whole."""
    for path in (folder / mark).glob("*.so") if (folder := cache_dir()) else ():
        with suppress(OSError):
            if path.stem == _digest(path.read_bytes()):
                return path
            path.unlink(missing_ok=True)
    return None


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


def build(source: str, mark: str, *more: str) -> Path | None:
    """Compile into the cache, atomically, and return the library; None (said once) if that does not work."""
    cc, cache = compiler(), cache_dir()
    if cc is None or cache is None:
        return None
    try:
        with tempfile.TemporaryDirectory(dir=cache, ignore_cleanup_errors=True) as folder:
            return _compiled(source, [cc[0], *flags(), *more], Path(folder), cache / mark)
    except (OSError, subprocess.SubprocessError) as error:
        return _without(f"cannot compile: {error}")


def _compiled(source: str, cc: Sequence[str], here: Path, to: Path) -> Path:
    """Return the library compiled in the folder `here`, then in `to`. Raises OSError or SubprocessError."""
    (here / "step.c").write_text(source)
    with subprocess.Popen([*cc, "step.c", "-o", "step.so", "-lm"], cwd=here, stdin=subprocess.DEVNULL,
                          stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as process:
        hangs = threading.Timer(300, process.kill)  # with a timeout of its own it would look again every now and then
        hangs.start()
        try:
            said = process.communicate()[0]
        finally:
            hangs.cancel()
    if process.returncode:
        raise OSError(f"the C compiler failed ({(said.decode(errors='replace').splitlines() or ['no message'])[0]})")
    path = to / f"{_digest((here / 'step.so').read_bytes())}.so"
    to.mkdir(mode=0o700, exist_ok=True)
    os.replace(here / "step.so", path)
    return path


def load(path: Path, sizes: tuple[int, ...]) -> tuple[Any, Any] | None:
    """Return walks over a record, and in half the steps, by the library at `path`; None (said once) if that fails."""
    mark = mark_of(f"{DRIVER}{DRIVER_FLAGS}", "driver")
    if not (driver := mark and (find(mark) or build(DRIVER, mark, *DRIVER_FLAGS))):
        return None
    try:
        step, walks = ctypes.CDLL(str(path)), _driver(str(driver))
        code = [ctypes.cast(getattr(step, f"motorid_{n}"), ctypes.c_void_p) for n in ("light", "full", "out")]
    except (OSError, AttributeError) as error:
        return _without(f"cannot load {path} ({error}; MOTORID_CACHE names another folder)")
    return partial(walks[0], *sizes, *code), partial(walks[1], *sizes[:2], code[0])


@lru_cache(maxsize=8)
def _driver(path: str) -> tuple[Any, Any]:
    """Return the functions of the driver at `path`. Raises OSError or AttributeError."""
    library = ctypes.CDLL(path)
    run, halved = library.motorid_run, library.motorid_halved
    pointer, integer = ctypes.c_void_p, ctypes.c_longlong
    run.restype = integer
    run.argtypes = [*[integer] * 4, *[pointer] * 3, integer, *[pointer] * 7, integer, *[pointer] * 7]
    halved.restype, halved.argtypes = None, [*[integer] * 2, pointer, integer, *[pointer] * 8]
    return run, halved


def _without(why: str) -> None:
    say_once(f"motorid: {why}; going on with CasADi's virtual machine, same results, slower.")
