#include "link.h"

#include <string.h>

#include "check.h"

void fcc_link_encode(uint8_t packet[FCC_LINK_PACKET], const struct fcc_frame *frame,
                     uint32_t time_us)
{
    uint8_t plain[FCC_LINK_PLAIN];
    uint16_t crc;
    size_t i, code = 0;

    plain[0] = (uint8_t)(frame->id & 0xFFu);
    plain[1] = (uint8_t)(frame->id >> 8);
    for (i = 0; i < 4; i++) {
        plain[2 + i] = (uint8_t)(time_us >> (8 * i));
    }
    memcpy(&plain[6], frame->data, sizeof frame->data);
    crc = fcc_crc16(plain, FCC_LINK_BODY);
    plain[FCC_LINK_BODY] = (uint8_t)(crc & 0xFFu);
    plain[FCC_LINK_BODY + 1u] = (uint8_t)(crc >> 8);

    /* COBS: each zero becomes the distance to the next one; so short a packet has no group that is
     * full at 254 bytes. */
    for (i = 0; i < FCC_LINK_PLAIN; i++) {
        if (plain[i] == 0) {
            packet[code] = (uint8_t)(i + 1 - code);
            code = i + 1;
        } else {
            packet[i + 1] = plain[i];
        }
    }
    packet[code] = (uint8_t)(FCC_LINK_CODED - code);
    packet[FCC_LINK_CODED] = 0;
}

/* Undo COBS; false if a distance leads past the end. */
static bool uncode(uint8_t plain[FCC_LINK_PLAIN], const uint8_t coded[FCC_LINK_CODED])
{
    size_t next = coded[0], i;

    for (i = 1; i < FCC_LINK_CODED; i++) {
        if (i == next) {
            plain[i - 1] = 0;
            next += coded[i];
        } else {
            plain[i - 1] = coded[i];
        }
    }
    return next == FCC_LINK_CODED;
}

static bool open_packet(const struct fcc_link *link, struct fcc_frame *frame, uint32_t *time_us)
{
    uint8_t plain[FCC_LINK_PLAIN];
    uint16_t crc;
    size_t i;

    if (link->size != FCC_LINK_CODED || !uncode(plain, link->coded)) {
        return false;
    }
    crc = (uint16_t)(plain[FCC_LINK_BODY] | plain[FCC_LINK_BODY + 1u] << 8);
    frame->id = (uint16_t)(plain[0] | plain[1] << 8);
    if (fcc_crc16(plain, FCC_LINK_BODY) != crc || frame->id > 0x7FFu) {
        return false;
    }
    *time_us = 0;
    for (i = 0; i < 4; i++) {
        *time_us |= (uint32_t)plain[2 + i] << (8 * i);
    }
    memcpy(frame->data, &plain[6], sizeof frame->data);
    return true;
}

bool fcc_link_feed(struct fcc_link *link, uint8_t byte, struct fcc_frame *frame,
                   uint32_t *time_us)
{
    bool whole;

    if (byte != 0) {
        if (link->size < FCC_LINK_CODED) {
            link->coded[link->size] = byte;
        }
        if (link->size <= FCC_LINK_CODED) {
            link->size++; /* one too many marks the packet as overlong */
        }
        return false;
    }
    if (link->size == 0) {
        return false; /* delimiters in a row are an idle line */
    }
    whole = open_packet(link, frame, time_us);
    link->size = 0;
    if (!whole) {
        link->dropped++;
    }
    return whole;
}
