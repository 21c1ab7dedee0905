#include "check.h"

/* Bit by bit: 72 bits take about a microsecond on a small controller, a table 256 bytes. */
static uint8_t crc8_byte(uint8_t crc, uint8_t byte)
{
    int bit;

    crc ^= byte;
    for (bit = 0; bit < 8; bit++) {
        crc = (uint8_t)((unsigned)crc << 1 ^ ((crc & 0x80u) ? 0x1Du : 0u));
    }
    return crc;
}

uint8_t fcc_crc8(uint16_t id, const uint8_t payload[8])
{
    uint8_t crc = 0xFF;
    int i;

    crc = crc8_byte(crc, (uint8_t)(id & 0xFFu));
    crc = crc8_byte(crc, (uint8_t)(id >> 8));
    for (i = 0; i < 7; i++) {
        crc = crc8_byte(crc, payload[i]);
    }
    return crc ^ 0xFFu;
}

uint16_t fcc_crc16(const uint8_t *data, size_t size)
{
    uint16_t crc = 0xFFFF;
    size_t i;
    int bit;

    for (i = 0; i < size; i++) {
        crc ^= (uint16_t)(data[i] << 8);
        for (bit = 0; bit < 8; bit++) {
            crc = (uint16_t)((unsigned)crc << 1 ^ ((crc & 0x8000u) ? 0x1021u : 0u));
        }
    }
    return crc;
}
