/* fcc-can INTERFACE [option...]: the node on SocketCAN, such as can0 or vcan0. */
#define _DEFAULT_SOURCE

#include <errno.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <stdint.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#include "run.h"

static bool receive(void *self, struct fcc_frame *frame, bool *got)
{
    const int *descriptor = self;
    struct can_frame raw;
    ssize_t count = recv(*descriptor, &raw, sizeof raw, MSG_DONTWAIT);

    *got = false;
    if (count < 0) {
        return errno == EAGAIN || errno == EINTR;
    }
    /* The filter lets in standard data frames of the requests' identifiers only. */
    if ((size_t)count == sizeof raw && raw.can_dlc == sizeof frame->data) {
        frame->id = (uint16_t)(raw.can_id & CAN_SFF_MASK);
        memcpy(frame->data, raw.data, sizeof frame->data);
        *got = true;
    }
    return true;
}

static bool transmit(void *self, const struct fcc_frame *frame, uint32_t time_us)
{
    const int *descriptor = self;
    struct can_frame raw;

    (void)time_us; /* CAN frames carry no time */
    memset(&raw, 0, sizeof raw);
    raw.can_id = frame->id;
    raw.can_dlc = sizeof frame->data;
    memcpy(raw.data, frame->data, sizeof frame->data);
    return send(*descriptor, &raw, sizeof raw, MSG_DONTWAIT) == (ssize_t)sizeof raw ||
           errno == EAGAIN || errno == ENOBUFS || errno == EINTR;
}

static bool open_bus(const char *channel, struct fcc_bus *bus)
{
    static int descriptor;
    const canid_t mask = CAN_SFF_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG;
    struct can_filter filters[] = {{EHA_FCC_BIT_REQUEST_FRAME_ID, mask},
                                   {FCC_UDS_REQUEST_ID, mask}};
    struct sockaddr_can address;

    memset(&address, 0, sizeof address);
    address.can_family = AF_CAN;
    address.can_ifindex = (int)if_nametoindex(channel);
    if (address.can_ifindex == 0) {
        return false;
    }
    descriptor = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    if (descriptor < 0 ||
        setsockopt(descriptor, SOL_CAN_RAW, CAN_RAW_FILTER, filters, sizeof filters) != 0 ||
        bind(descriptor, (struct sockaddr *)&address, sizeof address) != 0) {
        return false;
    }
    bus->self = &descriptor;
    bus->receive = receive;
    bus->send = transmit;
    return true;
}

int main(int argc, char **argv)
{
    struct fcc_rider rider = fcc_bench_rider();

    return fcc_run(argc, argv, "INTERFACE", open_bus, &rider);
}
