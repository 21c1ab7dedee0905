"""Builds and runs the emulated flight-control computer for `sim` and `bit --simulate`."""

from __future__ import annotations

import argparse
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import numpy as np

from ehadiag.cli.effects import the_effects, the_sensors
from ehadiag.core.actuator import Actuator
from ehadiag.core.errors import EhadiagError
from ehadiag.core.stored_test import StoredTest
from ehadiag_sim.faults.hardware import Hardware, break_hardware
from ehadiag_sim.fcc.computer import FccCore
from ehadiag_sim.fcc.emulator import run_emulator
from ehadiag_sim.plant.conditions import Faults
from firmware_iface.mapping.bus_map import BusMap
from firmware_iface.transport.interface import Transport

__all__ = ["emulator_beside", "make_core"]


def make_core(
    arguments: argparse.Namespace,
    actuator: Actuator,
    tests: Iterable[StoredTest],
    bus_map: BusMap,
) -> FccCore:
    """Return the computer with the actuator that the options describe, its kernels loaded.

    Parameters
    ----------
    arguments : argparse.Namespace
        The parsed command line.
    actuator : Actuator
        Data of the actuator.
    tests : Iterable[StoredTest]
        Tests that the computer stores, each with a number of its own.
    bus_map : BusMap
        Which message and signal plays which role.

    Returns
    -------
    FccCore
        The emulated computer.

    Raises
    ------
    ConfigurationError
        A value out of its range, an unknown kind of broken hardware.
    """
    item = Hardware(actuator, the_effects(arguments), the_sensors(arguments))
    if arguments.broken:
        rng = np.random.default_rng(arguments.simulator_seed)
        item = break_hardware(arguments.broken, rng, item)
    core = FccCore(
        item.actuator,
        tests,
        faults=Faults(arguments.Kintas, arguments.FSS, arguments.FDJ),
        effects=item.effects,
        sensors=item.sensors,
        seed=arguments.simulator_seed,
        serial=arguments.serial_number,
        bus_map=bus_map,
        channel_faults=item.channel_faults,
        # In simulated time too a recording has the date of its test.
        start_ns=time.time_ns(),
    )
    core.step()
    return core


@contextmanager
def emulator_beside(core: FccCore, transport: Transport) -> Iterator[None]:
    """Run the computer on a bus in a thread of its own while the block runs.

    Parameters
    ----------
    core : FccCore
        The emulated computer.
    transport : Transport
        The bus to send and receive on.

    Raises
    ------
    EhadiagError
        The emulator's bus failed meanwhile.
    """
    stop = threading.Event()
    failure: list[EhadiagError] = []

    def work() -> None:
        try:
            run_emulator(core, transport, stop)
        except EhadiagError as error:
            failure.append(error)

    thread = threading.Thread(target=work, name="ehadiag-emulator", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
    if failure:
        raise failure[0]
