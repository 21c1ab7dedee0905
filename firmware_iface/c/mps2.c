/* What a bare Cortex-M (QEMU's mps2-an500 and mps2-an386) needs before newlib starts: its vectors,
 * and floating-point switched on; and its instructions counted. */
#include <stdint.h>

extern void _start(void);
extern void __stack(void); /* an address of the linker script, the end of the memory */

static void reset(void)
{
    *(volatile uint32_t *)0xe000ed88u |= 0xfu << 20; /* CPACR: coprocessors 10 and 11 */
    __asm__ volatile("dsb\n\tisb");
    _start();
}

/* Instructions so far, to within 40: one takes a nanosecond (-icount shift=0), the board's timer
 * counts down at 25 MHz and begins anew after 171e9 instructions. */
uint64_t instructions(void);
uint64_t instructions(void)
{
    volatile uint32_t *const timer = (volatile uint32_t *)0x40000000u;

    if (timer[0] == 0u) {
        timer[2] = 0xffffffffu; /* from which it begins anew */
        timer[1] = 0xffffffffu;
        timer[0] = 1u;
    }
    return (uint64_t)(0xffffffffu - timer[1]) * 40u;
}

static void hang(void)
{
    for (;;) {
    }
}

/* The control tick of a program that has one. */
void tick_handler(void);
__attribute__((weak)) void tick_handler(void) {}

__attribute__((section(".vectors"), used)) static void (*const vectors[16])(void) = {
    __stack, reset, hang, hang, hang, hang, hang, 0, 0, 0, 0, hang, hang, 0, hang, tick_handler,
};
