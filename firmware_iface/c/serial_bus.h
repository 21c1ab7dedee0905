/* A serial line or pseudo-terminal as the bus of a program, 8N1, 921600 baud (BUS-15). POSIX. */
#ifndef FCC_SERIAL_BUS_H
#define FCC_SERIAL_BUS_H

#include "run.h"

/* Open the one line of a program; false, with errno, if it cannot be. */
bool fcc_serial_open(const char *channel, struct fcc_bus *bus);

#endif
