"""Study of the monitor on free motion: false alarms, delays and names of changes, thresholds.

The monitored unit is the detailed simulator, from rest, for some minutes a piece, in current and in
position mode by turns. Oil is -20 … 100 degC and drifts, the supply ripples by up to 0.3 MPa, both
are told with noise and a probe's error; the severities that the monitor has are off by some 0.003.
An interval of a rate is Garwood's (Biometrika 28, 1936), 95 %.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2, gumbel_r

from ehadiag.core.actuator import default_actuator
from ehadiag.monitor.change_test import (
    BLOCK_S,
    CAUSES,
    PIECE_H,
    SPANS,
    STRIDE,
    ChangeTest,
)
from ehadiag.monitor.score_bank import BANK_NAMES, ScoreBank
from ehadiag_tools.free_motion.motion import KINDS, Motion, changed, free_motion, random_motion
from ehadiag_tools.study import Options, Record, Study, markdown
from firmware_iface.recording import CommandMode

SEVERITY_ERROR = 0.003
"""Standard deviation of the severities that the monitor has from the true ones, 1."""
CHANGED_PIECE_S = 180.0
CHANGE_S = 60.0
"""Length of a piece with a change, and time of the change, s."""
CHANGES = (
    ("Kintas", 0.05), ("Kintas", 0.1), ("Kintas", 0.2), ("FSS", 0.05), ("FSS", 0.1), ("FSS", 0.2),
    ("FDJ", 0.05), ("FDJ", 0.1), ("FDJ", 0.2), ("spool_offset", 2e-6), ("spool_offset", 5e-6),
    ("spool_gain", 0.02), ("pressure_offset", 0.3e6), ("pressure_gain", 0.03),
    ("current_offset", 1e-4), ("current_gain", 0.02), ("position_gain", 0.03), ("supply", -2e6),
    ("supply", -4e6), ("oil", 15.0), ("oil", -15.0), ("load", 400.0),
)  # fmt: skip
"""Changes and their sizes, SI."""
SPREAD_SHARE = 0.97
"""Share of healthy values below a cause's spread."""


@dataclass(frozen=True, slots=True)
class MotionCase:
    """A piece of motion, and the monitor's hours between false alarms."""

    motion: Motion
    hours: float
    calibrates: bool = False
    """Whether all values are recorded, not alarms alone."""


def perform(case: MotionCase) -> Record:
    """Move the simulated unit, and test its motion for changes.

    `alarms`: time (s) and causes (name, size, standard error) of each that repeats none.
    """
    begin = time.process_time()
    actuator, motion = default_actuator(), case.motion
    record = free_motion(actuator, motion)
    error = np.random.default_rng(motion.seed).normal(0.0, SEVERITY_ERROR, 3)
    given = np.clip(np.add(motion.faults, error), 0.0, 1.0).tolist()
    rate, mode = actuator.controller.rate, CommandMode[motion.mode.upper()]
    test = ChangeTest(ScoreBank(actuator, tuple(given), mode=mode), rate, case.hours)
    alarms, values = [], []
    block = round(BLOCK_S * rate)
    for tick, row in enumerate(record.rows.tolist()):
        if tick % block == 0:
            test.tune(record.mean_environment(tick, tick + block))
        found = test.push(tuple(row))
        if found is not None and not found.repeated:
            causes = [(item.name, item.size, item.stderr) for item in found.causes]
            alarms.append((tick / rate, causes))
        if case.calibrates and (tick + 1) % (block * STRIDE) == 0:
            values.append(np.abs(test.values).round(2).tolist())
    spent = time.process_time() - begin
    return {"alarms": alarms, "values": values, "processor_s": spent}


def garwood(count: int) -> tuple[float, float]:
    """Return the exact 95 % interval of a Poisson mean of which so many were counted."""
    low = 0.0 if count == 0 else float(chi2.ppf(0.025, 2 * count)) / 2.0
    return low, float(chi2.ppf(0.975, 2 * count + 2)) / 2.0


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--hours", type=float, default=10.0, metavar="H", help="between false alarms (%(default)g)")
    add("--changes", action="store_true", help="study changes instead, --cases rounds of all")
    add("--calibrate", action="store_true", help="find the monitor's spreads and threshold instead")
    add("--piece", type=float, default=3600.0 * PIECE_H, metavar="S",
        help="length of a healthy piece (%(default)g)")  # fmt: skip


def _cases(options: Options) -> list[MotionCase]:
    if options.changes:
        return [
            MotionCase(_changed(options.seed, *item), options.hours)
            for item in itertools.product(
                range(1, options.cases + 1), range(len(CHANGES)), range(len(CommandMode))
            )
        ]
    return [
        MotionCase(
            random_motion(
                np.random.default_rng((options.seed, number)), number, options.piece,
                options.seed + number,
            ),
            options.hours,
            options.calibrate,
        )
        for number in range(options.cases)
    ]  # fmt: skip


def _changed(seed: int, turn: int, number: int, mode: int) -> Motion:
    rng = np.random.default_rng((seed, turn, number, mode))
    kind = (7 * turn + 3 * number + 5 * mode) % len(KINDS)
    own = seed + 1000 * turn + 10 * number + mode
    motion = random_motion(rng, 2 * kind + mode, CHANGED_PIECE_S, own)
    return changed(motion, *CHANGES[number], CHANGE_S)


def _report(records: Sequence[Record], options: Options) -> Iterator[str]:
    if options.calibrate:
        yield from _calibration(records)
    elif options.changes:
        yield from _changes(records)
    else:
        yield from _false_alarms(records, options)
    spent = sum(item["processor_s"] for item in records)
    hours = sum(item["motion"]["seconds"] for item in records) / 3600.0
    yield f"\nprocessor time {spent:.0f} s, {spent / hours:.0f} s an hour of motion"


def _false_alarms(records: Sequence[Record], options: Options) -> Iterator[str]:
    rows = []
    for name in ("current", "position", "both"):
        part = [item for item in records if name in ("both", item["motion"]["mode"])]
        if part:
            hours = sum(item["motion"]["seconds"] for item in part) / 3600.0
            alarms = sum(len(item["alarms"]) for item in part)
            low, high = garwood(alarms)
            interval = f"{low / hours:.2f} … {high / hours:.2f}"
            rows.append((name, f"{hours:.2f}", str(alarms), f"{alarms / hours:.2f}", interval))
    yield f"stated {1.0 / options.hours:.2f}/h, seed {options.seed}\n"
    yield from markdown(("mode", "hours", "alarms", "an hour", "95 % interval"), rows)
    for item in records:
        motion = item["motion"]
        for when, causes in item["alarms"]:
            piece = f"seed {motion['seed']} {motion['kind']} {motion['mode']}"
            yield f"- {piece}: {when:.0f} s, {causes}"


def _changes(records: Sequence[Record]) -> Iterator[str]:
    """Delays and names; a piece that alarms before its change counts as a false alarm."""
    rows = []
    counts = [0, 0, 0, 0]
    for change, size in CHANGES:
        for mode in ("current", "position"):
            part = [
                item for item in records
                if (item["motion"]["change"], item["motion"]["size"], item["motion"]["mode"])
                == (change, size, mode)
            ]  # fmt: skip
            delays, names = [], []
            for item in part:
                counts[0] += 1
                after = [found for found in item["alarms"] if found[0] > CHANGE_S]
                counts[3] += len(item["alarms"]) - len(after)
                kind = item["motion"]["kind"]
                delays.append(f"{after[0][0] - CHANGE_S:.0f} ({kind})" if after else f"- ({kind})")
                if after:
                    likely = [name for name, _, _ in after[0][1]]
                    counts[1] += 1
                    counts[2] += likely[0] == change
                    names.append(" or ".join(likely))
            cells = ", ".join(delays), "; ".join(names)
            rows.append((change, f"{size:g}", mode, *cells))
    yield from markdown(("change", "size", "mode", "found after, s (motion)", "named"), rows)
    total, found, right, early = counts
    named = f"{right} of {found} with the right name first"
    yield f"\n{found} of {total} found, {named}; {early} alarms before"


def _calibration(records: Sequence[Record]) -> Iterator[str]:
    values = [np.array(item["values"]) for item in records]
    spreads = np.maximum(np.quantile(np.concatenate(values), SPREAD_SHARE, axis=0), 1.0)
    spreads = np.ceil(10.0 * spreads) / 10.0
    names = [BANK_NAMES[place] for place in CAUSES]
    rows = [
        (name, *(f"{value:.1f}" for value in column))
        for name, column in zip(names, spreads.T, strict=True)
    ]
    yield from markdown(("cause", *(f"{span * BLOCK_S:g} s" for span in SPANS)), rows)
    largest = np.array([(item / spreads).max() for item in values])
    location, scale = gumbel_r.fit(largest)
    yield f"\nlargest of each of {len(largest)} pieces: Gumbel's law, {location:.2f}, {scale:.2f}"
    yield "largest of all: " + ", ".join(f"{value:.2f}" for value in np.sort(largest)[::-1][:10])


FREE_MOTION = Study(
    "free-motion",
    "The monitor's false alarms in free motion; --changes: delays and names; --calibrate.",
    _cases, perform, _report, _options, count=24,
    counted="pieces of motion; with --changes rounds of all changes",
)  # fmt: skip
