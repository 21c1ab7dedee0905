"""Diagnoses the reference recordings on foreign buses beside the default one: verdicts, errors.

tools/foreign_buses tests/data/logs
tools/foreign_buses --bus psi29 --jitter 0 1 --lead-in 0 10 -- tests/data/logs
tools/foreign_buses --calibrated FOLDER UNITS      (FOLDER holds A.toml … of `ehadiag calibrate`)
"""

from __future__ import annotations

import argparse
import csv
import itertools
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ehadiag.assess.diagnosis import diagnose
from ehadiag.assess.verdict import Verdict
from ehadiag.core.actuator import Actuator, default_actuator, load_actuator
from ehadiag.core.find_test import Sought
from ehadiag.core.recording import Recording
from ehadiag.core.stored_test import StoredTest, bundled_tests
from ehadiag_tools.rigs.buses import BUSES, ForeignBus
from ehadiag_tools.rigs.rerecord import Disturbance, frames_on, logged, played
from firmware_iface.alignment.windows import recordings_of
from firmware_iface.logs.any_recording import Meaning, recorded_tests
from firmware_iface.logs.reader import choose, read_recording
from firmware_iface.mapping.bus_map import default_map

__all__ = ["as_sent", "main", "on_bus"]

DAQ = "daq"
"""Decoded signals."""
NAMES = ("Kintas", "FSS", "FDJ")


@dataclass(frozen=True, slots=True)
class Line:
    """What became of one recording."""

    verdict: str
    error: float
    """Largest difference of an estimate from the truth, 1."""
    covered: tuple[bool, ...]
    """Whether the 95 % interval of each severity holds the truth; empty without estimates."""
    why: str


@dataclass(frozen=True, slots=True)
class Truth:
    """What is known of a recording.

    Attributes
    ----------
    severities : tuple[float, float, float]
        In the order of `NAMES`.
    actuator : Actuator
        The unit that it is of.
    """

    severities: tuple[float, float, float]
    actuator: Actuator


def on_bus(
    bus: ForeignBus,
    recording: Recording,
    test: StoredTest,
    how: Disturbance,
    actuator: Actuator,
    seed: int,
) -> Recording:
    """Play a recording on a bus, and read it there as a log of that bus is read."""
    if recording.samples is None:
        raise ValueError(f"{recording.source}: nothing to play")
    this = played(recording.samples, as_sent(test), how.lead_in_s)
    table, bus_map = frames_on(bus, recording, this, how, seed)
    sought = Sought(tuple(bundled_tests().values()), actuator.controller)
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

    if recording.samples is None:
        raise ValueError(f"{recording.source}: nothing to play")
    this = played(recording.samples, as_sent(test), how.lead_in_s)
    columns = logged(this, how, rate, recording.samples.period_ns, seed)
    known = recording.environment
    for name in ("supply_pressure", "return_pressure", "oil_temperature"):
        columns[name] = np.full(len(columns["time"]), getattr(known, name))
    sought = Sought(tuple(bundled_tests().values()), actuator.controller)
    with tempfile.TemporaryDirectory(prefix="ehadiag-") as folder:
        path = Path(folder) / f"{Path(recording.source).stem}.csv"
        pandas.DataFrame(columns).to_csv(path, index=False, float_format="%.9g")
        return choose(recorded_tests([path], Meaning(default_map(), None, sought)))


def as_sent(test: StoredTest) -> NDArray[np.float64]:
    """Command of a test as the default bus's frames carry it, A or m."""
    step = 2e-6 if test.closed_loop else 0.5e-6
    return np.asarray(np.round(test.command() / step) * step)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="reference recordings and their truth.csv")
    parser.add_argument("--bus", nargs="*", choices=[*(item.name for item in BUSES), DAQ])
    parser.add_argument("--jitter", nargs="*", type=float, default=[0.0, 0.2, 0.5, 1.0])
    parser.add_argument("--lead-in", nargs="*", type=float, default=[1.7])
    parser.add_argument("--drift", type=float, default=100.0, help="ppm")
    parser.add_argument("--batch", type=float, default=0.0, help="ms")
    parser.add_argument("--lost", type=float, default=0.0, help="share of the frames")
    parser.add_argument("--unordered", action="store_true", help="log sorted by its stamps")
    parser.add_argument("--rate", type=float, default=2000.0, help="of the decoded signals, Hz")
    parser.add_argument("--calibrated", type=Path, help="folder of the units' actuator files")
    parser.add_argument("--only", nargs="*", help="recordings by name")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("-v", "--verbose", action="store_true", help="a line a recording")
    given = parser.parse_args(arguments)
    tests = bundled_tests()
    truth = _truth(given.folder, given.calibrated)
    names = [name for name in truth if not given.only or Path(name).stem in given.only]
    read = {name: read_recording(given.folder / name) for name in names}
    usual = {name: _line(item, tests, truth[name]) for name, item in read.items()}
    _show("default", "", usual, usual)
    buses: list[ForeignBus | None] = [*BUSES, None]
    chosen = [bus for bus in buses if not given.bus or _name(bus) in given.bus]
    for bus, jitter, lead in itertools.product(chosen, given.jitter, given.lead_in):
        how = Disturbance(
            jitter, lead, given.drift, given.batch, given.lost, kept=not given.unordered
        )
        lines = {}
        begin = time.perf_counter()
        for name in names:
            actuator = truth[name].actuator
            test = next(item for item in tests.values() if item.id == read[name].test_id)
            if bus is None:
                got = on_daq(read[name], test, how, actuator, given.seed, given.rate)
            else:
                got = on_bus(bus, read[name], test, how, actuator, given.seed)
            lines[name] = _line(got, tests, truth[name])
            if given.verbose:
                line = lines[name]
                print(f"    {name:<24}{line.verdict:<12}{100 * line.error:8.2f} %  {line.why}")
                for note in got.quality.notes:
                    print(f"        {note}")
        spent = time.perf_counter() - begin
        _show(_name(bus), f"{jitter:g} ms, {lead:g} s", lines, usual)
        if given.verbose:
            print(f"    {spent:.1f} s")
    return 0


def _name(bus: ForeignBus | None) -> str:
    return DAQ if bus is None else bus.name


def _truth(folder: Path, calibrated: Path | None) -> dict[str, Truth]:
    """What is known of each recording; without those of units that are not calibrated."""
    with (folder / "truth.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    out = {}
    for row in rows:
        path = calibrated / f"{row['unit']}.toml" if calibrated is not None else None
        if path is None or path.is_file():
            actuator = load_actuator(path) if path is not None else default_actuator()
            severities = (float(row["Kintas"]), float(row["FSS"]), float(row["FDJ"]))
            out[row["file"]] = Truth(severities, actuator)
    return out


def _line(recording: Recording, tests: dict[str, StoredTest], truth: Truth) -> Line:
    result = diagnose([recording], truth.actuator, tests.values())
    why = "; ".join(result.reasons)
    if result.identification is None:
        return Line(result.verdict.name, float("nan"), (), why)
    found = {item.name: item for item in result.identification.estimates}
    pairs = [(found[name], value) for name, value in zip(NAMES, truth.severities, strict=True)]
    return Line(
        result.verdict.name,
        max(abs(item.value - value) for item, value in pairs),
        tuple(item.interval95[0] <= value <= item.interval95[1] for item, value in pairs),
        why,
    )


def _show(bus: str, how: str, lines: dict[str, Line], usual: dict[str, Line]) -> None:
    """One line: verdicts that agree with the default bus, mean and greatest error, coverage.

    Errors and coverage are of the recordings that got a verdict.
    """
    same = sum(line.verdict == usual[name].verdict for name, line in lines.items())
    told = [line for line in lines.values() if line.verdict != Verdict.NOT_TESTED.name]
    errors = np.array([line.error for line in told])
    mean, most = (100 * errors.mean(), 100 * errors.max()) if told else (np.nan, np.nan)
    covered = [item for line in told for item in line.covered]
    wrong = sum(line.verdict != usual[name].verdict for name, line in lines.items() if line in told)
    print(
        f"{bus:<10}{how:<16}{same:>3} of {len(lines)} verdicts, {wrong} wrong,"
        f"{mean:>8.2f} %{most:>8.2f} %{sum(covered):>5} of {len(covered)} covered",
        flush=True,
    )
