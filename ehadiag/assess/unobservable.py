"""Says which severities are left to observe where currents or ticks of samples are lost.

In closed loop the noise of the jack's sensor is part of the current. Where samples are lost, so is
that noise, and with it what filter clogging and spool friction show: how the spool follows the
current tick by tick. Jack friction shows in the pressure over whole strokes, and stays.

So it is where time stamps that jitter by ticks have sorted the frames of a bus without counters. In
open loop the test tells the current of each tick all the same, and every severity stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ehadiag.core.recording import Recording
from ehadiag.identify.experiment import Experiment
from ehadiag.identify.result import Estimate, Identification
from ehadiag.identify.uncertainty import UNIFORM_STD, interval95

__all__ = [
    "MOST_GUESSED",
    "MOST_OUT_OF_ORDER",
    "lost_order",
    "lost_positions",
    "observable",
    "what_is_left",
]

MOST_GUESSED = 0.015
"""Share of ticks in closed loop whose current had to be guessed (docs/reference/bus-faults.md)."""
LARGEST_SHARE = 0.25
"""Such a share beyond which nothing was tried."""
HIDDEN = ("Kintas", "FSS")
"""Severities that the spool's answer to single ticks of current tells."""
LEAST_STD = 0.01
"""Severity; of the others: off by 0.001 at most in closed loop with up to 13 % guessed, and in open
loop sorted by stamps that jitter by a tick."""
MOST_OUT_OF_ORDER = 0.01
"""Share of commands at other ticks than their own from which on frames have lost their order."""


def lost_positions(experiment: Experiment) -> str:
    """Why a test's current cannot be rebuilt; empty if it can.

    Parameters
    ----------
    experiment : Experiment
        The test.

    Returns
    -------
    str
        One clause.
    """
    guessed = experiment.trace.guessed
    if guessed <= MOST_GUESSED:
        return ""
    return (
        f"{guessed:.1%} of the jack positions that the control law worked on are lost "
        f"(limit {MOST_GUESSED:.1%}) and not told by the response: the servovalve current cannot "
        "be rebuilt"
    )


def lost_order(recording: Recording) -> str:
    """Why the ticks of a recording's samples are not known; empty if they are.

    Parameters
    ----------
    recording : Recording
        Of the test.

    Returns
    -------
    str
        One clause.
    """
    share = recording.out_of_order
    if not recording.by_time or share <= MOST_OUT_OF_ORDER:
        return ""
    return (
        f"by their time stamps {share:.0%} of the commands are of other ticks (limit "
        f"{MOST_OUT_OF_ORDER:.0%}): the frames have lost their order, and no counter tells it"
    )


def observable(experiments: Sequence[Experiment]) -> bool:
    """Whether so few positions are lost that some severity can be observed.

    Parameters
    ----------
    experiments : Sequence[Experiment]
        The tests.

    Returns
    -------
    bool
        False beyond what was tried.
    """
    return all(item.trace.guessed <= LARGEST_SHARE for item in experiments)


def what_is_left(found: Identification, *, closed: bool) -> tuple[Identification, str]:
    """Take the severities back that are hidden, and widen the others.

    Parameters
    ----------
    found : Identification
        As if nothing were lost.
    closed : bool
        Whether a test in closed loop is among the recordings.

    Returns
    -------
    tuple[Identification, str]
        With intervals that hold in spite of it; what can be observed and what cannot, in words.
    """
    hidden = HIDDEN if closed else ()
    estimates = tuple(_widened(item, hidden) for item in found.estimates)
    scale = np.array(
        [new.std / max(old.std, 1e-12) for new, old in zip(estimates, found.estimates, strict=True)]
    )
    covariance = found.covariance * np.outer(scale, scale)
    told = " and ".join(
        f"{item.name} {item.interval95[0]:.2f} … {item.interval95[1]:.2f}"
        for item in estimates
        if item.shown
    )
    words = ", but ".join(
        filter(None, [f"{', '.join(hidden)} not observable" if hidden else "", told])
    )
    return replace(found, estimates=estimates, covariance=covariance), words


def _widened(item: Estimate, hidden: Sequence[str]) -> Estimate:
    if item.name in hidden:
        return replace(item, std=UNIFORM_STD, interval95=(0.0, 1.0), shown=False)
    std = max(item.std, LEAST_STD)
    return replace(item, std=std, interval95=interval95(item.value, std))
