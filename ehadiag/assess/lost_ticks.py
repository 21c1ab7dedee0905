"""Finds by the response which jack positions a control law worked on where samples are lost.

In closed loop the noise of the jack's sensor is part of the current: a lost sample leaves the
current of the next tick unknown by some steps, and spool and pressure, tens of steps of the
pressure's converter for one of the spool's, show it for some ticks. So does a row of samples that
stands a tick beside its own amidst lost ones. What explains the measured response best is kept, the
severities are identified anew, a few times over (coordinate descent: J. Besag, On
the statistical analysis of dirty pictures, J. R. Statist. Soc. B 48(3), 1986).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator
from ehadiag.core.recording import Recording, Samples
from ehadiag.identify.commanded_current import guessed_positions
from ehadiag.identify.experiment import Experiment, build_experiment, share_offsets
from ehadiag.identify.result import Identification
from ehadiag.identify.spans import ANCHOR_LSB, lay_out
from ehadiag.identify.uncertainty import interval95
from ehadiag.model.parameters import Unknowns
from ehadiag.model.scalar.residuals import ScalarModel

__all__ = ["UNEASY", "can_be_told", "told_by_response", "widened"]

UNEASY = 0.005
"""Share of residuals beyond three deviations (0.003 for noise alone) from which on rows that time
placed amidst lost ones are taken to stand beside their own here and there."""

TOLD_STD = 1e-3
"""Deviation of each severity that this leaves: 0.0014 off was seen, changes and severities bearing
each other out."""

MOST_GUESSED = 0.1
"""Share of guessed currents up to which this was tried: 0.005 to 0.04."""
REACH = 30
"""Ticks in which a wrong current shows."""
APART = REACH + 10
"""Ticks between two changes that are tried in one run of the model."""
CLOSE = 8
"""Ticks between two changes that are made at once at least."""
CODES = (0, -1, 1, -2, 2)
"""Steps of the converter from a straight line between its neighbours that a lost position may lie
off; its noise and rounding are 0.6 steps."""
UNLIKELY = 1.3
"""Steps squared, of the same: a variance and what the straight line adds."""
FEW_ROWS = 3
"""Rows that are moved together beside a gap, besides all up to the next gap, and"""
MOST_ROWS = 40
"""at most so many of these."""
MOVED = 8.0
"""What moving rows must explain, in variances: they were placed by their time and their current."""
CLEAR = 4.0
"""By how much the best of several positions must be better than the second one, in variances."""
HOPELESS = 0.35
"""Share of residuals beyond three deviations from which on the severities are too wrong to tell
anything: 0.12 at most was mended."""
CAP, CAP_CURRENT = 9.0, 16.0
"""Most that a residual counts, in variances."""
CURRENT_NOISE = 0.6
"""Steps of the converter: its noise and rounding."""
SWEEPS = 3
"""Over all changes, between two identifications."""
ROUNDS = 3
"""Identifications."""
FEW = 3
"""Changes in a sweep from which on no further one follows."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Change:
    """A lost jack position told, or rows of samples moved by a tick.

    Attributes
    ----------
    begin : int
        First tick.
    end : int
        One past the last.
    by : int
        Ticks by which the rows are moved; 0: the position is told.
    position : float
        m, where it is told.
    unlikely : float
        What it must explain, in variances.
    """

    begin: int
    end: int
    by: int
    position: float
    unlikely: float

    @property
    def first(self) -> int:
        """First tick that it touches."""
        return min(self.begin, self.begin + self.by)


def can_be_told(recordings: Sequence[Recording], experiments: Sequence[Experiment]) -> bool:
    """Whether currents were guessed, or rows placed by time amidst lost ones, that it may tell.

    Parameters
    ----------
    recordings : Sequence[Recording]
        As recorded.
    experiments : Sequence[Experiment]
        One of each.

    Returns
    -------
    bool
        False where none was, or more than this was tried for.
    """
    shares = [item.trace.guessed for item in experiments]
    if len(recordings) != len(shares) or max(shares, default=0.0) > MOST_GUESSED:
        return False
    return any(
        share > 0.0 or _is_movable(item) for share, item in zip(shares, recordings, strict=True)
    )


def told_by_response(
    recordings: Sequence[Recording],
    experiments: Sequence[Experiment],
    actuator: Actuator,
    identify: Callable[[Sequence[Experiment]], Identification],
) -> tuple[list[Experiment], Identification, str] | None:
    """Find lost positions and misplaced rows, and identify anew.

    Parameters
    ----------
    recordings : Sequence[Recording]
        As recorded.
    experiments : Sequence[Experiment]
        One of each.
    actuator : Actuator
        Whose control law it is.
    identify : Callable[[Sequence[Experiment]], Identification]
        Identifies from experiments.

    Returns
    -------
    tuple[list[Experiment], Identification, str] | None
        The experiments with what the response told, what they say, and a note; None where it told
        nothing.
    """
    found, now = identify(experiments), list(experiments)
    shared = share_offsets(experiments)
    rows = [_Rows(*each, actuator) for each in zip(recordings, experiments, shared, strict=True)]
    told = moved = 0
    for _ in range(ROUNDS if found.fit.outliers <= HOPELESS else 0):
        made = [change for item in rows for change in item.improve(found)]
        told += sum(not item.by for item in made)
        moved += sum(abs(item.by) * (item.end - item.begin) for item in made)
        if not made:
            break
        now = [item.experiment() for item in rows]
        found = identify(now)
        if len(made) < FEW:
            break
    if not told and not moved:
        return None
    words = [f"{told} lost jack positions that the control law worked on"] if told else []
    words += [f"that {moved} rows of samples stood a tick beside their own"] if moved else []
    return now, found, f"the response told {', and '.join(words)}"


def widened(found: Identification) -> Identification:
    """Add what the telling leaves open to the severities' intervals.

    Parameters
    ----------
    found : Identification
        As if all positions had been seen.

    Returns
    -------
    Identification
        With wider intervals.
    """
    std = [float(np.hypot(item.std, TOLD_STD)) for item in found.estimates]
    estimates = tuple(
        replace(item, std=wide, interval95=interval95(item.value, wide))
        for item, wide in zip(found.estimates, std, strict=True)
    )
    covariance = found.covariance + TOLD_STD**2 * np.eye(len(std))
    return replace(found, estimates=estimates, covariance=covariance)


def _is_movable(recording: Recording) -> bool:
    """Whether time alone has placed its rows, and ticks without one are among them."""
    samples = recording.samples
    return recording.by_time and samples is not None and bool(_empty(samples).any())


def _empty(samples: Samples) -> NDArray[np.bool_]:
    """Ticks of which nothing came, shape (n,)."""
    channels = (samples.current, samples.spool, samples.pressure, samples.position)
    return np.asarray(np.isnan(channels).all(axis=0))


class _Rows:
    """Samples of one recording, changed step by step."""

    def __init__(
        self, recording: Recording, experiment: Experiment, shared: Experiment, actuator: Actuator
    ) -> None:
        assert recording.samples is not None
        self._samples = recording.samples
        self._environment = recording.environment
        self._movable = _is_movable(recording)
        self._begin = experiment
        self._shared = shared
        self._actuator = actuator
        self._anchor: tuple[float, float] | None = ANCHOR_LSB

    def experiment(self) -> Experiment:
        """Return what is identified from."""
        return self._build(self._samples, self._begin)

    def improve(self, found: Identification) -> list[Change]:
        """Make the changes that explain more of the response at such severities."""
        made: list[Change] = []
        controller = self._actuator.controller
        if not (self._begin.trace.guessed or self._movable) or controller.GAI or controller.GAD:
            return made
        ways: dict[float, tuple[float, float] | None] = {
            float(self._misfit(self._samples, found, way).sum()): way for way in (ANCHOR_LSB, None)
        }
        self._anchor = ways[min(ways)]
        for _ in range(SWEEPS):
            chosen = self._sweep(found)
            self._samples = _changed(self._samples, chosen)
            made += chosen
            if len(chosen) < FEW:
                break
        return made

    def _sweep(self, found: Identification) -> list[Change]:
        before = self._misfit(self._samples, found, self._anchor)
        gains: list[tuple[float, Change]] = []
        for together in _apart(self._changes()):
            after = self._misfit(_changed(self._samples, together), found, self._anchor)
            for change in together:
                seen = slice(max(change.first - 1, 0), change.end + REACH)
                gain = float(np.sum(before[seen] - after[seen])) - change.unlikely
                gains.append((gain, change))
        return _best(gains)

    def _changes(self) -> list[Change]:
        """What may be changed now."""
        samples, test = self._samples, self._begin.test
        lost = np.isnan(samples.position)
        out: list[Change] = []
        if lost.all():
            return out
        step, ticks = self._begin.channels.position.lsb, np.arange(len(lost))
        bridged = np.interp(ticks, ticks[~lost], samples.position[~lost])
        asked = np.zeros(0, dtype=np.int64)
        if test.closed_loop:
            law = self._actuator.controller
            asked = guessed_positions(samples, test, law, self._begin.channels)
        for tick in (asked - 1).tolist():
            if tick >= 0 and lost[tick]:
                code = round(float(bridged[tick]) / step)
                out += [
                    Change(tick, tick + 1, 0, (code + off) * step, off * off / UNLIKELY)
                    for off in CODES
                ]
        return out + (_moves(_empty(samples)) if self._movable else [])

    def _build(self, samples: Samples, begin: Experiment) -> Experiment:
        """Experiment of some samples, noise and offsets those of another."""
        item = build_experiment(samples, self._environment, begin.test, self._actuator)
        return replace(
            item,
            spool=item.spool + item.spool_offset - begin.spool_offset,
            pressure=item.pressure + item.pressure_offset - begin.pressure_offset,
            position=item.position + item.position_offset - begin.position_offset,
            spool_offset=begin.spool_offset,
            pressure_offset=begin.pressure_offset,
            position_offset=begin.position_offset,
            origin=begin.origin,
        ).with_noise(begin.noise)

    def _misfit(
        self, samples: Samples, found: Identification, anchor: tuple[float, float] | None
    ) -> Floats:
        """What each tick's samples say against some severities, in variances, shape (n,).

        anchor: see `ehadiag.identify.spans.lay_out`.
        """
        item = self._build(samples, self._shared)
        constants = found.constants(item.constants)
        model = ScalarModel(lay_out([item], anchor_lsb=anchor), Unknowns((), (constants,), {}))
        left = model.residuals(np.zeros((1, 0)))[0][0]
        trace, noise = item.trace, CURRENT_NOISE * item.channels.current.lsb
        current = np.nan_to_num((samples.current - trace.offset - trace.current) / noise)
        return np.asarray(
            np.minimum(left**2, CAP).sum(axis=0) + np.minimum(current**2, CAP_CURRENT)
        )


def _moves(lost: NDArray[np.bool_]) -> list[Change]:
    """Rows beside a gap that may be moved into it: some, or all up to the next gap."""
    out: list[Change] = []
    gaps = np.flatnonzero(np.concatenate([[True], lost, [True]])) - 1
    for before, after in zip(gaps[:-1].tolist(), gaps[1:].tolist(), strict=True):
        row = after - before - 1
        counts = {*range(1, min(row, FEW_ROWS) + 1), *([row] if 0 < row <= MOST_ROWS else [])}
        for count in sorted(counts):
            if before >= 0:
                out.append(Change(before + 1, before + 1 + count, -1, np.nan, MOVED))
            if after < len(lost):
                out.append(Change(after - count, after, 1, np.nan, MOVED))
    return out


def _changed(samples: Samples, changes: Sequence[Change]) -> Samples:
    rows = np.stack([samples.current, samples.spool, samples.pressure, samples.position])
    saturated = samples.saturated.copy()
    for item in changes:
        if not item.by:
            rows[-1, item.begin] = item.position
            continue
        for values, nothing in ((rows, np.nan), (saturated, False)):
            moved = values[:, item.begin : item.end].copy()
            values[:, item.begin : item.end] = nothing
            values[:, item.begin + item.by : item.end + item.by] = moved
    current, spool, pressure, position = rows
    return replace(
        samples,
        current=current,
        spool=spool,
        pressure=pressure,
        position=position,
        saturated=saturated,
    )


def _apart(changes: Sequence[Change]) -> Iterator[list[Change]]:
    """Changes so far apart that one run of the model tells of each of them."""
    left = sorted(changes, key=lambda item: item.first)
    while left:
        together: list[Change] = []
        others: list[Change] = []
        for item in left:
            free = not together or item.first >= together[-1].end + APART
            (together if free else others).append(item)
        yield together
        left = others


def _best(gains: Sequence[tuple[float, Change]]) -> list[Change]:
    """Changes that are clearly for the better, the best ones first, none close to another."""
    wanted = [(gain, item) for gain, item in gains if item.by and gain > 0.0]
    told: dict[int, list[tuple[float, Change]]] = {}
    for gain, item in gains:
        if not item.by:
            told.setdefault(item.begin, []).append((gain, item))
    for each in told.values():
        each.sort(key=lambda pair: -pair[0])
        margin = each[0][0] - each[1][0]
        if margin > CLEAR:
            wanted.append((margin, each[0][1]))
    chosen: list[Change] = []
    for _, item in sorted(wanted, key=lambda pair: -pair[0]):
        if all(
            item.first >= other.end + CLOSE or other.first >= item.end + CLOSE for other in chosen
        ):
            chosen.append(item)
    return chosen
