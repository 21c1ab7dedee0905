/* Pushes a second of an actuator at rest into a monitor, and prints what it holds then. */
#include <inttypes.h>
#include <stdio.h>

#include "eha_monitor.h"

#define TICKS 1000

int main(void)
{
    static eha_monitor monitor;
    const eha_unit unit = EHA_UNIT_DEFAULT;
    const eha_tick rest = {0.0, 0.0, 0.0, 0.0, 0.0};
    int32_t alarms = 0;

    if (eha_monitor_init(&monitor, &unit) != 0) {
        (void)fputs("a number of the unit is out of its range\n", stderr);
        return 1;
    }
    for (int tick = 0; tick < TICKS; ++tick) {
        alarms |= eha_monitor_push(&monitor, &rest);
    }
    (void)printf("alarms %" PRId32 ", spool %g m, residual %g\n", alarms, monitor.predicted[0],
                 monitor.residual[0]);
    return 0;
}
