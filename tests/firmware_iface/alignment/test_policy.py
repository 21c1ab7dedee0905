"""Policies: which counts refuse a recording, which are noted, and the wording."""

from __future__ import annotations

import pytest

from ehadiag.core.recording import MessageCounts
from firmware_iface.alignment.policy import judge_frames
from firmware_iface.mapping.file import Policy, PolicyLimits

KINDS = {
    "crc": ("crc_errors", "frames with a wrong check sum"),
    "range": ("range_errors", "frames with values outside their range"),
    "length": ("length_errors", "frames of a wrong length"),
    "lost": ("lost", "frames lost"),
    "repeated": ("repeated", "frames repeated"),
    "out_of_order": ("out_of_order", "frames out of order"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_fault_is_refused_where_its_own_policy_says_so(kind):
    """The share is that of all frames sent, as far as is known: those received and those lost."""
    count, words = KINDS[kind]
    counts = {"A": MessageCounts(**{"received": 100, "lost": 60, count: 40}), "B": MessageCounts()}
    frames = 140 if kind == "lost" else 160
    limit = 40 / frames
    assert judge_frames(Policy(), counts) == ((), ())
    refused, notes = judge_frames(Policy(**{kind: "refuse"}), counts)
    assert refused == (f"A: 40 of {frames} {words} (the mapping's policy allows 0)",)
    assert notes == ()
    at = Policy(**{kind: "refuse"}, limits=PolicyLimits(**{kind: limit}))
    assert judge_frames(at, counts) == ((), ())
    below = Policy(**{kind: "refuse"}, limits=PolicyLimits(**{kind: limit - 1e-6}))
    assert judge_frames(below, counts)[0] == (
        f"A: 40 of {frames} {words} (the mapping's policy allows {limit:.3g})",
    )


@pytest.mark.parametrize("kind", ["crc", "range"])
def test_faulty_frames_that_are_used_are_noted(kind):
    count, words = KINDS[kind]
    counts = {"A": MessageCounts(received=9), "B": MessageCounts(**{"received": 9, count: 1})}
    refused, notes = judge_frames(Policy(**{kind: "flag"}), counts)
    assert refused == ()
    assert notes == (f"B: 1 {words}, used as the mapping's policy says",)


@pytest.mark.parametrize("kind", ["lost", "out_of_order"])
def test_gaps_and_lateness_are_counted_anyway_and_need_no_note(kind):
    counts = {"A": MessageCounts(**{"received": 9, KINDS[kind][0]: 4})}
    assert judge_frames(Policy(**{kind: "flag"}), counts) == ((), ())


def test_every_message_and_every_kind_is_judged():
    """A sound message, or a kind within its share, ends nothing."""
    counts = {
        "A": MessageCounts(received=100, crc_errors=1, repeated=2, lost=1),
        "B": MessageCounts(received=100),
        "C": MessageCounts(received=10, crc_errors=1, length_errors=3),
    }
    policy = Policy(
        crc="refuse",
        range="flag",
        length="refuse",
        repeated="refuse",
        limits=PolicyLimits(crc=0.05, repeated=0.5),
    )
    refused, notes = judge_frames(policy, counts)
    assert [why.split(" (")[0] for why in refused] == [
        "C: 1 of 10 frames with a wrong check sum",
        "C: 3 of 10 frames of a wrong length",
    ]
    assert notes == ()


def test_no_frames_at_all_are_no_fault():
    policy = Policy(**dict.fromkeys(KINDS, "refuse"))
    assert judge_frames(policy, {"A": MessageCounts()}) == ((), ())
    assert judge_frames(policy, {}) == ((), ())
