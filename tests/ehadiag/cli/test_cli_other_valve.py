"""A 40 mA valve with a 0.8 mm spool, on a bus with other ranges and resolutions: every command."""

from __future__ import annotations

import json

import pytest
from other_valve import CONVERTERS, frames_of_a_test, write_rig

from ehadiag.cli.main import main
from ehadiag.core.actuator import load_actuator
from ehadiag.core.stored_test import bundled_tests, load_test
from ehadiag_sim.plant.conditions import Effects, Faults
from firmware_iface.mapping.bus_map import load_map

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
