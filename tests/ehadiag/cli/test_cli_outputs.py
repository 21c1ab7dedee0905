"""What is written: whole, under a safe name, on the disk before it is printed; whatever happens."""

from __future__ import annotations

import errno
import io
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from cli_result import COMMAND, Run
from places import LOGS

from ehadiag.history.store import History
from ehadiag.terminal.output import print_status
from firmware_iface.files import Folder
from firmware_iface.logs.reader import read_frames

HEALTHY, WORN = LOGS / "healthy-open.blf", LOGS / "paper-open-1.blf"
posix = pytest.mark.skipif(os.name != "posix", reason="shells, links and names of POSIX")
full = pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
FAST = ("bit", "--simulate", "--fast", "--json", "--test", "open")
FORMATS = (".blf", ".asc", ".csv", ".trc")


def shell(
    line: str, folder: Path, environment: dict[str, str], *arguments: object
) -> subprocess.CompletedProcess[bytes]:
    """Run a line of a shell in which $EHADIAG is the program."""
    return subprocess.run(
        ["bash", "-c", line, "bash", *map(str, arguments)],
        cwd=folder,
        env=environment | {"EHADIAG": " ".join(COMMAND)},
        capture_output=True,
        timeout=120,
        check=False,
    )


def lines(errors: bytes) -> list[str]:
    said = [line for line in errors.decode().splitlines() if "font cache" not in line]
    assert all(line.startswith("ehadiag: ") for line in said), said
    return [line.removeprefix("ehadiag: ") for line in said]


def verdicts(folder: Path) -> dict[str, str]:
    """Of every result in a folder; nothing half-written is in it."""
    assert not [path for path in folder.iterdir() if path.suffix == ".part"]
    return {path.stem: json.loads(path.read_text())["verdict"] for path in folder.glob("*.json")}


@full
@posix
@pytest.mark.parametrize("option", ["--json", ""])
def test_full_standard_output(option: str, tmp_path: Path, environment: dict[str, str]) -> None:
    done = shell(
        f'$EHADIAG diagnose {option} --no-picture --out o "$1" "$2" > /dev/full',
        tmp_path, environment, HEALTHY, WORN,
    )  # fmt: skip
    assert done.returncode == 3  # of one of the two: worse than the other's 10
    first, *others = lines(done.stderr)
    assert first == "standard output: No space left on device"
    assert [line.split()[0] for line in others] == ["wrote", "wrote"]
    assert verdicts(tmp_path / "o") == {"healthy-open": "HEALTHY", "paper-open-1": "DEGRADED"}


@posix
@pytest.mark.parametrize("option", ["--json", ""])
def test_closed_pipe(option: str, tmp_path: Path, environment: dict[str, str]) -> None:
    done = shell(
        f'$EHADIAG diagnose {option} --no-picture --out o "$1" | true; exit ${{PIPESTATUS[0]}}',
        tmp_path, environment, WORN,
    )  # fmt: skip
    assert done.returncode == 3  # worse than DEGRADED
    assert lines(done.stderr)[0] == "standard output: Broken pipe"
    assert len(verdicts(tmp_path / "o")) == 1


@posix
@pytest.mark.parametrize("where", ["> /dev/full", "| true"])
@pytest.mark.parametrize("command", ["tests", 'check-bus --log "$1"'])
def test_commands_without_a_verdict(
    command: str, where: str, tmp_path: Path, environment: dict[str, str]
) -> None:
    line = f"$EHADIAG {command} {where}; exit ${{PIPESTATUS[0]}}"
    done = shell(line, tmp_path, environment, HEALTHY)
    assert done.returncode == 3
    (said,) = lines(done.stderr)
    assert said.startswith("standard output: ")


@full
@posix
@pytest.mark.parametrize(
    "command",
    [
        'diagnose --list "$1"', "export --list", "completion bash", "init test new",
        "history --history h init", "history --history h list",
    ],
)  # fmt: skip
def test_other_commands_with_a_full_output(
    command: str, tmp_path: Path, environment: dict[str, str]
) -> None:
    History(tmp_path / "h", create=True).close()
    done = shell(f"$EHADIAG {command} > /dev/full", tmp_path, environment, HEALTHY)
    assert done.returncode == 3
    (said,) = lines(done.stderr)
    assert said == "standard output: No space left on device"
    assert command != "init test new" or (tmp_path / "new" / "test.toml").stat().st_size > 0


@full
@posix
def test_live_test_with_full_outputs(tmp_path: Path, environment: dict[str, str]) -> None:
    """Neither a full standard output nor a full standard error costs the result."""
    line = "$EHADIAG bit --simulate --fast --test open --FSS 0.9 --out o > /dev/full 2> /dev/full"
    done = shell(line, tmp_path, environment)
    assert done.returncode == 20
    assert list(verdicts(tmp_path / "o").values()) == ["FAULT"]
    assert sorted(path.suffix for path in (tmp_path / "o").iterdir()) == [
        ".blf", ".json", ".png",
    ]  # fmt: skip


def test_full_disk_for_the_result(run: Run, tiny_disk: Path) -> None:
    filler = tiny_disk / "filler"
    filler.write_bytes(b"x" * (64 << 10))
    for log, code in ((HEALTHY, 3), (WORN, 3)):  # worse than DEGRADED
        result = run("diagnose", "--json", "--out", tiny_disk, log)
        assert result.code == code
        assert result.objects[0]["source"] == str(log)
        assert result.message == (
            f"ehadiag: result {tiny_disk / log.stem}.json: No space left on device"
        )
    assert list(tiny_disk.iterdir()) == [filler]


def test_full_disk_for_the_picture(run: Run, tiny_disk: Path) -> None:
    result = run("diagnose", "--json", "--out", tiny_disk, HEALTHY)
    assert result.code == 3
    first, last = result.err.splitlines()
    assert first == f"ehadiag: picture {tiny_disk / HEALTHY.stem}.png: No space left on device"
    assert last == f"ehadiag: wrote {tiny_disk / HEALTHY.stem}.json"
    (written,) = tiny_disk.iterdir()
    assert json.loads(written.read_text()) == result.objects[0]


@pytest.mark.parametrize("suffix", FORMATS)
def test_full_disk_for_the_recording(suffix: str, run: Run, tiny_disk: Path) -> None:
    """The test is aborted, what was recorded stays readable, and the result says why."""
    path = tiny_disk / f"r{suffix}"
    result = run(*FAST, "--out", "o", "--record", path)
    assert (result.code, result.objects[0]["verdict"]) == (30, "NOT_TESTED")
    assert result.objects[0]["reasons"] == [f"recording {path}: No space left on device"]
    assert verdicts(Path("o")) == {"r": "NOT_TESTED"}
    assert len(read_frames(path)) > 500


@pytest.mark.usefixtures("undrawn")
@posix
@pytest.mark.parametrize("suffix", [".json", ".png"])
def test_a_planted_link_is_not_followed(suffix: str, run: Run, tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("precious")
    Path("o").mkdir()
    Path("o", HEALTHY.stem + suffix).symlink_to(victim)
    result = run("diagnose", "--json", "--out", "o", HEALTHY)
    assert result.code == 0
    assert victim.read_text() == "precious"
    assert result.message.startswith(f"ehadiag: wrote o/{HEALTHY.stem}-2.json")


@posix
@pytest.mark.parametrize("suffix", FORMATS)
def test_a_planted_link_is_not_recorded_to(suffix: str, run: Run, tmp_path: Path) -> None:
    Path("o").mkdir()
    Path(f"o/r{suffix}").symlink_to(tmp_path / "victim")
    result = run(*FAST, "--out", "o", "--record", f"o/r{suffix}")
    assert result.code == 3
    assert result.message.endswith("exists, and is not overwritten; name another file")
    assert not (tmp_path / "victim").exists()


@posix
def test_an_output_folder_that_is_a_link(run: Run, tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    Path("o").symlink_to("real")
    for command in (["diagnose", HEALTHY], [*FAST]):
        result = run(*command, "--out", "o")
        assert (result.code, result.message) == (
            3, "ehadiag: output folder o: is a link; name the folder it leads to",
        )  # fmt: skip
    assert list((tmp_path / "real").iterdir()) == []


ODD_NAMES = [
    (b"..blf", "_", "..blf"),
    (b"...blf", "_-2", "...blf"),
    (b"-x.blf", "_x", "-x.blf"),
    (b"caf\xe9.blf", "caf_", "caf\\xe9.blf"),
    (b"a\x1b[31m\n.blf", "a_[31m_", "a\\x1b[31m\\x0a.blf"),
    (b"$x_{[bold]y[nothing].blf", "$x_{[bold]y[nothing]", "$x_{[bold]y[nothing].blf"),
    ("\u202egnp.blf".encode(), "_gnp", "\\u202egnp.blf"),
    (b"n" * 251 + b".blf", "n" * 200, "n" * 251 + ".blf"),
]
"""Name of a log, stem of its result, and what is shown of the name."""


@posix
def test_odd_names(run: Run, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for name, _, _ in ODD_NAMES:
        shutil.copy(os.fsencode(HEALTHY), os.path.join(os.fsencode(tmp_path), b"in", name))
    given = [f"in/{os.fsdecode(name)}" for name, _, _ in ODD_NAMES]
    table = run("diagnose", "--jobs", 1, "--out", "o", "--no-picture", *given)
    assert table.code == 0
    shown = [line for line in table.out.splitlines() if "recording in/" in line]
    assert shown == [f"  recording in/{item}" for _, _, item in ODD_NAMES]
    assert "\x1b" not in table.out + table.err
    sources = {
        stem: "in/" + name.decode("utf-8", "backslashreplace") for name, stem, _ in ODD_NAMES
    }
    assert sources == {
        path.stem: json.loads(path.read_text())["source"] for path in (tmp_path / "o").iterdir()
    }
    drawn = {stem: sources[stem] for _, stem, _ in ODD_NAMES[-3:]}
    found = run("diagnose", "--jobs", 1, "--out", "p", "--json", *given[-3:])
    assert found.code == 0
    assert [item["source"] for item in found.objects] == [*drawn.values()]
    written = [f"{stem}{suffix}" for stem in drawn for suffix in (".json", ".png")]
    assert sorted(path.name for path in (tmp_path / "p").iterdir()) == sorted(written)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in", "o", "p"]


@posix
def test_odd_names_in_errors(run: Run) -> None:
    for option in ((), ("--actuator",), ("--test",), ("--mapping",), ("--out", "/dev/null/x")):
        name = os.fsdecode(b"gone\x1b[2J\xff.blf")
        came = run("diagnose", *option, name, *([HEALTHY] if option else []))
        assert came.code in (2, 3)
        assert "\x1b" not in came.err
        assert "--out" in option or came.message.startswith("ehadiag: ")


def test_a_terminal_without_the_characters(tmp_path: Path, environment: dict[str, str]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "ehadiag", "diagnose", str(HEALTHY)],
        cwd=tmp_path,
        env=environment | {"PYTHONIOENCODING": "ascii", "LC_ALL": "C"},
        capture_output=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"\\u2026" in done.stdout


@pytest.mark.parametrize("name", ["\x1b[31mred", "[/nothing][bold]", "two\nlines"])
def test_names_in_an_actuator_file_are_text(name: str, run: Run, tmp_path: Path) -> None:
    data = (Path(__file__).parents[3] / "ehadiag/data/actuator.toml").read_text()
    text = data.replace('"reference-31"', json.dumps(name))
    (tmp_path / "a.toml").write_text(text)
    result = run("diagnose", "--actuator", "a.toml", HEALTHY)
    shown = name.replace("\x1b", "\\x1b").replace("\n", "\\x0a")
    assert result.out.splitlines()[1].endswith(f", unit 1, open-loop test, actuator type {shown}")
    (found,) = run("diagnose", "--json", "--actuator", "a.toml", HEALTHY).objects
    assert found["actuator"] == name


@pytest.mark.usefixtures("undrawn")
def test_equal_names_do_not_overwrite_each_other(run: Run, tmp_path: Path) -> None:
    """In one call, and in calls one after the other; the same recording gives its result anew."""
    for folder, log in (("a", HEALTHY), ("b", WORN)):
        (tmp_path / folder).mkdir()
        shutil.copy(log, tmp_path / folder / "log.blf")
    run("diagnose", "--out", "o", "--no-picture", "a/log.blf", "b/log.blf")
    assert verdicts(Path("o")) == {"log": "HEALTHY", "log-2": "DEGRADED"}
    for name, stem, verdict in (("b", "log", "DEGRADED"), ("a", "log-2", "HEALTHY")):
        result = run("diagnose", "--out", "p", f"{name}/log.blf")
        assert f"wrote p/{stem}.json, p/{stem}.png" in result.err
        assert verdicts(Path("p"))[stem] == verdict
    again = run("diagnose", "--out", "p", "--limit", "0.29", "b/log.blf")
    assert "wrote p/log.json, p/log.png" in again.err
    assert verdicts(Path("p")) == {"log": "FAULT", "log-2": "HEALTHY"}
    assert len(list(Path("p").iterdir())) == 4


@pytest.mark.usefixtures("undrawn")
def test_a_file_that_is_no_result_is_not_overwritten(run: Run) -> None:
    Path("o").mkdir()
    for name in ("healthy-open.json", "healthy-open-2.png", "healthy-open-3.json"):
        Path("o", name).write_text("[1]")
    result = run("diagnose", "--out", "o", HEALTHY)
    assert "wrote o/healthy-open-4.json" in result.err
    assert Path("o/healthy-open.json").read_text() == "[1]"


@pytest.mark.usefixtures("undrawn")
@posix
def test_permissions(run: Run) -> None:
    before = os.umask(0o027)
    try:
        run("diagnose", "--report", "--out", "o", HEALTHY)
    finally:
        os.umask(before)
    assert Path("o").stat().st_mode & 0o777 == 0o750
    assert {path.stat().st_mode & 0o777 for path in Path("o").iterdir()} == {0o640}
    assert len(list(Path("o").iterdir())) == 3


def test_the_time_limit(run: Run) -> None:
    limit = ("--time-limit", "1e-6", "--no-picture")
    result = run("diagnose", "--json", *limit, "--out", "o", HEALTHY, WORN)
    assert result.code == 30
    for found in result.objects:
        assert found["verdict"] == "NOT_TESTED"
        assert found["test"] == "open"
        assert found["quality"]["frames"] == 11331
        (reason,) = found["reasons"]
        assert reason.startswith("no estimate within 1e-06 s: given up in the first approx")
    assert set(verdicts(Path("o")).values()) == {"NOT_TESTED"}
    live = run(*FAST, *limit)
    assert live.code == 30
    (reason,) = live.objects[0]["reasons"]
    assert reason.startswith("no estimate within 1e-06 s: given up in the ")


@posix
def test_matplotlib_reads_nothing_that_lies_about(
    tmp_path: Path, environment: dict[str, str]
) -> None:
    (tmp_path / "matplotlibrc").write_text("figure.dpi: no number\nsavefig.format: pdf\n")
    done = subprocess.run(
        [*COMMAND, "diagnose", "--json", "--out", "o", str(HEALTHY)],
        cwd=tmp_path, env=environment, capture_output=True, check=True,
    )  # fmt: skip
    assert lines(done.stderr) == ["wrote o/healthy-open.json, o/healthy-open.png"]
    assert (tmp_path / "o/healthy-open.png").read_bytes()[:4] == b"\x89PNG"


def test_signals_are_written_beside_a_result_once(run: Run, tmp_path: Path) -> None:
    command = ("diagnose", "--json", "--no-picture", "--signals", "mf4", "--signals", "mcap", WORN)
    assert "--signals: name by --out the folder" in run(*command).message
    names = ["paper-open-1.json", "paper-open-1.signals.mcap", "paper-open-1.signals.mf4"]
    for _ in range(2):
        assert run(*command, "--out", "o").code == 10
        assert sorted(item.name for item in (tmp_path / "o").iterdir()) == names
    refused = run(*command, HEALTHY, "--out", "o", "--jobs", "2")
    assert refused.code == 2
    assert "--jobs: --signals needs samples" in refused.message


def test_no_signals_are_written_without_their_result(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_folder: Folder, name: str, _content: bytes) -> None:
        raise OSError(errno.ENOSPC, f"no space for {name}")

    monkeypatch.setattr(Folder, "write_new", full)
    result = run("diagnose", "--json", "--no-picture", "--signals", "mf4", WORN, "--out", "o")
    assert "result o/paper-open-1.json" in result.message
    assert list((tmp_path / "o").iterdir()) == []


def test_no_signals_of_others_are_replaced(run: Run, tmp_path: Path) -> None:
    other = tmp_path / "o" / "paper-open-1.signals.mf4"
    other.parent.mkdir()
    other.write_bytes(b"of somebody else")
    run("diagnose", "--json", "--no-picture", "--signals", "mf4", WORN, "--out", "o")
    assert other.read_bytes() == b"of somebody else"
    assert (tmp_path / "o" / "paper-open-1-2.signals.mf4").exists()


def test_signals_in_a_folder_of_recordings_are_no_recordings(run: Run, tmp_path: Path) -> None:
    (tmp_path / "o").mkdir()
    shutil.copy(WORN, tmp_path / "o")
    run("diagnose", "--json", "--no-picture", "--signals", "mf4", "o", "--out", "o")
    found = run("diagnose", "--json", "o")
    assert len(found.objects) == 1
    assert "signals of a result are no recording: o/paper-open-1.signals.mf4" in found.err


class Terminal(io.StringIO):
    """Standard error that is a terminal."""

    def isatty(self) -> bool:
        return True


def test_a_terminal_breaks_no_file_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setattr("sys.stderr", screen := Terminal())
    names = [f"a-folder/20261125T230028Z-closed.{kind}" for kind in ("json", "png")]
    print_status(f"wrote {', '.join(names)}")
    assert [line.strip(" ,") for line in screen.getvalue().splitlines()] == [
        "ehadiag: wrote", *names,
    ]  # fmt: skip
