"""Diagnoses a recording that was played again on a foreign bus, and compares with the truth."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ehadiag.assess.diagnosis import Diagnosis, diagnose
from ehadiag.core.actuator import Actuator, default_actuator, load_actuator
from ehadiag.core.errors import EhadiagError
from ehadiag.core.find_test import Sought
from ehadiag.core.recording import Recording, Samples
from ehadiag.core.stored_test import StoredTest, bundled_tests
from ehadiag.model.parameters import FAULT_NAMES
from ehadiag_tools.rigs.buses import BUSES, ForeignBus
from ehadiag_tools.rigs.rerecord import Disturbance, frames_on, logged, played
from firmware_iface.alignment.windows import recordings_of
from firmware_iface.logs.any_recording import Meaning, recorded_tests
from firmware_iface.logs.reader import choose, read_recording
from firmware_iface.mapping.bus_map import default_map

__all__ = ["DAQ", "DEFAULT", "Replay", "as_sent", "on_bus", "on_daq", "perform_replay"]

DAQ = "daq"
"""Decoded signals."""
DEFAULT = "default"
"""The recording as it is."""


@dataclass(frozen=True, slots=True)
class Replay:
    """Settings of one diagnosis; what it gives depends on nothing else but code and files.

    Attributes
    ----------
    recording : str
        Path of a recording on the default bus.
    severities : tuple[float, float, float]
        Truth, in the order of `FAULT_NAMES`.
    actuator : str
        Path of the unit's file; empty for the reference actuator.
    bus : str
        Name of one of `BUSES`, `DAQ` or `DEFAULT`.
    how : Disturbance
        Of the time stamps.
    rate : float
        Of the decoded signals, Hz.
    seed : int
        Of the delays.
    """

    recording: str
    severities: tuple[float, float, float]
    actuator: str
    bus: str
    how: Disturbance
    rate: float
    seed: int


def perform_replay(run: Replay) -> dict[str, Any]:
    """Play, read, diagnose: verdict, largest error (fraction of 1), intervals that hold, why."""
    actuator, recording = _actuator(run.actuator), read_recording(Path(run.recording))
    try:
        return _compared(diagnose([_played(run, recording, actuator)], actuator, _tests()), run)
    except EhadiagError as error:
        return {"verdict": "error", "error": None, "covered": [], "why": str(error), "notes": []}


def _compared(result: Diagnosis, run: Replay) -> dict[str, Any]:
    out: dict[str, Any] = {
        "verdict": result.verdict.name,
        "error": None,
        "covered": [],
        "why": "; ".join(result.reasons),
        "notes": [note for item in result.recordings for note in item.quality.notes],
    }
    if result.identification is not None:
        found = {item.name: item for item in result.identification.estimates}
        pairs = [
            (found[name], value) for name, value in zip(FAULT_NAMES, run.severities, strict=True)
        ]
        out["error"] = max(abs(item.value - value) for item, value in pairs)
        out["covered"] = [
            bool(item.interval95[0] <= value <= item.interval95[1]) for item, value in pairs
        ]
        out["found"] = [[item.value, item.std] for item, _ in pairs]
    return out


def _played(run: Replay, recording: Recording, actuator: Actuator) -> Recording:
    if run.bus == DEFAULT:
        return recording
    test = next(item for item in _tests() if item.id == recording.test_id)
    if run.bus == DAQ:
        return on_daq(recording, test, run.how, actuator, run.seed, run.rate)
    bus = next(item for item in BUSES if item.name == run.bus)
    return on_bus(bus, recording, test, run.how, actuator, run.seed)


@cache
def _tests() -> tuple[StoredTest, ...]:
    return tuple(bundled_tests().values())


@cache
def _actuator(path: str) -> Actuator:
    return load_actuator(Path(path)) if path else default_actuator()


def on_bus(
    bus: ForeignBus,
    recording: Recording,
    test: StoredTest,
    how: Disturbance,
    actuator: Actuator,
    seed: int,
) -> Recording:
    """Play a recording on a bus, and read it there as a log of that bus is read."""
    this = played(_samples_of(recording), as_sent(test), how.lead_in_s)
    table, bus_map = frames_on(bus, recording, this, how, seed)
    sought = Sought(_tests(), actuator.controller)
    name = f"{Path(recording.source).stem} on {bus.name}"
    return choose(recordings_of([table], bus_map, name, len(table) + 1, sought=sought))


def on_daq(
    recording: Recording,
    test: StoredTest,
    how: Disturbance,
    actuator: Actuator,
    seed: int,
    rate: float,
) -> Recording:
    """Write a recording as a decoded CSV at a rate (Hz), and read it as `diagnose` does."""
    import pandas  # noqa: PLC0415 - optional, and slow

    samples = _samples_of(recording)
    this = played(samples, as_sent(test), how.lead_in_s)
    columns = logged(this, how, rate, samples.period_ns, seed)
    known = recording.environment
    for name in ("supply_pressure", "return_pressure", "oil_temperature"):
        columns[name] = np.full(len(columns["time"]), getattr(known, name))
    sought = Sought(_tests(), actuator.controller)
    with tempfile.TemporaryDirectory(prefix="ehadiag-") as folder:
        path = Path(folder) / f"{Path(recording.source).stem}.csv"
        pandas.DataFrame(columns).to_csv(path, index=False, float_format="%.9g")
        return choose(recorded_tests([path], Meaning(default_map(), None, sought)))


def _samples_of(recording: Recording) -> Samples:
    if recording.samples is None:
        raise ValueError(f"{recording.source}: nothing to play")
    return recording.samples


def as_sent(test: StoredTest) -> NDArray[np.float64]:
    """Command of a test as the default bus's frames carry it, A or m."""
    step = 2e-6 if test.closed_loop else 0.5e-6
    return np.asarray(np.round(test.command() / step) * step)
