/* What the two programs share: options, the clock, and the loop over ticks. POSIX. */
#ifndef FCC_RUN_H
#define FCC_RUN_H

#include <stdbool.h>
#include <stdint.h>

#include "frames.h"

/* A bus, without blocking. Both calls end the program by returning false when the bus is lost. */
struct fcc_bus {
    void *self;
    /* Fill frame if one has come, and say so in got. */
    bool (*receive)(void *self, struct fcc_frame *frame, bool *got);
    /* A bus that is full may drop the frame: the control law does not wait. */
    bool (*send)(void *self, const struct fcc_frame *frame, uint32_t time_us);
};

/* Read the options after the first argument (the bus) and run until SIGINT, SIGTERM, --ticks or the
 * loss of the bus. Returns the exit status: 0; 1 bus lost; 2 wrong options. */
int fcc_run(int argc, char **argv, const char *channel,
            bool (*open_bus)(const char *channel, struct fcc_bus *bus));

#endif
