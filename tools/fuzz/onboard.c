/* An exported library: its functions in any order, with any numbers and contents of objects. */
#include <math.h>
#include <string.h>

#include "eha_identify.h"
#include "native.h"

#define GUARD 0x5aa5a55a5aa5a55au
#define MOST_WORK 400.0 /* ticks of a model in an input */
#define TEST_TICKS EHA_TEST_TICKS_CURRENT

static struct {
    uint64_t before;
    eha_monitor monitor;
    uint64_t between;
    eha_identification job;
    uint64_t after;
} memory;
static eha_monitor was;
static eha_identification was_job;
static eha_tick recording[TEST_TICKS];
static const uint8_t *next;
static size_t left;
static double work_left;
static int recorded;

static uint8_t byte(void)
{
    if (left == 0) {
        return 0;
    }
    --left;
    return *next++;
}

/* A number of a usual or of a special size, or any bits. */
static double number(double usual)
{
    static const double special[] = {
        0.0, -0.0, 1.0, -1.0, 0.5, 1e-300, 5e-324, -5e-324, 1e300, -1e300, 1e9, 20.0, 200.0, 2900.0,
        1.0000000000000002, -1e-9, (double)NAN, (double)INFINITY, -(double)INFINITY, 4.0};
    const uint8_t kind = byte();
    double value = 0.0;

    if (kind < 160u) {
        return usual * (kind - 80.0) / 40.0;
    }
    if (kind < 240u) {
        return special[kind % (sizeof special / sizeof special[0])] * (kind < 200u ? 1.0 : usual);
    }
    for (size_t i = 0; i < sizeof value; ++i) {
        ((uint8_t *)&value)[i] = byte();
    }
    return value;
}

static void tick_of(eha_tick *tick, int closed)
{
    tick->command = number(closed ? 1e-2 : 1e-2);
    tick->current = number(1e-2);
    tick->spool = number(3e-4);
    tick->pressure = number(5e6);
    tick->position = number(1e-2);
}

static void fill(void *object, size_t size, uint8_t how)
{
    uint32_t noise = how;

    for (size_t i = 0; i < size; ++i) {
        noise = noise * 1664525u + 1013904223u;
        ((uint8_t *)object)[i] = how == 0 ? 0u : (how == 1 ? 0xffu : (uint8_t)(noise >> 24));
    }
}

static int among(int32_t code, int32_t most)
{
    return code >= EHA_ERROR_LIBRARY && code <= most;
}

static void monitored(int32_t code, int what)
{
    const int32_t health = eha_monitor_health(&memory.monitor);

    if (!among(code, what == 3 ? 15 : 0)) {
        finding("a code that there is not");
    }
    if (code < 0 && memcmp(&was, &memory.monitor, sizeof was) != 0) {
        finding("memory of a refused call");
    }
    if (health < 0 || health > 127) {
        finding("a health that there is not");
    }
    if (code >= 0 && (health & (EHA_HEALTH_MODEL | EHA_HEALTH_OBJECT)) == 0) {
        for (int i = 0; i < 3; ++i) {
            if (!isfinite(memory.monitor.predicted[i])) {
                finding("a model without numbers, and a good health");
            }
        }
        for (int i = 0; i < 4; ++i) {
            if (!isfinite(memory.monitor.cusum[i])) {
                finding("a sum without a number");
            }
        }
    }
    shown(((uint64_t)what << 32) | ((uint64_t)(uint8_t)code << 16) | (uint64_t)health);
}

static void identified(int32_t code, int what)
{
    if (!among(code, EHA_IDENTIFY_GOES_ON)) {
        finding("a code that there is not");
    }
    if (code < 0 && memcmp(&was_job, &memory.job, sizeof was_job) != 0) {
        finding("memory of a refused call");
    }
    if (what == 6 && code == EHA_IDENTIFY_DONE) {
        const int none = memory.job.verdict == EHA_NOT_TESTED;

        if (none != (memory.job.reasons != 0.0) || (none && !isnan(memory.job.kintas)) ||
            (!none && !(memory.job.kintas >= 0.0 && memory.job.kintas <= 1.0))) {
            finding("a verdict, and numbers that are not its own");
        }
        shown(0x7000000u + (uint64_t)memory.job.reasons);
    }
    shown(((uint64_t)what << 32) | ((uint64_t)(uint8_t)code << 16));
}

void check(const uint8_t *bytes, size_t size)
{
    const eha_unit good = EHA_UNIT_DEFAULT;
    eha_unit unit = good;
    eha_environment around = {40.0, 2.07e7, 7e5};
    eha_slice slice = {TEST_TICKS, 1.0};
    eha_tick tick;
    double spool;

    memory.before = memory.between = memory.after = GUARD;
    (void)memset(&memory.monitor, 0, sizeof memory.monitor);
    (void)memset(&memory.job, 0, sizeof memory.job);
    if (recorded) { /* an input must not depend on the one before */
        (void)memset(recording, 0, sizeof recording);
        recorded = 0;
    }
    next = bytes;
    left = size;
    work_left = MOST_WORK;
    while (left > 0) {
        const uint8_t what = byte();
        const uint8_t more = (uint8_t)(what / 9u);

        was = memory.monitor;
        switch (what % 9u) {
        case 0:
            spool = number(2e-4);
            monitored(eha_monitor_reset(&memory.monitor, more == 5u ? NULL : &spool), 0);
            break;
        case 1: { /* a member of the unit */
            static const double usual[] = {1.0, 1.0, 1.0, 1e-5, 1e5, 1.0, 2e7, 1.0};
            double numbers[sizeof unit / sizeof(double)];

            (void)memcpy(numbers, &unit, sizeof unit);
            numbers[more % 11u] = number(more % 11u < 8u ? usual[more % 11u] : 1.0);
            (void)memcpy(&unit, numbers, sizeof unit);
            break;
        }
        case 2:
            unit = more > 20u ? good : unit;
            monitored(eha_monitor_init(&memory.monitor, &unit), 2);
            break;
        case 3:
            tick_of(&tick, unit.closed != 0.0);
            for (int i = 0; i <= more; ++i) {
                was = memory.monitor;
                monitored(eha_monitor_push(&memory.monitor, more == 5u ? NULL : &tick), 3);
                tick.command = -tick.command;
            }
            break;
        case 4:
            around.oil_temperature = number(100.0);
            around.supply_pressure = number(2e7);
            around.return_pressure = number(1e6);
            shown(0x4000u + (uint64_t)(uint8_t)eha_unit_environment(&unit, &around));
            break;
        case 5:
            was_job = memory.job;
            unit = more > 20u ? good : unit;
            identified(eha_identify_begin(&memory.job, more == 5u ? NULL : &unit), 5);
            break;
        case 6:
            slice.ticks = more < 20u ? TEST_TICKS : number(TEST_TICKS);
            slice.work = more % 4u != 0u ? 50.0 : number(20.0);
            if (slice.work > work_left) {
                slice.work = work_left;
            }
            work_left -= slice.work >= 1.0 ? slice.work : 0.0;
            was_job = memory.job;
            identified(eha_identify_run(&memory.job, recording, &slice), 6);
            break;
        case 7: /* the recording, or a tick of it */
            tick_of(&tick, unit.closed != 0.0);
            recorded = 1;
            for (size_t k = more % TEST_TICKS; k < TEST_TICKS; k += more < 8u ? 1u : 16u) {
                recording[k] = tick;
                recording[k].spool += 1e-7 * (double)(k * 7u % 13u);
                recording[k].pressure += 1e3 * (double)(k * 5u % 11u);
            }
            break;
        default:
            fill(more % 2u == 0 ? (void *)&memory.monitor : (void *)&memory.job,
                 more % 2u == 0 ? sizeof memory.monitor : sizeof memory.job, more / 2u);
            break;
        }
        if (memory.before != GUARD || memory.between != GUARD || memory.after != GUARD) {
            finding("memory beside an object");
        }
    }
}
