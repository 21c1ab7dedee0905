"""What a recording may cost, reader by reader, and that no error quotes what a file holds."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from bus_synth import START, make_truth, play
from long_logs import write_bomb, write_repeated

from ehadiag import ConfigurationError, EhadiagError, InputOutputError, load_actuator
from firmware_iface.bus_map import load_map
from firmware_iface.codec import Encoder
from firmware_iface.dbc import MAX_MESSAGE_SIGNALS, MAX_SIGNALS, parse_dbc
from firmware_iface.logs.log_files import FRAME_READERS, Budget
from firmware_iface.logs.reader import iterate_recordings, read_frames
from firmware_iface.logs.recorder import Recorder
from firmware_iface.signals.columns import ColumnMap
from firmware_iface.signals.recordings import read_recording
from firmware_iface.signals.tables import read_signals
from firmware_iface.stored_test import resolve_test
from firmware_iface.transport.frames import Frame

SECRET = "root:x:0:0:topsecret:/root:/bin/sh\n"
KINDS = [item for item in FRAME_READERS if item != ".mf4"]
ONE = Frame(START, 0x123, bytes(8))


def recorded(path: Path, count: int = 300) -> Path:
    if path.suffix == ".mf4":
        pytest.importorskip("asammdf", reason="MF4 needs the extra ehadiag[mf4]")
    if path.suffix == ".log":
        lines = (f"(1700000000.{k:06d}) can0 123#0000000000000000\n" for k in range(count))
        path.write_text("".join(lines))
        return path
    with Recorder(path) as recorder:
        for k in range(count):
            recorder.write(Frame(START + k * 1_000_000, 0x123, bytes(8)))
    return path


def one_line(error: pytest.ExceptionInfo[EhadiagError]) -> str:
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.filterwarnings("default")  # asammdf's own
@pytest.mark.parametrize("suffix", FRAME_READERS)
@pytest.mark.parametrize(
    ("budget", "says"),
    [
        (Budget(frames=299), "more than 299 frames; .*--max-frames"),
        (Budget(size=1000), "larger than .* MiB; .*--max-log-size"),
        (Budget(seconds=0.0), "not read within 0 s; .*--max-read-time"),
    ],
)
def test_every_reader_keeps_every_budget(
    suffix: str, budget: Budget, says: str, tmp_path: Path
) -> None:
    path = recorded(tmp_path / f"x{suffix}", 3000 if budget.size == 1000 else 300)
    with pytest.raises(InputOutputError, match=says) as error:
        read_recording(path, budget=budget)
    assert str(path) in one_line(error)


@pytest.mark.parametrize("suffix", KINDS)
def test_all_frames_at_once_have_a_limit_of_memory(suffix: str, tmp_path: Path) -> None:
    path = recorded(tmp_path / f"x{suffix}")
    assert len(read_frames(path, Budget(held=300))) == 300
    with pytest.raises(InputOutputError, match="more than 299 frames, too many to hold at once"):
        read_frames(path, Budget(held=299))


def test_what_a_container_unpacks_to_is_counted_while_it_unpacks(tmp_path: Path) -> None:
    write_bomb(tmp_path / "bomb.blf", 1_000_000)
    with pytest.raises(InputOutputError, match=r"unpacks to more than .*--max-log-size"):
        read_recording(tmp_path / "bomb.blf", budget=Budget(size=4 << 20))
    with pytest.raises(InputOutputError, match="more than 100000 frames"):
        read_recording(tmp_path / "bomb.blf", budget=Budget(frames=100_000))


PEAK = """
import re, sys
from firmware_iface.errors import InputOutputError
from firmware_iface.logs.log_files import Budget
from firmware_iface.signals.recordings import read_recording
try:
    recording = read_recording(sys.argv[1], budget=Budget(frames=int(sys.argv[2])))
    print(recording.samples.ticks, file=sys.stderr)
except InputOutputError as error:
    print(error, file=sys.stderr)
# Not getrusage: that begins with the peak of the process that started this one.
print(int(re.search(r"VmHWM:\\s+(\\d+)", open("/proc/self/status").read())[1]) >> 10)
"""


def peak_mb(path: Path, frames: int) -> tuple[int, str]:
    done = subprocess.run(
        [sys.executable, "-c", PEAK, str(path), str(frames)],
        capture_output=True,
        text=True,
        check=True,
    )
    return int(done.stdout), done.stderr.strip()


@pytest.mark.skipif(sys.platform != "linux", reason="peak memory as Linux tells it")
def test_a_small_file_of_many_frames_ends_in_one_line_with_little_memory(tmp_path: Path) -> None:
    write_bomb(tmp_path / "bomb.blf", 84_000_000)
    assert (tmp_path / "bomb.blf").stat().st_size < 12 << 20
    peak, said = peak_mb(tmp_path / "bomb.blf", 3_000_000)
    assert "more than 3000000 frames; split it, or allow more by --max-frames" in said
    assert "\n" not in said
    assert peak < 150


def session(ticks: int, before: int, after: int) -> list[Frame]:
    return play(Encoder(), make_truth(ticks), counter=0, idle_before=before, idle_after=after)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="peak memory as Linux tells it")
def test_a_gigabyte_is_read_within_300_MB(tmp_path: Path) -> None:
    frames = session(5500, 10_000, 10_100)
    count = write_repeated(tmp_path / "long.blf", frames, 420, 25_600_000_000)
    assert (tmp_path / "long.blf").stat().st_size > 1_000_000_000
    peak, said = peak_mb(tmp_path / "long.blf", count)
    assert said == "5500"
    assert peak < 300


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="peak memory as Linux tells it")
def test_a_test_without_end_is_cut_and_takes_no_more_than_is_held(tmp_path: Path) -> None:
    frames = session(25_600, 0, 0)
    count = write_repeated(tmp_path / "endless.blf", frames, 80, 25_600_000_000)
    peak, _ = peak_mb(tmp_path / "endless.blf", count)
    assert peak < 1000
    found = list(iterate_recordings(tmp_path / "endless.blf"))
    assert found


@pytest.mark.skipif(sys.platform != "linux", reason="peak memory as Linux tells it")
def test_memory_does_not_grow_with_the_length(tmp_path: Path) -> None:
    frames = session(200, 1000, 1360)  # ten whole turns of the counters
    for times in (40, 120):
        write_repeated(tmp_path / f"{times}.blf", frames, times, 2_560_000_000)
    short, _ = peak_mb(tmp_path / "40.blf", 10**7)
    long, said = peak_mb(tmp_path / "120.blf", 10**7)
    assert said == "200"
    assert long < short + 25


def test_all_tests_of_a_long_log_are_there(tmp_path: Path) -> None:
    frames = session(200, 1000, 1360)
    write_repeated(tmp_path / "x.blf", frames, 50, 2_560_000_000)
    found = list(iterate_recordings(tmp_path / "x.blf"))
    assert [item.samples.ticks for item in found if item.samples] == [200] * 50
    assert all(item.quality.total("lost") == 0 for item in found)
    starts = [item.start_ns for item in found]
    assert np.diff(starts).tolist() == [2_560_000_000] * 49


def read_table(path: Path) -> object:
    """Decoded signals instead of frames."""
    pytest.importorskip("pyarrow", reason="tables need the extra ehadiag[daq]")
    return read_signals(path, ColumnMap(), Budget())


READERS: dict[str, Callable[[Path], object]] = {
    "mapping": load_map,
    "dbc": lambda path: load_map(path.parent / "map.toml", path),
    "actuator": load_actuator,
    "test": lambda path: resolve_test(str(path)),
    **dict.fromkeys(FRAME_READERS, read_recording),
    **dict.fromkeys([f"{suffix}.gz" for suffix in (".blf", ".log")], read_recording),
    ".parquet": read_table,
    ".parquet.gz": read_table,
}


def named(kind: str, folder: Path) -> Path:
    from importlib import resources

    content = resources.files("firmware_iface").joinpath("data", "eha_fcc.toml").read_bytes()
    (folder / "map.toml").write_bytes(content)
    return folder / f"x{kind if kind.startswith('.') else '.toml'}"


@pytest.mark.filterwarnings("default")  # asammdf's own
@pytest.mark.parametrize("kind", READERS)
def test_no_error_quotes_a_file_behind_a_link(kind: str, tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_text(SECRET * 3)
    path = named(kind, tmp_path)
    path.symlink_to(secret)
    with pytest.raises(EhadiagError) as error:
        READERS[kind](path)
    said = one_line(error)
    for word in ("topsecret", "root:", "/bin/sh", ":x:"):
        assert word not in said


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names on this system")
@pytest.mark.parametrize("kind", READERS)
def test_a_pipe_is_refused_at_once(kind: str, tmp_path: Path) -> None:
    path = named(kind, tmp_path)
    os.mkfifo(path)
    with pytest.raises(InputOutputError, match=r"not a (regular )?file") as error:
        READERS[kind](path)
    one_line(error)


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="no such device on this system")
@pytest.mark.parametrize("kind", READERS)
def test_a_device_is_refused_at_once(kind: str, tmp_path: Path) -> None:
    path = named(kind, tmp_path)
    path.symlink_to("/dev/zero")
    with pytest.raises(InputOutputError, match=r"not a (regular )?file") as error:
        READERS[kind](path)
    one_line(error)


def many(messages: int, signals: int) -> bytes:
    rows = ['VERSION ""', "BU_: A"]
    for number in range(messages):
        rows.append(f"BO_ {number} M{number}: 8 A")
        rows.append(' SG_ X M : 0|16@1+ (1,0) [0|0] "" A')
        rows += [f' SG_ S{k} m{k} : 16|8@1+ (1,0) [0|255] "" A' for k in range(signals)]
    return "\n".join(rows).encode()


def test_a_dbc_of_too_many_signals_is_refused_before_it_is_parsed() -> None:
    with pytest.raises(ConfigurationError, match=f"more than {MAX_MESSAGE_SIGNALS} signals"):
        parse_dbc(many(1, 100_000)[: 2 << 20], "x.dbc")
    with pytest.raises(ConfigurationError, match=f"more than {MAX_SIGNALS} signals"):
        parse_dbc(many(200, 60), "x.dbc")
    assert len(parse_dbc(many(2, 60), "x.dbc")["M0"].signals) == 61


def test_a_key_without_end_is_refused_before_it_is_parsed(tmp_path: Path) -> None:
    path = tmp_path / "deep.toml"
    path.write_text("a" + ".a" * 100_000 + " = 1\n")
    with pytest.raises(ConfigurationError, match="a line with more than 50 dots"):
        load_map(path)


@pytest.mark.parametrize("scale", ["1e308", "1e-308", "-1e300"])
def test_scales_without_sense_are_refused(scale: str, tmp_path: Path) -> None:
    path = named("mapping", tmp_path)
    text = (tmp_path / "map.toml").read_text(encoding="utf-8")
    old = 'signal = "ServoCurrent"'
    assert old in text
    path.write_text(text.replace(old, f"{old}, scale = {scale}", 1))
    from importlib import resources

    dbc = resources.files("firmware_iface").joinpath("data", "eha_fcc.dbc").read_bytes()
    (tmp_path / "eha_fcc.dbc").write_bytes(dbc)
    with pytest.raises(ConfigurationError, match="scale must lie within"):
        load_map(path)
