"""Readers of other packages: found by an entry point, and refused in one line where faulty."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from places import LOGS

import ehadiag
from firmware_iface.errors import ConfigurationError, InputOutputError
from firmware_iface.logs import log_files
from firmware_iface.logs.log_files import holds_signals, known_suffixes
from firmware_iface.logs.reader import read_frames
from firmware_iface.signals.columns import ColumnMap
from firmware_iface.signals.recordings import read_recording
from firmware_iface.signals.tables import read_signals
from firmware_iface.transport.frames import FrameTable

GVRET = """
import csv

from firmware_iface.logs.log_files import DamagedLogError
from firmware_iface.transport.frames import ColumnBuilder


class GvretReader:
    signature = b"Time Stamp,ID,Extended,Dir,Bus,LEN,"

    def frames(self, path, spending):
        with path.open(encoding="utf-8", newline="") as file:
            rows = csv.reader(file)
            next(rows)
            columns = ColumnBuilder()
            for row in rows:
                spending.look_at_clock()
                try:
                    time_us, can_id, extended, direction, bus, length, *data = row
                    payload = bytes(int(item, 16) for item in data[: int(length)])
                    columns.add(
                        int(time_us) * 1000,
                        int(can_id, 16),
                        payload,
                        extended=extended == "true",
                        sent=direction == "Tx",
                        channel=int(bus) + 1,
                    )
                except ValueError:
                    yield columns.table()
                    raise DamagedLogError("the log is damaged") from None
                if len(columns) >= 10_000:
                    yield columns.table()
                    columns = ColumnBuilder()
        yield columns.table()
"""
HEADER = "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n"
LOG = LOGS / "paper-open-1.blf"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of installed packages."""
    site = tmp_path / "site"
    site.mkdir()
    monkeypatch.syspath_prepend(site)
    log_files._plugins.cache_clear()
    yield site
    log_files._plugins.cache_clear()
    for name in ("trial_reader", "other_reader"):
        sys.modules.pop(name, None)


def install(site: Path, code: str, point: str = ".csv = trial_reader:GvretReader") -> None:
    """Put a package of one module there."""
    module = point.split("=")[1].split(":", maxsplit=1)[0].strip()
    (site / f"{module}.py").write_text(code)
    about = site / f"{module}-1.5.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.5\n")
    (about / "entry_points.txt").write_text(f"[ehadiag.log_readers]\n{point}\n")


def write_gvret(path: Path, table: FrameTable) -> Path:
    """Write frames as SavvyCAN does."""
    lines = [HEADER]
    for time_ns, can_id, extended, length, data in zip(
        table.time_ns, table.can_id, table.extended, table.length, table.data, strict=True
    ):
        payload = ",".join(f"{item:02X}" for item in data[:length])
        kind = str(bool(extended)).lower()
        lines.append(f"{time_ns // 1000},{can_id:08X},{kind},Rx,0,{length},{payload},\n")
    path.write_text("".join(lines))
    return path


def one_line(error: pytest.ExceptionInfo[Exception]) -> str:
    assert "\n" not in str(error.value)
    return str(error.value)


def test_a_recording_in_the_format_of_a_plug_in_has_the_same_samples(
    folder: Path, tmp_path: Path
) -> None:
    install(folder, GVRET)
    path = write_gvret(tmp_path / "x.csv", read_frames(LOG))
    assert not holds_signals(path, mapped=False)
    found, expected = read_recording(path), read_recording(LOG)
    assert found.samples is not None
    assert expected.samples is not None
    for name in ("current", "spool", "pressure", "position", "command"):
        np.testing.assert_array_equal(
            getattr(found.samples, name), getattr(expected.samples, name), name
        )
    assert "read by trial_reader:GvretReader of trial_reader 1.5" in found.quality.notes


@pytest.mark.slow
def test_a_plug_in_is_all_that_a_diagnosis_needs(folder: Path, tmp_path: Path) -> None:
    install(folder, GVRET)
    path = write_gvret(tmp_path / "x.csv", read_frames(LOG))
    found, expected = ehadiag.diagnose(path), ehadiag.diagnose(LOG)
    assert found.severities == expected.severities


def test_a_log_that_a_plug_in_finds_damaged_is_read_up_to_there(
    folder: Path, tmp_path: Path
) -> None:
    install(folder, GVRET)
    path = write_gvret(tmp_path / "x.csv", read_frames(LOG).rows(slice(0, 500)))
    path.write_text(path.read_text() + "torn")
    assert len(read_frames(path)) == 500
    assert (
        "the log is damaged after 500 frames; the rest is lost"
        in read_recording(path).quality.notes
    )


def test_other_files_of_the_suffix_stay_with_their_readers(folder: Path, tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas", reason="tables need the extra ehadiag[daq]")
    install(folder, GVRET)
    time = np.arange(100) * 1e-3
    path = tmp_path / "daq.csv"
    pandas.DataFrame(dict.fromkeys(("time", "spool", "pressure", "position"), time)).to_csv(path)
    assert holds_signals(path, mapped=False)
    assert len(read_signals(path, ColumnMap(), log_files.Budget())) == 3


def test_a_new_suffix_is_known_everywhere(folder: Path, tmp_path: Path) -> None:
    install(folder, GVRET, ".gvret = trial_reader:GvretReader")
    path = write_gvret(tmp_path / "x.gvret", read_frames(LOG).rows(slice(0, 500)))
    assert len(read_frames(path)) == 500
    assert ".gvret" in known_suffixes()
    (tmp_path / "x.pcap").write_text("x")
    with pytest.raises(ConfigurationError, match=r"unknown kind \.pcap; known: .*\.gvret"):
        read_frames(tmp_path / "x.pcap")


@pytest.mark.parametrize(
    ("code", "says"),
    [
        ("import no_such_module\n", "cannot be loaded: ModuleNotFoundError: .*no_such_module"),
        ("def broken(:\n", "cannot be loaded: SyntaxError"),
        ("x = 1\n", "cannot be loaded: AttributeError"),
        ("class GvretReader: signature = b''\n", "needs a method frames or signals"),
        (GVRET.replace("    signature =", "    magic ="), "needs a method .*, and a signature"),
        (GVRET.replace('b"Time Stamp,ID,Extended,Dir,Bus,LEN,"', 'b""'), "read by ehadiag itself"),
        (GVRET.replace('b"Time Stamp,ID,Extended,Dir,Bus,LEN,"', 'b"time"'), "by ehadiag itself"),
    ],
)
def test_a_faulty_plug_in_ends_in_one_line_that_names_it(
    code: str, says: str, folder: Path, tmp_path: Path
) -> None:
    install(folder, code)
    path = write_gvret(tmp_path / "x.csv", read_frames(LOG).rows(slice(0, 50)))
    with pytest.raises(ConfigurationError, match=says) as error:
        read_frames(path)
    assert "log reader trial_reader:GvretReader of trial_reader 1.5: " in one_line(error)
    assert len(read_frames(LOG)) > 0  # another kind of log does not need it


def test_two_plug_ins_for_the_same_files_are_refused(folder: Path, tmp_path: Path) -> None:
    install(folder, GVRET)
    install(folder, GVRET, ".csv = other_reader:GvretReader")
    path = write_gvret(tmp_path / "x.csv", read_frames(LOG).rows(slice(0, 50)))
    with pytest.raises(ConfigurationError, match=r"files are read by .*_reader 1\.5") as error:
        read_frames(path)
    one_line(error)


@pytest.mark.parametrize(
    ("code", "says"),
    [
        (GVRET.replace("next(rows)", "1 / 0"), "damaged: ZeroDivisionError in its reader"),
        (GVRET.replace("def frames(self, path, spending)", "def frames(self)"), "TypeError"),
    ],
)
def test_a_plug_in_that_fails_ends_in_one_line(
    code: str, says: str, folder: Path, tmp_path: Path
) -> None:
    install(folder, code)
    path = write_gvret(tmp_path / "x.csv", read_frames(LOG).rows(slice(0, 50)))
    with pytest.raises(InputOutputError, match=says) as error:
        read_frames(path)
    assert str(path) in one_line(error)


def test_a_plug_in_that_yields_something_else_is_refused(folder: Path, tmp_path: Path) -> None:
    install(folder, GVRET.replace("yield columns.table()", "yield [1, 2]"))
    path = write_gvret(tmp_path / "x.csv", read_frames(LOG).rows(slice(0, 50)))
    with pytest.raises(ConfigurationError, match="yields no FrameTable") as error:
        read_frames(path)
    one_line(error)


def test_a_plug_in_of_decoded_signals_is_chosen_by_its_suffix(folder: Path, tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas", reason="tables need the extra ehadiag[daq]")
    install(
        folder,
        "import pandas\n"
        "from firmware_iface.signals.tables import table_signals\n"
        "class GvretReader:\n"
        "    signature = b''\n"
        "    def signals(self, path, columns, budget, *, complete):\n"
        "        table = pandas.read_json(path)\n"
        "        names = list(table.columns)\n"
        "        return table_signals(table, {}, names, columns, path, complete=complete)\n",
        ".json = trial_reader:GvretReader",
    )
    time = np.arange(100) * 1e-3
    path = tmp_path / "daq.json"
    pandas.DataFrame(dict.fromkeys(("time", "spool", "pressure", "position"), time)).to_json(path)
    assert holds_signals(path, mapped=False)
    found = read_signals(path, ColumnMap(), log_files.Budget())
    np.testing.assert_allclose(found["channels.spool"].value, time)
    with pytest.raises(ConfigurationError, match="unknown kind"):
        read_frames(path)
