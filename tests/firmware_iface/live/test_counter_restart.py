"""A computer that restarts its status counter with a change of state is one sender, not two."""

from __future__ import annotations

import pytest
from bus_synth import STATUS, make_truth, one, play
from msgspec.structs import replace

from firmware_iface.bus_map import default_map
from firmware_iface.codec import Encoder
from firmware_iface.live_decode import BitStatus, LiveDecoder
from firmware_iface.recording import BitState

BUS = default_map()


class RestartingEncoder(Encoder):
    """Restarts the counter of the status whenever the state changes."""

    def __init__(self, first: int) -> None:
        super().__init__(BUS)
        self._first, self._state = first, None

    def status(self, state, *rest):
        if state != self._state:
            self._counters["BitStatus"] = self._first
        self._state = state
        return super().status(state, *rest)


def frames_of(encoder: Encoder, idle_before: int = 1200, shift_ns: int = 0, **options):
    frames = play(encoder, make_truth(2000), idle_before=idle_before, idle_after=400, **options)
    return [replace(item, time_ns=item.time_ns + shift_ns) for item in frames]


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("idle_before", [80, 1200, 6000])
def test_a_restart_with_a_change_of_state_is_no_second_sender(idle_before: int, first: int) -> None:
    frames = frames_of(RestartingEncoder(first), idle_before)
    decoder = LiveDecoder(BUS)
    states = [
        item.state for frame in frames if isinstance(item := decoder.decode(frame), BitStatus)
    ]
    assert (decoder.second_sender, decoder.conflicts) == ("", 0)
    assert {BitState.IDLE, BitState.RUNNING, BitState.COMPLETE} <= set(states)
    recording = one(frames, BUS)
    assert recording.quality.refused == ()
    assert recording.quality.messages["BitStatus"].conflicts == 0
    assert recording.outcome.state is BitState.COMPLETE


@pytest.mark.parametrize("apart", [1, 3, 20, 60, 200])
@pytest.mark.parametrize("restarting", [False, True])
def test_two_senders_of_different_states_are_found(apart: int, restarting: bool) -> None:
    ours = frames_of(RestartingEncoder(0) if restarting else Encoder(BUS))
    other = Encoder(BUS)
    other._counters["BitStatus"] = 255 - apart
    theirs = [
        frame
        for tick in range(0, 3600, 20)
        for frame in other.status(
            BitState.IDLE, 0, 0, 0.001 * tick, 78, ours[0].time_ns + tick * 1_000_000 + 7_000_000
        )
    ]
    assert all(frame.can_id == STATUS for frame in theirs)
    frames = sorted([*ours, *theirs], key=lambda item: item.time_ns)
    decoder = LiveDecoder(BUS)
    for frame in frames:
        decoder.decode(frame)
    assert "a second sender of BitStatus" in decoder.second_sender
