"""Defaults from files and variables, templates, completion, `-v`.

Options of the simulated unit: every effect has one, in its unit, and does what it says.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from cli_result import COMMAND, Run
from places import LOGS, ROOT

import ehadiag
from ehadiag import CommandMode, bundled_tests, default_actuator
from ehadiag.cli.main import parser_and_commands
from ehadiag.cli.simulator_options import (
    DATA_ERROR_NAMES,
    add_simulator_options,
    simulator_settings,
)
from ehadiag_sim.conditions import (
    DataErrors,
    Effects,
    Faults,
    Sensors,
    UnmodelledEffects,
    condition_options,
)
from ehadiag_sim.emulator import emulated_computer
from firmware_iface.bus_map import default_map

HEALTHY = LOGS / "healthy-open.blf"


@pytest.fixture
def own(tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> Path:
    """File of the user's own defaults."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "configuration"))
    folder = tmp_path / "configuration" / "ehadiag"
    folder.mkdir(parents=True)
    return folder / "ehadiag.toml"


def seed(run: Run, *arguments: object) -> int:
    result = run("diagnose", "--json", *arguments, HEALTHY)
    assert result.code == 0, result.err
    found: int = result.objects[0]["configuration"]["seed"]
    return found


def test_the_nearer_default_wins(
    run: Run, own: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    own.write_text("seed = 1\n[diagnose]\nseed = 2\n[bit]\nseed = 9\n")
    assert seed(run) == 2
    (tmp_path / "ehadiag.toml").write_text("seed = 3\n")
    assert seed(run) == 3
    assert run("diagnose", "--json", HEALTHY).err == f"ehadiag: defaults from {own}, ehadiag.toml\n"
    monkeypatch.setenv("EHADIAG_SEED", "4")
    assert seed(run) == 4
    assert seed(run, "--seed", 5) == 5


def test_a_required_option_and_a_repeated_one(run: Run, own: Path) -> None:
    own.write_text('test = ["closed"]\n')
    assert run("sim").code == 2  # no bus, but a test is no matter any more
    namespace = ["diagnose", "--list", "--json", HEALTHY, "--test", "open"]
    assert run(*namespace).code == 0


def test_files_are_looked_for_beside_the_users_own_defaults(run: Run, own: Path) -> None:
    assert run("init", "actuator", own.parent).code == 0
    text = (own.parent / "actuator.toml").read_text()
    (own.parent / "actuator.toml").write_text(text.replace("reference-31", "left aileron"))
    own.write_text('actuator = "actuator.toml"\n')
    result = run("diagnose", "--json", HEALTHY)
    assert result.err == ""
    assert result.objects[0]["actuator"] == "left aileron"


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("seed = -1\n", "need a whole number, 0 …"),
        ('solver = "guess"\n', "is none of cga, pygad"),
        ("json = 3\n", "need true or false"),
        ("diagnose = 3\n", "need a table [diagnose]"),
        ("seed = [\n", "not valid TOML"),
        ("out = 'x'\n", "out is not for a project's file"),
        ("max_frames = 3\n", "max_frames is not for a project's file"),
        ("jbos = 2\n", "jbos is no option of any command, did you mean jobs?"),
        ("[diagnos]\njobs = 2\n", "[diagnos] is no command, did you mean [diagnose]?"),
        ("[bit]\njobs = 2\n", "[bit] jobs is no option of bit"),
        ("[diagnose]\nsolvr = 'cga'\n", "solvr is no option of diagnose, did you mean solver?"),
    ],
)
def test_wrong_defaults(text: str, why: str, run: Run, tmp_path: Path) -> None:
    (tmp_path / "ehadiag.toml").write_text(text)
    result = run("diagnose", HEALTHY)
    assert result.code == 2
    assert why in result.message
    assert "ehadiag.toml" in result.message


def test_unknown_keys_of_the_users_own_file_are_refused_too(run: Run, own: Path) -> None:
    own.write_text("jbos = 2\n")
    result = run("tests")
    assert result.code == 2
    assert f"{own}: jbos is no option of any command, did you mean jobs?" in result.message


def test_an_option_may_be_called_like_a_command(run: Run, own: Path) -> None:
    own.write_text('history = "none.sqlite"\nreport = true\n')
    assert "no history none.sqlite" in run("history", "list").message
    assert "is a command" not in run("report", "none.json").err


def test_a_variable_that_is_no_option_is_said(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EHADIAG_JBOS", "2")
    result = run("tests")
    assert result.code == 0
    assert result.message == (
        "ehadiag: variable EHADIAG_JBOS: there is no option --jbos; EHADIAG_JOBS?"
    )


def test_verbs_and_options_that_exclude_each_other_have_defaults(
    run: Run, own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run("history", "init", "--history", "h.sqlite")
    monkeypatch.setenv("EHADIAG_UNIT", "7")
    own.write_text('[history]\nhistory = "h.sqlite"\n[export]\nfmu = true\nlist = false\n')
    result = run("history", "plot", "--out", "x.png")
    assert "serial 7: the history has no diagnosis of it" in result.message
    run("history", "import", ROOT / "docs" / "examples" / "fleet.csv")
    monkeypatch.setenv("EHADIAG_UNIT", "2")
    assert run("history", "event", "oiled").code == 0
    assert {item["serial"] for item in run("history", "list", "--json").objects} == {2}
    assert run("history", "--history", "none.sqlite", "list").code == 2
    assert "need --out DIR" in run("export").message
    assert run("export", "--list").code == 0
    monkeypatch.setenv("EHADIAG_TARGET", "nothing-like-it")
    assert "nothing-like-it" in run("export", "--out", "x").err  # the variable is nearer
    assert run("export", "--list").code == 0
    assert "another-one" in run("export", "--target", "another-one", "--out", "x").err


TRANSMITTING = {
    "bit": ("no bus named", 'interface = "virtual"\nchannel = "x"\n', ["--test", "open"]),
    "sim": ("no bus named", 'interface = "virtual"\n', []),
    "serve": ("no bus named", 'interface = "virtual"\n', ["--allow-tests"]),
    "replay": ("no bus named", 'interface = "virtual"\nchannel = "x"\n', [HEALTHY]),
}


@pytest.mark.parametrize("command", TRANSMITTING)
def test_a_project_makes_nobody_transmit(
    command: str, run: Run, own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    why, text, more = TRANSMITTING[command]
    for content in (text, f"[{command}]\n{text}"):
        (tmp_path / "ehadiag.toml").write_text(content)
        result = run(command, *more)
        assert result.code == 2
        assert f"ignored: {command} can transmit" in result.err
        assert "interface" in result.err.splitlines()[0]
        assert why in result.err
    # What the user says, in a file or a variable of his own, counts.
    (tmp_path / "ehadiag.toml").unlink()
    if command == "serve":  # would begin to serve
        return
    own.write_text('interface = "none-such"\n')
    assert "none-such" in run(command, *more).err
    monkeypatch.setenv("EHADIAG_INTERFACE", "nor-this")
    assert "nor-this" in run(command, *more).err


def test_a_project_starts_no_test(run: Run, tmp_path: Path) -> None:
    (tmp_path / "ehadiag.toml").write_text('test = "open"\nlimit = 0.8\n')
    result = run("bit", "--simulate", "--fast")
    assert result.code == 2
    assert "test ignored: bit can transmit" in result.err
    assert "required: --test" in result.err
    result = run("bit", "--simulate", "--fast", "--test", "open", "--json", "--no-picture")
    assert result.objects[0]["verdict"] == "HEALTHY"
    assert result.objects[0]["configuration"]["levels"]["limit"] == 0.8


def test_who_only_listens_takes_the_bus_of_a_project(run: Run, tmp_path: Path) -> None:
    (tmp_path / "ehadiag.toml").write_text('interface = "none-such"\n')
    for command in ("check-bus", "monitor"):
        assert "none-such" in run(command).err


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="permissions of POSIX")
def test_defaults_that_others_may_write_are_refused(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "ehadiag.toml"
    path.write_text("limit = 0.99\n")
    path.chmod(0o666)
    result = run("diagnose", HEALTHY)
    assert result.code == 2
    assert "others may write to it" in result.message


def test_templates_work_as_they_are(run: Run) -> None:
    for kind in ("actuator", "test", "mapping", "defaults"):
        result = run("init", kind, "new")
        assert result.code == 0
        assert all(Path(name).exists() for name in result.out.splitlines())
        again = run("init", kind, "new")
        assert again.code == 3
        assert "not overwritten" in again.message
    result = run(
        "diagnose", "--json", "--actuator", "new/actuator.toml", "--mapping", "new/mapping.toml",
        "--test", "new/test.toml", HEALTHY,
    )  # fmt: skip
    assert result.objects[0]["verdict"] == "HEALTHY"
    template = Path("new/ehadiag.toml").read_text()
    lines = [line[2:] for line in template.splitlines() if line.startswith(("# [", "# jobs"))]
    Path("ehadiag.toml").write_text("\n".join(lines))
    assert run("diagnose", "--json", HEALTHY).code == 0


def test_a_test_is_named_alike_everywhere(run: Run) -> None:
    assert run("tests", "--csv", "1").out == run("tests", "--csv", "open").out
    for arguments in (
        ["tests", "--csv"],
        ["bit", "--simulate", "--test"],
        ["diagnose", "x", "--test"],
    ):
        result = run(*arguments, "none")
        assert result.code == 2
        assert "neither a stored test (closed or 2, open or 1) nor a test file" in result.message


@pytest.mark.parametrize("shell", ["bash", "zsh", "tcsh"])
def test_completion_knows_commands_and_options(shell: str, run: Run) -> None:
    script = run("completion", shell).out
    for word in ("diagnose", "check-bus", "resume"):
        assert word in script
    if shell == "bash":
        done = subprocess.run(["bash", "-n"], input=script, text=True, check=False)
        assert done.returncode == 0


def test_verbose_tells_versions_and_options(environment: dict[str, str], tmp_path: Path) -> None:
    done = subprocess.run(
        [*COMMAND, "tests", "-v"], env=environment, cwd=tmp_path, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    assert f"ehadiag: ehadiag {ehadiag.__version__} (Python {sys.version.split()[0]}" in done.stderr
    assert "csv=None" in done.stderr


def test_every_command_takes_verbose() -> None:
    commands = parser_and_commands()[1]
    assert all("-v" in command._option_string_actions for command in commands.values())


def parsed(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser(allow_abbrev=False)
    add_simulator_options(parser)
    return parser.parse_args([*words])


def test_every_condition_has_an_option() -> None:
    kinds = (Faults, Effects, Sensors, UnmodelledEffects)
    found = [item.field for kind in kinds for item in condition_options(kind)]
    named = {item.name for kind in kinds for item in fields(kind)}
    assert set(found) | {"data", "unmodelled", "return_pressure"} == named
    assert len(found) == len(set(found))
    assert set(DATA_ERROR_NAMES) == {item.name for item in fields(DataErrors)}


def test_without_options_there_is_no_effect() -> None:
    settings = simulator_settings(parsed())
    found = settings["faults"], settings["effects"], settings["sensors"]
    assert found == (Faults(), Effects(), Sensors())


@pytest.mark.parametrize(
    ("kind", "item"),
    [
        (kind, item)
        for kind in (Faults, Effects, Sensors, UnmodelledEffects)
        for item in condition_options(kind)
        if item.default == 0.0
    ],
    ids=lambda value: getattr(value, "flag", ""),
)
def test_values_are_in_the_unit_of_the_name(kind, item, tmp_path) -> None:
    settings = simulator_settings(
        in_scenario(tmp_path, f"{item.flag[2:].replace('-', '_')} = 0.02")
    )
    unmodelled = settings["effects"].unmodelled
    holder = next(found for found in (*settings.values(), unmodelled) if isinstance(found, kind))
    assert getattr(holder, item.field) == pytest.approx(0.02 * item.scale)


def in_scenario(folder, text: str, *words: str) -> argparse.Namespace:
    (folder / "scenario.toml").write_text(text)
    return parsed("--simulate", str(folder / "scenario.toml"), *words)


def test_sensors_data_and_plays_arrive_and_the_command_line_overrules(tmp_path) -> None:
    text = "early_ms = 0.1\nsupply_error_MPa = -0.1\nsensor_gains = [0, 0.01, -0.01, 0.002]\n"
    text += "plays = 8\nFSS = 0.1\nnoise = 3\ndata_error = { GM = 0.02, MJ = -0.03 }\n"
    words = ["--offsets", "1", "2", "3", "4", "--noise", "0.25", "--supply", "21", "--fss", "0.5"]
    settings = simulator_settings(in_scenario(tmp_path, text, *words))
    sensors, effects = settings["sensors"], settings["effects"]
    assert sensors.gains == (0.0, 0.01, -0.01, 0.002)
    assert (sensors.offsets_lsb, sensors.noise_lsb) == ((1.0, 2.0, 3.0, 4.0), 0.25)
    assert (sensors.early, sensors.supply_error) == pytest.approx((0.1e-3, -0.1e6))
    assert (effects.plays, effects.data) == (8, DataErrors(GM=0.02, MJ=-0.03))
    assert (effects.supply_pressure, settings["faults"].FSS) == (21e6, 0.5)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("hysteresis = 2", "hysteresis: 2 is outside 0 … 1"),
        ("plays = 0", "plays: 0 is outside 1 … 256"),
        ("plays = 1.5", "scenario s.toml: plays: 1.5 is no such number"),
        ("sensor_gains = [0.1]", "need 4 numbers"),
        ("data_error = 1", "need a table"),
        ("data_error = { XX = 1 }", "XX = 1: need a fraction of one of GM, "),
        ('data_error = { GM = "x" }', "GM = 'x': need a fraction"),
        ("early_ms = 1", "early"),
        ('broken = "bent-rod"', "not one of seized-spool"),
        ("null_bias_mA = nan", "null_bias"),
        ("null_bais_mA = 1", "there is no key null_bais_mA, did you mean null_bias_mA?"),
    ],
)
def test_wrong_values_are_one_line(text, says, run, tmp_path) -> None:
    (tmp_path / "s.toml").write_text(text)
    result = run("bit", "--fast", "--json", "--test", "open", "--simulate", "s.toml")
    assert result.code == 2
    assert says in result.err
    assert len(result.err.strip().splitlines()) == 1


def spool_codes(folder, text: str = "") -> list[int]:
    """Of the emulated computer's actuator under a sine of 4 mA."""
    settings = simulator_settings(in_scenario(folder, text))
    core = emulated_computer(
        default_actuator(), bundled_tests().values(), default_map(), **settings
    )
    drive = 4e-3 * np.sin(0.1 * np.arange(100))
    return [int(core.plant.tick(float(x), CommandMode.CURRENT)[1]) for x in drive]


def test_scenarios_reach_the_actuator_of_the_computer(tmp_path) -> None:
    plain = spool_codes(tmp_path)
    assert spool_codes(tmp_path) == plain
    for text in ("null_bias_mA = 0.2", "data_error = { GM = 0.05 }", "torque_cubic = 0.3"):
        assert np.abs(np.subtract(spool_codes(tmp_path, text), plain)).max() > 10
    assert np.ptp(spool_codes(tmp_path, 'broken = "dead-spool"')) < 10
