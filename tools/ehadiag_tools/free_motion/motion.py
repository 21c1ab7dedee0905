"""Study of the monitor on free motion: false alarms, delays and names of changes, thresholds.

The monitored unit is the detailed simulator, by semi-implicit steps of fixed length, from rest, for
some minutes a piece, in current and in position mode by turns; the monitor's own model moves by
exact transitions between events and by collocation. Motion is of 22 kinds, or of ten others.
Oil is -20 … 100 degC and drifts, the supply ripples by up to 0.3 MPa, both are told with noise and
a probe's error; the severities that the monitor has are off by some 0.003. An interval of a rate is
Garwood's (Biometrika 28, 1936), 95 %.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from ehadiag.compile.jit import Array, Array2, kernel
from ehadiag.compile.vector import unpacker
from ehadiag.core.actuator import Actuator, default_actuator
from ehadiag.core.conversion import actuator_channels
from ehadiag.model.registry import FAULT_NAMES
from ehadiag.monitor.change_test import (
    CAUSES,
    PIECE_H,
    SPANS,
    STRIDE,
    ChangeTest,
    alarm_threshold,
)
from ehadiag.monitor.score_bank import BANK_NAMES, BLOCK_S, ScoreBank
from ehadiag_sim.conditions import Effects, Faults
from ehadiag_sim.plant_dynamics import STATE, advance_plant
from ehadiag_sim.plant_laws import PlantCoefficients, scale_unit_data, unit_condition, unit_data
from ehadiag_tools.free_motion.commands import HELD_OUT, KINDS, even_in_octaves, random_command
from ehadiag_tools.study import Options, Record, Study, grouped, markdown
from firmware_iface.recording import DEFAULT_SCALES, CommandMode, Environment

ALL_KINDS = (*KINDS, *HELD_OUT)
LARGEST = {CommandMode.POSITION: 10e-3, CommandMode.CURRENT: 1.5e-3}
"""Largest command, m and A; in current mode what brings the jack back is added."""
CENTRING_A_M, CENTRING_S = 0.1, 0.5
"""Gain, A/m, and time constant, s, of what keeps the jack from walking off in current mode."""
OIL = (-20.0, 100.0)
"""Range of the oil's temperature, degC."""
STEP = 2e-6
"""Integration step, s: eight times the default's. With 8 µs two of 32 healthy pieces alarmed by the
steps' own error, with 2 µs neither."""
ENVIRONMENT_TICKS = 50
"""Ticks between two changes of oil and supply, 1."""
REPORT_TICKS = 100
"""Ticks between two messages of oil and supply, 1."""
TOLD_NOISE = (0.05e6, 0.5)
"""Noise of the told supply, Pa, and oil, K: each message has its own."""
PROBE_ERROR = (0.05e6, 1.0)
"""Standard deviation of a probe's constant error, Pa and K."""


@dataclass(frozen=True, slots=True)
class Motion:
    """A piece of free motion, and what the unit is in it."""

    kind: str
    mode: str
    seconds: float
    faults: tuple[float, ...]
    seed: int
    oil: float = 40.0
    """At the beginning, degC."""
    oil_rate: float = 0.0
    """K/s."""
    ripple: float = 0.0
    """Amplitude of the supply, Pa."""
    ripple_hz: float = 1.0
    change: str = ""
    """What changes: a severity, `oil`, `supply`, `load`, or a sensor's offset or gain."""
    size: float = 0.0
    """By how much; SI."""
    after: float = 60.0
    """Time of the change, s."""
    exact: bool = False
    """Whether oil and supply are told without errors."""


@dataclass(frozen=True, slots=True, eq=False)
class MotionRecord:
    """What came over the bus."""

    rows: NDArray[np.float64]
    """Command (A or m), current (A), spool (m), pressure (Pa), position (m), shape (ticks, 5)."""
    told: NDArray[np.float64]
    """Supply less return pressure (Pa) and oil (degC) every `REPORT_TICKS`, shape (n, 2)."""

    def mean_environment(self, begin: int, end: int) -> Environment:
        """Mean of oil and supply as told between two ticks."""
        told = self.told[begin // REPORT_TICKS : max(end, begin + REPORT_TICKS) // REPORT_TICKS]
        supply, oil = told.mean(axis=0).tolist()
        return Environment(supply, 0.0, oil)


_coefficients_of = unpacker(PlantCoefficients)


@kernel
def _move(
    state: Array, coefficients: Array2, changed: int, substeps: int, closed: bool, law: Array,
    commands: Array, noise: Array2, lsb: Array, gains: Array2, out: Array2,
) -> None:  # fmt: skip
    """Move the unit tick by tick from a state.

    coefficients: of the unit in each span of `ENVIRONMENT_TICKS`; gains: of the sensors before and
    after the change, shape (2, 4); changed: spans before it; law: gain (A/m), saturation (A),
    resolution of commands, centring gain and share, tick.
    """
    step, seen, centre = law[5] / substeps, 0.0, 0.0
    for span in range(coefficients.shape[0]):
        part = 1 if span >= changed else 0
        p = _coefficients_of(coefficients[span])
        begin = span * ENVIRONMENT_TICKS
        for k in range(begin, min(begin + ENVIRONMENT_TICKS, commands.shape[0])):
            wanted = commands[k]
            if not closed:
                wanted -= law[3] * centre
            wanted = np.round(wanted / law[2]) * law[2]
            current = law[0] * (wanted - seen) if closed else wanted
            current = min(max(current, -law[1]), law[1])
            advance_plant(state, p, p.GM * current, step, substeps)
            truth = (current, state[STATE.spool], state[STATE.pressure], state[STATE.jack])
            out[k, 0] = wanted
            for c in range(4):
                code = np.round(truth[c] * gains[part, c] / lsb[c] + noise[k, c])
                out[k, 1 + c] = min(max(code, -2048.0), 2047.0) * lsb[c]
            seen = out[k, 4]
            centre += law[4] * (state[STATE.jack] - centre)


SENSOR_PLACES = {"current": 0, "spool": 1, "pressure": 2, "position": 3}


def free_motion(actuator: Actuator, motion: Motion) -> MotionRecord:
    """Move a simulated actuator from rest, see `Motion`."""
    mode = CommandMode[motion.mode.upper()]
    rate, closed = actuator.controller.rate, mode is CommandMode.POSITION
    rng = np.random.default_rng((motion.seed, int(mode), ALL_KINDS.index(motion.kind)))
    ticks = round(motion.seconds * rate)
    commands = np.array(random_command(rng, motion.kind, ticks, rate, LARGEST[mode]))
    lsb = np.array([channel.lsb for channel in actuator_channels(actuator)])
    resolution = DEFAULT_SCALES.position_step if closed else DEFAULT_SCALES.current_step
    law = np.array([
        actuator.controller.GAP, actuator.controller.IM, resolution,
        CENTRING_A_M, 1.0 / (CENTRING_S * rate), 1.0 / rate,
    ])  # fmt: skip
    spans = -(-ticks // ENVIRONMENT_TICKS)
    time = np.arange(spans) * (ENVIRONMENT_TICKS / rate)
    changed = round(motion.after * rate / ENVIRONMENT_TICKS) if motion.change else spans
    # Oil drifts to an end of its range and back.
    width = OIL[1] - OIL[0]
    turned = (motion.oil + motion.oil_rate * time - OIL[0] + width) % (2.0 * width) - width
    angle = 2.0 * math.pi * motion.ripple_hz * time + rng.uniform(0.0, 2.0 * math.pi)
    wave = motion.ripple * np.sin(angle)
    environment = np.column_stack((OIL[0] + np.abs(turned), actuator.servovalve.PSR + wave))
    told = environment[:: REPORT_TICKS // ENVIRONMENT_TICKS, ::-1].copy()
    if not motion.exact:
        told += np.multiply(PROBE_ERROR, rng.standard_normal(2))
        told += np.multiply(TOLD_NOISE, rng.standard_normal(told.shape))
    noise, gains = 0.5 * rng.standard_normal((ticks, 4)), np.ones((2, 4))
    name, _, part = motion.change.partition("_")
    if part == "gain":
        gains[1, SENSOR_PLACES[name]] += motion.size
    elif part == "offset":
        place = SENSOR_PLACES[name]
        noise[changed * ENVIRONMENT_TICKS :, place] += motion.size / lsb[place]
    elif name in ("oil", "supply"):
        environment[changed:, int(name == "supply")] += motion.size
    severities = dict(zip(FAULT_NAMES, motion.faults, strict=True))
    worn = severities | ({name: severities[name] + motion.size} if name in severities else {})
    loads = 0.0, motion.size if name == "load" else 0.0
    data, conditions = unit_data(actuator), [
        unit_condition(Faults(**faults), Effects(return_pressure=0.0, load=load), 0.0, OIL[0])
        for faults, load in zip((severities, worn), loads, strict=True)
    ]  # fmt: skip
    coefficients = np.array([
        scale_unit_data(
            data,
            conditions[span >= changed]._replace(oil_temperature=oil, supply_pressure=supply),
        )
        for span, (oil, supply) in enumerate(environment.tolist())
    ])  # fmt: skip
    out = np.empty((ticks, 5))
    _move(
        np.zeros(STATE.end), coefficients, changed, math.ceil(1.0 / (rate * STEP) - 1e-6), closed,
        law, commands, noise, lsb, gains, out,
    )  # fmt: skip
    return MotionRecord(out, told)


def random_motion(
    rng: np.random.Generator,
    number: int,
    seconds: float,
    seed: int,
    kinds: Sequence[str] = KINDS,
) -> Motion:
    """Piece of healthy motion: kinds and modes in turn, all else at random."""
    return Motion(
        kinds[number // 2 % len(kinds)],
        "position" if number % 2 else "current",
        seconds,
        tuple(rng.uniform(0.0, 0.7, 3).tolist()),
        seed,
        oil=float(rng.uniform(*OIL)),
        oil_rate=float(rng.uniform(-0.05, 0.05)),
        ripple=float(rng.uniform(0.0, 0.3e6)),
        ripple_hz=even_in_octaves(rng, (0.1, 3.0)),
    )


SEVERITY_ERROR = 0.003
"""Standard deviation of the severities that the monitor has from the true ones, 1."""
CHANGED_PIECE_S = 150.0
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
GROWN = 0.05
"""Largest growth of a severity since its diagnosis in the study of severities, 1."""
SPREAD_SHARE = 0.97
"""Share of healthy values below a cause's spread."""
TAIL_SHARE = 0.05
"""Share of the largest values of pieces that makes their tail."""
LEAST_VOTE_SPREAD = 0.75
"""Least spread of a sum of votes: a strong block adds 0.6, and one block is no change."""


@dataclass(frozen=True, slots=True)
class MotionCase:
    """A piece of motion, and the monitor's hours between false alarms."""

    motion: Motion
    hours: float
    calibrates: bool = False
    """Whether all values are recorded, not alarms alone."""
    grown: float = 0.0
    """Largest growth of a severity since the diagnosis that the monitor has."""


def perform(case: MotionCase) -> Record:
    """Move the simulated unit, and test its motion for changes.

    `alarms`: time (s) and causes (name, size, standard error) of each that repeats none;
    `severities`: estimate, standard error, interval and truth of those that are stated.
    """
    begin = time.process_time()
    actuator, motion = default_actuator(), case.motion
    record = free_motion(actuator, motion)
    rng = np.random.default_rng(motion.seed)
    error = rng.normal(0.0, SEVERITY_ERROR, 3) - rng.uniform(0.0, case.grown, 3)
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
    severities = {
        item.name: (item.estimate, item.std, item.interval95, truth)
        for item, truth in zip(test.flight.severities()[0], motion.faults, strict=True)
        if item.estimate is not None
    }
    spent = time.process_time() - begin
    return {"alarms": alarms, "values": values, "severities": severities, "processor_s": spent}


def garwood(count: int) -> tuple[float, float]:
    """Return the exact 95 % interval of a Poisson mean of which so many were counted."""
    low = 0.0 if count == 0 else float(chi2.ppf(0.025, 2 * count)) / 2.0
    return low, float(chi2.ppf(0.975, 2 * count + 2)) / 2.0


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--hours", type=float, default=10.0, metavar="H", help="between false alarms (%(default)g)")
    add("--changes", action="store_true", help="study changes instead, --cases rounds of all")
    add("--severities", action="store_true", help="study the stated severities instead")
    add("--calibrate", action="store_true", help="find the monitor's spreads and threshold instead")
    add("--kinds", choices=("known", "held-out"), default="known",
        help="known: those that the threshold comes from (%(default)s)")  # fmt: skip
    add("--piece", type=float, default=3600.0 * PIECE_H, metavar="S",
        help="length of a healthy piece (%(default)g)")  # fmt: skip


def _cases(options: Options) -> list[MotionCase]:
    kinds = KINDS if options.kinds == "known" else tuple(HELD_OUT)
    if options.changes:
        return [
            MotionCase(_changed(options.seed, *item, kinds), options.hours)
            for item in itertools.product(
                range(1, options.cases + 1), range(len(CHANGES)), range(len(CommandMode))
            )
        ]
    return [
        MotionCase(
            random_motion(
                np.random.default_rng((options.seed, number)), number, options.piece,
                options.seed + number, kinds,
            ),
            options.hours,
            options.calibrate,
            # Every second pair of modes.
            GROWN * (options.severities and number // 2 % 2),
        )
        for number in range(options.cases)
    ]  # fmt: skip


def _changed(seed: int, turn: int, number: int, mode: int, kinds: Sequence[str]) -> Motion:
    rng = np.random.default_rng((seed, turn, number, mode))
    kind = (7 * turn + 3 * number + 5 * mode) % len(kinds)
    own = seed + 1000 * turn + 10 * number + mode
    motion = random_motion(rng, 2 * kind + mode, CHANGED_PIECE_S, own, kinds)
    change, size = CHANGES[number]
    return replace(motion, change=change, size=size, after=CHANGE_S)


def _report(records: Sequence[Record], options: Options) -> Iterator[str]:
    flat = [{**item["motion"], **item} for item in records]
    if options.calibrate:
        yield from _calibration(flat, options.hours)
    elif options.changes:
        yield from _changes(flat)
    elif options.severities:
        yield from _severities(flat)
    else:
        yield from _false_alarms(flat, options)
    spent = sum(item["processor_s"] for item in flat)
    hours = _hours_of(flat)
    yield f"\nprocessor time {spent:.0f} s, {spent / hours:.0f} s an hour of motion"


def _hours_of(records: Sequence[Record]) -> float:
    return float(sum(item["seconds"] for item in records) / 3600.0)


def _false_alarms(records: Sequence[Record], options: Options) -> Iterator[str]:
    yield f"stated {1.0 / options.hours:.2f}/h, seed {options.seed}\n"
    rows = []
    for (mode,), part in (grouped(records, "mode") | {("both",): records}).items():
        hours, alarms = _hours_of(part), sum(len(item["alarms"]) for item in part)
        low, high = garwood(alarms)
        interval = f"{low / hours:.2f} … {high / hours:.2f}"
        rows.append((mode, f"{hours:.2f}", alarms, f"{alarms / hours:.2f}", interval))
    yield from markdown(("mode", "hours", "alarms", "an hour", "95 % interval"), rows)
    for item in records:
        for when, causes in item["alarms"]:
            piece = f"seed {item['seed']} {item['kind']} {item['mode']}"
            yield f"- {piece}: {when:.0f} s, {causes}"


def _severities(records: Sequence[Record]) -> Iterator[str]:
    """How often severities are stated, and how near the truth; `grown` since their diagnosis."""
    each = [
        {"mode": item["mode"], "grown": item["grown"] > 0.0, "name": name,
         "stated": item["severities"].get(name)}
        for item in sorted(records, key=lambda item: (item["mode"], item["grown"]))
        for name in FAULT_NAMES
    ]  # fmt: skip
    rows = []
    for (mode, grown, name), part in grouped(each, "mode", "grown", "name").items():
        found = [item["stated"] for item in part if item["stated"]]
        if found:
            value, std, (low, high), truth = (np.array(x).T for x in zip(*found, strict=True))
            error, covered = value - truth, (low <= truth) & (truth <= high)
            numbers = np.sqrt(np.mean(error**2)), np.abs(error).max(), np.median(std)
            rows.append((
                mode, "grown" if grown else "as diagnosed", name, f"{len(found)} of {len(part)}",
                covered.sum(), *(f"{value:.4f}" for value in numbers),
            ))  # fmt: skip
    heads = ("mode", "unit", "severity", "stated", "covered", "rms error", "largest", "stated std")
    yield from markdown(heads, rows)


def _changes(records: Sequence[Record]) -> Iterator[str]:
    """Delays and names; a piece that alarms before its change counts as a false alarm."""
    rows, found, right, early = [], 0, 0, 0
    for (change, size, mode), part in grouped(records, "change", "size", "mode").items():
        delays, names = [], []
        for item in part:
            after = [alarm for alarm in item["alarms"] if alarm[0] > CHANGE_S]
            early += len(item["alarms"]) - len(after)
            delays.append(f"- ({item['kind']})")
            if after:
                when, causes = after[0]
                likely = [name for name, _, _ in causes]
                delays[-1] = f"{when - CHANGE_S:.0f} ({item['kind']})"
                names.append(" or ".join(likely))
                found, right = found + 1, right + (likely[0] == change)
        rows.append((change, f"{size:g}", mode, ", ".join(delays), "; ".join(names)))
    yield from markdown(("change", "size", "mode", "found after, s (motion)", "named"), rows)
    named = f"{right} of {found} with the right name first"
    yield f"\n{found} of {len(records)} found, {named}; {early} alarms before"


def _calibration(records: Sequence[Record], hours: float) -> Iterator[str]:
    """Spreads and threshold; and alarms in the pieces of each kind by those of all other kinds.

    What alarms of a severity below the least change are ignored is not counted: the rate is an
    upper one.
    """
    looks = 3600.0 * PIECE_H / (STRIDE * BLOCK_S)
    values, kinds = [], []
    for item in records:
        count = max(1, round(len(item["values"]) / looks))
        values += np.array_split(np.array(item["values"]), count)
        kinds += [item["kind"]] * count
    spans, votes = _spreads(values)
    rows = [
        (BANK_NAMES[place], *(f"{value:.1f}" for value in column), f"{vote:.2f}")
        for place, column, vote in zip(CAUSES, spans.T, votes, strict=True)
    ]
    yield from markdown(("cause", *(f"{span * BLOCK_S:g} s" for span in SPANS), "votes"), rows)
    largest = _largest(values, spans, votes)
    location, scale = _tail(largest)
    yield f"\nlargest of each of {len(largest)} pieces: tail of {location:.2f}, {scale:.2f}"
    yield "largest of all: " + ", ".join(f"{value:.2f}" for value in np.sort(largest)[::-1][:10])
    seen = _hours_of(records)
    for stated in (hours / 5.0, hours):
        alarms = 0
        for kind in set(kinds):
            others = [item for item, other in zip(values, kinds, strict=True) if other != kind]
            mine = [item for item, other in zip(values, kinds, strict=True) if other == kind]
            bounds = _spreads(others)
            threshold = alarm_threshold(stated, _tail(_largest(others, *bounds)))
            alarms += int(np.sum(_largest(mine, *bounds) > threshold))
        low, high = garwood(alarms)
        yield (
            f"each kind by the threshold of all others: {alarms} pieces with an alarm in"
            f" {seen:.2f} h, {alarms / seen:.2f} an hour ({low / seen:.2f} … {high / seen:.2f}),"
            f" stated {1.0 / stated:.2f}"
        )


def _spreads(values: Sequence[Array]) -> tuple[Array, Array]:
    """By span and cause, and by cause of the largest sums of votes in a piece."""
    spans = np.quantile(np.concatenate(values)[:, : len(SPANS)], SPREAD_SHARE, axis=0)
    votes = [item[:, len(SPANS) :].max(axis=(0, 1)) for item in values]
    votes = np.maximum(np.quantile(votes, SPREAD_SHARE, axis=0), LEAST_VOTE_SPREAD)
    return np.ceil(10.0 * np.maximum(spans, 1.0)) / 10.0, np.ceil(4.0 * votes) / 4.0


def _largest(values: Sequence[Array], spans: Array, votes: Array) -> Array:
    spreads = np.concatenate((spans, np.broadcast_to(votes, (2, len(CAUSES)))))
    return np.array([(item / spreads).max() for item in values])


def _tail(largest: Array) -> tuple[float, float]:
    """Location and scale of Gumbel's law with the tail of these values.

    By their mean excess: the bulk of them says little of the few pieces in which the model errs.
    """
    least = float(np.quantile(largest, 1.0 - TAIL_SHARE))
    scale = float(np.mean(largest[largest > least] - least))
    return least + scale * math.log(TAIL_SHARE), scale


FREE_MOTION = Study(
    "free-motion",
    "The monitor's false alarms in free motion; --changes: delays and names; --calibrate.",
    _cases, perform, _report, _options, count=24,
    counted="pieces of motion; with --changes rounds of all changes",
)  # fmt: skip
