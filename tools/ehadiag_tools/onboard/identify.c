/* Identifies a recorded test with an exported library: what it found, in bits, stack and effort. */
#include "eha_identify.h"
#include "measure.h"
#include "ticks.h"

#define RESULTS 17
#define WORK 50.0 /* ticks of a model in a slice */
#define MILLION 1000000u

static eha_identification identification;
static eha_tick recording[sizeof tick_bits / sizeof tick_bits[0]];

int main(void)
{
    eha_unit unit = EHA_UNIT_DEFAULT;
    const double count = (double)(sizeof tick_bits / sizeof tick_bits[0]);
    const eha_slice slice = {count, WORK};
    uint64_t begin;
    uint64_t spent = 0u;
    uint64_t slice_spent;
    uint64_t longest = 0u;
    int32_t going;

    (void)memcpy(&unit, unit_bits, sizeof unit_bits);
    (void)memcpy(recording, tick_bits, sizeof recording);
    (void)stack_paint(0);
    if (eha_identify_begin(&identification, &unit) != 0) {
        return 1;
    }
    do {
        begin = instructions();
        going = eha_identify_run(&identification, recording, &slice);
        slice_spent = instructions() - begin;
        spent += slice_spent; /* the counter begins anew after some minutes */
        longest = slice_spent > longest ? slice_spent : longest;
    } while (going == EHA_IDENTIFY_GOES_ON);
    (void)printf("stack %lu\n", (unsigned long)stack_paint(1));
    (void)printf("millions %lu\n", (unsigned long)(spent / MILLION));
    (void)printf("longest %lu\n", (unsigned long)longest);
    (void)printf("outcome %" PRId32, going);
    print_numbers((const double *)&identification, RESULTS);
    (void)printf("\n");
    return 0;
}
