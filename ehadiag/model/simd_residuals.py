"""Residuals of candidates by the model, as many at a time as a block has lanes."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ehadiag.compile.jit import Array, Array2, Array3, kernel, merged, packed_argument
from ehadiag.compile.vector import LANES, VECTOR_WIDTH, load, minimum, packed, store
from ehadiag.model.batch import POSITION_ROW, PRESSURE_ROW, SIGNAL_ROWS, SPOOL_ROW, Batch
from ehadiag.model.plant import PLANT_FIELDS, PlantConstants
from ehadiag.model.sensors import read_pressure, read_spool
from ehadiag.model.simd_jack import anchor_jack_lanes, sampled_positions
from ehadiag.model.simd_layout import (
    BLOCK,
    COEFFICIENTS,
    ROWS,
    BlockTraits,
    aligned_numbers,
    block_part,
    block_places,
    sensor_laws,
    tabulate_coefficients,
)
from ehadiag.model.simd_spool import anchor_spool_lanes, drive_lanes
from ehadiag.model.simd_tick import advance_block, rest_block


class BlockScratch(NamedTuple):
    """Scratch of the kernels below, one for each thread."""

    levels: NDArray[np.int64]
    """How often the jack's ticks are halved, 0 … 4. The same for every candidate, so that no answer
    depends on the others in its block. Of no meaning where no pressure counts: there the jack is
    left out. Shape (N,)."""
    memory: Array
    """Of a block, see `ehadiag.model.simd_layout`."""
    rows: Array2
    """Candidates of a block, in the test of the span at hand; shape (lanes, PLANT_FIELDS)."""
    sums: Array
    sample: Array
    """Costs, and residuals of one sample; shape (lanes,)."""
    no_costs: Array
    uncounted: NDArray[np.int64]
    no_residuals: Array3
    """What is not wanted, of no candidate."""


def jack_levels(batch: Batch, scattered: Array) -> NDArray[np.int64]:
    """Halvings of the jack's ticks, shape (N,), by a run of candidates all over the space.

    scattered: their constants, shape (LANES or less, tests, PLANT_FIELDS).
    """
    levels = np.full(batch.weight.shape[1], -1, dtype=np.int64)
    if batch.weight[PRESSURE_ROW:].any():
        # Without weights the jack is left out, and the spool's path is all that is looked at.
        spool_only = batch._replace(weight=np.zeros_like(batch.weight))
        runs = BlockRuns(spool_only, block_scratch(levels))
        runs.costs(scattered, 1.0, np.empty(len(scattered)))
    return levels


def block_scratch(levels: NDArray[np.int64], lanes: int = LANES) -> BlockScratch:
    """Scratch with the jack's steps; those below 0 are found by the first block that is run."""
    return BlockScratch(
        levels=levels,
        memory=aligned_numbers(block_places(lanes).end),
        rows=np.zeros((lanes, PLANT_FIELDS)),
        sums=aligned_numbers(lanes),
        sample=aligned_numbers(lanes),
        no_costs=np.zeros(0),
        uncounted=np.zeros(0, dtype=np.int64),
        no_residuals=np.zeros((0, 0, 0)),
    )


@packed
def _add_residual(
    end: int, measured: float, weight: float, cap: float, row: int, signal: int,
    state: Array, coefficients: Array,
    sample: Array, sums: Array,
) -> None:  # fmt: skip
    """Weighted residual of one sample in every lane, its capped square added to the sums.

    row: of the state; signal: row of the residuals.
    """
    for o in range(0, end, VECTOR_WIDTH):
        law = sensor_laws(coefficients, o)
        value = load(state, row * LANES + o)
        if signal == SPOOL_ROW:
            shown = read_spool(law, value)
        elif signal == PRESSURE_ROW:
            shown = read_pressure(law, value)
        else:
            shown = law.position_offset + law.position_gain * value
        residual = (measured - shown) * weight
        store(sample, o, residual)
        store(sums, o, load(sums, o) + minimum(residual * residual, cap))


@merged
def _block(
    batch: Batch, candidates: Array, cap: float, work: BlockScratch, address: int,
    out: Array,
) -> None:  # fmt: skip
    """Costs of up to LANES candidates into `work.sums`, residuals of the first ones into `out`.

    address: of the block's memory; out: shape (LANES or less, signals, N), or of no candidate.
    """
    state = block_part(address, BLOCK.state, BLOCK.path)
    coefficients = block_part(address, BLOCK.coefficients, BLOCK.moving)
    rows, sums, sample = work.rows, work.sums, work.sample
    current, spool, pressure = batch.current, batch.spool, batch.pressure
    position, weight, levels, start = batch.position, batch.weight, work.levels, batch.start
    located = weight.shape[0] > POSITION_ROW
    count, wanted = candidates.shape[0], out.shape[0]
    # Lanes that hold no candidate repeat the last one up to its first event; a half of none is left
    # out.
    end = VECTOR_WIDTH if count <= VECTOR_WIDTH else LANES
    has = BlockTraits(False, False, False, False, False, False, 0)
    sums[:] = 0.0
    state[:] = 0.0
    for index in range(batch.tick.shape[0]):
        tick, test = batch.tick[index], batch.test[index]
        gain, small, large, follow, until = batch.anchor[index]
        anchored = math.isfinite(small) or math.isfinite(large)
        if index == 0 or test != batch.test[index - 1] or tick != batch.tick[index - 1]:
            for i in range(LANES):
                for field in range(PLANT_FIELDS):
                    rows[i, field] = candidates[min(i, count - 1), test, field]
            has = tabulate_coefficients(address, rows, tick)
            for i in range(count, LANES):
                coefficients[COEFFICIENTS.idle * LANES + i] = 1.0
        # Most candidates are read at the end of the tick, where the spool is at hand.
        read = ROWS.spool_sampled if has.senses else ROWS.spool
        since = batch.since[index]
        state[ROWS.current * LANES :] = 0.0
        for k in range(since - batch.history[index], since):
            drive_lanes(end, current[k], has.plays, state, coefficients)
        rest_block(address, end, has.plays, batch.origin[index], batch.place[index])
        last = start[index + 1] - 1
        while last >= start[index] and not weight[PRESSURE_ROW:, last].any():
            last -= 1
        for k in range(start[index], start[index + 1]):
            # Nothing depends on the jack but pressure and position.
            levels[k] = advance_block(
                address, count, end, current[since + k - start[index]], tick, has, k <= last,
                levels[k],
            )  # fmt: skip
            seen = math.isfinite(spool[k])
            if weight[SPOOL_ROW, k] != 0.0 and seen:
                _add_residual(
                    end, spool[k], weight[SPOOL_ROW, k], cap, read, SPOOL_ROW,
                    state, coefficients, sample, sums,
                )  # fmt: skip
                for i in range(wanted):
                    out[i, SPOOL_ROW, k] = sample[i]
            if weight[PRESSURE_ROW, k] != 0.0 and math.isfinite(pressure[k]):
                _add_residual(
                    end, pressure[k], weight[PRESSURE_ROW, k], cap, ROWS.pressure_sampled,
                    PRESSURE_ROW,
                    state, coefficients, sample, sums,
                )  # fmt: skip
                for i in range(wanted):
                    out[i, PRESSURE_ROW, k] = sample[i]
            if located and math.isfinite(position[k]):
                sampled_positions(end, state, coefficients)
                if weight[POSITION_ROW, k] != 0.0:
                    _add_residual(
                        end, position[k], weight[POSITION_ROW, k], cap, ROWS.position_sampled,
                        POSITION_ROW,
                        state, coefficients, sample, sums,
                    )  # fmt: skip
                    for i in range(wanted):
                        out[i, POSITION_ROW, k] = sample[i]
                if follow != 0.0:
                    anchor_jack_lanes(end, position[k], follow, state, coefficients)
            if anchored and seen and k - start[index] < until:
                anchor_spool_lanes(end, read, spool[k], gain, small, large, state, coefficients)


@kernel
def run_blocks(
    batch: Batch,
    candidates: Array3,
    cap: float,
    work: BlockScratch,
    address: int,
    costs: Array,
    anchored: NDArray[np.int64],
    residuals: Array3,
) -> None:
    """Run the candidates LANES at a time; out are costs, counts and residuals of all or of none."""
    n = candidates.shape[0]
    for first in range(0, n, LANES):
        here = min(LANES, n - first)
        _block(
            batch, candidates[first : first + here], cap, work, address,
            residuals[first : first + here],
        )  # fmt: skip
        for i in range(min(here, costs.shape[0] - first)):
            costs[first + i] = work.sums[i]
        for i in range(min(here, anchored.shape[0] - first)):
            count = block_part(address, BLOCK.state, BLOCK.path)[ROWS.anchor_count * LANES + i]
            anchored[first + i] = int(count)


class BlockRuns:
    """Runs of candidates over spans of recordings, LANES at a time, by one thread.

    What the kernel is given in each call is prepared once.
    """

    def __init__(self, batch: Batch, work: BlockScratch) -> None:
        self.batch = batch
        self.work = work
        self._batch = packed_argument(Batch._make(map(np.ascontiguousarray, batch)))
        self._scratch = packed_argument(work)
        self._address = work.memory.ctypes.data

    def of_thread(self) -> BlockRuns:
        """Return the runs of another thread, with the same steps of the jack."""
        return BlockRuns(self.batch, block_scratch(self.work.levels.copy()))

    def costs(self, candidates: Array, cap: float, out: Array) -> None:
        """Write the summed squared weighted residuals of each candidate, each square at most `cap`.

        candidates: shape (n, tests, PLANT_FIELDS); out: shape (n,).
        """
        run_blocks(
            self._batch, candidates, cap, self._scratch, self._address,
            out, self.work.uncounted, self.work.no_residuals,
        )  # fmt: skip

    def residuals(self, candidates: Array, out: Array, anchored: NDArray[np.int64]) -> None:
        """Write weighted residuals, measured less modelled, of every candidate.

        out: shape (n, signals, N), 0 of a missing sample; anchored: how often the model was
        re-anchored, shape (n,).
        """
        out[:] = 0.0
        run_blocks(
            self._batch, candidates, math.inf, self._scratch, self._address,
            self.work.no_costs, anchored, out,
        )  # fmt: skip


@kernel
def run_single(
    batch: Batch, candidate: Array3, work: BlockScratch, address: int, out: Array3
) -> int:
    """Residuals of one candidate, its jack's steps by its own path; returns its re-anchorings.

    Compiled for one lane.
    """
    for k in range(work.levels.shape[0]):
        work.levels[k] = -1
    _block(batch, candidate, math.inf, work, address, out)
    return int(block_part(address, BLOCK.state, BLOCK.path)[ROWS.anchor_count])


@kernel
def respond(
    constants: PlantConstants,
    address: int,
    row: Array2,
    current: Array,
    tick: float,
    origin: float,
    place: float,
    history: Array,
    measured: Array,
    anchor: Array,
    response: Array2,
) -> None:
    """Spool, pressure and position of every tick, from rest, and the re-anchorings until then.

    Compiled for one lane. address: of its memory; row: scratch, shape (1, PLANT_FIELDS); see
    `ehadiag.model.residual_models.model_response`. Writes the response, SI, shape (4, n), as it is
    sampled, before any re-anchoring of the tick; the last row counts these.
    """
    state = block_part(address, BLOCK.state, BLOCK.path)
    coefficients = block_part(address, BLOCK.coefficients, BLOCK.moving)
    for field in range(PLANT_FIELDS):
        row[0, field] = constants[field]
    state[:] = 0.0
    has = tabulate_coefficients(address, row, tick)
    for k in range(history.shape[0]):
        drive_lanes(1, history[k], has.plays, state, coefficients)
    rest_block(address, 1, has.plays, origin, place)
    read = ROWS.spool_sampled if has.senses else ROWS.spool
    for k in range(current.shape[0]):
        advance_block(address, 1, 1, current[k], tick, has, True, -1)
        sampled_positions(1, state, coefficients)
        response[SPOOL_ROW, k] = state[read]
        response[PRESSURE_ROW, k] = state[ROWS.pressure_sampled]
        response[POSITION_ROW, k] = state[ROWS.position_sampled]
        if math.isfinite(measured[k]):
            anchor_spool_lanes(
                1, read, measured[k], anchor[0], anchor[1], anchor[2], state, coefficients
            )
        response[SIGNAL_ROWS, k] = state[ROWS.anchor_count]
