"""Checks before `ehadiag bit` starts: options, rates and buses that could not lead to a verdict."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from ehadiag.cli import bus_options
from ehadiag.core.actuator import Actuator
from ehadiag.core.errors import ConfigurationError
from ehadiag.core.stored_test import SAME_RATE, StoredTest

if TYPE_CHECKING:
    from firmware_iface.mapping.bus_map import BusMap

__all__ = ["refuse_beforehand"]


def refuse_beforehand(
    arguments: argparse.Namespace, test: StoredTest, actuator: Actuator, bus_map: BusMap
) -> None:
    """Refuse what could not end in a verdict whatever the bus says.

    Parameters
    ----------
    arguments : argparse.Namespace
        The parsed command line.
    test : StoredTest
        The stored test.
    actuator : Actuator
        Data of the actuator.
    bus_map : BusMap
        The bus that will carry the test.

    Raises
    ------
    ConfigurationError
        Options that contradict each other, different rates, a bus on which the test cannot be
        requested.
    """
    _refuse_contradictions(arguments)
    _refuse_other_rates(test, actuator, bus_map)
    if arguments.listen and bus_map.find("status.state") is None:
        raise ConfigurationError(
            f"--listen: the mapping {bus_map.name} has no status.state, and nothing else tells when"
            " a test begins and ends: record with another tool, and find the test by ehadiag"
            " diagnose"
        )
    if not arguments.listen:
        _refuse_what_cannot_be_requested(test, bus_map)


def _refuse_other_rates(test: StoredTest, actuator: Actuator, bus_map: BusMap) -> None:
    """Say before the surface moves that its test could not be judged."""
    rates = {
        f"test {test.name!r}": test.rate,
        f"controller of actuator {actuator.name!r}": actuator.controller.rate,
        "mapping of the bus": 1e9 / bus_map.tick_ns,
    }
    if max(rates.values()) > min(rates.values()) * (1.0 + SAME_RATE):
        each = ", ".join(f"{name} {rate:g} Hz" for name, rate in rates.items())
        raise ConfigurationError(f"different rates: {each}")


def _refuse_contradictions(arguments: argparse.Namespace) -> None:
    if arguments.simulate and arguments.listen:
        raise ConfigurationError("--simulate and --listen exclude each other")
    if arguments.fast and not arguments.simulate:
        raise ConfigurationError("--fast: only the simulated actuator can hurry, add --simulate")
    if arguments.fast and bus_options.has_bus(arguments):
        raise ConfigurationError("--fast: a bus has its own time, leave --interface out")
    if arguments.simulate and arguments.serial:
        raise ConfigurationError(
            "--simulate: a serial link has two ends, run ehadiag sim on the other one"
        )
    if arguments.simulate:
        bus_options.refuse_two_buses(arguments)
    else:
        bus_options.need_one_bus(arguments)


def _refuse_what_cannot_be_requested(test: StoredTest, bus_map: BusMap) -> None:
    from firmware_iface.codec.encode import Encoder  # noqa: PLC0415

    encoder = Encoder(bus_map)
    for code in ("start", "abort"):
        encoder.request(code, test.id)
