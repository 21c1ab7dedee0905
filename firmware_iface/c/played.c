#include "played.h"

#include <string.h>

void fcc_played_tick(struct fcc_played *played, const struct fcc_command *command,
                     uint16_t codes[4])
{
    const uint16_t rest[4] = {
        eha_fcc_servo_telemetry_servo_current_encode(0.0),
        eha_fcc_servo_telemetry_spool_position_encode(0.0),
        eha_fcc_servo_telemetry_diff_pressure_encode(0.0),
        eha_fcc_servo_telemetry_jack_position_encode(0.0),
    };

    if (command->test_id == 0) {
        played->place = 0;
    }
    if (command->test_id == 0 || played->place >= played->count) {
        memcpy(codes, rest, sizeof rest);
    } else {
        memcpy(codes, played->codes[played->place++], sizeof rest);
    }
}
