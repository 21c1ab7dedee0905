"""Verdicts: every reason for NOT TESTED, and the two levels.

One order of exit codes, whichever way several things come of a call. Every reference recording
through the command line: verdict, estimates, counted losses.
"""

from __future__ import annotations

import csv
import itertools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from cli_result import Run
from msgspec.structs import replace
from places import LOGS

from ehadiag import (
    Actuator,
    ConfigurationError,
    Diagnosis,
    Levels,
    Recording,
    Verdict,
    bundled_tests,
    default_actuator,
)
from ehadiag.assess.diagnosis import diagnose
from ehadiag.assess.verdict import VerdictRule, judge
from ehadiag.cli import batch_run
from ehadiag.setup import RecordedTest, Setup
from ehadiag.terminal.output import exit_code_of_inputs, worst_exit_code
from firmware_iface.recording import BitOutcome, BitReason, BitState, Environment
from firmware_iface.signals.recordings import read_recording

TESTS = bundled_tests()


@pytest.fixture(scope="module")
def recording() -> Recording:
    return read_recording(LOGS / "healthy-open.blf")


def diagnosis_of(*recordings: Recording, actuator: Actuator | None = None) -> Diagnosis:
    return diagnose(recordings, actuator or default_actuator(), TESTS.values())


def with_samples(recording: Recording, **changes: Any) -> Recording:
    assert recording.samples is not None
    return replace(recording, samples=replace(recording.samples, **changes))


def without(values: np.ndarray, rows: Any) -> np.ndarray:
    out = values.copy()
    out[rows] = np.nan
    return out


def reasons(*recordings: Recording, actuator: Actuator | None = None) -> tuple[str, ...]:
    result = diagnosis_of(*recordings, actuator=actuator)
    assert result.verdict is Verdict.NOT_TESTED
    return result.reasons


def test_the_recording_itself_is_sound(recording: Recording) -> None:
    result = diagnosis_of(recording)
    assert (result.verdict, result.reasons) == (Verdict.HEALTHY, ())


def test_a_test_that_did_not_come_about(recording: Recording) -> None:
    cold = BitOutcome(BitState.REFUSED, BitReason.OIL_TOO_COLD)
    assert reasons(replace(recording, outcome=cold)) == (
        "refused by the flight-control computer: oil too cold",
    )
    aborted = replace(recording, outcome=BitOutcome(BitState.ABORTED))
    assert reasons(aborted) == ("the test was aborted",)
    assert reasons(replace(recording, samples=None)) == ("no telemetry of a test in the recording",)


def test_a_test_that_nobody_knows(recording: Recording) -> None:
    (unknown,) = reasons(replace(recording, test_id=99))
    assert unknown.startswith("test 99 is none of the stored tests")
    unnumbered = replace(recording, test_id=None)
    (unsaid,) = reasons(unnumbered)
    assert unsaid.startswith("the recording does not say which test it is of")
    told = diagnose([unnumbered], default_actuator(), TESTS.values(), default=TESTS["open"])
    assert told.verdict is Verdict.HEALTHY


@pytest.mark.parametrize("channel", ["spool", "pressure"])
def test_missing_samples(channel: str, recording: Recording) -> None:
    samples = recording.samples
    assert samples is not None
    values = getattr(samples, channel)
    rng = np.random.default_rng(4)
    scattered = without(values, rng.permutation(5500)[:4180])
    assert reasons(with_samples(recording, **{channel: scattered}))[0] == (
        f"76% of the {channel} samples are missing (limit 75%)"
    )
    gap = without(values, slice(2000, 2251))
    assert reasons(with_samples(recording, **{channel: gap})) == (
        f"no {channel} sample for 0.25 s (limit 0.25 s)",
    )
    end = without(values, slice(5100, None))
    assert reasons(with_samples(recording, **{channel: end})) == (
        f"no {channel} sample for 0.40 s (limit 0.25 s)",
    )


def test_a_quarter_of_the_samples_may_be_missing(recording: Recording) -> None:
    samples = recording.samples
    assert samples is not None
    rows = np.random.default_rng(4).permutation(5500)[:1300]
    damaged = with_samples(
        recording, spool=without(samples.spool, rows), pressure=without(samples.pressure, rows)
    )
    assert diagnosis_of(damaged).verdict is Verdict.HEALTHY


def test_saturated_converter(recording: Recording) -> None:
    samples = recording.samples
    assert samples is not None
    for row, name in ((1, "spool"), (2, "pressure")):
        saturated = samples.saturated.copy()
        saturated[row, :120] = True
        assert reasons(with_samples(recording, saturated=saturated)) == (
            f"2% of the {name} samples stand at the converter's end",
        )


@pytest.mark.parametrize(
    ("environment", "words"),
    [
        (Environment(oil_temperature=150.0), "oil at 150 degC, outside -54 … 135"),
        (Environment(oil_temperature=-60.0), "oil at -60 degC, outside -54 … 135"),
        (
            Environment(supply_pressure=9.7e6, return_pressure=0.7e6),
            "supply 9.0 MPa above return, the actuator's data say 20.0 MPa",
        ),
    ],
)
def test_surroundings_out_of_range(
    environment: Environment, words: str, recording: Recording
) -> None:
    assert reasons(replace(recording, environment=environment)) == (words,)


def test_another_kind_of_test(recording: Recording) -> None:
    (first, *_) = reasons(replace(recording, test_id=TESTS["closed"].id))
    assert first == "the command is a current, test 'closed' needs another"
    slow = with_samples(recording, period_ns=2_000_000)
    assert reasons(slow) == ("telemetry every 2 ms, test at 1000 Hz",)
    actuator = default_actuator()
    slow_law = msgspec.structs.replace(
        actuator, controller=msgspec.structs.replace(actuator.controller, rate=500.0)
    )
    assert reasons(recording, actuator=slow_law) == ("controller at 500 Hz, test at 1000 Hz",)


def test_another_command_than_the_test_has(recording: Recording) -> None:
    samples = recording.samples
    assert samples is not None
    (first, *_) = reasons(with_samples(recording, command=samples.command + 1e-4))
    assert first == "the command differs from test 'open' by up to 0.1 mA: another test was played"


def test_failed_current_driver(recording: Recording) -> None:
    samples = recording.samples
    assert samples is not None
    (reason,) = reasons(with_samples(recording, current=0.9 * samples.current))
    assert "LSB rms from what the command gives (limit 4)" in reason


def test_wrong_controller_data() -> None:
    actuator = default_actuator()
    stiff = msgspec.structs.replace(
        actuator, controller=msgspec.structs.replace(actuator.controller, GAP=2.0)
    )
    (reason,) = reasons(read_recording(LOGS / "healthy-closed.blf"), actuator=stiff)
    assert "from what the control law gives" in reason


def test_frozen_signal(recording: Recording) -> None:
    samples = recording.samples
    assert samples is not None
    frozen = with_samples(recording, pressure=np.full_like(samples.pressure, 1e5))
    assert reasons(frozen) == ("the pressure signal is frozen",)


def test_data_of_another_actuator(recording: Recording) -> None:
    actuator = default_actuator()
    light = msgspec.structs.replace(
        actuator, jack=msgspec.structs.replace(actuator.jack, AJ=1.3e-3)
    )
    (reason,) = reasons(recording, actuator=light)
    assert reason.startswith("the model does not explain the recording: ")


def test_two_actuators_have_no_joint_estimate(recording: Recording) -> None:
    assert reasons(recording, replace(recording, serial=2)) == (
        "the recordings are of actuators with different serial numbers",
    )


@pytest.mark.parametrize(
    ("values", "verdict", "named"),
    [
        ((0.0, 0.0, 0.0), Verdict.HEALTHY, []),
        ((0.2499, 0.1, 0.0), Verdict.HEALTHY, []),
        ((0.25, 0.0, 0.0), Verdict.DEGRADED, ["Kintas"]),
        ((0.0, 0.7499, 0.3), Verdict.DEGRADED, ["FSS", "FDJ"]),
        ((0.0, 0.0, 0.75), Verdict.FAULT, ["FDJ"]),
        ((1.0, 0.3, 0.0), Verdict.FAULT, ["Kintas", "FSS"]),
        ((0.3, 1.0, 0.3), Verdict.FAULT, ["Kintas", "FSS", "FDJ"]),
    ],
)
def test_levels_of_the_estimates(
    values: tuple[float, ...], verdict: Verdict, named: list[str]
) -> None:
    names = ("Kintas", "FSS", "FDJ")
    estimates = [
        SimpleNamespace(name=name, value=value) for name, value in zip(names, values, strict=True)
    ]
    given, why = judge(SimpleNamespace(estimates=estimates), Levels(rule=VerdictRule.ESTIMATE))
    assert given is verdict
    assert [reason.split()[0] for reason in why] == named


@pytest.mark.parametrize(
    ("advisory", "limit"), [(0.0, 0.5), (0.5, 0.5), (0.6, 0.5), (0.2, 1.1), (float("nan"), 0.5)]
)
def test_levels_out_of_order(advisory: float, limit: float) -> None:
    with pytest.raises(ConfigurationError, match="need 0 < advisory < limit <= 1"):
        Levels(advisory, limit)


HEALTHY, CLOSED = (LOGS / name for name in ("healthy-open.blf", "healthy-closed.blf"))
WORST_FIRST = (20, 40, 3, 30, 10, 0)


def test_the_order() -> None:
    for worse, better in itertools.combinations(WORST_FIRST, 2):
        assert worst_exit_code((better, worse)) == worst_exit_code((worse, better)) == worse
    assert worst_exit_code(()) == 0
    assert worst_exit_code((2, 30)) == 3
    assert exit_code_of_inputs([2]) == 2
    assert exit_code_of_inputs([2, 2]) == 3


@pytest.mark.parametrize(("codes", "worst"), [((20, 30), 20), ((30, 3), 3), ((10, 0), 10)])
def test_tests_of_one_recording(
    codes: tuple[int, int], worst: int, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two tests of one recording; their verdicts are put in their place."""
    ended, read = iter(codes), Setup.read
    monkeypatch.setattr(
        Setup,
        "read",
        lambda self, log, *_, **__: RecordedTest(read(self, log).recordings * 2, (), None, 0.0),
    )
    monkeypatch.setattr(batch_run, "diagnose_and_deliver", lambda *_: (None, next(ended)))
    assert run("diagnose", "--merge", "--all", HEALTHY, CLOSED).code == worst
    assert next(ended, None) is None


def test_inputs_that_cannot_be_read(run: Run) -> None:
    Path("x.unknown").write_text("x")
    Path("y.unknown").write_text("y")
    for options in (["--list"], ["--joint"], []):
        alone = run("diagnose", *options, "x.unknown")
        assert alone.code == 2
        assert run("diagnose", *options, "x.unknown", "y.unknown").code == 3
    assert run("report", "x.unknown").code == 2
    assert run("report", "x.unknown", "y.unknown").code == 3


FAULTS = ("Kintas", "FSS", "FDJ")
TOLERANCE = 5e-4
TRUTH = {row["file"]: row for row in csv.DictReader((LOGS / "truth.csv").read_text().splitlines())}
CODES = {"HEALTHY": 0, "DEGRADED": 10}


@pytest.mark.parametrize("name", sorted(TRUTH))
def test_estimates_are_the_truth(name: str, run: Run) -> None:
    truth = {fault: float(TRUTH[name][fault]) for fault in FAULTS}
    result = run("diagnose", "--json", LOGS / name)
    (found,) = result.objects
    verdict = "DEGRADED" if max(truth.values()) >= 0.25 else "HEALTHY"
    assert (found["verdict"], result.code) == (verdict, CODES[verdict])
    assert found["test"] == TRUTH[name]["test"]
    assert found["serial"] == 1
    for fault, value in truth.items():
        assert found["faults"][fault]["estimate"] == pytest.approx(value, abs=TOLERANCE)
        assert found["faults"][fault]["std"] < 2 * TOLERANCE
    named = [reason.split()[0] for reason in found["reasons"]]
    assert named == [fault for fault in FAULTS if truth[fault] >= 0.25]


def test_losses_of_the_lossy_recording_are_counted(run: Run) -> None:
    (found,) = run("diagnose", "--json", LOGS / "lossy-open.blf").objects
    quality = found["quality"]
    assert quality["lost"] == pytest.approx(0.02 * 11331, rel=0.2)
    assert quality["crc_errors"] == pytest.approx(0.005 * 11331, rel=0.3)
    assert quality["frames"] + quality["lost"] == 11331


def test_a_sound_recording_has_nothing_to_count(run: Run) -> None:
    (found,) = run("diagnose", "--json", LOGS / "paper-open-1.blf").objects
    counted = ("lost", "repeated", "crc_errors", "out_of_order", "length_errors", "foreign")
    assert {name: found["quality"][name] for name in counted} == dict.fromkeys(counted, 0)
    assert found["quality"]["frames"] == 11331
