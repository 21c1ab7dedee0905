"""One rule for logs of every kind: bad lines and stamps that stand or run backward are counted."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from bus_synth import START, make_truth, play
from msgspec.structs import replace
from test_logs import write

from firmware_iface.bus_map import default_map
from firmware_iface.codec import Encoder
from firmware_iface.logs.reader import read_frames
from firmware_iface.recording import Recording
from firmware_iface.signals.recordings import read_recording

FRAMES = play(Encoder(default_map()), make_truth(400))
TEXT = (".log", ".asc", ".trc", ".csv")
ALL = (*TEXT, ".blf", ".mf4")
pytestmark = pytest.mark.filterwarnings("default")  # asammdf's own

BAD_LINES = {
    "noise": lambda _: "\x01\ufffd#@!~ nothing, of, any, format",
    "cut": lambda line: line[: len(line) // 3],
    "letters in a number": lambda line: line.replace("0", "Z"),
}


def stamped(suffix: str, line: str, stamp: float) -> str:
    """A line of a text log with another stamp, s from its beginning."""
    match suffix:
        case ".log":
            return f"({START / 1e9 + stamp:.6f}){line[line.index(')') + 1 :]}"
        case ".csv":
            return f"{START / 1e9 + stamp:.6f}{line[line.index(',') :]}"
        case ".asc":
            return f"{stamp:.6f} {line.split(maxsplit=1)[1]}"
        case _:
            number, _, rest = line.split(maxsplit=2)
            return f"{number} {1e3 * stamp:.3f} {rest}"


def log_with_stamps(path: Path, stamp: Callable[[int], float]) -> Path:
    """The recording with the stamp of its n-th frame, s from its beginning."""
    if path.suffix in (".blf", ".mf4"):
        frames = [
            replace(item, time_ns=START + round(1e9 * stamp(index)))
            for index, item in enumerate(FRAMES)
        ]
        return write(path, frames)
    lines = write(path, FRAMES).read_text().splitlines()
    places = frame_lines(path.suffix, lines)
    for index, place in enumerate(places):
        lines[place] = stamped(path.suffix, lines[place], stamp(index))
    path.write_text("\n".join(lines) + "\n")
    return path


def frame_lines(suffix: str, lines: list[str]) -> list[int]:
    words = {".log": "#", ".asc": "Rx", ".trc": "Rx", ".csv": ","}
    found = [i for i, line in enumerate(lines) if words[suffix] in line and "arbitr" not in line]
    found = [i for i in found if not lines[i].startswith(";")]
    assert len(found) == len(FRAMES)
    return found


def needs(suffix: str) -> None:
    if suffix == ".mf4":
        pytest.importorskip("asammdf", reason="MF4 needs the extra ehadiag[mf4]")


def notes_of(recording: Recording, word: str) -> list[str]:
    return [note for note in recording.quality.notes if word in note]


@pytest.mark.parametrize("suffix", TEXT)
@pytest.mark.parametrize("kind", BAD_LINES)
def test_a_bad_line_costs_itself_and_is_counted(tmp_path: Path, suffix: str, kind: str) -> None:
    path = write(tmp_path / f"log{suffix}", FRAMES)
    lines = path.read_text().splitlines()
    places = frame_lines(suffix, lines)
    for place in (places[100], places[101], places[500]):
        lines[place] = BAD_LINES[kind](lines[place])
    path.write_text("\n".join(lines) + "\n")
    recording = read_recording(path)
    assert notes_of(recording, "could not be read") == ["3 lines of the log could not be read"]
    assert notes_of(recording, "breaks off") == []
    assert len(read_frames(path)) == len(FRAMES) - 3


@pytest.mark.parametrize("suffix", [".asc", ".trc", ".csv"])
def test_a_last_line_that_is_cut_is_the_end_of_the_log(tmp_path: Path, suffix: str) -> None:
    path = write(tmp_path / f"log{suffix}", FRAMES)
    lines = path.read_text().splitlines()
    last = frame_lines(suffix, lines)[700]
    path.write_text("\n".join([*lines[:last], lines[last][:-20]]))
    found = read_frames(path)
    assert len(found) in (700, 701)


@pytest.mark.parametrize("suffix", [".csv", ".trc"])
def test_a_log_of_bad_lines_is_given_up(tmp_path: Path, suffix: str) -> None:
    path = write(tmp_path / f"log{suffix}", FRAMES[:10])
    bad = {".csv": "Z, z\n", ".trc": "11 0.050 DT 1 ZZZZ Rx - 8 00\n"}[suffix]
    with path.open("a") as file:
        file.writelines(bad for _ in range(100_000))
    recording = read_recording(path)
    assert notes_of(recording, "could not be read")
    assert int(notes_of(recording, "could not be read")[0].split()[0]) <= 1011
    assert notes_of(recording, "breaks off or is damaged after 10 frames")


@pytest.mark.parametrize("suffix", ALL)
def test_stamps_all_alike_are_said(tmp_path: Path, suffix: str) -> None:
    needs(suffix)
    recording = read_recording(log_with_stamps(tmp_path / f"log{suffix}", lambda _: 1.0))
    count = len(FRAMES)
    said = f"{count - 1} of {count} time stamps are those of the frame before"
    assert notes_of(recording, "time stamps are") == [said]


@pytest.mark.parametrize("suffix", ALL)
def test_stamps_that_run_backward_are_said(tmp_path: Path, suffix: str) -> None:
    needs(suffix)
    path = log_with_stamps(tmp_path / f"log{suffix}", lambda n: 5.0 + (n % 7) * 0.01)
    recording = read_recording(path)
    count, back = len(FRAMES), (len(FRAMES) - 1) // 7
    said = f"time stamps run backward {back} times in {count} frames, by up to 0.06 s"
    assert notes_of(recording, "run backward") == [said]


@pytest.mark.parametrize("suffix", ALL)
def test_a_sound_log_has_no_note(tmp_path: Path, suffix: str) -> None:
    needs(suffix)
    path = log_with_stamps(tmp_path / f"log{suffix}", lambda n: 0.0005 * n)
    assert read_recording(path).quality.notes == ()


def test_events_and_comments_of_an_asc_are_no_bad_lines(tmp_path: Path) -> None:
    path = write(tmp_path / "log.asc", FRAMES)
    lines = path.read_text().splitlines()
    place = frame_lines(".asc", lines)[5]
    events = [
        "// version 13.0.0",
        "0.002500 1  Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.00%",
        "0.002600 CAN 1 Status:chip status error active",
        "0.002700 1 J1939TP FEE3p 6 0 0 - Rx d 23 A0 0F A6 60",
        "0.001500 1  ErrorFrame",
        "0.002900 SV: 1 0 1 ::Sys::Value = 3",
        "",
    ]
    path.write_text("\n".join([*lines[:place], *events, *lines[place:]]) + "\n")
    assert read_recording(path).quality.notes == ()


def test_a_date_that_python_can_does_not_know_still_ends_in_a_reading(tmp_path: Path) -> None:
    path = write(tmp_path / "log.asc", FRAMES)
    text = path.read_text()
    head, rest = text.split("\n", 1)
    assert head.startswith("date")
    path.write_text(f"date Xyz Foo 99 99:99:99.000 2026\n{rest}")
    assert len(read_frames(path)) == len(FRAMES)
