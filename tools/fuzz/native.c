/* Fuzzes C code in its own process, without a fuzzing engine: `native SEED RUNS FOLDER`, or
 * `native FILE...` to run inputs once. An input that shows what none before did goes to FOLDER; what
 * counts as shown are pairs of branches of code compiled with -fsanitize-coverage=trace-pc, and what
 * the target reports by `shown`. A finding is a call of `finding`, a signal, or more than 20 s: its
 * input is written to `finding.bin`, and the exit status is not 0. */
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "native.h"

#define MOST_BYTES 96u
#define MOST_INPUTS 4096u
#define FEATURES 65536u
#define SHARE 64u
#define HANG_S 20u

static struct {
    uint8_t bytes[MOST_BYTES];
    size_t size;
} inputs[MOST_INPUTS], present;
static size_t kept;
static uint8_t seen[FEATURES];
static uint64_t state;
static uintptr_t last;
static size_t features;
static int fresh;
static uint32_t share = 1;

static uint32_t draw(uint32_t below)
{
    state ^= state << 13;
    state ^= state >> 7;
    state ^= state << 17;
    return (uint32_t)(state >> 32) % below;
}

int chosen(void)
{
    uint32_t sum = 0x811c9dc5u;

    for (size_t i = 0; i < present.size; ++i) {
        sum = (sum ^ present.bytes[i]) * 0x01000193u;
    }
    return (sum >> 8) % share == 0u;
}

void shown(uint64_t feature)
{
    uint8_t *const place = &seen[(feature * 0x9e3779b97f4a7c15u) >> 48];

    if (*place == 0) {
        *place = 1;
        ++features;
        fresh = 1;
    }
}

void __sanitizer_cov_trace_pc(void);
void __sanitizer_cov_trace_pc(void)
{
    const uintptr_t here = (uintptr_t)__builtin_return_address(0);

    shown(here ^ (last << 20));
    last = here;
}

/* Writes the present input; only what a signal's handler may call. */
static void end(const char *why)
{
    FILE *const file = fopen("finding.bin", "wb");

    if (file != NULL) {
        (void)fwrite(present.bytes, 1, present.size, file);
        (void)fclose(file);
    }
    (void)fprintf(stderr, "finding: %s\n", why);
    _exit(1);
}

void finding(const char *why)
{
    end(why);
}

static void on_signal(int number)
{
    end(number == SIGALRM ? "no end" : "a signal");
}

static void run(void)
{
    last = 0;
    fresh = 0;
    check(present.bytes, present.size);
}

static void change(void)
{
    static const uint8_t special[] = {0u, 1u, 2u, 3u, 0x7fu, 0x80u, 0xf0u, 0xffu};
    size_t at = present.size == 0 ? 0 : draw((uint32_t)present.size);
    const size_t count = 1u + draw(16u);

    switch (draw(7u)) {
    case 0:
        present.bytes[at] ^= (uint8_t)(1u << draw(8u));
        break;
    case 1:
        present.bytes[at] = (uint8_t)draw(256u);
        break;
    case 2:
        present.bytes[at] = special[draw(sizeof special)];
        break;
    case 3: /* more at the end */
        for (size_t i = 0; i < count && present.size < MOST_BYTES; ++i) {
            present.bytes[present.size++] = (uint8_t)draw(256u);
        }
        break;
    case 4: /* less */
        present.size = at;
        break;
    case 5: /* a piece of another input */
        if (kept > 0) {
            const size_t other = draw((uint32_t)kept);

            for (size_t i = at; i < inputs[other].size; ++i) {
                present.bytes[i] = inputs[other].bytes[i];
            }
            present.size = present.size > inputs[other].size ? present.size : inputs[other].size;
        }
        break;
    default: /* one piece twice */
        for (size_t i = 0; i < count && at + i < present.size && present.size < MOST_BYTES; ++i) {
            present.bytes[present.size++] = present.bytes[at + i];
        }
        break;
    }
}

static void keep(const char *folder)
{
    char name[512];
    uint64_t digest = 0xcbf29ce484222325u;
    FILE *file;

    if (kept == MOST_INPUTS) {
        return;
    }
    inputs[kept++] = present;
    for (size_t i = 0; i < present.size; ++i) {
        digest = (digest ^ present.bytes[i]) * 0x100000001b3u;
    }
    (void)snprintf(name, sizeof name, "%s/%016llx", folder, (unsigned long long)digest);
    file = fopen(name, "wb");
    if (file != NULL) {
        (void)fwrite(present.bytes, 1, present.size, file);
        (void)fclose(file);
    }
}

static int load(const char *name)
{
    FILE *const file = fopen(name, "rb");

    if (file == NULL) {
        return 0;
    }
    present.size = fread(present.bytes, 1, MOST_BYTES, file);
    (void)fclose(file);
    return 1;
}

int main(int argc, char **argv)
{
    const int fuzzes = argc == 4 && strspn(argv[1], "0123456789") == strlen(argv[1]);
    unsigned long long runs;
    char line[512];

    (void)signal(SIGALRM, on_signal);
    (void)signal(SIGSEGV, on_signal);
    (void)signal(SIGFPE, on_signal);
    (void)signal(SIGILL, on_signal);
    (void)signal(SIGBUS, on_signal);
    if (!fuzzes) {
        for (int i = 1; i < argc; ++i) {
            if (!load(argv[i])) {
                return 2;
            }
            (void)alarm(HANG_S);
            run();
        }
        (void)printf("%d inputs, %zu features\n", argc - 1, features);
        return 0;
    }
    share = SHARE;
    state = strtoull(argv[1], NULL, 10) * 2u + 1u;
    runs = strtoull(argv[2], NULL, 10);
    while (fgets(line, sizeof line, stdin) != NULL) { /* names of inputs to begin with */
        line[strcspn(line, "\n")] = '\0';
        if (load(line)) {
            run();
            if (kept < MOST_INPUTS) {
                inputs[kept++] = present;
            }
        }
    }
    for (unsigned long long n = 0; n < runs; ++n) {
        if (kept > 0 && draw(64u) != 0) {
            present = inputs[draw((uint32_t)kept)];
        } else {
            present.size = 0;
        }
        for (uint32_t changes = 1u + draw(4u); changes > 0u; --changes) {
            change();
        }
        (void)alarm(HANG_S);
        run();
        if (fresh) {
            keep(argv[3]);
        }
    }
    (void)printf("%llu inputs, %zu features, %zu kept\n", runs, features, kept);
    return 0;
}
