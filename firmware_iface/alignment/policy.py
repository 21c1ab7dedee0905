"""Applies the mapping's policy: which frame faults are merely counted, which refuse a verdict."""

from __future__ import annotations

from collections.abc import Mapping

from ehadiag.core.recording import MessageCounts
from firmware_iface.mapping.file import Policy

__all__ = ["judge_frames"]

KINDS = {
    "crc": ("crc_errors", "frames with a wrong check sum"),
    "range": ("range_errors", "frames with values outside their range"),
    "length": ("length_errors", "frames of a wrong length"),
    "lost": ("lost", "frames lost"),
    "repeated": ("repeated", "frames repeated"),
    "out_of_order": ("out_of_order", "frames out of order"),
}
"""Key of the policy: count of the quality, and its words."""


def judge_frames(
    policy: Policy, counts: Mapping[str, MessageCounts]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Reasons to refuse a verdict, and notes on faulty frames that were used.

    A kind is refused where it is met in more than its share of a message's frames, lost ones
    among them.
    """
    refused, notes = [], []
    for kind, (count, words) in KINDS.items():
        action: str = getattr(policy, kind)
        limit: float = getattr(policy.limits, kind)
        for name, item in counts.items():
            bad, frames = int(getattr(item, count)), item.received + item.lost
            if not bad:
                continue
            if action == "refuse" and bad > limit * frames:
                share = f"{bad} of {frames} {words} (the mapping's policy allows {limit:.3g})"
                refused.append(f"{name}: {share}")
            elif action == "flag" and kind in ("crc", "range"):
                notes.append(f"{name}: {bad} {words}, used as the mapping's policy says")
    return tuple(refused), tuple(notes)
