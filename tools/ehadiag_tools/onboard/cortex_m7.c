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

static void hang(void)
{
    for (;;) {
    }
}

__attribute__((section(".vectors"), used)) static void (*const vectors[16])(void) = {
    __stack, reset, hang, hang, hang, hang, hang,
};
