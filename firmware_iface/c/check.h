/* Check sums of the bus and of the serial link (BUS-6, BUS-15). */
#ifndef FCC_CHECK_H
#define FCC_CHECK_H

#include <stddef.h>
#include <stdint.h>

/* CRC-8 SAE J1850 (polynomial 0x1D, start 0xFF, final xor 0xFF) over the low byte of the
 * identifier, its high byte, and bytes 0 to 6 of the payload. */
uint8_t fcc_crc8(uint16_t id, const uint8_t payload[8]);

/* CRC-16/CCITT-FALSE (polynomial 0x1021, start 0xFFFF). */
uint16_t fcc_crc16(const uint8_t *data, size_t size);

#endif
