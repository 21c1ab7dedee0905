"""How candidates stand side by side: WIDTH of them in a vector, LANES in a block.

Arrays are flat, row r of lane i at r * LANES + i.
"""

from __future__ import annotations

from ehadiag.compile.rows import lane_of, lane_packer, lanes_of
from ehadiag.compile.vector import WIDTH
from ehadiag.model.laws import DriveLaw, JackLaw, SpoolLaw
from ehadiag.model.sensors import Follow, SensorLaw

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
    FILTERED,
    FRESH,
    DONE,
    DEFLECTION,
    WIRE,
    SEEN,
    SPOOL_LAGGED,
    PRESSURE,
    LAGGED,
    PRESSURE_SEEN,
    POSITION,
    ANCHORED,
    FLOWING,
    PLAYS,
) = range(24)
"""Rows of the state. DEFLECTION: of the flapper by the current alone; SEEN: spool as it is sampled;
SPOOL_LAGGED, LAGGED: spool and pressure behind the filter at the end of the tick; PRESSURE: stored
in the oil of an orifice stage; PRESSURE_SEEN, POSITION: pressure and jack as they are sampled;
WIRE: end of the feedback wire; FRESH: the jack has just started or stopped; DONE: it has taken this
tick beside the spool; ANCHORED: how often the lane was re-anchored, which goes on from span to
span; FLOWING: current behind its driver's lag."""

MOST_PLAYS = 16
STATE_ROWS = PLAYS + MOST_PLAYS
"""What the plays of the hysteresis hold stands in the last rows."""
PLACE, SLOPE = 0, NODES + 1
PATH_ROWS = 2 * (NODES + 1)
"""Rows of the path: position and velocity of the spool at the nodes 0 … NODES."""

DRIVE_LAW = 0
SPOOL_LAW = DRIVE_LAW + len(DriveLaw._fields)
JACK_LAW = SPOOL_LAW + len(SpoolLaw._fields)
SENSOR_LAW = JACK_LAW + len(JackLaw._fields)
ROOM = SENSOR_LAW + len(SensorLaw._fields)
RING_TIME = ROOM + 1
REST = RING_TIME + 1
MOVE = REST + 4
LOOSE = MOVE + 16
IDLE = LOOSE + 16
SENSING = IDLE + 1
MOST_HALVINGS = 4
"""The jack takes at most 2^MOST_HALVINGS steps a tick."""
SENSING_ROWS = 2 * len(Follow._fields) + 1
"""For steps of the tick halved so often: how the filter follows a whole one, and up to the instant
of sampling, and the number of the step that holds it."""
COEFFICIENT_ROWS = SENSING + (MOST_HALVINGS + 1) * SENSING_ROWS
"""Rows of the coefficients: the laws' fields; flapper deflection within which a resting spool
stays; reciprocal of the ringing's rate; transitions over a whole tick at rest (2 x 2), over a
quarter of a tick moving (4 x 4), and the same without the feedback wire; 1 in a lane that holds no
candidate, whose events nobody waits for; the filter before the converters."""

drive_laws = lanes_of(DriveLaw, DRIVE_LAW, LANES)
spool_laws = lanes_of(SpoolLaw, SPOOL_LAW, LANES)
jack_laws = lanes_of(JackLaw, JACK_LAW, LANES)
sensor_laws = lanes_of(SensorLaw, SENSOR_LAW, LANES)
whole_steps = lanes_of(Follow, SENSING, LANES)
sampled_steps = lanes_of(Follow, SENSING + len(Follow._fields), LANES)
"""Compiled, of an array and a lane: laws of the WIDTH lanes from there. For the filter a lane
stands for one of a number of halvings, n SENSING_ROWS LANES further on."""
spool_law_of_lane = lane_of(SpoolLaw, SPOOL_LAW, LANES)
jack_law_of_lane = lane_of(JackLaw, JACK_LAW, LANES)
sensor_law_of_lane = lane_of(SensorLaw, SENSOR_LAW, LANES)
"""Compiled, of an array and a lane: laws of that lane."""
keep_drive_law = lane_packer(DriveLaw, DRIVE_LAW, LANES)
keep_spool_law = lane_packer(SpoolLaw, SPOOL_LAW, LANES)
keep_jack_law = lane_packer(JackLaw, JACK_LAW, LANES)
keep_sensor_law = lane_packer(SensorLaw, SENSOR_LAW, LANES)
keep_whole_step = lane_packer(Follow, SENSING, LANES)
keep_sampled_step = lane_packer(Follow, SENSING + len(Follow._fields), LANES)
"""Compiled, of an array, a lane and a law: write that lane's."""
