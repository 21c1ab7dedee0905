"""How candidates stand side by side: WIDTH of them in a vector, LANES in a block.

Arrays are flat, row r of lane i at r * LANES + i.
"""

from __future__ import annotations

from ehadiag.compile.vector import WIDTH

LANES = 2 * WIDTH
NODES = 4
"""Pieces of the spool's path in a tick."""

(
    FLAPPER,
    FLAPPER_RATE,
    SPOOL,
    SPOOL_RATE,
    DIRECTION,
    CLAMPED,
    BUSY,
    JACK,
    JACK_VELOCITY,
    JACK_DIRECTION,
    PRESSURE,
    FILTERED,
    FRESH,
    DONE,
    DEFLECTION,
    SEEN,
    ANCHORED,
    STATE_ROWS,
) = range(18)
"""Rows of the state. DEFLECTION: of the flapper by the current alone; SEEN:
spool as it is sampled; FRESH: the jack has just
started or stopped; DONE: it has taken this tick beside the spool; ANCHORED: how often the lane was
re-anchored, which goes on from span to span."""

PLACE, SLOPE = 0, NODES + 1
PATH_ROWS = 2 * (NODES + 1)
"""Rows of the path: position and velocity of the spool at the nodes 0 … NODES."""

(
    DRIVE_GAIN,
    RATIO,
    REACH,
    DRY,
    BREAKAWAY,
    ROOM,
    FLAPPER_STOP,
    STROKE,
    FORCE,
    SPOOL_MASS,
    DAMPING,
    DYNAMIC,
    RING_DAMPING,
    RING_TIME,
    JACK_FLOW,
    JACK_SLOPE,
    JACK_LEAK,
    JACK_CORNER,
    JACK_AREA,
    JACK_VISCOSITY,
    JACK_BY_MASS,
    JACK_SUPPLY,
    JACK_STROKE,
    JACK_LOAD,
    JACK_FRICTION,
    JACK_STATIC,
    SPOOL_OFFSET,
    PRESSURE_OFFSET,
    SEEN_PLACE_BEFORE,
    SEEN_PLACE,
    SEEN_SLOPE_BEFORE,
    SEEN_SLOPE,
    SCALAR_ROWS,
) = range(33)
"""Rows of the coefficients that are one number a lane, see `ehadiag.model.laws`. ROOM: flapper
deflection within which a resting spool stays; RING_TIME: reciprocal of the ringing's rate;
SEEN_…: weights of the last piece's ends at the instant of sampling."""
REST = SCALAR_ROWS
MOVE = REST + 4
COEFFICIENT_ROWS = MOVE + 16
"""Then the transitions over a whole tick at rest (2 x 2) and a quarter of a tick moving (4 x 4)."""
