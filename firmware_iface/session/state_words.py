"""Says in plain words what a computer told last of its built-in test."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ehadiag.core.recording import BitReason, BitState
from firmware_iface.codec.decode import Decoded
from firmware_iface.mapping.bus_map import BusMap

__all__ = ["state_in_words"]


def state_in_words(messages: Mapping[str, Decoded], bus_map: BusMap) -> str:
    """Say what the computer told last of its test.

    Parameters
    ----------
    messages : Mapping[str, Decoded]
        Decoded messages by name.
    bus_map : BusMap
        What they mean.

    Returns
    -------
    str
        One sentence; empty where it told nothing.
    """
    lead = bus_map.find("status.state")
    if lead is None or not len(messages[lead[0].name].row):
        return ""
    item = messages[lead[0].name]

    def last(key: str) -> float:
        known = item.values.get(f"status.{key}", np.empty(0))
        known = known[np.isfinite(known)]
        return float(known[-1]) if len(known) else float("nan")

    said = bus_map.states.get(int(last("state")) if np.isfinite(last("state")) else -1)
    if said is None:
        return f"state of the test: {last('state'):g}, which the mapping does not name"
    words = f"state of the test: {said.name.lower()}"
    if np.isfinite(last("test_id")) and last("test_id") > 0:
        words += f", test {last('test_id'):.0f}"
    if said is BitState.RUNNING and np.isfinite(last("elapsed")):
        words += f", {last('elapsed'):.1f} s since its start"
    if said in (BitState.REFUSED, BitState.ABORTED) and np.isfinite(last("reason")):
        number = int(last("reason"))
        if number in BitReason.__members__.values():
            words += f" ({BitReason(number).name.lower().replace('_', ' ')})"
    return words
