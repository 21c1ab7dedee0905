"""Two tests of different modes in one log of a bus without test numbers: both are found."""

from __future__ import annotations

from dataclasses import replace

import pytest
from places import LOGS

from ehadiag.core.actuator import default_actuator
from ehadiag.core.find_test import Sought
from ehadiag.core.stored_test import bundled_tests
from ehadiag_tools.rigs.buses import BUSES
from ehadiag_tools.rigs.replay import as_sent
from ehadiag_tools.rigs.rerecord import Disturbance, frames_on, played
from firmware_iface.alignment.windows import recordings_of
from firmware_iface.logs.reader import read_recording
from firmware_iface.transport.frames import concatenate

TESTS = bundled_tests()
LATER_NS = 7_000_000_000


@pytest.fixture(scope="module")
def log():
    """An open and a closed loop test, one after the other, frames late by 0.5 ms."""
    (bus,) = (item for item in BUSES if item.name == "command")
    tables = []
    for index, (name, test) in enumerate((("paper-open-2", "open"), ("paper-closed-3", "closed"))):
        recording = read_recording(LOGS / f"{name}.blf")
        this = played(recording.samples, as_sent(TESTS[test]), 0.5)
        table, bus_map = frames_on(bus, recording, this, Disturbance(0.5, drift_ppm=100.0), 1)
        tables.append(replace(table, time_ns=table.time_ns + index * LATER_NS))
    return concatenate(tables), bus_map


def found(log, *tests: str, **where: float):
    table, bus_map = log
    sought = Sought(tuple(TESTS[name] for name in tests), default_actuator().controller, **where)
    return list(recordings_of([table], bus_map, "log", len(table) + 1, sought=sought))


def test_both_are_found_in_order_of_time(log):
    both = found(log, "open", "closed")
    assert [item.test_id for item in both] == [1, 2]
    notes = [" ".join(item.quality.notes) for item in both]
    assert "test 'open' found by its command at 0.500 s" in notes[0]
    assert "test 'closed' found by its command at 7.499 s" in notes[1]


@pytest.mark.parametrize("name", ["open", "closed"])
def test_one_is_chosen_by_its_name(log, name):
    (only,) = found(log, name)
    assert only.test_id == TESTS[name].id


def test_one_is_chosen_by_its_time(log):
    (first,) = found(log, "open", "closed", end_s=6.8)
    (second,) = found(log, "open", "closed", start_s=6.5)
    assert (first.test_id, second.test_id) == (1, 2)
