/* The limit for a fit: a program for this motor alone, compiled by `peers.py`.

   L di/dt = v - R i - K w,  J dw/dt = K i - b w - tau_c tanh(w / width), from rest, the voltage constant between samples.

   While the friction keeps its full size, a sample is one step, which is exact: the exponential of the linear motor with
   its derivatives (scaling and squaring). Where the speed goes through zero, short steps of an L-stable Runge-Kutta
   method of order 2 (Alexander, SIAM J. Numer. Anal. 14(6), 1977) with the derivatives of the step. Least squares by
   Levenberg-Marquardt in the logarithms of R, L, K, b, J and, if there is friction, tau_c. */
#include <math.h>
#include <string.h>

enum { P = 6 };
static const double GAMMA = 0.29289321881345254; /* 1 - sqrt(1/2) */

typedef struct { double x[2], s[2][P]; } State;             /* (i, omega) and its derivatives by the logarithms */
typedef struct { double e[2][4], d[2][4][P]; } Exact;       /* (i, omega) from (i, omega, v, sgn), one sample later */
typedef struct { double r, l, k, b, j, tau, width; } Motor;

static void product(double out[4][4], double a[4][4], double b[4][4], double c[4][4], double d[4][4], double by)
{ /* out = (a b + c d) by; c may be absent */
    double sum[4][4];
    for (int m = 0; m < 4; m++)
        for (int n = 0; n < 4; n++) {
            double s = 0;
            for (int q = 0; q < 4; q++) s += a[m][q] * b[q][n] + (c ? c[m][q] * d[q][n] : 0);
            sum[m][n] = s * by;
        }
    memcpy(out, sum, sizeof sum);
}

static void discretise(const Motor *m, double dt, Exact *out)
{
    double a[4][4] = {{-m->r / m->l, -m->k / m->l, 1 / m->l, 0}, {m->k / m->j, -m->b / m->j, 0, -m->tau / m->j}};
    double da[P][4][4] = {0}, term[4][4] = {0}, dterm[P][4][4] = {0}, e[4][4], de[P][4][4] = {0}, norm = 0;
    da[0][0][0] = a[0][0], da[2][0][1] = a[0][1], da[2][1][0] = a[1][0], da[3][1][1] = a[1][1], da[5][1][3] = a[1][3];
    for (int n = 0; n < 4; n++) da[1][0][n] = -a[0][n], da[4][1][n] = -a[1][n];
    for (int n = 0; n < 8; n++) norm += fabs(a[n / 4][n % 4]) * dt;
    int halvings = 0;
    while (norm > 0.5 && halvings < 60) norm /= 2, dt /= 2, halvings++;
    for (int n = 0; n < 4; n++) term[n][n] = 1;
    memcpy(e, term, sizeof e);
    for (int n = 1; n <= 11; n++) {
        for (int p = 0; p < P; p++) product(dterm[p], dterm[p], a, term, da[p], dt / n);
        product(term, term, a, 0, 0, dt / n);
        for (int c = 0; c < 16; c++) {
            e[c / 4][c % 4] += term[c / 4][c % 4];
            for (int p = 0; p < P; p++) de[p][c / 4][c % 4] += dterm[p][c / 4][c % 4];
        }
    }
    while (halvings--) {
        for (int p = 0; p < P; p++) product(de[p], de[p], e, e, de[p], 1);
        product(e, e, e, 0, 0, 1);
    }
    for (int c = 0; c < 8; c++) {
        out->e[c / 4][c % 4] = e[c / 4][c % 4];
        for (int p = 0; p < P; p++) out->d[c / 4][c % 4][p] = de[p][c / 4][c % 4];
    }
}

static void exact_step(const Exact *m, double v, double sign, const State *at, State *to)
{
    double z[4] = {at->x[0], at->x[1], v, sign};
    for (int r = 0; r < 2; r++) {
        double x = 0;
        for (int c = 0; c < 4; c++) x += m->e[r][c] * z[c];
        to->x[r] = x;
        for (int p = 0; p < P; p++)
            to->s[r][p] = m->e[r][0] * at->s[0][p] + m->e[r][1] * at->s[1][p] + m->d[r][0][p] * z[0]
                          + m->d[r][1][p] * z[1] + m->d[r][2][p] * z[2] + m->d[r][3][p] * z[3];
    }
}

static int stage(const Motor *m, double v, double h, const State *from, State *y, State *slope)
{ /* y = from + h f(y) by Newton's method, with its derivatives and the slope's; 0 if it does not converge */
    double f[2], a[2][2], det = 1, th = 0;
    *y = *from;
    for (int n = 0, last = 0; n < 25; n++) {
        th = tanh(y->x[1] / m->width);
        f[0] = (v - m->r * y->x[0] - m->k * y->x[1]) / m->l;
        f[1] = (m->k * y->x[0] - m->b * y->x[1] - m->tau * th) / m->j;
        a[0][0] = 1 + h * m->r / m->l, a[0][1] = h * m->k / m->l, a[1][0] = -h * m->k / m->j;
        a[1][1] = 1 + h * (m->b + m->tau * (1 - th * th) / m->width) / m->j;
        det = a[0][0] * a[1][1] - a[0][1] * a[1][0];
        if (last) break;
        double g0 = y->x[0] - from->x[0] - h * f[0], g1 = y->x[1] - from->x[1] - h * f[1];
        double d0 = (a[1][1] * g0 - a[0][1] * g1) / det, d1 = (a[0][0] * g1 - a[1][0] * g0) / det;
        y->x[0] -= d0, y->x[1] -= d1;
        last = fabs(d0) < 1e-9 * (1 + fabs(y->x[0])) && fabs(d1) < 1e-9 * (m->width + fabs(y->x[1]));
        if (!last && n == 23) return 0;
    }
    double own[2][P] = {{-m->r * y->x[0] / m->l, -f[0], -m->k * y->x[1] / m->l},
                        {0, 0, m->k * y->x[0] / m->j, -m->b * y->x[1] / m->j, -f[1], -m->tau * th / m->j}};
    for (int p = 0; p < P; p++) {
        double g0 = from->s[0][p] + h * own[0][p], g1 = from->s[1][p] + h * own[1][p];
        y->s[0][p] = (a[1][1] * g0 - a[0][1] * g1) / det, y->s[1][p] = (a[0][0] * g1 - a[1][0] * g0) / det;
    }
    for (int r = 0; r < 2; r++) {
        slope->x[r] = (y->x[r] - from->x[r]) / h;
        for (int p = 0; p < P; p++) slope->s[r][p] = (y->s[r][p] - from->s[r][p]) / h;
    }
    return 1;
}

static int short_steps(const Motor *m, double v, double dt, State *x)
{ /* one sample in steps that change the speed by a quarter of itself, at most; 0 if none is short enough */
    for (double left = dt, h; left > 0; left -= h) {
        double rate = fabs((m->k * x->x[0] - m->b * x->x[1] - m->tau * tanh(x->x[1] / m->width)) / m->j);
        h = fmin(dt / 8, 0.25 * (fabs(x->x[1]) + m->width) / (rate + 1e-30));
        h = h > 0.7 * left ? left : h;
        for (;; h /= 2) {
            State y, slope, second = *x;
            if (h < 1e-9 * dt) return 0;
            if (!stage(m, v, GAMMA * h, x, &y, &slope)) continue;
            for (int c = 0; c < 2 + 2 * P; c++) ((double *)&second)[c] += (1 - GAMMA) * h * ((double *)&slope)[c];
            if (stage(m, v, GAMMA * h, &second, &y, &slope)) { *x = y; break; }
        }
    }
    return 1;
}

static double normal_equations(int runs, const int *n, const double *v, const double *y, double dt, const double *sigma,
                               double width, const double *p, double h[P][P], double g[P])
{ /* chi2, with h = J'J and g = J'r */
    Motor m = {p[0], p[1], p[2], p[3], p[4], p[5], width};
    Exact exact;
    double chi2 = 0;
    discretise(&m, dt, &exact);
    memset(h, 0, P * sizeof h[0]), memset(g, 0, P * sizeof *g);
    for (int run = 0; run < runs; v += n[run], y += 2 * n[run], run++) {
        State x = {0}, next;
        for (int k = 0; k < n[run]; k++) {
            for (int c = 0; c < 2; c++) {
                double r = (x.x[c] - y[2 * k + c]) / sigma[c], s[P];
                chi2 += r * r;
                for (int a = 0; a < P; a++) s[a] = x.s[c][a] / sigma[c], g[a] += s[a] * r;
                for (int a = 0; a < P; a++)
                    for (int b = 0; b <= a; b++) h[a][b] += s[a] * s[b];
            }
            double sign = m.tau > 0 ? copysign(1, x.x[1]) : 0, clear = 20 * width;
            if (sign == 0 || fabs(x.x[1]) > clear) {
                exact_step(&exact, v[k], sign, &x, &next);
                if (sign == 0 || sign * next.x[1] > clear) { x = next; continue; }
            }
            if (!short_steps(&m, v[k], dt, &x)) return NAN;
        }
    }
    return chi2;
}

static void solve(int np, double h[P][P], const double g[P], double damping, double d[P])
{ /* d = -(h + damping diag h)^-1 g by Cholesky's method */
    double l[P][P];
    for (int a = 0; a < np; a++) {
        d[a] = -g[a];
        for (int b = 0; b <= a; b++) {
            double s = h[a][b] * (a == b ? 1 + damping : 1);
            for (int c = 0; c < b; c++) s -= l[a][c] * l[b][c];
            l[a][b] = a == b ? sqrt(s) : s / l[b][b];
        }
        for (int b = 0; b < a; b++) d[a] -= l[a][b] * d[b];
        d[a] /= l[a][a];
    }
    for (int a = np - 1; a >= 0; a--) {
        for (int b = a + 1; b < np; b++) d[a] -= l[b][a] * d[b];
        d[a] /= l[a][a];
    }
}

/* p: the start, and the estimate; tau_c = 0: no friction. v: all runs, one after the other; y: (i, omega) per sample. */
int fit(int runs, const int *n, const double *v, const double *y, double dt, const double *sigma, double width, double *p)
{
    double h[P][P], g[P], h2[P][P], g2[P], d[P], q[P] = {0}, damping = 1e-3;
    double chi2 = normal_equations(runs, n, v, y, dt, sigma, width, p, h, g);
    int tried = 0;
    while (++tried < 200 && damping < 1e12) {
        solve(p[5] > 0 ? 6 : 5, h, g, damping, d);
        for (int a = 0; a < 5 + (p[5] > 0); a++) q[a] = p[a] * exp(fmax(-1, fmin(1, d[a])));
        double now = normal_equations(runs, n, v, y, dt, sigma, width, q, h2, g2);
        if (!(now < chi2)) {
            if (fabs(now - chi2) < 1e-9 * chi2) break;
            damping *= 8;
            continue;
        }
        double fell = chi2 - now;
        memcpy(p, q, sizeof q), memcpy(h, h2, sizeof h), memcpy(g, g2, sizeof g);
        chi2 = now, damping /= 8;
        if (fell < 1e-9 * chi2) break;
    }
    return tried;
}
