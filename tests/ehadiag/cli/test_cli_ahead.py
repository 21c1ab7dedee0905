"""Identification while the test runs: same digits as afterwards, and no listening beyond need."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from cli_result import Run
from places import LOGS

from ehadiag.assess.acceptance import nothing_is_under_way
from ehadiag.assess.diagnosis import DiagnosisSession
from ehadiag.cli.ahead import Ahead, working_ahead
from ehadiag.cli.deadline import Deadline
from ehadiag.core.actuator import default_actuator
from ehadiag.core.recording import BitState, Recording
from ehadiag.core.stored_test import StoredTest, resolve_test
from firmware_iface.logs.reader import read_frames
from firmware_iface.session.assembler import Assembler
from firmware_iface.session.handshake import Phase
from firmware_iface.session.tester import Progress
from firmware_iface.transport.frames import Frame

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


def test_stages_run_when_they_are_due(monkeypatch: pytest.MonkeyPatch) -> None:
    session = a_session()
    due = len(session.due_s(TEST))
    taken = threading.Semaphore(0)
    work = session.feed

    def take(recording: Recording) -> None:
        work(recording)
        taken.release()

    monkeypatch.setattr(session, "feed", take)
    with working_ahead(session, heard("paper-open-1.blf"), TEST) as ahead:
        for tenth in range(54):
            ahead.watch(Progress(Phase.RUNNING, tenth / 10.0, TEST.duration, 0, None))
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


def watched(ahead: Ahead, session: Blocked) -> None:
    """Let every snapshot fall due; the first one is at work then, the others wait."""
    for at in session.due_s(TEST):
        ahead.watch(Progress(Phase.RUNNING, at + 0.05, 1.0, 0, None))
        assert session.begun.wait(60.0)


def test_the_end_does_not_wait_for_stale_snapshots(monkeypatch: pytest.MonkeyPatch) -> None:
    session: Any = Blocked()
    assembler: Any = Numbered()
    with working_ahead(session, assembler, TEST) as ahead:
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

    def abandon(ahead: Ahead) -> None:
        told.append("abandon")
        leave(ahead)

    leave = Ahead.abandon
    monkeypatch.setattr(Ahead, "finish", interrupted)
    monkeypatch.setattr(Ahead, "abandon", abandon)
    result = run("bit", "--simulate", "--fast", "--json", "--test", "open", "--record", "a.blf")
    assert (result.code, told) == (30, ["finish", "abandon"])
    assert result.objects[0]["reasons"] == ["stopped by the user"]


def test_the_wait_for_what_runs_ahead_has_an_end(monkeypatch: pytest.MonkeyPatch) -> None:
    online: Any = Blocked()
    assembler: Any = Numbered()
    with working_ahead(online, assembler, TEST) as ahead:
        watched(ahead, online)
        assert not ahead.finish(Deadline(0.01), threading.Event())
        stop = threading.Event()
        stop.set()
        assert not ahead.finish(Deadline(60.0), stop)
        ahead.abandon()
    online.go_on.set()


def test_a_test_that_is_all_there_needs_no_more_listening() -> None:
    with working_ahead(a_session(), heard("paper-open-1.blf"), TEST) as ahead:
        assert ahead.all_there()
        assert ahead.finish(Deadline(60.0), threading.Event())
    assert ahead.whole is not None
    assert ahead.whole.outcome.state is BitState.COMPLETE
    assert ahead.ended_at is not None


@pytest.mark.parametrize(("without", "before"), [(1, 0), (1, 49), (40, 0)])
def test_frames_that_are_missing_may_be_under_way(without: int, before: int) -> None:
    log = heard("paper-open-1.blf", without=without, before=before)
    with working_ahead(a_session(), log, TEST) as ahead:
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
