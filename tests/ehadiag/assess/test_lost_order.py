"""Frames whose order is lost: what is refused, and what is told all the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from places import LOGS

from ehadiag.assess.diagnosis import Diagnosis, diagnose
from ehadiag.assess.unobservable import MOST_OUT_OF_ORDER, lost_order
from ehadiag.assess.verdict import Verdict
from ehadiag.core.actuator import default_actuator
from ehadiag.core.find_test import Sought, found_tests
from ehadiag.core.recording import Recording
from ehadiag.core.stored_test import bundled_tests
from firmware_iface.logs.reader import read_recording

TESTS = bundled_tests()
CHANNELS = ("current", "spool", "pressure", "position", "command")


def sorted_by_late_stamps(name: str) -> Recording:
    """Each tick's message is late by itself, by 1 ms half-normal; the log is sorted by stamps."""
    whole = read_recording(LOGS / name)
    samples = whole.samples
    assert samples is not None
    late = np.abs(np.random.default_rng(1).normal(0.0, 1.0, samples.ticks))
    order = np.argsort(np.arange(samples.ticks) + late)
    mixed = replace(samples, **{name: getattr(samples, name)[order] for name in CHANNELS})
    sought = Sought(tuple(TESTS.values()), default_actuator().controller)
    bare = replace(whole, samples=mixed, test_id=None, by_time=True)
    return found_tests(bare, sought)[0]


def diagnosed(recording: Recording) -> Diagnosis:
    return diagnose([recording], default_actuator(), TESTS.values())


@pytest.mark.slow
def test_in_open_loop_every_severity_is_left() -> None:
    mixed = sorted_by_late_stamps("paper-open-2.blf")
    assert mixed.out_of_order > MOST_OUT_OF_ORDER
    found = diagnosed(mixed)
    assert found.verdict is Verdict.NOT_TESTED
    (reason,) = found.reasons
    assert "of the commands are of other ticks (limit 1%)" in reason
    assert "lost their order, and no counter tells it: Kintas 0." in reason
    assert found.identification is not None
    truth = (0.3, 0.6, 0.3)
    for item, value in zip(found.identification.estimates, truth, strict=True):
        assert item.interval95[0] < value < item.interval95[1] < item.interval95[0] + 0.05


def test_order_counts_only_where_no_counter_tells_the_ticks() -> None:
    whole = read_recording(LOGS / "paper-open-2.blf")
    assert whole.out_of_order == 0.0
    for share, by_time, said in ((0.2, True, True), (0.2, False, False), (0.01, True, False)):
        assert bool(lost_order(replace(whole, out_of_order=share, by_time=by_time))) is said
