/* Stands in for servovalve, jack, control law and converters when no rig is there.
 *
 * A first-order spool and a jack that moves in proportion to it: enough to answer the protocol with
 * samples that move. It has no friction, no load and no faults: nothing to diagnose. */
#ifndef FCC_BENCH_H
#define FCC_BENCH_H

#include <stdint.h>

#include "node.h"

struct fcc_bench {
    double current; /* mA */
    double spool;   /* mm */
    double jack;    /* mm */
    double speed;   /* mm/s */
};

/* Hold a command for one tick, then read the four converters. */
void fcc_bench_tick(struct fcc_bench *bench, const struct fcc_command *command, uint16_t codes[4]);

#endif
