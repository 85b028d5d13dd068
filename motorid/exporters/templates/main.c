/* Example, written by motorid: walk the model over a record.
 *
 *   cc -O2 ${name}_main.c $name.c -lm -o $name
 *   ./$name RECORD.csv [RUN] > out.csv
 *
 * RECORD.csv has one heading line, then per sample: time (s), the inputs, and the sub-steps to the next sample.
 * RUN counts the records of the fit from 0; it picks the state at the start (all zero where there is none), and the
 * parameters that this record has for itself.
 */
#include <stdio.h>
#include <stdlib.h>
#include "$name.h"

static int read_row(FILE* file, double* t, double* u, int* substeps) {
  int j;
  if (fscanf(file, "%lf", t) != 1) return 0;
  for (j = 0; j < ${NAME}_NU; j++) if (fscanf(file, " ,%lf", &u[j]) != 1) return 0;
  return fscanf(file, " ,%d", substeps) == 1 && *substeps > 0;
}

int main(int argc, char** argv) {
  double s[3] = {0, 0, 0}, x[${NAME}_NX], y[${NAME}_NY], u[${NAME}_NU], v[${NAME}_NU], t, later;
  const double* p = ${name}_parameters;
  int run = argc > 2 ? atoi(argv[2]) : 0, m, next, j, c;
  FILE* file = argc > 1 ? fopen(argv[1], "r") : 0;
  if (!file) { fprintf(stderr, "usage: %s RECORD.csv [RUN]\n", argv[0]); return 2; }
  while ((c = fgetc(file)) != '\n' && c != EOF) {}
#ifdef ${NAME}_RUNS
  if (run < 0 || run >= ${NAME}_RUNS) { fprintf(stderr, "runs are 0 to %d\n", ${NAME}_RUNS - 1); return 2; }
  for (j = 0; j < 3; j++) s[j] = ${name}_starts[run][j];
  p = ${name}_run_parameters[run];
#else
  (void)run;
#endif
  if (!read_row(file, &t, u, &m)) { fprintf(stderr, "%s has no rows of t, inputs, sub-steps\n", argv[1]); return 2; }
  ${name}_initial(s, p, x);
  printf("t");
  for (j = 0; j < ${NAME}_NY; j++) printf(",%s", ${name}_output_names[j]);
  for (;;) {
    ${name}_outputs(x, u, p, y);
    printf("\n%.17g", t);
    for (j = 0; j < ${NAME}_NY; j++) printf(",%.17g", y[j]);
    if (!read_row(file, &later, v, &next)) break;
    {
      double end[${NAME}_NU];
      for (j = 0; j < ${NAME}_NU; j++) end[j] = ${name}_held[j] ? u[j] : v[j];
      ${name}_step(x, u, end, later - t, m, p);
    }
    for (j = 0; j < ${NAME}_NU; j++) u[j] = v[j];
    t = later; m = next;
  }
  printf("\n");
  fclose(file);
  return 0;
}
