"""A tick of a block of candidates: current in; spool, pressure and jack as they are sampled out."""

from __future__ import annotations

from typing import NamedTuple

from ehadiag.compile.jit import Array, bare_kernel, merged
from ehadiag.compile.vector import (
    LANES,
    VECTOR_WIDTH,
    absolute,
    any_lane,
    load,
    maximum,
    minimum,
    packed,
    where,
)
from ehadiag.model.simd_jack import (
    jack_tick,
    land_opening_lanes,
    orifice_level,
    orifice_tick,
    rest_jack_lanes,
    sampled_pressures,
    sensed_jack_tick,
    sensed_orifice_tick,
)
from ehadiag.model.simd_layout import BLOCK, MAX_JACK_HALVINGS, BlockTraits, block_part
from ehadiag.model.simd_spool import (
    creep_lanes,
    deflect_lanes,
    drive_lanes,
    rest_spool_lanes,
    sample_spool_lanes,
    spool_lanes,
)
from ehadiag.model.simd_spool_events import event_ticks
from ehadiag.model.simd_spool_halving import halved_lanes


class JackLevelRules(NamedTuple):
    """Rules for the number of steps of the jack in a tick."""

    bow: float = 0.008e-6
    """Distance of the spool's path from its chord for two steps, m, where the orifice is almost
    closed; elsewhere in proportion to its opening."""
    bow_ratio: float = 6.0
    """Ratio of that distance for four steps to that for two, 1."""
    opening: float = 10.0e-6
    """Opening below which the orifice is almost closed, m."""
    travel_share: float = 0.15
    """Travel for two steps, as a share of the opening, 1."""
    crossing: float = 5.0e-6
    """Travel past the closed orifice for eight steps, m; four times that: sixteen."""


JACK_LEVELS = JackLevelRules()


@packed
def _jack_level(path: Array) -> int:
    """Halvings of this tick for the jack of the most exacting lane."""
    level = 0
    for o in range(0, LANES, VECTOR_WIDTH):
        x0, x4 = load(path, o), load(path, 4 * LANES + o)
        x1, x2, x3 = load(path, LANES + o), load(path, 2 * LANES + o), load(path, 3 * LANES + o)
        near = where(x0 * x4 > 0.0, minimum(absolute(x0), absolute(x4)), 0.0)
        near = maximum(near, JACK_LEVELS.opening)
        bow = maximum(absolute(x1 - 0.75 * x0 - 0.25 * x4), absolute(x3 - 0.25 * x0 - 0.75 * x4))
        bow = maximum(bow, absolute(x2 - 0.5 * (x0 + x4)))
        need = maximum(
            bow * (JACK_LEVELS.opening / JACK_LEVELS.bow),
            absolute(x4 - x0) / JACK_LEVELS.travel_share,
        )
        crosses = where(near <= JACK_LEVELS.opening, absolute(x4 - x0), 0.0)
        if any_lane(crosses > 4.0 * JACK_LEVELS.crossing):
            level = max(level, 4)
        elif any_lane(crosses > JACK_LEVELS.crossing):
            level = max(level, 3)
        if any_lane(need > JACK_LEVELS.bow_ratio * near):
            level = max(level, 2)
        elif any_lane(need > near):
            level = max(level, 1)
    return level


@bare_kernel
def _other_jack_tick(
    end: int,
    orifice: bool,
    senses: bool,
    tick: float,
    level: int,
    state: Array,
    path: Array,
    coefficients: Array,
    scratch: Array,
) -> None:
    """Jack of all lanes over a tick, behind orifices or with the pressure as its filter has it.

    Apart from the plain one, so that this stays as it is.
    """
    if orifice and senses:
        sensed_orifice_tick(end, tick, level, state, path, coefficients, scratch)
    elif orifice:
        orifice_tick(end, tick, level, state, path, coefficients, scratch)
    else:
        sensed_jack_tick(end, tick, level, state, path, coefficients)


@merged
def rest_block(address: int, end: int, plays: int, origin: float, place: float) -> None:
    """All lanes at rest, spool and jack at these positions (m), currents as the plays hold them."""
    state = block_part(address, BLOCK.state, BLOCK.path)
    coefficients = block_part(address, BLOCK.coefficients, BLOCK.moving)
    deflect_lanes(end, plays, state, coefficients)
    rest_spool_lanes(end, origin, state, coefficients)
    rest_jack_lanes(end, origin, place, state, coefficients)


@bare_kernel
def advance_block(
    address: int, count: int, end: int, current: float, tick: float, has: BlockTraits,
    with_jack: bool, level: int,
) -> int:  # fmt: skip
    """Advance a block by a tick of a current (A).

    count, end: lanes with a candidate, and those that are computed; tick: s; has: what
    `tabulate_coefficients` has returned; with_jack: whether the jack goes along; level: halvings
    of the tick for the jack, -1: by the spool's path, -2: one more than that. Returns the level.
    Spool and pressure as they are sampled are then in the state.
    """
    state = block_part(address, BLOCK.state, BLOCK.path)
    path = block_part(address, BLOCK.path, BLOCK.coefficients)
    coefficients = block_part(address, BLOCK.coefficients, BLOCK.moving)
    drive_lanes(end, current, has.plays, state, coefficients)
    busy = spool_lanes(end, tick, has, state, path, coefficients)
    if busy and has.creeps:
        busy = creep_lanes(end, tick, state, path, coefficients)
    if busy:
        busy = halved_lanes(
            end, tick, has, with_jack, state, path, coefficients,
            block_part(address, BLOCK.slides, BLOCK.free_slides),
            block_part(address, BLOCK.free_slides, BLOCK.rings),
            block_part(address, BLOCK.rings, BLOCK.pieces),
            block_part(address, BLOCK.pieces, BLOCK.scratch),
        )  # fmt: skip
    if busy:
        event_ticks(
            count, tick, with_jack, state, path, coefficients,
            block_part(address, BLOCK.moving, BLOCK.loose),
            block_part(address, BLOCK.loose, BLOCK.stuck),
            block_part(address, BLOCK.stuck, BLOCK.slides),
            block_part(address, BLOCK.pieces, BLOCK.scratch),
        )  # fmt: skip
    if has.senses:
        sample_spool_lanes(end, tick, state, path, coefficients)
    if has.shaped:
        land_opening_lanes(end, path, coefficients)
    if level < 0:
        finer = min(_jack_level(path) - 1 - level, MAX_JACK_HALVINGS)
        level = orifice_level(tick, coefficients) if has.orifice else finer
    if with_jack:
        if has.senses or has.orifice:
            _other_jack_tick(
                end, has.orifice, has.senses, tick, level, state, path, coefficients,
                block_part(address, BLOCK.scratch, BLOCK.end),
            )  # fmt: skip
        else:
            jack_tick(end, tick, level, state, path, coefficients)
        sampled_pressures(end, has.senses or has.orifice, state, path, coefficients)
    return level
