"""The monitor beside a test: alarms by what was known of the unit before, and nothing it stops."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from places import LOGS

from ehadiag.cli.watch.in_test import InTest
from ehadiag.cli.watch.known import KnownUnit
from ehadiag.core.actuator import default_actuator
from ehadiag.core.errors import ConfigurationError
from ehadiag.core.stored_test import resolve_test
from ehadiag.live.snapshot import Severity
from firmware_iface.logs.reader import read_frames
from firmware_iface.mapping.bus_map import BusMap, default_map
from firmware_iface.transport.frames import Frame

ACTUATOR, TEST = default_actuator(), resolve_test("open")
TRUE = {"Kintas": 0.6, "FSS": 0.6, "FDJ": 0.6}


def known(**severities: float) -> KnownUnit:
    return KnownUnit(
        "diagnosis 3",
        tuple(Severity(name=name, estimate=item) for name, item in severities.items()),
    )


def beside(find: Callable[[int], KnownUnit | None] | None, bus_map: BusMap | None = None) -> InTest:
    """The recording of an open-loop test, watched; the history answers before the test begins."""
    made = InTest(ACTUATOR, bus_map or default_map(), [TEST], find)
    table = read_frames(LOGS / "paper-open-4.blf")
    status = int(np.flatnonzero(table.can_id == 0x201)[0])
    for row in range(len(table.can_id)):
        data = table.data[row, : table.length[row]].tobytes()
        made.take(Frame(int(table.time_ns[row]), can_id=int(table.can_id[row]), data=data))
        if row == status:
            for thread in threading.enumerate():
                if thread.name == "ehadiag-known":
                    thread.join()
    return made


def test_a_unit_of_which_nothing_is_known_is_compared_with_a_new_one() -> None:
    made = beside(None)
    count, alarms = made.alarms
    assert count == len(alarms) > 0
    assert {item.during for item in alarms} == {"open"}
    assert made.residuals is not None
    assert made.residuals.against == "a unit as new"
    assert made.why == ""


def test_a_unit_that_is_as_its_history_says_raises_no_alarm() -> None:
    asked = []

    def find(serial: int) -> KnownUnit:
        asked.append(serial)
        return known(**TRUE)

    made = beside(find)
    assert made.alarms == (0, ())
    assert made.residuals is not None
    assert made.residuals.against == "diagnosis 3"
    assert asked == [made.serial]


@pytest.mark.parametrize("wrong", [0.65, 0.0])
def test_a_unit_that_has_changed_since_raises_one(wrong: float) -> None:
    assert beside(lambda _serial: known(**TRUE | {"FSS": wrong})).alarms[0] > 0


def test_a_history_that_cannot_be_asked_is_said_and_the_test_goes_on() -> None:
    def find(_serial: int) -> KnownUnit:
        raise ConfigurationError("history x: is none")

    made = beside(find)
    assert made.why == "earlier diagnoses are not looked at: history x: is none"
    assert made.residuals is not None


def test_a_bus_without_single_ticks_has_no_residuals_and_says_why() -> None:
    telemetry = next(item for item in default_map().messages.values() if item.can_id == 0x110)
    slow = replace(
        default_map(),
        messages={**default_map().messages, telemetry.name: replace(telemetry, counter=None)},
    )
    made = beside(None, slow)
    assert made.residuals is None
    assert made.why.startswith("no residuals: ")
    assert "counter" in made.why
