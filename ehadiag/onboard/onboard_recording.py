"""Look at a recording on board: what it says of itself, and whether it can carry a verdict."""

from __future__ import annotations

import math

import numpy as np

from ehadiag.compile.jit import Array, bare_kernel, inlined_exact, merged
from ehadiag.compile.vector import BYTES_PER_NUMBER, array_at
from ehadiag.monitor.monitor_memory import MONITOR_UNIT_SIZE
from ehadiag.onboard.onboard_memory import (
    CHANNEL_COUNT,
    CHANNEL_SUMS,
    ONBOARD,
    ONBOARD_GENES,
    PLAN_TEST_SIZE,
    PLAN_TESTS,
    REASONS,
    UNIT_CLOSED,
    UNIT_SUPPLY,
    ChannelSums,
    verdict_rules_of,
)
from ehadiag.onboard.onboard_search import (
    PLAN_PRESSURE_WEIGHT,
    PLAN_SPOOL_WEIGHT,
    SEARCH,
)

(LAST, EARLIER, SQUARES, SAMPLES, GAP, LONGEST, OUTLIERS, LEAST, MOST, CUT, REST, RESTED) = range(
    CHANNEL_SUMS
)
"""Places of `ChannelSums`."""
assert len(ChannelSums._fields) == CHANNEL_SUMS
MOVED = ONBOARD.sums
"""Place of whether the test has moved the actuator."""
DIGEST_PRIME = 0x100000001B3
"""Factor of the digest of a recording, 1: that of the 64-bit FNV hash."""
DIGEST_BITS_LOST = 12
"""Bits of it that are left out, 1: what is left is a whole number of a double."""


@merged
def channel_sums_at(address: int) -> Array:
    """What a pass counts of spool, pressure and position, shape (CHANNEL_COUNT, CHANNEL_SUMS)."""
    return array_at(address + BYTES_PER_NUMBER * ONBOARD.channels, (CHANNEL_COUNT, CHANNEL_SUMS))


@inlined_exact
def clear_channels(sums: Array) -> None:
    """Begin to count."""
    for c in range(CHANNEL_COUNT):
        for i in range(CHANNEL_SUMS):
            sums[c, i] = 0.0
        sums[c, LAST] = sums[c, EARLIER] = math.nan
        sums[c, LEAST], sums[c, MOST] = math.inf, -math.inf


@inlined_exact
def tick_digest(digest: float, ticks_address: int, k: int) -> float:
    """Digest of a recording with one tick more."""
    for channel in range(5):
        place = ticks_address + BYTES_PER_NUMBER * (5 * k + channel)
        bits = array_at(place, (1,)).view(np.uint64)[0]
        mixed = (np.uint64(np.int64(digest)) ^ bits) * np.uint64(DIGEST_PRIME)
        digest = float(np.int64(mixed >> np.uint64(DIGEST_BITS_LOST)))
    return digest


@bare_kernel
def look_at_tick(address: int, plan: Array, ticks: Array, k: int) -> None:
    """Count what a tick says of the recording."""
    p, sums, r = array_at(address, (ONBOARD.end,)), channel_sums_at(address), verdict_rules_of(plan)
    if ticks[k, 0] != 0.0:
        p[MOVED] = 1.0
    for c in range(CHANNEL_COUNT):
        low, high = r.spool_low, r.spool_high
        if c == 1:
            low, high = r.pressure_low, r.pressure_high
        elif c == 2:
            low, high = r.position_low, r.position_high
        value = ticks[k, 2 + c]
        if not math.isfinite(value):
            sums[c, GAP] += 1.0
            sums[c, LONGEST] = max(sums[c, LONGEST], sums[c, GAP])
            continue
        sums[c, GAP] = 0.0
        sums[c, SAMPLES] += 1.0
        sums[c, SQUARES] += value
        sums[c, LEAST], sums[c, MOST] = min(sums[c, LEAST], value), max(sums[c, MOST], value)
        if value <= low or value >= high:
            sums[c, CUT] += 1.0
        if p[MOVED] == 0.0:
            sums[c, REST] += value
            sums[c, RESTED] += 1.0


@inlined_exact
def recording_reasons(address: int, plan: Array, count: int) -> float:
    """Why a recording that was looked at carries no verdict; 0: it does."""
    sums, r = channel_sums_at(address), verdict_rules_of(plan)
    unit = array_at(address + BYTES_PER_NUMBER * ONBOARD.unit, (MONITOR_UNIT_SIZE,))
    reasons = 0.0
    lost, frozen, cut = False, False, False
    for c in range(CHANNEL_COUNT):
        cut = cut or sums[c, CUT] > r.most_saturated * count
        if c == 2:
            break  # a frozen position is none of the model's
        lost = lost or sums[c, SAMPLES] < (1.0 - r.most_lost) * count
        lost = lost or sums[c, LONGEST] > r.longest_gap
        frozen = frozen or not sums[c, LEAST] < sums[c, MOST]
    if lost:
        reasons += REASONS.lost
    if frozen:
        reasons += REASONS.frozen
    if cut:
        reasons += REASONS.saturated
    if unit[UNIT_SUPPLY] < r.least_supply:
        reasons += REASONS.supply
    return reasons


@inlined_exact
def test_place(unit: Array) -> int:
    """Place of a unit's test in the plan."""
    return PLAN_TESTS + (PLAN_TEST_SIZE if unit[UNIT_CLOSED] != 0.0 else 0)


@bare_kernel
def end_look(address: int, plan: Array, count: int) -> float:
    """Take the offsets from the sensors at rest, if that was long enough; why there is no verdict.

    In closed loop friction may hold the spool beside its middle before the command moves. The jack
    comes back, so that the mean of the whole test is near the offset. The first approximation
    begins without spool friction.
    """
    p, sums = array_at(address, (ONBOARD.end,)), channel_sums_at(address)
    unit = array_at(address + BYTES_PER_NUMBER * ONBOARD.unit, (MONITOR_UNIT_SIZE,))
    held = False
    for c in range(2):
        weight = plan[PLAN_SPOOL_WEIGHT] if c == 0 else plan[PLAN_PRESSURE_WEIGHT]
        rest = sums[c, REST] / max(sums[c, RESTED], 1.0) * weight
        mean = sums[c, SQUARES] / max(sums[c, SAMPLES], 1.0) * weight
        if c == 0:
            held = unit[UNIT_CLOSED] != 0.0 and abs(rest - mean) > SEARCH.most_held
        if sums[c, RESTED] >= SEARCH.min_rest_samples:
            p[ONBOARD.point + ONBOARD_GENES + c] = mean if held else rest
    for i in range(ONBOARD_GENES):
        p[ONBOARD.centre + i] = 0.0
    return recording_reasons(address, plan, count)
