#include "frames.h"

#include "check.h"

#define MOST_FRACTION 0xFFFFFFu /* of 24 bits */

/* Every message of this bus has its counter in byte 6 and its check sum in byte 7. */
static void seal(struct fcc_frame *frame, uint16_t id, uint8_t *counter)
{
    frame->id = id;
    frame->data[6] = (*counter)++;
    frame->data[7] = fcc_crc8(id, frame->data);
}

void fcc_pack_telemetry(struct fcc_frame *frame, const uint16_t codes[4], uint8_t *counter)
{
    struct eha_fcc_servo_telemetry_t message = {0};

    message.servo_current = codes[0];
    message.spool_position = codes[1];
    message.diff_pressure = codes[2];
    message.jack_position = codes[3];
    (void)eha_fcc_servo_telemetry_pack(frame->data, &message, sizeof frame->data);
    seal(frame, EHA_FCC_SERVO_TELEMETRY_FRAME_ID, counter);
}

void fcc_pack_command(struct fcc_frame *frame, uint8_t mode, int16_t value, uint8_t test_id,
                      uint8_t *counter)
{
    struct eha_fcc_servo_command_t message = {0};

    message.command_mode = mode;
    message.command_test_id = test_id;
    if (mode == EHA_FCC_SERVO_COMMAND_COMMAND_MODE_CURRENT_CHOICE) {
        message.current_command = value;
    } else {
        message.position_command = value;
    }
    (void)eha_fcc_servo_command_pack(frame->data, &message, sizeof frame->data);
    seal(frame, EHA_FCC_SERVO_COMMAND_FRAME_ID, counter);
}

void fcc_pack_environment(struct fcc_frame *frame, uint16_t supply, uint16_t ret, uint16_t oil,
                          uint8_t *counter)
{
    struct eha_fcc_environment_t message = {0};

    message.supply_pressure = supply;
    message.return_pressure = ret;
    message.oil_temperature = oil;
    (void)eha_fcc_environment_pack(frame->data, &message, sizeof frame->data);
    seal(frame, EHA_FCC_ENVIRONMENT_FRAME_ID, counter);
}

void fcc_pack_status(struct fcc_frame *frame, uint8_t state, uint8_t reason, uint8_t test_id,
                     uint16_t elapsed, uint16_t serial, uint8_t *counter)
{
    struct eha_fcc_bit_status_t message = {0};

    message.bit_state = state;
    message.bit_reason = reason;
    message.status_test_id = test_id;
    message.elapsed_time = elapsed;
    message.actuator_serial = serial;
    (void)eha_fcc_bit_status_pack(frame->data, &message, sizeof frame->data);
    seal(frame, EHA_FCC_BIT_STATUS_FRAME_ID, counter);
}

void fcc_pack_request(struct fcc_frame *frame, uint8_t code, uint8_t test_id, uint8_t *counter)
{
    struct eha_fcc_bit_request_t message = {0};

    message.request_code = code;
    message.request_test_id = test_id;
    (void)eha_fcc_bit_request_pack(frame->data, &message, sizeof frame->data);
    seal(frame, EHA_FCC_BIT_REQUEST_FRAME_ID, counter);
}

void fcc_pack_onboard_verdict(struct fcc_frame *frame, uint8_t state, uint8_t test_id,
                              uint8_t verdict, uint16_t runs, uint8_t *counter)
{
    struct eha_fcc_onboard_verdict_t message = {0};

    message.onboard_state = state;
    message.onboard_test_id = test_id;
    message.onboard_verdict = verdict;
    message.onboard_runs = runs;
    (void)eha_fcc_onboard_verdict_pack(frame->data, &message, sizeof frame->data);
    seal(frame, EHA_FCC_ONBOARD_VERDICT_FRAME_ID, counter);
}

/* Raw number of a severity or deviation, 1e-7, nearest; a NaN is 0. */
static uint32_t fraction(double value)
{
    if (!(value > 0.0)) {
        return 0;
    }
    return value < MOST_FRACTION * 1e-7 ? (uint32_t)(value * 1e7 + 0.5) : MOST_FRACTION;
}

void fcc_pack_onboard_kintas(struct fcc_frame *frame, double severity, double deviation,
                             uint8_t *counter)
{
    struct eha_fcc_onboard_kintas_t message = {0};

    message.severity_kintas = fraction(severity);
    message.deviation_kintas = fraction(deviation);
    (void)eha_fcc_onboard_kintas_pack(frame->data, &message, sizeof frame->data);
    seal(frame, EHA_FCC_ONBOARD_KINTAS_FRAME_ID, counter);
}

void fcc_pack_onboard_fss(struct fcc_frame *frame, double severity, double deviation,
                          uint8_t *counter)
{
    struct eha_fcc_onboard_fss_t message = {0};

    message.severity_fss = fraction(severity);
    message.deviation_fss = fraction(deviation);
    (void)eha_fcc_onboard_fss_pack(frame->data, &message, sizeof frame->data);
    seal(frame, EHA_FCC_ONBOARD_FSS_FRAME_ID, counter);
}

void fcc_pack_onboard_fdj(struct fcc_frame *frame, double severity, double deviation,
                          uint8_t *counter)
{
    struct eha_fcc_onboard_fdj_t message = {0};

    message.severity_fdj = fraction(severity);
    message.deviation_fdj = fraction(deviation);
    (void)eha_fcc_onboard_fdj_pack(frame->data, &message, sizeof frame->data);
    seal(frame, EHA_FCC_ONBOARD_FDJ_FRAME_ID, counter);
}

bool fcc_intact(const struct fcc_frame *frame)
{
    return fcc_crc8(frame->id, frame->data) == frame->data[7];
}

bool fcc_unpack_telemetry(const struct fcc_frame *frame, struct eha_fcc_servo_telemetry_t *out)
{
    return frame->id == EHA_FCC_SERVO_TELEMETRY_FRAME_ID && fcc_intact(frame) &&
           eha_fcc_servo_telemetry_unpack(out, frame->data, sizeof frame->data) == 0;
}

bool fcc_unpack_command(const struct fcc_frame *frame, struct eha_fcc_servo_command_t *out)
{
    return frame->id == EHA_FCC_SERVO_COMMAND_FRAME_ID && fcc_intact(frame) &&
           eha_fcc_servo_command_unpack(out, frame->data, sizeof frame->data) == 0;
}

bool fcc_unpack_environment(const struct fcc_frame *frame, struct eha_fcc_environment_t *out)
{
    return frame->id == EHA_FCC_ENVIRONMENT_FRAME_ID && fcc_intact(frame) &&
           eha_fcc_environment_unpack(out, frame->data, sizeof frame->data) == 0;
}

bool fcc_unpack_status(const struct fcc_frame *frame, struct eha_fcc_bit_status_t *out)
{
    return frame->id == EHA_FCC_BIT_STATUS_FRAME_ID && fcc_intact(frame) &&
           eha_fcc_bit_status_unpack(out, frame->data, sizeof frame->data) == 0;
}

bool fcc_unpack_request(const struct fcc_frame *frame, struct eha_fcc_bit_request_t *out)
{
    return frame->id == EHA_FCC_BIT_REQUEST_FRAME_ID && fcc_intact(frame) &&
           eha_fcc_bit_request_unpack(out, frame->data, sizeof frame->data) == 0;
}
