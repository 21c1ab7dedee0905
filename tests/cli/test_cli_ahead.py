"""Working ahead of the end of a test: when there is nothing left to listen for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cli_result import LOGS

from ehadiag.actuator import default_actuator
from ehadiag.cli.ahead import working_ahead
from ehadiag.fitness import nothing_is_under_way
from ehadiag.online import OnlineIdentification
from ehadiag.recording import BitState
from ehadiag.storedtest import resolve_test
from firmware_iface.assembler import Assembler
from firmware_iface.frames import Frame
from firmware_iface.handshake import Phase
from firmware_iface.logs import read_frames
from firmware_iface.tester import Progress

TEST = resolve_test("open")


def heard(
    name: str, *, until: BitState = BitState.COMPLETE, without: int = 0, before: int = 0
) -> Assembler:
    """Frames of a log up to the first status that says so.

    Of the telemetry so many are left out, and so many come after them.
    """
    table = read_frames(LOGS / name)
    states = np.where(table.can_id == 0x201, table.data[:, 0] & 15, -1)
    end = int(np.flatnonzero(states == until)[0]) + 1
    telemetry = np.flatnonzero(table.can_id[:end] == 0x110)
    last = len(telemetry) - before
    left_out = set(telemetry[last - without : last].tolist())
    assembler = Assembler(name)
    for row in sorted(set(range(end)) - left_out):
        data = table.data[row, : table.length[row]].tobytes()
        assembler.add(Frame(int(table.time_ns[row]), can_id=int(table.can_id[row]), data=data))
    return assembler


def test_stages_run_when_they_are_due() -> None:
    online = OnlineIdentification(TEST, default_actuator())
    with working_ahead(online, heard("paper-open-1.blf"), TEST) as ahead:
        for tenth in range(54):
            ahead.watch(Progress(Phase.RUNNING, tenth / 10.0, TEST.duration, 0, None))
        ahead.finish()
    assert len(online.memory) == 5, "first approximation, three stages of search, refinement"
    assert online.memory.reused == 3 * 5, "the log has all of them at the first of four instants"


def test_a_test_that_is_all_there_needs_no_more_listening() -> None:
    online = OnlineIdentification(TEST, default_actuator())
    with working_ahead(online, heard("paper-open-1.blf"), TEST) as ahead:
        assert ahead.all_there()
        ahead.finish()
    assert ahead.whole is not None
    assert ahead.whole.outcome.state is BitState.COMPLETE
    assert ahead.ended_at is not None


@pytest.mark.parametrize(("without", "before"), [(1, 0), (1, 49), (40, 0)])
def test_frames_that_are_missing_may_be_under_way(without: int, before: int) -> None:
    online = OnlineIdentification(TEST, default_actuator())
    log = heard("paper-open-1.blf", without=without, before=before)
    with working_ahead(online, log, TEST) as ahead:
        assert not ahead.all_there()
        ahead.abandon()
    assert ahead.whole is None


def test_what_may_be_under_way() -> None:
    assert nothing_is_under_way(heard("paper-open-1.blf").recording(), TEST)
    assert not nothing_is_under_way(heard("paper-open-1.blf").recording(), resolve_test("closed"))
    lossy = heard("lossy-open.blf").recording()
    assert np.isnan(lossy.samples.spool).sum() > 50
    assert nothing_is_under_way(lossy, TEST), "none of its last samples is lost"
    lost = heard("paper-open-1.blf", without=3, before=50).recording()
    assert not np.isfinite(lost.samples.spool).all()
    assert nothing_is_under_way(lost, TEST), "lost for good"
    blind = heard("paper-open-1.blf").recording()
    blind = replace(blind, samples=replace(blind.samples, position=np.full(TEST.ticks, np.nan)))
    assert nothing_is_under_way(blind, TEST), "a channel that is not on this bus"
    running = heard("paper-open-1.blf", until=BitState.RUNNING).recording()
    assert not nothing_is_under_way(running, TEST)
