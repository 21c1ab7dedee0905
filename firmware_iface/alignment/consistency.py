"""Checks that all frames received during a test belong to one test of one unit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.recording import BitState
from firmware_iface.codec.status import Status

__all__ = ["contradictions", "time_bases"]

TWICE = 2
"""Times a value must be told to count: a damaged frame whose check sum fits tells it once."""
TURNS = 2
"""Changes to and fro beyond which two senders speak in turn."""
SAME_START = 20
"""Ticks by which the first tick that status frames imply may scatter."""

Rows = NDArray[np.int64]


def time_bases(status: Status, running: Rows) -> tuple[Rows, str]:
    """Running frames of one time base, and what a second one beside it means; empty for none.

    Each running frame implies the test's first tick. Tests that follow one another imply one after
    the other; two first ticks in turn come from two senders.

    Parameters
    ----------
    status : Status
        All status frames, in columns.
    running : Rows
        Rows of `status` that say so and give the elapsed time.

    Returns
    -------
    tuple[Rows, str]
        Rows of one time base, and the reason against the recording (empty: none).
    """
    start = status.start[running].astype(np.int64)
    order = np.argsort(start, kind="stable")
    cuts = np.flatnonzero(np.diff(start[order]) > SAME_START) + 1
    groups = [np.sort(group) for group in np.split(order, cuts)]
    groups = sorted((group for group in groups if len(group) >= TWICE), key=len, reverse=True)
    dropped = np.zeros(len(running), dtype=np.bool_)
    kept: list[Rows] = []
    reason = ""
    for group in groups:
        beside = [
            other
            for other in kept
            if np.count_nonzero((group > other[0]) & (group < other[-1])) >= TWICE
        ]
        if not beside:
            kept.append(group)
            continue
        dropped[group] = True
        apart = int(np.median(start[group]) - np.median(start[beside[0]]))
        reason = (
            "the status tells of two time bases in turn, their tests begun"
            f" {abs(apart)} ticks apart: a second sender of the status"
        )
    return running[~dropped], reason


def contradictions(
    status: Status, inside: Rows, final: int | None, first: int, stop: int, test_id: int | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Reasons why what was said is not of one test on one unit, and notes on single odd frames.

    Parameters
    ----------
    status : Status
        All status frames, in columns.
    inside : Rows
        Rows of `status` between first and last tick.
    final : int | None
        Row that told of the end; None without one.
    first : int
        Ticks of the test.
    stop : int
        See `first`.
    test_id : int | None
        What the commands say; None: nothing.

    Returns
    -------
    tuple[tuple[str, ...], tuple[str, ...]]
        Reasons and notes, a sentence each.
    """
    told = inside if final is None else np.append(inside[inside != final], final)
    reasons, notes = [], []
    for what, values, expected in (
        ("serial number", status.serial[told], None),
        ("test number", _numbers(status, told), test_id),
    ):
        reason, note = _one_value(what, values, expected, final is not None)
        reasons += [reason] * bool(reason)
        notes += [note] * bool(note)
    amidst = inside[
        (status.following[inside] > first + SAME_START)
        & (status.following[inside] < stop - SAME_START)
    ]
    for state in (BitState.IDLE, BitState.ARMING):
        count = int(np.count_nonzero(status.state[amidst] == state))
        if count >= TWICE:
            reasons.append(f"the status says {state.name.lower()} {count} times amidst the test")
    if np.any(status.state[amidst] == BitState.REFUSED):
        notes.append("another request was refused while the test ran")
    if final is not None:
        later = np.arange(final + 1, len(status.row))
        same = np.abs(status.start[later] - first) <= SAME_START
        count = int(np.count_nonzero((status.state[later] == BitState.RUNNING) & same))
        if count >= TWICE:
            word = BitState(int(status.state[final])).name.lower()
            reasons.append(f"the status says that the test runs after it was {word}")
    return tuple(reasons), tuple(notes)


def _numbers(status: Status, told: Rows) -> Rows:
    """Test numbers of frames that speak of a test; -1 for the others."""
    speaks = np.isin(status.state[told], (BitState.RUNNING, BitState.COMPLETE))
    return np.where(speaks, status.test_id[told], -1)


def _one_value(what: str, values: Rows, expected: int | None, ends: bool) -> tuple[str, str]:
    """Reason and note on a value that must not change; `ends`: the last frame weighs."""
    known = values[values >= 0]
    unique, count = np.unique(known, return_counts=True)
    if len(unique) == 0:
        return "", ""
    usual = int(unique[np.argmax(count)])
    if expected is not None and usual != expected:
        return f"commands say {what} {expected}, the status {usual}", ""
    odd = [int(value) for value, times in zip(unique, count, strict=True) if times >= TWICE]
    odd = [value for value in odd if value != usual]
    last = int(values[-1])
    if ends and last >= 0 and last != usual and last not in odd:
        odd.append(last)
    if odd:
        if np.count_nonzero(np.diff(known[np.isin(known, [usual, *odd])])) > TURNS:
            return (
                f"the status tells {what} {usual} and {odd[0]} in turn: a second sender of the"
                " status"
            ), ""
        return f"the {what} changes within the test: {usual} and {odd[0]}", ""
    if len(unique) > 1:
        other = int(unique[unique != usual][0])
        return "", f"one status frame says {what} {other}, all others {usual}"
    return "", ""
