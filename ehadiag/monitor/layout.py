"""Where the numbers of a monitor stand in its one flat array, whose address its kernel is given."""

from __future__ import annotations

from typing import Final

from ehadiag.model.scalar.spool_tick import NODE_COLUMNS, NODES_PER_TICK
from ehadiag.model.scalar.transition import FINEST

NUMBER: Final = 8  # bytes

# Parameters: constants of the plant, scalars of the spool (ehadiag.model), then:
SCALARS: Final = 25
TICK: Final = 31  # s
DYNAMIC: Final = 32  # dry friction of the moving jack, N
IM: Final = 33  # control law, see ehadiag.core.actuator.Controller
GAP: Final = 34
GAI: Final = 35
GAD: Final = 36
CLOSED: Final = 37  # not 0: the command is a position
INVERTIBLE: Final = 38  # not 0: a lost position's code follows from the current
LINEAR: Final = 39  # below this current (A) it does
CODE_POSITION: Final = 40  # converter step of the position, m
ANCHOR_GAIN: Final = 41
ANCHOR_SMALL: Final = 42
ANCHOR_LARGE: Final = 43
OFFSETS: Final = 44  # of spool and pressure sensor, m and Pa
WEIGHTS: Final = 46  # reciprocal noise of both
REFERENCE: Final = 48  # CUSUM: k, h, largest residual that counts
THRESHOLD: Final = 49
LIMIT: Final = 50
DEVIATION: Final = 51  # a lost command did not go on where the current is off by more, A

# State. Flapper (m, m/s) and spool (m, m/s); direction of motion +1, -1, 0; flapper on its stop.
XF: Final = 52
WF: Final = 53
XS: Final = 54
VS: Final = 55
DIRECTION: Final = 56
CLAMPED: Final = 57
FILTERED: Final = 58  # innovation, m
# Jack: velocity, position, direction, and where it has the spool.
JACK_VELOCITY: Final = 59
JACK_POSITION: Final = 60
JACK_DIRECTION: Final = 61
JACK_SPOOL: Final = 62
# Control law.
SEEN: Final = 63  # measured position of the tick before, m; NaN if lost
ERROR_BEFORE: Final = 64
INTEGRAL: Final = 65
STARTED: Final = 66
COMMAND: Final = 67  # of the tick before, known or not, its rise over a tick, ticks lost since
SLOPE: Final = 68
LOST: Final = 69
# Results.
PREDICTED: Final = 70  # spool, pressure, position
RESIDUAL: Final = 73  # spool, pressure
CUSUM: Final = 75  # spool upper, lower; pressure upper, lower
MOVING: Final = 79  # ehadiag.model.scalar.transition.SpoolTables
STUCK: Final = MOVING + 16 * (FINEST + 1)
DECAY: Final = STUCK + 4 * (FINEST + 1)
NODES: Final = DECAY + FINEST + 1  # path of the spool, scratch
SIZE: Final = NODES + NODES_PER_TICK * NODE_COLUMNS
