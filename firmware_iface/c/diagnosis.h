/* The computer's own diagnosis (BUS-17): records the stored test that the node plays, identifies it
 * with the library that `ehadiag export` writes, and says on the bus what it has found.
 *
 * Two contexts share one struct. The control tick, which may be an interrupt:
 *
 *     command = fcc_node_begin(&node);
 *     ... converters ...
 *     count = fcc_node_end(&node, codes, frames);
 *     count += fcc_diagnosis_tick(&diagnosis, &node, codes, frames + count);
 *
 * and the background, at its leisure:
 *
 *     for (;;) (void)fcc_diagnosis_work(&diagnosis, 50.0);
 *
 * What they share belongs to one of them at a time, as `stage` says: to the background while a test
 * waits to be identified or is, to the tick otherwise. On a computer with several cores the caller
 * puts a lock around both. A test that starts while an identification runs ends it; if the
 * background has not given way when the test's first tick is there, the test is not recorded. */
#ifndef FCC_DIAGNOSIS_H
#define FCC_DIAGNOSIS_H

#include "eha_identify.h"
#include "node.h"

#ifndef FCC_DIAGNOSIS_TICKS
#define FCC_DIAGNOSIS_TICKS 5500u /* of a test, from its start, that are kept and identified */
#endif
#define FCC_DIAGNOSIS_PERIOD 100u /* ticks */
#define FCC_DIAGNOSIS_FRAMES 4u   /* verdict, and one for each severity */

enum fcc_stage {
    FCC_NOTHING = EHA_FCC_ONBOARD_VERDICT_ONBOARD_STATE_NOTHING_CHOICE,
    FCC_RECORDING = EHA_FCC_ONBOARD_VERDICT_ONBOARD_STATE_RECORDING_CHOICE,
    FCC_IDENTIFYING = EHA_FCC_ONBOARD_VERDICT_ONBOARD_STATE_IDENTIFYING_CHOICE,
    FCC_DONE = EHA_FCC_ONBOARD_VERDICT_ONBOARD_STATE_DONE_CHOICE,
    FCC_GIVEN_UP = EHA_FCC_ONBOARD_VERDICT_ONBOARD_STATE_GIVEN_UP_CHOICE
};

struct fcc_diagnosis {
    eha_identification job;
    eha_tick recording[FCC_DIAGNOSIS_TICKS];
    uint32_t ticks;        /* in the recording */
    struct fcc_rig rig;    /* at the end of the test */
    uint32_t serial;       /* of the unit */
    bool closed;           /* commands are positions */
    bool begun;            /* the background has begun */
    uint8_t test_id;
    volatile uint8_t stage; /* enum fcc_stage */
    volatile bool stop;     /* a new test is about to start */
    uint16_t runs;          /* of the model, said on the bus */
    uint8_t counters[FCC_DIAGNOSIS_FRAMES];
};

void fcc_diagnosis_init(struct fcc_diagnosis *diagnosis);

/* Take the tick that `fcc_node_end` has just ended; returns how many frames are to be sent. */
size_t fcc_diagnosis_tick(struct fcc_diagnosis *diagnosis, const struct fcc_node *node,
                          const uint16_t codes[4], struct fcc_frame frames[FCC_DIAGNOSIS_FRAMES]);

/* Go on for about so many ticks of a model, fewer where a pass ends; false if there is nothing to do. */
bool fcc_diagnosis_work(struct fcc_diagnosis *diagnosis, double work);

#endif
