"""Generated C, compiled once per model and kept on disk by content; never needed, only faster.

The library holds CasADi's code of one step and a short driver that walks over a record of any length, so
nothing is compiled again for another run length, number of sub-steps or set of free parameters.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from functools import lru_cache
from pathlib import Path

import casadi as ca

from motorid.integrate.step import StepFunctions

# -Bsymbolic: a name of ours must never be taken from another library.
# The others let divisions by one pivot share its reciprocal; results stay within rounding of the virtual machine's.
FLAGS = ("-O2", "-fPIC", "-shared", "-Wl,-Bsymbolic", "-ffp-contract=off", "-fno-math-errno", "-freciprocal-math",
         "-fno-trapping-math")
_told: set[str] = set()

DRIVER = r"""
#include <math.h>
#include <stdlib.h>
#include <string.h>

/* x over one record; returns -1, or the index of the first sample whose state is not finite. */
long long motorid_run(long long n, const long long* nsub, const double* dt, const double* u0, const double* u1,
                      const double* us, const double* x0, const double* p, long long nq,
                      const double* S0, const double* Pq, double* Y, double* DY, double* X, double* DX, double* E) {
  casadi_int a1, r1, i1, w1, na = 8, nr = 8, ni = 1, nw = 1;
  motorid_light_work(&a1, &r1, &i1, &w1);
  if (a1 > na) na = a1; if (r1 > nr) nr = r1; if (i1 > ni) ni = i1; if (w1 > nw) nw = w1;
  motorid_full_work(&a1, &r1, &i1, &w1);
  if (a1 > na) na = a1; if (r1 > nr) nr = r1; if (i1 > ni) ni = i1; if (w1 > nw) nw = w1;
  motorid_out_work(&a1, &r1, &i1, &w1);
  if (a1 > na) na = a1; if (r1 > nr) nr = r1; if (i1 > ni) ni = i1; if (w1 > nw) nw = w1;
  const double** arg = malloc(na * sizeof(double*));
  double** res = malloc(nr * sizeof(double*));
  casadi_int* iw = malloc(ni * sizeof(casadi_int));
  double* w = malloc((nw + 2 * NX * nq + 1) * sizeof(double));
  double *S = w + nw, *T = S + NX * nq;
  double x[NX], xn[NX], e[NX], A[NX * NX], B[NX * NP], ua[NU], ub[NU], y[NY], C[NY * NX], D[NY * NP];
  long long k, bad = -1;
  memcpy(x, x0, sizeof(x));
  if (nq) memcpy(S, S0, NX * nq * sizeof(double));
  for (k = 0; k < n; k++) {
    int r, c; long long j;
    for (r = 0; r < NX; r++) if (!isfinite(x[r])) bad = k;
    if (bad >= 0) break;
    if (X) memcpy(X + k * NX, x, sizeof(x));
    if (DX) memcpy(DX + k * NX * nq, S, NX * nq * sizeof(double));
    arg[0] = x; arg[1] = us + k * NU; arg[2] = p;
    res[0] = y; res[1] = nq ? C : 0; res[2] = nq ? D : 0;
    motorid_out(arg, res, iw, w, 0);
    memcpy(Y + k * NY, y, sizeof(y));
    if (nq) for (r = 0; r < NY; r++) {
      double* row = DY + (k * NY + r) * nq;
      for (j = 0; j < nq; j++) row[j] = 0;
      for (c = 0; c < NX; c++) if (C[c * NY + r] != 0) for (j = 0; j < nq; j++) row[j] += C[c * NY + r] * S[c * nq + j];
      for (c = 0; c < NP; c++) if (D[c * NY + r] != 0) for (j = 0; j < nq; j++) row[j] += D[c * NY + r] * Pq[c * nq + j];
    }
    if (k == n - 1) break;
    long long s, m = nsub[k]; double h = dt[k] / m;
    if (E) memset(E + k * NX, 0, NX * sizeof(double));
    for (s = 0; s < m; s++) {
      for (c = 0; c < NU; c++) {
        double slope = u1[k * NU + c] - u0[k * NU + c];
        ua[c] = u0[k * NU + c] + slope * s / m; ub[c] = u0[k * NU + c] + slope * (s + 1) / m;
      }
      arg[0] = x; arg[1] = ua; arg[2] = ub; arg[3] = &h; arg[4] = p;
      res[0] = xn; res[1] = e; res[2] = A; res[3] = B;
      if (nq) {
        motorid_full(arg, res, iw, w, 0);
        for (r = 0; r < NX; r++) {
          double* row = T + r * nq;
          for (j = 0; j < nq; j++) row[j] = 0;
          for (c = 0; c < NX; c++) { double a = A[c * NX + r]; if (a != 0) for (j = 0; j < nq; j++) row[j] += a * S[c * nq + j]; }
          for (c = 0; c < NP; c++) { double b = B[c * NX + r]; if (b != 0) for (j = 0; j < nq; j++) row[j] += b * Pq[c * nq + j]; }
        }
        memcpy(S, T, NX * nq * sizeof(double));
      } else motorid_light(arg, res, iw, w, 0);
      if (E) for (r = 0; r < NX; r++) { double q = fabs(e[r]); if (!(q <= E[k * NX + r])) E[k * NX + r] = q; }
      memcpy(x, xn, sizeof(x));
    }
  }
  free(arg); free(res); free(iw); free(w);
  return bad;
}
"""


def cache_dir() -> Path:
    """Return the folder of compiled steps: ``$MOTORID_CACHE``, else the user's cache folder."""
    if os.environ.get("MOTORID_CACHE"):
        return Path(os.environ["MOTORID_CACHE"])
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "motorid"


@lru_cache(maxsize=1)
def compiler() -> tuple[str, str] | None:
    """Return (path, version line) of a C compiler, or None; ``$MOTORID_CC`` names one, ``none`` forbids it."""
    wanted = os.environ.get("MOTORID_CC")
    if wanted == "none" or sys.platform == "win32":
        return None
    for name in (wanted,) if wanted else ("cc", "gcc", "clang"):
        path = shutil.which(name)
        if path:
            try:
                done = subprocess.run([path, "--version"], capture_output=True, text=True, timeout=20, check=True)
            except (OSError, subprocess.SubprocessError):
                continue
            return path, (done.stdout.splitlines() or [""])[0]
    return None


def say_once(text: str) -> None:
    """Print one line on standard error, the first time only."""
    if text not in _told:
        _told.add(text)
        print(text, file=sys.stderr)


def generate(functions: StepFunctions) -> str:
    """Return the C source of the step functions and the driver."""
    code = ca.CodeGenerator("motorid_code", {"casadi_int": "long long", "with_header": False})
    for f in functions:
        code.add(f)
    f = functions.full
    sizes = {"NX": f.size1_in(0), "NU": f.size1_in(1), "NP": f.size1_in(4), "NY": functions.out.size1_out(0)}
    return code.dump() + "".join(f"#define {k} {max(v, 1)}\n" for k, v in sizes.items()) + DRIVER


def library_path(key: str) -> Path | None:
    """Return where the library of the content `key` is or would be; None without a compiler."""
    cc = compiler()
    if cc is None:
        return None
    mark = hashlib.sha256("\0".join([key, *cc, *FLAGS, DRIVER, platform.machine(), ca.__version__]).encode())
    return cache_dir() / f"step-{mark.hexdigest()[:32]}.so"


def build(functions: StepFunctions, path: Path) -> bool:
    """Compile into `path`, atomically; False (said once) if that does not work."""
    cc = compiler()
    if cc is None:
        return False
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            source, target = Path(folder) / "step.c", Path(folder) / "step.so"
            source.write_text(generate(functions))
            done = subprocess.run([cc[0], *FLAGS, str(source), "-o", str(target), "-lm"], capture_output=True,
                                  text=True, timeout=300)
            if done.returncode:
                first = (done.stderr.splitlines() or ["no message"])[0]
                say_once(f"motorid: the C compiler failed ({first}); going on with CasADi's virtual machine, slower.")
                return False
            os.replace(target, path)
    except (OSError, subprocess.SubprocessError) as error:
        say_once(f"motorid: cannot compile ({error}); going on with CasADi's virtual machine, slower.")
        return False
    return True


def load(path: Path) -> ctypes._CFuncPtr | None:
    """Return the driver in the library at `path`, or None if it cannot be loaded."""
    try:
        run = ctypes.CDLL(str(path)).motorid_run
    except (OSError, AttributeError):
        path.unlink(missing_ok=True)  # a damaged file would fail for ever
        return None
    pointer, integer = ctypes.c_void_p, ctypes.c_longlong
    run.restype = integer
    run.argtypes = [integer, *[pointer] * 7, integer, *[pointer] * 7]
    return run
