#include "uds.h"

#include <string.h>

enum { READ_CODES = 0x19, READ_DATA = 0x22, ROUTINE_CONTROL = 0x31 };
enum { START = 1, STOP = 2, RESULTS = 3 };
enum { BY_STATUS_MASK = 0x02, SNAPSHOT = 0x04, SUPPORTED = 0x0A };
enum { SINGLE = 0, FIRST = 1, CONSECUTIVE = 2, FLOW = 3 };
enum { PADDING = 0xCC, FIRST_BYTES = 6, NEXT_BYTES = 7 };
enum code {
    POSITIVE = 0,
    NO_SERVICE = 0x11,
    NO_SUBFUNCTION = 0x12,
    WRONG_LENGTH = 0x13,
    BUSY = 0x21,
    CONDITIONS = 0x22,
    SEQUENCE = 0x24,
    OUT_OF_RANGE = 0x31
};

#define NEGATIVE 0x7Fu
#define ROUTINE 0x0201u
#define ONBOARD 0x0120u
#define OFFSETS 0x0121u
#define SERIAL 0xF18Cu
#define SOFTWARE 0xF195u
#define NOT_TESTED 30u
#define AVAILABLE 0x19u
#define FAILED 0x09u
#define NOT_COMPLETED 0x10u

static const struct {
    uint32_t number;
    uint8_t verdict;
} trouble_codes[] = {{0x5A0100u, 10}, {0x5A0200u, 20}, {0x5A0300u, NOT_TESTED}};

static void put(struct fcc_uds *uds, uint32_t value, unsigned bytes)
{
    while (bytes-- > 0 && uds->size < FCC_UDS_LONGEST) {
        uds->answer[uds->size++] = (uint8_t)(value >> (8u * bytes));
    }
}

static uint32_t number_of(const uint8_t *data, unsigned bytes)
{
    uint32_t value = 0;

    while (bytes-- > 0) {
        value = value << 8 | *data++;
    }
    return value;
}

static void keep(struct fcc_uds *uds, const struct fcc_node *node)
{
    uds->requested = true;
    uds->last.state = node->state;
    uds->last.reason = FCC_NO_REASON;
    uds->last.test_id = node->test_id;
    uds->last.elapsed = node->elapsed;
}

static enum code start(struct fcc_uds *uds, struct fcc_node *node, uint8_t test_id)
{
    const bool running = node->state == FCC_ARMING || node->state == FCC_RUNNING;
    const enum fcc_reason reason = fcc_node_start(node, test_id);

    if (reason == FCC_NO_REASON) {
        keep(uds, node);
        return POSITIVE;
    }
    if (!running) {
        uds->requested = true;
        uds->last.state = FCC_REFUSED;
        uds->last.reason = reason;
        uds->last.test_id = test_id;
        uds->last.elapsed = 0;
    }
    return reason == FCC_ALREADY_RUNNING ? BUSY
           : reason == FCC_UNKNOWN_TEST  ? OUT_OF_RANGE
                                         : CONDITIONS;
}

static enum code routine(struct fcc_uds *uds, struct fcc_node *node, const uint8_t *data,
                         size_t size)
{
    enum code refused = POSITIVE;

    if (size < 4) {
        return WRONG_LENGTH;
    }
    if (data[1] < START || data[1] > RESULTS) {
        return NO_SUBFUNCTION;
    }
    if (number_of(data + 2, 2) != ROUTINE) {
        return OUT_OF_RANGE;
    }
    if (size != (data[1] == START ? 5u : 4u)) {
        return WRONG_LENGTH;
    }
    if (data[1] == START) {
        refused = start(uds, node, data[4]);
    } else if (data[1] == STOP && fcc_node_abort(node)) {
        keep(uds, node);
    } else if (data[1] == STOP || !uds->requested) {
        refused = SEQUENCE;
    }
    if (refused == POSITIVE) {
        put(uds, data[1], 1);
        put(uds, ROUTINE, 2);
        put(uds, (uint32_t)uds->last.state, 1);
        put(uds, (uint32_t)uds->last.reason, 1);
        put(uds, uds->last.test_id, 1);
        put(uds, uds->last.elapsed, 2);
        put(uds, node->serial, 2);
    }
    return refused;
}

static void put_onboard(struct fcc_uds *uds)
{
    const struct fcc_found *found = &uds->found;
    const bool done = found->state == FCC_FOUND_DONE;
    size_t i;

    put(uds, found->state, 1);
    put(uds, uds->requested ? uds->last.test_id : 0u, 1);
    put(uds, done ? found->verdict : NOT_TESTED, 1);
    put(uds, found->runs, 2);
    for (i = 0; i < 3; i++) {
        put(uds, done ? found->severity[i] : 0u, 3);
    }
    for (i = 0; i < 3; i++) {
        put(uds, done ? found->deviation[i] : 0u, 3);
    }
}

static enum code read_data(struct fcc_uds *uds, const struct fcc_node *node, const uint8_t *data,
                           size_t size)
{
    size_t at, i;

    if (size < 3 || size % 2 == 0) {
        return WRONG_LENGTH;
    }
    for (at = 1; at < size; at += 2) {
        const uint32_t number = number_of(data + at, 2);

        put(uds, number, 2);
        switch (number) {
        case ONBOARD:
            put_onboard(uds);
            break;
        case OFFSETS:
            for (i = 0; i < 4; i++) {
                put(uds, (uint16_t)uds->offsets[i], 2);
            }
            break;
        case SERIAL:
            put(uds, node->serial, 2);
            break;
        case SOFTWARE:
            for (i = 0; i < FCC_UDS_SOFTWARE; i++) {
                put(uds, (uint8_t)uds->software[i], 1);
            }
            break;
        default:
            return OUT_OF_RANGE;
        }
    }
    return POSITIVE;
}

/* Status of a trouble code: by the verdict on the last test, once there is one. */
static uint8_t code_status(const struct fcc_uds *uds, size_t i)
{
    const enum fcc_state state = uds->last.state;
    uint8_t verdict = uds->found.verdict;

    if (uds->requested && (state == FCC_ABORTED || state == FCC_REFUSED)) {
        verdict = NOT_TESTED;
    } else if (!uds->requested || state != FCC_COMPLETE || uds->found.state != FCC_FOUND_DONE) {
        return NOT_COMPLETED;
    }
    return trouble_codes[i].verdict == verdict ? FAILED : 0;
}

static enum code read_codes(struct fcc_uds *uds, const uint8_t *data, size_t size)
{
    const size_t count = sizeof trouble_codes / sizeof trouble_codes[0];
    size_t i;

    if (size < 2) {
        return WRONG_LENGTH;
    }
    if (data[1] != BY_STATUS_MASK && data[1] != SNAPSHOT && data[1] != SUPPORTED) {
        return NO_SUBFUNCTION;
    }
    if (size != (data[1] == BY_STATUS_MASK ? 3u : data[1] == SNAPSHOT ? 6u : 2u)) {
        return WRONG_LENGTH;
    }
    put(uds, data[1], 1);
    if (data[1] != SNAPSHOT) {
        put(uds, AVAILABLE, 1);
    } else if (data[5] != 1 && data[5] != 0xFF) {
        return OUT_OF_RANGE;
    }
    for (i = 0; i < count; i++) {
        const uint8_t status = code_status(uds, i);

        if (data[1] == SNAPSHOT ? number_of(data + 2, 3) == trouble_codes[i].number
                                : data[1] == SUPPORTED || (status & data[2]) != 0) {
            put(uds, trouble_codes[i].number, 3);
            put(uds, status, 1);
            if (data[1] == SNAPSHOT && status == FAILED) {
                put(uds, 0x0101u, 2); /* first snapshot, one identifier */
                put(uds, ONBOARD, 2);
                put_onboard(uds);
            }
        }
    }
    return data[1] == SNAPSHOT && uds->size == 2 ? OUT_OF_RANGE : POSITIVE;
}

static void answer(struct fcc_uds *uds, struct fcc_node *node, const uint8_t *data, size_t size)
{
    enum code code = NO_SERVICE;

    uds->size = uds->sent = 0;
    put(uds, data[0] + 0x40u, 1);
    if (data[0] == ROUTINE_CONTROL) {
        code = routine(uds, node, data, size);
    } else if (data[0] == READ_DATA) {
        code = read_data(uds, node, data, size);
    } else if (data[0] == READ_CODES) {
        code = read_codes(uds, data, size);
    }
    if (code != POSITIVE) {
        uds->size = 0;
        put(uds, NEGATIVE, 1);
        put(uds, data[0], 1);
        put(uds, (uint32_t)code, 1);
    }
}

static bool stops(const uint8_t *frame)
{
    return frame[0] == 4 && frame[1] == ROUTINE_CONTROL && frame[2] == STOP;
}

static void take_flow(struct fcc_uds *uds, const uint8_t *data)
{
    const uint8_t gap = data[2];

    if (uds->sent == 0 || uds->sent >= uds->size) {
        return; /* nothing waits for it */
    }
    uds->waited = 0;
    if ((data[0] & 0x0F) == 0) {
        uds->flowing = true;
        uds->block = data[1];
        uds->left = data[1];
        uds->gap = gap <= 0x7F ? gap : gap >= 0xF1 && gap <= 0xF9 ? 1 : 0x7F;
    } else if ((data[0] & 0x0F) != 1) { /* neither "go on" nor "wait" */
        uds->sent = uds->size;
    }
}

static uint8_t *new_frame(struct fcc_frame *frame)
{
    frame->id = FCC_UDS_RESPONSE_ID;
    memset(frame->data, PADDING, sizeof frame->data);
    return frame->data;
}

/* The next frame of the answer, if it may be sent now. */
static size_t send(struct fcc_uds *uds, struct fcc_frame *frame)
{
    const size_t rest = uds->size - uds->sent;
    uint8_t *data;
    size_t bytes;

    if (rest == 0) {
        return 0;
    }
    if (uds->sent == 0 && uds->size < sizeof frame->data) {
        data = new_frame(frame);
        data[0] = (uint8_t)uds->size;
        memcpy(data + 1, uds->answer, uds->size);
        uds->sent = uds->size;
        return 1;
    }
    if (uds->sent == 0) {
        data = new_frame(frame);
        data[0] = (uint8_t)(FIRST << 4 | uds->size >> 8);
        data[1] = (uint8_t)uds->size;
        memcpy(data + 2, uds->answer, FIRST_BYTES);
        uds->sent = FIRST_BYTES;
        uds->sequence = 1;
        uds->flowing = false;
        uds->waited = 0;
        return 1;
    }
    if (!uds->flowing) {
        return 0;
    }
    bytes = rest < NEXT_BYTES ? rest : NEXT_BYTES;
    data = new_frame(frame);
    data[0] = (uint8_t)(CONSECUTIVE << 4 | (uds->sequence++ & 0x0F));
    memcpy(data + 1, uds->answer + uds->sent, bytes);
    uds->sent += bytes;
    uds->waited = 0;
    if (uds->block != 0 && --uds->left == 0) {
        uds->flowing = false;
    }
    return 1;
}

void fcc_uds_init(struct fcc_uds *uds)
{
    memset(uds, 0, sizeof *uds);
    memcpy(uds->software, "fcc node", sizeof "fcc node");
}

void fcc_uds_take(struct fcc_uds *uds, const struct fcc_frame *frame)
{
    const uint8_t *data = frame->data;
    size_t place = uds->pending;

    if (frame->id != FCC_UDS_REQUEST_ID) {
        return;
    }
    if (data[0] >> 4 == FLOW) {
        take_flow(uds, data);
    } else if (data[0] >> 4 == FIRST) {
        uds->overflow = true;
    } else if (data[0] >> 4 == SINGLE && data[0] >= 1 && data[0] <= 7) {
        if (place == FCC_REQUESTS) {
            if (!stops(data)) {
                return;
            }
            place--; /* a flood must not keep out a stop */
        } else {
            uds->pending++;
        }
        memcpy(uds->requests[place], data, sizeof uds->requests[place]);
    }
}

size_t fcc_uds_tick(struct fcc_uds *uds, struct fcc_node *node,
                    struct fcc_frame frames[FCC_UDS_FRAMES])
{
    size_t i, sent, count = 0;

    if (node->state != FCC_IDLE && node->state != FCC_REFUSED) {
        keep(uds, node);
    }
    for (i = 0; i < uds->pending; i++) {
        answer(uds, node, uds->requests[i] + 1, uds->requests[i][0]);
    }
    uds->pending = 0;
    if (uds->overflow) {
        uint8_t *data = new_frame(&frames[count++]);

        data[0] = FLOW << 4 | 2;
        data[1] = data[2] = 0;
        uds->overflow = false;
    }
    if (uds->sent != 0 && uds->sent < uds->size) {
        uds->waited++;
        if (!uds->flowing && uds->waited > FCC_UDS_FLOW_TICKS) {
            uds->sent = uds->size; /* nobody listens */
        }
        if (uds->flowing && uds->waited < uds->gap) {
            return count;
        }
    }
    do {
        sent = send(uds, &frames[count]);
        count += sent;
    } while (sent != 0 && count < FCC_UDS_FRAMES && uds->flowing && uds->gap == 0);
    return count;
}
