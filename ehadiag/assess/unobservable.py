"""Says which severities are left to observe where the servovalve current cannot be rebuilt.

In closed loop the noise of the jack's sensor is part of the current. Where samples are lost, so is
that noise, and with it what filter clogging and spool friction show: how the spool follows the
current tick by tick. Jack friction shows in the pressure over whole strokes, and stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ehadiag.identify.experiment import Experiment
from ehadiag.identify.result import Estimate, Identification
from ehadiag.identify.uncertainty import UNIFORM_STD, interval95

__all__ = ["MOST_GUESSED", "lost_positions", "observable", "what_is_left"]

MOST_GUESSED = 0.015
"""Share of ticks in closed loop whose current had to be guessed (docs/reference/bus-faults.md)."""
LARGEST_SHARE = 0.25
"""Such a share beyond which nothing was tried."""
HIDDEN = ("Kintas", "FSS")
"""Severities that the spool's answer to single ticks of current tells."""
LEAST_STD = 0.01
"""Severity; of the others: off by 0.001 at most in closed loop with up to 13 % guessed."""


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
        f"(limit {MOST_GUESSED:.1%}): the servovalve current cannot be rebuilt"
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


def what_is_left(found: Identification) -> tuple[Identification, str]:
    """Take the severities back that lost positions hide, and widen the others.

    Parameters
    ----------
    found : Identification
        As if nothing were lost.

    Returns
    -------
    tuple[Identification, str]
        With intervals that hold in spite of it; what can be observed and what cannot, in words.
    """
    estimates = tuple(map(_widened, found.estimates))
    scale = np.array(
        [new.std / max(old.std, 1e-12) for new, old in zip(estimates, found.estimates, strict=True)]
    )
    covariance = found.covariance * np.outer(scale, scale)
    told = " and ".join(
        f"{item.name} {item.interval95[0]:.2f} … {item.interval95[1]:.2f}"
        for item in estimates
        if item.shown
    )
    words = f"{', '.join(HIDDEN)} not observable" + (f", but {told}" if told else "")
    return replace(found, estimates=estimates, covariance=covariance), words


def _widened(item: Estimate) -> Estimate:
    if item.name in HIDDEN:
        return replace(item, std=UNIFORM_STD, interval95=(0.0, 1.0), shown=False)
    std = max(item.std, LEAST_STD)
    return replace(item, std=std, interval95=interval95(item.value, std))
