#include <math.h>
#include <stdlib.h>
#include <string.h>

/* Its loops over the unknowns are all that is worth a vector unit; the code of a step gains nothing, and takes longer to
   compile. */
#if defined(__GNUC__) && !defined(__clang__)
#define FAST __attribute__((optimize("O3", "fp-contract=off")))
#else
#define FAST
#endif

/* out = A S + B Pq; A and B column-major with `rows` rows, Pq by its nonzeros, mostly one per unknown. */
FAST static void propagate(double* out, int rows, const double* A, const double* B, const double* S, long long nq,
                           long long nz, const long long* param, const long long* unknown, const double* slope) {
  long long j;
  int r, c;
  memset(out, 0, rows * nq * sizeof(double));
  for (r = 0; r < rows; r++) {
    double *row = out + r * nq, direct = 0;
    for (c = 0; c < NX; c++) {
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
static void part(long long k, long long s, long long m, const double* dt, const double* u0, const double* u1,
                 double* ua, double* ub, double* h) {
  int c;
  double share = 1.0 / m, slope;
  *h = dt[k] * share;
  for (c = 0, u0 += k * NU, u1 += k * NU; c < NU; c++) {
    slope = (u1[c] - u0[c]) * share; ua[c] = u0[c] + slope * s; ub[c] = ua[c] + slope;
  }
}

/* x over one record, E: the largest error estimate in each interval, without S0; returns -1, or the index of the first
   sample whose state is not finite. */
long long motorid_run(long long n, const long long* nsub, const double* dt, const double* u0, const double* u1,
                      const double* us, const double* x0, const double* p, long long nq, const double* S0,
                      const double* Pq, double* Y, double* DY, double* X, double* DX, double* E) {
  const double* arg[N_ARG];
  double *res[N_RES], w[N_W], *S = malloc((2 * NX * nq + 1) * sizeof(double)), *T = S + NX * nq, *both = S;
  casadi_int iw[N_IW];
  long long nz = 0, *param = malloc((2 * NP * nq + 1) * sizeof(long long)), *unknown = param + NP * nq;
  double* slope = malloc((NP * nq + 1) * sizeof(double));
  double x[NX], xn[NX], e[NX], h, A[NX * NX], B[NX * NP], ua[NU], ub[NU], y[NY], C[NY * NX], D[NY * NP];
  long long k, s, bad = -1;
  memcpy(x, x0, sizeof(x));
  if (nq) memcpy(S, S0, NX * nq * sizeof(double));
  for (k = 0; k < NP * nq; k++) if (Pq[k % NP * nq + k / NP] != 0) {
    param[nz] = k % NP; unknown[nz] = k / NP; slope[nz++] = Pq[k % NP * nq + k / NP];
  }
  for (k = 0; k < n; k++) {
    int r, c;
    for (r = 0; r < NX; r++) if (!isfinite(x[r])) bad = k;
    if (bad >= 0) break;
    if (X) memcpy(X + k * NX, x, sizeof(x));
    if (DX) memcpy(DX + k * NX * nq, S, NX * nq * sizeof(double));
    arg[0] = x; arg[1] = us + k * NU; arg[2] = p;
    res[0] = y; res[1] = nq ? C : 0; res[2] = nq ? D : 0;
    motorid_out(arg, res, iw, w, 0);
    memcpy(Y + k * NY, y, sizeof(y));
    if (nq) propagate(DY + k * NY * nq, NY, C, D, S, nq, nz, param, unknown, slope);
    if (k == n - 1) break;
    if (E) memset(E + k * NX, 0, NX * sizeof(double));
    for (s = 0; s < nsub[k]; s++) {
      part(k, s, nsub[k], dt, u0, u1, ua, ub, &h);
      arg[0] = x; arg[1] = ua; arg[2] = ub; arg[3] = &h; arg[4] = p;
      res[0] = xn; res[1] = nq ? A : e; res[2] = B;
      if (nq) {
        motorid_full(arg, res, iw, w, 0);
        propagate(T, NX, A, B, S, nq, nz, param, unknown, slope);
        double* old = S; S = T; T = old;
      } else motorid_light(arg, res, iw, w, 0);
      if (E) for (r = 0; r < NX; r++) { double q = fabs(e[r]); if (!(q <= E[k * NX + r])) E[k * NX + r] = q; }
      memcpy(x, xn, sizeof(x));
    }
  }
  free(both); free(param); free(slope);
  return bad;
}

/* Where intervals `rows` end from X in half the steps. */
void motorid_halved(long long n, const long long* rows, const long long* nsub, const double* dt, const double* u0,
                    const double* u1, const double* X, const double* p, double* ends) {
  const double* arg[N_ARG];
  double *res[N_RES], w[N_W], x[NX], h, ua[NU], ub[NU];
  casadi_int iw[N_IW];
  long long j, s;
  for (j = 0; j < n; j++, ends += NX) {
    long long k = rows[j], m = 2 * nsub[k];
    memcpy(x, X + k * NX, sizeof(x));
    for (s = 0; s < m; s++) {
      part(k, s, m, dt, u0, u1, ua, ub, &h);
      arg[0] = x; arg[1] = ua; arg[2] = ub; arg[3] = &h; arg[4] = p;
      res[0] = ends; res[1] = 0;
      motorid_light(arg, res, iw, w, 0);
      memcpy(x, ends, sizeof(x));
    }
  }
}
