/* A minimal flight-control computer (docs/reference/bus.md): it answers requests, plays stored
 * tests and sends telemetry, command, environment and status.
 *
 * No transport, no clock, no heap: one struct of fixed size, and two calls per control tick of 1 ms:
 *
 *     command = fcc_node_begin(&node);           the command to hold during this tick
 *     ... hold it, read the four converters at the end of the tick ...
 *     count = fcc_node_end(&node, codes, frames); the frames to send now
 *
 * Frames from the bus go to fcc_node_take() at any time between the two calls of one context; it is
 * not safe to call it from an interrupt without a queue of the caller's. */
#ifndef FCC_NODE_H
#define FCC_NODE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "frames.h"
#include "stored_tests.h"

#define FCC_TICK_US 1000u
#define FCC_FRAMES_PER_TICK 5u /* refusal, status, command, telemetry, environment */
#define FCC_REQUESTS 8u        /* that may come in one tick */

/* Most and least that a test may start with; raw numbers of the bus. */
#define FCC_LEAST_SUPPLY 1500   /* 15 MPa above return */
#define FCC_COLDEST_OIL 800     /* -20 degC */
#define FCC_OFF_CENTRE 1.0      /* mm */

#define FCC_ARMING_TICKS 100u
#define FCC_HOLD_TICKS 500u     /* how long an end, or a refusal, stays on the bus */
#define FCC_STATUS_TICKS 20u
#define FCC_ENVIRONMENT_TICKS 100u

enum fcc_state {
    FCC_IDLE = EHA_FCC_BIT_STATUS_BIT_STATE_IDLE_CHOICE,
    FCC_ARMING = EHA_FCC_BIT_STATUS_BIT_STATE_ARMING_CHOICE,
    FCC_RUNNING = EHA_FCC_BIT_STATUS_BIT_STATE_RUNNING_CHOICE,
    FCC_COMPLETE = EHA_FCC_BIT_STATUS_BIT_STATE_COMPLETE_CHOICE,
    FCC_ABORTED = EHA_FCC_BIT_STATUS_BIT_STATE_ABORTED_CHOICE,
    FCC_REFUSED = EHA_FCC_BIT_STATUS_BIT_STATE_REFUSED_CHOICE
};

enum fcc_reason {
    FCC_NO_REASON = EHA_FCC_BIT_STATUS_BIT_REASON_NONE_CHOICE,
    FCC_UNKNOWN_TEST = EHA_FCC_BIT_STATUS_BIT_REASON_UNKNOWN_TEST_CHOICE,
    FCC_SUPPLY_LOW = EHA_FCC_BIT_STATUS_BIT_REASON_SUPPLY_PRESSURE_LOW_CHOICE,
    FCC_OIL_COLD = EHA_FCC_BIT_STATUS_BIT_REASON_OIL_TOO_COLD_CHOICE,
    FCC_NOT_CENTRED = EHA_FCC_BIT_STATUS_BIT_REASON_NOT_CENTRED_CHOICE,
    FCC_ALREADY_RUNNING = EHA_FCC_BIT_STATUS_BIT_REASON_ALREADY_RUNNING_CHOICE,
    FCC_INTERLOCK = EHA_FCC_BIT_STATUS_BIT_REASON_INTERLOCK_OPEN_CHOICE
};

/* What the computer knows of the rig, raw numbers of `Environment`; the caller keeps it fresh. */
struct fcc_rig {
    uint16_t supply, ret; /* 0.01 MPa */
    uint16_t oil;         /* 0.1 degC above -100 degC */
    bool interlock_open;
};

struct fcc_command {
    uint8_t mode;    /* CommandMode: 1 current, 2 position */
    int16_t value;   /* 0.5 uA or 2 um */
    uint8_t test_id; /* 0 while no test runs */
};

struct fcc_node {
    struct fcc_rig rig;
    uint16_t serial; /* of the actuator */
    enum fcc_state state;
    const struct fcc_test *test; /* armed or running */
    uint8_t test_id;             /* in the status */
    uint32_t tick, since;        /* present tick; tick in which the state began */
    uint16_t elapsed;            /* ticks of the test, for the status */
    uint16_t position;           /* last code of the jack's position */
    struct fcc_command command;
    bool told;                   /* the present state is on the bus */
    enum fcc_reason refusal;     /* to say, or said while the state is refused */
    uint8_t refused_id;
    uint8_t counters[4];         /* telemetry, command, environment, status */
    struct eha_fcc_bit_request_t requests[FCC_REQUESTS];
    size_t pending;
};

void fcc_node_init(struct fcc_node *node, uint16_t serial, const struct fcc_rig *rig);

/* What requests do, for another protocol (uds.h); before fcc_node_begin. An abort of no running
 * test does nothing and is false. */
enum fcc_reason fcc_node_start(struct fcc_node *node, uint8_t test_id);
bool fcc_node_abort(struct fcc_node *node);

void fcc_node_take(struct fcc_node *node, const struct fcc_frame *frame);
struct fcc_command fcc_node_begin(struct fcc_node *node);
size_t fcc_node_end(struct fcc_node *node, const uint16_t codes[4],
                    struct fcc_frame frames[FCC_FRAMES_PER_TICK]);

#endif
