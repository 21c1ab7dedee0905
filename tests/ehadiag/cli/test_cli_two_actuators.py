"""Several actuators on one bus: a mapping each, one log, a result for each."""

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
from places import LOGS
from two_actuators import write_log, write_mappings

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
        (["--dbc", "left.dbc"], "each names its own DBC"),
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
