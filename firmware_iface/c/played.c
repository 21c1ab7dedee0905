#include "played.h"

#include <string.h>

void fcc_played_tick(struct fcc_played *played, const struct fcc_command *command,
                     uint16_t codes[4])
{
    static const uint16_t rest[4] = {FCC_CENTRE, FCC_CENTRE, FCC_CENTRE, FCC_CENTRE};

    if (command->test_id == 0) {
        played->place = 0;
    }
    if (command->test_id == 0 || played->place >= played->count) {
        memcpy(codes, rest, sizeof rest);
    } else {
        memcpy(codes, played->codes[played->place++], sizeof rest);
    }
}
