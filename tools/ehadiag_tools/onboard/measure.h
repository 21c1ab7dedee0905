/* What a program measures of the calls that it makes: stack by painting it, instructions where the
 * emulator counts them, and numbers as their bits. */
#ifndef MEASURE_H
#define MEASURE_H

#include <inttypes.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

#define STACK_BYTES 16384
#define MARGIN 64
#define PAINT 0xa5

#ifdef COUNTED
uint64_t instructions(void);
#else
static uint64_t instructions(void) { return 0u; }
#endif

/* Colours the stack below the caller, or counts what of it has lost its colour. */
static size_t __attribute__((noinline)) stack_paint(int counting)
{
    volatile uint8_t *room = (volatile uint8_t *)__builtin_frame_address(0) - STACK_BYTES - MARGIN;
    size_t same = 0;

    if (counting == 0) {
        for (size_t i = 0; i < STACK_BYTES; ++i) {
            room[i] = PAINT;
        }
        return 0;
    }
    while (same < STACK_BYTES && room[same] == PAINT) {
        ++same;
    }
    return STACK_BYTES + MARGIN - same;
}

static void print_numbers(const double *values, int count)
{
    for (int i = 0; i < count; ++i) {
        uint64_t bits;

        (void)memcpy(&bits, &values[i], sizeof bits);
        (void)printf(" %08" PRIx32 "%08" PRIx32, (uint32_t)(bits >> 32), (uint32_t)bits);
    }
}

#endif
