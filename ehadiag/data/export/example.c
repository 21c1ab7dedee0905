/* Pushes a second of an actuator at rest into a monitor, as frames of the default bus, and prints
 * what it holds then. */
#include <inttypes.h>
#include <stdio.h>

#include "eha_monitor.h"
#include "samples.h"

#define TICKS 1000

/* What a bus would have brought: telemetry and command of one tick. */
static void receive(struct fcc_frame *telemetry, struct fcc_frame *command)
{
    static uint8_t counters[2];
    const uint16_t codes[4] = {
        eha_fcc_servo_telemetry_servo_current_encode(0.0),
        eha_fcc_servo_telemetry_spool_position_encode(0.0),
        eha_fcc_servo_telemetry_diff_pressure_encode(0.0),
        eha_fcc_servo_telemetry_jack_position_encode(0.0),
    };

    fcc_pack_telemetry(telemetry, codes, &counters[0]);
    fcc_pack_command(command, EHA_FCC_SERVO_COMMAND_COMMAND_MODE_CURRENT_CHOICE, 0, 0,
                     &counters[1]);
}

int main(void)
{
    static eha_monitor monitor;
    const eha_unit unit = EHA_UNIT_DEFAULT;
    int32_t alarms = 0;

    if (eha_monitor_init(&monitor, &unit) != 0) {
        (void)fputs("a number of the unit is out of its range\n", stderr);
        return 1;
    }
    for (int tick = 0; tick < TICKS; ++tick) {
        struct eha_fcc_servo_telemetry_t telemetry;
        struct eha_fcc_servo_command_t command;
        struct fcc_frame frames[2];

        receive(&frames[0], &frames[1]);
        if (fcc_unpack_telemetry(&frames[0], &telemetry) &&
            fcc_unpack_command(&frames[1], &command)) {
            const struct fcc_sample sample = fcc_sample_of_frames(&telemetry, &command);
            const eha_tick now = {sample.command, sample.current, sample.spool, sample.pressure,
                                  sample.position};

            alarms |= eha_monitor_push(&monitor, &now);
        }
    }
    (void)printf("alarms %" PRId32 ", spool %g m, residual %g\n", alarms, monitor.predicted[0],
                 monitor.residual[0]);
    return 0;
}
