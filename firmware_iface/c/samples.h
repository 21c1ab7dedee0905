/* Raw numbers of the bus as the SI units in which monitor and identification take them; the digits
 * are those of the same recording decoded on the ground, so compile without contraction
 * (-ffp-contract=off). */
#ifndef FCC_SAMPLES_H
#define FCC_SAMPLES_H

#include <stdint.h>

#include "node.h"

struct fcc_sample {
    double command;  /* A or m */
    double current;  /* A */
    double spool;    /* m */
    double pressure; /* Pa */
    double position; /* m */
};

struct fcc_around {
    double oil;            /* degC */
    double supply, ret;    /* Pa */
};

/* The sample of a tick from its command and its four converters. */
struct fcc_sample fcc_sample_of(const struct fcc_command *command, const uint16_t codes[4]);

/* The same of a telemetry and a command message of one tick. */
struct fcc_sample fcc_sample_of_frames(const struct eha_fcc_servo_telemetry_t *telemetry,
                                       const struct eha_fcc_servo_command_t *command);

struct fcc_around fcc_around_of(const struct fcc_rig *rig);

#endif
