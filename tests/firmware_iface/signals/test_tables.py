"""Tables of decoded signals as others write them: dates as time stamps, empty columns."""

from __future__ import annotations

import gzip
import warnings
from pathlib import Path

import numpy as np
import pandas
import pytest

from ehadiag.core.errors import InputOutputError
from firmware_iface.logs.budget import Budget
from firmware_iface.signals import tables
from firmware_iface.signals.columns import ColumnMap
from firmware_iface.signals.tables import Signal, joined, read_signals

ROWS = 40
STEPS_NS = np.arange(ROWS) * 1_000_000
BEGIN = np.datetime64("2026-03-01T12:00:00", "ns")


def table(time: object, **more: object) -> pandas.DataFrame:
    names = ("current", "spool", "pressure", "position")
    return pandas.DataFrame({"time": time} | {name: np.arange(ROWS) * 1.0 for name in names} | more)


def read(path: Path) -> dict[str, Signal]:
    return read_signals(path, ColumnMap(), Budget())


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
@pytest.mark.parametrize("zone", [None, "UTC", "Europe/Berlin"])
def test_dates_of_every_resolution_and_zone(unit: str, zone: str | None, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    dates = pandas.Series((BEGIN + STEPS_NS).astype(f"datetime64[{unit}]"))
    if zone is not None:
        dates = dates.dt.tz_localize("UTC").dt.tz_convert(zone)
    path = tmp_path / "daq.parquet"
    table(dates).to_parquet(path)
    time = read(path)["channels.spool"].time
    assert np.allclose(np.diff(time), 1e-3, rtol=0, atol=1e-6)
    assert time[0] == BEGIN.astype(np.int64) / 1e9


def test_whole_seconds_and_gaps(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    dates = pandas.Series(BEGIN.astype("datetime64[s]") + np.arange(ROWS))
    dates[3] = pandas.NaT
    path = tmp_path / "daq.parquet"
    table(dates).to_parquet(path)
    time = read(path)["channels.spool"].time
    assert len(time) == ROWS - 1
    assert time[-1] - time[0] == ROWS - 1


def test_spans_of_time(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    path = tmp_path / "daq.parquet"
    table(pandas.Series(STEPS_NS.astype("timedelta64[us]") // 1000)).to_parquet(path)
    assert np.allclose(read(path)["channels.spool"].time, STEPS_NS * 1e-9, atol=1e-12)


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
    time = read(path)["channels.spool"].time
    assert np.allclose(np.diff(time), 1e-3, rtol=0, atol=1e-6)
    assert time[0] == pytest.approx(BEGIN.astype(np.int64) / 1e9 - shift, abs=1e-6)


def test_other_texts_are_refused_by_the_name_of_the_column(tmp_path: Path) -> None:
    path = tmp_path / "daq.csv"
    table([f"1st of March, {n}" for n in range(ROWS)]).to_csv(path, index=False)
    with pytest.raises(InputOutputError, match=r"in column 'time' \(1st of March, 0, …\): need"):
        read(path)


def test_columns_without_a_number(tmp_path: Path) -> None:
    path = tmp_path / "daq.csv"
    table(STEPS_NS * 1e-9, supply_pressure=np.nan, oil_temperature=40.0).to_csv(path, index=False)
    found = read(path)
    assert "environment.supply_pressure" not in found
    assert len(found["environment.oil_temperature"].time) == ROWS
    assert joined([found, found]).keys() == found.keys()
    table(STEPS_NS * 1e-9, spool=np.nan).to_csv(path, index=False)
    with pytest.raises(InputOutputError, match=r"channels.spool has 0 numbers"):
        read(path)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_table_too_long_to_hold_is_refused(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pyarrow")
    path = tmp_path / f"daq{suffix}"
    whole = table(STEPS_NS * 1e-9, remark=["x"] * ROWS)
    whole.to_csv(path, index=False) if suffix == ".csv" else whole.to_parquet(path)
    monkeypatch.setattr(tables, "MOST_ROWS", ROWS)
    assert len(read(path)["channels.spool"].time) == ROWS
    monkeypatch.setattr(tables, "MOST_ROWS", ROWS - 1)
    with pytest.raises(InputOutputError, match=r"more than 39 rows, .* cut it about"):
        read(path)


def test_a_parquet_file_of_many_columns_is_refused_unread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pyarrow")
    path = tmp_path / "daq.parquet"
    table(STEPS_NS * 1e-9).to_parquet(path)
    monkeypatch.setattr(tables, "MOST_CELLS", ROWS)
    monkeypatch.setattr(pandas, "read_parquet", None)
    with pytest.raises(InputOutputError, match="40 values"):
        read(path)


def test_no_more_of_a_packed_table_is_unpacked_than_tells_its_kind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "daq.csv.gz"
    path.write_bytes(gzip.compress(b"time,spool\n" + b"0,0\n" * 1_000_000))
    monkeypatch.setattr(tables, "unpacked", None)
    assert tables.holds_signals(path, mapped=False)
    torn = tmp_path / "torn.csv.gz"
    torn.write_bytes(path.read_bytes()[:200])
    assert tables.holds_signals(torn, mapped=False)


def test_rows_longer_than_the_header_are_no_warning(tmp_path: Path) -> None:
    path = tmp_path / "daq.csv"
    rows = "".join(f"{k / 1000},1,2,3,4,spare\n" for k in range(ROWS))
    path.write_text("time,current,spool,pressure,position\n" + rows)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read(path)["channels.current"].value.tolist() == [1.0] * ROWS
