"""Where the numbers of a monitor stand in its one flat array, whose address its kernel is given."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

from ehadiag.compile.rows import packer, unpacker
from ehadiag.model.control import ControlLaw, ControlState
from ehadiag.model.jack_state import JackState
from ehadiag.model.laws import DriveLaw, JackLaw, SpoolLaw
from ehadiag.model.scalar.spool_tick import NODE_COLUMNS, NODES_PER_TICK
from ehadiag.model.scalar.transition import FINEST
from ehadiag.model.sensors import SensorLaw

NUMBER: Final = 8
"""Bytes."""


class Settings(NamedTuple):
    """What a monitor is made with, beside the laws.

    Attributes
    ----------
    plays : float
        Number of plays of the hysteresis.
    closed : float
        Not 0: the command is a position.
    invertible : float
        Not 0: a lost position's code follows from the current.
    linear : float
        Below this current it does, A.
    code_position : float
        Converter step of the position, m.
    anchor_gain : float
        See `ehadiag.model.anchor.Anchor`.
    anchor_small : float
        See `anchor_gain`.
    anchor_large : float
        See `anchor_gain`.
    spool_weight : float
        Reciprocal noise of both.
    pressure_weight : float
        See `spool_weight`.
    reference : float
        Of the CUSUM: k, h, largest residual that counts.
    threshold : float
        See `reference`.
    limit : float
        See `reference`.
    deviation : float
        A lost command did not go on where the current is off by more, A.
    """

    plays: float
    closed: float
    invertible: float
    linear: float
    code_position: float
    anchor_gain: float
    anchor_small: float
    anchor_large: float
    spool_weight: float
    pressure_weight: float
    reference: float
    threshold: float
    limit: float
    deviation: float


class Moving(NamedTuple):
    """Flapper and spool between two ticks, as numbers; see `ehadiag.model.spool_events.SpoolState`.

    Attributes
    ----------
    xf : float
        Flapper deflection, m.
    wf : float
        Its rate, m/s.
    xs : float
        Spool position, m.
    vs : float
        Its velocity, m/s.
    wire : float
        End of the feedback wire, m.
    direction : float
        Of the spool's motion, +1 or -1; 0 at rest.
    clamped : float
        Not 0: the flapper is on its stop.
    filtered : float
        Innovation of the re-anchoring, m.
    jack_spool : float
        Where the jack has the spool, m.
    lagged : float
        The spool behind the filter before its converter, m.
    """

    xf: float
    wf: float
    xs: float
    vs: float
    wire: float
    direction: float
    clamped: float
    filtered: float
    jack_spool: float
    lagged: float


class Followed(NamedTuple):
    """What is known of command and position between two ticks.

    Attributes
    ----------
    seen : float
        Measured position of the tick before, m; NaN if lost.
    command : float
        Of the tick before, known or not.
    slope : float
        Its rise over a tick.
    lost : float
        Ticks lost since one was known.
    """

    seen: float
    command: float
    slope: float
    lost: float


def _place(start: int, kind: Any) -> int:
    """Behind a part that begins at `start`."""
    return start + len(kind._fields)


DRIVE_LAW: Final = 0
SPOOL_LAW: Final = _place(DRIVE_LAW, DriveLaw)
JACK_LAW: Final = _place(SPOOL_LAW, SpoolLaw)
SENSOR_LAW: Final = _place(JACK_LAW, JackLaw)
CONTROL_LAW: Final = _place(SENSOR_LAW, SensorLaw)
SETTINGS: Final = _place(CONTROL_LAW, ControlLaw)
STATE: Final = _place(SETTINGS, Settings)
MOVING: Final = STATE
JACK: Final = _place(MOVING, Moving)
CONTROL: Final = _place(JACK, JackState)
FOLLOWED: Final = _place(CONTROL, ControlState)
PREDICTED: Final = _place(FOLLOWED, Followed)
"""Spool, pressure, position."""
RESIDUAL: Final = PREDICTED + 3
"""Spool, pressure."""
CUSUM: Final = RESIDUAL + 2
"""Upper and lower sum of the spool, then of the pressure."""
PLAYS: Final = CUSUM + 4
"""What the plays of the hysteresis hold, A, as many as the settings say, and last what flows behind
the lag of the current's driver."""
MOST_PLAYS: Final = 16
TABLES: Final = PLAYS + MOST_PLAYS + 1
SLIDE: Final = TABLES
"""See `ehadiag.model.scalar.transition.SpoolTables`: spool moving with
and without the feedback wire, at rest, flapper on its stop."""
LOOSE: Final = SLIDE + 16 * (FINEST + 1)
RING: Final = LOOSE + 16 * (FINEST + 1)
DECAY: Final = RING + 4 * (FINEST + 1)
NODES: Final = DECAY + FINEST + 1
"""The path of a tick, behind all tables."""
SIZE: Final = NODES + NODES_PER_TICK * NODE_COLUMNS

drive_law_of = unpacker(DriveLaw, DRIVE_LAW)
spool_law_of, jack_law_of = unpacker(SpoolLaw, SPOOL_LAW), unpacker(JackLaw, JACK_LAW)
sensor_law_of = unpacker(SensorLaw, SENSOR_LAW)
control_law_of = unpacker(ControlLaw, CONTROL_LAW)
settings_of = unpacker(Settings, SETTINGS)
moving_of, keep_moving = unpacker(Moving, MOVING), packer(Moving, MOVING)
jack_of, keep_jack = unpacker(JackState, JACK), packer(JackState, JACK)
control_of, keep_control = unpacker(ControlState, CONTROL), packer(ControlState, CONTROL)
followed_of, keep_followed = unpacker(Followed, FOLLOWED), packer(Followed, FOLLOWED)
