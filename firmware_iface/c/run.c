#define _POSIX_C_SOURCE 200809L

#include "run.h"

#include <errno.h>
#include <math.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "bench.h"
#include "node.h"

#define MOST_READ 64      /* frames per tick: a flooded bus must not stop the control law */
#define FRAME_US 130u     /* length of a frame at 1 Mbit/s: the stamps of one tick follow so */

static volatile sig_atomic_t stopped;

static void on_signal(int number)
{
    (void)number;
    stopped = 1;
}

struct options {
    struct fcc_rig rig;
    double serial, jack, ticks;
    bool uds; /* requests and status by UDS */
};

static bool number(const char *text, double low, double high, double *out)
{
    char *end;

    *out = strtod(text, &end);
    return end != text && *end == '\0' && *out >= low && *out <= high;
}

static bool parse(int argc, char **argv, struct options *options)
{
    double value;
    int i;

    for (i = 2; i < argc; i++) {
        const char *name = argv[i];

        if (strcmp(name, "--interlock-open") == 0) {
            options->rig.interlock_open = true;
            continue;
        }
        if (strcmp(name, "--uds") == 0) {
            options->uds = true;
            continue;
        }
        if (++i == argc) {
            return false;
        }
        if (strcmp(name, "--serial") == 0 && number(argv[i], 0, 65535, &value)) {
            options->serial = value;
        } else if (strcmp(name, "--supply-MPa") == 0 && number(argv[i], 0, 40.95, &value)) {
            options->rig.supply = (uint16_t)lrint(value / 0.01);
        } else if (strcmp(name, "--oil-degC") == 0 && number(argv[i], -100, 309.5, &value)) {
            options->rig.oil = (uint16_t)lrint((value + 100) / 0.1);
        } else if (strcmp(name, "--jack-mm") == 0 && number(argv[i], -59, 59, &value)) {
            options->jack = value;
        } else if (strcmp(name, "--ticks") == 0 && number(argv[i], 1, 4e9, &value)) {
            options->ticks = value;
        } else {
            return false;
        }
    }
    return true;
}

static void convert(void *self, const struct fcc_command *command, uint16_t codes[4])
{
    fcc_bench_tick((struct fcc_bench *)self, command, codes);
}

static void place(void *self, double jack)
{
    ((struct fcc_bench *)self)->jack = jack;
}

struct fcc_rider fcc_bench_rider(void)
{
    static struct fcc_bench bench;
    const struct fcc_rider rider = {&bench, convert, NULL, NULL, place};

    return rider;
}

/* One tick: requests in, command held, frames out; `uds` NULL: by the own messages. */
static bool run_tick(struct fcc_node *node, struct fcc_uds *uds, const struct fcc_rider *rider,
                     const struct fcc_bus *bus, uint32_t time_us)
{
    struct fcc_frame frames[FCC_FRAMES_PER_TICK + FCC_RIDER_FRAMES + FCC_UDS_FRAMES];
    struct fcc_command command;
    uint16_t codes[4];
    size_t i, count = 0;
    bool got = true;

    for (i = 0; i < MOST_READ && got; i++) {
        if (!bus->receive(bus->self, &frames[0], &got)) {
            return false;
        }
        if (got && uds != NULL) {
            fcc_uds_take(uds, &frames[0]);
        } else if (got) {
            fcc_node_take(node, &frames[0]);
        }
    }
    if (uds != NULL) {
        count = fcc_uds_tick(uds, node, frames);
    }
    command = fcc_node_begin(node);
    rider->convert(rider->self, &command, codes);
    count += fcc_node_end(node, codes, frames + count);
    if (rider->after != NULL) {
        count += rider->after(rider->self, node, codes, frames + count);
    }
    for (i = 0; i < count; i++) {
        if (uds != NULL && frames[i].id == EHA_FCC_BIT_STATUS_FRAME_ID) {
            continue;
        }
        if (!bus->send(bus->self, &frames[i], time_us + (uint32_t)i * FRAME_US)) {
            return false;
        }
    }
    return true;
}

int fcc_run(int argc, char **argv, const char *channel,
            bool (*open_bus)(const char *channel, struct fcc_bus *bus),
            const struct fcc_rider *rider)
{
    struct options options = {{2070, 70, 1400, false}, 1, 0, 0, false};
    struct sigaction action;
    struct fcc_node node;
    struct fcc_uds uds;
    struct fcc_bus bus;
    struct timespec due;
    uint32_t tick;

    if (argc < 2 || argv[1][0] == '-' || !parse(argc, argv, &options)) {
        fprintf(stderr,
                "usage: %s %s [--serial N] [--supply-MPa P] [--oil-degC T] [--jack-mm X]\n"
                "       [--interlock-open] [--ticks N] [--uds]\n",
                argv[0], channel);
        return 2;
    }
    if (options.uds && rider->after != NULL) {
        fprintf(stderr, "%s: --uds: this node sends its own diagnosis by its messages only\n", argv[0]);
        return 2;
    }
    if (!open_bus(argv[1], &bus)) {
        fprintf(stderr, "%s: %s: %s\n", argv[0], argv[1], strerror(errno));
        return 1;
    }
    memset(&action, 0, sizeof action);
    action.sa_handler = on_signal;
    sigaction(SIGINT, &action, NULL);
    sigaction(SIGTERM, &action, NULL);
    if (rider->place != NULL) {
        rider->place(rider->self, options.jack);
    }
    fcc_uds_init(&uds);
    fcc_node_init(&node, (uint16_t)options.serial, &options.rig);
    clock_gettime(CLOCK_MONOTONIC, &due);
    for (tick = 0; !stopped && (options.ticks == 0 || tick < options.ticks); tick++) {
        due.tv_nsec += 1000000; /* absolute deadlines: lateness is made up, the rate does not drift */
        if (due.tv_nsec >= 1000000000) {
            due.tv_nsec -= 1000000000;
            due.tv_sec++;
        }
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL) == EINTR && !stopped) {
        }
        if (!run_tick(&node, options.uds ? &uds : NULL, rider, &bus, (tick + 1u) * FCC_TICK_US)) {
            fprintf(stderr, "%s: %s: bus lost: %s\n", argv[0], argv[1], strerror(errno));
            return 1;
        }
        if (rider->spare != NULL) {
            rider->spare(rider->self);
        }
    }
    return 0;
}
