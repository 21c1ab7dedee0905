/* Replays recorded ticks through an exported monitor and prints what it holds after each, in bits. */
#include <inttypes.h>
#include <stdio.h>
#include <string.h>

#include "eha_monitor.h"
#include "ticks.h"

#define STACK_BYTES 16384
#define MARGIN 64
#define PAINT 0xa5

static eha_monitor monitor;

#ifdef COUNTED
uint32_t instructions(void);
#else
static uint32_t instructions(void) { return 0u; }
#endif
#define COUNTER_SPAN (0x1000000u * 40u) /* after which it begins anew */

static uint32_t since(uint32_t before)
{
    const uint32_t now = instructions();

    return now >= before ? now - before : now + COUNTER_SPAN - before;
}

static double number(uint64_t bits)
{
    double value;

    (void)memcpy(&value, &bits, sizeof value);
    return value;
}

static void print_numbers(const double *values, int count)
{
    for (int i = 0; i < count; ++i) {
        uint64_t bits;

        (void)memcpy(&bits, &values[i], sizeof bits);
        (void)printf("%08" PRIx32 "%08" PRIx32 " ", (uint32_t)(bits >> 32), (uint32_t)bits);
    }
}

/* Colours the stack below the caller, or counts what of it has lost its colour. */
static size_t __attribute__((noinline)) stack_paint(int counting)
{
    volatile uint8_t *room = (volatile uint8_t *)__builtin_frame_address(0) - STACK_BYTES - MARGIN;
    size_t same = 0;

    if (counting == 0) {
        for (size_t i = 0; i < STACK_BYTES; ++i) {
            room[i] = PAINT;
        }
        return 0;
    }
    while (same < STACK_BYTES && room[same] == PAINT) {
        ++same;
    }
    return STACK_BYTES + MARGIN - same;
}

int main(void)
{
    eha_unit unit;
    size_t deepest = 0;
    uint64_t total = 0u;
    uint32_t worst = 0u;

    (void)memcpy(&unit, unit_bits, sizeof unit);
    (void)stack_paint(0);
    if (eha_monitor_init(&monitor, &unit) != 0) {
        return 1;
    }
    (void)printf("init stack %lu\n", (unsigned long)stack_paint(1));
    for (size_t k = 0; k < sizeof tick_bits / sizeof tick_bits[0]; ++k) {
        eha_tick tick;
        int32_t alarms;
        size_t used;
        uint32_t begin, spent;

        tick.command = number(tick_bits[k][0]);
        tick.current = number(tick_bits[k][1]);
        tick.spool = number(tick_bits[k][2]);
        tick.pressure = number(tick_bits[k][3]);
        tick.position = number(tick_bits[k][4]);
        (void)stack_paint(0);
        begin = instructions();
        alarms = eha_monitor_push(&monitor, &tick);
        spent = since(begin);
        total += spent;
        worst = spent > worst ? spent : worst;
        used = stack_paint(1);
        deepest = used > deepest ? used : deepest;
        (void)printf("tick %" PRId32 " ", alarms);
        print_numbers(monitor.predicted, 3);
        print_numbers(monitor.residual, 2);
        print_numbers(monitor.cusum, 4);
        (void)printf("\n");
    }
    (void)printf("worst count %" PRIu32 "\n", worst);
    (void)printf("mean count %" PRIu32 "\n",
                 (uint32_t)(total / (sizeof tick_bits / sizeof tick_bits[0])));
    (void)printf("push stack %lu\n", (unsigned long)deepest);
    return 0;
}
