/* $title
 *
$about
 */
#ifndef ${NAME}_H
#define ${NAME}_H

#ifdef __cplusplus
extern "C" {
#endif

/* States x, inputs u, outputs y, parameters p: SI units, in this order. */
$sizes

extern const char* const ${name}_state_names[${NAME}_NX];
extern const char* const ${name}_input_names[${NAME}_NU];
extern const char* const ${name}_output_names[${NAME}_NY];
extern const char* const ${name}_parameter_names[${NAME}_NP];
extern const double ${name}_parameters[${NAME}_NP];
extern const int ${name}_held[${NAME}_NU]; /* 1: the input stays constant between samples, 0: straight lines */
$starts_declared
/* x at the start from s = (current, speed, angle) there. */
void ${name}_initial(const double s[3], const double* p, double* x);
/* dx/dt; of a balance without storage, the balance itself. */
void ${name}_rhs(const double* x, const double* u, const double* p, double* dx);
/* What the sensors show. */
void ${name}_outputs(const double* x, const double* u, const double* p, double* y);
/* x over dt in equal sub-steps, the input running from u0 to u1; with substeps < 1 as many as ${NAME}_SUBSTEPS in
 * ${NAME}_DT seconds. The step is L-stable, but quick states (bristles, a small inductance) need short ones:
 * $checked */
#define ${NAME}_DT $dt
#define ${NAME}_SUBSTEPS $substeps
void ${name}_step(double* x, const double* u0, const double* u1, double dt, int substeps, const double* p);

#ifdef __cplusplus
}
#endif
#endif
