"""The history as CSV and Parquet, and diagnoses of another system."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from history_cases import an_entry

from ehadiag.cli.main import main
from ehadiag.history.records import entries_from_csv, history_csv, history_parquet
from ehadiag.history.store import History
from ehadiag.model.registry import FAULT_NAMES
from firmware_iface.errors import ConfigurationError

ENTRIES = [
    an_entry(7, 100.0 * n, (0.1 * n, 0.2, 0.3), number=n, tested=f"2026-03-0{n}T12:00:00.000Z")
    for n in (1, 2)
]


def test_what_was_exported_can_be_imported() -> None:
    found = entries_from_csv(history_csv(ENTRIES), "a.csv", FAULT_NAMES)
    for mine, other in zip(found, ENTRIES, strict=True):
        for name in ("tested", "actuator", "serial", "test", "verdict", "usage", "severities"):
            assert getattr(mine, name) == getattr(other, name)


def test_parquet_has_the_rows_of_the_csv_file() -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    rows = parquet.read_table(io.BytesIO(history_parquet(ENTRIES))).to_pylist()
    assert [row["estimate"] for row in rows] == [0.1, 0.2, 0.3, 0.2, 0.2, 0.3]
    assert rows[0]["serial"] == 7
    assert rows[0]["cycles"] is None


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("verdict", "opinion", "has no column verdict"),
        ("HEALTHY", "FINE", "line 2: verdict: there is HEALTHY"),
        ("FSS", "spool", "line 3: severity spool: there is Kintas"),
        ("2026-03-01", "yesterday ", "line 2: when yesterday "),
        (",7,", ",seven,", "line 2: serial seven: need a whole number, 0 … "),
        (",7,", ",-7,", "line 2: serial -7: need a whole number, 0 … "),
        ("0.1,", "nan,", "line 2: estimate nan: need a number, 0 … 1"),
        (",0.3,", ",5,", "line 4: estimate 5: need a number, 0 … 1"),
        (",0.0002,", ",-0.004,", "line 2: std -0.004: need a number, 1e-09 … "),
        (",0.0002,", ",0,", "line 2: std 0: need a number, 1e-09 … "),
        ("reference-31", "", "line 2: actuator: is empty"),
        ("2026-03-01", "2999-03-01", "line 2: when 2999-03-01T12:00:00.000Z: is in the future"),
        (",100.0,", ",-5,", "line 2: hours -5: need a number, 0 … "),
        ("FDJ", "FSS", "line 4: severity FSS: twice in one diagnosis"),
        (",0.1,0.0002,", "\r\n0.1,0.0002,", "line 2: estimate: the row ends before it"),
    ],
)
def test_a_table_that_is_none_is_one_line(old: str, new: str, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words) as caught:
        entries_from_csv(history_csv(ENTRIES).replace(old, new), "a.csv", FAULT_NAMES)
    assert "\n" not in str(caught.value)


def test_import_appends_all_or_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place, table = tmp_path / "h", tmp_path / "a.csv"
    assert main(["history", "init", "--history", str(place)]) == 0
    table.write_text(history_csv(ENTRIES))
    assert main(["history", "import", str(table), "--history", str(place)]) == 0
    table.write_text(history_csv(ENTRIES).replace("2026-03-02", "later"))
    assert main(["history", "import", str(table), "--history", str(place)]) == 2
    with History(place) as history:
        assert len(history.entries()) == 2
    assert "2 diagnoses of" in capsys.readouterr().out
    table.write_text(history_csv(ENTRIES).replace("2026-03-02", "2026-03-03"))
    assert main(["history", "import", str(table), "--history", str(place)]) == 0
    assert "1 diagnoses of" in (said := capsys.readouterr().out)
    assert "1 more were there already" in said
    with History(place) as history:
        assert len(history.entries()) == 3
    out = tmp_path / "b.parquet"
    assert main(["history", "export", "--out", str(out), "--history", str(place)]) == 0
    assert out.read_bytes()[:4] == b"PAR1"


@pytest.mark.parametrize(
    ("old", "new"), [("HEALTHY,Kintas,0.1", "FAULT,Kintas,0.9"), ("0.0,", "1.0,")]
)
def test_another_diagnosis_of_the_same_time_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str
) -> None:
    place, table = tmp_path / "h", tmp_path / "a.csv"
    with History(place, create=True) as history:
        history.append_all(ENTRIES[:1])
    table.write_text(history_csv(ENTRIES).replace(old, new, 1))
    assert main(["history", "import", str(table), "--history", str(place)]) == 2
    assert "has other diagnoses of 2026-03-01T12:00:00.000Z (serial 7)" in capsys.readouterr().err
    with History(place) as history:
        assert len(history.entries()) == 1


def test_rows_of_one_diagnosis_may_be_written_in_several_ways() -> None:
    first, *others = history_csv(ENTRIES[:1]).splitlines()[1:]
    other = others[0].replace(",7,", ",07,").replace(":00.000Z", ":00Z")
    table = "\n".join([history_csv([]).strip(), first, other])
    (found,) = entries_from_csv(table, "a.csv", FAULT_NAMES)
    assert [item.name for item in found.severities] == ["Kintas", "FSS"]
