"""How candidates stand side by side: one lane of a vector register each.

Arrays are flat, row r of lane i at r * LANES + i: the compiler then knows that rows do not overlap,
and turns loops over lanes into vector instructions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., Any])

LANES = 16
NODES = 8
"""Nodes of the spool's path a tick; the vector step writes the even ones."""

# Rows of the state.
FLAPPER, FLAPPER_RATE, SPOOL, SPOOL_RATE, DIRECTION, CLAMPED, BUSY = 0, 1, 2, 3, 4, 5, 6
JACK, JACK_VELOCITY, JACK_DIRECTION, DIVIDE, EASE, RATE, PRESSURE = 7, 8, 9, 10, 11, 12, 13
FILTERED, ANCHORED = 14, 15
STATE_ROWS = 16
# Rows of the path: position and velocity of the spool at the nodes 0 … NODES.
PLACE, SLOPE = 0, NODES + 1
PATH_ROWS = 2 * (NODES + 1)
# Rows of the coefficients: the step of a whole tick at rest (2 x 2), of a quarter tick (4 x 4).
DRY, BREAK, ROOM, DAMPING, DYNAMIC, JACK_FRICTION = 0, 1, 2, 3, 4, 5
SPOOL_OFFSET, PRESSURE_OFFSET, REST, MOVE = 6, 7, 8, 12
COEFFICIENT_ROWS = 28

LOOSE = {"contract", "nnan", "nsz"}
"""Fused products, and minima and maxima in one instruction: no NaN enters the model."""


def packed(function: F) -> F:
    """Compile a loop over lanes into the kernels that call it."""
    return numba.njit(nogil=True, error_model="numpy", fastmath=LOOSE)(function)


def packed_inline(function: F) -> F:
    """Compile as a part of the body of a loop over lanes."""
    return numba.njit(nogil=True, error_model="numpy", fastmath=LOOSE, forceinline=True)(function)
