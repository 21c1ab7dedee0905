"""The stored test in a recording that does not name it: which, when, how sure."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from ehadiag import CommandMode, Recording, Samples, bundled_tests, default_actuator
from firmware_iface.find_test import CandidateTests, extract_tests, match_test
from firmware_iface.recording import BitOutcome, Environment, Quality

CONTROLLER = default_actuator().controller
TESTS = tuple(bundled_tests().values())
SOUGHT = CandidateTests(TESTS, CONTROLLER)
BY_NAME = bundled_tests()


def samples_of(name: str, before: int = 0, after: int = 0, *, beside: int = 0) -> Samples:
    """A stream that holds a test: current as the control law gives it for a jack that follows."""
    test = BY_NAME[name]
    command = np.concatenate([np.zeros(before), test.command(), np.zeros(after)])
    n = len(command)
    rng = np.random.default_rng(7)
    position = np.round((0.9 * command + rng.normal(0, 2e-5, n)) / 2.9e-5) * 2.9e-5
    current = command
    if test.closed_loop:
        seen = np.concatenate([[0.0], position[:-1]])
        current = np.clip(CONTROLLER.GAP * (command - seen), -CONTROLLER.IM, CONTROLLER.IM)
    current = current + rng.normal(0.0, 3e-6, n)
    mode = CommandMode.POSITION if test.closed_loop else CommandMode.CURRENT
    return Samples(
        period_ns=1_000_000,
        mode=mode,
        current=current,
        spool=rng.normal(0, 1e-7, n),
        pressure=rng.normal(0, 1e4, n),
        position=position,
        command=np.roll(command, beside),
        saturated=np.zeros((4, n), dtype=np.bool_),
        host_ns=np.arange(n) * 1_000_000,
    )


def recording(samples: Samples) -> Recording:
    return Recording(
        "made up", samples, None, None, BitOutcome(), Environment(), Quality(), None, 0
    )


@pytest.mark.parametrize("name", ["open", "closed"])
@pytest.mark.parametrize(("before", "after"), [(0, 0), (1, 5), (9_999, 300)])
def test_a_test_is_found_by_its_command(name: str, before: int, after: int) -> None:
    (found,) = extract_tests(recording(samples_of(name, before, after)), SOUGHT)
    assert found.test_id == BY_NAME[name].id
    assert found.samples is not None
    assert found.samples.ticks == BY_NAME[name].ticks
    np.testing.assert_array_equal(found.samples.command, BY_NAME[name].command())
    assert found.start_ns == before * 1_000_000
    assert f"found by its command at {before * 1e-3:.3f} s" in found.quality.notes[-1]


@pytest.mark.parametrize(("name", "by"), [("open", "current"), ("closed", "control law")])
def test_without_a_command_the_current_tells(name: str, by: str) -> None:
    whole = samples_of(name, 1234, 77)
    bare = replace(whole, command=np.full(whole.ticks, np.nan), mode=CommandMode.CURRENT)
    (found,) = extract_tests(recording(bare), SOUGHT)
    assert found.test_id == BY_NAME[name].id
    assert found.start_ns == 1234 * 1_000_000
    assert f"by its {by}" in found.quality.notes[-1]


@pytest.mark.parametrize("beside", [-3, -1, 0, 2])
@pytest.mark.parametrize("name", ["open", "closed"])
def test_telemetry_beside_its_command_is_put_right_by_the_current(name: str, beside: int) -> None:
    found = match_test(samples_of(name, 500, 500, beside=beside), TESTS, CONTROLLER)
    assert found is not None
    assert (found.first, found.command_first) == (500, 500 + beside)
    assert found.sure


def test_two_tests_in_one_recording_are_both_found() -> None:
    first, second = samples_of("open", 100, 400), samples_of("open", 300, 50)
    both = {
        name: np.concatenate([getattr(first, name), getattr(second, name)], axis=-1)
        for name in ("current", "spool", "pressure", "position", "command", "saturated")
    }
    ticks = first.ticks + second.ticks
    joined = replace(first, **both, host_ns=np.arange(ticks) * 1_000_000)
    found = extract_tests(recording(joined), SOUGHT)
    assert [item.start_ns for item in found] == [100_000_000, (6000 + 300) * 1_000_000]


def test_what_is_no_stored_test_is_said_and_left_whole() -> None:
    samples = samples_of("open")
    strange = replace(samples, command=np.sin(np.arange(samples.ticks) / 300.0) * 5e-3)
    (found,) = extract_tests(recording(strange), SOUGHT)
    assert found.test_id is None
    assert found.samples is strange
    assert "no stored test was played: the nearest" in found.quality.notes[-1]


def test_the_user_may_say_where_it_lies() -> None:
    samples = samples_of("open", 2000, 8000)
    twice = replace(
        samples,
        command=samples.command + np.roll(samples.command, 7000),
        current=samples.current + np.roll(samples.current, 7000),
    )
    (late,) = extract_tests(recording(twice), replace(SOUGHT, start_s=8.0))
    assert late.start_ns == 9_000_000_000
    (early,) = extract_tests(recording(twice), replace(SOUGHT, end_s=8.0))
    assert early.start_ns == 2_000_000_000


def test_a_named_start_stands_where_nothing_shows_it() -> None:
    samples = samples_of("open", 2000, 100)
    nothing = np.full(samples.ticks, np.nan)
    mute = replace(samples, command=nothing, current=nothing)
    only = CandidateTests((BY_NAME["open"],), CONTROLLER, start_s=2.0)
    (found,) = extract_tests(recording(mute), only)
    assert found.test_id == BY_NAME["open"].id
    assert found.samples is not None
    np.testing.assert_array_equal(found.samples.spool, samples.spool[2000:7500])


def test_a_recording_that_ends_early_still_tells_its_beginning() -> None:
    samples = samples_of("closed", 300)
    cut = replace(
        samples,
        **{
            name: getattr(samples, name)[..., :5000]
            for name in (
                "current",
                "spool",
                "pressure",
                "position",
                "command",
                "saturated",
                "host_ns",
            )
        },
    )
    (found,) = extract_tests(recording(cut), SOUGHT)
    assert found.start_ns == 300_000_000
    assert found.samples is not None
    assert np.isnan(found.samples.spool[4700:]).all()


def test_commands_out_of_place_are_left_out() -> None:
    samples = samples_of("open", 50, 50)
    command = samples.command.copy()
    command[[2600, 4700]] = command[[2598, 4702]]
    (found,) = extract_tests(recording(replace(samples, command=command)), SOUGHT)
    assert found.samples is not None
    known = np.isfinite(found.samples.command)
    assert np.abs(found.samples.command - BY_NAME["open"].command())[known].max() < 2e-6
