"""The live view: fits its terminal, shows texts of others as text, says each thing once.

`ehadiag serve` as it is called: what it refuses, what it hands on, and one simulated test.
"""

from __future__ import annotations

import http.client
import io
import json
import os
import pickle
import signal
import subprocess
import sys

import pytest
from cli_result import Run
from msgspec.structs import replace
from rich.console import Console

from ehadiag.cli.main import main, parse_arguments
from ehadiag.cli.serve_command import bit_arguments, monitor_arguments
from ehadiag.core.conventions import FALSE_ALARM_INTERVAL_H
from ehadiag.estimate import Severity
from ehadiag.live import (
    Alarm,
    BusState,
    Ending,
    Residuals,
    RunningTest,
    Signals,
    Snapshot,
    publish,
)
from ehadiag.terminal.live_view import draw_snapshot, sparkline
from ehadiag.terminal.screen import SessionScreen, StatusLines, can_show_screen

HOSTILE = "[bold red]x[/] \x1b[2J\u202e:bomb: <script>alert(1)</script>"


def snapshot(number: int = 1, text: str = "left aileron", **changes: object) -> Snapshot:
    history = tuple(float(item % 7) for item in range(200))
    some = (None, *history[1:])
    whole = Snapshot(
        number=number,
        time="2026-03-01T12:00:00.000Z",
        command="monitor",
        actuator=text,
        serial=12,
        bus=BusState(name=text, state="open", frames=4000, rate_per_s=2070.0, load=0.23, lost=1),
        test=RunningTest(
            name=text, number=1, phase="running", elapsed_s=2.0, duration_s=5.5, left_s=3.5
        ),
        mode="current",
        signals=Signals(
            time_s=history,
            command_mA=some,
            command_mm=(None,) * 200,
            current_mA=some,
            spool_mm=some,
            pressure_MPa=some,
            position_mm=some,
        ),
        residuals=Residuals(spool=0.1, pressure=None, spool_above=1.0),
        severities=(Severity(name="FSS", estimate=0.3, std=0.01, source=text),),
        working="watching",
        notes=(text,),
    )
    return replace(whole, **changes)  # type: ignore[arg-type]


def alarm(number: int, text: str = "open") -> Alarm:
    return Alarm(time=f"2026-03-01T12:00:0{number}.000Z", signal="spool", side="above", during=text)


def printed(item: Snapshot, width: int, *, unicode: bool = True) -> list[str]:
    out = io.StringIO()
    console = Console(file=out, width=width, markup=False, emoji=False, highlight=False)
    console.print(draw_snapshot(item, width, unicode=unicode))
    return out.getvalue().splitlines()


@pytest.mark.parametrize("width", [60, 80, 200])
@pytest.mark.parametrize("text", ["left aileron", HOSTILE, "x" * 300])
def test_it_fits_and_shows_what_others_wrote_as_text(width: int, text: str) -> None:
    item = snapshot(
        text=text,
        alarms=tuple(alarm(number, text) for number in range(8)),
        alarm_count=12,
        ending=Ending(verdict="ALARM", reasons=(text,)),
    )
    item = Snapshot.from_json(item.to_json())  # as it reaches the screen
    lines = printed(item, width)
    assert len(lines) <= 30
    assert all(len(line) == width for line in lines)
    assert all(line.isprintable() for line in lines)
    whole = "\n".join(lines)
    assert "ALARM" in whole
    assert "12 alarms" in whole
    assert text is not HOSTILE or "[bold red]x[/] \\x1b[2J\\u202e:bomb:" in whole


def test_the_result_of_a_test_stands_once() -> None:
    """It is printed below the last view."""
    ending = Ending(verdict="DEGRADED", reasons=("Plan to replace the servovalve.",))
    whole = "\n".join(printed(snapshot(command="bit", ending=ending), 80))
    assert "DEGRADED" not in whole
    assert "servovalve" not in whole
    assert "FSS" not in whole
    assert "pressure" in whole


def test_all_that_is_known_is_there() -> None:
    whole = "\n".join(printed(snapshot(), 80))
    for item in ("open", "2070 frames/s", "load 23%", "lost 1", "3.5 s left",
                 "current mode", "0.3000 ± 0.0100", "at rest", "100% of the alarm, above",
                 "no alarm"):  # fmt: skip
        assert item in whole


def test_a_test_shows_residuals_and_alarms_too_and_against_what() -> None:
    found = Residuals(spool=-3.25, against=HOSTILE, spool_below=1.0)
    item = snapshot(command="bit", residuals=found, alarms=(alarm(1),), alarm_count=1)
    for width in (80, 200):
        whole = "\n".join(printed(item, width))
        for part in ("-3.2 σ", "100% of the alarm, below", "against: [bold red]x", "1 alarms",
                     "spool above what the model says during open"):  # fmt: skip
            assert part in whole
    calm = "\n".join(printed(snapshot(command="bit", residuals=Residuals(spool=-33.6)), 80))
    assert "0% of the alarm" in calm
    assert not {"above", "below"} & set(calm.split())
    assert "residual" not in "\n".join(printed(snapshot(command="bit", residuals=None), 80))
    assert list(StatusLines().of(item))[3].endswith(f"during test 'open', compared with {HOSTILE}")


def test_a_terminal_without_block_characters_gets_ascii() -> None:
    whole = "\n".join(printed(snapshot(), 80, unicode=False)[1:-1])
    assert not set(whole) & set("▁▂▃▄▅▆▇█·")


def test_a_spark_lies_between_least_and_most_and_shows_holes() -> None:
    assert sparkline((0.0, None, 1.0), 10) == "▁ █"
    assert sparkline((1.0, 2.0, 3.0), 2) == "▁█"
    assert sparkline((5.0, 5.0), 10) == "▄▄"
    assert sparkline((None, None), 10) == ""


def test_lines_say_each_thing_once() -> None:
    lines = StatusLines()
    first = list(lines.of(snapshot(1)))
    assert first == [
        "bus left aileron open",
        "test 'left aileron': running",
        "FSS 0.3000 ± 0.0100 (left aileron)",
        "left aileron",
    ]
    assert list(lines.of(snapshot(2))) == []
    alarms = tuple(alarm(number) for number in range(8))
    more = list(lines.of(snapshot(3, alarms=alarms, alarm_count=9)))
    assert len(more) == 8
    assert "spool above what the model says during test 'open'" in more[0]
    last = snapshot(4, alarms=alarms, alarm_count=9, ending=Ending(verdict="ALARM", reasons=("x",)))
    assert list(lines.of(last)) == ["ALARM: x"]


def test_the_screens_process_draws_what_it_reads_and_ends_with_it() -> None:
    process = [sys.executable, "-P", "-m", "ehadiag.terminal.screen_process"]
    given = b"".join(snapshot(number).to_json() + b"\n" for number in range(1, 4))
    done = subprocess.run(
        process, input=given, capture_output=True, timeout=60, check=False,
        env={**os.environ, "COLUMNS": "80", "PYTHONIOENCODING": "utf-8"},
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, b"")
    assert "2070 frames/s" in done.stderr.decode()


def test_no_screen_where_there_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    assert not can_show_screen(plain=False)
    with SessionScreen(plain=False) as screen, publish(snapshot, screen.take):
        pass
    assert "test 'left aileron': running" in capsys.readouterr().err


def test_a_test_is_told_in_plain_lines_where_there_is_no_terminal(run: Run) -> None:
    """What the running test showed stands there before the verdict."""
    found = run("bit", "--test", "open", "--simulate", "--fast", "--FSS", "0.3", "--no-picture")
    assert found.code == 10
    assert "ehadiag: test 'open': " in found.err
    assert "FSS 0.2" in found.err or "FSS 0.3" in found.err
    assert "(final)" in found.err
    assert "DEGRADED" in found.out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "no bus named"),
        (["--simulate"], "--allow-tests"),
        (["-i", "virtual", "--protocol", "uds"], "--protocol: no test is requested without"),
        (["-i", "virtual", "--xcp"], "--xcp: no test is requested without"),
        (["--simulate", "--allow-tests", "--http-port", "70000"], "need a port"),
        (["--simulate", "--allow-tests", "--test", "nothing"], "nothing"),
        (["--simulate", "--allow-tests", "--actuator", "missing.toml"], "missing.toml"),
    ],
)
def test_wrong_usage_is_one_line(options, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    try:
        code = main(["serve", *options])
    except SystemExit as error:
        code = error.code
    assert code in (2, 3)
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert words in said[0]


def test_options_are_handed_on_as_they_were_given(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "own"))
    (tmp_path / "own" / "ehadiag").mkdir(parents=True)
    file = tmp_path / "own" / "ehadiag" / "ehadiag.toml"
    file.write_text("[bit]\nmax_position = 20.0\n[serve]\nadvisory = 0.3\n")
    given = ["-i", "socketcan", "-c", "can 0", "--fd", "--bus-kwargs", "a=1", "b=2", "--hours", "5"]
    given += ["--protocol", "uds", "--xcp", "700:701"]
    arguments = parse_arguments(["serve", *given, "--mapping", "m.toml", "--http-port", "0"])
    test = bit_arguments(arguments, "closed")
    assert (test.interface, test.channel, test.fd) == ("socketcan", "can 0", True)
    assert (test.bus_kwargs, test.hours, test.mapping) == (["a=1", "b=2"], 5.0, ["m.toml"])
    assert (test.test, test.report, test.no_picture) == ("closed", True, True)
    assert (test.protocol, test.xcp) == ("uds", "700:701")
    assert (test.max_position, test.advisory, test.limit) == (20.0, 0.3, 0.75)
    watch = monitor_arguments(arguments)
    assert (watch.interface, watch.bus_kwargs, watch.mapping) == (
        "socketcan", ["a=1", "b=2"], "m.toml",
    )  # fmt: skip
    assert watch.hours == FALSE_ALARM_INTERVAL_H
    pickle.loads(pickle.dumps((test, watch)))


@pytest.mark.slow
def test_a_simulated_test_is_run_from_the_page(tmp_path):
    command = ["serve", "--simulate", "--allow-tests", "--http-port", "0", "--out", str(tmp_path)]
    program = [sys.executable, "-m", "ehadiag", *command]
    with subprocess.Popen(program, stderr=subprocess.PIPE, text=True, cwd=tmp_path) as process:
        try:
            said = process.stderr.readline()
            address, token = said.split()[2].split("#token=")
            port = int(address.rstrip("/").rpartition(":")[2])
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=120)
            headers = {"X-Ehadiag-Token": token}
            connection.request("POST", "/start", json.dumps({"test": "open"}), headers)
            assert connection.getresponse().read() == b"{}"
            stream = http.client.HTTPConnection("127.0.0.1", port, timeout=120)
            stream.request("GET", "/live")
            answer, ending, running = stream.getresponse(), None, True
            while ending is None or running:
                line = answer.readline()
                assert line, "the page's stream ended before the test"
                data = json.loads(line[6:]) if line.startswith(b"data: {") else {}
                ending = data.get("ending", ending)
                running = data.get("running", running)
            assert ending["verdict"] in ("HEALTHY", "NOT TESTED")
            assert list(tmp_path.glob("*.json"))
        finally:
            process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
