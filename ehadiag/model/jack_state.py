"""What the algorithms of second stage and jack share: state, piece of the spool's path, sensor."""

from __future__ import annotations

from typing import Any, NamedTuple

from ehadiag.compile.vector import packed
from ehadiag.model.sensors import LATE, followed, following

__all__ = ["JackState", "Piece", "Probe", "place_on", "sense"]


class JackState(NamedTuple):
    """Jack between two pieces.

    Attributes
    ----------
    place: m.
    velocity: m/s.
    direction: of its motion, +1 or -1; 0 at rest.
    fresh: not 0 if it has just started or stopped.
    pressure: differential pressure, Pa; of an orifice stage, where it is stored in the oil.
    lagged: differential pressure behind the filter, Pa.
    seen: the same when it was sampled last, Pa.
    """

    place: float
    velocity: float
    direction: float
    fresh: float
    pressure: float
    lagged: float
    seen: float


class Piece(NamedTuple):
    """Piece of the spool's path, a cubic; numbers, or vectors of as many lanes.

    Attributes
    ----------
    span: duration, s.
    x0, x1: spool at its ends, m.
    rise0, rise1: slopes there times `span`, m.
    """

    span: Any
    x0: Any
    x1: Any
    rise0: Any
    rise1: Any


class Probe(NamedTuple):
    """How the sensor of pressure looks at a piece.

    Attributes
    ----------
    lag: of the filter before its converter, s.
    due: from the start of the piece to the instant of sampling, s; none of this piece if negative
        or beyond it.
    """

    lag: float
    due: float


@packed
def place_on(p: Piece, q: Any) -> Any:
    """Spool at the share q of a piece, m."""
    r = 1.0 - q
    return p.x0 + q * q * (3.0 - 2.0 * q) * (p.x1 - p.x0) + q * r * (r * p.rise0 - q * p.rise1)


@packed
def sense(
    probe: Probe, cubic: Any, begin: float, span: float, lagged: float, seen: float
) -> tuple[float, float]:
    """Pressure behind the filter after a step, and when it was sampled, Pa.

    cubic: coefficients of the pressure over the step; begin: its start, s from that of the piece;
    span: s; lagged, seen: before, Pa.
    """
    upto = probe.due - begin
    if 0.0 < upto <= LATE * span:
        seen = followed(following(probe.lag, span, upto), lagged, cubic)
    return followed(following(probe.lag, span, span), lagged, cubic), seen
