/* UDS over ISO-TP (docs/reference/uds.md): starts, stops and watches the node's tests in place of
 * `BitRequest` and `BitStatus`, and answers with the computer's own result.
 *
 *     fcc_uds_take(&uds, &frame);                  each frame of the bus
 *     count = fcc_uds_tick(&uds, &node, frames);   once per tick, before fcc_node_begin()
 *
 * Requests fit one frame; a longer one gets the flow control "overflow". An answer that is under
 * way gives way to that of the next request. No heap, one struct of fixed size. */
#ifndef FCC_UDS_H
#define FCC_UDS_H

#include "node.h"

#define FCC_UDS_REQUEST_ID 0x7E0u
#define FCC_UDS_RESPONSE_ID 0x7E8u
#define FCC_UDS_LONGEST 80u      /* bytes of an answer: three times the longest data */
#define FCC_UDS_FRAMES 13u       /* per tick: an answer of that length, an overflow */
#define FCC_UDS_FLOW_TICKS 1000u /* wait for flow control (N_Bs of ISO 15765-2) */
#define FCC_UDS_SOFTWARE 16u

enum { FCC_FOUND_NOTHING = 0, FCC_FOUND_DONE = 3 };

/* The computer's own result of its last test; the caller keeps it up to date. */
struct fcc_found {
    uint8_t state;   /* OnboardState (BUS-17) */
    uint8_t verdict; /* 0, 10, 20, 30 (BUS-18) */
    uint16_t runs;
    uint32_t severity[3], deviation[3]; /* Kintas, FSS, FDJ; 1e-7 */
};

struct fcc_uds_status {
    enum fcc_state state;
    enum fcc_reason reason;
    uint8_t test_id;
    uint16_t elapsed; /* ms */
};

struct fcc_uds {
    struct fcc_found found;
    int16_t offsets[4];              /* of the sensors: 0.5 uA, 20 nm, 1 kPa, 2 um */
    char software[FCC_UDS_SOFTWARE]; /* filled up by 0 */
    bool requested;                  /* a test was, so that `last` says something */
    struct fcc_uds_status last;
    uint8_t requests[FCC_REQUESTS][8]; /* single frames */
    size_t pending;
    bool overflow;
    uint8_t answer[FCC_UDS_LONGEST];
    size_t size, sent; /* bytes of it */
    bool flowing;      /* flow control has come */
    uint8_t sequence, block, gap; /* of frames; gap in ticks */
    uint32_t waited, left;        /* ticks without flow control; frames of the block, 0: all */
};

void fcc_uds_init(struct fcc_uds *uds);
void fcc_uds_take(struct fcc_uds *uds, const struct fcc_frame *frame);
size_t fcc_uds_tick(struct fcc_uds *uds, struct fcc_node *node,
                    struct fcc_frame frames[FCC_UDS_FRAMES]);

#endif
