"""What a diagnosis would say of the frames that `check-bus` heard: units, signs, a whole test."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from ehadiag.core.actuator import Actuator
from ehadiag.core.find_test import Sought
from ehadiag.core.recording import Recording, Samples
from ehadiag.core.stored_test import StoredTest

if TYPE_CHECKING:
    from firmware_iface.mapping.bus_map import BusMap
    from firmware_iface.transport.frames import FrameTable

__all__ = ["Outlook", "outlook"]

NOT_PHYSICS = ("status.", "command.test_id", "request.")


@dataclass(frozen=True, slots=True)
class Outlook:
    """What a diagnosis would say.

    Attributes
    ----------
    units : tuple[str, ...]
        Channels whose unit or sign motion contradicts.
    test : str
        The stored test that the frames hold whole; empty without one.
    refused : tuple[str, ...]
        Why it would not be judged.
    heard : Samples | None
        All that was heard, on ticks; None: no channel was.
    """

    units: tuple[str, ...]
    test: str
    refused: tuple[str, ...]
    heard: Samples | None = None


def outlook(
    table: FrameTable, bus_map: BusMap, actuator: Actuator, tests: tuple[StoredTest, ...]
) -> Outlook:
    """Ask of some frames what a diagnosis would ask of them.

    Parameters
    ----------
    table : FrameTable
        Frames in order of arrival.
    bus_map : BusMap
        What they mean.
    actuator : Actuator
        Data of the actuator.
    tests : tuple[StoredTest, ...]
        Tests that may have been played.

    Returns
    -------
    Outlook
        Without motion and test there is nothing in it.
    """
    from ehadiag.assess.wrong_units import implausible  # noqa: PLC0415 - only where frames came
    from firmware_iface.alignment.windows import recordings_of  # noqa: PLC0415

    if not len(table):
        return Outlook((), "", ())
    everything = len(table) + 1
    (whole,) = recordings_of([table], _without_test(bus_map), "", everything, everything)
    units = () if whole.samples is None else implausible(whole.samples, actuator)
    sought = Sought(tests, actuator.controller)
    ran = [
        (item, test)
        for item in recordings_of([table], bus_map, "", everything, everything, sought)
        for test in tests
        if item.test_id == test.id and item.samples is not None
        if item.samples.ticks == test.ticks
    ]
    if not ran:
        return Outlook(units, "", (), whole.samples)
    recording, test = ran[-1]
    refused = tuple(_objections(recording, test, actuator))
    return Outlook(units, test.name, refused, whole.samples)


def _without_test(bus_map: BusMap) -> BusMap:
    """The same bus, saying nothing of a test: all that was heard is then one stretch of motion."""
    messages = {
        name: replace(
            item, roles=tuple(role for role in item.roles if not role.name.startswith(NOT_PHYSICS))
        )
        for name, item in bus_map.messages.items()
    }
    return replace(bus_map, messages={name: item for name, item in messages.items() if item.roles})


def _objections(recording: Recording, test: StoredTest, actuator: Actuator) -> list[str]:
    from ehadiag.assess.acceptance import (  # noqa: PLC0415 - loads numba
        objections_to_experiment,
        objections_to_recording,
    )
    from ehadiag.identify.experiment import build_experiment  # noqa: PLC0415

    found = objections_to_recording(recording, test, actuator)
    if found or recording.samples is None:
        return found
    return objections_to_experiment(
        build_experiment(recording.samples, recording.environment, test, actuator)
    )
