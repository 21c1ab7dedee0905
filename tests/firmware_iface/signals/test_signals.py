"""Recordings of decoded signals: columns, units, rates, held and measured, several files."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pandas
import pytest
from places import LOGS

from ehadiag.core.actuator import default_actuator
from ehadiag.core.errors import ConfigurationError, InputOutputError
from ehadiag.core.find_test import Sought
from ehadiag.core.stored_test import bundled_tests
from ehadiag_tools.rigs.rerecord import Disturbance, logged, played
from firmware_iface.logs.any_recording import Meaning, recorded_tests
from firmware_iface.logs.reader import read_recording
from firmware_iface.mapping.bus_map import default_map
from firmware_iface.signals.columns import ColumnMap, load_columns, named_columns
from firmware_iface.signals.resample import Clock, holds, on_ticks
from firmware_iface.signals.tables import Signal, holds_signals

SOUGHT = Sought(tuple(bundled_tests().values()), default_actuator().controller)
KEYS = ("current", "spool", "pressure", "position")


@pytest.fixture(scope="module")
def source():
    return read_recording(LOGS / "paper-open-2.blf")


@pytest.fixture(scope="module")
def table(source):
    """What a logger at 2 kHz writes of the bus, its clock 100 ppm fast."""
    command = np.round(bundled_tests()["open"].command() / 0.5e-6) * 0.5e-6
    this = played(source.samples, command, 0.4)
    columns = logged(this, Disturbance(drift_ppm=100.0), 2000.0, 1_000_000, 1)
    return pandas.DataFrame(columns)


def read(*paths: Path, columns: ColumnMap | None = None):
    (found,) = recorded_tests(paths, Meaning(default_map(), columns, SOUGHT))
    return found


def assert_same(found, source, most_missing: int = 150) -> None:
    """Each row that is there is that of its tick, but for a few of the slips of the clocks."""
    assert found.test_id == 1
    for key in KEYS:
        got, true = getattr(found.samples, key), getattr(source.samples, key)
        known = np.isfinite(got)
        assert (~known).sum() <= most_missing
        wrong = np.abs(got - true)[known] > 1e-6 * np.abs(true).max()
        assert wrong.sum() <= 5, key


def test_held_values_come_back_exactly(tmp_path, table, source):
    path = tmp_path / "daq.csv"
    table.to_csv(path, index=False, float_format="%.9g")
    found = read(path)
    assert_same(found, source)
    notes = " ".join(found.quality.notes)
    assert "ticks by the changes of held signals" in notes
    assert "test 'open' found by its command" in notes


@pytest.mark.parametrize("kind", ["csv.gz", "semicolons", "units row", "parquet"])
def test_other_ways_to_write_the_same(tmp_path, table, source, kind):
    path = tmp_path / ("daq.parquet" if kind == "parquet" else "daq.csv")
    if kind == "parquet":
        pytest.importorskip("pyarrow")
        table.to_parquet(path)
    elif kind == "semicolons":
        table.to_csv(path, index=False, sep=";", decimal=",", float_format="%.9g")
    elif kind == "units row":
        scaled = table.assign(position=table.position * 1e3, pressure=table.pressure * 1e-5)
        body = scaled.to_csv(index=False, header=False, float_format="%.9g")
        units = {"time": "s", "position": "mm", "pressure": "bar"}
        heads = ",".join(table.columns)
        said = ",".join(units.get(name, {"spool": "m"}.get(name, "A")) for name in table.columns)
        path.write_text(f"{heads}\n{said}\n{body}")
    else:
        path = tmp_path / "daq.csv.gz"
        path.write_bytes(gzip.compress(table.to_csv(index=False, float_format="%.9g").encode()))
    assert_same(read(path), source)


def test_mapped_columns_and_units(tmp_path, table, source):
    other = pandas.DataFrame(
        {
            "t [ms]": table.time * 1e3,
            "Isv": table.current * 1e3,
            "LVDT (mm)": table.spool * 1e3,
            "dp": table.pressure / 6894.757293168361,
            "Stroke": -table.position * 1e3,
            "cmd": table.current_command * 1e3,
        }
    )
    path = tmp_path / "rig.csv"
    other.to_csv(path, index=False, float_format="%.10g")
    mapping = tmp_path / "rig.toml"
    mapping.write_text(
        'schema = "ehadiag.columns/1"\ntime = { column = "t" }\n[channels]\n'
        'current = { column = "Isv", unit = "mA" }\nspool = { column = "LVDT" }\n'
        'pressure = { column = "dp", unit = "psi" }\n'
        'position = { column = "Stroke", unit = "mm", scale = -1.0 }\n'
    )
    columns = named_columns(["current_command=cmd:mA"], load_columns(mapping))
    assert_same(read(path, columns=columns), source)


def test_split_files_and_a_file_for_each_bus_are_one_recording(tmp_path, table, source):
    half = len(table) // 2
    parts = (table[:half], table[half:], table[["time", "current", "current_command"]])
    paths = []
    for index, part in enumerate(
        (
            parts[0].drop(columns=["current", "current_command"]),
            parts[1].drop(columns=["current", "current_command"]),
            parts[2],
        )
    ):
        paths.append(tmp_path / f"part-{index}.csv")
        part.to_csv(paths[-1], index=False, float_format="%.9g")
    assert_same(read(*paths), source)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time,spool,pressure\n" + "1,2,3\n" * 20, "no column for channels.position"),
        ("spool,pressure,position\n" + "1,2,3\n" * 20, "no column of time stamps"),
    ],
)
def test_what_is_missing_is_named_with_what_there_is(tmp_path, text, words):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=words) as caught:
        read(path)
    if "position" in words:
        assert "the file has time, spool, pressure" in str(caught.value)


def test_a_column_of_words_is_one_line(tmp_path):
    path = tmp_path / "bad.csv"
    path.write_text("time,spool,pressure,position\n" + "1,2,3,4\n" + "1,2,3,x\n" * 20)
    with pytest.raises(
        InputOutputError, match="has 21 numbers, but only 1 different time stamps; at least 10"
    ):
        read(path)


@pytest.mark.parametrize("option", ["position", "nothing=Stroke", "position=Stroke:psi"])
def test_a_wrong_column_option_says_what_is_needed(option):
    with pytest.raises(ConfigurationError, match=r"--column|no length"):
        named_columns([option], ColumnMap())


def test_frames_and_signals_are_told_apart(tmp_path):
    frames = tmp_path / "frames.csv"
    frames.write_text("timestamp,arbitration_id,extended,remote,error,dlc,data\n")
    assert not holds_signals(frames, mapped=False)
    signals = tmp_path / "signals.csv"
    signals.write_text("time,spool\n0,1\n")
    assert holds_signals(signals, mapped=False)
    assert not holds_signals(LOGS / "paper-open-1.blf", mapped=True)


@pytest.mark.parametrize(
    ("rate", "most"), [(800.0, 6e-3), (2000.0, 1e-3), (5000.0, 2e-4), (20_000.0, 2e-4)]
)
def test_a_measured_signal_is_read_at_the_end_of_each_tick(rate, most):
    time = np.arange(int(rate)) / rate
    signal = Signal(time, np.sin(2 * np.pi * 25.0 * time))
    clock = Clock.even(0.05, 1e-3, 900)
    assert not holds(signal, 1e-3)
    got, rule = on_ticks(signal, clock, 1e-3, hold=False)
    assert np.abs(got - np.sin(2 * np.pi * 25.0 * clock.begin[1:]))[np.isfinite(got)].max() < most
    assert ("mean" in rule) == (rate >= 8000.0)


def test_a_slow_signal_leaves_holes():
    time = np.arange(500) / 500.0
    got, rule = on_ticks(Signal(time, time), Clock.even(0.0, 1e-3, 990), 1e-3, hold=False)
    assert np.isfinite(got).sum() == pytest.approx(495, abs=3)
    assert "nearest tick" in rule


@pytest.mark.parametrize(("rate", "jitter", "seen"), [(1000.0, 0.5, 0.8), (2000.0, 1.0, 0.75)])
def test_values_that_come_late_are_placed_by_the_test(tmp_path, source, rate, jitter, seen):
    command = np.round(bundled_tests()["open"].command() / 0.5e-6) * 0.5e-6
    this = played(source.samples, command, 1.3)
    how = Disturbance(jitter, drift_ppm=100.0)
    path = tmp_path / "late.csv"
    columns = logged(this, how, rate, 1_000_000, 1)
    pandas.DataFrame(columns).to_csv(path, index=False, float_format="%.9g")
    found = read(path)
    assert found.test_id == 1
    assert found.by_time
    assert "late" in " ".join(found.quality.notes)
    # The last sine moves all signals from tick to tick.
    fast = slice(4600, 5400)
    got, true = found.samples.spool[fast], source.samples.spool[fast]
    known = np.isfinite(got)
    assert known.mean() > seen
    wrong = np.abs(got - true)[known] > 1e-6 * np.abs(true).max()
    assert wrong.mean() < 0.05
