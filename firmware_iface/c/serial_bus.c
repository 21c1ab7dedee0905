#define _DEFAULT_SOURCE

#include "serial_bus.h"

#include <errno.h>
#include <fcntl.h>
#include <stdint.h>
#include <string.h>
#include <termios.h>
#include <unistd.h>

#include "link.h"

struct serial {
    int descriptor;
    struct fcc_link link;
    uint8_t bytes[256];
    size_t size, used;
    bool torn; /* the line took only a part of the last packet */
};

static bool receive(void *self, struct fcc_frame *frame, bool *got)
{
    struct serial *serial = self;
    uint32_t time_us;

    *got = false;
    for (;;) {
        while (serial->used < serial->size) {
            if (fcc_link_feed(&serial->link, serial->bytes[serial->used++], frame, &time_us)) {
                *got = true;
                return true;
            }
        }
        const ssize_t count = read(serial->descriptor, serial->bytes, sizeof serial->bytes);

        serial->used = serial->size = 0;
        if (count <= 0) {
            return count == 0 || errno == EAGAIN || errno == EINTR;
        }
        serial->size = (size_t)count;
    }
}

static bool send(void *self, const struct fcc_frame *frame, uint32_t time_us)
{
    struct serial *serial = self;
    uint8_t packet[1 + FCC_LINK_PACKET] = {0};
    size_t size = FCC_LINK_PACKET + (serial->torn ? 1u : 0u);
    ssize_t count;

    /* After a torn packet a delimiter comes first, or this one would be lost with it. */
    fcc_link_encode(packet + 1, frame, time_us);
    count = write(serial->descriptor, serial->torn ? packet : packet + 1, size);
    if (count < 0) {
        return errno == EAGAIN || errno == EINTR;
    }
    serial->torn = (size_t)count < size;
    return true;
}

bool fcc_serial_open(const char *channel, struct fcc_bus *bus)
{
    static struct serial serial;
    struct termios settings;

    serial.descriptor = open(channel, O_RDWR | O_NOCTTY | O_NONBLOCK);
    if (serial.descriptor < 0 || tcgetattr(serial.descriptor, &settings) != 0) {
        return false;
    }
    cfmakeraw(&settings);
    settings.c_cflag |= CLOCAL | CREAD;
    settings.c_cc[VMIN] = 1; /* nothing to read is EAGAIN; a line that hung up is an error */
    settings.c_cc[VTIME] = 0;
    if (cfsetspeed(&settings, B921600) != 0 ||
        tcsetattr(serial.descriptor, TCSANOW, &settings) != 0) {
        return false;
    }
    bus->self = &serial;
    bus->receive = receive;
    bus->send = send;
    return true;
}
