/* Model exchange of FMI 3.0 around acceleration(q, dq, u), which CasADi has written above this text.
   Value references: 0 time, then u (N_U), q (N_Q), dq (N_Q), der(q) (N_Q), ddq (N_Q). */

#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if defined _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif
#define N_X (2 * N_Q)
#define STATE (1 + N_U)

enum { OK = 0, ERROR = 3 };

typedef struct {
  double t, u[N_U + 1], x[N_X], dx[N_X];
} Arm;

static int evaluate(Arm *arm) {
  const double *arg[SZ_ARG + 1] = {arm->x, arm->x + N_Q, arm->u};
  double *res[SZ_RES + 1] = {arm->dx + N_Q};
  long long int iw[SZ_IW + 1];
  double w[SZ_W + 1];
  memcpy(arm->dx, arm->x + N_Q, N_Q * sizeof(double));
  return excite_acceleration(arg, res, iw, w, 0) ? ERROR : OK;
}

EXPORT const char *fmi3GetVersion(void) { return "3.0"; }

EXPORT void *fmi3InstantiateModelExchange(const char *name, const char *token, const char *resources, int visible,
                                          int logging, void *environment, void *log) {
  static const double start[N_X + 1] = START;
  Arm *arm = strcmp(token, TOKEN) ? NULL : calloc(1, sizeof(Arm));
  if (arm) memcpy(arm->x, start, sizeof arm->x);
  return arm;
}

EXPORT void fmi3FreeInstance(void *arm) { free(arm); }

EXPORT int fmi3Reset(void *instance) {
  static const double start[N_X + 1] = START;
  Arm *arm = instance;
  memset(arm, 0, sizeof *arm);
  memcpy(arm->x, start, sizeof arm->x);
  return OK;
}

EXPORT int fmi3SetTime(void *arm, double t) {
  ((Arm *)arm)->t = t;
  return OK;
}

EXPORT int fmi3GetFloat64(void *instance, const uint32_t references[], size_t n, double values[], size_t n_values) {
  Arm *arm = instance;
  if (n != n_values || evaluate(arm)) return ERROR;
  for (size_t k = 0; k < n; k++) {
    uint32_t r = references[k];
    if (r >= STATE + 2 * N_X) return ERROR;
    values[k] = r == 0 ? arm->t : r < STATE ? arm->u[r - 1] : r < STATE + N_X ? arm->x[r - STATE] : arm->dx[r - STATE - N_X];
  }
  return OK;
}

EXPORT int fmi3SetFloat64(void *instance, const uint32_t references[], size_t n, const double values[], size_t n_values) {
  Arm *arm = instance;
  if (n != n_values) return ERROR;
  for (size_t k = 0; k < n; k++) {
    uint32_t r = references[k];
    if (r == 0 || r >= STATE + N_X) return ERROR;
    if (r < STATE) arm->u[r - 1] = values[k];
    else arm->x[r - STATE] = values[k];
  }
  return OK;
}

EXPORT int fmi3SetContinuousStates(void *arm, const double x[], size_t n) {
  if (n != N_X) return ERROR;
  memcpy(((Arm *)arm)->x, x, sizeof ((Arm *)arm)->x);
  return OK;
}

EXPORT int fmi3GetContinuousStates(void *arm, double x[], size_t n) {
  if (n != N_X) return ERROR;
  memcpy(x, ((Arm *)arm)->x, sizeof ((Arm *)arm)->x);
  return OK;
}

EXPORT int fmi3GetContinuousStateDerivatives(void *arm, double dx[], size_t n) {
  if (n != N_X || evaluate(arm)) return ERROR;
  memcpy(dx, ((Arm *)arm)->dx, sizeof ((Arm *)arm)->dx);
  return OK;
}

EXPORT int fmi3GetNominalsOfContinuousStates(void *arm, double nominals[], size_t n) {
  for (size_t k = 0; k < n; k++) nominals[k] = 1.0;
  return n == N_X ? OK : ERROR;
}

EXPORT int fmi3GetNumberOfContinuousStates(void *arm, size_t *n) {
  *n = N_X;
  return OK;
}

EXPORT int fmi3GetNumberOfEventIndicators(void *arm, size_t *n) {
  *n = 0;
  return OK;
}

EXPORT int fmi3GetEventIndicators(void *arm, double indicators[], size_t n) { return n ? ERROR : OK; }

EXPORT int fmi3CompletedIntegratorStep(void *arm, _Bool unchanged, _Bool *event, _Bool *terminate) {
  *event = *terminate = 0;
  return OK;
}

EXPORT int fmi3UpdateDiscreteStates(void *arm, _Bool *again, _Bool *terminate, _Bool *nominals, _Bool *states,
                                    _Bool *timed, double *next) {
  *again = *terminate = *nominals = *states = *timed = 0;
  *next = 0;
  return OK;
}

EXPORT int fmi3EnterInitializationMode(void *arm, _Bool defined, double tolerance, double start, _Bool stops, double stop) {
  ((Arm *)arm)->t = start;
  return OK;
}

/* Changes of mode that need nothing. */
#define DONE(name) EXPORT int name(void *arm) { return OK; }
DONE(fmi3ExitInitializationMode) DONE(fmi3EnterEventMode) DONE(fmi3EnterContinuousTimeMode) DONE(fmi3Terminate)
DONE(fmi3SetDebugLogging)

/* Functions of the standard for what this model has not. */
#define NONE(name) EXPORT void *name(void) { return NULL; }
#define ABSENT(name) EXPORT int name(void) { return ERROR; }
#define BOTH(type) ABSENT(fmi3Get##type) ABSENT(fmi3Set##type)
NONE(fmi3InstantiateCoSimulation) NONE(fmi3InstantiateScheduledExecution)
BOTH(Float32) BOTH(Int8) BOTH(UInt8) BOTH(Int16) BOTH(UInt16) BOTH(Int32) BOTH(UInt32) BOTH(Int64) BOTH(UInt64)
BOTH(Boolean) BOTH(String) BOTH(Binary) BOTH(Clock) BOTH(FMUState) BOTH(IntervalDecimal) BOTH(IntervalFraction)
BOTH(ShiftDecimal) BOTH(ShiftFraction)
ABSENT(fmi3GetNumberOfVariableDependencies) ABSENT(fmi3GetVariableDependencies) ABSENT(fmi3FreeFMUState)
ABSENT(fmi3SerializedFMUStateSize) ABSENT(fmi3SerializeFMUState) ABSENT(fmi3DeserializeFMUState)
ABSENT(fmi3GetDirectionalDerivative) ABSENT(fmi3GetAdjointDerivative) ABSENT(fmi3EnterConfigurationMode)
ABSENT(fmi3ExitConfigurationMode) ABSENT(fmi3EvaluateDiscreteStates) ABSENT(fmi3EnterStepMode)
ABSENT(fmi3GetOutputDerivatives) ABSENT(fmi3DoStep) ABSENT(fmi3ActivateModelPartition)
