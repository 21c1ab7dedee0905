"""What a recording lacks is noted beside the verdict, or is the reason for NOT TESTED."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cli_result import Run
from msgspec.structs import replace
from places import LOGS

from ehadiag import Diagnosis, Recording, Verdict, bundled_tests, default_actuator
from ehadiag.assess.diagnosis import diagnose
from ehadiag.identify.identification_session import NuisanceMode
from firmware_iface.logs.reader import read_frames
from firmware_iface.logs.recorder import Recorder
from firmware_iface.recording import BitOutcome, BitState, Environment
from firmware_iface.signals.recordings import read_recording
from firmware_iface.transport.frames import Frame, FrameTable

TELEMETRY, COMMAND, ENVIRONMENT = 0x110, 0x111, 0x120


@pytest.fixture(scope="module")
def recording() -> Recording:
    return read_recording(LOGS / "paper-open-1.blf")


def diagnosis_of(recording: Recording, **options: NuisanceMode) -> Diagnosis:
    return diagnose([recording], default_actuator(), bundled_tests().values(), **options)


def frames_of(table: FrameTable) -> list[Frame]:
    columns = table.time_ns.tolist(), table.can_id.tolist(), table.data, table.length.tolist()
    return [
        Frame(time_ns, can_id, bytes(data[:length]))
        for time_ns, can_id, data, length in zip(*columns, strict=True)
    ]


def rewritten(log: str, folder: Path, without: int) -> Path:
    """A log without one message."""
    path = folder / f"without-{without:x}.blf"
    with Recorder(path) as recorder:
        for frame in frames_of(read_frames(LOGS / log)):
            if frame.can_id != without:
                recorder.write(frame)
    return path


def cut(recording: Recording, first: int, last: int) -> Recording:
    """Without the samples before tick `first` and from tick `last` on."""
    samples = recording.samples
    assert samples is not None
    gone = (np.arange(samples.ticks) < first) | (np.arange(samples.ticks) >= last)
    names = ("current", "spool", "pressure", "position", "command")
    lost = {name: np.where(gone, np.nan, getattr(samples, name)) for name in names}
    return replace(recording, samples=replace(samples, **lost))


def test_a_whole_recording_needs_no_remark(recording: Recording) -> None:
    assert diagnosis_of(recording).notes == ()


def test_what_is_assumed_without_environment_is_said(recording: Recording) -> None:
    sound = diagnosis_of(recording)
    bare = diagnosis_of(replace(recording, environment=Environment()))
    assert bare.notes == (
        "no oil temperature on the bus: 40 degC assumed",
        "no supply pressure on the bus: the actuator file's 20 MPa assumed",
    )
    assert (bare.verdict, bare.reasons) == (sound.verdict, sound.reasons)
    half = replace(recording.environment, return_pressure=None)
    assert len(diagnosis_of(replace(recording, environment=half)).notes) == 1


def test_a_log_without_environment_says_so_in_text_and_json(run: Run, tmp_path: Path) -> None:
    path = rewritten("paper-open-1.blf", tmp_path, ENVIRONMENT)
    text = run("diagnose", path)
    assert text.code == 10
    assert "note: no oil temperature on the bus: 40 degC assumed" in text.out
    (found,) = run("diagnose", "--json", path).objects
    assert len(found["quality"]["notes"]) == 2
    checked = run("check-bus", "--log", path)
    assert "oil_temperature is not on the bus: a diagnosis assumes the actuator file's" in (
        checked.out
    )
    assert checked.code == run("check-bus", "--log", LOGS / "paper-open-1.blf").code


@pytest.mark.parametrize(
    ("first", "last", "words"),
    [
        (0, 5300, "the last 0.200 s of the test are missing: the recording ends early"),
        (0, 5450, "the last 0.050 s of the test are missing: the recording ends early"),
        (120, 5500, "the first 0.120 s of the test are missing"),
    ],
)
def test_a_recording_cut_at_an_end_says_how_much_is_missing(
    first: int, last: int, words: str, recording: Recording
) -> None:
    came = diagnosis_of(cut(recording, first, last))
    assert came.notes == (words,)
    assert came.verdict is Verdict.DEGRADED


def test_the_end_that_is_missing_in_closed_loop_needs_no_current() -> None:
    came = diagnosis_of(cut(read_recording(LOGS / "paper-closed-1.blf"), 0, 5300))
    assert came.notes == ("the last 0.200 s of the test are missing: the recording ends early",)
    assert came.verdict is Verdict.DEGRADED


def test_a_single_lost_frame_at_the_end_is_no_cut(recording: Recording) -> None:
    assert diagnosis_of(cut(recording, 0, 5497)).notes == ()


def test_a_recording_without_the_word_of_completion_says_so(recording: Recording) -> None:
    running = replace(recording, outcome=BitOutcome(BitState.RUNNING))
    (note,) = diagnosis_of(running).notes
    assert note == "the recording ends before the computer's word that the test is complete"


def test_what_the_users_own_policy_refuses_is_the_reason(recording: Recording) -> None:
    why = "ServoTelemetry: 9 of 5500 frames lost (the mapping's policy allows 0.001)"
    strict = replace(recording, quality=replace(recording.quality, refused=(why,)))
    came = diagnosis_of(strict)
    assert (came.verdict, came.reasons) == (Verdict.NOT_TESTED, (why,))


def test_notes_of_joint_recordings_are_said_once(recording: Recording) -> None:
    bare = replace(recording, environment=Environment())
    joint = diagnose([bare, bare], default_actuator(), bundled_tests().values())
    assert len(joint.notes) == 2


def test_closed_loop_without_command_frames_is_borne_out_by_the_current(
    run: Run, tmp_path: Path
) -> None:
    path = rewritten("paper-closed-1.blf", tmp_path, COMMAND)
    came = run("diagnose", "--json", path)
    assert came.code == 10
    (found,) = came.objects
    assert any("which the current bears out" in note for note in found["quality"]["notes"])


def test_closed_loop_without_command_and_current_says_what_to_record(recording: Recording) -> None:
    whole = read_recording(LOGS / "paper-closed-1.blf")
    assert whole.samples is not None
    nothing = np.full(whole.samples.ticks, np.nan)
    bare = replace(whole, samples=replace(whole.samples, command=nothing, current=nothing))
    came = diagnosis_of(bare)
    assert came.verdict is Verdict.NOT_TESTED
    assert "record the message with the command too" in came.reasons[0]


def test_open_loop_needs_no_command_frames(run: Run, tmp_path: Path) -> None:
    assert run("diagnose", rewritten("paper-open-1.blf", tmp_path, COMMAND)).code == 10


@pytest.mark.parametrize(
    ("every", "tested", "nuisances"),
    [
        pytest.param(100, True, NuisanceMode.AUTO, marks=pytest.mark.slow),
        pytest.param(9, True, NuisanceMode.AUTO, marks=pytest.mark.slow),
        (9, False, NuisanceMode.NONE),
    ],
)
def test_closed_loop_with_lost_positions_is_judged_up_to_a_stated_share(
    every: int, tested: bool, nuisances: NuisanceMode
) -> None:
    """Two ticks in a row lost: neither position nor current tells what the control law did."""
    whole = read_recording(LOGS / "paper-closed-1.blf")
    samples = whole.samples
    assert samples is not None
    gone = np.isin(np.arange(samples.ticks) % every, (7, 8))
    lost = {
        name: np.where(gone, np.nan, getattr(samples, name))
        for name in ("current", "spool", "pressure", "position")
    }
    came = diagnosis_of(replace(whole, samples=replace(samples, **lost)), nuisances=nuisances)
    if tested:
        assert came.verdict is Verdict.DEGRADED
    else:
        assert came.verdict is Verdict.NOT_TESTED
        (reason,) = came.reasons
        assert reason.startswith(
            "11.1% of the jack positions that the control law worked on are lost (limit 1.5%) and "
            "not told by the response: the servovalve current cannot be rebuilt: Kintas, FSS not "
            "observable, but FDJ "
        )
        assert came.identification is not None
        clogging, friction, jack = came.identification.estimates
        assert clogging.interval95 == friction.interval95 == (0.0, 1.0)
        assert not clogging.shown
        assert jack.shown
        assert jack.interval95[0] < 0.3 < jack.interval95[1]
        assert jack.interval95[1] - jack.interval95[0] < 0.05
