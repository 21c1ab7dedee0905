"""`check-bus`: what it shows of channels and state, and that it says what `diagnose` would.

Several actuators on one bus: a mapping each, one log, a result for each. A 40 mA valve with a 0.8
mm spool, on a bus with other ranges and resolutions: every command.
"""

from __future__ import annotations

import json
import threading
import time
import uuid
from pathlib import Path

import can
import can.interfaces.virtual
import pytest
from cli_result import Run
from msgspec.structs import replace
from other_valve import CONVERTERS, frames_of_a_test, write_rig
from places import LOGS, ROOT
from two_actuators import write_log, write_mappings

from ehadiag import bundled_tests, load_actuator, load_test
from ehadiag.cli.main import main
from ehadiag_sim.conditions import Effects, Faults
from firmware_iface.bus_map import load_map
from firmware_iface.bus_report import RangeUse, render_bus_report, report_bus
from firmware_iface.transport.frames import ColumnBuilder

DATA = ROOT / "firmware_iface" / "data"


def mapped(tmp_path: Path, before: str, after: str) -> Path:
    """The default mapping with one signal mapped in another way."""
    (tmp_path / "eha_fcc.dbc").write_bytes((DATA / "eha_fcc.dbc").read_bytes())
    text = (DATA / "eha_fcc.toml").read_text()
    assert before in text
    path = tmp_path / "rig.toml"
    path.write_text(text.replace(before, after))
    return path


def test_physical_values_and_the_state_in_plain_words(run: Run) -> None:
    came = run("check-bus", "--log", LOGS / "paper-open-1.blf")
    assert came.code == 0
    (line,) = [item for item in came.out.splitlines() if item.startswith("position")]
    assert line.endswith(" mm")
    assert "state of the test: complete, test 1" in came.out


def test_the_same_as_json(run: Run) -> None:
    came = run("check-bus", "--json", "--log", LOGS / "paper-closed-1.blf")
    found = json.loads(came.out)
    assert (found["schema"], found["test"], found["problems"]) == ("ehadiag.bus/1", "closed", [])
    current = next(item for item in found["ranges"] if item["channel"] == "current")
    assert current["lowest"] <= current["now"] <= current["highest"]


@pytest.mark.parametrize("log", ["lossy-open.blf", "healthy-closed.blf"])
def test_what_diagnose_takes_check_bus_takes(run: Run, log: str) -> None:
    assert run("check-bus", "--log", LOGS / log).code == 0
    assert run("diagnose", LOGS / log).code in (0, 10, 20)


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        (
            'signal = "JackPosition" }',
            'signal = "JackPosition", scale = -1.0 }',
            "position: its sign is reversed",
        ),
        ('signal = "DiffPressure" }', 'signal = "DiffPressure", unit = "psi" }', "pressure: "),
        ('signal = "SpoolPosition" }', 'signal = "SpoolPosition", unit = "in" }', "spool: "),
    ],
)
def test_a_wrong_unit_or_sign_is_a_problem(
    run: Run, tmp_path: Path, before: str, after: str, words: str
) -> None:
    path = mapped(tmp_path, before, after)
    came = run("check-bus", "--mapping", path, "--log", LOGS / "paper-open-1.blf")
    assert came.code == 30
    assert words in came.out


def test_listening_needs_a_status_and_says_so_at_once(run: Run, tmp_path: Path) -> None:
    line = 'state = { message = "BitStatus", signal = "BitState" }\n'
    path = mapped(tmp_path, line, "")
    came = run("bit", "--listen", "--test", "open", "--mapping", path, "-i", "virtual", "-c", "x")
    assert came.code == 2
    assert "has no status.state" in came.err


def test_the_bus_of_a_context_of_python_cans_file(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "can.conf"
    file.write_text("[default]\ninterface = virtual\nchannel = low\n[HS]\nchannel = high\n")
    monkeypatch.setattr("can.util.CONFIG_FILES", [str(file)])
    for options, channel in (([], "low"), (["--context", "HS"], "high")):
        result = run("check-bus", *options, "--duration", "0.05")
        assert result.out.startswith(f"listened to virtual {channel} for ")
    result = run("check-bus", "--context", "MS")
    assert (result.code, "no section [MS]" in result.message) == (2, True)


def test_a_picture_of_what_was_heard(run: Run, tmp_path: Path) -> None:
    log = LOGS / "paper-closed-1.blf"
    came = run("check-bus", "--log", log, "--plot", "bus.png")
    assert (came.code, came.err) == (0, "ehadiag: wrote bus.png\n")
    assert (tmp_path / "bus.png").read_bytes().startswith(b"\x89PNG")
    came = run("check-bus", "--log", log, "--plot", "none/bus.png")
    assert (came.code, "picture none/bus.png: " in came.message) == (3, True)
    empty = tmp_path / "empty.log"
    empty.write_text("(1.0) can0 7FF#00\n")
    came = run("check-bus", "--log", empty, "--plot", "nothing.png")
    assert came.code == 30
    assert "nothing is drawn" in came.message
    assert not (tmp_path / "nothing.png").exists()


LEFT, RIGHT = LOGS / "healthy-open.blf", LOGS / "paper-open-4.blf"


@pytest.fixture
def rig(tmp_path: Path) -> tuple[list[object], Path]:
    """Options that name both actuators, and the log of both."""
    left, right = write_mappings(tmp_path)
    log = write_log(tmp_path / "both.blf", LEFT, RIGHT)
    return ["--mapping", left, "--mapping", right], log


def estimates(tree: dict[str, object]) -> dict[str, object]:
    return {name: fault["estimate"] for name, fault in tree["faults"].items()}


@pytest.mark.slow
def test_each_actuator_has_the_result_that_it_has_alone(rig, run: Run) -> None:
    options, log = rig
    both = run("diagnose", "--json", *options, log, "--out", "out", "--no-picture")
    alone = run("diagnose", "--json", LEFT, RIGHT)
    assert both.code == 10
    assert [tree["verdict"] for tree in both.objects] == ["HEALTHY", "DEGRADED"]
    assert [estimates(tree) for tree in both.objects] == [estimates(tree) for tree in alone.objects]
    files = [tree["configuration"]["mapping"]["file"] for tree in both.objects]
    assert [Path(name).name for name in files] == ["left.toml", "right.toml"]
    for tree, label in zip(both.objects, ("left", "right"), strict=True):
        assert f"actuator of mapping {label}" in tree["quality"]["notes"]
        assert json.loads(Path(f"out/both-{label}.json").read_text()) == tree


@pytest.mark.slow
def test_results_of_each_are_taken_up_again(rig, run: Run) -> None:
    options, log = rig
    first = run("diagnose", "--json", "--resume", "r.jsonl", *options[:2], log)
    both = run("diagnose", "--json", "--resume", "r.jsonl", "--summary", "s.json", *options, log)
    assert both.objects[0]["faults"] == first.objects[0]["faults"]
    assert "do not count" not in both.err
    assert json.loads(Path("s.json").read_text())["reused"] == 1
    again = run("diagnose", "--json", "--resume", "r.jsonl", *options, log, "--jobs", 2)
    assert again.objects == both.objects


def test_list_names_the_tests_of_each(rig, run: Run) -> None:
    options, log = rig
    result = run("diagnose", "--list", *options, log)
    assert result.code == 0
    assert "(left)" in result.out
    assert "(right)" in result.out


@pytest.mark.parametrize(
    ("more", "why"),
    [
        (["--joint"], "--joint is of one actuator"),
        (["--dbc", "left.dbc"], "each names its own"),
        (["--mapping", "left.toml"], "named twice"),
        (["--actuator", "a.toml"] * 3, "named 3 times, --mapping 2 times"),
    ],
)
def test_what_several_mappings_do_not_go_with(rig, more: list[str], why: str, run: Run) -> None:
    options, log = rig
    options = [str(item).replace(f"{log.parent}/", "") for item in options]
    result = run("diagnose", *options, *more, log)
    assert result.code == 2
    assert why in result.message


@pytest.mark.slow
def test_two_tests_are_listened_to_at_once_and_recorded_once(rig, run: Run) -> None:
    options, log = rig
    channel = f"two-{uuid.uuid4()}"

    def play() -> None:
        while not can.interfaces.virtual.channels.get(channel):  # nobody listens yet
            time.sleep(0.05)
        with (
            can.LogReader(str(log)) as reader,
            can.Bus(interface="virtual", channel=channel) as bus,
        ):
            for message in can.MessageSync(reader, timestamps=True):
                message.channel = None
                bus.send(message)

    player = threading.Thread(target=play, daemon=True)
    player.start()
    bus = ["-i", "virtual", "-c", channel]
    listen = ["bit", "--listen", "--test", "open", *options, *bus, "--no-picture", "--no-history"]
    result = run(*listen, "--json", "--out", "runs", "--record", "once.blf")
    player.join(30.0)
    assert [tree["verdict"] for tree in result.objects] == ["HEALTHY", "DEGRADED"]
    assert result.code == 10
    assert {tree["source"] for tree in result.objects} == {"once.blf"}
    names = sorted(path.name for path in Path("runs").iterdir())
    assert names == ["once-left.json", "once-right.json"]
    again = run("diagnose", "--json", *options, "once.blf")
    assert [estimates(tree) for tree in again.objects] == [
        estimates(tree) for tree in result.objects
    ]


def test_only_one_actuator_is_asked_for_a_test(rig, run: Run) -> None:
    result = run("bit", "--test", "open", "-i", "virtual", *rig[0])
    assert result.code == 2
    assert "a test is requested of one actuator" in result.message


TRUTH = {"Kintas": 0.3, "FSS": 0.4, "FDJ": 0.2}


def log_of(rig, number, **conditions):
    """A candump log of one test on the rig."""
    actuator, bus = load_actuator(rig / "actuator.toml"), load_map(rig / "rig.toml")
    tests = [load_test(rig / "open-40.toml"), bundled_tests()["closed"]]
    path = rig / f"{number}.log"
    with path.open("w", encoding="ascii") as out:
        for frame in frames_of_a_test(actuator, tests, bus, number, **conditions):
            stamp = f"{frame.time_ns // 10**9}.{frame.time_ns // 1000 % 10**6:06d}"
            out.write(f"({stamp}) can0 {frame.can_id:03X}#{frame.data.hex().upper()}\n")
    return path


def options(rig):
    """Options that name the rig."""
    return ["--actuator", str(rig / "actuator.toml"), "--mapping", str(rig / "rig.toml")]


def diagnosed(rig, capsys, number, **conditions):
    """What is said of the three faults' sizes, and of the null bias."""
    log = log_of(rig, number, faults=Faults(**TRUTH), **conditions)
    said = ["--test", str(rig / "open-40.toml")] if number == 41 else []
    code = main(["diagnose", str(log), *options(rig), *said, "--json", "--no-history"])
    result = json.loads(capsys.readouterr().out)
    assert (code, result["verdict"]) == (10, "DEGRADED")
    for name, value in TRUTH.items():
        assert result["faults"][name]["estimate"] == pytest.approx(value, abs=0.005)
    return result


@pytest.mark.slow
def test_faults_and_null_bias_are_found_with_the_converters_seen_in_the_data(tmp_path, capsys):
    rig = write_rig(tmp_path, converters="")
    result = diagnosed(rig, capsys, 41, effects=Effects(null_bias=0.7e-3))
    (bias,) = (item for item in result["other"] if item["name"] == "null_bias")
    assert bias["value"] == pytest.approx(0.7e-3, abs=0.02e-3)


@pytest.mark.slow
def test_faults_are_found_in_closed_loop_with_the_converters_of_the_file(tmp_path, capsys):
    diagnosed(write_rig(tmp_path), capsys, 2)


@pytest.mark.slow
def test_check_bus_shows_the_other_ranges(tmp_path, capsys):
    rig = write_rig(tmp_path)
    log = log_of(rig, 41)
    assert main(["check-bus", "--log", str(log), *options(rig)]) == 0
    said = capsys.readouterr().out
    line = next(line for line in said.splitlines() if line.startswith("current"))
    assert float(line.split()[-3]) == pytest.approx(-40.0, abs=0.2)
    assert line.endswith("mA")


@pytest.mark.parametrize("command", [["sim"], ["bit", "--simulate", "--test", "open"]])
def test_a_bus_that_cannot_carry_the_valve_is_named(tmp_path, capsys, command):
    rig = write_rig(tmp_path)
    bus = ["-i", "virtual", "-c", "x"] if command == ["sim"] else []
    assert main([*command, *bus, "--actuator", str(rig / "actuator.toml")]) == 2
    assert "ServoCurrent carries -12" in capsys.readouterr().err


@pytest.mark.slow
def test_spool_at_the_converters_end_is_seen_though_the_bus_reaches_further(tmp_path, capsys):
    narrow = CONVERTERS.replace("spool = { full_scale = 1e-3 }", "spool = { full_scale = 0.3e-3 }")
    rig = write_rig(tmp_path, narrow)
    log = log_of(rig, 41)
    said = ["--test", str(rig / "open-40.toml"), "--json", "--no-history"]
    assert main(["diagnose", str(log), *options(rig), *said]) == 30
    reasons = json.loads(capsys.readouterr().out)["reasons"]
    assert any("spool samples stand at the converter's end" in reason for reason in reasons)


def test_columns_of_24_bits_do_not_run_together() -> None:
    report = report_bus(ColumnBuilder().table(), load_map(DATA / "eha_fcc.toml"))
    use = RangeUse("spool", -8388608, 8388607, 1 << 24, -5e-4, 5e-4, 0.0, 0)
    (line,) = (
        line.split()
        for line in render_bus_report(replace(report, ranges=(use,))).splitlines()
        if line.startswith("spool ")
    )
    assert line[1:6] == ["-8388608", "…", "8388607", "16777216", "100"]


def test_what_the_model_does_not_explain_is_refused_here_too(tmp_path: Path, run: Run) -> None:
    text = (ROOT / "ehadiag" / "data" / "actuator.toml").read_text(encoding="utf-8")
    assert "MJ  = 150.0" in text
    (tmp_path / "a.toml").write_text(text.replace("MJ  = 150.0", "MJ  = 900.0"))
    log = LOGS / "paper-open-1.blf"
    told = run("check-bus", "--log", log, "--actuator", tmp_path / "a.toml")
    found = run("diagnose", log, "--actuator", tmp_path / "a.toml", "--json")
    assert (told.code, found.code) == (30, 30)
    (tree,) = found.objects
    assert all(f"refuses: {item}" in told.out for item in tree["reasons"])
