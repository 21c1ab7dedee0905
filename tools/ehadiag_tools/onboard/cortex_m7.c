/* What a bare Cortex-M7 needs before newlib starts: its vectors, and floating-point switched on. */
#include <stdint.h>

extern void _start(void);
extern void __stack(void); /* an address of the linker script, the end of the memory */

static void reset(void)
{
    *(volatile uint32_t *)0xe000ed88u |= 0xfu << 20; /* CPACR: coprocessors 10 and 11 */
    __asm__ volatile("dsb\n\tisb");
    _start();
}

/* Instructions so far, to within 40: one takes a nanosecond (-icount shift=0), SysTick counts 25 MHz. */
uint32_t instructions(void);
uint32_t instructions(void)
{
    volatile uint32_t *const systick = (volatile uint32_t *)0xe000e010u;

    if (systick[0] == 0u) {
        systick[1] = 0xffffffu;
        systick[2] = 0u;
        systick[0] = 5u;
    }
    return (0xffffffu - systick[2]) * 40u;
}

static void hang(void)
{
    for (;;) {
    }
}

__attribute__((section(".vectors"), used)) static void (*const vectors[16])(void) = {
    __stack, reset, hang, hang, hang, hang, hang,
};
