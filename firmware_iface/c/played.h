/* Stands in for actuator and converters with what the converters of a recorded test read, so that
 * there is something to diagnose where no rig is. */
#ifndef FCC_PLAYED_H
#define FCC_PLAYED_H

#include <stddef.h>
#include <stdint.h>

#include "node.h"

struct fcc_played {
    const uint16_t (*codes)[4]; /* of each tick of the test */
    size_t count;
    size_t place;
};

/* Codes of the tick in which the command holds: those of the recording while a test runs. */
void fcc_played_tick(struct fcc_played *played, const struct fcc_command *command,
                     uint16_t codes[4]);

#endif
