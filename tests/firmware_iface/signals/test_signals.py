"""Recordings of decoded signals: columns, units, rates, held and measured, several files.

Values that reach a logger late, overtaken or seldom, placed by the test that was played. The even
clock behind a table's stamps. Tables of decoded signals as others write them: dates as time stamps,
empty columns.
"""

from __future__ import annotations

import gzip
import warnings
from pathlib import Path

import numpy as np
import pandas
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from places import LOGS

from ehadiag import ConfigurationError, InputOutputError, bundled_tests, default_actuator
from ehadiag_tools.rigs.rerecord import Disturbance, logged, played
from firmware_iface.bus_map import default_map
from firmware_iface.find_test import CandidateTests
from firmware_iface.logs import log_files
from firmware_iface.logs.log_files import Budget, holds_signals
from firmware_iface.signals import tables
from firmware_iface.signals.columns import ColumnMap, load_columns, named_columns
from firmware_iface.signals.held import (
    ArrivalClock,
    Arrivals,
    ExpectedCommand,
    placed_by_time,
    placed_in_order,
)
from firmware_iface.signals.recordings import Interpretation, read_recording, recorded_tests
from firmware_iface.signals.resample import TickClock, is_held, on_ticks
from firmware_iface.signals.tables import RecordedSignal, even_times, join_tables, read_signals

SOUGHT = CandidateTests(tuple(bundled_tests().values()), default_actuator().controller)
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
    (found,) = recorded_tests(paths, Interpretation(default_map(), columns, SOUGHT))
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
    signal = RecordedSignal(time, np.sin(2 * np.pi * 25.0 * time))
    clock = TickClock.even(0.05, 1e-3, 900)
    assert not is_held(signal, 1e-3)
    got, rule = on_ticks(signal, clock, 1e-3, hold=False)
    assert np.abs(got - np.sin(2 * np.pi * 25.0 * clock.begin[1:]))[np.isfinite(got)].max() < most
    assert ("mean" in rule) == (rate >= 8000.0)


def test_a_slow_signal_leaves_holes():
    time = np.arange(500) / 500.0
    got, rule = on_ticks(
        RecordedSignal(time, time), TickClock.even(0.0, 1e-3, 990), 1e-3, hold=False
    )
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


TESTS = bundled_tests()
CONTROLLER = default_actuator().controller
NOISE = 3e-6
LEAD = 200


def late(count: int, jitter: float, drift: float, rng: np.random.Generator):
    """Arrivals of frames that keep their order, on a clock that drifts."""
    true = np.arange(count) + np.abs(rng.normal(0.0, jitter, count))
    return np.maximum.accumulate(true) * (1.0 + drift)


def open_loop(jitter: float, drift: float, seed: int, keep: float):
    """What is seen of an open loop test, the ticks that it is of, and what is expected."""
    rng = np.random.default_rng(seed)
    command = np.concatenate([np.zeros(LEAD), TESTS["open"].command()])
    told = np.concatenate([np.full(LEAD, np.nan), TESTS["open"].command()])
    at = late(len(command), jitter, drift, rng)
    # What comes at the same instant as the next one is overtaken before the logger looks.
    seen = np.append(np.diff(at) > 1e-9, [True]) & (rng.random(len(at)) < keep)
    tick = np.flatnonzero(seen)
    current = command[tick] + rng.normal(0.0, NOISE, len(tick))
    events = Arrivals(at[tick], current, np.full(len(tick), np.nan), 0.1)
    return events, tick, ExpectedCommand(told, np.zeros(len(told), dtype=np.bool_), CONTROLLER)


@pytest.mark.parametrize("jitter", [0.0, 0.2, 0.5, 1.0])
def test_the_current_tells_the_tick_where_it_moves(jitter):
    events, tick, expected = open_loop(jitter, 50e-6, 1, 0.95)
    placed = placed_in_order(events, expected, NOISE)
    moving = expected.shows(tick, NOISE)
    assert moving.sum() > 1000
    assert np.mean(placed.tick[moving] == tick[moving]) > 0.995
    assert np.all(np.diff(placed.tick) >= 1)


@settings(max_examples=3, deadline=None)
@given(st.floats(0.0, 1.0), st.floats(-100e-6, 100e-6), st.integers(0, 10_000), st.floats(0.7, 1.0))
def test_placed_ticks_rise_and_are_near(jitter, drift, seed, keep):
    events, tick, expected = open_loop(jitter, drift, seed, keep)
    placed = placed_in_order(events, expected, NOISE)
    assert np.all(np.diff(placed.tick) >= 1)
    assert np.median(np.abs(placed.tick - tick)) <= 1
    assert np.all(placed.late >= 0.0)


def test_in_closed_loop_the_position_before_tells_the_current():
    rng = np.random.default_rng(3)
    command = TESTS["closed"].command()
    position = command + rng.normal(0.0, 20e-6, len(command))
    before = np.concatenate([[0.0], position[:-1]])
    current = np.clip(CONTROLLER.GAP * (command - before), -CONTROLLER.IM, CONTROLLER.IM)
    at = late(len(command), 0.5, 0.0, rng)
    seen = np.flatnonzero(np.append(np.diff(at) > 1e-9, [True]))
    events = Arrivals(at[seen], current[seen], position[seen], 0.1)
    expected = ExpectedCommand(command, np.ones(len(command), dtype=np.bool_), CONTROLLER)
    placed = placed_in_order(events, expected, NOISE)
    assert np.mean(placed.tick == seen) > 0.97


def test_what_tells_nothing_goes_by_the_time_on_the_same_clock():
    true = np.arange(500)
    clock = ArrivalClock(100e-6, 0.4)
    at = (true + 0.4) / (1.0 - 100e-6)
    placed = placed_by_time(at, clock, 0.2)
    assert np.array_equal(placed.tick, true)
    assert np.all(placed.late < 0.01)


def test_an_integral_in_the_control_law_tells_nothing():
    law = type(CONTROLLER)(IM=0.01, GAP=1.7, GAI=1.0)
    expected = ExpectedCommand(np.zeros(3), np.ones(3, dtype=np.bool_), law)
    assert np.isnan(expected.current(np.arange(3), np.zeros(3))).all()


EVEN = 5.0 + np.arange(4000) * 0.5e-3 * (1.0 + 80e-6)


@pytest.mark.parametrize("jitter", [0.2e-3, 1e-3])
def test_late_stamps_of_even_rows_become_even(jitter):
    rng = np.random.default_rng(1)
    found, scatter = even_times(EVEN + np.abs(rng.normal(0.0, jitter, len(EVEN))))
    away = found - EVEN
    assert np.ptp(away) < 0.15 * jitter
    assert scatter == pytest.approx(0.6 * jitter, rel=0.1)


def test_batches_become_even():
    found, scatter = even_times(np.repeat(EVEN[19::20], 20))
    assert scatter > 2e-3
    assert np.ptp(np.diff(found)) < 1e-9
    assert np.ptp(found - EVEN) < 1e-3


@pytest.mark.parametrize("kind", ["even", "gap", "lost", "short", "nan"])
def test_other_stamps_stay(kind):
    rng = np.random.default_rng(2)
    time = {
        "even": EVEN,
        "gap": np.concatenate([EVEN[:2000], EVEN[2100:]]) + rng.normal(0.0, 1e-4, 3900),
        "lost": EVEN[rng.random(4000) < 0.9],
        "short": EVEN[:500] + rng.normal(0.0, 1e-4, 500),
        "nan": np.append(EVEN, np.nan),
    }[kind]
    found, scatter = even_times(time)
    assert found is time
    assert scatter == 0.0


def test_a_table_with_jittering_stamps_reads_as_one_without(tmp_path):
    source = read_recording(LOGS / "paper-open-2.blf")
    this = played(source.samples, bundled_tests()["open"].command(), 0.4)
    columns = logged(this, Disturbance(drift_ppm=100.0), 2000.0, 1_000_000, 1)
    rng = np.random.default_rng(3)
    columns["time"] = columns["time"] + np.abs(rng.normal(0.0, 1e-3, len(columns["time"])))
    path = tmp_path / "daq.csv"
    pandas.DataFrame(columns).to_csv(path, index=False, float_format="%.9g")
    candidates = CandidateTests(tuple(bundled_tests().values()), default_actuator().controller)
    (found,) = recorded_tests([path], Interpretation(default_map(), None, candidates))
    assert any("time stamps jitter by 0.6 ms" in note for note in found.quality.notes)
    known = np.isfinite(found.samples.spool)
    assert known.mean() > 0.97
    away = np.abs(found.samples.spool - source.samples.spool)[known]
    assert (away > 1e-9).sum() <= 5


ROWS = 40
STEPS_NS = np.arange(ROWS) * 1_000_000
BEGIN = np.datetime64("2026-03-01T12:00:00", "ns")


def frame_of(time: object, **more: object) -> pandas.DataFrame:
    names = ("current", "spool", "pressure", "position")
    return pandas.DataFrame({"time": time} | {name: np.arange(ROWS) * 1.0 for name in names} | more)


def recording_of(path: Path) -> dict[str, RecordedSignal]:
    return read_signals(path, ColumnMap(), Budget())


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
@pytest.mark.parametrize("zone", [None, "UTC", "Europe/Berlin"])
def test_dates_of_every_resolution_and_zone(unit: str, zone: str | None, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    dates = pandas.Series((BEGIN + STEPS_NS).astype(f"datetime64[{unit}]"))
    if zone is not None:
        dates = dates.dt.tz_localize("UTC").dt.tz_convert(zone)
    path = tmp_path / "daq.parquet"
    frame_of(dates).to_parquet(path)
    time = recording_of(path)["channels.spool"].time
    assert np.allclose(np.diff(time), 1e-3, rtol=0, atol=1e-6)
    assert time[0] == BEGIN.astype(np.int64) / 1e9


def test_whole_seconds_and_gaps(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    dates = pandas.Series(BEGIN.astype("datetime64[s]") + np.arange(ROWS))
    dates[3] = pandas.NaT
    path = tmp_path / "daq.parquet"
    frame_of(dates).to_parquet(path)
    time = recording_of(path)["channels.spool"].time
    assert len(time) == ROWS - 1
    assert time[-1] - time[0] == ROWS - 1


def test_spans_of_time(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    path = tmp_path / "daq.parquet"
    frame_of(pandas.Series(STEPS_NS.astype("timedelta64[us]") // 1000)).to_parquet(path)
    assert np.allclose(recording_of(path)["channels.spool"].time, STEPS_NS * 1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("form", "shift"),
    [("{0}", 0.0), ("{0}Z", 0.0), ("{0}+02:00", 7200.0), ("{1}", 0.0), ('"{2}"', 0.0)],
)
def test_iso_texts(form: str, shift: float, tmp_path: Path) -> None:
    texts = [str(item) for item in (BEGIN + STEPS_NS).astype("datetime64[us]")]
    written = [form.format(item, item.replace("T", " "), item.replace(".", ",")) for item in texts]
    head = "time,current,spool,pressure,position"
    path = tmp_path / "daq.csv"
    path.write_text(
        "\n".join([head, *(f"{item},{n},{n},{n},{n}" for n, item in enumerate(written))])
    )
    time = recording_of(path)["channels.spool"].time
    assert np.allclose(np.diff(time), 1e-3, rtol=0, atol=1e-6)
    assert time[0] == pytest.approx(BEGIN.astype(np.int64) / 1e9 - shift, abs=1e-6)


def test_other_texts_are_refused_by_the_name_of_the_column(tmp_path: Path) -> None:
    path = tmp_path / "daq.csv"
    frame_of([f"1st of March, {n}" for n in range(ROWS)]).to_csv(path, index=False)
    with pytest.raises(InputOutputError, match=r"in column 'time' \(1st of March, 0, …\): need"):
        recording_of(path)


def test_columns_without_a_number(tmp_path: Path) -> None:
    path = tmp_path / "daq.csv"
    frame_of(STEPS_NS * 1e-9, supply_pressure=np.nan, oil_temperature=40.0).to_csv(
        path, index=False
    )
    found = recording_of(path)
    assert "environment.supply_pressure" not in found
    assert len(found["environment.oil_temperature"].time) == ROWS
    assert join_tables([found, found]).keys() == found.keys()
    frame_of(STEPS_NS * 1e-9, spool=np.nan).to_csv(path, index=False)
    with pytest.raises(InputOutputError, match=r"channels.spool has 0 numbers"):
        recording_of(path)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_table_too_long_to_hold_is_refused(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pyarrow")
    path = tmp_path / f"daq{suffix}"
    whole = frame_of(STEPS_NS * 1e-9, remark=["x"] * ROWS)
    whole.to_csv(path, index=False) if suffix == ".csv" else whole.to_parquet(path)
    monkeypatch.setattr(tables, "MAX_TABLE_ROWS", ROWS)
    assert len(recording_of(path)["channels.spool"].time) == ROWS
    monkeypatch.setattr(tables, "MAX_TABLE_ROWS", ROWS - 1)
    with pytest.raises(InputOutputError, match=r"more than 39 rows, .* cut it about"):
        recording_of(path)


def test_a_parquet_file_of_many_columns_is_refused_unread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pyarrow")
    path = tmp_path / "daq.parquet"
    frame_of(STEPS_NS * 1e-9).to_parquet(path)
    monkeypatch.setattr(tables, "MAX_TABLE_CELLS", ROWS)
    monkeypatch.setattr(pandas, "read_parquet", None)
    with pytest.raises(InputOutputError, match="40 values"):
        recording_of(path)


def test_no_more_of_a_packed_table_is_unpacked_than_tells_its_kind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "daq.csv.gz"
    path.write_bytes(gzip.compress(b"time,spool\n" + b"0,0\n" * 1_000_000))
    monkeypatch.setattr(log_files, "unpacked_log", None)
    assert log_files.holds_signals(path, mapped=False)
    torn = tmp_path / "torn.csv.gz"
    torn.write_bytes(path.read_bytes()[:200])
    assert log_files.holds_signals(torn, mapped=False)


def test_rows_longer_than_the_header_are_no_warning(tmp_path: Path) -> None:
    path = tmp_path / "daq.csv"
    rows = "".join(f"{k / 1000},1,2,3,4,spare\n" for k in range(ROWS))
    path.write_text("time,current,spool,pressure,position\n" + rows)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert recording_of(path)["channels.current"].value.tolist() == [1.0] * ROWS
