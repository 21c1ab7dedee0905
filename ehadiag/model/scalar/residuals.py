"""Residuals of candidates by the scalar kernels, one candidate at a time.

What the target computer runs, and the reference for the vector kernels.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import inlined, kernel
from ehadiag.model.batch import POSITION_ROW, PRESSURE_ROW, SPOOL_ROW, Batch, longest_span
from ehadiag.model.laws import BEND
from ehadiag.model.parameters import Unknowns
from ehadiag.model.plant import plant_of
from ehadiag.model.scalar.jack import jack_response
from ehadiag.model.scalar.spool import spool_response
from ehadiag.model.scalar.spool_tick import NODE_COLUMNS, NODES_PER_TICK
from ehadiag.model.scalar.transition import spool_tables
from ehadiag.model.sensors import read_pressure, read_spool, sensor_law

__all__ = ["ScalarModel"]


class _Workspace(NamedTuple):
    """Scratch arrays, so that no evaluation allocates; one for each thread."""

    spool: NDArray[np.float64]
    pressure: NDArray[np.float64]
    position: NDArray[np.float64]
    nodes: NDArray[np.float64]
    node_end: NDArray[np.int64]


def _workspace(batch: Batch) -> _Workspace:
    longest = longest_span(batch)
    return _Workspace(
        spool=np.empty(longest),
        pressure=np.empty(longest),
        position=np.empty(longest),
        nodes=np.empty((longest * NODES_PER_TICK, NODE_COLUMNS)),
        node_end=np.empty(longest, dtype=np.int64),
    )


@inlined
def _weighted(error: float, weight: float) -> float:
    """Residual of a sample, 0 where it is missing."""
    residual = error * weight
    return residual if math.isfinite(residual) else 0.0


@kernel
def _residuals(
    batch: Batch,
    candidate: NDArray[np.float64],
    bend: float,
    work: _Workspace,
    out: NDArray[np.float64],
) -> int:
    """Weighted residuals of one candidate, rows of constants of shape (tests, FIELDS)."""
    anchored, signals = 0, batch.weight.shape[0]
    for index in range(batch.tick.shape[0]):
        a, b = batch.start[index], batch.start[index + 1]
        n = b - a
        constants, tick = plant_of(candidate[batch.test[index]]), batch.tick[index]
        anchored += spool_response(
            constants,
            spool_tables(constants, tick, bend),
            batch.current[batch.since[index] : batch.since[index] + n],
            tick,
            batch.origin[index],
            batch.current[batch.since[index] - batch.history[index] : batch.since[index]],
            batch.spool[a:b],
            batch.anchor[index],
            work.spool[:n],
            work.nodes,
            work.node_end[:n],
        )
        follow = batch.anchor[index, 3] if signals > POSITION_ROW else 0.0
        jack_response(
            constants,
            tick,
            batch.origin[index],
            batch.place[index],
            follow,
            batch.position[a:b],
            work.nodes,
            work.node_end[:n],
            work.pressure[:n],
            work.position[:n],
        )
        law = sensor_law(constants)
        for k in range(n):
            spool = batch.spool[a + k] - read_spool(law, work.spool[k])
            out[SPOOL_ROW, a + k] = _weighted(spool, batch.weight[SPOOL_ROW, a + k])
            pressure = batch.pressure[a + k] - read_pressure(law, work.pressure[k])
            out[PRESSURE_ROW, a + k] = _weighted(pressure, batch.weight[PRESSURE_ROW, a + k])
            if signals > POSITION_ROW:
                position = batch.position[a + k] - law.position_offset
                position -= law.position_gain * work.position[k]
                out[POSITION_ROW, a + k] = _weighted(position, batch.weight[POSITION_ROW, a + k])
    return anchored


class ScalarModel:
    """A `ehadiag.model.interface.ResidualModel` of scalar kernels.

    Parameters
    ----------
    bend : float
        Of the spool's path that a linear second stage does not feel, m.
    """

    def __init__(self, batch: Batch, unknowns: Unknowns, bend: float = BEND) -> None:
        self.batch = batch
        self.unknowns = unknowns
        self._bend = bend
        self.evaluations = 0
        self._work = _workspace(batch)

    def residuals(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """See the protocol."""
        out = np.empty((len(points), *self.batch.weight.shape))
        anchored = np.empty(len(points), dtype=np.int64)
        for i, candidate in enumerate(self.unknowns.candidates(points)):
            anchored[i] = _residuals(self.batch, candidate, self._bend, self._work, out[i])
        self.evaluations += len(points)
        return out, anchored

    def costs(self, points: NDArray[np.float64], cap: float) -> NDArray[np.float64]:
        """See the protocol."""
        return np.asarray(np.minimum(self.residuals(points)[0] ** 2, cap).sum(axis=(1, 2)))
