"""Study of the monitor on free motion: false alarms, delays and names of changes, thresholds.

The monitored unit is the detailed simulator, by semi-implicit steps of fixed length, from rest, for
some minutes a piece, in current and in position mode by turns; the monitor's own model moves by
exact transitions between events and by collocation. Motion is of twelve kinds. Oil is -20 … 100
degC and drifts, the supply ripples by up to 0.3 MPa, both are told with noise and a probe's error;
the severities that the monitor has are off by some 0.003. An interval of a rate is Garwood's
(Biometrika 28, 1936), 95 %.
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
from scipy.stats import chi2, gumbel_r

from ehadiag.compile.jit import Array, Array2, kernel
from ehadiag.core.actuator import Actuator, default_actuator
from ehadiag.core.conversion import actuator_channels
from ehadiag.monitor.change_test import (
    BLOCK_S,
    CAUSES,
    PIECE_H,
    SPANS,
    STRIDE,
    VOTE_SPREAD,
    ChangeTest,
    alarm_threshold,
)
from ehadiag.monitor.score_bank import BANK_NAMES, ScoreBank
from ehadiag_sim.conditions import Effects, Faults
from ehadiag_sim.plant_dynamics import STATE, advance_plant
from ehadiag_sim.plant_laws import PlantCoefficients, plant_coefficients
from ehadiag_tools.study import Options, Record, Study, markdown
from firmware_iface.recording import DEFAULT_SCALES, CommandMode, Environment

KINDS = (
    "hold", "steps", "ramps", "sines", "chirps", "noise", "triangles", "doublets", "stairs",
    "manoeuvres", "gusts", "dither",
)  # fmt: skip
"""Kinds of motion; a piece has one, broken by holds."""
LARGEST = {CommandMode.POSITION: 10e-3, CommandMode.CURRENT: 1.5e-3}
"""Largest command, m and A; in current mode what brings the jack back is added."""
CORNER_HZ = 2.0
"""Frequency beyond which amplitudes fall, Hz."""
CENTRING_A_M, CENTRING_S = 0.1, 0.5
"""Gain, A/m, and time constant, s, of what keeps the jack from walking off in current mode."""
STEP = 8e-6
"""Integration step, s: thirty-two times the default's; the monitor's scores are those of 1 µs."""
ENVIRONMENT_TICKS = 20
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
    faults: tuple[float, float, float]
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


@kernel
def _move(
    state: Array, p: PlantCoefficients, substeps: int, step: float, closed: bool, law: Array,
    commands: Array, noise: Array2, lsb: Array, gains: Array, held: Array, out: Array2,
) -> None:  # fmt: skip
    """Advance some ticks; law: gain (A/m), saturation (A), resolution of commands, centring gain
    and share; held: digitised position, and mean of the true one.
    """
    for k in range(commands.shape[0]):
        wanted = commands[k]
        if not closed:
            wanted -= law[3] * held[1]
        wanted = np.round(wanted / law[2]) * law[2]
        current = law[0] * (wanted - held[0]) if closed else wanted
        current = min(max(current, -law[1]), law[1])
        advance_plant(state, p, p.GM * current, step, substeps)
        truth = (current, state[STATE.spool], state[STATE.pressure], state[STATE.jack])
        out[k, 0] = wanted
        for c in range(4):
            code = np.round(truth[c] * gains[c] / lsb[c] + noise[k, c])
            out[k, 1 + c] = min(max(code, -2048.0), 2047.0) * lsb[c]
        held[0] = out[k, 4]
        held[1] += law[4] * (state[STATE.jack] - held[1])


SENSOR_PLACES = {"current": 0, "spool": 1, "pressure": 2, "position": 3}


def free_motion(actuator: Actuator, motion: Motion, step: float = STEP) -> MotionRecord:
    """Move a simulated actuator from rest, see `Motion`."""
    mode = CommandMode[motion.mode.upper()]
    rate, closed = actuator.controller.rate, mode is CommandMode.POSITION
    rng = np.random.default_rng((motion.seed, int(mode), KINDS.index(motion.kind)))
    ticks = round(motion.seconds * rate)
    commands = np.array(random_command(rng, motion.kind, ticks, rate, LARGEST[mode]))
    lsb = np.array([channel.lsb for channel in actuator_channels(actuator)])
    substeps = math.ceil(1.0 / (rate * step) - 1e-6)
    resolution = DEFAULT_SCALES.position_step if closed else DEFAULT_SCALES.current_step
    law = np.array([
        actuator.controller.GAP, actuator.controller.IM, resolution,
        CENTRING_A_M, 1.0 / (CENTRING_S * rate),
    ])  # fmt: skip
    state, held, out = np.zeros(STATE.end), np.zeros(2), np.empty((ticks, 5))
    error = np.zeros(2) if motion.exact else np.multiply(PROBE_ERROR, rng.standard_normal(2))
    told: list[list[float]] = []
    phase = rng.uniform(0.0, 2.0 * math.pi)
    changed = round(motion.after * rate) if motion.change else ticks + 1
    for tick in range(0, ticks, ENVIRONMENT_TICKS):
        time = tick / rate
        oil = motion.oil + motion.oil_rate * time
        wave = motion.ripple * math.sin(2.0 * math.pi * motion.ripple_hz * time + phase)
        supply = actuator.servovalve.PSR + wave
        if tick % REPORT_TICKS == 0:
            noise = np.zeros(2) if motion.exact else np.multiply(TOLD_NOISE, rng.normal(size=2))
            told.append(np.add([supply, oil], error + noise).tolist())
        size = motion.size if tick >= changed else 0.0
        gains = np.ones(4)
        name, _, part = motion.change.partition("_")
        if part == "gain":
            gains[SENSOR_PLACES[name]] += size
        severities = dict(zip(("Kintas", "FSS", "FDJ"), motion.faults, strict=True))
        if motion.change in severities:
            severities[motion.change] += size
        effects = Effects(
            oil_temperature=oil + (size if motion.change == "oil" else 0.0),
            supply_pressure=supply + (size if motion.change == "supply" else 0.0),
            return_pressure=0.0,
            load=size if motion.change == "load" else 0.0,
        )
        p = plant_coefficients(actuator, Faults(**severities), effects, filter_time=0.0)
        end = min(tick + ENVIRONMENT_TICKS, ticks)
        noise = 0.5 * rng.standard_normal((end - tick, 4))
        if part == "offset":
            noise[:, SENSOR_PLACES[name]] += size / lsb[SENSOR_PLACES[name]]
        _move(
            state, p, substeps, 1.0 / (rate * substeps), closed, law, commands[tick:end], noise,
            lsb, gains, held, out[tick:end],
        )  # fmt: skip
    return MotionRecord(out, np.array(told))


def random_command(
    rng: np.random.Generator, kind: str, ticks: int, rate: float, largest: float
) -> list[float]:
    """Commands of one kind of motion, m or A, at a rate in Hz; one segment of five is a hold."""
    out: list[NDArray[np.float64]] = []
    last, length = 0.0, 0
    while length < ticks:
        count = int(rng.uniform(0.5, 6.0) * rate)
        chosen = "hold" if rng.uniform() < 0.2 else kind
        piece = np.clip(_segment(rng, chosen, count, rate, last, largest), -largest, largest)
        out.append(piece)
        last, length = float(piece[-1]), length + count
    commands: list[float] = np.concatenate(out)[:ticks].tolist()
    return commands


def _segment(  # noqa: PLR0911 - one return a kind
    rng: np.random.Generator, kind: str, count: int, rate: float, last: float, largest: float
) -> NDArray[np.float64]:
    time = np.arange(count) / rate
    share = np.arange(count) / count
    target = rng.uniform(-largest, largest)
    if kind == "hold":
        small = 0.02 * largest * rng.integers(-1, 2)
        return np.full(count, last + small)
    if kind == "steps":
        return np.full(count, target)
    if kind == "ramps":
        return np.linspace(last, target, count)
    if kind == "manoeuvres":
        return last + (target - last) * share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    if kind == "stairs":
        return last + (target - last) * np.floor(share * rng.integers(3, 9) + 1.0) / 9.0
    if kind == "doublets":
        width = int(rng.uniform(0.05, 0.5) * rate)
        turn = np.arange(count) // width
        return last + 0.5 * target * np.where(turn == 0, 1.0, np.where(turn == 1, -1.0, 0.0))
    if kind == "dither":
        hertz = _even_in_octaves(rng, (1.0, 15.0))
        return last + 0.03 * target * np.sin(2 * np.pi * hertz * time)
    if kind in ("sines", "triangles"):
        hertz = _even_in_octaves(rng, (0.2, 20.0 if kind == "sines" else 3.0))
        wave = np.sin(2 * np.pi * hertz * time)
        wave = wave if kind == "sines" else np.arcsin(wave) * (2.0 / np.pi)
        return last + target / (1.0 + hertz / CORNER_HZ) * wave
    if kind == "chirps":
        sweep = 0.2 * rng.uniform(5.0, 75.0) ** share
        wave = np.sin(2 * np.pi * np.cumsum(sweep) / rate)
        return last + target / (1.0 + sweep / CORNER_HZ) * wave
    hertz = _even_in_octaves(rng, (0.2, 10.0) if kind == "noise" else (0.05, 1.0))
    part, noise, value, second = 2.0 * math.pi * hertz / rate, np.empty(count), 0.0, 0.0
    for k, draw in enumerate(rng.standard_normal(count).tolist()):
        value += part * (draw - value)
        second += min(4.0 * part, 1.0) * (value - second)
        noise[k] = value if kind == "noise" else second
    size = 0.25 * largest / math.sqrt(part / (2.0 - part)) / (1.0 + hertz / CORNER_HZ)
    return last + size * (noise - noise[0])


def _even_in_octaves(rng: np.random.Generator, ends: tuple[float, float]) -> float:
    return math.exp(rng.uniform(math.log(ends[0]), math.log(ends[1])))


def random_motion(rng: np.random.Generator, number: int, seconds: float, seed: int) -> Motion:
    """Piece of healthy motion: kinds and modes in turn, all else at random."""
    a, b, c = rng.uniform(0.0, 0.7, 3).tolist()
    return Motion(
        KINDS[number // 2 % len(KINDS)],
        "position" if number % 2 else "current",
        seconds,
        (a, b, c),
        seed,
        oil=float(rng.uniform(-20.0, 100.0)),
        oil_rate=float(rng.uniform(-0.05, 0.05)),
        ripple=float(rng.uniform(0.0, 0.3e6)),
        ripple_hz=_even_in_octaves(rng, (0.1, 3.0)),
    )


def changed(motion: Motion, change: str, size: float, after: float) -> Motion:
    """The same piece with a change in it."""
    return replace(motion, change=change, size=size, after=after)


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
    add("--cause", choices=dict(CHANGES), help="study its change in all kinds of motion instead")
    add("--calibrate", action="store_true", help="find the monitor's spreads and threshold instead")
    add("--piece", type=float, default=3600.0 * PIECE_H, metavar="S",
        help="length of a healthy piece (%(default)g)")  # fmt: skip


def _cases(options: Options) -> list[MotionCase]:
    if options.cause:
        return [
            MotionCase(_changed_kind(options.seed, options.cause, number), options.hours)
            for number in range(len(KINDS) * len(CommandMode))
        ]
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


def _changed_kind(seed: int, cause: str, number: int) -> Motion:
    """Piece of a kind and a mode with a middling change of a cause."""
    sizes = [size for name, size in CHANGES if name == cause]
    place = list(dict(CHANGES)).index(cause)
    rng = np.random.default_rng((seed, place, number))
    motion = random_motion(rng, number, CHANGED_PIECE_S, 1000 * seed + 100 * place + number)
    return changed(motion, cause, sizes[len(sizes) // 2], CHANGE_S)


def _report(records: Sequence[Record], options: Options) -> Iterator[str]:
    if options.calibrate:
        yield from _calibration(records, options.hours)
    elif options.changes or options.cause:
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
            if part:
                rows.append((change, f"{size:g}", mode, *cells))
    yield from markdown(("change", "size", "mode", "found after, s (motion)", "named"), rows)
    total, found, right, early = counts
    named = f"{right} of {found} with the right name first"
    yield f"\n{found} of {total} found, {named}; {early} alarms before"


def _calibration(records: Sequence[Record], hours: float) -> Iterator[str]:
    """Spreads and threshold; and alarms in each half of the pieces by those of the other half.

    What alarms of a severity below the least change are ignored is not counted: the rate is an
    upper one.
    """
    values = [np.array(item["values"]) for item in records]
    spreads = _spreads(values)
    names = [BANK_NAMES[place] for place in CAUSES]
    rows = [
        (name, *(f"{value:.1f}" for value in column))
        for name, column in zip(names, spreads[: len(SPANS)].T, strict=True)
    ]
    yield from markdown(("cause", *(f"{span * BLOCK_S:g} s" for span in SPANS)), rows)
    largest = _largest(values, spreads)
    location, scale = gumbel_r.fit(largest)
    yield f"\nlargest of each of {len(largest)} pieces: Gumbel's law, {location:.2f}, {scale:.2f}"
    yield "largest of all: " + ", ".join(f"{value:.2f}" for value in np.sort(largest)[::-1][:10])
    alarms = 0
    for half in range(2):
        # Pieces come in pairs of modes.
        mine = [item for place, item in enumerate(values) if place // 2 % 2 == half]
        others = [item for place, item in enumerate(values) if place // 2 % 2 != half]
        bounds = _spreads(others)
        threshold = alarm_threshold(hours, gumbel_r.fit(_largest(others, bounds)))
        alarms += int(np.sum(_largest(mine, bounds) > threshold))
    seen = sum(item["motion"]["seconds"] for item in records) / 3600.0
    low, high = garwood(alarms)
    yield (
        f"each half by the threshold of the other: {alarms} pieces with an alarm in {seen:.2f} h,"
        f" {alarms / seen:.2f} an hour ({low / seen:.2f} … {high / seen:.2f}), stated"
        f" {1.0 / hours:.2f}"
    )


def _spreads(values: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Of the values over spans; that of a sum of votes is given."""
    spreads = np.quantile(np.concatenate(values), SPREAD_SHARE, axis=0)
    spreads[len(SPANS) :] = VOTE_SPREAD
    return np.asarray(np.ceil(10.0 * np.maximum(spreads, 1.0)) / 10.0)


def _largest(
    values: Sequence[NDArray[np.float64]], spreads: NDArray[np.float64]
) -> NDArray[np.float64]:
    return np.array([(item / spreads).max() for item in values])


FREE_MOTION = Study(
    "free-motion",
    "The monitor's false alarms in free motion; --changes: delays and names; --calibrate.",
    _cases, perform, _report, _options, count=24,
    counted="pieces of motion; with --changes rounds of all changes",
)  # fmt: skip
