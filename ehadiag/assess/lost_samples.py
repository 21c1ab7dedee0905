"""Lost samples: severities that can still be estimated, and reconstructed positions.

In closed loop the noise of the jack's sensor is part of the current. A lost position leaves the
current of the next tick uncertain, and hides filter clogging and spool friction; jack friction
stays observable. The spool's and the pressure's response shows for some ticks which position the
control law had: the best one is kept (coordinate descent: J. Besag, On the statistical analysis
of dirty pictures, J. R. Statist. Soc. B 48(3), 1986).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ehadiag.compile.jit import Array
from ehadiag.core.actuator import Actuator
from ehadiag.core.criteria import ESTIMATION, LOSSES, ROUNDS
from ehadiag.identify.estimates import interval95
from ehadiag.identify.experiment import (
    ANCHOR_THRESHOLDS_LSB,
    Experiment,
    build_experiment,
    lay_out_spans,
    share_offsets,
)
from ehadiag.identify.identification_result import Estimate, Identification
from ehadiag.identify.signals import guessed_positions
from ehadiag.model.registry import Unknowns
from ehadiag.model.residual_models import ScalarModel
from ehadiag.model.severities import FAULT_LAWS
from firmware_iface.recording import Recording, Samples


def has_observable_severity(experiments: Sequence[Experiment]) -> bool:
    """Whether so few positions are lost that some severity can be observed."""
    return all(item.trace.guessed <= LOSSES.max_guessed_share for item in experiments)


def restrict_to_observable(
    found: Identification, experiments: Sequence[Experiment]
) -> tuple[Identification, str]:
    """Replace severities that lost samples hide by uniform densities, and widen the others.

    experiments: that it was found from. Also returns in words what can be observed and what cannot.
    """
    closed = any(item.test.closed_loop for item in experiments)
    hidden = [name for name, law in FAULT_LAWS.items() if closed and law.needs_each_tick]
    estimates = tuple(_widened_estimate(item, hidden) for item in found.estimates)
    scale = np.array(
        [
            new.std / max(old.std, np.finfo(np.float64).tiny)
            for new, old in zip(estimates, found.estimates, strict=True)
        ]
    )
    covariance = found.covariance * np.outer(scale, scale)
    restored = " and ".join(
        f"{item.name} {item.interval95[0]:.2f} … {item.interval95[1]:.2f}"
        for item in estimates
        if item.shown
    )
    words = ", but ".join(
        filter(None, [f"{', '.join(hidden)} not observable" if hidden else "", restored])
    )
    return replace(found, estimates=estimates, covariance=covariance), words


def _widened_estimate(item: Estimate, hidden: Sequence[str]) -> Estimate:
    if item.name in hidden:
        return replace(item, std=ESTIMATION.uniform_std, interval95=(0.0, 1.0), shown=False)
    std = max(item.std, LOSSES.min_severity_std)
    return replace(item, std=std, interval95=interval95(item.value, std))


RESPONSE_TICKS = 30
"""Ticks in which a wrong current shows, 1, some periods of first stage and spool: changes tried in
one run of the model, or made at once, are so far apart; more rows at once are not moved."""
POSITION_VARIANCE = 1.5 * ESTIMATION.noise_lsb**2
"""Variance of a position about a straight line between its neighbours by their noise, LSB²."""
CODE_OFFSETS = range(
    -math.floor(ESTIMATION.cauchy_scale * math.sqrt(POSITION_VARIANCE)),
    math.floor(ESTIMATION.cauchy_scale * math.sqrt(POSITION_VARIANCE)) + 1,
)
"""Distances of a lost position from such a line that are tried, LSB: two on either side."""


class SampleChange(msgspec.Struct, frozen=True):
    """A lost jack position that is filled in, or rows of samples moved by some ticks."""

    begin: int
    """First tick."""
    end: int
    """One past the last."""
    by: int
    """Ticks by which the rows are moved; 0: the position is filled in."""
    position: float
    """Position that is filled in, m."""
    penalty: float
    """Least gain in fit, in variances."""

    @property
    def first(self) -> int:
        """First tick that it touches."""
        return min(self.begin, self.begin + self.by)


def is_reconstructible(recordings: Sequence[Recording], experiments: Sequence[Experiment]) -> bool:
    """Whether currents were guessed, or rows placed by time amidst lost ones, few enough to
    correct.
    """
    shares = [item.trace.guessed for item in experiments]
    if len(recordings) != len(shares) or max(shares, default=0.0) > LOSSES.max_guessed_share:
        return False
    return any(
        share > 0.0 or _is_movable(item) for share, item in zip(shares, recordings, strict=True)
    )


def reconstruct_lost_samples(
    recordings: Sequence[Recording],
    experiments: Sequence[Experiment],
    actuator: Actuator,
    identify: Callable[[Sequence[Experiment]], Identification],
) -> tuple[list[Experiment], Identification, str] | None:
    """Find lost positions and misplaced rows by the response, and identify again by `identify`.

    Returns the corrected experiments, their identification and a note; None where nothing was
    corrected.
    """
    found, now = identify(experiments), list(experiments)
    shared = share_offsets(experiments)
    rows = [
        _RowReconstruction(*each, actuator)
        for each in zip(recordings, experiments, shared, strict=True)
    ]
    restored = moved = 0
    for _ in range(ROUNDS):
        made = [change for item in rows for change in item.improve(found)]
        restored += sum(not item.by for item in made)
        moved += sum(abs(item.by) * (item.end - item.begin) for item in made)
        if not made:
            break
        now = [item.experiment() for item in rows]
        found = identify(now)
    if not restored and not moved:
        return None
    words = [f"{restored} lost jack positions that the control law worked on"] if restored else []
    words += [f"that {moved} rows of samples stood a tick beside their own"] if moved else []
    return now, found, f"the response told {', and '.join(words)}"


def widen_intervals(found: Identification) -> Identification:
    """Add the uncertainty of a reconstruction to the severities' intervals."""
    std = [float(np.hypot(item.std, LOSSES.reconstruction_std)) for item in found.estimates]
    estimates = tuple(
        replace(item, std=wide, interval95=interval95(item.value, wide))
        for item, wide in zip(found.estimates, std, strict=True)
    )
    covariance = found.covariance + LOSSES.reconstruction_std**2 * np.eye(len(std))
    return replace(found, estimates=estimates, covariance=covariance)


def _is_movable(recording: Recording) -> bool:
    """Whether time alone has placed its rows, and ticks without one are among them."""
    samples = recording.samples
    return recording.by_time and samples is not None and bool(_empty_ticks(samples).any())


def _empty_ticks(samples: Samples) -> NDArray[np.bool_]:
    """Ticks without any sample, shape (n,)."""
    channels = (samples.current, samples.spool, samples.pressure, samples.position)
    return np.asarray(np.isnan(channels).all(axis=0))


class _RowReconstruction:
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
        self._anchor: tuple[float, float] | None = ANCHOR_THRESHOLDS_LSB

    def experiment(self) -> Experiment:
        """Return what is identified from."""
        return self._build(self._samples, self._begin)

    def improve(self, found: Identification) -> list[SampleChange]:
        """Make the changes that explain more of the response at such severities."""
        made: list[SampleChange] = []
        controller = self._actuator.controller
        if not (self._begin.trace.guessed or self._movable) or controller.GAI or controller.GAD:
            return made
        ways: dict[float, tuple[float, float] | None] = {
            float(self._misfit(self._samples, found, way).sum()): way
            for way in (ANCHOR_THRESHOLDS_LSB, None)
        }
        self._anchor = ways[min(ways)]
        for _ in range(ROUNDS):
            chosen = self._sweep(found)
            self._samples = _apply_changes(self._samples, chosen)
            made += chosen
            if not chosen:
                break
        return made

    def _sweep(self, found: Identification) -> list[SampleChange]:
        before = self._misfit(self._samples, found, self._anchor)
        gains: list[tuple[float, SampleChange]] = []
        for together in _spaced_changes(self._changes()):
            after = self._misfit(_apply_changes(self._samples, together), found, self._anchor)
            for change in together:
                seen = slice(max(change.first - 1, 0), change.end + RESPONSE_TICKS)
                gain = float(np.sum(before[seen] - after[seen])) - change.penalty
                gains.append((gain, change))
        return _best_changes(gains)

    def _changes(self) -> list[SampleChange]:
        """What may be changed now."""
        samples, test = self._samples, self._begin.test
        lost = np.isnan(samples.position)
        out: list[SampleChange] = []
        if lost.all():
            return out
        step, ticks = self._begin.channels.position.lsb, np.arange(len(lost))
        bridged = np.interp(ticks, ticks[~lost], samples.position[~lost])
        needed = np.zeros(0, dtype=np.int64)
        if test.closed_loop:
            law = self._actuator.controller
            needed = guessed_positions(samples, test, law, self._begin.channels)
        for tick in (needed - 1).tolist():
            if tick >= 0 and lost[tick]:
                code = round(float(bridged[tick]) / step)
                out += [
                    SampleChange(
                        tick,
                        tick + 1,
                        0,
                        (code + off) * step,
                        off * off / POSITION_VARIANCE,
                    )
                    for off in CODE_OFFSETS
                ]
        return out + (_row_moves(_empty_ticks(samples)) if self._movable else [])

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
    ) -> Array:
        """What each tick's samples say against some severities, in variances, shape (n,).

        anchor: see `ehadiag.identify.experiment.lay_out_spans`.
        """
        item = self._build(samples, self._shared)
        constants = found.constants(item.constants)
        model = ScalarModel(
            lay_out_spans([item], anchor_lsb=anchor), Unknowns((), (constants,), {})
        )
        left = model.residuals(np.zeros((1, 0)))[0][0]
        trace, noise = item.trace, ESTIMATION.noise_lsb * item.channels.current.lsb
        current = np.nan_to_num((samples.current - trace.offset - trace.current) / noise)
        return np.asarray(
            np.minimum(np.vstack([left, current]) ** 2, ESTIMATION.residual_cap).sum(axis=0)
        )


def _row_moves(lost: NDArray[np.bool_]) -> list[SampleChange]:
    """Rows next to a gap that may be moved into it: some, or all up to the next gap."""
    out: list[SampleChange] = []
    gaps = np.flatnonzero(np.concatenate([[True], lost, [True]])) - 1
    for before, after in zip(gaps[:-1].tolist(), gaps[1:].tolist(), strict=True):
        row = after - before - 1
        for count in sorted({1, row if row <= RESPONSE_TICKS else 1}) if row else ():
            if before >= 0:
                out.append(
                    SampleChange(before + 1, before + 1 + count, -1, np.nan, LOSSES.min_gain)
                )
            if after < len(lost):
                out.append(SampleChange(after - count, after, 1, np.nan, LOSSES.min_gain))
    return out


def _apply_changes(samples: Samples, changes: Sequence[SampleChange]) -> Samples:
    rows = np.stack([samples.current, samples.spool, samples.pressure, samples.position])
    saturated = samples.saturated.copy()
    for item in changes:
        if not item.by:
            rows[-1, item.begin] = item.position
            continue
        for values, empty in ((rows, np.nan), (saturated, False)):
            moved = values[:, item.begin : item.end].copy()
            values[:, item.begin : item.end] = empty
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


def _spaced_changes(changes: Sequence[SampleChange]) -> Iterator[list[SampleChange]]:
    """Changes so far apart that one run of the model shows the effect of each."""
    left = sorted(changes, key=lambda item: item.first)
    while left:
        together: list[SampleChange] = []
        others: list[SampleChange] = []
        for item in left:
            free = not together or item.first >= together[-1].end + RESPONSE_TICKS
            (together if free else others).append(item)
        yield together
        left = others


def _best_changes(gains: Sequence[tuple[float, SampleChange]]) -> list[SampleChange]:
    """Changes that are clearly for the better, the best ones first, none close to another."""
    wanted = [(gain, item) for gain, item in gains if item.by and gain > 0.0]
    restored: dict[int, list[tuple[float, SampleChange]]] = {}
    for gain, item in gains:
        if not item.by:
            restored.setdefault(item.begin, []).append((gain, item))
    for each in restored.values():
        each.sort(key=lambda pair: -pair[0])
        margin = each[0][0] - each[1][0]
        if margin > LOSSES.min_gain:
            wanted.append((margin, each[0][1]))
    chosen: list[SampleChange] = []
    for _, item in sorted(wanted, key=lambda pair: -pair[0]):
        if all(
            item.first >= other.end + RESPONSE_TICKS or other.first >= item.end + RESPONSE_TICKS
            for other in chosen
        ):
            chosen.append(item)
    return chosen
