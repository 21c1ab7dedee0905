"""Random units, their recordings, and the tables of units that somebody else recorded."""

from dataclasses import asdict, fields

import numpy as np
import pytest

from ehadiag.core.actuator import default_actuator
from ehadiag_sim.conditions import DataErrors, Effects, Faults, UnmodelledEffects
from ehadiag_sim.simulation import bus_command
from ehadiag_tools.main import main
from ehadiag_tools.simulator.units import (
    STRANGE_SIZES,
    Unit,
    random_unit,
    read_units,
    record,
    replay,
    residuals,
)
from firmware_iface.errors import ConfigurationError
from firmware_iface.recording import CHANNELS
from firmware_iface.stored_test import bundled_tests

ACTUATOR = default_actuator()
TESTS = bundled_tests()
EVERYTHING = {"data": True, "sensing": True, "friction": True, "orifice": True, "strangers": True}


def unit(seed, **groups):
    return random_unit(np.random.default_rng(seed), **groups)


def test_usual_sizes_are_used_to_their_ends_and_not_beyond():
    units = [unit(seed, **EVERYTHING) for seed in range(300)]

    def spread(values, low, high):
        values = np.array(values)
        assert values.min() >= low
        assert values.max() <= high
        assert values.max() - values.min() > 0.9 * (high - low)

    spread([u.effects.null_bias for u in units], -0.2e-3, 0.2e-3)
    spread([u.effects.hysteresis for u in units], 0.0, 0.04)
    spread([u.effects.gain_change for u in units], -0.05, 0.05)
    spread([u.effects.backlash for u in units], 0.0, 5e-6)
    for channel in range(4):
        spread([u.sensors.offsets_lsb[channel] for u in units], -20.48, 20.48)
    for item in fields(DataErrors):
        spread([getattr(u.effects.data, item.name) for u in units], -0.05, 0.05)
    spread([u.sensors.early for u in units], 0.0, 0.2e-3)
    spread([u.actuator.second_stage.beta for u in units], 6e8, 9e8)
    spread(np.log([u.effects.spool_stribeck for u in units]), np.log(1e-3), np.log(50e-3))
    for name in STRANGE_SIZES:
        share = np.mean([getattr(u.effects.unmodelled, name) != 0.0 for u in units])
        assert 0.4 < share < 0.6
    of_valves = {"underlap_errors", "spool_end_volume"}  # drawn by the study of valves
    assert set(STRANGE_SIZES) | of_valves == {item.name for item in fields(UnmodelledEffects)}


@pytest.mark.parametrize("group", EVERYTHING)
def test_switching_a_group_on_does_not_change_the_others(group):
    plain, more = unit(4), unit(4, **{group: True})
    assert more != plain
    for name in ("null_bias", "hysteresis", "gain_change", "backlash"):
        assert getattr(more.effects, name) == getattr(plain.effects, name)
    assert more.sensors.offsets_lsb == plain.sensors.offsets_lsb
    everything = unit(4, **EVERYTHING)
    if group == "data":
        assert everything.effects.data == more.effects.data


def test_a_recording_is_what_the_unit_gives():
    item = unit(1, sensing=True, serial=77)
    first = record(item, TESTS["closed"], Faults(0.1, 0.2, 0.3), seed=5, step=1e-5)
    again = record(item, TESTS["closed"], Faults(0.1, 0.2, 0.3), seed=5, step=1e-5)
    np.testing.assert_array_equal(first.samples.pressure, again.samples.pressure)
    assert first.serial == 77
    assert first.samples.ticks == TESTS["closed"].ticks
    hot = record(
        item, TESTS["closed"], seed=5, step=1e-5, oil_temperature=70.0, supply_pressure=19e6
    )
    off = item.sensors
    assert hot.environment.oil_temperature == pytest.approx(70.0 + off.temperature_error, abs=0.051)
    assert hot.environment.supply_pressure == pytest.approx(19e6 + off.supply_error, abs=5.1e3)


@pytest.mark.parametrize(("test", "seed"), [("open", 8), ("closed", 2)])
def test_replay_of_a_unit_leaves_the_noise_floor(test, seed):
    item = unit(seed, **EVERYTHING)
    faults = Faults(0.3, 0.2, 0.5)
    recording = record(item, TESTS[test], faults, seed=3, step=1e-5)
    gap = residuals(
        item.actuator,
        recording.samples,
        bus_command(TESTS[test]),
        faults,
        item.effects,
        1e-5,
        item.sensors,
    )
    floor = np.sqrt(0.5**2 + 1 / 12)
    np.testing.assert_allclose(np.sqrt((gap**2).mean(axis=1)), floor, rtol=0.04)


def test_replay_without_the_effects_does_not():
    item = unit(2)
    recording = record(item, TESTS["open"], seed=3, step=1e-5)
    command = bus_command(TESTS["open"])
    truth = replay(ACTUATOR, recording.samples, command, Faults(), Effects(), 1e-5)
    assert np.abs(truth[1] - recording.samples.spool).max() > 10 * CHANNELS[1].lsb


TABLE = """unit,effect,value,unit of value
A,current offset,0.06,mA
A,position offset,-0.3,mm
A,torque motor gain,1.031,of GM
A,hysteresis,0.022,"of IM, full width"
A,backlash half-width,1.4e-06,m
A,null bias,0.11,mA
A,number of plays,12,1
B,GM,2.961,SI
B,FDJ0,145.5,SI
B,analogue filter time constant,8e-05,s
B,Stribeck velocity spool,0.02,m/s
B,Stribeck velocity jack,0.004,m/s
C,second stage,2,2 = orifice
C,bulk modulus,740000000.0,Pa
"""


def test_table_of_recorded_units(tmp_path):
    path = tmp_path / "truth-effects.csv"
    path.write_text(TABLE)
    units = read_units(path, ACTUATOR)
    assert list(units) == ["A", "B", "C"]
    a = units["A"]
    assert a.sensors.offsets_lsb == pytest.approx((10.24, 0.0, 0.0, -10.24))
    assert a.effects.gain_change == pytest.approx(0.031)
    assert (a.effects.hysteresis, a.effects.plays) == (0.022, 12)
    assert a.effects.null_bias == pytest.approx(0.11e-3)
    assert a.effects.backlash == 1.4e-6
    b = units["B"]
    assert asdict(b.effects.data) == pytest.approx(
        asdict(DataErrors(GM=0.05, FDJ0=-0.03)), abs=1e-12
    )
    assert b.sensors.filter_time == 8e-5
    assert (b.effects.spool_stribeck, b.effects.jack_stribeck) == (0.02, 0.004)
    stage = units["C"].actuator.second_stage
    assert (stage.kind, stage.beta) == ("orifice", 7.4e8)
    assert units["C"].actuator.servovalve == ACTUATOR.servovalve


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("A,rust,1", "effect 'rust'"),
        ("A,hysteresis,7", "hysteresis: 7 is outside"),
        ("A,hysteresis,much", "value 'much' is not a number"),
        ("A,hysteresis", "value None is not a"),
    ],
)
def test_what_no_unit_has_is_refused(tmp_path, row, words):
    path = tmp_path / "truth-effects.csv"
    path.write_text(f"unit,effect,value\n{row}\n")
    with pytest.raises(ConfigurationError, match=words):
        read_units(path, ACTUATOR)


def test_recordings_leave_out_units_without_effects(tmp_path, capsys):
    (tmp_path / "truth.csv").write_text("file,unit,test,Kintas,FSS,FDJ\nd.blf,D,open,0,0,0\n")
    (tmp_path / "truth-effects.csv").write_text("unit,effect,value\nA,hysteresis,0.01\n")
    assert main(["recordings", str(tmp_path), "--resume", str(tmp_path / "kept.jsonl")]) == 0
    assert "d.blf" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("study", "table"),
    [("paper --recordings", "truth"), ("recorded-units --recordings", "truth"),
     ("foreign-buses", "truth"), ("recordings", "truth"), ("recordings", "truth-effects")],
)  # fmt: skip
def test_a_table_without_a_column_ends_in_one_line(tmp_path, capsys, study, table):
    (tmp_path / "truth.csv").write_text("file,test,Kintas,FSS,FDJ\n")
    (tmp_path / f"{table}.csv").write_text("file,test,unit,effect,FSS,FDJ\n")
    assert main([*study.split(), str(tmp_path)]) == ConfigurationError.exit_code
    lacking = "Kintas" if table == "truth" else "value"
    said = f"{study.split()[0]}: {tmp_path / table}.csv: without column {lacking}\n"
    assert capsys.readouterr().err == said


def test_default_unit_is_the_textbooks():
    assert Unit() == Unit(ACTUATOR, Effects())
