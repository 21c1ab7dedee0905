"""Study of recordings by a data acquisition with converters and a clock of its own.

The plant is sampled at 50 kHz, and read between two samples by a local cubic. The control computer
reads it once a tick through its own converters and acts on what these say; the acquisition never
sees their codes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray
from scipy.interpolate import Akima1DInterpolator

from ehadiag.assess.diagnosis import diagnose
from ehadiag.core.actuator import Actuator, default_actuator
from ehadiag_sim.conditions import Faults, Sensors, UnmodelledEffects
from ehadiag_sim.plant_dynamics import PlantDynamics
from ehadiag_sim.plant_laws import PositionController
from ehadiag_sim.sensing import SimulatedConverters
from ehadiag_sim.simulation import bus_command
from ehadiag_tools.accuracy.figures import accuracy_table, is_answered, outcome
from ehadiag_tools.rigs.rerecord import TESTS, read_columns
from ehadiag_tools.study import Options, Record, Study
from firmware_iface.errors import EhadiagError
from firmware_iface.recording import CHANNELS, Channels, CommandMode
from firmware_iface.stored_test import bundled_tests

PLANT_RATE = 50_000.0
"""Samples of the plant a second, Hz; a whole number of them makes a control tick."""
SETTLING_S, AFTER_S = 0.2, 0.3
"""Rest before and after each test, s; the recording begins within the first."""
OFFSET_SHARE = 0.01
"""Largest offset of a converter of the acquisition, of its range, 1: PHY-34."""
RANGE_SHARE = 1.25
"""Range of the acquisition's converters, of the computer's, 1."""
NOISE_STEPS = {12: 0.5, 16: 2.0}
"""Noise before conversion by the acquisition's bits, its own steps rms."""
RATES = (1000.0, 2000.0, 5000.0, 10_000.0)


@dataclass(frozen=True, slots=True)
class DaqCase:
    """One recording: test, severities, and how it was acquired.

    Rate: of the acquisition, Hz; phase: of its first sample, of its interval; drift: of its clock
    against the computer's, ppm; lead_in: from the recording's beginning to the test's, s.
    """

    test: str
    faults: tuple[float, float, float]
    rate: float
    bits: int
    with_command: bool
    lead_in_s: float
    phase: float
    drift_ppm: float
    seed: int


def recorded_columns(case: DaqCase) -> dict[str, NDArray[np.float64]]:
    """Columns that the acquisition writes: SI, times in s."""
    test, actuator = bundled_tests()[case.test], default_actuator()
    rng = np.random.default_rng(case.seed)
    mode = CommandMode.POSITION if test.closed_loop else CommandMode.CURRENT
    rest = round((SETTLING_S + case.lead_in_s) * test.rate)
    after = round(AFTER_S * test.rate)
    command = np.concatenate([np.zeros(rest), bus_command(test), np.zeros(after)])
    plant = PlantDynamics(_sampled_often(actuator), Faults(*case.faults))
    # Half a step at most: a larger offset of the computer moves the rest, and nothing else.
    own = Sensors(offsets_lsb=tuple(rng.uniform(-0.5, 0.5, len(CHANNELS)).tolist()))
    computer = SimulatedConverters(
        actuator, own, UnmodelledEffects(), int(rng.integers(1 << 31)), channels=CHANNELS
    )
    controller = PositionController(actuator.controller)
    parts = round(PLANT_RATE / test.rate)
    seen = np.empty((len(CHANNELS), len(command) * parts))
    measured = 0.0
    for tick, asked in enumerate(command.tolist()):
        current = controller.current(asked, mode, measured)
        for part in range(parts):
            plant.advance(current)
            seen[:, tick * parts + part] = (
                current, plant.spool, plant.pressure, plant.position
            )  # fmt: skip
        codes = computer.digitise((current, plant.spool, plant.pressure, plant.position))
        measured = float(CHANNELS.position.decode(codes[3:])[0])
    return _acquired(case, seen, np.repeat(command, parts), mode, rng)


def _sampled_often(actuator: Actuator) -> Actuator:
    """Actuator whose plant advances by one sample of `PLANT_RATE` at a time."""
    controller = msgspec.structs.replace(actuator.controller, rate=PLANT_RATE)
    return msgspec.structs.replace(actuator, controller=controller)


def _acquired(
    case: DaqCase,
    seen: NDArray[np.float64],
    command: NDArray[np.float64],
    mode: CommandMode,
    rng: np.random.Generator,
) -> dict[str, NDArray[np.float64]]:
    """What the acquisition makes of the plant's samples, each of the end of its span."""
    step = (1.0 + case.drift_ppm * 1e-6) / case.rate
    begin = SETTLING_S + case.phase / case.rate
    last = (seen.shape[1] - 1) / PLANT_RATE
    instants = begin + step * np.arange(int((last - begin) / step))
    # A current is held from the beginning of its span on.
    held = np.floor(instants * PLANT_RATE + 1e-6).astype(np.int64)
    ends = (np.arange(seen.shape[1]) + 1.0) / PLANT_RATE
    columns = {"time": np.arange(len(instants)) / case.rate}
    for index, channel in enumerate(_channels(case.bits)):
        value = seen[0][held] if index == 0 else Akima1DInterpolator(ends, seen[index])(instants)
        offset = rng.uniform(-OFFSET_SHARE, OFFSET_SHARE) * channel.full_scale
        noise = NOISE_STEPS[case.bits] * channel.lsb * rng.standard_normal(len(value))
        columns[channel.name] = channel.decode(channel.encode(value + offset + noise))
    for name, value in (
        ("supply_pressure", 20.7e6), ("return_pressure", 0.7e6), ("oil_temperature", 40.0)
    ):  # fmt: skip
        columns[name] = np.full(len(instants), value)
    if case.with_command:
        columns[f"{mode.name.lower()}_command"] = command[held]
    return columns


def _channels(bits: int) -> Channels:
    return Channels(
        *(
            replace(item, full_scale=RANGE_SHARE * item.full_scale, levels=float(1 << bits))
            for item in CHANNELS
        )
    )


def perform(case: DaqCase) -> Record:
    """Record, read, diagnose: verdict, estimates, why."""
    try:
        return outcome(diagnose([read_columns(recorded_columns(case))], default_actuator(), TESTS))
    except EhadiagError as error:
        return outcome(error)


def _cases(options: Options) -> list[DaqCase]:
    """Each kind of recording in turn, with severities, phase and clock of its own."""
    kinds = [
        (test, rate, bits, with_command)
        for test in ("closed", "open")
        for rate in RATES
        for bits in NOISE_STEPS
        for with_command in (False, True)
    ]
    out = []
    for number in range(options.cases):
        test, rate, bits, with_command = kinds[number % len(kinds)]
        rng = np.random.default_rng([options.seed, number])
        a, b, c = rng.uniform(0.0, 0.9, 3).round(3).tolist()
        lead_in, phase, drift = rng.uniform((0.0, 0.0, -100.0), (1.5, 1.0, 100.0)).round(3).tolist()
        seed = int(rng.integers(1 << 31))
        out.append(DaqCase(test, (a, b, c), rate, bits, with_command, lead_in, phase, drift, seed))
    return out


def _report(records: Sequence[Record], _options: Options) -> Iterator[str]:
    yield from accuracy_table(records, "test", "rate", "bits")
    for item in records:
        if not is_answered(item):
            command = "with" if item["with_command"] else "without"
            yield f"\n{item['test']} {item['rate']:g} Hz, {item['bits']} bit, {command} command:"
            yield f"{'; '.join(item['reasons'])}"


DAQ_RECORDINGS = Study(
    "daq-recordings",
    "Recordings by a data acquisition with its own converters: verdicts and errors.",
    _cases, perform, _report, count=64, counted="recordings, each kind in turn",
)  # fmt: skip
