/* What the programs share: options, the clock, and the loop over ticks. POSIX. */
#ifndef FCC_RUN_H
#define FCC_RUN_H

#include <stdbool.h>
#include <stdint.h>

#include "node.h"
#include "uds.h"

/* A bus, without blocking. Both calls end the program by returning false when the bus is lost. */
struct fcc_bus {
    void *self;
    /* Fill frame if one has come, and say so in got. */
    bool (*receive)(void *self, struct fcc_frame *frame, bool *got);
    /* A bus that is full may drop the frame: the control law does not wait. */
    bool (*send)(void *self, const struct fcc_frame *frame, uint32_t time_us);
};

#define FCC_RIDER_FRAMES 4u

/* What a program does with each tick of the node. */
struct fcc_rider {
    void *self;
    /* Hold the command for a tick, then read the four converters. */
    void (*convert)(void *self, const struct fcc_command *command, uint16_t codes[4]);
    /* Behind fcc_node_end; returns how many further frames are to be sent. NULL: nothing. */
    size_t (*after)(void *self, const struct fcc_node *node, const uint16_t codes[4],
                    struct fcc_frame frames[FCC_RIDER_FRAMES]);
    /* What there is to do between two ticks, which wait for it. NULL: nothing. */
    void (*spare)(void *self);
    /* Jack position to begin with, mm, as the option said; NULL: not used. */
    void (*place)(void *self, double jack);
};

/* The placeholder of bench.h. */
struct fcc_rider fcc_bench_rider(void);

/* Read the options after the first argument (the bus) and run until SIGINT, SIGTERM, --ticks or the
 * loss of the bus. Returns the exit status: 0; 1 bus lost; 2 wrong options. */
int fcc_run(int argc, char **argv, const char *channel,
            bool (*open_bus)(const char *channel, struct fcc_bus *bus),
            const struct fcc_rider *rider);

#endif
