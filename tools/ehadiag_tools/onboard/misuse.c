/* Calls an exported library as it must not be called, and as it is called normally with all
 * floating-point exceptions watched; says what is wrong, or how many kinds of bad input held. */
#include <fenv.h>
#include <float.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include "eha_identify.h"

/* The processor's own register where the compiler's library has no functions for it, or none for
 * small numbers that are flushed to zero. */
#if defined(__ARM_FP) && !defined(__aarch64__)
static uint32_t state_get(void)
{
    uint32_t value;

    __asm__ volatile("vmrs %0, fpscr" : "=r"(value));
    return value;
}
static void state_set(uint32_t value)
{
    __asm__ volatile("vmsr fpscr, %0" : : "r"(value));
}
#define FLUSH_BITS (1u << 24)
#define RAISED() (state_get() & 7u) /* invalid, division by zero, overflow */
#define CLEAR() state_set(state_get() & ~0x9fu)
#define ROUND_BITS(mode) ((uint32_t)(mode) << 22)
#elif defined(__x86_64__)
#include <xmmintrin.h>
#define state_get() _mm_getcsr()
#define state_set(value) _mm_setcsr(value)
#define FLUSH_BITS 0x8040u
#elif defined(__aarch64__)
static uint32_t state_get(void)
{
    uint64_t value;

    __asm__ volatile("mrs %0, fpcr" : "=r"(value));
    return (uint32_t)value;
}
static void state_set(uint32_t value)
{
    __asm__ volatile("msr fpcr, %0" : : "r"((uint64_t)value));
}
#define FLUSH_BITS (1u << 24)
#endif
#ifndef RAISED
#define RAISED() ((unsigned)fetestexcept(FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW))
#define CLEAR() ((void)feclearexcept(FE_ALL_EXCEPT))
#endif
#if defined(__ARM_FP) && !(__ARM_FP & 8) /* doubles in software */
#define SMALL float
#define SMALLEST FLT_MIN
#else
#define SMALL double
#define SMALLEST DBL_MIN
#endif
#ifndef SLICES
#define SLICES 100 /* of a job, all of it; an emulator may be too slow for that */
#endif
#define TICKS 3000
#define TEST_TICKS EHA_TEST_TICKS_CURRENT
#define GUARD 0xa55a5aa5u
#define LOST_TICKS 251 /* more than a test may lack */
#define COUNT(list) (sizeof(list) / sizeof(list)[0])
#define DOUBLES(object) (sizeof(object) / sizeof(double))

/* What lies around an object must stay as it is. */
static struct {
    uint64_t before[8];
    eha_monitor object;
    uint64_t between[8];
    eha_identification job;
    uint64_t after[8];
} memory, copy;
static eha_tick recording[TEST_TICKS];
static const double cannot_be[] = {(double)NAN, (double)INFINITY, -(double)INFINITY};
static int kinds;
static int wrong;

#define monitor memory.object

static void expect(int good, const char *what, int which)
{
    ++kinds;
    if (!good) {
        (void)printf("%s (%d)\n", what, which);
        wrong = 1;
    }
}

static void fill(void *object, size_t bytes, int content)
{
    uint8_t *const place = object;
    uint32_t noise = 12345u;

    for (size_t i = 0; i < bytes; ++i) {
        noise = noise * 1664525u + 1013904223u;
        place[i] = content == 0 ? 0u : (content == 1 ? (uint8_t)(noise >> 24) : 0xffu);
    }
}

static void keep(void)
{
    (void)memcpy(&copy, &memory, sizeof memory);
}

static int untouched(void)
{
    return memcmp(&memory, &copy, sizeof memory) == 0;
}

/* What goes where an object, a unit, ticks or amounts must be. */
static void pointers(void)
{
    static double room[DOUBLES(eha_identification) + 1];
    double *const wrong_ones[] = {NULL, (double *)(void *)((char *)room + 4)};

    for (int i = 0; i < 2; ++i) {
        void *const bad = wrong_ones[i];
        void *const good = room;

        expect(eha_unit_environment(bad, good) == EHA_ERROR_POINTER, "unit of surroundings", i);
        expect(eha_unit_environment(good, bad) == EHA_ERROR_POINTER, "surroundings", i);
        expect(eha_monitor_init(bad, good) == EHA_ERROR_POINTER, "monitor of init", i);
        expect(eha_monitor_init(good, bad) == EHA_ERROR_POINTER, "unit of init", i);
        expect(eha_monitor_reset(bad, good) == EHA_ERROR_POINTER, "monitor of reset", i);
        expect(eha_monitor_reset(good, bad) == EHA_ERROR_POINTER, "spool of reset", i);
        expect(eha_monitor_push(bad, good) == EHA_ERROR_POINTER, "monitor of push", i);
        expect(eha_monitor_push(good, bad) == EHA_ERROR_POINTER, "tick of push", i);
        expect(eha_monitor_health(bad) == EHA_HEALTH_OBJECT, "monitor of health", i);
        expect(eha_identify_begin(bad, good) == EHA_ERROR_POINTER, "job of begin", i);
        expect(eha_identify_begin(good, bad) == EHA_ERROR_POINTER, "unit of begin", i);
        expect(eha_identify_run(bad, good, good) == EHA_ERROR_POINTER, "job of run", i);
        expect(eha_identify_run(good, bad, good) == EHA_ERROR_POINTER, "ticks of run", i);
        expect(eha_identify_run(good, good, bad) == EHA_ERROR_POINTER, "amounts of run", i);
    }
    for (size_t i = 0; i < COUNT(room); ++i) {
        wrong |= room[i] != 0.0;
    }
}

/* Zeros, noise, NaN, and an object of the other kind in its place. */
static void objects(void)
{
    const eha_unit unit = EHA_UNIT_DEFAULT;
    const eha_slice slice = {TEST_TICKS, 1.0};
    const eha_tick tick = {0.0, 0.0, 0.0, 0.0, 0.0};
    const double spool = 0.0;

    for (int content = 0; content < 4; ++content) {
        eha_monitor *one = &monitor;

        if (content < 3) {
            fill(&monitor, sizeof monitor, content);
            fill(&memory.job, sizeof memory.job, content);
        } else { /* a job is larger than a monitor */
            wrong |= eha_identify_begin(&memory.job, &unit) != 0;
            one = (void *)&memory.job;
        }
        keep();
        expect(eha_monitor_push(one, &tick) == EHA_ERROR_OBJECT, "push into", content);
        expect(eha_monitor_reset(one, &spool) == EHA_ERROR_OBJECT, "reset of", content);
        expect(eha_monitor_health(one) == EHA_HEALTH_OBJECT, "health of", content);
        if (content < 3) {
            expect(eha_identify_run(&memory.job, recording, &slice) == EHA_ERROR_OBJECT, "run of",
                   content);
        }
        expect(untouched(), "memory that was not begun", content);
    }
}

/* Each member of a unit in turn, for monitor and identification. */
static void units(void)
{
    const eha_unit good = EHA_UNIT_DEFAULT;
    const struct {
        size_t member;
        double value;
        int32_t code;
    } list[] = {
        {0, -0.01, EHA_ERROR_RANGE}, {0, 1.01, EHA_ERROR_RANGE}, {1, -0.01, EHA_ERROR_RANGE},
        {1, 1.01, EHA_ERROR_RANGE}, {2, -0.01, EHA_ERROR_RANGE}, {2, 1.01, EHA_ERROR_RANGE},
        {3, 1.0, EHA_ERROR_RANGE}, {3, -1.0, EHA_ERROR_RANGE}, {4, 1e9, EHA_ERROR_RANGE},
        {4, -1e9, EHA_ERROR_RANGE}, {5, 0.0, EHA_ERROR_RANGE}, {5, -1.0, EHA_ERROR_RANGE},
        {5, 1e-3, EHA_ERROR_RANGE}, {5, 1e300, EHA_ERROR_RANGE}, {6, 0.0, EHA_ERROR_RANGE},
        {6, -2e7, EHA_ERROR_RANGE}, {6, 20.0, EHA_ERROR_RANGE}, {6, 200.0, EHA_ERROR_RANGE},
        {6, 2900.0, EHA_ERROR_RANGE}, {6, 1e300, EHA_ERROR_RANGE}, {6, 5e-324, EHA_ERROR_RANGE},
        {8, EHA_VERSION + 1.0, EHA_ERROR_LIBRARY}, {8, 0.0, EHA_ERROR_LIBRARY},
        {9, EHA_PLAN + 1.0, EHA_ERROR_LIBRARY}, {9, 0.0, EHA_ERROR_LIBRARY},
    };
    double numbers[DOUBLES(eha_unit)];
    eha_unit unit;

    fill(&memory, sizeof memory, 1);
    keep();
    for (size_t i = 0; i < COUNT(list) + 3u * 10u; ++i) {
        const size_t member = i < COUNT(list) ? list[i].member : (i - COUNT(list)) / 3u;
        const int32_t code =
            i < COUNT(list) ? list[i].code : (member < 8u ? EHA_ERROR_RANGE : EHA_ERROR_LIBRARY);

        (void)memcpy(numbers, &good, sizeof numbers);
        numbers[member] = i < COUNT(list) ? list[i].value : cannot_be[(i - COUNT(list)) % 3u];
        (void)memcpy(&unit, numbers, sizeof numbers);
        expect(eha_monitor_init(&monitor, &unit) == code, "unit of a monitor", (int)i);
        expect(eha_identify_begin(&memory.job, &unit) == code, "unit of a job", (int)i);
    }
    expect(untouched(), "memory of a unit that is refused", 0);
}

static void surroundings(void)
{
    const eha_environment list[] = {
        {-61.0, 2.07e7, 7e5}, {201.0, 2.07e7, 7e5}, {1e300, 2.07e7, 7e5}, {40.0, 7e5, 2.07e7},
        {40.0, 0.0, 0.0}, {40.0, (double)INFINITY, 7e5}, {(double)NAN, 2.07e7, 7e5},
        {40.0, (double)NAN, 7e5}, {40.0, 2.07e7, (double)NAN},
        {40.0, (double)INFINITY, (double)INFINITY},
    };
    const eha_unit good = EHA_UNIT_DEFAULT;
    eha_unit unit = good;

    for (size_t i = 0; i < COUNT(list); ++i) {
        expect(eha_unit_environment(&unit, &list[i]) == EHA_ERROR_RANGE, "surroundings", (int)i);
    }
    expect(memcmp(&unit, &good, sizeof unit) == 0, "unit of surroundings that are refused", 0);
}

static int has_numbers(void)
{
    double numbers[9];

    (void)memcpy(numbers, monitor.predicted, sizeof monitor.predicted);
    (void)memcpy(&numbers[3], monitor.cusum, sizeof monitor.cusum);
    for (int i = 0; i < 7; ++i) {
        if (!isfinite(numbers[i])) {
            return 0;
        }
    }
    return (eha_monitor_health(&monitor) & EHA_HEALTH_MODEL) == 0;
}

/* A number of a tick that cannot be, or is in a wrong unit; samples that stay away; noise. */
static void ticks(void)
{
    const double list[] = {1e300, -1e300, 1e12, -1e12, (double)INFINITY, -(double)INFINITY};
    const eha_unit unit = EHA_UNIT_DEFAULT;
    const eha_tick none = {(double)NAN, (double)NAN, (double)NAN, (double)NAN, (double)NAN};
    double numbers[5];
    eha_tick tick;

    expect(eha_monitor_init(&monitor, &unit) == 0, "a good unit", 0);
    for (int i = 0; i < 3; ++i) {
        keep();
        expect(eha_monitor_reset(&monitor, &cannot_be[i]) == EHA_ERROR_RANGE, "reset to", i);
        expect(untouched(), "memory of a reset that is refused", i);
    }
    for (size_t i = 0; i < 5u * COUNT(list); ++i) {
        (void)memset(numbers, 0, sizeof numbers);
        numbers[i / COUNT(list)] = list[i % COUNT(list)];
        (void)memcpy(&tick, numbers, sizeof numbers);
        expect(eha_monitor_push(&monitor, &tick) >= 0 &&
                   eha_monitor_health(&monitor) == EHA_HEALTH_BEYOND && has_numbers(),
               "tick with a number that cannot be", (int)i);
    }
    for (int k = 0; k < LOST_TICKS; ++k) {
        (void)eha_monitor_push(&monitor, &none);
    }
    expect(eha_monitor_health(&monitor) ==
               (EHA_HEALTH_SPOOL | EHA_HEALTH_PRESSURE | EHA_HEALTH_COMMAND) && has_numbers(),
           "no samples", 0);
    for (int closed = 0; closed < 2; ++closed) {
        eha_unit one = unit;

        one.closed = closed;
        expect(eha_monitor_init(&monitor, &one) == 0, "a good unit", 1);
        for (int k = 0; k < TICKS; ++k) { /* from end to end of what is allowed */
            const double sign = k % 2 == 0 ? 1.0 : -1.0;

            tick.command = closed ? sign * 0.02 : sign * 0.03;
            tick.current = -sign * 0.03;
            tick.spool = sign * 1e-3;
            tick.pressure = -sign * 2e7;
            tick.position = sign * 0.02;
            (void)eha_monitor_push(&monitor, &tick);
        }
        expect(has_numbers(), "from end to end", closed);
        for (int k = 0; k < TICKS; ++k) {
            fill(&tick, sizeof tick, 1);
            numbers[0] = ldexp(1.0, k % 2100 - 1070); /* through all exponents */
            (&tick.command)[k % 5] = k % 3 == 0 ? -numbers[0] : numbers[0];
            (void)eha_monitor_push(&monitor, &tick);
        }
        expect(has_numbers(), "noise in ticks", closed);
    }
}

static int is_refused(double reason)
{
    const double *const numbers = &memory.job.kintas;

    for (int i = 0; i < 8; ++i) {
        if (!isnan(numbers[i])) {
            return 0;
        }
    }
    return memory.job.verdict == EHA_NOT_TESTED && memory.job.reasons == reason;
}

static void identified(const eha_tick *ticks_of_test, double count, const eha_unit *unit)
{
    const eha_slice slice = {count, 1e4};

    wrong |= eha_identify_begin(&memory.job, unit) != 0;
    for (int k = 0; k < SLICES; ++k) {
        if (eha_identify_run(&memory.job, ticks_of_test, &slice) != EHA_IDENTIFY_GOES_ON) {
            break;
        }
    }
}

/* A test of no motion, but of some noise that is within the converters' ranges. */
static void record(void)
{
    for (int k = 0; k < TEST_TICKS; ++k) {
        const eha_tick tick = {1e-3, 1e-3, 1e-7 * (k * 7 % 13), 1e3 * (k * 5 % 11), 1e-6 * (k % 7)};

        recording[k] = tick;
    }
}

static void recordings(void)
{
    const double counts[] = {1.0, 100.0, TEST_TICKS - 1.0, TEST_TICKS + 1.0, 1e6};
    const double never[] = {0.0, -1.0, 0.5, 1e300, (double)NAN, (double)INFINITY};
    const eha_tick *const nowhere = (const eha_tick *)(uintptr_t)16u;
    const eha_unit unit = EHA_UNIT_DEFAULT;
    eha_slice slice = {TEST_TICKS, 1e4};
    eha_unit weak = unit;

    for (size_t i = 0; i < COUNT(counts); ++i) {
        identified(nowhere, counts[i], &unit); /* of another length, nothing of it is read */
        expect(is_refused(EHA_REASON_LENGTH), "a test of another length", (int)i);
    }
    wrong |= eha_identify_begin(&memory.job, &unit) != 0;
    keep();
    for (size_t i = 0; i < 2u * COUNT(never); ++i) {
        slice.ticks = i < COUNT(never) ? never[i] : (double)TEST_TICKS;
        slice.work = i < COUNT(never) ? 1.0 : never[i - COUNT(never)];
        if (!(slice.work >= 1.0)) {
            expect(eha_identify_run(&memory.job, nowhere, &slice) == EHA_ERROR_RANGE, "work", (int)i);
        } else if (i < COUNT(never)) {
            expect(eha_identify_run(&memory.job, nowhere, &slice) == EHA_ERROR_RANGE, "ticks", (int)i);
        }
    }
    expect(untouched(), "memory of a run that is refused", 0);

    record();
    for (int i = 0; i < 3; ++i) {
        record();
        for (int k = 0; k < TEST_TICKS; ++k) {
            recording[k].spool = i == 0 ? cannot_be[k % 3] : recording[k].spool;
            recording[k].pressure = i == 1 && k < 2000 ? cannot_be[k % 3] : recording[k].pressure;
            recording[k].spool = i == 2 && k > 5200 ? (double)NAN : recording[k].spool;
        }
        identified(recording, TEST_TICKS, &unit);
        expect(is_refused(i == 0 ? EHA_REASON_LOST | EHA_REASON_FROZEN : EHA_REASON_LOST),
               "lost samples", i);
    }
    for (int i = 0; i < 2; ++i) {
        record();
        for (int k = 0; k < TEST_TICKS; ++k) {
            recording[k].spool = i == 0 ? 1e-5 : recording[k].spool;
            recording[k].pressure = i == 1 ? 0.0 : recording[k].pressure;
        }
        identified(recording, TEST_TICKS, &unit);
        expect(is_refused(EHA_REASON_FROZEN), "a frozen sensor", i);
    }
    for (int i = 0; i < 3; ++i) {
        record();
        for (int k = 0; k < TEST_TICKS; k += 10) {
            (&recording[k].spool)[i] = 1e9;
        }
        identified(recording, TEST_TICKS, &unit);
        expect(is_refused(EHA_REASON_SATURATED), "a sensor at its end", i);
    }
    record();
    weak.supply *= 0.4;
    identified(recording, TEST_TICKS, &weak);
    expect(is_refused(EHA_REASON_SUPPLY), "a weak supply", 0);

    for (int i = SLICES < 100 ? 1 : 0; i < 2; ++i) { /* a sample, then the length, between calls */
        wrong |= eha_identify_begin(&memory.job, &unit) != 0;
        slice.ticks = TEST_TICKS;
        slice.work = 6e4;
        expect(eha_identify_run(&memory.job, recording, &slice) == EHA_IDENTIFY_GOES_ON, "run", i);
        recording[2000].pressure += i == 0 ? 1.0 : 0.0;
        slice.ticks -= i;
        for (int k = 0; k < 100 && memory.job.reasons == 0.0; ++k) {
            if (eha_identify_run(&memory.job, recording, &slice) != EHA_IDENTIFY_GOES_ON) {
                break;
            }
        }
        expect(is_refused(EHA_REASON_CHANGED), "a recording that changes", i);
        keep();
        expect(eha_identify_run(&memory.job, recording, &slice) == EHA_IDENTIFY_DONE, "done", i);
    }
}

/* What every function returns under an arithmetic that is not as stated. */
static void refused(int32_t codes[6])
{
    const eha_unit unit = EHA_UNIT_DEFAULT;
    const eha_slice slice = {TEST_TICKS, 1.0};
    const eha_tick tick = {0.0, 0.0, 0.0, 0.0, 0.0};
    const double spool = 0.0;

    codes[0] = eha_monitor_init(&monitor, &unit);
    codes[1] = eha_monitor_reset(&monitor, &spool);
    codes[2] = eha_monitor_push(&monitor, &tick);
    codes[3] = eha_identify_begin(&memory.job, &unit);
    codes[4] = eha_identify_run(&memory.job, recording, &slice);
    codes[5] = eha_monitor_health(&monitor) == EHA_HEALTH_ARITHMETIC ? EHA_ERROR_ARITHMETIC : 0;
}

static void expect_refused(const int32_t codes[6], int which)
{
    for (int i = 0; i < 6; ++i) {
        expect(codes[i] == EHA_ERROR_ARITHMETIC, "arithmetic", 10 * which + i);
    }
}

static void arithmetic(void)
{
    const eha_unit unit = EHA_UNIT_DEFAULT;
    int32_t codes[6];

    wrong |= eha_monitor_init(&monitor, &unit) != 0 || eha_identify_begin(&memory.job, &unit) != 0;
    keep();
#ifdef ROUND_BITS
    for (int mode = 1; mode < 4; ++mode) { /* upward, downward, towards zero */
        const uint32_t state = state_get();

        state_set(state | ROUND_BITS(mode));
        refused(codes);
        state_set(state);
        expect_refused(codes, mode);
    }
#else
    {
        const int modes[] = {FE_UPWARD, FE_DOWNWARD, FE_TOWARDZERO};

        for (int i = 0; i < 3; ++i) {
            const int set = fesetround(modes[i]) == 0 && fegetround() == modes[i];

            if (set) {
                refused(codes);
            }
            (void)fesetround(FE_TONEAREST);
            if (set) {
                expect_refused(codes, i);
            }
        }
    }
#endif
#ifdef FLUSH_BITS
    {
        const uint32_t state = state_get();
        volatile SMALL small = SMALLEST;

        state_set(state | FLUSH_BITS);
        small *= (SMALL)0.5;
        refused(codes);
        state_set(state);
        if (small == (SMALL)0.0) { /* an emulator may not flush */
            expect_refused(codes, 4);
        } else {
            (void)eha_monitor_init(&monitor, &unit);
            keep();
        }
    }
#endif
    expect(untouched(), "memory under an arithmetic that is refused", 0);
}

/* Rest, a ramp, steps and lost samples, in open and in closed loop. */
static void run_normally(double closed)
{
    const eha_environment warm = {60.0, 2.07e7, 7e5};
    const double spool = 1e-5;
    eha_unit unit = EHA_UNIT_DEFAULT;

    unit.closed = closed;
    CLEAR();
    expect(eha_unit_environment(&unit, &warm) == 0, "good surroundings", 0);
    expect(eha_monitor_init(&monitor, &unit) == 0, "a good unit", 2);
    expect(eha_monitor_reset(&monitor, &spool) == 0, "a good reset", 0);
    for (int k = 0; k < TICKS; ++k) {
        const double size = k < 500 ? 0.0 : (k < 1500 ? (k - 500) * 1e-6 : (k / 250 % 2) * 1e-2);
        eha_tick tick = {size, size, 1e-7 * (k % 3), 1e3 * (k % 5), 1e-6 * (k % 7)};

        if (k % 97 == 3) {
            tick.spool = tick.pressure = tick.position = (double)NAN;
        }
        if (k % 101 == 5) {
            tick.command = tick.current = (double)NAN;
        }
        (void)eha_monitor_push(&monitor, &tick);
        if (RAISED() != 0u) {
            expect(0, "floating-point exceptions at tick", k);
            return;
        }
    }
    expect(eha_monitor_health(&monitor) == 0, "health", (int)closed);
    record();
    identified(recording, TEST_TICKS, &unit);
#ifndef EHA_SINGLE_HOST /* compares pairs of which one is no number of the model's */
    expect(RAISED() == 0u, "floating-point exceptions of a job", (int)closed);
#endif
}

int main(void)
{
    for (int i = 0; i < 8; ++i) {
        memory.before[i] = memory.between[i] = memory.after[i] = GUARD;
    }
    pointers();
    objects();
    units();
    surroundings();
    for (int i = 0; i < 8; ++i) { /* noise was written around the objects, too */
        memory.before[i] = memory.between[i] = memory.after[i] = GUARD;
    }
    ticks();
    recordings();
    run_normally(0.0);
    run_normally(1.0);
    arithmetic();
    for (int i = 0; i < 8; ++i) {
        expect(memory.before[i] == GUARD && memory.between[i] == GUARD && memory.after[i] == GUARD,
               "memory around the objects", i);
    }
    if (wrong == 0) {
        (void)printf("nothing wrong in %d kinds of input\n", kinds);
    }
    return 0;
}
