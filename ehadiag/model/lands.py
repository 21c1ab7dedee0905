"""Metering lands of the spool: how far they open, as much travel of a spool with ideal ones.

Second stage and jack are given the path of the opening in place of the spool's, so that lands that
are displaced, unlike to both sides, overlapped or bent are a matter of this module alone.
"""

from __future__ import annotations

from typing import Any

from ehadiag.compile.vector import magnitude, packed, with_sign
from ehadiag.model.jack_state import Piece
from ehadiag.model.laws import JackLaw

__all__ = ["open_piece", "opens", "opens_by"]


@packed
def opens(j: JackLaw, x: Any) -> Any:
    """How far the lands are open with the spool at `x`, as much of its travel, m."""
    z = x - j.closed
    size = magnitude(z)
    return z * (1.0 + j.odd * (z * z) - j.lap / (j.corner + size)) + j.even * size


@packed
def opens_by(j: JackLaw, x: Any) -> Any:
    """What a small travel of the spool at `x` opens, over itself."""
    z = x - j.closed
    size = magnitude(z)
    wide = j.corner + size
    side = with_sign(size * 0.0 + 1.0, z)
    return 1.0 + 3.0 * j.odd * (z * z) - j.lap * j.corner / (wide * wide) + j.even * side


@packed
def open_piece(j: JackLaw, p: Piece) -> Piece:
    """Path of the lands' opening over a piece of the spool's path."""
    if j.shaped == 0.0:
        return p
    rise0, rise1 = opens_by(j, p.x0) * p.rise0, opens_by(j, p.x1) * p.rise1
    return Piece(p.span, opens(j, p.x0), opens(j, p.x1), rise0, rise1)
