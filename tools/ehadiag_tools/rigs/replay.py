"""Studies of recordings played again on foreign buses, and taken by a data acquisition.

The acquisition has converters and a clock of its own. The plant is sampled at 50 kHz, and read
between two samples by a local cubic. The control computer reads it once a tick through its own
converters and acts on what these say; the acquisition never sees their codes.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray
from scipy.interpolate import Akima1DInterpolator

from ehadiag.assess.diagnosis import diagnose
from ehadiag.core.actuator import Actuator, default_actuator, load_actuator
from ehadiag_sim.conditions import Faults, Sensors, UnmodelledEffects
from ehadiag_sim.plant_dynamics import PlantDynamics
from ehadiag_sim.plant_laws import PositionController
from ehadiag_sim.sensing import SimulatedConverters
from ehadiag_sim.simulation import bus_command
from ehadiag_tools.accuracy.figures import accuracy_table, is_answered, outcome
from ehadiag_tools.rigs.rerecord import (
    BUSES,
    TESTS,
    Disturbance,
    frames_on,
    logged,
    played,
    read_columns,
)
from ehadiag_tools.simulator.units import read_truth
from ehadiag_tools.study import Options, Record, Study, grouped
from firmware_iface.alignment.align import windowed_recordings
from firmware_iface.errors import EhadiagError
from firmware_iface.find_test import CandidateTests
from firmware_iface.recording import CHANNELS, CommandMode, Recording
from firmware_iface.signals.recordings import choose_recording, read_recording
from firmware_iface.stored_test import StoredTest, bundled_tests

DAQ = "daq"
"""Name of the decoded signals."""
DEFAULT = "default"
"""Name of the recording as it is."""
NAMES = (*BUSES, DAQ)
CLOCK_DRIFT_PPM = 100.0
"""Error of the host's clock, ppm: that of a usual crystal."""


@dataclass(frozen=True, slots=True)
class BusReplay:
    """One diagnosis of a recording on the default bus, played on another, with its true severities.

    Actuator: path of a file, empty for the reference one. Rate: of the decoded signals, Hz.
    """

    recording: str
    faults: tuple[float, ...]
    actuator: str
    bus: str
    how: Disturbance
    rate: float
    seed: int


def perform(case: BusReplay) -> Record:
    """Play, read, diagnose: verdict, estimates, why."""
    actuator, recording = _actuator(case.actuator), read_recording(Path(case.recording))
    return _judged(lambda: _played(case, recording, actuator), actuator)


def _judged(read: Callable[[], Recording], actuator: Actuator) -> Record:
    try:
        return outcome(diagnose([read()], actuator, TESTS))
    except EhadiagError as error:
        return outcome(error)


def _played(case: BusReplay, recording: Recording, actuator: Actuator) -> Recording:
    """Play a recording as the case has it, and read it there as `diagnose` does."""
    if case.bus == DEFAULT:
        return recording
    if recording.samples is None:
        raise ValueError(f"{recording.source}: nothing to play")
    test = next(item for item in TESTS if item.id == recording.test_id)
    this, name = played(recording.samples, as_sent(test), case.how.lead_in_s), case.recording
    if case.bus == DAQ:
        columns = logged(this, case.how, case.rate, recording.samples.period_ns, case.seed)
        for probe in ("supply_pressure", "return_pressure", "oil_temperature"):
            value = getattr(recording.environment, probe)
            columns[probe] = np.full(len(columns["time"]), value)
        return read_columns(columns, actuator, Path(name).stem)
    table, bus_map = frames_on(BUSES[case.bus], recording, this, case.how, case.seed)
    candidates = CandidateTests(TESTS, actuator.controller)
    return choose_recording(
        windowed_recordings([table], bus_map, name, len(table) + 1, candidates=candidates)
    )


@cache
def _actuator(path: str) -> Actuator:
    return load_actuator(Path(path)) if path else default_actuator()


def as_sent(test: StoredTest) -> NDArray[np.float64]:
    """Command of a test as the default bus's frames carry it, A or m."""
    step = 2e-6 if test.closed_loop else 0.5e-6
    return np.asarray(np.round(test.command() / step) * step)


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("folder", type=Path, nargs="+", help="recordings on the default bus, and truth.csv with"
        " the columns file, Kintas, FSS, FDJ, and unit for units that are calibrated")  # fmt: skip
    add("--calibrated", type=Path, metavar="FOLDER", help="of actuator files X.toml of the units,"
        " made by `ehadiag calibrate`; recordings X-new-… are left out")  # fmt: skip
    add("--only", action="append", metavar="NAME", help="one recording, by name")
    add("--bus", action="append", choices=NAMES, help="may be repeated (all)")
    add("--jitter", action="append", type=float, metavar="MS", help="half-normal (0 0.2 0.5 1)")
    add("--lead-in", type=float, metavar="S", help="instead of one drawn from 0 … 10 s for each")
    add("--rate", type=float, default=2000.0, help="of the decoded signals, Hz (%(default)g)")


def _cases(options: Options) -> list[BusReplay]:
    """Those of the default bus, then the others in any order: a part of them is a sample."""
    usual = [case for folder in options.folder for case in _usual_cases(folder, options)]
    others = [case for item in usual for case in _foreign_cases(item, options)]
    order = np.random.default_rng(options.seed).permutation(len(others)).tolist()
    return (usual + [others[place] for place in order])[: options.cases]


def _usual_cases(folder: Path, options: Options) -> Iterator[BusReplay]:
    """Recordings of a folder as they are; without those of units that are not calibrated."""
    for truth in read_truth(folder):
        path, actuator = Path(truth.path), ""
        if options.only and path.stem not in options.only:
            continue
        if truth.unit:
            unit = options.calibrated / f"{truth.unit}.toml" if options.calibrated else None
            if unit is None or not unit.is_file() or "-new-" in path.name:
                continue
            actuator = str(unit)
        yield BusReplay(
            truth.path, truth.faults, actuator, DEFAULT, Disturbance(), options.rate, options.seed
        )


def _foreign_cases(case: BusReplay, options: Options) -> Iterator[BusReplay]:
    """One recording on each bus with each jitter."""
    name = [*Path(case.recording).stem.encode()]
    jitters = options.jitter or (0.0, 0.2, 0.5, 1.0)
    for bus, jitter in itertools.product(options.bus or NAMES, jitters):
        rng = np.random.default_rng([options.seed, *name, *bus.encode(), round(1e3 * jitter)])
        drawn = round(float(rng.uniform(0.0, 10.0)), 3)
        lead_in = drawn if options.lead_in is None else options.lead_in
        how = Disturbance(jitter, lead_in, CLOCK_DRIFT_PPM)
        seed = int(rng.integers(1 << 31))
        yield BusReplay(case.recording, case.faults, case.actuator, bus, how, case.rate, seed)


def _report(records: Sequence[Record], _options: Options) -> Iterator[str]:
    """Errors and coverage of what has a verdict, and how many verdicts are the default bus's."""
    usual = {item["recording"]: item["verdict"] for item in records if item["bus"] == DEFAULT}
    order = (DEFAULT, *NAMES)
    items = [
        {**item, "jitter, ms": item["how"]["jitter_ms"]}
        for item in sorted(records, key=lambda item: order.index(item["bus"]))
    ]
    yield from accuracy_table(items, "bus", "jitter, ms")
    for (bus,), part in grouped(items, "bus").items():
        same = sum(item["verdict"] == usual[item["recording"]] for item in part)
        yield f"\n{bus}: verdicts as on the default bus {same} of {len(part)}"


FOREIGN_BUSES = Study(
    "foreign-buses",
    "Recordings played again on foreign buses: verdicts and errors beside the default bus.",
    _cases, perform, _report, _options, count=100_000,
    counted="those on the default bus, then a sample of the others",
)  # fmt: skip


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
    rate: float
    bits: int
    with_command: bool
    lead_in_s: float
    phase: float
    drift_ppm: float
    faults: tuple[float, ...]
    seed: int


def recorded_columns(case: DaqCase) -> dict[str, NDArray[np.float64]]:
    """Columns that the acquisition writes: SI, times in s."""
    test, actuator = bundled_tests()[case.test], default_actuator()
    rng = np.random.default_rng(case.seed)
    mode = test.command_mode
    rest = round((SETTLING_S + case.lead_in_s) * test.rate)
    after = round(AFTER_S * test.rate)
    command = np.concatenate([np.zeros(rest), bus_command(test), np.zeros(after)])
    # Advances by one sample at a time.
    controller = replace(actuator.controller, rate=PLANT_RATE)
    plant = PlantDynamics(replace(actuator, controller=controller), Faults(*case.faults))
    # Half a step at most: a larger offset of the computer moves the rest, and nothing else.
    own = Sensors(offsets_lsb=tuple(rng.uniform(-0.5, 0.5, len(CHANNELS)).tolist()))
    computer = SimulatedConverters(
        actuator, own, UnmodelledEffects(), int(rng.integers(1 << 31)), channels=CHANNELS
    )
    law = PositionController(actuator.controller)
    parts = round(PLANT_RATE / test.rate)
    seen, measured = [], 0.0
    for wanted in command.tolist():
        current = law.current(wanted, mode, measured)
        for _ in range(parts):
            plant.advance(current)
            seen.append(plant.seen)
        codes = computer.digitise(plant.seen)
        measured = float(CHANNELS.position.decode(codes[3:])[0])
    return _acquired(case, np.array(seen).T, np.repeat(command, parts), mode, rng)


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
    columns, levels = {"time": np.arange(len(instants)) / case.rate}, float(1 << case.bits)
    for index, channel in enumerate(CHANNELS):
        own = replace(channel, full_scale=RANGE_SHARE * channel.full_scale, levels=levels)
        value = seen[0][held] if index == 0 else Akima1DInterpolator(ends, seen[index])(instants)
        offset = rng.uniform(-OFFSET_SHARE, OFFSET_SHARE) * own.full_scale
        noise = NOISE_STEPS[case.bits] * own.lsb * rng.standard_normal(len(value))
        columns[channel.name] = own.decode(own.encode(value + offset + noise))
    for name, value in (
        ("supply_pressure", 20.7e6), ("return_pressure", 0.7e6), ("oil_temperature", 40.0)
    ):  # fmt: skip
        columns[name] = np.full(len(instants), value)
    if case.with_command:
        columns[f"{mode.name.lower()}_command"] = command[held]
    return columns


def perform_daq(case: DaqCase) -> Record:
    """Record, read, diagnose: verdict, estimates, why."""
    return _judged(lambda: read_columns(recorded_columns(case)), default_actuator())


def _daq_cases(options: Options) -> list[DaqCase]:
    """Each kind of recording in turn, with severities, phase and clock of its own."""
    kinds = list(itertools.product(("closed", "open"), RATES, NOISE_STEPS, (False, True)))
    out = []
    for number in range(options.cases):
        rng = np.random.default_rng([options.seed, number])
        faults = tuple(rng.uniform(0.0, 0.9, 3).round(3).tolist())
        lead_in, phase, drift = rng.uniform((0.0, 0.0, -100.0), (1.5, 1.0, 100.0)).round(3).tolist()
        seed = int(rng.integers(1 << 31))
        out.append(DaqCase(*kinds[number % len(kinds)], lead_in, phase, drift, faults, seed))
    return out


def _daq_report(records: Sequence[Record], _options: Options) -> Iterator[str]:
    yield from accuracy_table(records, "test", "rate", "bits")
    for item in records:
        if not is_answered(item):
            command = "with" if item["with_command"] else "without"
            yield f"\n{item['test']} {item['rate']:g} Hz, {item['bits']} bit, {command} command:"
            yield f"{'; '.join(item['reasons'])}"


DAQ_RECORDINGS = Study(
    "daq-recordings",
    "Recordings by a data acquisition with its own converters: verdicts and errors.",
    _daq_cases, perform_daq, _daq_report, count=64, counted="recordings, each kind in turn",
)  # fmt: skip
