/* Replays recorded ticks through an exported monitor and prints what it holds after each, in bits. */
#include "eha_monitor.h"
#include "measure.h"
#include "ticks.h"

static eha_monitor monitor;

static double number(uint64_t bits)
{
    double value;

    (void)memcpy(&value, &bits, sizeof value);
    return value;
}

int main(void)
{
    eha_unit unit = EHA_UNIT_DEFAULT;
    size_t deepest = 0;
    uint64_t total = 0u;
    uint64_t worst = 0u;

    (void)memcpy(&unit, unit_bits, sizeof unit_bits);
    (void)stack_paint(0);
    if (eha_monitor_init(&monitor, &unit) != 0) {
        return 1;
    }
    (void)printf("init stack %lu\n", (unsigned long)stack_paint(1));
    for (size_t k = 0; k < sizeof tick_bits / sizeof tick_bits[0]; ++k) {
        eha_tick tick;
        int32_t alarms;
        size_t used;
        uint64_t begin, spent;

        tick.command = number(tick_bits[k][0]);
        tick.current = number(tick_bits[k][1]);
        tick.spool = number(tick_bits[k][2]);
        tick.pressure = number(tick_bits[k][3]);
        tick.position = number(tick_bits[k][4]);
        (void)stack_paint(0);
        begin = instructions();
        alarms = eha_monitor_push(&monitor, &tick);
        spent = instructions() - begin;
        total += spent;
        worst = spent > worst ? spent : worst;
        used = stack_paint(1);
        deepest = used > deepest ? used : deepest;
        (void)printf("tick %" PRId32, alarms);
        print_numbers(monitor.predicted, 3);
        print_numbers(monitor.residual, 2);
        print_numbers(monitor.cusum, 4);
        (void)printf("\n");
    }
    (void)printf("worst count %" PRIu32 "\n", (uint32_t)worst);
    (void)printf("mean count %" PRIu32 "\n",
                 (uint32_t)(total / (sizeof tick_bits / sizeof tick_bits[0])));
    (void)printf("push stack %lu\n", (unsigned long)deepest);
    return 0;
}
