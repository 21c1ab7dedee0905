"""How candidates stand side by side: WIDTH of them in a vector, LANES in a block.

Arrays are flat, row r of lane i at r * LANES + i.
"""

from __future__ import annotations

from ehadiag.compile.vector import WIDTH

LANES = 2 * WIDTH
NODES = 4
"""Pieces of the spool's path in a tick."""

# Rows of the state.
FLAPPER, FLAPPER_RATE, SPOOL, SPOOL_RATE, DIRECTION, CLAMPED, BUSY = 0, 1, 2, 3, 4, 5, 6
JACK, JACK_VELOCITY, JACK_DIRECTION, PRESSURE, FILTERED = 7, 8, 9, 10, 11
FRESH, DONE, ANCHORED = 12, 13, 14
"""FRESH: the jack has just started or stopped; DONE: it has taken this tick beside the spool."""
STATE_ROWS = 15
# Rows of the path: position and velocity of the spool at the nodes 0 … NODES.
PLACE, SLOPE = 0, NODES + 1
PATH_ROWS = 2 * (NODES + 1)
# Rows of the coefficients: the step of a whole tick at rest (2 x 2), of a quarter tick (4 x 4).
DRY, BREAK, ROOM, DAMPING, DYNAMIC, JACK_FRICTION = 0, 1, 2, 3, 4, 5
SPOOL_OFFSET, PRESSURE_OFFSET, REST, MOVE = 6, 7, 8, 12
COEFFICIENT_ROWS = 28
