"""Watched limits: when a value or a silence ends a test, and the wording."""

from __future__ import annotations

import math

import pytest

from firmware_iface.codec.live_messages import Sample
from firmware_iface.session.limits import Limits, Watch

MS = 1_000_000
BEGIN = 1_700_000_000_000_000_000
ALL = Limits(position=0.025, pressure=20e6, current=10e-3)
SILENCE = 0.25
LOST = "telemetry lost: no {} for 0.25 s, and its limit is watched"


def sample(*brought, current=0.0, spool=0.0, pressure=0.0, position=0.0):
    """Everything is brought unless told."""
    values = (current, spool, pressure, position)
    return Sample(*values, frozenset(brought)) if brought else Sample(*values)


@pytest.fixture
def watching():
    def make(limits=ALL):
        watch = Watch(limits, SILENCE)
        watch.begin(BEGIN)
        return watch

    return make


def answers(watch, *samples, now=BEGIN):
    return [watch.on_sample(now, item) for item in samples]


def test_only_channels_with_a_limit_are_watched():
    assert list(Limits().watched()) == []
    assert dict(ALL.watched()) == {"position": 0.025, "pressure": 20e6, "current": 10e-3}
    assert list(Limits(pressure=1.0).watched()) == [("pressure", 1.0)]


@pytest.mark.parametrize(
    ("values", "why"),
    [
        ({"position": -0.02534}, "position -25.34 mm beyond its limit ±25 mm"),
        ({"pressure": 20.5e6}, "pressure 20.5 MPa beyond its limit ±20 MPa"),
        ({"current": 12.3456e-3}, "current 12.35 mA beyond its limit ±10 mA"),
    ],
)
def test_the_third_sample_in_a_row_ends_the_test(watching, values, why):
    beyond = sample(**values)
    assert answers(watching(), beyond, beyond, beyond, beyond) == ["", "", why, why]
    assert answers(watching(), beyond, beyond, sample(), beyond, beyond, beyond)[-2:] == ["", why]


def test_digits_of_a_limit_are_said_as_far_as_they_count(watching):
    watch = watching(Limits(position=0.0123456, samples=1))
    (why,) = answers(watch, sample(position=0.1))
    assert why == "position 100 mm beyond its limit ±12.35 mm"


def test_how_many_samples_may_be_told(watching):
    beyond = sample(current=-0.011)
    assert answers(watching(Limits(current=0.01, samples=1)), beyond) != [""]
    five = Limits(current=0.01, samples=5)
    assert [bool(why) for why in answers(watching(five), *[beyond] * 6)] == [False] * 4 + [True] * 2


def test_the_limit_itself_is_not_beyond(watching):
    edge = sample(position=0.025, pressure=-20e6, current=10e-3)
    assert answers(watching(), *[edge] * 5) == [""] * 5


def test_each_channel_has_its_own_count(watching):
    mixed = [sample(position=1.0), sample(position=1.0), sample(pressure=1e9), sample(current=1.0)]
    assert answers(watching(), *mixed) == [""] * 4
    both = sample(pressure=1e9, current=1.0)
    assert answers(watching(), both, both, both)[-1].startswith("pressure ")


@pytest.mark.parametrize("other", [sample("spool", position=1.0), sample(position=math.nan)])
def test_what_brings_no_value_neither_counts_nor_ends_the_count(watching, other):
    beyond = sample("position", position=1.0)
    got = answers(watching(), beyond, other, other, other, beyond, other, beyond)
    assert [bool(why) for why in got] == [False] * 6 + [True]


def test_a_channel_after_one_that_brings_nothing_is_watched_too(watching):
    """The first of the watched channels is missing, the last is beyond."""
    beyond = sample("current", current=1.0)
    assert answers(watching(), beyond, beyond, beyond)[-1].startswith("current ")


def test_spool_has_no_limit(watching):
    assert answers(watching(), *[sample(spool=1.0)] * 5) == [""] * 5


def test_silence_counts_from_the_begin_of_the_test(watching):
    watch = watching()
    assert watch.on_time(BEGIN + 250 * MS - 1) == ""
    assert watch.on_time(BEGIN + 250 * MS) == LOST.format("position")


def test_each_channel_must_keep_coming(watching):
    watch = watching()
    answers(watch, sample(), now=BEGIN + 100 * MS)
    answers(watch, sample("position", "current"), now=BEGIN + 300 * MS)
    assert watch.on_time(BEGIN + 350 * MS - 1) == ""
    assert watch.on_time(BEGIN + 350 * MS) == LOST.format("pressure")
    answers(watch, sample("pressure", pressure=math.nan), now=BEGIN + 340 * MS)
    assert watch.on_time(BEGIN + 350 * MS) == LOST.format("pressure")
    answers(watch, sample("pressure"), now=BEGIN + 340 * MS)
    assert watch.on_time(BEGIN + 549 * MS) == ""
    assert watch.on_time(BEGIN + 550 * MS) == LOST.format("position")


def test_a_sample_beyond_its_limit_is_heard_as_well(watching):
    watch = watching()
    answers(watch, sample(position=1.0), now=BEGIN + 200 * MS)
    assert watch.on_time(BEGIN + 449 * MS) == ""


def test_a_time_in_which_nobody_listened_is_no_silence(watching):
    watch = watching()
    answers(watch, sample("position"), now=BEGIN + 100 * MS)
    watch.excuse(1000 * MS)
    assert watch.on_time(BEGIN + 1249 * MS) == ""
    assert watch.on_time(BEGIN + 1250 * MS) == LOST.format("pressure")
    answers(watch, sample("pressure", "current"), now=BEGIN + 1240 * MS)
    assert watch.on_time(BEGIN + 1349 * MS) == ""
    assert watch.on_time(BEGIN + 1350 * MS) == LOST.format("position")


def test_what_nobody_watches_may_be_silent(watching):
    assert watching(Limits()).on_time(BEGIN + 10**12) == ""


def test_the_next_test_begins_anew(watching):
    watch = watching()
    beyond = sample(position=1.0)
    answers(watch, beyond, beyond)
    watch.begin(BEGIN + 1000 * MS)
    assert watch.on_time(BEGIN + 1249 * MS) == ""
    assert answers(watch, beyond, beyond, now=BEGIN + 1240 * MS) == ["", ""]
