/* The serial link (BUS-15): COBS(id u16, time u32 in us, payload 8 bytes, CRC-16), all little
 * endian, and a zero byte. */
#ifndef FCC_LINK_H
#define FCC_LINK_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "frames.h"

#define FCC_LINK_BODY 14u                      /* identifier, time, payload */
#define FCC_LINK_PLAIN (FCC_LINK_BODY + 2u)    /* with the check sum */
#define FCC_LINK_CODED (FCC_LINK_PLAIN + 1u)   /* COBS adds one byte to short packets */
#define FCC_LINK_PACKET (FCC_LINK_CODED + 1u)  /* with the delimiter */

struct fcc_link {
    uint8_t coded[FCC_LINK_CODED];
    size_t size;      /* bytes since the last delimiter, at most FCC_LINK_CODED + 1 */
    uint32_t dropped; /* packets that were damaged */
};

void fcc_link_encode(uint8_t packet[FCC_LINK_PACKET], const struct fcc_frame *frame,
                     uint32_t time_us);

/* Take one byte; true when it completes an intact packet, which then is in frame and time_us. */
bool fcc_link_feed(struct fcc_link *link, uint8_t byte, struct fcc_frame *frame,
                   uint32_t *time_us);

#endif
