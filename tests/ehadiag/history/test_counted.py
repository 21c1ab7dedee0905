"""Which diagnoses of a history count."""

from __future__ import annotations

from dataclasses import replace

import pytest
from history_cases import an_entry
from hypothesis import given
from hypothesis import strategies as st

from ehadiag.history.counted import counted
from ehadiag.history.records import Entry, Source, Usage


def of(*names: str, number: int = 0, hours: float | None = None) -> Entry:
    sources = tuple(Source(f"{name}.blf", None, name) for name in names)
    return an_entry(sources=sources, number=number, usage=Usage(hours))


def test_a_recording_diagnosed_again_counts_once() -> None:
    entries = [of("a", number=1), of("b", number=2), of("a", number=3)]
    assert [item.number for item in counted(entries)] == [2, 3]


def test_hours_that_only_the_first_diagnosis_was_told_are_kept() -> None:
    (found,) = counted([of("a", hours=5.0), of("a")])
    assert found.usage == Usage(5.0)
    (found,) = counted([of("a", hours=5.0), of("a", hours=6.0)])
    assert found.usage == Usage(6.0)


def test_a_joint_diagnosis_replaces_those_of_its_recordings() -> None:
    entries = [of("a", number=1), of("b", number=2), of("a", "b", number=3)]
    assert [item.number for item in counted(entries)] == [3]


@pytest.mark.parametrize(
    ("first", "second", "count"),
    [
        ("2026-03-01T12:00:00.000Z", "2026-03-01T12:00:00.001Z", 1),
        ("2026-03-01T12:00:00.000Z", "2026-03-01T14:00:00.001Z", 1),  # another zone
        ("2026-03-01T12:00:00.000Z", "2026-03-01T11:14:59.500Z", 1),
        ("2026-03-01T12:00:00.000Z", None, 1),
        (None, None, 1),
        ("2026-03-01T12:00:00.000Z", "2026-03-01T12:00:07.000Z", 2),
        ("2026-03-01T12:00:00.000Z", "2026-03-03T12:00:00.000Z", 2),
    ],
)
def test_two_tests_of_a_simulated_unit_are_two_whatever_their_samples(
    first: str | None, second: str | None, count: int
) -> None:
    entries = [replace(of("a", hours=5.0), tested=first), replace(of("a"), tested=second)]
    found = counted(entries)
    assert len(found) == count
    assert found[-1].usage == Usage(5.0 if count == 1 else None)


def test_without_samples_each_counts() -> None:
    entry = an_entry(sources=(Source("bus", None, None),))
    assert len(counted([entry, replace(entry, number=2)])) == 2


@given(st.lists(st.sampled_from("abc")))
def test_no_recording_counts_twice_and_none_is_lost(names: list[str]) -> None:
    found = counted([of(name, number=i) for i, name in enumerate(names)])
    kept = [item.sources[0].samples for item in found]
    assert len(kept) == len(set(kept))
    assert set(kept) == set(names)
