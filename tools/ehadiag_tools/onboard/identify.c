/* Identifies a recorded test with an exported library and prints what it found, in bits. */
#include <inttypes.h>
#include <stdio.h>
#include <string.h>

#include "eha_identify.h"
#include "ticks.h"

#define RESULTS 14

static eha_identification identification;
static eha_tick recording[sizeof tick_bits / sizeof tick_bits[0]];

int main(void)
{
    eha_unit unit;
    const double count = (double)(sizeof tick_bits / sizeof tick_bits[0]);
    const eha_slice slice = {count, 50.0};
    int32_t going;

    (void)memcpy(&unit, unit_bits, sizeof unit);
    (void)memcpy(recording, tick_bits, sizeof recording);
    if (eha_identify_begin(&identification, &unit) != 0) {
        return 1;
    }
    do {
        going = eha_identify_run(&identification, recording, &slice);
    } while (going == EHA_IDENTIFY_GOES_ON);
    (void)printf("outcome %" PRId32, going);
    for (int i = 0; i < RESULTS; ++i) {
        uint64_t bits;

        (void)memcpy(&bits, (const char *)&identification + 8 * i, sizeof bits);
        (void)printf(" %08" PRIx32 "%08" PRIx32, (uint32_t)(bits >> 32), (uint32_t)bits);
    }
    (void)printf("\n");
    return 0;
}
