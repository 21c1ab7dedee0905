#include "diagnosis.h"

#include <string.h>

#include "samples.h"

static bool with_background(const struct fcc_diagnosis *diagnosis)
{
    return diagnosis->stage == FCC_IDENTIFYING;
}

void fcc_diagnosis_init(struct fcc_diagnosis *diagnosis)
{
    memset(diagnosis, 0, sizeof *diagnosis);
    diagnosis->stage = FCC_NOTHING;
}

static void record(struct fcc_diagnosis *diagnosis, const struct fcc_node *node,
                   const uint16_t codes[4])
{
    const struct fcc_sample sample = fcc_sample_of(&node->command, codes);

    if (node->elapsed == 0) {
        diagnosis->ticks = 0;
        diagnosis->test_id = node->test_id;
        diagnosis->closed =
            node->command.mode == EHA_FCC_SERVO_COMMAND_COMMAND_MODE_POSITION_CHOICE;
        diagnosis->stage = FCC_RECORDING;
    }
    if (diagnosis->stage == FCC_RECORDING && diagnosis->ticks < FCC_DIAGNOSIS_TICKS) {
        eha_tick *tick = &diagnosis->recording[diagnosis->ticks++];

        tick->command = sample.command;
        tick->current = sample.current;
        tick->spool = sample.spool;
        tick->pressure = sample.pressure;
        tick->position = sample.position;
    }
}

/* Hand a whole test to the background. */
static void hand_over(struct fcc_diagnosis *diagnosis, const struct fcc_node *node)
{
    diagnosis->rig = node->rig;
    diagnosis->serial = node->serial;
    diagnosis->begun = false;
    diagnosis->runs = 0;
    diagnosis->stop = false;
    diagnosis->stage = FCC_IDENTIFYING;
}

static void follow(struct fcc_diagnosis *diagnosis, const struct fcc_node *node,
                   const uint16_t codes[4])
{
    if (with_background(diagnosis)) {
        diagnosis->stop = node->state == FCC_ARMING || node->state == FCC_RUNNING;
        return;
    }
    switch (node->state) {
    case FCC_ARMING:
        diagnosis->stage = FCC_NOTHING;
        break;
    case FCC_RUNNING:
        record(diagnosis, node, codes);
        break;
    case FCC_COMPLETE:
        if (diagnosis->stage == FCC_RECORDING) {
            hand_over(diagnosis, node);
        }
        break;
    case FCC_ABORTED:
    case FCC_REFUSED:
    case FCC_IDLE:
        if (diagnosis->stage == FCC_RECORDING) {
            diagnosis->stage = FCC_GIVEN_UP;
        }
        break;
    }
}

size_t fcc_diagnosis_tick(struct fcc_diagnosis *diagnosis, const struct fcc_node *node,
                          const uint16_t codes[4], struct fcc_frame frames[FCC_DIAGNOSIS_FRAMES])
{
    const eha_identification *found = &diagnosis->job;
    uint8_t *counters = diagnosis->counters;
    uint8_t verdict;
    bool done;

    follow(diagnosis, node, codes);
    if (node->tick % FCC_DIAGNOSIS_PERIOD != 0) {
        return 0;
    }
    done = diagnosis->stage == FCC_DONE;
    verdict = (uint8_t)(done ? found->verdict : EHA_NOT_TESTED);
    fcc_pack_onboard_verdict(&frames[0], diagnosis->stage, diagnosis->test_id, verdict,
                             diagnosis->runs, &counters[0]);
    if (!done) {
        return 1;
    }
    fcc_pack_onboard_kintas(&frames[1], found->kintas, found->std_kintas, &counters[1]);
    fcc_pack_onboard_fss(&frames[2], found->fss, found->std_fss, &counters[2]);
    fcc_pack_onboard_fdj(&frames[3], found->fdj, found->std_fdj, &counters[3]);
    return FCC_DIAGNOSIS_FRAMES;
}

/* Begin; false if a number of the rig is out of its range. */
static bool begin(struct fcc_diagnosis *diagnosis)
{
    const struct fcc_around around = fcc_around_of(&diagnosis->rig);
    const eha_environment environment = {around.oil, around.supply, around.ret};
    eha_unit unit = EHA_UNIT_DEFAULT;

    unit.closed = diagnosis->closed ? 1.0 : 0.0;
    unit.serial = (double)diagnosis->serial;
    return eha_unit_environment(&unit, &environment) == 0 &&
           eha_identify_begin(&diagnosis->job, &unit) == 0;
}

bool fcc_diagnosis_work(struct fcc_diagnosis *diagnosis, double work)
{
    const eha_slice slice = {(double)diagnosis->ticks, work};
    int32_t going = EHA_IDENTIFY_GOES_ON;

    if (!with_background(diagnosis)) {
        return false;
    }
    if (diagnosis->stop) {
        diagnosis->stage = FCC_NOTHING;
        return false;
    }
    if (diagnosis->begun) {
        going = eha_identify_run(&diagnosis->job, diagnosis->recording, &slice);
        diagnosis->runs = (uint16_t)diagnosis->job.runs;
    } else if (begin(diagnosis)) {
        diagnosis->begun = true;
    } else {
        going = EHA_ERROR_RANGE;
    }
    if (going != EHA_IDENTIFY_GOES_ON) {
        diagnosis->stage = going == EHA_IDENTIFY_DONE ? FCC_DONE : FCC_GIVEN_UP;
    }
    return true;
}
