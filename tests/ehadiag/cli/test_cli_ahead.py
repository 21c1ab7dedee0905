"""Identification while the test runs: same digits as afterwards, and no listening beyond need."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest
from cli_result import Run
from msgspec.structs import replace
from places import LOGS

from ehadiag import Recording, StoredTest, default_actuator
from ehadiag.assess.acceptance import is_complete_recording
from ehadiag.assess.diagnosis import DiagnosisSession
from ehadiag.session.bit_run import EarlyIdentification, early_identification
from ehadiag.setup import Deadline
from firmware_iface.handshake import Phase
from firmware_iface.logs.reader import read_frames
from firmware_iface.recording import BitState
from firmware_iface.stored_test import resolve_test
from firmware_iface.tester import Assembler, BitProgress
from firmware_iface.transport.frames import Frame

TEST = resolve_test("open")


def assembler_of(
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


def test_stages_run_when_they_are_due(monkeypatch: pytest.MonkeyPatch) -> None:
    session = a_session()
    due = len(session.due_s(TEST))
    taken = threading.Semaphore(0)
    work = session.feed

    def take(recording: Recording) -> None:
        work(recording)
        taken.release()

    monkeypatch.setattr(session, "feed", take)
    with early_identification(session, assembler_of("paper-open-1.blf"), TEST) as ahead:
        for tenth in range(54):
            ahead.watch(BitProgress(Phase.RUNNING, tenth / 10.0, TEST.duration, 0, None))
        assert all(taken.acquire(timeout=60.0) for _ in range(due))
        assert ahead.finish(Deadline(60.0), threading.Event())
    assert due == 4
    # First approximation, three stages of search, refinement.
    assert session.reused == 3 * 5, "the log has all of them at the first of four instants"


def a_session() -> DiagnosisSession:
    return DiagnosisSession(default_actuator(), (TEST,))


class Blocked:
    """A session that is at its first snapshot until it may go on."""

    def __init__(self) -> None:
        self.begun, self.go_on = threading.Event(), threading.Event()
        self.taken: list[int] = []

    def due_s(self, _test: StoredTest) -> tuple[float, ...]:
        return (0.1, 0.2, 0.3, 0.4)

    def feed(self, number: int) -> None:
        self.taken.append(number)
        self.begun.set()
        assert self.go_on.wait(60.0)


class Numbered:
    """An assembler whose tables are numbers."""

    def __init__(self) -> None:
        self.tables = 0

    def table(self) -> int:
        self.tables += 1
        return self.tables

    def recording_of(self, table: int) -> int:
        return table


def watched(ahead: EarlyIdentification, session: Blocked) -> None:
    """Let every snapshot fall due; the first one is at work then, the others wait."""
    for at in session.due_s(TEST):
        ahead.watch(BitProgress(Phase.RUNNING, at + 0.05, 1.0, 0, None))
        assert session.begun.wait(60.0)


def test_the_end_does_not_wait_for_stale_snapshots(monkeypatch: pytest.MonkeyPatch) -> None:
    session: Any = Blocked()
    assembler: Any = Numbered()
    with early_identification(session, assembler, TEST) as ahead:
        watched(ahead, session)
        join = ahead._thread.join

        def waiting(timeout: float | None = None) -> None:
            session.go_on.set()
            join(timeout)

        monkeypatch.setattr(ahead._thread, "join", waiting)
        assert ahead.finish(Deadline(60.0), threading.Event())
    assert session.taken == [1, 4]


def test_ctrl_c_after_the_test_abandons_what_runs_ahead(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []

    def interrupted(*_: object) -> bool:
        told.append("finish")
        raise KeyboardInterrupt

    def abandon(ahead: EarlyIdentification) -> None:
        told.append("abandon")
        leave(ahead)

    leave = EarlyIdentification.abandon
    monkeypatch.setattr(EarlyIdentification, "finish", interrupted)
    monkeypatch.setattr(EarlyIdentification, "abandon", abandon)
    bit = ("bit", "--simulate", "--fast", "--json", "--no-picture", "--test", "open")
    result = run(*bit, "--record", "a.blf")
    assert (result.code, told) == (30, ["finish", "abandon"])
    assert result.objects[0]["reasons"] == ["stopped by the user"]


def test_the_wait_for_what_runs_ahead_has_an_end(monkeypatch: pytest.MonkeyPatch) -> None:
    online: Any = Blocked()
    assembler: Any = Numbered()
    with early_identification(online, assembler, TEST) as ahead:
        watched(ahead, online)
        assert not ahead.finish(Deadline(0.01), threading.Event())
        stop = threading.Event()
        stop.set()
        assert not ahead.finish(Deadline(60.0), stop)
        ahead.abandon()
    online.go_on.set()


def test_a_test_that_is_all_there_needs_no_more_listening() -> None:
    with early_identification(a_session(), assembler_of("paper-open-1.blf"), TEST) as ahead:
        assert ahead.all_there()
        assert ahead.finish(Deadline(60.0), threading.Event())
    assert ahead.complete_recording is not None
    assert ahead.complete_recording.outcome.state is BitState.COMPLETE
    assert ahead.ended_at is not None


@pytest.mark.parametrize(("without", "before"), [(1, 0), (1, 49), (40, 0)])
def test_frames_that_are_missing_may_be_under_way(without: int, before: int) -> None:
    log = assembler_of("paper-open-1.blf", without=without, before=before)
    with early_identification(a_session(), log, TEST) as ahead:
        assert not ahead.all_there()
        ahead.abandon()
    assert ahead.complete_recording is None


def test_what_may_be_under_way() -> None:
    assert is_complete_recording(assembler_of("paper-open-1.blf").recording(), TEST)
    assert not is_complete_recording(
        assembler_of("paper-open-1.blf").recording(), resolve_test("closed")
    )
    lossy = assembler_of("lossy-open.blf").recording()
    assert np.isnan(lossy.samples.spool).sum() > 50
    assert is_complete_recording(lossy, TEST), "none of its last samples is lost"
    lost = assembler_of("paper-open-1.blf", without=3, before=50).recording()
    assert not np.isfinite(lost.samples.spool).all()
    assert is_complete_recording(lost, TEST), "lost for good"
    blind = assembler_of("paper-open-1.blf").recording()
    blind = replace(blind, samples=replace(blind.samples, position=np.full(TEST.ticks, np.nan)))
    assert is_complete_recording(blind, TEST), "a channel that is not on this bus"
    running = assembler_of("paper-open-1.blf", until=BitState.RUNNING).recording()
    assert not is_complete_recording(running, TEST)
