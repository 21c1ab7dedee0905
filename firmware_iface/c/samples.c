#include "samples.h"

#define MILLI 1e-3
#define MEGA 1e6

struct fcc_sample fcc_sample_of(const struct fcc_command *command, const uint16_t codes[4])
{
    struct fcc_sample sample;

    if (command->mode == EHA_FCC_SERVO_COMMAND_COMMAND_MODE_CURRENT_CHOICE) {
        sample.command = eha_fcc_servo_command_current_command_decode(command->value) * MILLI;
    } else {
        sample.command = eha_fcc_servo_command_position_command_decode(command->value) * MILLI;
    }
    sample.current = eha_fcc_servo_telemetry_servo_current_decode(codes[0]) * MILLI;
    sample.spool = eha_fcc_servo_telemetry_spool_position_decode(codes[1]) * MILLI;
    sample.pressure = eha_fcc_servo_telemetry_diff_pressure_decode(codes[2]) * MEGA;
    sample.position = eha_fcc_servo_telemetry_jack_position_decode(codes[3]) * MILLI;
    return sample;
}

struct fcc_sample fcc_sample_of_frames(const struct eha_fcc_servo_telemetry_t *telemetry,
                                       const struct eha_fcc_servo_command_t *command)
{
    const uint16_t codes[4] = {telemetry->servo_current, telemetry->spool_position,
                               telemetry->diff_pressure, telemetry->jack_position};
    struct fcc_command active = {0, 0, 0};

    active.mode = command->command_mode;
    active.value = active.mode == EHA_FCC_SERVO_COMMAND_COMMAND_MODE_CURRENT_CHOICE
                       ? command->current_command
                       : command->position_command;
    active.test_id = command->command_test_id;
    return fcc_sample_of(&active, codes);
}

struct fcc_around fcc_around_of(const struct fcc_rig *rig)
{
    struct fcc_around around;

    around.oil = eha_fcc_environment_oil_temperature_decode(rig->oil);
    around.supply = eha_fcc_environment_supply_pressure_decode(rig->supply) * MEGA;
    around.ret = eha_fcc_environment_return_pressure_decode(rig->ret) * MEGA;
    return around;
}
