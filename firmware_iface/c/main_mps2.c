/* The node that diagnoses itself on a bare Cortex-M7: QEMU's mps2-an500, its first UART as the
 * serial link. The control tick is the SysTick interrupt, the identification the background. It plays
 * the converters of a recorded test, which `played_codes.h` holds, and tells by semihosting, in
 * bits, what it has found; the bus carries seven digits of it. */
#include <inttypes.h>
#include <stdio.h>
#include <string.h>

#include "diagnosis.h"
#include "link.h"
#include "played.h"
#include "played_codes.h"

#define TICKS_PER_READ 64   /* bytes taken in one tick */
#define SPINS 100000u       /* how long a full line is waited for */
#define CLOCK_KHZ 25000u
#define SAID 9              /* numbers of a result: severities to verdict */

static volatile uint32_t *const uart = (volatile uint32_t *)0x40004000u;
static volatile uint32_t *const systick = (volatile uint32_t *)0xe000e010u;
static volatile uint32_t *const timer = (volatile uint32_t *)0x40000000u;
enum { TIMER_CONTROL, TIMER_VALUE, TIMER_RELOAD };
enum { UART_DATA, UART_STATE, UART_CONTROL, UART_CLEAR, UART_DIVIDER };

static struct fcc_node node;
static struct fcc_diagnosis diagnosis;
static struct fcc_played played;
static struct fcc_link line;

void tick_handler(void);

static void send(const struct fcc_frame *frame, uint32_t time_us)
{
    uint8_t packet[FCC_LINK_PACKET];
    uint32_t spins = 0;
    size_t i;

    fcc_link_encode(packet, frame, time_us);
    for (i = 0; i < sizeof packet && spins < SPINS; i++) {
        for (spins = 0; (uart[UART_STATE] & 1u) != 0u && spins < SPINS; spins++) {
        }
        uart[UART_DATA] = packet[i];
    }
}

/* One tick; the time of its frames is that of the node's own count. */
static void run_tick(void)
{
    struct fcc_frame frames[FCC_FRAMES_PER_TICK + FCC_DIAGNOSIS_FRAMES];
    struct fcc_frame request;
    struct fcc_command command;
    const uint32_t now = (node.tick + 1u) * FCC_TICK_US;
    uint16_t codes[4];
    uint32_t time_us;
    size_t i, count;

    for (i = 0; i < TICKS_PER_READ && (uart[UART_STATE] & 2u) != 0u; i++) {
        if (fcc_link_feed(&line, (uint8_t)uart[UART_DATA], &request, &time_us)) {
            fcc_node_take(&node, &request);
        }
    }
    command = fcc_node_begin(&node);
    fcc_played_tick(&played, &command, codes);
    count = fcc_node_end(&node, codes, frames);
    count += fcc_diagnosis_tick(&diagnosis, &node, codes, frames + count);
    for (i = 0; i < count; i++) {
        send(&frames[i], now + (uint32_t)i);
    }
}

/* An emulator that did not run for a while has lost interrupts, not time: make the ticks up. */
void tick_handler(void)
{
    static uint32_t behind; /* what the timer had at the end of the last tick, counting down */
    const uint32_t now = timer[TIMER_VALUE];

    while (behind - now >= CLOCK_KHZ) {
        behind -= CLOCK_KHZ;
        run_tick();
    }
}

static void tell(const eha_identification *found)
{
    double numbers[SAID];
    uint64_t bits;
    int i;

    memcpy(numbers, found, sizeof numbers);
    (void)printf("found");
    for (i = 0; i < SAID; i++) {
        memcpy(&bits, &numbers[i], sizeof bits);
        (void)printf(" %08" PRIx32 "%08" PRIx32, (uint32_t)(bits >> 32), (uint32_t)bits);
    }
    (void)printf("\n");
    (void)fflush(stdout);
}

int main(void)
{
    const struct fcc_rig rig = PLAYED_RIG;
    bool told = false;

    played.codes = played_codes;
    played.count = sizeof played_codes / sizeof played_codes[0];
    fcc_node_init(&node, PLAYED_SERIAL, &rig);
    fcc_diagnosis_init(&diagnosis);
    uart[UART_DIVIDER] = 27; /* 921600 baud */
    uart[UART_CONTROL] = 3;
    timer[TIMER_RELOAD] = 0xffffffffu;
    timer[TIMER_VALUE] = 0u;
    timer[TIMER_CONTROL] = 1u;
    systick[1] = CLOCK_KHZ - 1u;
    systick[2] = 0;
    systick[0] = 7;
    for (;;) {
        if (!fcc_diagnosis_work(&diagnosis, 50.0)) {
            __asm__ volatile("wfi");
        }
        if (diagnosis.stage != FCC_DONE) {
            told = false;
        } else if (!told) {
            told = true;
            tell(&diagnosis.job);
        }
    }
}
