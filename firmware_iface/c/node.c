#include "node.h"

#include <math.h>
#include <string.h>

#define CURRENT EHA_FCC_SERVO_COMMAND_COMMAND_MODE_CURRENT_CHOICE
#define POSITION EHA_FCC_SERVO_COMMAND_COMMAND_MODE_POSITION_CHOICE
#define START EHA_FCC_BIT_REQUEST_REQUEST_CODE_START_CHOICE
#define ABORT EHA_FCC_BIT_REQUEST_REQUEST_CODE_ABORT_CHOICE

enum { TELEMETRY, COMMAND, ENVIRONMENT, STATUS }; /* places of the counters */

static bool busy(const struct fcc_node *node)
{
    return node->state == FCC_ARMING || node->state == FCC_RUNNING;
}

static void enter(struct fcc_node *node, enum fcc_state state, uint8_t test_id)
{
    node->state = state;
    node->test_id = test_id;
    node->since = node->tick;
    node->told = false;
}

static enum fcc_reason objection(const struct fcc_node *node, uint8_t test_id)
{
    if (busy(node)) {
        return FCC_ALREADY_RUNNING;
    }
    if (fcc_test_find(test_id) == NULL) {
        return FCC_UNKNOWN_TEST;
    }
    if (node->rig.interlock_open) {
        return FCC_INTERLOCK;
    }
    if (node->rig.supply < node->rig.ret + FCC_LEAST_SUPPLY) {
        return FCC_SUPPLY_LOW;
    }
    if (node->rig.oil < FCC_COLDEST_OIL) {
        return FCC_OIL_COLD;
    }
    if (fabs(eha_fcc_servo_telemetry_jack_position_decode(node->position)) > FCC_OFF_CENTRE) {
        return FCC_NOT_CENTRED;
    }
    return FCC_NO_REASON;
}

enum fcc_reason fcc_node_start(struct fcc_node *node, uint8_t test_id)
{
    enum fcc_reason reason = objection(node, test_id);

    node->refusal = reason;
    node->refused_id = test_id;
    if (reason == FCC_NO_REASON) {
        node->test = fcc_test_find(test_id);
        node->elapsed = 0;
        enter(node, FCC_ARMING, test_id);
    } else if (!busy(node)) {
        enter(node, FCC_REFUSED, test_id);
    } /* otherwise the refusal is said once, and the running test goes on */
    return reason;
}

bool fcc_node_abort(struct fcc_node *node)
{
    if (!busy(node)) {
        return false;
    }
    enter(node, FCC_ABORTED, node->test_id);
    return true;
}

/* Change the state when its time is up. */
static void advance(struct fcc_node *node)
{
    uint32_t elapsed = node->tick - node->since;

    switch (node->state) {
    case FCC_ARMING:
        if (elapsed >= FCC_ARMING_TICKS) {
            enter(node, FCC_RUNNING, node->test_id);
        }
        break;
    case FCC_RUNNING:
        if (elapsed >= fcc_test_ticks(node->test)) {
            node->elapsed = (uint16_t)elapsed;
            enter(node, FCC_COMPLETE, node->test_id);
        }
        break;
    case FCC_COMPLETE:
    case FCC_ABORTED:
    case FCC_REFUSED:
        if (elapsed >= FCC_HOLD_TICKS) {
            node->elapsed = 0;
            node->refusal = FCC_NO_REASON;
            enter(node, FCC_IDLE, 0);
        }
        break;
    case FCC_IDLE:
        break;
    }
}

void fcc_node_init(struct fcc_node *node, uint16_t serial, const struct fcc_rig *rig)
{
    memset(node, 0, sizeof *node);
    node->rig = *rig;
    node->serial = serial;
    node->state = FCC_IDLE;
    node->position = eha_fcc_servo_telemetry_jack_position_encode(0.0);
    node->refusal = FCC_NO_REASON;
}

void fcc_node_take(struct fcc_node *node, const struct fcc_frame *frame)
{
    struct eha_fcc_bit_request_t request;

    if (!fcc_unpack_request(frame, &request)) {
        return;
    }
    if (node->pending < FCC_REQUESTS) {
        node->requests[node->pending++] = request;
    } else if (request.request_code == ABORT) {
        node->requests[FCC_REQUESTS - 1] = request; /* a flood must not keep out an abort */
    }
}

struct fcc_command fcc_node_begin(struct fcc_node *node)
{
    struct fcc_command command = {POSITION, 0, 0}; /* hold the surface in the middle */
    size_t i;

    for (i = 0; i < node->pending; i++) {
        if (node->requests[i].request_code == START) {
            (void)fcc_node_start(node, node->requests[i].request_test_id);
        } else if (node->requests[i].request_code == ABORT) {
            (void)fcc_node_abort(node);
        }
    }
    node->pending = 0;
    advance(node);
    if (node->state == FCC_RUNNING) {
        node->elapsed = (uint16_t)(node->tick - node->since);
        command.mode = node->test->mode;
        command.value = fcc_test_command(node->test, node->elapsed);
        command.test_id = node->test_id;
    } else if (node->state == FCC_ABORTED) {
        command.mode = CURRENT;
    }
    node->command = command;
    return command;
}

static size_t say_status(struct fcc_node *node, struct fcc_frame *frames)
{
    enum fcc_reason reason = FCC_NO_REASON;
    bool due = node->tick % FCC_STATUS_TICKS == 0 || !node->told;
    size_t count = 0;

    if (node->state == FCC_REFUSED) {
        reason = node->refusal;
    } else if (busy(node) && node->refusal != FCC_NO_REASON) {
        fcc_pack_status(&frames[count++], FCC_REFUSED, (uint8_t)node->refusal, node->refused_id, 0,
                        node->serial, &node->counters[STATUS]);
        node->refusal = FCC_NO_REASON;
        due = true;
    }
    if (due) {
        fcc_pack_status(&frames[count++], (uint8_t)node->state, (uint8_t)reason, node->test_id,
                        node->elapsed, node->serial, &node->counters[STATUS]);
        node->told = true;
    }
    return count;
}

size_t fcc_node_end(struct fcc_node *node, const uint16_t codes[4],
                    struct fcc_frame frames[FCC_FRAMES_PER_TICK])
{
    size_t count = say_status(node, frames);

    fcc_pack_command(&frames[count++], node->command.mode, node->command.value,
                     node->command.test_id, &node->counters[COMMAND]);
    fcc_pack_telemetry(&frames[count++], codes, &node->counters[TELEMETRY]);
    if (node->tick % FCC_ENVIRONMENT_TICKS == 0) {
        fcc_pack_environment(&frames[count++], node->rig.supply, node->rig.ret, node->rig.oil,
                             &node->counters[ENVIRONMENT]);
    }
    node->position = codes[3];
    node->tick++;
    return count;
}
