"""Broken hardware: every kind shows, is seeded, and strikes what its name says."""

import numpy as np
import pytest
from places import ROOT

from ehadiag import ConfigurationError, bundled_tests, default_actuator
from ehadiag_sim import sensing
from ehadiag_sim.broken_hardware import HARDWARE_FAULTS, Hardware, break_hardware, simulate_broken
from ehadiag_sim.conditions import Effects, Faults, Sensors
from ehadiag_sim.emulator import FccCore
from ehadiag_sim.simulation import simulate
from firmware_iface.recording import CHANNELS

ACTUATOR = default_actuator()
TESTS = bundled_tests()
COARSE = 10e-6
LSB = np.array([[channel.lsb] for channel in CHANNELS])
FLOOR = np.sqrt(0.5**2 + 1 / 12)
WHOLE = Hardware(ACTUATOR, Effects(), Sensors())


def of_plant(kind):
    return not break_hardware(kind, np.random.default_rng(0), WHOLE).channel_faults


def rows(recording):
    s = recording.samples
    return np.vstack([s.current, s.spool, s.pressure, s.position]) / LSB


@pytest.fixture(scope="module")
def whole():
    run = simulate(ACTUATOR, TESTS["open"], seed=99, step=COARSE)
    return rows(run.recording("whole"))


def test_there_are_kinds_enough():
    assert len(HARDWARE_FAULTS) >= 22
    assert sum(item.hidden for item in HARDWARE_FAULTS.values()) <= len(HARDWARE_FAULTS) // 4


@pytest.mark.parametrize("kind", HARDWARE_FAULTS)
def test_every_kind_shows_unless_it_may_be_hidden(kind, whole):
    gap = (
        rows(simulate_broken(kind, np.random.default_rng(5), ACTUATOR, TESTS["open"], step=COARSE))
        - whole
    )
    rms = np.sqrt((gap**2).mean(axis=1))
    if not HARDWARE_FAULTS[kind].hidden:
        assert rms.max() > 1.3 * np.sqrt(2.0) * FLOOR
    if not of_plant(kind):
        struck = [index for index, c in enumerate(CHANNELS) if c.name in kind.split("-")]
        others = np.delete(rms, struck)
        np.testing.assert_allclose(others, np.sqrt(2.0) * FLOOR, rtol=0.05)


@pytest.mark.parametrize("kind", ["loose-spool", "foamed-oil", "swapped-spool-pressure"])
def test_same_generator_same_damage(kind):
    def once(seed):
        rng = np.random.default_rng(seed)
        return rows(simulate_broken(kind, rng, ACTUATOR, TESTS["open"], step=COARSE))

    np.testing.assert_array_equal(once(3), once(3))
    assert (once(3) != once(4)).any()


def test_a_dead_jack_sensor_drives_the_surface_to_its_stop():
    run = simulate(
        ACTUATOR,
        TESTS["closed"],
        sensors=Sensors(noise_lsb=0.0),
        step=COARSE,
        channel_faults=[sensing.DeadSensor(3, 0.0)],
    )
    assert np.abs(run.position).max() == ACTUATOR.jack.XJM
    assert (run.codes[3] == 2048).all()


def test_unknown_kind_is_refused_with_the_list():
    with pytest.raises(ConfigurationError, match="not one of seized-spool"):
        break_hardware("bent-rod", np.random.default_rng(0), WHOLE)


def test_the_units_own_effects_stay():
    unit = Hardware(ACTUATOR, Effects(hysteresis=0.02), Sensors(gains=(0.0, 0.01, 0.0, 0.0)))
    item = break_hardware("starved", np.random.default_rng(1), unit)
    assert item.effects.hysteresis == 0.02
    assert item.sensors.gains == unit.sensors.gains
    probe = item.effects.supply_pressure + item.sensors.supply_error
    assert probe == pytest.approx(20.7e6)
    assert item.effects.supply_pressure < 11e6


def test_each_test_of_the_computer_begins_with_fresh_damage():
    """A sensor that freezes after 0.3 s does so in the second test too."""
    frozen = sensing.FrozenSensor(1, 300)
    core = FccCore(
        ACTUATOR, TESTS.values(), channel_faults=[frozen], sensors=Sensors(noise_lsb=0.0)
    )
    first, second = core._fresh_plant(), core._fresh_plant()
    from ehadiag import CommandMode

    for plant in (first, second):
        codes = [int(plant.tick(8e-3, CommandMode.CURRENT)[1]) for _ in range(8)]
        assert len(set(codes)) > 1
    assert frozen._held is None


def channel_after(fault, ticks=200):
    """Readings of all channels, half ranges, of a ramp through 200 ticks."""
    out = []
    for tick in range(ticks):
        values = [0.001 * (index + 1) * tick * c.full_scale for index, c in enumerate(CHANNELS)]
        fault(tick, values, CHANNELS)
        out.append([value / c.full_scale for value, c in zip(values, CHANNELS, strict=True)])
    return np.array(out).T


RAMP = np.outer([0.001, 0.002, 0.003, 0.004], np.arange(200))


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (sensing.DeadSensor(1, -1.0), np.full(200, -1.0)),
        (sensing.ScaledSensor(1, -1.0), -RAMP[1]),
        (sensing.DriftingSensor(1, 0.01), RAMP[1] + 0.01 * np.arange(200)),
        (sensing.FrozenSensor(1, 50), np.minimum(RAMP[1], RAMP[1, 50])),
        (sensing.LateSensor(1, 10), np.maximum(RAMP[1] - 0.02, 0.0)),
        (sensing.LooseContact(1, 20, 5), np.where(np.arange(200) % 20 < 5, 0.0, RAMP[1])),
        (
            sensing.SpikingSensor(1, 100, 0.5),
            RAMP[1]
            + np.where(np.arange(200) == 99, -0.5, 0)
            + np.where(np.arange(200) == 199, 0.5, 0),
        ),
        (sensing.MainsHum(1, 0.05, 0.1), RAMP[1] + 0.1 * np.sin(0.1 * np.pi * np.arange(200))),
    ],
)
def test_each_damage_does_what_its_name_says(fault, expected):
    got = channel_after(fault)
    np.testing.assert_allclose(got[1], expected, atol=1e-12)
    np.testing.assert_allclose(got[[0, 2, 3]], RAMP[[0, 2, 3]], atol=1e-12)


def test_swapped_wires_exchange_shares_of_range():
    got = channel_after(sensing.SwappedWires(1, 3))
    np.testing.assert_allclose(got, RAMP[[0, 3, 2, 1]], atol=1e-12)


def test_lost_bits_round():
    got = channel_after(sensing.LostLowBits(2, 64))[2]
    np.testing.assert_allclose(got * 32.0, np.round(got * 32.0), atol=1e-9)
    assert np.abs(got - RAMP[2]).max() <= 1.0 / 64.0 + 1e-9


@pytest.mark.parametrize("kind", [kind for kind in HARDWARE_FAULTS if of_plant(kind)])
def test_damage_goes_with_any_wear_and_loop(kind):
    recording = simulate_broken(
        kind, np.random.default_rng(8), ACTUATOR, TESTS["closed"], Faults(0.5, 0.5, 0.5), step=20e-6
    )
    assert np.isfinite(rows(recording)).all()
    assert kind in recording.source


def test_every_kind_is_documented():
    page = (ROOT / "docs/reference/broken-hardware.md").read_text()
    rows = {
        name.strip().strip("`"): line.rsplit("|", 2)[1].strip() == "yes"
        for line in page.splitlines()
        if line.startswith("| `")
        for name in line.split("|")[1].split(",")
    }
    found = {}
    for kind, item in HARDWARE_FAULTS.items():
        pattern = kind if of_plant(kind) or "swapped" in kind else kind.split("-")[0] + "-CHANNEL"
        assert rows[pattern] == item.hidden, kind
        found[pattern] = True
    assert set(found) == set(rows)
