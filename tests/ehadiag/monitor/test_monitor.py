"""The streaming monitor against the model run on whole records, and what it does with defects.

The examples of the monitor's page run and print what the page says.
"""

from __future__ import annotations

import copy
import os
import pickle
import re
import sys
import threading
import tracemalloc
from functools import lru_cache
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from places import LOGS, ROOT

from ehadiag import CommandMode, ConfigurationError, Monitor, Tick, default_actuator
from ehadiag.identify.experiment import build_experiment
from ehadiag.model.batch import NO_ANCHOR, Anchor
from ehadiag.model.residual_models import model_response
from ehadiag_tools.simulator.units import damaged, damaged_unit
from firmware_iface.recording import CHANNELS
from firmware_iface.signals.recordings import read_recording
from firmware_iface.stored_test import resolve_test

MATCHED = {
    "healthy-open.blf": (0.0, 0.0, 0.0),
    "paper-open-2.blf": (0.3, 0.6, 0.3),
    "paper-open-4.blf": (0.6, 0.6, 0.6),
    "paper-closed-1.blf": (0.3, 0.3, 0.3),
    "paper-closed-4.blf": (0.6, 0.6, 0.6),
    "hot-worn-closed.asc": (0.2, 0.5, 0.1),
}
"""Reference recordings (PHY-41) and their true severities (truth.csv)."""
ANCHOR = Anchor(0.3, 1.3 * CHANNELS.spool.lsb, 6.0 * CHANNELS.spool.lsb)
NAN = float("nan")
NOTHING = Tick(NAN, NAN, NAN, NAN, NAN)


@lru_cache(maxsize=8)
def recorded(file):
    recording = read_recording(LOGS / file)
    s = recording.samples
    rows = zip(s.command, s.current, s.spool, s.pressure, s.position, strict=True)
    return recording, [Tick(*map(float, row)) for row in rows]


def monitor_for(file, faults, **options):
    recording, ticks = recorded(file)
    monitor = Monitor(
        default_actuator(),
        faults,
        recording.environment,
        mode=recording.samples.mode,
        **options,
    )
    return monitor, ticks


def run(monitor, ticks):
    """Predictions (n, 3), residuals (n, 2), alarms (n, 2, 2)."""
    readings = [monitor.push(tick).copy() for tick in ticks]
    return tuple(np.array([getattr(r, f) for r in readings]) for f in FIELDS)


FIELDS = ("predicted", "residual", "alarmed")


@pytest.mark.parametrize("anchor", [NO_ANCHOR, ANCHOR], ids=["free", "anchored"])
@pytest.mark.parametrize("file", sorted(MATCHED))
def test_tick_by_tick_equals_the_whole_record(file, anchor):
    """With constants that are off, so that the model is re-anchored, and sticks elsewhere."""
    faults = np.clip(np.add(MATCHED[file], (0.05, 0.1, -0.1)), 0.0, 1.0)
    monitor, ticks = monitor_for(file, faults, anchor=anchor)
    recording, _ = recorded(file)
    name = "closed" if recording.samples.mode is CommandMode.POSITION else "open"
    experiment = build_experiment(
        recording.samples, recording.environment, resolve_test(name), default_actuator()
    )
    whole = model_response(
        damaged(experiment.constants, faults),
        experiment.trace.current,
        experiment.tick,
        measured=recording.samples.spool,
        anchor=anchor,
    )
    predicted, residual, _ = run(monitor, ticks)
    assert (whole.anchored.size > 0) == (anchor is ANCHOR)
    for column, values in enumerate((whole.spool, whole.pressure, whole.position)):
        scale = np.abs(values).max()
        np.testing.assert_allclose(predicted[:, column], values, rtol=0.0, atol=1e-12 * scale)
    noise = np.sqrt(0.5**2 + 1 / 12) * np.array([CHANNELS.spool.lsb, CHANNELS.pressure.lsb])
    seen = np.column_stack([recording.samples.spool, recording.samples.pressure])
    np.testing.assert_allclose(residual, (seen - predicted[:, :2]) / noise, atol=1e-9)


def test_the_control_law_has_integral_and_derivative():
    """An actuator with a full PID: the current is what the law gives on the recorded position."""
    actuator = default_actuator()
    law = msgspec.structs.replace(actuator.controller, GAI=3.0, GAD=1e-3)
    actuator = msgspec.structs.replace(actuator, controller=law)
    rng = np.random.default_rng(0)
    command = np.repeat(rng.uniform(-8e-3, 8e-3, 20), 10)
    place = np.cumsum(rng.normal(0.0, 3e-5, 200))
    currents, integral, before = [], 0.0, None
    for k, target in enumerate(command):
        error = target - (place[k - 1] if k else target)
        slope = 0.0 if before is None else (error - before) / 1e-3
        trial, before = integral + error * 1e-3, error
        wanted = law.GAP * error + law.GAI * trial + law.GAD * slope
        out = np.clip(wanted, -law.IM, law.IM)
        if wanted == out or (wanted - out) * error < 0.0:
            integral = trial
        currents.append(out)
    monitor = Monitor(actuator, (0, 0, 0), mode=CommandMode.POSITION, anchor=NO_ANCHOR)
    ticks = [Tick(c, NAN, NAN, NAN, x) for c, x in zip(command, place, strict=True)]
    predicted, _, _ = run(monitor, ticks)
    whole = model_response(damaged_unit(np.zeros(3), actuator), np.array(currents), 1e-3)
    assert 0.1 < np.mean(np.abs(currents) == law.IM) < 0.9
    np.testing.assert_allclose(predicted[:, 0], whole.spool, atol=1e-15)


@pytest.mark.parametrize("file", sorted(MATCHED))
def test_a_matched_recording_gives_no_alarm(file):
    """A false alarm in 100 h: none in 5.5 s, though the actuator is not the monitoring model."""
    monitor, ticks = monitor_for(file, MATCHED[file])
    _, residual, alarmed = run(monitor, ticks)
    assert not alarmed.any()
    assert np.all(np.sqrt(np.mean(residual**2, axis=0)) < 1.25)


@pytest.mark.parametrize(
    ("file", "wrong", "channel", "within"),
    [
        ("paper-open-4.blf", (0.7, 0.6, 0.6), 0, 2600),
        ("paper-open-4.blf", (0.6, 0.7, 0.6), 0, 1000),
        ("paper-open-4.blf", (0.6, 0.6, 0.7), 1, 1000),
        ("paper-closed-4.blf", (0.7, 0.6, 0.6), 0, 1000),
        ("paper-closed-4.blf", (0.6, 0.7, 0.6), 0, 1000),
        ("paper-closed-4.blf", (0.6, 0.6, 0.7), 1, 1000),
    ],
)
def test_a_wrong_constant_gives_alarm(file, wrong, channel, within):
    monitor, ticks = monitor_for(file, wrong)
    _, _, alarmed = run(monitor, ticks)
    first = int(np.flatnonzero(alarmed[:, channel].any(axis=1))[0])
    assert first < within


def test_lost_samples_change_no_verdict():
    """Two per cent of the frames are lost: the residuals keep their size, no alarm."""
    monitor, ticks = monitor_for("lossy-open.blf", (0.4, 0.2, 0.5))
    lost = sum(np.isnan(tick).any() for tick in ticks)
    _, residual, alarmed = run(monitor, ticks)
    assert lost > 100
    assert not alarmed.any()
    assert np.all(np.sqrt(np.nanmean(residual**2, axis=0)) < 1.25)
    np.testing.assert_array_equal(np.isnan(residual[:, 0]), [np.isnan(t.spool) for t in ticks])


@pytest.mark.parametrize("file", ["paper-open-2.blf", "paper-closed-4.blf"])
def test_whole_ticks_may_be_lost(file):
    """A single tick of nothing, every 50 ticks."""
    monitor, ticks = monitor_for(file, MATCHED[file])
    holed = [NOTHING if k % 50 == 25 else tick for k, tick in enumerate(ticks)]
    _, residual, _ = run(monitor, holed)
    assert np.isnan(residual[25::50]).all()
    assert np.all(np.nanmedian(np.abs(residual), axis=0) < 0.8)


def test_a_lost_sample_leaves_the_sums():
    monitor, ticks = monitor_for("healthy-open.blf", (0.0, 0.0, 0.0))
    for tick in ticks[:500]:
        before = monitor.push(tick).copy()
    after = monitor.push(NOTHING)
    assert before.cusum.any()
    np.testing.assert_array_equal(after.cusum, before.cusum)


values = st.one_of(
    st.floats(-1e9, 1e9), st.just(NAN), st.just(np.inf), st.just(-np.inf), st.integers(-9, 9)
)


@settings(max_examples=60)
@given(
    st.lists(st.tuples(values, values, values, values, values), max_size=40),
    st.sampled_from(CommandMode),
)
def test_no_sample_breaks_the_model(samples, mode):
    actuator = default_actuator()
    monitor = Monitor(actuator, (0.2, 0.4, 0.6), mode=mode)
    for sample in samples:
        reading = monitor.push(Tick(*sample))
        assert np.isfinite(reading.predicted).all()
        assert np.isfinite(reading.cusum).all()
        assert (reading.cusum >= 0.0).all()
        assert abs(reading.predicted[0]) <= actuator.servovalve.XSM
        assert abs(reading.predicted[1]) <= actuator.servovalve.PSR


def test_push_keeps_no_memory():
    monitor, ticks = monitor_for("paper-open-2.blf", MATCHED["paper-open-2.blf"])
    pushed = ticks * 19
    assert len(pushed) > 100_000
    for tick in ticks:
        monitor.push(tick)
    tracemalloc.start()
    try:
        for tick in pushed[:100]:
            monitor.push(tick)
        before, _ = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        for tick in pushed:
            monitor.push(tick)
        after, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert abs(after - before) < 512
    # What one call's arguments take while it lasts; nothing that grows.
    assert peak - before < 2048


@pytest.mark.skipif(sys.platform != "linux", reason="reads the size of the process as on Linux")
def test_hours_of_pushes_leave_the_process_as_it_was():
    """What compiled code allocates no Python tool sees: the process itself must not grow."""
    monitor, ticks = monitor_for("paper-closed-4.blf", MATCHED["paper-closed-4.blf"])
    page = os.sysconf("SC_PAGE_SIZE")

    def push_all(times):
        for _ in range(times):
            for tick in ticks:
                monitor.push(tick)
        return int(Path("/proc/self/statm").read_text().split()[1]) * page

    before = push_all(20)
    # 16 bytes left behind by each of a million pushes would be 16 MB.
    assert push_all(180) - before < 2_000_000


def test_another_thread_may_push():
    """The receive thread pushes while this one runs Python: the answer is the same."""
    monitor, ticks = monitor_for("paper-closed-1.blf", MATCHED["paper-closed-1.blf"])
    alone, _, _ = run(monitor, ticks)
    monitor.reset()
    out = []
    thread = threading.Thread(target=lambda: out.append(run(monitor, ticks)))
    thread.start()
    while thread.is_alive():
        sum(range(1000))
    thread.join()
    np.testing.assert_array_equal(out[0][0], alone)


def test_readings_cannot_be_written():
    monitor, ticks = monitor_for("healthy-open.blf", (0.0, 0.0, 0.0))
    reading = monitor.push(ticks[0])
    assert reading is monitor.reading
    with pytest.raises(ValueError, match="read-only"):
        reading.cusum[0, 0] = 0.0


class Unreadable:
    def __float__(self):
        raise KeyError("no number")


@pytest.mark.parametrize(
    "sample",
    [(1.0,) * 4, (1.0,) * 6, (None,) * 5, None, ("one",) * 5, (1.0,) * 4 + (Unreadable(),)],
)
def test_what_is_no_tick_leaves_the_monitor(sample):
    monitor, ticks = monitor_for("healthy-open.blf", (0.0, 0.0, 0.0))
    for tick in ticks[:300]:
        before = monitor.push(tick).copy()
    with pytest.raises(TypeError, match="tuple of five numbers"):
        monitor.push(sample)
    for name in ("predicted", "residual", "cusum"):
        np.testing.assert_array_equal(getattr(monitor.reading, name), getattr(before, name))


def test_what_float_takes_is_a_number():
    """To look at types would cost every push its time (docs/how-to/monitor.md)."""
    monitor, ticks = monitor_for("healthy-open.blf", (0.0, 0.0, 0.0))
    numbers = monitor.push(ticks[300]).copy()
    monitor.reset()
    texts = monitor.push(tuple(str(float(value)) for value in ticks[300]))
    np.testing.assert_array_equal(texts.predicted, numbers.predicted)
    np.testing.assert_array_equal(texts.residual, numbers.residual)


@pytest.mark.parametrize("place", [-2e-4, 1e-6, 1.2e-5, 3e-4, 1.0])
def test_a_reset_puts_the_spool_at_rest_there(place):
    """Near its centre friction holds it, further out the feedback wire takes it away."""
    actuator, faults = default_actuator(), (0.2, 0.4, 0.6)
    monitor = Monitor(actuator, faults, anchor=NO_ANCHOR)
    monitor.reset(place)
    predicted, _, _ = run(monitor, [Tick(0.0, 0.0, NAN, NAN, NAN)] * 100)
    origin = min(place, actuator.servovalve.XSM)
    whole = model_response(damaged_unit(faults, actuator), np.zeros(100), 1e-3, origin=origin)
    assert (np.ptp(whole.spool) > 0.0) == (abs(place) > 1.5e-5)
    np.testing.assert_allclose(predicted[:, 0], whole.spool, rtol=1e-12, atol=1e-18)
    np.testing.assert_allclose(predicted[:, 1], whole.pressure, rtol=1e-9, atol=1.0)


@pytest.mark.parametrize("way", [copy.copy, copy.deepcopy, pickle.dumps])
def test_a_monitor_cannot_be_copied(way):
    """The copy would write into the memory of the first, which may be gone by then."""
    with pytest.raises(TypeError, match="cannot be copied"):
        way(Monitor(default_actuator(), (0.0, 0.0, 0.0)))


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"faults": (0.1, 0.2)}, "Kintas"),
        ({"faults": (0.1, 0.2, 1.1)}, "Kintas"),
        ({"faults": (0.1, 0.2, NAN)}, "Kintas"),
        ({"noise": (0.0, 1.0)}, "noise"),
        ({"offsets": (NAN, 0.0)}, "offsets"),
        ({"hours": 0.0}, "hours"),
        ({"shift": 99.0}, "shift"),
    ],
)
def test_bad_values_are_told(options, word):
    options = {"faults": (0.1, 0.2, 0.3), **options}
    faults = options.pop("faults")
    with pytest.raises(ConfigurationError, match=word) as caught:
        Monitor(default_actuator(), faults, **options)
    assert "\n" not in str(caught.value)


def test_the_mode_can_change_between_two_ticks():
    """From the change on the commands are currents: as a monitor of that mode, from rest."""
    monitor = Monitor(default_actuator(), (0.2, 0.3, 0.1), mode=CommandMode.POSITION)
    other = Monitor(default_actuator(), (0.2, 0.3, 0.1), mode=CommandMode.CURRENT)
    for _ in range(5):
        monitor.push(Tick(0.0, 0.0, 0.0, 0.0, 0.0))
        other.push(Tick(0.0, 0.0, 0.0, 0.0, 0.0))
    monitor.follow(CommandMode.CURRENT)
    for command in (1e-3, 2e-3, NAN, 2e-3):
        tick = Tick(command, NAN, NAN, NAN, 0.0)
        ours, theirs = monitor.push(tick).copy(), other.push(tick).copy()
        np.testing.assert_array_equal(ours.predicted, theirs.predicted)
    monitor.follow(CommandMode.POSITION)
    monitor.push(Tick(0.0, NAN, NAN, NAN, 0.0))
    assert monitor.push(Tick(0.0, NAN, NAN, NAN, 0.0)).predicted[0] < ours.predicted[0]


PAGE = ROOT / "docs" / "how-to" / "monitor.md"
EXAMPLES = re.findall(
    r"```python\n(.*?)```.*?```\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL
)


def test_the_page_has_its_examples():
    assert len(EXAMPLES) == 2


@pytest.mark.parametrize(("example", "expected"), EXAMPLES, ids=["pushed", "decoded"])
def test_example_prints_what_the_page_says(example, expected, capsys):
    exec(compile(example, str(PAGE), "exec"), {})
    assert capsys.readouterr().out == expected
