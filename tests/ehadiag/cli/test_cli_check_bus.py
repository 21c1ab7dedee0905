"""`check-bus`: what it shows of channels and state, and that it says what `diagnose` would."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from cli_result import Run
from places import LOGS, ROOT

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
