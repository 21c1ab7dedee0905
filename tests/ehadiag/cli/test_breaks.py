"""Breaks of the command line that were found by attacking it; each stays repaired."""

from __future__ import annotations

import csv
import shutil
import struct
from importlib import resources
from pathlib import Path

import can
import pytest
from cli_result import Run
from msgspec.structs import replace
from places import LOGS

from ehadiag.setup import Setup
from firmware_iface.bus_map import default_map
from firmware_iface.logs.recorder import Recorder
from firmware_iface.mapping_file import UdsIdentifiers
from firmware_iface.transport.frames import Frame

HEALTHY = LOGS / "healthy-open.blf"
START_YEAR_OFFSET = 40
"""Byte of the start's year in the header of a BLF file."""
REQUEST_ID = 0x200
"""Identifier of the frame that requests a test, on the default bus."""
OTHER_REQUEST_ID = 0x311


def test_dates_that_no_stamp_holds_cost_the_batch_nothing(run: Run, tmp_path: Path) -> None:
    for name, year in (("a.blf", 1), ("b.blf", 9999), ("c.blf", None)):
        content = bytearray(HEALTHY.read_bytes())
        if year is not None:
            struct.pack_into("<H", content, START_YEAR_OFFSET, year)
        (tmp_path / name).write_bytes(content)
    result = run(
        "diagnose", "--jobs", "1", "--json", "--results", "r.csv", "a.blf", "b.blf", "c.blf"
    )
    assert [item["verdict"] for item in result.objects] == ["HEALTHY"] * 3
    assert result.code == 0
    assert len(list(csv.DictReader(Path("r.csv").read_text().splitlines()))) == 3


def test_an_error_of_the_program_costs_one_recording_only(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = Setup.read

    def failing(setup: Setup, *logs: str, progress: object) -> object:
        if logs[0] == "a.blf":
            raise IndexError("out of bounds")
        return read(setup, *logs)

    monkeypatch.setattr(Setup, "read", failing)
    for name in ("a.blf", "b.blf"):
        shutil.copy(HEALTHY, tmp_path / name)
    result = run("diagnose", "--jobs", "1", "--json", "--results", "r.csv", "a.blf", "b.blf")
    assert result.message.startswith("ehadiag: log a.blf: unexpected IndexError")
    assert [item.get("verdict") for item in result.objects] == [None, "HEALTHY"]
    assert result.code == 3
    assert len(list(csv.DictReader(Path("r.csv").read_text().splitlines()))) == 2


def played(run: Run, *options: object) -> tuple[list[int], str]:
    """Identifiers that `replay` put on a bus, and what it said."""
    with can.Bus(interface="virtual", channel="breaks") as listener:
        bus = ("-i", "virtual", "-c", "breaks", "--speed", "0")
        result = run("replay", "log.blf", *bus, *options)
        sent = []
        while (message := listener.recv(0)) is not None:
            sent.append(message.arbitration_id)
    assert result.code == 0
    return sent, result.message


@pytest.fixture
def log(tmp_path: Path) -> list[int]:
    """Identifiers of the frames of a recording with two requests, `log.blf`."""
    identifiers = [0x110, 0x111, REQUEST_ID, 0x120, OTHER_REQUEST_ID, REQUEST_ID, 0x110]
    with Recorder(tmp_path / "log.blf") as recorder:
        for number, can_id in enumerate(identifiers):
            recorder.write(Frame(number * 1_000_000, can_id, bytes(8)))
    return identifiers


def test_replay_sends_no_request_of_a_recording_unless_asked_to(run: Run, log: list[int]) -> None:
    sent, text = played(run)
    assert sent == [item for item in log if item != REQUEST_ID]
    assert "played 5 of 7 frames" in text
    assert text.endswith(", 2 requests left out (--with-requests)")
    sent, text = played(run, "--with-requests")
    assert sent == log
    assert "left out" not in text
    assert "the surface moves" in " ".join(run("replay", "--help").out.split())


def test_replay_sends_no_request_by_uds(run: Run, tmp_path: Path) -> None:
    start = Frame(0, 0x7E0, bytes((5, 0x31, 0x01, 0x02, 0x01, 1, 0xCC, 0xCC)))
    with Recorder(tmp_path / "log.blf") as recorder:
        for frame in (Frame(0, 0x110, bytes(8)), start, Frame(0, 0x7E8, bytes(8))):
            recorder.write(frame)
    sent, text = played(run)
    assert sent == [0x110, 0x7E8]
    assert text.endswith(", 1 requests left out (--with-requests)")
    sent, _ = played(run, "--id-offset", "1")
    assert sent == [0x110, 0x7E0, 0x7E8]
    taken = replace(default_map(), uds=UdsIdentifiers(0x110, 0x7E8))
    assert taken.request_identifiers == {(REQUEST_ID, False)}


def test_replay_leaves_out_the_requests_of_a_mapped_bus(
    run: Run, log: list[int], tmp_path: Path
) -> None:
    assert default_map().request_identifiers == {(REQUEST_ID, False), (0x7E0, False)}
    text = resources.files("firmware_iface").joinpath("data/eha_fcc.dbc").read_text()
    for word in ("BO_", "VAL_"):
        text = text.replace(f"{word} {REQUEST_ID} ", f"{word} {OTHER_REQUEST_ID} ")
    (tmp_path / "other.dbc").write_text(text)
    sent, _ = played(run, "--dbc", "other.dbc")
    assert sent == [item for item in log if item != OTHER_REQUEST_ID]
