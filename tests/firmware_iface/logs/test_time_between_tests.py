"""Time between tests on a bus that says nothing of them is no test."""

from __future__ import annotations

import pytest
from places import LOGS

from ehadiag import bundled_tests, default_actuator
from ehadiag_tools.rigs.replay import as_sent
from ehadiag_tools.rigs.rerecord import BUSES, Disturbance, frames_on, played
from firmware_iface.alignment.align import windowed_recordings
from firmware_iface.find_test import CandidateTests
from firmware_iface.signals import recordings
from firmware_iface.signals.recordings import Interpretation, read_recording, recorded_tests

SOUGHT = CandidateTests(tuple(bundled_tests().values()), default_actuator().controller)
WINDOW = 14_000
"""Frames held at once: 7 s, more than a test and less than the time before it."""


@pytest.fixture(scope="module")
def bus_log():
    """A test after more idle time than is held at once."""
    source = read_recording(LOGS / "paper-open-1.blf")
    how = Disturbance(lead_in_s=8.0)
    this = played(source.samples, as_sent(bundled_tests()["open"]), how.lead_in_s)
    return frames_on(BUSES["command"], source, this, how, 1)


def stretches(table, bus_map, sought):
    """What windows of the log hold."""
    tables = [table.rows(slice(row, row + 1000)) for row in range(0, len(table), 1000)]
    return list(windowed_recordings(tables, bus_map, "bus", WINDOW, WINDOW, sought))


def test_only_tests_are_recordings(bus_log, monkeypatch):
    found = stretches(*bus_log, SOUGHT)
    assert {item.test_id for item in found} == {None, 1}
    monkeypatch.setattr(recordings, "iterate_recordings", lambda *_: iter(found))
    named = list(recorded_tests(["bus.blf"], Interpretation(bus_log[1], None, SOUGHT)))
    assert [item.test_id for item in named] == [1]


def test_a_log_without_a_test_says_so_once(bus_log, monkeypatch):
    other = CandidateTests((bundled_tests()["closed"],), SOUGHT.controller)
    found = stretches(*bus_log, other)
    assert len(found) > 1
    monkeypatch.setattr(recordings, "iterate_recordings", lambda *_: iter(found))
    (left,) = recorded_tests(["bus.blf"], Interpretation(bus_log[1], None, other))
    assert left.test_id is None
    assert "no stored test" in " ".join(left.quality.notes)
