#include "stored_tests.h"

#include <math.h>

#include "frames.h"

#define CURRENT EHA_FCC_SERVO_COMMAND_COMMAND_MODE_CURRENT_CHOICE
#define POSITION EHA_FCC_SERVO_COMMAND_COMMAND_MODE_POSITION_CHOICE
#define COUNT(array) (sizeof(array) / sizeof(array)[0])

static const double TWO_PI = 6.283185307179586;

/* ehadiag/data/tests/open.toml */
static const struct fcc_point open_points[] = {
    {0, 0.0f},      {200, 0.0f},   {700, 1.5f},   {1700, -1.5f}, {2200, 0.0f},
    {2400, 0.0f},   {2400, 10.0f}, {2500, 10.0f}, {2500, -10.0f}, {2700, -10.0f},
    {2700, 10.0f},  {2800, 10.0f}, {2800, 0.0f},  {3500, 0.0f},
};
static const struct fcc_segment open_segments[] = {
    {0, 3500, 0.0f, 0.0f, open_points, COUNT(open_points)},
    {3500, 4500, 3.0f, 3.0f, NULL, 0},
    {4500, 5500, 8.0f, 25.0f, NULL, 0},
};

/* ehadiag/data/tests/closed.toml */
static const struct fcc_point closed_points[] = {
    {0, 0.0f},      {200, 0.0f},     {1200, 10.0f}, {1700, 10.0f},
    {1700, -10.0f}, {2300, -10.0f},  {3300, 0.0f},  {3500, 0.0f},
};
static const struct fcc_segment closed_segments[] = {
    {0, 3500, 0.0f, 0.0f, closed_points, COUNT(closed_points)},
    {3500, 4500, 4.0f, 2.0f, NULL, 0},
    {4500, 5500, 3.0f, 7.0f, NULL, 0},
};

static const struct fcc_test tests[] = {
    {1, CURRENT, open_segments, COUNT(open_segments)},
    {2, POSITION, closed_segments, COUNT(closed_segments)},
};

const struct fcc_test *fcc_test_find(uint8_t id)
{
    size_t i;

    for (i = 0; i < COUNT(tests); i++) {
        if (tests[i].id == id) {
            return &tests[i];
        }
    }
    return NULL;
}

uint16_t fcc_test_ticks(const struct fcc_test *test)
{
    return test->segments[test->count - 1].end_ms;
}

/* At a step, and where segments meet, the tick that starts there still has the earlier value. */
static double polyline(const struct fcc_segment *segment, uint16_t ms)
{
    const struct fcc_point *point = segment->points + 1;
    double share;

    while (point->ms < ms && point < segment->points + segment->count - 1) {
        point++;
    }
    if (point->ms == point[-1].ms) {
        return point[-1].value;
    }
    share = (double)(ms - point[-1].ms) / (double)(point->ms - point[-1].ms);
    return point[-1].value + (double)(point->value - point[-1].value) * share;
}

int16_t fcc_test_command(const struct fcc_test *test, uint16_t tick)
{
    const struct fcc_segment *segment = test->segments;
    double value, lsb = test->mode == CURRENT
                            ? eha_fcc_servo_command_current_command_decode(1)
                            : eha_fcc_servo_command_position_command_decode(1);

    while (segment->end_ms < tick && segment < test->segments + test->count - 1) {
        segment++;
    }
    if (segment->points != NULL) {
        value = polyline(segment, tick);
    } else {
        value = segment->amplitude *
                sin(TWO_PI * segment->frequency * (tick - segment->start_ms) / 1000.0);
    }
    return (int16_t)lrint(value / lsb);
}
