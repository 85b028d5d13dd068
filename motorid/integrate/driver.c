/* Walks over a record with the code of one step, of any system. Built once, and so for speed: its loops over the unknowns
   are worth a vector unit. The code of a step gains nothing by that, and takes longer to compile. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

/* Of scalar functions in CasADi: they need no work space. */
typedef int (*code)(const double** arg, double** res, long long* iw, double* w, int mem);

/* out = A S + B Pq; A and B column-major with `rows` rows, Pq by its nonzeros, mostly one per unknown. */
static void propagate(double* out, long long rows, long long nx, const double* A, const double* B, const double* S,
                      long long nq, long long nz, const long long* param, const long long* unknown, const double* slope) {
  long long j, r, c;
  memset(out, 0, rows * nq * sizeof(double));
  for (r = 0; r < rows; r++) {
    double *row = out + r * nq, direct = 0;
    for (c = 0; c < nx; c++) {
      double a = A[c * rows + r];
      const double* other = S + c * nq;
      if (a != 0) for (j = 0; j < nq; j++) row[j] += a * other[j];
    }
    for (j = 0; j < nz; j++) {
      direct += B[param[j] * rows + r] * slope[j];
      if (j + 1 < nz && unknown[j + 1] == unknown[j]) continue;
      row[unknown[j]] += direct; direct = 0;
    }
  }
}

/* Length and inputs of sub-step s of m in interval k. */
static void part(long long k, long long s, long long m, long long nu, const double* dt, const double* u0, const double* u1,
                 double* ua, double* ub, double* h) {
  long long c;
  double share = 1.0 / m, slope;
  *h = dt[k] * share;
  for (c = 0, u0 += k * nu, u1 += k * nu; c < nu; c++) {
    slope = (u1[c] - u0[c]) * share; ua[c] = u0[c] + slope * s; ub[c] = ua[c] + slope;
  }
}

/* x over one record, E: the largest error estimate in each interval, without S0; returns -1, or the index of the first
   sample whose state is not finite. */
long long motorid_run(long long nx, long long nu, long long np, long long ny, code light, code full, code out,
                      long long n, const long long* nsub, const double* dt, const double* u0, const double* u1,
                      const double* us, const double* x0, const double* p, long long nq, const double* S0,
                      const double* Pq, double* Y, double* DY, double* X, double* DX, double* E) {
  const double* arg[5];
  double *res[3], *S = malloc((2 * nx * nq + 1) * sizeof(double)), *T = S + nx * nq, *both = S;
  long long nz = 0, *param = malloc((2 * np * nq + 1) * sizeof(long long)), *unknown = param + np * nq;
  double* slope = malloc((np * nq + 1) * sizeof(double));
  double pair[2 * nx], *x = pair, *xn = pair + nx, e[nx], h, A[nx * nx], B[nx * np], ua[nu], ub[nu];
  double C[ny * nx], D[ny * np];
  long long k, s, r, bad = -1;
  memcpy(x, x0, nx * sizeof(double));
  if (nq) memcpy(S, S0, nx * nq * sizeof(double));
  for (k = 0; k < np * nq; k++) if (Pq[k % np * nq + k / np] != 0) {
    param[nz] = k % np; unknown[nz] = k / np; slope[nz++] = Pq[k % np * nq + k / np];
  }
  for (k = 0; k < n; k++) {
    for (r = 0; r < nx; r++) if (!isfinite(x[r])) bad = k;
    if (bad >= 0) break;
    if (X) for (r = 0; r < nx; r++) X[k * nx + r] = x[r];
    if (DX) memcpy(DX + k * nx * nq, S, nx * nq * sizeof(double));
    arg[0] = x; arg[1] = us + k * nu; arg[2] = p;
    res[0] = Y + k * ny; res[1] = C; res[2] = D;
    out(arg, res, 0, 0, 0);
    if (nq) propagate(DY + k * ny * nq, ny, nx, C, D, S, nq, nz, param, unknown, slope);
    if (k == n - 1) break;
    if (E) for (r = 0; r < nx; r++) E[k * nx + r] = 0;
    for (s = 0; s < nsub[k]; s++) {
      double *old = x, *before = S;
      part(k, s, nsub[k], nu, dt, u0, u1, ua, ub, &h);
      arg[0] = x; arg[1] = ua; arg[2] = ub; arg[3] = &h; arg[4] = p;
      res[0] = xn; res[1] = nq ? A : e; res[2] = B;
      if (nq) {
        full(arg, res, 0, 0, 0);
        propagate(T, nx, nx, A, B, S, nq, nz, param, unknown, slope);
        S = T; T = before;
      } else light(arg, res, 0, 0, 0);
      if (E) for (r = 0; r < nx; r++) { double q = fabs(e[r]); if (!(q <= E[k * nx + r])) E[k * nx + r] = q; }
      x = xn; xn = old;
    }
  }
  free(both); free(param); free(slope);
  return bad;
}

/* Where intervals `rows` end from X in half the steps. */
void motorid_halved(long long nx, long long nu, code light, long long n, const long long* rows, const long long* nsub,
                    const double* dt, const double* u0, const double* u1, const double* X, const double* p,
                    double* ends) {
  const double* arg[5];
  double *res[2], x[nx], e[nx], h, ua[nu], ub[nu];
  long long j, s, r;
  for (j = 0; j < n; j++, ends += nx) {
    long long k = rows[j], m = 2 * nsub[k];
    for (r = 0; r < nx; r++) x[r] = X[k * nx + r];
    for (s = 0; s < m; s++) {
      part(k, s, m, nu, dt, u0, u1, ua, ub, &h);
      arg[0] = x; arg[1] = ua; arg[2] = ub; arg[3] = &h; arg[4] = p;
      res[0] = ends; res[1] = e;
      light(arg, res, 0, 0, 0);
      for (r = 0; r < nx; r++) x[r] = ends[r];
    }
  }
}
