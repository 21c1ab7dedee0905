"""Options of the simulated unit: every effect has one, in its unit, and does what it says."""

import argparse
from dataclasses import fields

import numpy as np
import pytest

from ehadiag.cli import options
from ehadiag.cli.effects import DATA, EFFECTS, SENSORS, STRANGERS, the_effects, the_sensors
from ehadiag.cli.simulator import make_core
from ehadiag.core.actuator import default_actuator
from ehadiag.core.recording import CommandMode
from ehadiag.core.stored_test import bundled_tests
from ehadiag_sim.plant.conditions import DataErrors, Effects, Sensors, Strangers
from firmware_iface.mapping.bus_map import default_map

FAST = ("bit", "--simulate", "--fast", "--json", "--record", "a.blf", "--test", "open")


def parsed(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser(allow_abbrev=False)
    options.add_fault_options(parser)
    return parser.parse_args([*words])


def test_every_effect_has_an_option() -> None:
    switches = [item.field for item in (*EFFECTS, *SENSORS, *STRANGERS)]
    classes = (Effects, Sensors, Strangers)
    known = {item.name for kind in classes for item in fields(kind)}
    others = {
        "data",
        "strangers",
        "plays",
        "oil_temperature",
        "supply_pressure",
        "return_pressure",
        "noise_lsb",
        "offsets_lsb",
        "gains",
    }
    assert set(switches) | others == known
    assert len(switches) == len(set(switches))
    assert set(DATA) == {item.name for item in fields(DataErrors)}


def test_without_options_there_is_no_effect() -> None:
    nothing = parsed()
    assert the_effects(nothing) == Effects()
    assert the_sensors(nothing) == Sensors()


@pytest.mark.parametrize("item", [*EFFECTS, *STRANGERS], ids=lambda item: item.option)
def test_values_are_in_the_unit_of_the_name(item) -> None:
    effects = the_effects(parsed(item.option, "0.02"))
    holder = effects.strangers if item in STRANGERS else effects
    assert getattr(holder, item.field) == pytest.approx(0.02 * item.scale)


def test_sensors_data_and_plays_arrive() -> None:
    words = "--early-ms 0.1 --supply-error-MPa -0.1 --sensor-gains 0 0.01 -0.01 0.002 --plays 8"
    arguments = parsed(*words.split(), "--data-error", "GM=0.02", "--data-error", "MJ=-0.03")
    sensors = the_sensors(arguments)
    assert sensors.gains == (0.0, 0.01, -0.01, 0.002)
    assert (sensors.early, sensors.supply_error) == pytest.approx((0.1e-3, -0.1e6))
    effects = the_effects(arguments)
    assert (effects.plays, effects.data) == (8, DataErrors(GM=0.02, MJ=-0.03))


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--hysteresis", "2"], "hysteresis: 2 is outside 0 … 1"),
        (["--plays", "0"], "plays: 0 is outside 1 … 256"),
        (["--data-error", "GM"], "--data-error GM: need NAME=FRACTION"),
        (["--data-error", "XX=1"], "--data-error XX=1: need NAME=FRACTION"),
        (["--data-error", "GM=x"], "--data-error GM=x: need NAME=FRACTION"),
        (["--early-ms", "1"], "early"),
        (["--broken", "bent-rod"], "not one of seized-spool"),
        (["--null-bias-mA", "nan"], "null_bias"),
    ],
)
def test_wrong_values_are_one_line(words, says, run) -> None:
    result = run(*FAST, *words)
    assert result.code == 2
    assert says in result.err
    assert len(result.err.strip().splitlines()) == 1


def spool_codes(*words: str) -> list[int]:
    """Of the emulated computer's actuator under a sine of 4 mA."""
    core = make_core(parsed(*words), default_actuator(), bundled_tests().values(), default_map())
    drive = 4e-3 * np.sin(0.1 * np.arange(100))
    return [int(core.plant.tick(float(x), CommandMode.CURRENT)[1]) for x in drive]


def test_options_reach_the_actuator_of_the_computer() -> None:
    plain = spool_codes()
    assert spool_codes() == plain
    for words in (
        ("--null-bias-mA", "0.2"),
        ("--data-error", "GM=0.05"),
        ("--torque-cubic", "0.3"),
    ):
        assert np.abs(np.subtract(spool_codes(*words), plain)).max() > 10
    assert np.ptp(spool_codes("--broken", "dead-spool")) < 10
