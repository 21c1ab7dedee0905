#include "bench.h"

#include <math.h>

static const double TICK = 1e-3;        /* s */
static const double MOST_CURRENT = 10;  /* mA */
static const double LOOP_GAIN = 2;      /* mA per mm */
static const double SPOOL_GAIN = 0.04;  /* mm per mA */
static const double SPOOL_LAG = 5e-3;   /* s */
static const double JACK_GAIN = 300;    /* mm/s per mm */
static const double DRAG = 0.02;        /* MPa per mm/s */

static uint16_t convert(double value, double full_scale)
{
    double code = floor(value / full_scale * 2048.0 + 0.5) + 2048.0;

    return (uint16_t)fmin(fmax(code, 0.0), 4095.0);
}

void fcc_bench_tick(struct fcc_bench *bench, const struct fcc_command *command, uint16_t codes[4])
{
    double wanted;

    if (command->mode == EHA_FCC_SERVO_COMMAND_COMMAND_MODE_CURRENT_CHOICE) {
        wanted = 0.0005 * command->value;
    } else {
        wanted = LOOP_GAIN * (0.002 * command->value - bench->jack);
    }
    bench->current = fmin(fmax(wanted, -MOST_CURRENT), MOST_CURRENT);
    bench->spool += (SPOOL_GAIN * bench->current - bench->spool) * TICK / SPOOL_LAG;
    bench->speed = JACK_GAIN * bench->spool;
    bench->jack += bench->speed * TICK;
    codes[0] = convert(bench->current, 12.0);
    codes[1] = convert(bench->spool, 0.5);
    codes[2] = convert(DRAG * bench->speed, 25.0);
    codes[3] = convert(bench->jack, 60.0);
}
