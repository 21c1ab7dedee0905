"""Where the numbers of a monitor stand in its two flat arrays.

A kernel call takes flat arrays at once; a named tuple would be looked through field by field.
"""

from __future__ import annotations

from typing import Final

# Parameters: constants of the plant, scalars of the spool (ehadiag.model), then:
SCALARS: Final = 25
TICK: Final = 31  # s
DYNAMIC: Final = 32  # dry friction of the moving jack, N
IM: Final = 33  # control law, see ehadiag.actuator.Controller
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
PARAMETERS: Final = 52

# State. Flapper (m, m/s) and spool (m, m/s); direction of motion +1, -1, 0; flapper on its stop.
XF: Final = 0
WF: Final = 1
XS: Final = 2
VS: Final = 3
DIRECTION: Final = 4
CLAMPED: Final = 5
FILTERED: Final = 6  # innovation, m
# Jack: velocity, position, direction, and where it has the spool.
JACK_VELOCITY: Final = 7
JACK_POSITION: Final = 8
JACK_DIRECTION: Final = 9
JACK_SPOOL: Final = 10
# Control law.
SEEN: Final = 11  # measured position of the tick before, m; NaN if lost
ERROR_BEFORE: Final = 12
INTEGRAL: Final = 13
STARTED: Final = 14
COMMAND: Final = 15  # of the tick before, known or not, its rise over a tick, ticks lost since
SLOPE: Final = 16
LOST: Final = 17
# Results.
PREDICTED: Final = 18  # spool, pressure, position
RESIDUAL: Final = 21  # spool, pressure
CUSUM: Final = 23  # spool upper, lower; pressure upper, lower
STATES: Final = 27
