"""Chooses the adapter channel of a recording that carries the actuator's bus.

A frame belongs to its channel, bus and identifier: equal identifiers on two channels are two
streams, never one.
"""

from __future__ import annotations

import numpy as np

from firmware_iface.codec.validity import rows_of, sound_rows
from firmware_iface.mapping.bus_map import BusMap
from firmware_iface.transport.frames import FrameTable

__all__ = ["channels_in", "choose_channel"]


def channels_in(table: FrameTable, bus_map: BusMap) -> frozenset[int]:
    """Channels on which a sound frame of the actuator's came; 0, where none is said, left out.

    Requests do not count: they are the tester's.
    """
    numbers = np.unique(table.channel)
    if len(numbers) == 1:
        return frozenset(numbers[numbers > 0].tolist())
    found: set[int] = set()
    for message in bus_map.messages.values():
        if not all(role.name.startswith("request.") for role in message.roles):
            row, *_ = sound_rows(table, rows_of(table, message), message)
            found.update(np.unique(table.channel[row]).tolist())
    return frozenset(found - {0})


def choose_channel(chosen: int | None, present: frozenset[int]) -> tuple[int | None, str]:
    """Channel to decode (None: all there are), and why none can be; empty if one can.

    Parameters
    ----------
    chosen : int | None
        By the mapping or by `--log-channel`; None: not at all.
    present : frozenset[int]
        What `channels_in` found in the recording.

    Returns
    -------
    tuple[int | None, str]
        The channel, and the reason why there is none (empty: there is one).
    """
    listed = ", ".join(map(str, sorted(present)))
    if chosen is None:
        if len(present) > 1:
            return None, (
                f"frames of the actuator's on the adapter channels {listed}: choose one by"
                " --log-channel, or by channel in the mapping"
            )
        return next(iter(present), None), ""
    if present and chosen not in present:
        return chosen, (
            f"no frame of the actuator's on adapter channel {chosen}, which was chosen; there are"
            f" on {listed}"
        )
    return chosen, ""
