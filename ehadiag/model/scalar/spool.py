"""First stage and spool over a whole record: kernel of the monitoring model."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import kernel
from ehadiag.model.anchor import re_anchored
from ehadiag.model.laws import drive_law
from ehadiag.model.plant import PlantConstants
from ehadiag.model.scalar.drive import deflection_held, drive
from ehadiag.model.scalar.spool_tick import sensed_path, spool_rest, spool_tick
from ehadiag.model.scalar.transition import SpoolTables
from ehadiag.model.sensors import read_spool, sensor_law
from ehadiag.model.spool_events import SpoolState

__all__ = ["spool_response"]


@kernel
def spool_response(
    constants: PlantConstants,
    tables: SpoolTables,
    current: NDArray[np.float64],
    tick: float,
    origin: float,
    history: NDArray[np.float64],
    measured: NDArray[np.float64],
    anchor: NDArray[np.float64],
    spool: NDArray[np.float64],
    nodes: NDArray[np.float64],
    node_end: NDArray[np.int64],
) -> int:
    """Spool position at the end of every tick, from rest.

    Parameters
    ----------
    current: servovalve current of each tick, A, shape (n,).
    tick: s.
    origin: spool position before the first tick, m.
    history: current of all ticks before, A, shape (h,): it has loaded the hysteresis, and the
        flapper is in equilibrium with its last.
    measured: measured spool position, m, shape (n,), NaN where missing; used only to re-anchor.
    anchor: (gain, small, large, …), see `ehadiag.model.anchor.Anchor`.
    spool: out, m, shape (n,), as it is sampled, the prediction before any re-anchoring.
    nodes: out, shape (n * NODES_PER_TICK, NODE_COLUMNS), the path as `spool_tick` writes it, with
        the jump that a re-anchoring adds after a tick's last piece.
    node_end: out, shape (n,), index one past the last node of each tick.

    Returns
    -------
    How many times the model was re-anchored.
    """
    motor, law, sensor = drive_law(constants, tick), tables.law, sensor_law(constants)
    held = np.zeros(int(constants.NPL) + 1)
    for k in range(history.shape[0]):
        drive(motor, held, history[k])
    s = spool_rest(law, deflection_held(motor, held), origin)
    count, anchored, filtered, lagged = 0, 0, 0.0, s.xs
    for k in range(current.shape[0]):
        before, first = s.xs, count
        s, count = spool_tick(tables, drive(motor, held, current[k]), tick, s, nodes, count)
        node_end[k] = count
        spool[k], lagged = sensed_path(sensor, tick, nodes, first, count, before, lagged)
        xs, filtered, moved = re_anchored(
            measured[k] - read_spool(sensor, spool[k]),
            anchor[0], anchor[1], anchor[2], s.xs, filtered, law.stroke,
        )  # fmt: skip
        if moved:
            nodes[count - 1, 4] = xs - s.xs
            lagged += xs - s.xs
            s = SpoolState(s.xf, s.wf, xs, s.vs, s.wire + (xs - s.xs), s.direction, s.clamped)
            anchored += 1
    return anchored
