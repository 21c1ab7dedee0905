"""The live view: fits its terminal, shows texts of others as text, says each thing once."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from dataclasses import replace

import pytest
from cli_result import Run
from rich.console import Console

from ehadiag.cli.screen.draw import drawn, spark
from ehadiag.cli.screen.lines import Lines
from ehadiag.cli.screen.show import shown, wants_screen
from ehadiag.live.snapshot import (
    Alarm,
    Bus,
    Ending,
    Residuals,
    RunningTest,
    Severity,
    Signals,
    Snapshot,
)

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
        bus=Bus(name=text, state="open", frames=4000, rate_per_s=2070.0, load=0.23, lost=1),
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
    console.print(drawn(item, width, unicode=unicode))
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


def test_all_that_is_known_is_there() -> None:
    whole = "\n".join(printed(snapshot(), 80))
    for item in ("open", "2070 frames/s", "load 23%", "lost 1", "3.5 s left", "current mode",
                 "0.3000 ± 0.0100", "rests", "100% of the alarm, above", "no alarm"):  # fmt: skip
        assert item in whole


def test_a_test_shows_residuals_and_alarms_too_and_against_what() -> None:
    found = Residuals(spool=-3.25, against=HOSTILE, spool_below=1.0)
    item = snapshot(command="bit", residuals=found, alarms=(alarm(1),), alarm_count=1)
    for width in (80, 200):
        whole = "\n".join(printed(item, width))
        for part in ("-3.2 σ", "100% of the alarm, below", "against: [bold red]x", "1 alarms",
                     "spool above model during open"):  # fmt: skip
            assert part in whole
    assert "residual" not in "\n".join(printed(snapshot(command="bit", residuals=None), 80))
    assert list(Lines().of(item))[3].endswith(f"during test 'open', compared with {HOSTILE}")


def test_a_terminal_without_block_characters_gets_ascii() -> None:
    whole = "\n".join(printed(snapshot(), 80, unicode=False)[1:-1])
    assert not set(whole) & set("▁▂▃▄▅▆▇█·")


def test_a_spark_lies_between_least_and_most_and_shows_holes() -> None:
    assert spark((0.0, None, 1.0), 10) == "▁ █"
    assert spark((1.0, 2.0, 3.0), 2) == "▁█"
    assert spark((5.0, 5.0), 10) == "▄▄"
    assert spark((None, None), 10) == ""


def test_lines_say_each_thing_once() -> None:
    lines = Lines()
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
    process = [sys.executable, "-P", "-m", "ehadiag.cli.screen.terminal"]
    given = b"".join(snapshot(number).to_json() + b"\n" for number in range(1, 4))
    done = subprocess.run(
        process, input=given, capture_output=True, timeout=60, check=False,
        env={**os.environ, "COLUMNS": "80", "PYTHONIOENCODING": "utf-8"},
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, b"")
    assert "2070 frames/s" in done.stderr.decode()


def test_no_screen_where_there_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    assert not wants_screen(plain=False)
    with shown(snapshot, plain=False):
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
