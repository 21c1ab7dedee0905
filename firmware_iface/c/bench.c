#include "bench.h"

#include <math.h>

static const double TICK = 1e-3;        /* s */
static const double MOST_CURRENT = 10;  /* mA */
static const double LOOP_GAIN = 2;      /* mA per mm */
static const double SPOOL_GAIN = 0.04;  /* mm per mA */
static const double SPOOL_LAG = 5e-3;   /* s */
static const double JACK_GAIN = 300;    /* mm/s per mm */
static const double DRAG = 0.02;        /* MPa per mm/s */

/* Codes as the bus carries them: range and step are those of the generated signal. */
static uint16_t convert(double value, double (*decode)(uint16_t), bool (*is_in_range)(uint16_t))
{
    double low = decode(0), step = decode(1) - low, code = floor((value - low) / step + 0.5);
    uint16_t top = UINT16_MAX;

    while (!is_in_range(top)) {
        top >>= 1;
    }
    return (uint16_t)fmin(fmax(code, 0.0), top);
}

void fcc_bench_tick(struct fcc_bench *bench, const struct fcc_command *command, uint16_t codes[4])
{
    double wanted;

    if (command->mode == EHA_FCC_SERVO_COMMAND_COMMAND_MODE_CURRENT_CHOICE) {
        wanted = eha_fcc_servo_command_current_command_decode(command->value);
    } else {
        wanted = eha_fcc_servo_command_position_command_decode(command->value);
        wanted = LOOP_GAIN * (wanted - bench->jack);
    }
    bench->current = fmin(fmax(wanted, -MOST_CURRENT), MOST_CURRENT);
    bench->spool += (SPOOL_GAIN * bench->current - bench->spool) * TICK / SPOOL_LAG;
    bench->speed = JACK_GAIN * bench->spool;
    bench->jack += bench->speed * TICK;
    codes[0] = convert(bench->current, eha_fcc_servo_telemetry_servo_current_decode,
                       eha_fcc_servo_telemetry_servo_current_is_in_range);
    codes[1] = convert(bench->spool, eha_fcc_servo_telemetry_spool_position_decode,
                       eha_fcc_servo_telemetry_spool_position_is_in_range);
    codes[2] = convert(DRAG * bench->speed, eha_fcc_servo_telemetry_diff_pressure_decode,
                       eha_fcc_servo_telemetry_diff_pressure_is_in_range);
    codes[3] = convert(bench->jack, eha_fcc_servo_telemetry_jack_position_decode,
                       eha_fcc_servo_telemetry_jack_position_is_in_range);
}
