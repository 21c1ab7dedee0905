"""Kernels of the objective: many candidates against one or more recordings.

Candidates are rows of a matrix; recordings stand one behind the other in flat arrays, so that one
compiled function serves any number of either.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.kernels import kernel
from ehadiag.model.plant import PlantConstants
from ehadiag.model.scalar.jack import jack_response
from ehadiag.model.scalar.spool import NODE_COLUMNS, NODES_PER_TICK, spool_response
from ehadiag.model.scalar.transition import spool_tables

__all__ = ["Batch", "Workspace", "constants_of", "costs", "residuals", "spool_rates", "workspace"]


class Batch(NamedTuple):
    """Recordings (or spans of them) to explain; m of them, N ticks in all.

    constants: shape (m, fields of PlantConstants).
    tick: s, shape (m,).
    start: first tick of each span in the flat arrays, then N, shape (m + 1,).
    origin: spool position before the first tick of each span, m, shape (m,).
    current_before: current before the first tick of each span, A, shape (m,).
    current: A, shape (N,).
    spool, pressure: measured, m and Pa, shape (N,), NaN where missing.
    weight: reciprocal noise of spool and pressure, 0 where not used, shape (2, N).
    anchor: re-anchoring in each span (see `Anchor`), shape (m, 3).
    """

    constants: NDArray[np.float64]
    tick: NDArray[np.float64]
    start: NDArray[np.int64]
    origin: NDArray[np.float64]
    current_before: NDArray[np.float64]
    current: NDArray[np.float64]
    spool: NDArray[np.float64]
    pressure: NDArray[np.float64]
    weight: NDArray[np.float64]
    anchor: NDArray[np.float64]


class Workspace(NamedTuple):
    """Scratch arrays, so that no evaluation allocates; one for each thread."""

    spool: NDArray[np.float64]
    pressure: NDArray[np.float64]
    position: NDArray[np.float64]
    nodes: NDArray[np.float64]
    node_end: NDArray[np.int64]


def workspace(batch: Batch) -> Workspace:
    """Scratch for a batch."""
    longest = int(np.diff(batch.start).max())
    return Workspace(
        spool=np.empty(longest),
        pressure=np.empty(longest),
        position=np.empty(longest),
        nodes=np.empty((longest * NODES_PER_TICK, NODE_COLUMNS)),
        node_end=np.empty(longest, dtype=np.int64),
    )


@kernel
def constants_of(row: NDArray[np.float64]) -> PlantConstants:
    """Constants of a span, `row` of `Batch.constants`."""
    return PlantConstants(
        row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7], row[8], row[9],
        row[10], row[11], row[12], row[13], row[14], row[15], row[16], row[17], row[18], row[19],
        row[20], row[21], row[22], row[23], row[24],
    )  # fmt: skip


@kernel
def _run_spool(batch: Batch, candidate: NDArray[np.float64], work: Workspace, index: int) -> int:
    """Spool's path of one span into the workspace; returns how often it was re-anchored."""
    a, b = batch.start[index], batch.start[index + 1]
    constants = constants_of(batch.constants[index])
    tick = batch.tick[index]
    return spool_response(
        constants,
        spool_tables(constants, candidate[0], candidate[1], tick),
        batch.current[a:b],
        tick,
        batch.origin[index],
        batch.current_before[index],
        batch.spool[a:b] - candidate[3],
        batch.anchor[index],
        work.spool[: b - a],
        work.nodes,
        work.node_end[: b - a],
    )


@kernel
def residuals(
    batch: Batch, candidate: NDArray[np.float64], work: Workspace, out: NDArray[np.float64]
) -> int:
    """Weighted gaps, measured less modelled, of spool and pressure: out, shape (2, N).

    `candidate` is (Kintas, FSS, FDJ, spool offset in m, pressure offset in Pa). A missing sample
    gives 0. Returns how often the model was re-anchored.
    """
    anchored = 0
    for index in range(batch.tick.shape[0]):
        a, b = batch.start[index], batch.start[index + 1]
        n = b - a
        anchored += _run_spool(batch, candidate, work, index)
        jack_response(
            constants_of(batch.constants[index]),
            candidate[2],
            batch.origin[index],
            work.nodes,
            work.node_end[:n],
            work.pressure[:n],
            work.position[:n],
        )
        for k in range(n):
            gap = (batch.spool[a + k] - candidate[3] - work.spool[k]) * batch.weight[0, a + k]
            out[0, a + k] = gap if math.isfinite(gap) else 0.0
            gap = (batch.pressure[a + k] - candidate[4] - work.pressure[k]) * batch.weight[1, a + k]
            out[1, a + k] = gap if math.isfinite(gap) else 0.0
    return anchored


@kernel
def spool_rates(
    batch: Batch, candidate: NDArray[np.float64], work: Workspace, out: NDArray[np.float64]
) -> None:
    """Velocity of the modelled spool at the end of each tick: out, m/s, shape (N,)."""
    for index in range(batch.tick.shape[0]):
        _run_spool(batch, candidate, work, index)
        a = batch.start[index]
        for k in range(batch.start[index + 1] - a):
            out[a + k] = work.nodes[work.node_end[k] - 1, 3]


@kernel
def costs(
    batch: Batch,
    candidates: NDArray[np.float64],
    cap: float,
    work: Workspace,
    gaps: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """Summed squared weighted gap of each candidate, each square at most `cap`: out, shape (n,)."""
    for i in range(candidates.shape[0]):
        residuals(batch, candidates[i], work, gaps)
        total = 0.0
        for channel in range(2):
            for k in range(gaps.shape[1]):
                total += min(gaps[channel, k] * gaps[channel, k], cap)
        out[i] = total
