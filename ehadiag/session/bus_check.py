"""Checks a bus: what maps, what is missing, and whether a diagnosis would take its test."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec
from msgspec.structs import replace

from ehadiag.core.actuator import Actuator
from firmware_iface.bus_map import BusMap
from firmware_iface.errors import valid_text
from firmware_iface.find_test import CandidateTests
from firmware_iface.recording import Samples
from firmware_iface.stored_test import StoredTest

if TYPE_CHECKING:
    from firmware_iface.bus_report import BusReport
    from firmware_iface.transport.frames import FrameTable

BUS_SCHEMA = "ehadiag.bus/1"
STATUS_ROLE_PREFIXES = ("status.", "command.test_id", "request.")


class BusCheck(msgspec.Struct, frozen=True):
    """Report on the frames of a bus; print it, or `to_dict`."""

    source: str
    """Where the frames are from, for people."""
    report: BusReport
    """Messages, rates, gaps, ranges; `problems` stand in the way of a diagnosis."""
    test: str
    """Stored test that the frames hold from beginning to end; empty without one."""
    samples: Samples | None
    """All samples on ticks; None: no channel was received."""

    @property
    def usable(self) -> bool:
        """Whether nothing stands in the way of a diagnosis."""
        return not self.report.problems

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object of `check-bus --json`."""
        head = {"schema": BUS_SCHEMA, "source": valid_text(self.source)}
        return {**head, **msgspec.to_builtins(self.report), "test": self.test or None}

    def __str__(self) -> str:
        """Return the report as lines of text."""
        from firmware_iface.bus_report import render_bus_report  # noqa: PLC0415

        return f"{self.source}\n{render_bus_report(self.report)}"


def check_frames(
    table: FrameTable,
    bus_map: BusMap,
    actuator: Actuator,
    tests: tuple[StoredTest, ...],
    source: str,
) -> BusCheck:
    """Check frames as a diagnosis would.

    table: frames in order of arrival; bus_map: meaning of the frames; actuator: data of the
    actuator; tests: tests that may have been played; source: where the frames are from, for people.
    Returns the report; with a complete test the diagnosis decides on its problems.
    """
    from ehadiag.assess.diagnosis import diagnose  # noqa: PLC0415 - loads kernels
    from ehadiag.assess.plausibility import objections_to_units  # noqa: PLC0415 - only where frames came
    from ehadiag.assess.verdict import Verdict  # noqa: PLC0415
    from firmware_iface.alignment.align import windowed_recordings  # noqa: PLC0415
    from firmware_iface.bus_report import report_bus  # noqa: PLC0415

    report = report_bus(table, bus_map)
    if not len(table):
        return BusCheck(source, report, "", None)
    window = len(table) + 1
    (everything,) = windowed_recordings([table], _without_status(bus_map), "", window, window)
    samples = everything.samples
    units = () if samples is None else objections_to_units(samples, actuator)
    candidates = CandidateTests(tests, actuator.controller)
    complete = [
        (item, test)
        for item in windowed_recordings([table], bus_map, "", window, window, candidates)
        for test in tests
        if item.test_id == test.id and item.samples is not None
        if item.samples.ticks == test.ticks
    ]
    if not complete:
        remarks = (*report.remarks, "no whole test is in it: a diagnosis needs one")
        report = replace(report, problems=(*report.problems, *units), remarks=remarks)
        return BusCheck(source, report, "", samples)
    recording, test = complete[-1]
    found = diagnose([recording], actuator, [test])
    if found.verdict is Verdict.NOT_TESTED:
        why = (f"a diagnosis of test {test.name!r} refuses: {item}" for item in found.reasons)
        report = replace(report, problems=(*report.problems, *units, *why))
    else:  # in spite of the report's problems
        verdict = f"test {test.name!r} is in it whole, and a diagnosis takes it"
        remarks = (*report.remarks, *report.problems, *units, verdict)
        report = replace(report, problems=(), remarks=remarks)
    return BusCheck(source, report, test.name, samples)


def _without_status(bus_map: BusMap) -> BusMap:
    """Return the bus without what it says of tests: all its frames are then one recording."""
    messages = {
        name: replace(
            item,
            roles=tuple(
                role for role in item.roles if not role.name.startswith(STATUS_ROLE_PREFIXES)
            ),
        )
        for name, item in bus_map.messages.items()
    }
    return replace(bus_map, messages={name: item for name, item in messages.items() if item.roles})
