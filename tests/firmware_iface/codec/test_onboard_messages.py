"""What a computer says it has found itself: put together live and from a log, of the right test."""

from dataclasses import replace

import pytest
from bus_synth import START, make_truth, play, recordings
from onboard_frames import SEVERITIES, advance, findings
from places import ROOT

from ehadiag.core.errors import ConfigurationError
from ehadiag.core.recording import OnboardState
from firmware_iface.codec.onboard import OnboardReader
from firmware_iface.mapping.bus_map import default_map, load_map

BEFORE = "BO_ 528 OnboardVerdict"
DATA = ROOT / "firmware_iface" / "data"
NOTHING, RECORDING, IDENTIFYING, DONE, GIVEN_UP = OnboardState


@pytest.fixture
def reader():
    return OnboardReader(default_map())


def hear(reader, *frames):
    for frame in frames:
        reader.take(frame)


def test_a_result_is_whole_with_its_last_severity(reader):
    hear(reader, advance(DONE, 2, 20, 442), *findings()[:2])
    assert reader.result is None
    hear(reader, findings()[2])
    found = reader.result
    assert (found.test_id, found.verdict, found.runs) == (2, 20, 442)
    for name, (value, std) in SEVERITIES.items():
        assert found.severities[name] == pytest.approx(value, abs=1e-9)
        assert found.std[name] == pytest.approx(std, abs=1e-9)


def test_severities_count_only_behind_the_word_that_it_is_done(reader):
    hear(reader, *findings())
    assert reader.result is None
    hear(reader, advance(IDENTIFYING), *findings())
    assert reader.result is None


@pytest.mark.parametrize("state", [NOTHING, RECORDING, IDENTIFYING, GIVEN_UP])
def test_a_result_goes_with_the_next_state(reader, state):
    hear(reader, advance(DONE), *findings(), advance(state))
    assert reader.result is None
    assert reader.awaited is (state in (RECORDING, IDENTIFYING))


def test_what_is_awaited(reader):
    assert not reader.awaited
    hear(reader, advance(DONE))
    assert reader.awaited
    hear(reader, *findings())
    assert not reader.awaited


def test_a_damaged_frame_counts_for_nothing(reader):
    first, *rest = findings()
    broken = replace(first, data=bytes([first.data[0] ^ 1]) + first.data[1:])
    hear(reader, advance(DONE), broken, *rest)
    assert reader.result is None
    hear(reader, replace(first, error=True), replace(first, remote=True, data=b""))
    assert reader.result is None


@pytest.mark.parametrize(("test_id", "ours"), [(1, True), (2, False), (None, True)])
def test_a_result_is_that_of_its_test(reader, test_id, ours):
    hear(reader, advance(DONE, 1), *findings())
    assert (reader.of_test(test_id) is not None) is ours


def test_each_recording_has_what_was_found_after_it(encoder, bus_map):
    first = play(encoder, make_truth(300), idle_before=200, idle_after=200)
    second = play(
        encoder, make_truth(300, 2), idle_before=200, idle_after=200, test_id=2, counter=13 + 700,
        start_ns=START + 700_000_000,
    )  # fmt: skip
    found = dict.fromkeys(SEVERITIES, (0.5, 0.01))
    frames = [
        advance(DONE, 2), *findings(found), *first,
        advance(DONE, 1, 10), *findings(), advance(NOTHING, 1), *second,
    ]  # fmt: skip
    one, two = recordings(frames, bus_map)
    assert one.onboard.verdict == 10
    assert one.onboard.severities["FSS"] == pytest.approx(0.6, abs=1e-9)
    assert two.onboard is None
    one, two = recordings([*frames, advance(DONE, 1), *findings()], bus_map)
    assert two.onboard is None, "of another test"
    one, two = recordings([*frames, advance(DONE, 2), *findings(found)], bus_map)
    assert two.onboard.severities["FSS"] == pytest.approx(0.5, abs=1e-9)


def test_they_are_neither_foreign_nor_counted(encoder, bus_map):
    frames = play(encoder, make_truth(300), idle_before=50, idle_after=50)
    (plain,) = recordings(frames, bus_map)
    (told,) = recordings([*frames, advance(DONE), *findings()], bus_map)
    assert told.quality == plain.quality


def test_a_dbc_without_these_messages_is_still_the_default_bus(tmp_path):
    text = (DATA / "eha_fcc.dbc").read_text()
    kept = [
        part
        for part in text.split("\n\n")
        if not part.startswith("BO_ 52") and "BO_ 53" not in part
    ]
    assert BEFORE not in "\n\n".join(kept[:-1])
    path = tmp_path / "older.dbc"
    lines = "\n\n".join(kept).splitlines()
    path.write_text(
        "\n".join(x for x in lines if not any(f" {n} " in x for n in (528, 529, 530, 531)))
    )
    bus_map = default_map(path)
    assert bus_map.onboard == ()
    assert bus_map.messages.keys() == default_map().messages.keys()


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ('FSS = { message = "OnboardFSS", signal = "SeverityFSS" }\n', "onboard.FSS is needed"),
        ('state = { message = "OnboardVerdict", signal = "OnboardState" }\n', "onboard.state is"),
    ],
)
def test_half_a_finding_is_refused(tmp_path, line, why):
    text = (DATA / "eha_fcc.toml").read_text()
    assert line in text
    (tmp_path / "map.toml").write_text(text.replace(line, ""))
    (tmp_path / "eha_fcc.dbc").write_bytes((DATA / "eha_fcc.dbc").read_bytes())
    with pytest.raises(ConfigurationError, match=why):
        load_map(tmp_path / "map.toml")


def test_a_message_of_two_minds_is_refused(tmp_path):
    text = (DATA / "eha_fcc.toml").read_text()
    old = 'runs = { message = "OnboardVerdict", signal = "OnboardRuns" }'
    new = 'runs = { message = "BitStatus", signal = "ElapsedTime" }'
    (tmp_path / "map.toml").write_text(text.replace(old, new))
    (tmp_path / "eha_fcc.dbc").write_bytes((DATA / "eha_fcc.dbc").read_bytes())
    with pytest.raises(ConfigurationError, match="BitStatus carries onboard findings and other"):
        load_map(tmp_path / "map.toml")
