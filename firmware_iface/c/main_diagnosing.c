/* fcc-diagnosing DEVICE [option...]: the node that diagnoses itself, on a serial line. It plays the
 * converters of a recorded test, which `played_codes.h` holds, and needs the library of
 * `ehadiag export`. A tick waits for the slice of the identification before it. */
#include "diagnosis.h"
#include "played.h"
#include "played_codes.h"
#include "serial_bus.h"

struct example {
    struct fcc_diagnosis diagnosis;
    struct fcc_played played;
};

static void convert(void *self, const struct fcc_command *command, uint16_t codes[4])
{
    struct example *example = self;

    fcc_played_tick(&example->played, command, codes);
}

static size_t after(void *self, const struct fcc_node *node, const uint16_t codes[4],
                    struct fcc_frame frames[FCC_RIDER_FRAMES])
{
    struct example *example = self;

    return fcc_diagnosis_tick(&example->diagnosis, node, codes, frames);
}

static void spare(void *self)
{
    struct example *example = self;

    (void)fcc_diagnosis_work(&example->diagnosis, 1e4);
}

int main(int argc, char **argv)
{
    static struct example example;
    const struct fcc_rider rider = {&example, convert, after, spare, NULL};

    example.played.codes = played_codes;
    example.played.count = sizeof played_codes / sizeof played_codes[0];
    fcc_diagnosis_init(&example.diagnosis);
    return fcc_run(argc, argv, "DEVICE", fcc_serial_open, &rider);
}
