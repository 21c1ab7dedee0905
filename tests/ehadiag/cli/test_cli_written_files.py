"""Every file that a command writes in the same predicaments.

A link in its place, a full disk, an odd name; and its permissions. Results and pictures of `--out`
have tests of their own.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Iterable
from pathlib import Path

import msgspec
import pytest
from cli_result import Run
from places import LOGS

from ehadiag import Actuator, Calibrated, Recording, StoredTest, default_actuator
from ehadiag.cli.main import main
from ehadiag.core.actuator import Calibration, FitQuality
from ehadiag.design.score import Proposal, Score
from ehadiag.identify.experiment import build_experiment

HEALTHY = LOGS / "healthy-open.blf"
posix = pytest.mark.skipif(os.name != "posix", reason="links and names of POSIX")
WRITTEN = {
    "results": (".jsonl", "diagnose", "v.blf", "--results", "{}"),
    "resumed results": (".jsonl", "diagnose", "v.blf", "--resume", "{}"),
    "lock of results": (".jsonl.lock", "diagnose", "v.blf", "--results", "{}"),
    "results as CSV": (".csv", "diagnose", "v.blf", "--results", "{}"),
    "results as Parquet": (".parquet", "diagnose", "v.blf", "--results", "{}"),
    "report for build servers": (".xml", "diagnose", "v.blf", "--junit", "{}"),
    "summary": (".json", "diagnose", "v.blf", "--summary", "{}"),
    "history of a diagnosis": (".sqlite", "diagnose", "v.blf", "--history", "{}"),
    "history": (".sqlite", "history", "init", "--history", "{}"),
    "exported history": (".csv", "history", "export", "--history", "h.sqlite", "--out", "{}"),
    "trend": (
        ".png", "history", "plot", "--unit", "1", "--history", "h.sqlite", "--out", "{}"
    ),
    "page": (".html", "report"),
    "channels over time": (".png", "check-bus", "--log", "v.blf", "--plot", "{}"),
    "log of alarms": (
        ".jsonl", "monitor", "--log", "v.blf", "--log-file", "{}",
    ),
    "recording": (
        ".blf", "bit", "--simulate", "--fast", "--test", "open", "--no-picture", "--out", "o",
        "--record", "{}",
    ),
    "template": ("", "init", "test", "{}"),
    "calibrated unit": (".toml", "calibrate", "v.blf", "--out", "{}"),
    "picture of a calibration": (".png", "calibrate", "v.blf", "--out", "{}"),
    "page of a calibration": (".html", "calibrate", "v.blf", "--report", "--out", "{}"),
    "designed test": (".toml", "design", "--out", "{}"),
    "exported library": ("", "export", "--target", "cortex-m4", "--out", "{}"),
}  # fmt: skip
ODD = os.fsdecode(b"-a\x1b[31m\n \xff?#%20")


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the commands read: a log, its result, a history."""
    folder = tmp_path_factory.mktemp("prepared")
    shutil.copy(HEALTHY, folder / "v.blf")
    options = ["--no-picture", "--out", str(folder), "--history", str(folder / "h.sqlite")]
    assert main(["diagnose", str(folder / "v.blf"), *options]) == 0
    return folder


@pytest.fixture(autouse=True)
def nothing_slow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Learn, search and compile nothing: what is written of it is."""
    own = msgspec.structs.replace(
        default_actuator(),
        calibration=Calibration(
            date="2026-01-02T03:04:05Z", start="reference-31", serial=7, plays=1, effects={},
            parameters=("null_bias",), std=(1e-7,), root=((1.0,),), held={},
            fit=FitQuality(excess=1.0, outliers=0.0, spool_rms=1.0, pressure_rms=1.0),
            recordings=(),
        ),
    )  # fmt: skip
    score = Score(bounds=(), figure=1e-3, travel=0.01, rate=0.1, pressure=1e7)

    def calibrate(
        recordings: list[Recording], start: Actuator, tests: Iterable[StoredTest], **_: object
    ) -> Calibrated:
        (recording,), test = recordings, next(iter(tests))
        assert recording.samples is not None
        experiment = build_experiment(recording.samples, recording.environment, test, start)
        return Calibrated(
            recordings=(recording,), tests=(test,), start=start, actuator=own, reasons=(),
            notes=(), severities=(), values=(), tried=(), experiments=(experiment,), seed=0,
            evaluations=0, elapsed=0.0,
        )  # fmt: skip

    def propose(test: StoredTest, *_: object, **__: object) -> Proposal:
        return Proposal(test, score, scored=1, better=True)

    monkeypatch.setattr("ehadiag.calibration.calibrate_unit.calibrate", calibrate)
    monkeypatch.setattr("ehadiag.design.score.score", lambda *_: score)
    monkeypatch.setattr("ehadiag.design.score.propose", propose)
    monkeypatch.setattr("ehadiag.export.library.object_files", lambda *_: [b"code"])


@pytest.fixture
def place(prepared: Path, run: Run, tmp_path: Path) -> Path:
    """A folder to write to, below the working folder."""
    shutil.copytree(prepared, tmp_path, dirs_exist_ok=True)
    (tmp_path / "there").mkdir()
    return tmp_path / "there"


def written(kind: str, folder: Path, stem: str = "x") -> tuple[Path, list[str]]:
    """A file that a command is to write, and the command."""
    suffix, *arguments = WRITTEN[kind]
    path = folder / f"{stem}{suffix}"
    if kind == "page":
        result = shutil.copy("v.json", folder / f"{stem}.json")
        os.chmod(result, 0o640)
        return path, ["report", str(result)]
    if kind == "template":
        return folder / "test.toml", ["init", "test", str(folder)]
    if kind == "exported library":
        (folder / stem).mkdir()
        path = folder / stem / "libeha.a"
        return path, [*arguments[:-1], str(path.parent)]
    if arguments[0] == "calibrate":
        return path, [item.format(path.with_suffix(".toml")) for item in arguments]
    return path, [item.format(str(path).removesuffix(".lock")) for item in arguments]


@pytest.mark.usefixtures("undrawn")
@posix
@pytest.mark.parametrize("there", [True, False])
@pytest.mark.parametrize("kind", WRITTEN)
def test_a_link_in_its_place_is_not_followed(kind: str, there: bool, place: Path, run: Run) -> None:
    path, command = written(kind, place)
    victim = place.parent / "victim"
    if there:
        victim.write_bytes(b"")
    path.symlink_to(victim)
    result = run(*command)
    assert victim.exists() == there
    assert not there or victim.read_bytes() == b""
    assert result.code in (2, 3) or not path.is_symlink()
    assert "Traceback" not in result.err


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("kind", [item for item in WRITTEN if item != "lock of results"])
def test_a_full_disk_is_said_and_leaves_nothing_half_written(
    kind: str, place: Path, run: Run, tiny_disk: Path
) -> None:
    path, command = written(kind, tiny_disk)
    with contextlib.suppress(OSError), (tiny_disk / "filler").open("wb", 0) as filler:
        while filler.write(bytes(4096)):
            pass
    result = run(*command)
    assert result.code in (3, 30)
    assert "Traceback" not in result.err
    assert re.search("No space left|no room left|disk is full", result.err)
    assert not list(tiny_disk.glob(".ehadiag-*"))
    assert not path.exists() or path.stat().st_size == 0
    assert kind != "recording" or not path.exists()


@pytest.mark.parametrize("kind", ["calibrated unit", "designed test"])
def test_what_took_long_is_told_where_it_cannot_be_written(
    kind: str, place: Path, run: Run, tiny_disk: Path
) -> None:
    path, command = written(kind, tiny_disk)
    (tiny_disk / "filler").write_bytes(b"x" * (64 << 10))
    for options in ([], ["--json"]):
        result = run(*command, *options)
        assert result.code == 3
        assert f"{path}: No space left on device" in result.err
        assert "wrote" not in result.err
        assert len(result.out) > 100


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
@pytest.mark.parametrize("output", ["full", "closed"])
@pytest.mark.parametrize("kind", ["calibrated unit", "designed test", "exported library"])
def test_what_took_long_is_written_where_it_cannot_be_told(
    kind: str,
    output: str,
    place: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path, command = written(kind, place)
    if output == "full":
        writer = os.open("/dev/full", os.O_WRONLY)
    else:
        reader, writer = os.pipe()
        os.close(reader)
    with open(writer, "w", encoding="utf-8") as stream:
        monkeypatch.setattr("sys.stdout", stream)
        assert main(command) == 3
    said = "Broken pipe" if output == "closed" else "No space left on device"
    assert f"ehadiag: standard output: {said}\n" in capsys.readouterr().err
    assert path.stat().st_size > 0


@posix
@pytest.mark.parametrize("kind", [item for item in WRITTEN if item not in ("template",)])
def test_an_odd_name_is_written_as_it_is_and_shown_as_text(
    kind: str, place: Path, run: Run
) -> None:
    path, command = written(kind, place, ODD)
    before = os.umask(0o027)
    try:
        result = run(*command)
    finally:
        os.umask(before)
    assert result.code == 0
    assert {item.stat().st_mode & 0o777 for item in path.parent.iterdir()} == {0o640}
    assert path.stat().st_mode & 0o777 == 0o640
    assert "\x1b" not in result.out + result.err
    assert "Traceback" not in result.err
