/*
 * Co-simulation unit around exported kernels: FMI 2.0 and FMI 3.0, of which a unit's description
 * names one. All variables are doubles; `model.h`, written with it, says how many there are.
 */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "model.h"

#define OK 0
#define DISCARD 2
#define ERROR 3
#define SLACK 1e-6 /* of a tick: what a master's sum of times may be off */

typedef void (*logger3)(void *environment, int status, const char *category, const char *message);
typedef void (*logger2)(void *environment, const char *instance, int status, const char *category,
                        const char *message, ...);

typedef struct {
    const void *logger;
    const void *allocate;
    const void *release;
    const void *finished;
    void *environment;
} callbacks2;

typedef struct {
    double values[EHA_VALUES];
    double memory[EHA_MEMORY];
    double time;
    int running; /* not 0: initialised: fixed parameters can no longer be set */
    void *environment;
    logger2 log2;
    logger3 log3;
} unit;

static const double starts[EHA_VALUES] = EHA_STARTS;
static const char fixed[EHA_PARAMETERS + 1] = EHA_FIXED; /* '1': not to be set in a run */

static int refuse(unit *u, int status, const char *why)
{
    if (u->log2 != NULL) {
        u->log2(u->environment, EHA_MODEL, status, "logStatusError", why);
    }
    if (u->log3 != NULL) {
        u->log3(u->environment, status, "logStatusError", why);
    }
    return status;
}

static int reset(unit *u)
{
    (void)memcpy(u->values, starts, sizeof starts);
    (void)memset(u->memory, 0, sizeof u->memory);
    u->time = 0.0;
    u->running = 0;
    return OK;
}

static unit *make(const char *token)
{
    unit *u;

    if (token == NULL || strcmp(token, EHA_TOKEN) != 0) {
        return NULL;
    }
    u = (unit *)calloc(1, sizeof *u);
    if (u != NULL) {
        (void)reset(u);
    }
    return u;
}

static int start(unit *u)
{
    if (eha_start(u->memory, u->values) != 0) {
        return refuse(u, ERROR, "a parameter is out of its range");
    }
    u->running = 1;
    return OK;
}

static int get(unit *u, const uint32_t *references, size_t count, double *values)
{
    for (size_t i = 0; i < count; ++i) {
        if (references[i] > EHA_VALUES) {
            return refuse(u, ERROR, "no variable of this reference");
        }
        values[i] = references[i] == EHA_VALUES ? u->time : u->values[references[i]];
    }
    return OK;
}

static int set(unit *u, const uint32_t *references, size_t count, const double *values)
{
    for (size_t i = 0; i < count; ++i) {
        if (references[i] >= EHA_PARAMETERS + EHA_INPUTS) {
            return refuse(u, ERROR, "not a parameter and not an input");
        }
        if (u->running != 0 && references[i] < EHA_PARAMETERS && fixed[references[i]] == '1') {
            return refuse(u, ERROR, "this parameter is fixed once the unit is initialised");
        }
        u->values[references[i]] = values[i];
    }
    return OK;
}

static int advance(unit *u, double now, double step)
{
    const double ticks = step / EHA_TICK;
    const double whole = nearbyint(ticks);

    if (u->running == 0) {
        return refuse(u, ERROR, "not initialised");
    }
    if (!(whole >= 1.0 && whole < 1e9 && fabs(ticks - whole) < SLACK)) {
        return refuse(u, DISCARD, "the step is not a whole number of control ticks");
    }
    for (double tick = 0.0; tick < whole; tick += 1.0) {
        if (eha_tick_once(u->memory, u->values) != 0) {
            return refuse(u, ERROR, "an input is no number, or a parameter is out of its range");
        }
    }
    u->time = now + step;
    return OK;
}

/* State of a unit: all that changes in a run, as bytes. */
typedef struct {
    double values[EHA_VALUES];
    double memory[EHA_MEMORY];
    double time;
    double running;
} state;

static int keep_state(const unit *u, void **kept)
{
    state *s = (state *)(*kept != NULL ? *kept : malloc(sizeof *s));

    if (s == NULL) {
        return ERROR;
    }
    (void)memcpy(s->values, u->values, sizeof s->values);
    (void)memcpy(s->memory, u->memory, sizeof s->memory);
    s->time = u->time;
    s->running = (double)u->running;
    *kept = s;
    return OK;
}

static int take_state(unit *u, const void *kept)
{
    const state *s = (const state *)kept;

    if (s == NULL) {
        return refuse(u, ERROR, "no state");
    }
    (void)memcpy(u->values, s->values, sizeof u->values);
    (void)memcpy(u->memory, s->memory, sizeof u->memory);
    u->time = s->time;
    u->running = s->running != 0.0;
    return OK;
}

static int free_state(void **kept)
{
    free(*kept);
    *kept = NULL;
    return OK;
}

static int write_state(unit *u, const void *kept, void *bytes, size_t size)
{
    if (kept == NULL || size < sizeof(state)) {
        return refuse(u, ERROR, "no state, or no room for it");
    }
    (void)memcpy(bytes, kept, sizeof(state));
    return OK;
}

static int read_state(unit *u, const void *bytes, size_t size, void **kept)
{
    if (size != sizeof(state)) {
        return refuse(u, ERROR, "these bytes are no state of this unit");
    }
    if (*kept == NULL) {
        *kept = malloc(sizeof(state));
    }
    if (*kept == NULL) {
        return ERROR;
    }
    (void)memcpy(*kept, bytes, sizeof(state));
    return OK;
}

#define STATE_FUNCTIONS(get, set, drop, size_of, serialize, deserialize, byte)              \
    int get(void *u, void **kept) { return keep_state((const unit *)u, kept); }             \
    int set(void *u, void *kept) { return take_state((unit *)u, kept); }                    \
    int drop(void *u, void **kept)                                                          \
    {                                                                                       \
        (void)u;                                                                            \
        return free_state(kept);                                                            \
    }                                                                                       \
    int size_of(void *u, void *kept, size_t *size)                                          \
    {                                                                                       \
        (void)u, (void)kept;                                                                \
        *size = sizeof(state);                                                              \
        return OK;                                                                          \
    }                                                                                       \
    int serialize(void *u, void *kept, byte bytes[], size_t size)                           \
    {                                                                                       \
        return write_state((unit *)u, kept, bytes, size);                                   \
    }                                                                                       \
    int deserialize(void *u, const byte bytes[], size_t size, void **kept)                  \
    {                                                                                       \
        return read_state((unit *)u, bytes, size, kept);                                    \
    }

STATE_FUNCTIONS(fmi3GetFMUState, fmi3SetFMUState, fmi3FreeFMUState, fmi3SerializedFMUStateSize,
                fmi3SerializeFMUState, fmi3DeserializeFMUState, uint8_t)
STATE_FUNCTIONS(fmi2GetFMUstate, fmi2SetFMUstate, fmi2FreeFMUstate, fmi2SerializedFMUstateSize,
                fmi2SerializeFMUstate, fmi2DeSerializeFMUstate, char)

/* ---- FMI 3.0 ---- */

const char *fmi3GetVersion(void) { return "3.0"; }

int fmi3SetDebugLogging(void *u, int on, size_t count, const char *const categories[])
{
    (void)u, (void)on, (void)count, (void)categories;
    return OK;
}

void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources,
                                  _Bool visible, _Bool logging, _Bool events, _Bool early,
                                  const uint32_t required[], size_t count, void *environment,
                                  logger3 log, void *intermediate)
{
    unit *u = make(token);

    (void)name, (void)resources, (void)visible, (void)events, (void)early, (void)required;
    (void)count, (void)intermediate;
    if (u != NULL) {
        u->environment = environment;
        u->log3 = logging ? log : NULL;
    }
    return u;
}

void fmi3FreeInstance(void *u) { free(u); }

int fmi3EnterInitializationMode(void *u, _Bool tolerant, double tolerance, double begin,
                                _Bool ends, double end)
{
    (void)tolerant, (void)tolerance, (void)ends, (void)end;
    ((unit *)u)->time = begin;
    return OK;
}

int fmi3ExitInitializationMode(void *u) { return start((unit *)u); }

int fmi3Terminate(void *u)
{
    (void)u;
    return OK;
}

int fmi3Reset(void *u) { return reset((unit *)u); }

int fmi3GetFloat64(void *u, const uint32_t references[], size_t count, double values[],
                   size_t many)
{
    return count == many ? get((unit *)u, references, count, values) : ERROR;
}

int fmi3SetFloat64(void *u, const uint32_t references[], size_t count, const double values[],
                   size_t many)
{
    return count == many ? set((unit *)u, references, count, values) : ERROR;
}

int fmi3DoStep(void *u, double now, double step, _Bool kept, _Bool *event, _Bool *ended,
               _Bool *early, double *reached)
{
    const int status = advance((unit *)u, now, step);

    (void)kept;
    *event = 0;
    *ended = 0;
    *early = 0;
    *reached = status == OK ? now + step : now;
    return status;
}

/* ---- FMI 2.0 ---- */

const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }

int fmi2SetDebugLogging(void *u, int on, size_t count, const char *const categories[])
{
    (void)u, (void)on, (void)count, (void)categories;
    return OK;
}

void *fmi2Instantiate(const char *name, int kind, const char *token, const char *resources,
                      const callbacks2 *callbacks, int visible, int logging)
{
    unit *u = kind == 1 ? make(token) : NULL;

    (void)name, (void)resources, (void)visible;
    if (u != NULL && callbacks != NULL) {
        u->environment = callbacks->environment;
        if (logging != 0) {
            (void)memcpy(&u->log2, &callbacks->logger, sizeof u->log2);
        }
    }
    return u;
}

void fmi2FreeInstance(void *u) { free(u); }

int fmi2SetupExperiment(void *u, int tolerant, double tolerance, double begin, int ends, double end)
{
    (void)tolerant, (void)tolerance, (void)ends, (void)end;
    ((unit *)u)->time = begin;
    return OK;
}

int fmi2EnterInitializationMode(void *u)
{
    (void)u;
    return OK;
}

int fmi2ExitInitializationMode(void *u) { return start((unit *)u); }

int fmi2Terminate(void *u)
{
    (void)u;
    return OK;
}

int fmi2Reset(void *u) { return reset((unit *)u); }

int fmi2GetReal(void *u, const uint32_t references[], size_t count, double values[])
{
    return get((unit *)u, references, count, values);
}

int fmi2SetReal(void *u, const uint32_t references[], size_t count, const double values[])
{
    return set((unit *)u, references, count, values);
}

int fmi2DoStep(void *u, double now, double step, int kept)
{
    (void)kept;
    return advance((unit *)u, now, step);
}

/* ---- what the description of the unit says that it cannot do, and variables of other kinds ---- */

#define REFUSED(name) \
    int name(void);   \
    int name(void) { return ERROR; }
#define NOTHING(name)   \
    void *name(void);   \
    void *name(void) { return NULL; }

NOTHING(fmi3InstantiateModelExchange)
NOTHING(fmi3InstantiateScheduledExecution)
REFUSED(fmi3EnterEventMode)
REFUSED(fmi3EnterConfigurationMode)
REFUSED(fmi3ExitConfigurationMode)
REFUSED(fmi3GetFloat32)
REFUSED(fmi3GetInt8)
REFUSED(fmi3GetUInt8)
REFUSED(fmi3GetInt16)
REFUSED(fmi3GetUInt16)
REFUSED(fmi3GetInt32)
REFUSED(fmi3GetUInt32)
REFUSED(fmi3GetInt64)
REFUSED(fmi3GetUInt64)
REFUSED(fmi3GetBoolean)
REFUSED(fmi3GetString)
REFUSED(fmi3GetBinary)
REFUSED(fmi3GetClock)
REFUSED(fmi3SetFloat32)
REFUSED(fmi3SetInt8)
REFUSED(fmi3SetUInt8)
REFUSED(fmi3SetInt16)
REFUSED(fmi3SetUInt16)
REFUSED(fmi3SetInt32)
REFUSED(fmi3SetUInt32)
REFUSED(fmi3SetInt64)
REFUSED(fmi3SetUInt64)
REFUSED(fmi3SetBoolean)
REFUSED(fmi3SetString)
REFUSED(fmi3SetBinary)
REFUSED(fmi3SetClock)
REFUSED(fmi3GetNumberOfVariableDependencies)
REFUSED(fmi3GetVariableDependencies)
REFUSED(fmi3GetDirectionalDerivative)
REFUSED(fmi3GetAdjointDerivative)
REFUSED(fmi3GetIntervalDecimal)
REFUSED(fmi3GetIntervalFraction)
REFUSED(fmi3GetShiftDecimal)
REFUSED(fmi3GetShiftFraction)
REFUSED(fmi3SetIntervalDecimal)
REFUSED(fmi3SetIntervalFraction)
REFUSED(fmi3SetShiftDecimal)
REFUSED(fmi3SetShiftFraction)
REFUSED(fmi3EvaluateDiscreteStates)
REFUSED(fmi3UpdateDiscreteStates)
REFUSED(fmi3EnterContinuousTimeMode)
REFUSED(fmi3CompletedIntegratorStep)
REFUSED(fmi3SetTime)
REFUSED(fmi3SetContinuousStates)
REFUSED(fmi3GetContinuousStateDerivatives)
REFUSED(fmi3GetEventIndicators)
REFUSED(fmi3GetContinuousStates)
REFUSED(fmi3GetNominalsOfContinuousStates)
REFUSED(fmi3GetNumberOfEventIndicators)
REFUSED(fmi3GetNumberOfContinuousStates)
REFUSED(fmi3EnterStepMode)
REFUSED(fmi3GetOutputDerivatives)
REFUSED(fmi3ActivateModelPartition)
REFUSED(fmi2GetInteger)
REFUSED(fmi2GetBoolean)
REFUSED(fmi2GetString)
REFUSED(fmi2SetInteger)
REFUSED(fmi2SetBoolean)
REFUSED(fmi2SetString)
REFUSED(fmi2GetDirectionalDerivative)
REFUSED(fmi2SetRealInputDerivatives)
REFUSED(fmi2GetRealOutputDerivatives)
REFUSED(fmi2CancelStep)
REFUSED(fmi2GetStatus)
REFUSED(fmi2GetRealStatus)
REFUSED(fmi2GetIntegerStatus)
REFUSED(fmi2GetBooleanStatus)
REFUSED(fmi2GetStringStatus)
