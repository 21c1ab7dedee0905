/* fcc-serial DEVICE [option...]: the node on a serial line or pseudo-terminal. */
#include "serial_bus.h"

int main(int argc, char **argv)
{
    struct fcc_rider rider = fcc_bench_rider();

    return fcc_run(argc, argv, "DEVICE", fcc_serial_open, &rider);
}
