/* The firmware side of the bus: any bytes of a serial line, any frames, any ticks. */
#include <string.h>

#include "link.h"
#include "native.h"
#include "node.h"
#include "samples.h"

#define MOST_TICKS 700u /* of an input: arming takes 100, an end stays 500 */

static const uint8_t *next;
static size_t left;

static uint8_t byte(void)
{
    if (left == 0) {
        return 0;
    }
    --left;
    return *next++;
}

static void unpack(const struct fcc_frame *frame)
{
    struct eha_fcc_servo_telemetry_t telemetry;
    struct eha_fcc_servo_command_t command;
    struct eha_fcc_environment_t environment;
    struct eha_fcc_bit_status_t status;
    struct eha_fcc_bit_request_t request;
    const int found = fcc_unpack_telemetry(frame, &telemetry) + fcc_unpack_command(frame, &command) +
                      fcc_unpack_environment(frame, &environment) +
                      fcc_unpack_status(frame, &status) + fcc_unpack_request(frame, &request);

    if (found > 1) {
        finding("a frame of two messages");
    }
    if (found == 1 && !fcc_intact(frame)) {
        finding("a damaged frame was taken");
    }
}

/* Bytes of the line; what comes out must survive its own packet. */
static void line(void)
{
    struct fcc_link link, again;
    struct fcc_frame frame, same;
    uint32_t time_us, time_same;
    uint8_t packet[FCC_LINK_PACKET];

    (void)memset(&link, 0, sizeof link);
    while (left > 0) {
        if (!fcc_link_feed(&link, byte(), &frame, &time_us)) {
            continue;
        }
        unpack(&frame);
        fcc_link_encode(packet, &frame, time_us);
        (void)memset(&again, 0, sizeof again);
        for (size_t i = 0; i < sizeof packet; ++i) {
            if (fcc_link_feed(&again, packet[i], &same, &time_same) != (i + 1u == sizeof packet)) {
                finding("a packet is not whole at its end");
            }
        }
        if (same.id != frame.id || memcmp(same.data, frame.data, sizeof same.data) != 0 ||
            time_same != time_us) {
            finding("a frame does not survive its own packet");
        }
    }
}

static struct fcc_frame frame_of(void)
{
    static const uint16_t identifiers[] = {
        EHA_FCC_SERVO_TELEMETRY_FRAME_ID, EHA_FCC_SERVO_COMMAND_FRAME_ID,
        EHA_FCC_ENVIRONMENT_FRAME_ID, EHA_FCC_BIT_STATUS_FRAME_ID, EHA_FCC_BIT_REQUEST_FRAME_ID,
        EHA_FCC_BIT_REQUEST_FRAME_ID, EHA_FCC_BIT_REQUEST_FRAME_ID, 0x7ffu};
    const uint8_t kind = byte();
    struct fcc_frame frame;
    uint8_t counter = (uint8_t)(kind >> 4);

    if ((kind & 8u) != 0) { /* a sound request */
        const uint8_t code = byte();

        fcc_pack_request(&frame, code & 3u, byte(), &counter);
        return frame;
    }
    frame.id = identifiers[kind & 7u];
    for (size_t i = 0; i < sizeof frame.data; ++i) {
        frame.data[i] = byte();
    }
    return frame;
}

/* A node through frames and ticks, some of them many at once. */
static void node(void)
{
    const struct fcc_rig rig = {(uint16_t)(byte() * 20u), (uint16_t)(byte() * 4u),
                                (uint16_t)(byte() * 10u), (byte() & 7u) == 7u};
    struct fcc_frame frames[FCC_FRAMES_PER_TICK + 1u];
    struct fcc_node own;
    unsigned room = MOST_TICKS;

    fcc_node_init(&own, byte(), &rig);
    while (left > 0) {
        const uint8_t what = byte();
        const unsigned wanted = (what & 3u) == 3u ? 8u * (what >> 2) : what & 3u;
        const unsigned ticks = wanted < room ? wanted : room;

        room -= ticks;
        if ((what & 4u) != 0) {
            const struct fcc_frame frame = frame_of();

            unpack(&frame);
            fcc_node_take(&own, &frame);
        }
        for (unsigned i = 0; i < ticks; ++i) {
            const struct fcc_command command = fcc_node_begin(&own);
            const uint16_t codes[4] = {what, (uint16_t)(what << 8), 0xffffu, 0x8000u};
            struct fcc_sample sample;
            size_t count;

            (void)memset(&frames[FCC_FRAMES_PER_TICK], 0x5a, sizeof frames[0]);
            count = fcc_node_end(&own, codes, frames);
            if (count < 2u || count > FCC_FRAMES_PER_TICK ||
                frames[FCC_FRAMES_PER_TICK].data[7] != 0x5au) {
                finding("more frames than a tick has");
            }
            for (size_t k = 0; k < count; ++k) {
                if (!fcc_intact(&frames[k])) {
                    finding("a frame of the node is damaged");
                }
            }
            if ((command.test_id != 0) != (own.state == FCC_RUNNING)) {
                finding("a test's command while no test runs");
            }
            sample = fcc_sample_of(&command, codes);
            if (!(sample.spool == sample.spool && sample.command == sample.command)) {
                finding("a sample is no number");
            }
            shown(((uint64_t)own.state << 16) | ((uint64_t)own.refusal << 8) | own.pending);
        }
    }
}

void check(const uint8_t *bytes, size_t size)
{
    next = bytes;
    left = size;
    switch (byte() & 63u) { /* a node takes a hundred times as long as a line */
    case 63u:
        if (chosen()) {
            node();
        }
        break;
    case 32u:
    case 33u:
        while (left > 0) {
            const struct fcc_frame frame = frame_of();

            unpack(&frame);
        }
        break;
    default:
        line();
        break;
    }
}
