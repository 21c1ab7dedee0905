"""On-board identification: kernels that begin, continue and conclude it with a verdict.

The recording is looked at; the three searches of single severities lead to the refinement, which
sharpens a density of severities and offsets. Where its optimum does not explain the recording the
refinement begins anew over the usual sizes, and after that the compact genetic algorithm searches
wider. The last passes give standard deviations and verdict. Each phase is passes over the
recording, and a pass may stop after any tick.
"""

from __future__ import annotations

import math
from typing import Final

from ehadiag.compile.jit import Array, bare_kernel, brief_kernel, inlined_exact
from ehadiag.compile.vector import BYTES_PER_NUMBER, array_at, unpacker
from ehadiag.identify.staged_search import SEARCH_STAGES
from ehadiag.model.laws import ControlLaw
from ehadiag.monitor.monitor_memory import (
    MONITOR,
    MONITOR_PLAN_CONTROL,
    MONITOR_UNIT_SIZE,
    prepare_monitor,
)
from ehadiag.onboard.onboard_memory import (
    DIRECTIONS_OF_PASS,
    ONBOARD,
    ONBOARD_GENES,
    ONBOARD_MODELS,
    ONBOARD_PLAN_SIZE,
    ONBOARD_RUNS,
    PHASES,
    PLAN_WINDOWS,
    PROGRESS,
    REASONS,
)
from ehadiag.onboard.onboard_optimum import (
    add_day,
    add_directions,
    add_evidence,
    direction_count,
    end_conclusion,
    end_day,
    end_directions,
    refuse_verdict,
    start_conclusion,
    start_day,
    start_directions,
    write_result,
)
from ehadiag.onboard.onboard_recording import (
    EARLIER,
    LAST,
    MOVED,
    channel_sums_at,
    clear_channels,
    end_look,
    look_at_tick,
    test_place,
    tick_digest,
)
from ehadiag.onboard.onboard_refinement import (
    ROUNDS,
    add_lines,
    end_round,
    start_round,
)
from ehadiag.onboard.onboard_search import (
    GRID_SEVERITIES,
    GRIDS,
    KINTAS,
    PLAN_SPOOL_WEIGHT,
    SEARCH,
    add_costs,
    begin_window,
    count_residual,
    drive_models,
    end_generation,
    end_grid,
    end_noise,
    next_spool,
    push_first_model,
    push_models,
    start_generation,
    start_grid,
    start_noise,
)


@brief_kernel
def begin_identification(address: int, plan_address: int, unit_address: int) -> int:
    """Begin an identification; severities and offsets of the unit are those of its start.

    Addresses are those of the memory of ONBOARD.end numbers, of a plan with rules and of a unit's
    MONITOR_UNIT_FIELDS, whose viscosity, supply and kind of commands hold. Returns 0, or 1 where a
    number of the unit is out of its range.
    """
    p, unit = array_at(address, (ONBOARD.end,)), array_at(unit_address, (MONITOR_UNIT_SIZE,))
    if (
        prepare_monitor(address + BYTES_PER_NUMBER * ONBOARD.monitors, plan_address, unit_address)
        != 0
    ):
        return 1
    for i in range(ONBOARD.monitors):
        p[i] = 0.0
    for i in range(MONITOR_UNIT_SIZE):
        p[ONBOARD.unit + i] = unit[i]
    refuse_verdict(address, 0.0)
    p[PROGRESS.phase], p[PROGRESS.tick] = PHASES.recording, -1.0
    p[PROGRESS.attempts], p[PROGRESS.score] = 1.0, math.inf
    return 0


NO_WINDOWS: Final = -1
"""Of a pass over the whole recording."""
SEARCH_OF_SEVERITY: Final = (1, 2, 0)
"""Which search's windows a severity has, in the order of the plan (FDJ, Kintas, FSS)."""
GENETIC_SEARCH: Final = 3
PREPARATION: Final = 20.0 * ONBOARD_MODELS
"""Effort of the preparation of all models, in ticks of one."""
SPOOL_BACK: Final = 5
"""Ticks before a window in which the spool's last sample is looked for, 1."""
MAX_TICKS: Final = 1e6
"""Largest number of ticks of a recording, 1."""
control_law_of_plan = unpacker(ControlLaw, MONITOR_PLAN_CONTROL)


@inlined_exact
def _pass_search(p: Array) -> int:
    """Which search's windows a pass has."""
    if p[PROGRESS.phase] == PHASES.grids:
        return SEARCH_OF_SEVERITY[GRID_SEVERITIES[int(p[PROGRESS.stage])]]
    return GENETIC_SEARCH if p[PROGRESS.phase] == PHASES.search else NO_WINDOWS


@inlined_exact
def _window_end(address: int, plan: Array, place: int) -> int:
    """First tick (place 0) or end (1) of the window of a pass; 0, 0 where there is none more."""
    p = array_at(address, (ONBOARD.end,))
    window, search = int(p[PROGRESS.window]), _pass_search(p)
    if search == NO_WINDOWS:
        return 0 if place == 0 or window > 0 else int(p[PROGRESS.ticks])
    if window >= PLAN_WINDOWS:
        return 0
    unit = array_at(address + BYTES_PER_NUMBER * ONBOARD.unit, (MONITOR_UNIT_SIZE,))
    return int(plan[test_place(unit) + 1 + 2 * (search * PLAN_WINDOWS + window) + place])


@bare_kernel
def start_pass(address: int, plan_address: int, plan: Array) -> None:
    """Prepare the models of a pass."""
    p = array_at(address, (ONBOARD.end,))
    phase, steps = p[PROGRESS.phase], int(p[PROGRESS.steps])
    p[PROGRESS.passed] = 0.0
    if phase == PHASES.recording:
        clear_channels(channel_sums_at(address))
        p[MOVED] = 0.0
    elif phase == PHASES.grids:
        start_grid(address, plan_address, plan, int(p[PROGRESS.stage]), steps)
    elif phase == PHASES.search:
        start_generation(address, plan_address, plan, steps)
    elif phase == PHASES.noise:
        start_noise(address, plan_address, plan)
        clear_channels(channel_sums_at(address))
    elif phase == PHASES.refinement:
        start_round(address, plan_address, plan)
    elif phase == PHASES.conclusion:
        start_conclusion(address, plan_address, plan)
    elif phase == PHASES.considered:
        start_directions(address, plan_address, plan, steps)
    else:
        start_day(address, plan_address, plan)


@bare_kernel
def start_window(address: int, plan: Array, ticks: Array) -> None:
    """Let the models begin some time before a window, at the spool as measured."""
    p, law = array_at(address, (ONBOARD.end,)), control_law_of_plan(plan)
    first = _window_end(address, plan, 0)
    if not (p[PROGRESS.phase] == PHASES.grids and _pass_search(p) == 0):
        first = max(first - int(SEARCH.run_in_s / law.tick), 0)
    p[PROGRESS.tick] = float(first)
    if _pass_search(p) == NO_WINDOWS:
        return
    offset = p[ONBOARD.point + ONBOARD_GENES] / plan[PLAN_SPOOL_WEIGHT]
    spool = offset
    for k in range(max(first - SPOOL_BACK, 0), first):
        if math.isfinite(ticks[k, 2]):
            spool = ticks[k, 2]
    p[PROGRESS.spool] = spool
    begin_window(address, spool - offset)


@bare_kernel
def pass_tick(address: int, plan: Array, ticks_address: int, ticks: Array, k: int) -> float:
    """Advance a pass by a tick; how many models that took."""
    p = array_at(address, (ONBOARD.end,))
    phase, models = p[PROGRESS.phase], float(ONBOARD_MODELS)
    if _pass_search(p) == NO_WINDOWS:
        p[PROGRESS.passed] = tick_digest(p[PROGRESS.passed], ticks_address, k)
    counts = k >= _window_end(address, plan, 0)
    if phase == PHASES.recording:
        look_at_tick(address, plan, ticks, k)
        return 1.0
    if phase == PHASES.noise:
        push_first_model(address, ticks, k)
        sums = channel_sums_at(address)
        for c in range(2):
            now = p[ONBOARD.monitors + MONITOR.residual + c]
            count_residual(p, c, now, sums[c, LAST], sums[c, EARLIER])
            sums[c, EARLIER], sums[c, LAST] = sums[c, LAST], now
        return 1.0
    if phase == PHASES.grids and _pass_search(p) == 0:
        offset = p[ONBOARD.point + ONBOARD_GENES] / plan[PLAN_SPOOL_WEIGHT]
        spool = next_spool(ticks, k, _window_end(address, plan, 1), p[PROGRESS.spool])
        drive_models(address, plan, spool - offset, p[PROGRESS.spool] - offset, ticks[k, 3])
        p[PROGRESS.spool] = spool
        return 1.0
    push_models(address, ticks, k)
    if phase == PHASES.refinement:
        add_lines(address, ticks, k)
    elif phase == PHASES.conclusion:
        add_evidence(address, plan, ticks, k)
    elif phase == PHASES.considered:
        add_directions(address)
    elif phase in (PHASES.day, PHASES.last_day):
        add_day(address, plan)
    elif phase == PHASES.search and counts:
        add_costs(address, SEARCH.cap, SEARCH.cap)
    elif counts:
        severity = GRID_SEVERITIES[int(p[PROGRESS.stage])]
        add_costs(address, math.inf if severity == KINTAS else SEARCH_STAGES.spool_cap, 0.0)
    return models


@bare_kernel
def end_pass(address: int, plan: Array) -> float:
    """Take what a pass has found; the phase that follows."""
    p = array_at(address, (ONBOARD.end,))
    phase, steps = p[PROGRESS.phase], p[PROGRESS.steps]
    if phase == PHASES.recording:
        p[PROGRESS.digest] = p[PROGRESS.passed]
    elif _pass_search(p) == NO_WINDOWS and p[PROGRESS.digest] != p[PROGRESS.passed]:
        refuse_verdict(address, REASONS.changed)
        return PHASES.done
    p[PROGRESS.steps] = steps + 1.0
    following = phase
    if phase == PHASES.recording:
        reasons = end_look(address, plan, int(p[PROGRESS.ticks]))
        following = PHASES.grids
        if reasons > 0.0:
            refuse_verdict(address, reasons)
            following = PHASES.done
    elif phase == PHASES.grids:
        if end_grid(address, int(p[PROGRESS.stage]), int(steps)):
            p[PROGRESS.stage] += 1.0
            p[PROGRESS.steps] = 0.0
        if p[PROGRESS.stage] == len(GRIDS):
            for i in range(ONBOARD_GENES):
                p[ONBOARD.point + i] = p[ONBOARD.centre + i]
            following = PHASES.noise
    elif phase == PHASES.search:
        if end_generation(address, int(steps)):
            following = PHASES.noise
    elif phase == PHASES.noise:
        end_noise(address, ROUNDS.start_std if p[PROGRESS.attempts] == 1.0 else ROUNDS.wide_std)
        following = PHASES.refinement
    elif phase == PHASES.refinement:
        last, settled = end_round(address, steps + 1.0)
        p[PROGRESS.settled] = 1.0 if settled else 0.0
        if last:
            following = PHASES.day
    elif phase == PHASES.conclusion:
        following = end_conclusion(address, plan)
    elif phase == PHASES.considered:
        end_directions(address)
    else:
        end_day(address, plan)
        following = phase + 1.0
    passes = p[PROGRESS.steps] if phase == PHASES.considered else 0.0
    if (
        following == PHASES.considered
        and phase >= PHASES.last_day
        and passes * DIRECTIONS_OF_PASS >= direction_count(plan)
    ):
        write_result(address, plan)
        following = PHASES.done
    if following != phase:
        p[PROGRESS.steps] = 0.0
    return following


@brief_kernel
def continue_identification(
    address: int, plan_address: int, ticks_address: int, amounts: tuple[float, float]
) -> int:
    """Continue an identification by so many ticks of a model, or to its end; a tick is done whole.

    Addresses are those of an identification that was begun, of its plan, and of the recorded test
    with five numbers a tick, the same in every call; amounts: ticks of the recording, 1 … 1e6,
    and of a model. Returns 0: done; 1: to be continued; 2: an amount is out of its range.
    """
    if not (1.0 <= amounts[0] <= MAX_TICKS and amounts[1] >= 1.0):
        return 2
    p, plan = array_at(address, (ONBOARD.end,)), array_at(plan_address, (ONBOARD_PLAN_SIZE,))
    count, done = int(amounts[0]), 0.0
    ticks = array_at(ticks_address, (count, 5))
    if p[PROGRESS.phase] != PHASES.done and p[PROGRESS.ticks] != float(count):
        # Nothing is read of a recording that is not as long as the test.
        unit = array_at(address + BYTES_PER_NUMBER * ONBOARD.unit, (MONITOR_UNIT_SIZE,))
        reason = REASONS.changed if p[PROGRESS.ticks] != 0.0 else REASONS.length
        if reason == REASONS.changed or float(count) != plan[test_place(unit)]:
            refuse_verdict(address, reason)
            p[PROGRESS.phase] = PHASES.done
    p[PROGRESS.ticks] = float(count)
    while p[PROGRESS.phase] != PHASES.done and done < amounts[1]:
        if p[PROGRESS.tick] < 0.0:
            if p[PROGRESS.window] == 0.0:
                if done > max(amounts[1] - PREPARATION, 0.0):
                    break
                start_pass(address, plan_address, plan)
                done += PREPARATION
            start_window(address, plan, ticks)
        k, end = int(p[PROGRESS.tick]), _window_end(address, plan, 1)
        while k < end and done < amounts[1]:
            models = pass_tick(address, plan, ticks_address, ticks, k)
            done += models
            p[ONBOARD_RUNS] += models / float(count)
            k += 1
        p[PROGRESS.tick] = float(k)
        if k < end:
            break
        p[PROGRESS.tick] = -1.0
        p[PROGRESS.window] += 1.0
        if _window_end(address, plan, 1) == 0:
            p[PROGRESS.window] = 0.0
            p[PROGRESS.phase] = end_pass(address, plan)
    return 0 if p[PROGRESS.phase] == PHASES.done else 1
