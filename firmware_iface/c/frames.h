/* Frames of the default bus: packed and unpacked by the code that cantools generates, guarded by
 * counter and check sum here. Values are the raw numbers of the DBC's signals. */
#ifndef FCC_FRAMES_H
#define FCC_FRAMES_H

#include <stdbool.h>
#include <stdint.h>

#include "generated/eha_fcc.h"

struct fcc_frame {
    uint16_t id; /* 11 bits */
    uint8_t data[8];
};

/* Each call fills counter and check sum, packs the frame, and moves the counter on. */
void fcc_pack_telemetry(struct fcc_frame *frame, const uint16_t codes[4], uint8_t *counter);
void fcc_pack_command(struct fcc_frame *frame, uint8_t mode, int16_t value, uint8_t test_id,
                      uint8_t *counter);
void fcc_pack_environment(struct fcc_frame *frame, uint16_t supply, uint16_t ret, uint16_t oil,
                          uint8_t *counter);
void fcc_pack_status(struct fcc_frame *frame, uint8_t state, uint8_t reason, uint8_t test_id,
                     uint16_t elapsed, uint16_t serial, uint8_t *counter);
void fcc_pack_request(struct fcc_frame *frame, uint8_t code, uint8_t test_id, uint8_t *counter);
void fcc_pack_onboard_verdict(struct fcc_frame *frame, uint8_t state, uint8_t test_id,
                              uint8_t verdict, uint16_t runs, uint8_t *counter);

/* A severity and its standard deviation; what the signal cannot hold is cut at its end. */
void fcc_pack_onboard_kintas(struct fcc_frame *frame, double severity, double deviation,
                             uint8_t *counter);
void fcc_pack_onboard_fss(struct fcc_frame *frame, double severity, double deviation,
                          uint8_t *counter);
void fcc_pack_onboard_fdj(struct fcc_frame *frame, double severity, double deviation,
                          uint8_t *counter);

/* Whether the check sum is that of identifier and payload. */
bool fcc_intact(const struct fcc_frame *frame);

/* False for another identifier or a wrong check sum. */
bool fcc_unpack_telemetry(const struct fcc_frame *frame, struct eha_fcc_servo_telemetry_t *out);
bool fcc_unpack_command(const struct fcc_frame *frame, struct eha_fcc_servo_command_t *out);
bool fcc_unpack_environment(const struct fcc_frame *frame, struct eha_fcc_environment_t *out);
bool fcc_unpack_status(const struct fcc_frame *frame, struct eha_fcc_bit_status_t *out);
bool fcc_unpack_request(const struct fcc_frame *frame, struct eha_fcc_bit_request_t *out);

#endif
