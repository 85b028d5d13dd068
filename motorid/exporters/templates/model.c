/* $title, written by motorid */
$generated
#include "$name.h"

const char* const ${name}_state_names[${NAME}_NX] = {$states};
const char* const ${name}_input_names[${NAME}_NU] = {$inputs};
const char* const ${name}_output_names[${NAME}_NY] = {$outputs};
const char* const ${name}_parameter_names[${NAME}_NP] = {$parameter_names};
const double ${name}_parameters[${NAME}_NP] = {
  $parameters
};
const int ${name}_held[${NAME}_NU] = {$held};
$starts
static void ${name}_call(int (*f)(const double**, double**, int*, double*, int), const double** given, int n_given,
                        double* result, double* other) {
  const double* arg[$sz_arg];
  double* res[$sz_res];
  int iw[$sz_iw];
  double w[$sz_w];
  int k;
  for (k = 0; k < $sz_arg; k++) arg[k] = k < n_given ? given[k] : 0;
  for (k = 0; k < $sz_res; k++) res[k] = 0;
  res[0] = result;
  res[1] = other;
  f(arg, res, iw, w, 0);
}

void ${name}_initial(const double s[3], const double* p, double* x) {
  const double* given[2];
  given[0] = s; given[1] = p;
  ${name}_call(${name}_f_initial, given, 2, x, 0);
}

void ${name}_rhs(const double* x, const double* u, const double* p, double* dx) {
  const double* given[3];
  given[0] = x; given[1] = u; given[2] = p;
  ${name}_call(${name}_f_rhs, given, 3, dx, 0);
}

void ${name}_outputs(const double* x, const double* u, const double* p, double* y) {
  const double* given[3];
  given[0] = x; given[1] = u; given[2] = p;
  ${name}_call(${name}_f_outputs, given, 3, y, 0);
}

void ${name}_step(double* x, const double* u0, const double* u1, double dt, int substeps, const double* p) {
  double a[${NAME}_NU], b[${NAME}_NU], next[${NAME}_NX], error[${NAME}_NX], h;
  const double* given[5];
  int s, j;
  if (substeps < 1) substeps = (int)(dt / ${NAME}_DT * ${NAME}_SUBSTEPS + 0.999);
  if (substeps < 1) substeps = 1;
  h = dt / substeps;
  for (s = 0; s < substeps; s++) {
    for (j = 0; j < ${NAME}_NU; j++) {
      a[j] = u0[j] + (u1[j] - u0[j]) * s / substeps;
      b[j] = u0[j] + (u1[j] - u0[j]) * (s + 1) / substeps;
    }
    given[0] = x; given[1] = a; given[2] = b; given[3] = &h; given[4] = p;
    ${name}_call(${name}_f_step, given, 5, next, error);
    for (j = 0; j < ${NAME}_NX; j++) x[j] = next[j];
  }
}
