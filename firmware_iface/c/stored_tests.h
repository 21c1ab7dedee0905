/* The stored tests PHY-25 and PHY-26, as the computer plays them. */
#ifndef FCC_STORED_TESTS_H
#define FCC_STORED_TESTS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* A corner of a polyline; a time given twice is a step. Values in mA or mm. */
struct fcc_point {
    uint16_t ms;
    float value;
};

/* A polyline when it has points, otherwise amplitude * sin(2 pi frequency (t - start)). */
struct fcc_segment {
    uint16_t start_ms, end_ms;
    float amplitude; /* mA or mm */
    float frequency; /* Hz */
    const struct fcc_point *points;
    size_t count;
};

struct fcc_test {
    uint8_t id;
    uint8_t mode; /* CommandMode: 1 current, 2 position */
    const struct fcc_segment *segments;
    size_t count;
};

/* The test of that number, NULL if there is none. */
const struct fcc_test *fcc_test_find(uint8_t id);

/* Length in ticks of 1 ms. */
uint16_t fcc_test_ticks(const struct fcc_test *test);

/* Command of a tick, raw: 0.5 uA or 2 um. */
int16_t fcc_test_command(const struct fcc_test *test, uint16_t tick);

#endif
