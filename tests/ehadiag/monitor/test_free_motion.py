"""The monitor between tests: silent where nothing can be told, and not elsewhere.

The monitor in a receive thread gets every tick, in order. Design of the CUSUM against published
tables and against white noise.
"""

from __future__ import annotations

import math
import re
import subprocess
import sys

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from places import ROOT

from ehadiag import CommandMode, ConfigurationError, Monitor, Tick, default_actuator
from ehadiag.model.batch import NO_ANCHOR
from ehadiag.model.plant import SLIP_TICKS
from ehadiag.monitor.plan import CUSUM_COUNT, CusumDesign, design_cusum, mean_run_length
from ehadiag.monitor.streaming import (
    SETTLING_TICKS,
    FreeMotionMonitor,
    undecided_spool,
    undecided_travel,
)
from ehadiag_sim.conditions import Faults
from ehadiag_sim.simulation import Plant
from ehadiag_tools.free_motion.motion import Motion, free_motion
from firmware_iface.codec import Encoder
from firmware_iface.live_decode import LiveTicks
from firmware_iface.recording import CHANNELS
from firmware_iface.stored_test import resolve_test
from firmware_iface.transport.adapters import BusOptions
from firmware_iface.transport.base import Receiver
from firmware_iface.transport.python_can import PythonCanTransport

ACTUATOR = default_actuator()
WORN = (0.3, 0.3, 0.3)


def monitor_of(faults, mode, hours=0.5):
    inner = Monitor(ACTUATOR, faults, mode=mode, hours=hours)
    return FreeMotionMonitor(inner, undecided_spool(ACTUATOR, faults[2]))


def alarms_of(monitor, rows):
    found = []
    for tick, row in enumerate(rows.tolist()):
        reading = monitor.push(tuple(row))
        if monitor.settled and reading.alarmed.any():
            found.append(tick)
    return found


@pytest.mark.parametrize("mode", list(CommandMode))
def test_free_motion_of_a_known_unit_gives_no_alarm_and_that_of_a_changed_one_does(mode):
    """Four seconds: an alarm in half an hour is not to be met with."""
    motion = Motion("steps", mode.name.lower(), 4.0, WORN, 1)
    same = free_motion(ACTUATOR, motion).rows
    assert alarms_of(monitor_of(WORN, mode), same) == []
    assert alarms_of(monitor_of((0.3, 0.3, 0.6), mode), same)


def held(seconds, seed=0):
    """A worn unit that is held in the middle, where the jack sticks and slides by turns."""
    plant = Plant(ACTUATOR, Faults(*WORN), seed=seed)
    lsb = np.array([12e-3, 0.5e-3, 25e6, 60e-3]) / 2048
    rows = []
    for tick in range(round(seconds * 1000)):
        command = 2e-3 if tick < 300 else 0.0
        codes = plant.tick(command, CommandMode.POSITION)
        rows.append([command, *((codes - 2048) * lsb)])
    return np.array(rows)


@pytest.mark.parametrize(
    ("share", "lost", "counts"), [(0.5, False, False), (2.0, False, True), (2.0, True, False)]
)
def test_the_pressure_of_a_jack_that_slips_on_oil_does_not_count(share, lost, counts):
    stage = msgspec.structs.replace(ACTUATOR.second_stage, kind="orifice")
    actuator = msgspec.structs.replace(ACTUATOR, second_stage=stage)
    travel = undecided_travel(actuator, WORN[2])
    monitor = FreeMotionMonitor(Monitor(actuator, WORN), 0.0, travel=travel)
    step = share * travel / SLIP_TICKS
    places = [step * k for k in range(2 * SLIP_TICKS)]
    if lost:
        places[-1] = math.nan
    seen = [monitor.push((0.0, 0.0, 1e-4, 1e6, place)).residual[1] for place in places]
    assert np.isfinite(seen[-1]) == counts
    assert not np.isfinite(seen[:SLIP_TICKS]).any()
    assert undecided_travel(ACTUATOR, WORN[2]) == 0.0, "without oil nothing rings"


def test_the_pressure_says_nothing_while_the_surface_is_held():
    monitor = monitor_of(WORN, CommandMode.POSITION)
    rests = [np.isnan(monitor.push(tuple(row)).residual[1]) for row in held(2.0).tolist()]
    assert np.mean(rests[1500:]) > 0.25
    assert np.mean(rests[20:250]) < 0.1


def test_what_friction_hides_grows_with_it_and_is_never_less_than_some_steps():
    sizes = [undecided_spool(ACTUATOR, severity) for severity in (0.0, 0.5, 1.0)]
    assert sizes == sorted(sizes)
    assert sizes[0] > 3.0 * CHANNELS.spool.lsb
    assert sizes[-1] < 0.01 * ACTUATOR.servovalve.XSM


def test_a_spool_that_rests_beside_the_middle_is_found_while_the_monitor_settles():
    """It is half a step beside the noisy sample that the monitor began with."""
    rng = np.random.default_rng(1)
    place, lsb = 0.5 * CHANNELS.spool.lsb, CHANNELS.spool.lsb
    monitor = monitor_of((0.0, 0.9, 0.0), CommandMode.CURRENT)
    monitor.reset(-lsb)
    residuals = []
    for _ in range(2 * SETTLING_TICKS):
        spool = np.rint((place + 0.5 * lsb * rng.standard_normal()) / lsb) * lsb
        reading = monitor.push((0.0, 0.0, spool, 0.0, 0.0))
        residuals.append(float(reading.residual[0]))
        assert not (monitor.settled and reading.alarmed.any())
    assert abs(np.mean(residuals[SETTLING_TICKS:])) < 0.3


def test_settling_counts_only_ticks_with_a_sample():
    monitor = monitor_of((0.0, 0.0, 0.0), CommandMode.CURRENT)
    nan = float("nan")
    for _ in range(2 * SETTLING_TICKS):
        monitor.push((0.0, nan, nan, nan, nan))
    assert not monitor.settled
    for _ in range(SETTLING_TICKS):
        monitor.push((0.0, 0.0, 0.0, 0.0, 0.0))
    assert monitor.settled
    monitor.settle()
    assert not monitor.settled


FAULTS = (0.3, 0.3, 0.3)
TICKS = 1500


def test_residuals_on_a_virtual_bus_are_noise():
    """One tick is left out on the bus: the monitor is told, and goes on."""
    live = LiveTicks()
    monitor = Monitor(default_actuator(), FAULTS, mode=CommandMode.POSITION)
    residuals, alarms = [], 0

    def watch(frame):
        nonlocal alarms
        for tick in live.take(frame):
            reading = monitor.push(tick)
            residuals.append(reading.residual.copy())
            alarms += int(reading.alarmed.sum())

    plant, encoder = Plant(default_actuator(), Faults(*FAULTS), seed=3), Encoder()
    options = BusOptions("virtual", channel="monitor-live")
    with (
        PythonCanTransport(options) as bus,
        PythonCanTransport(options, transmit=True) as other,
        Receiver(bus, sink=watch) as source,
    ):
        for k, command in enumerate(resolve_test("closed").command()[:TICKS].tolist()):
            frames = encoder.command(CommandMode.POSITION, command, 0, 0)
            frames += encoder.telemetry(plant.tick(command, CommandMode.POSITION).tolist(), 0)
            for frame in frames if k != 700 else ():
                other.send(frame)
        received = 0
        while received < 2 * (TICKS - 1) and source.receive(5.0) is not None:
            received += 1
    assert (len(residuals), live.lost, live.breaks) == (TICKS, 1, 0)
    assert np.isnan(residuals[700]).all()
    assert alarms == 0
    np.testing.assert_allclose(np.sqrt(np.nanmean(np.square(residuals), axis=0)), 1.0, atol=0.15)


@pytest.mark.slow
def test_the_soak_accounts_for_every_frame(tmp_path):
    loopnet = str(ROOT / "tools" / "loopnet.sh")
    if subprocess.run([loopnet, "true"], capture_output=True, check=False).returncode == 125:
        pytest.skip("no network namespace can be made here")
    report = tmp_path / "soak.md"
    command = [loopnet, sys.executable, str(ROOT / "tools" / "study"), "soak"]
    options = ["-i", "udp_multicast", "--minutes", "0.05", "--output", str(report), "--diagnose"]
    done = subprocess.run(
        [*command, *options], capture_output=True, text=True, timeout=300, check=False, cwd=ROOT
    )
    assert report.is_file(), done.stderr
    rows = {
        name.strip(): [float(number) for number in re.findall(r"[\d.]+(?:e[+-]\d+)?", value)]
        for name, value in re.findall(r"^\| (.+?) \| (.+?) \|$", report.read_text(), re.MULTILINE)
    }
    first = {name: values[0] for name, values in rows.items() if values}
    sent, received, queued = (first[name] for name in ("sent", "received", "dropped_by_queue"))
    lost = first["own_lost"] + first["foreign_lost"]
    assert done.returncode == (1 if lost else 0)
    assert sent == received + lost > 2000
    assert first["recorded"] == received + queued
    assert lost <= first["dropped_by_kernel"] + queued
    assert first["pushes"] + first["ticks_lost"] <= received / 2
    assert first["alarms"] == 0
    assert first["diagnoses"] > 0
    assert first["rss_end"] > 0
    for name in ("age_us", "push_us", "work_us"):
        assert rows[name][0] > 0.0
        assert rows[name] == sorted(rows[name])


@pytest.mark.parametrize(("threshold", "length"), [(4.0, 168.0), (5.0, 465.0)])
def test_run_length_of_the_literature(threshold, length):
    """Two-sided, k = 0.5: Montgomery, Introduction to Statistical Quality Control, table 9.3."""
    two_sided = mean_run_length(CusumDesign(0.5, threshold)) / 2.0
    assert two_sided == pytest.approx(length, rel=0.02)


@given(st.floats(1.0, 1e6), st.floats(0.2, 4.0), st.floats(1e-4, 1e-2))
def test_design_meets_the_rate(hours, shift, tick):
    design = design_cusum(hours, tick, shift)
    assert design.reference == shift / 2.0
    assert mean_run_length(design) * tick / CUSUM_COUNT == pytest.approx(hours * 3600.0, rel=1e-6)


def test_no_threshold_for_a_rate_too_high():
    with pytest.raises(ConfigurationError, match="no threshold"):
        design_cusum(1e-4, 0.1, 5.0)


def count_alarms(mean_ticks, pushes, seed, shift=1.0):
    """Alarms of a monitor on an actuator at rest; its sensors show white noise of known size."""
    noise = CHANNELS.spool.lsb, CHANNELS.pressure.lsb
    monitor = Monitor(
        default_actuator(),
        (0.0, 0.0, 0.0),
        hours=mean_ticks * 1e-3 / 3600.0,
        shift=shift,
        noise=noise,
        anchor=NO_ANCHOR,
    )
    rng = np.random.default_rng(seed)
    alarms = np.zeros((2, 2), dtype=int)
    for _ in range(pushes // 10_000):
        spool, pressure = (rng.standard_normal((10_000, 2)) * noise).T.tolist()
        for x, p in zip(spool, pressure, strict=True):
            alarmed = monitor.push(Tick(0.0, 0.0, x, p, 0.0)).alarmed
            if alarmed.any():
                alarms += alarmed
    return alarms


def test_false_alarms_come_at_about_the_stated_rate():
    alarms = count_alarms(1000, 200_000, seed=1)
    assert alarms.sum() == pytest.approx(200, rel=0.35)  # 5 standard deviations
    assert (alarms > 20).all()


@pytest.mark.slow
@pytest.mark.parametrize("shift", [0.5, 1.0, 2.0])
def test_false_alarms_come_at_the_stated_rate(shift):
    """About 1500 alarms, each sum its quarter: 2.6 % by chance, some per cent by Siegmund."""
    alarms = count_alarms(1000, 1_500_000, seed=2, shift=shift)
    assert alarms.sum() == pytest.approx(1500, rel=0.15)
    np.testing.assert_allclose(alarms / alarms.sum(), 0.25, atol=0.05)
