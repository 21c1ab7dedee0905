"""From a recording to what the identification works on: inputs, outputs and their noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator
from ehadiag.core.channels import PRESSURE, SPOOL, Channel
from ehadiag.core.recording import Environment, Samples
from ehadiag.core.stored_test import StoredTest, Window
from ehadiag.identify.commanded_current import CurrentTrace, commanded_current
from ehadiag.model.plant import PlantConstants, plant_constants
from ehadiag.model.scalar.residuals import Batch
from ehadiag.model.scalar.response import FREE_RUN, Anchor

__all__ = [
    "ANCHOR_LSB",
    "Experiment",
    "build_experiment",
    "judge_noise",
    "make_batch",
    "noise_is_judged_early",
    "share_offsets",
]

KEPT_SHARE = 0.98
KEPT_MEAN = 0.75978
"""Mean absolute value of a standard normal variable, the largest 2 % left out."""
TYPICAL_NOISE_LSB = float(np.sqrt(0.5**2 + 1.0 / 12.0))
"""Noise of a 12-bit channel of the contract, LSB: thresholds in LSB are meant at this noise."""
ANCHOR_GAIN = 0.3
ANCHOR_LSB = (1.3, 6.0)
"""Filtered and single innovations beyond which the model is put back on the spool, LSB."""
DISPLACED = 0.3e6
"""Pressure at rest (Pa) above which it is none of the sensor's offset."""
LEAST_REST = 20
"""Samples at rest from which an offset is taken."""
QUIET_BLOCK = 100
"""Ticks over which noise is judged."""
LEAST_QUIET_BLOCKS = 20
QUIET_SHARE = 0.867
"""Deviation of white noise in the quietest fifth of such blocks (0.864 to 0.869 for 2 to 5.5 s)."""


@dataclass(frozen=True, slots=True, eq=False)
class Experiment:
    """One recorded test, ready for identification; arrays of shape (n,)."""

    test: StoredTest
    constants: PlantConstants
    tick: float
    """s."""
    trace: CurrentTrace
    spool: NDArray[np.float64]
    """Measured less its offset, m; NaN where missing or at the converter's end."""
    pressure: NDArray[np.float64]
    """Measured less its offset, Pa; NaN where missing or at the converter's end."""
    spool_noise: float
    """Standard deviation, m."""
    pressure_noise: float
    """Standard deviation, Pa."""
    spool_offset: float
    """Already taken off `spool`, m: its mean while the actuator rests before the test moves it."""
    pressure_offset: float
    """Already taken off `pressure`, Pa."""
    rested: bool
    """Whether the actuator rested long enough before the test to show them."""
    origin: float
    """Spool position before the test, m, as the pressure at rest tells."""

    @property
    def ticks(self) -> int:
        """Number of ticks."""
        return len(self.spool)


def build_experiment(
    samples: Samples, environment: Environment, test: StoredTest, actuator: Actuator
) -> Experiment:
    """Prepare a recording for identification."""
    spool = np.where(samples.saturated[1], np.nan, samples.spool)
    pressure = np.where(samples.saturated[2], np.nan, samples.pressure)
    trace = commanded_current(samples, test, actuator.controller)
    rest = _ticks_at_rest(trace.current)
    constants = plant_constants(actuator, environment)
    spool_offset, pressure_offset = _mean(spool[:rest]), _mean(pressure[:rest])
    origin = 0.0
    if constants.FR != 0.0:
        # What the jack's load asks for is no offset.
        pressure_offset = 0.0
    elif abs(pressure_offset) > DISPLACED:
        # So much pressure is that of a spool that friction holds beside the middle.
        leak = 1.0 + constants.GP / constants.GQ * constants.CLK
        origin = min(max(pressure_offset * leak / constants.GP, -constants.XSM), constants.XSM)
        spool_offset, pressure_offset = spool_offset - origin, 0.0
    spool, pressure = spool - spool_offset, pressure - pressure_offset
    # Before the sines only, where that suffices: the same while the test still runs.
    quiet = _first_part(test) if noise_is_judged_early(test) else len(spool)
    return Experiment(
        test=test,
        constants=constants,
        tick=samples.period_ns * 1e-9,
        trace=trace,
        spool=spool,
        pressure=pressure,
        spool_noise=_noise(spool[:quiet], SPOOL),
        pressure_noise=_noise(pressure[:quiet], PRESSURE),
        spool_offset=spool_offset,
        pressure_offset=pressure_offset,
        rested=rest >= LEAST_REST,
        origin=origin,
    )


def _first_part(test: StoredTest) -> int:
    """Ticks of a test before its genetic search's window."""
    return round(min(begin for begin, _ in test.windows.refinement) * test.rate)


def noise_is_judged_early(test: StoredTest) -> bool:
    """Whether the test's first part is long enough to judge the noise by."""
    return _first_part(test) >= LEAST_QUIET_BLOCKS * QUIET_BLOCK


def _ticks_at_rest(current: NDArray[np.float64]) -> int:
    """How long the current is zero before the test moves the actuator.

    In closed loop the noise of the jack's sensor keeps the spool moving: no rest, no offset yet.
    """
    moving = np.flatnonzero(current != 0.0)
    return int(moving[0]) if moving.size else len(current)


def _mean(values: NDArray[np.float64]) -> float:
    """Mean of what is there; 0 of too little."""
    seen = values[np.isfinite(values)]
    return float(seen.mean()) if seen.size >= LEAST_REST else 0.0


def share_offsets(experiments: Sequence[Experiment]) -> list[Experiment]:
    """Take the sensors' offsets, where one test of the actuator shows them at rest, off all."""
    resting = [item for item in experiments if item.rested]
    if not resting:
        return list(experiments)
    spool = float(np.mean([item.spool_offset for item in resting]))
    pressure = float(np.mean([item.pressure_offset for item in resting]))
    return [
        item
        if item.rested
        else replace(
            item,
            spool=item.spool - spool,
            pressure=item.pressure - pressure,
            spool_offset=spool,
            pressure_offset=pressure,
        )
        for item in experiments
    ]


def judge_noise(experiment: Experiment, gaps: NDArray[np.float64]) -> Experiment:
    """Weigh an experiment anew, by the noise that its gaps show, shape (2, n).

    Second differences of the gaps hold what is noise; what the model fails to explain moves
    slowly and stays out, so that it still shows as a gap that the noise does not cover.
    """
    scale = []
    for row in gaps:
        known = row != 0.0
        second = (row[2:] - 2.0 * row[1:-1] + row[:-2])[known[2:] & known[1:-1] & known[:-2]]
        most = np.sort(np.abs(second))[: int(KEPT_SHARE * second.size)]
        spread = np.mean(most) / (KEPT_MEAN * np.sqrt(6.0)) if most.size else 1.0
        scale.append(float(spread))
    return replace(
        experiment,
        spool_noise=max(experiment.spool_noise * scale[0], SPOOL.lsb / np.sqrt(12.0)),
        pressure_noise=max(experiment.pressure_noise * scale[1], PRESSURE.lsb / np.sqrt(12.0)),
    )


def make_batch(
    experiments: Sequence[Experiment],
    windows: Sequence[Sequence[Window]] | None = None,
    *,
    lead: float = 0.0,
    channels: tuple[bool, bool] = (True, True),
    anchor_lsb: tuple[float, float] | None = None,
) -> Batch:
    """Lay spans of experiments one behind the other.

    Parameters
    ----------
    windows: for each experiment the spans (s) to explain; None: all of every test.
    lead: run-in before each span, s, without weight.
    channels: whether spool and pressure count.
    anchor_lsb: re-anchoring thresholds (small, large) in units of LSB-sized noise; None: free run.
    """
    parts: list[tuple[Experiment, int, int, int]] = []
    for index, experiment in enumerate(experiments):
        spans = [(0.0, experiment.ticks * experiment.tick)] if windows is None else windows[index]
        for start, end in spans:
            a = round(start / experiment.tick)
            b = min(round(end / experiment.tick), experiment.ticks)
            first = max(0, a - round(lead / experiment.tick))
            if b - a > 1:
                parts.append((experiment, first, a, b))
    if not parts:
        raise ValueError("no span of any experiment is inside its recording")
    weight, anchors, origins = [], [], []
    for experiment, first, a, b in parts:
        inside = np.arange(first, b) >= a
        on_spool = inside & np.isfinite(experiment.spool[first:b]) & channels[0]
        on_pressure = inside & np.isfinite(experiment.pressure[first:b]) & channels[1]
        weight.append(
            np.vstack([on_spool / experiment.spool_noise, on_pressure / experiment.pressure_noise])
        )
        unit = experiment.spool_noise / TYPICAL_NOISE_LSB
        anchor = FREE_RUN
        if anchor_lsb is not None:
            anchor = Anchor(ANCHOR_GAIN, anchor_lsb[0] * unit, anchor_lsb[1] * unit)
        anchors.append(anchor.as_array())
        origins.append(_origin(experiment, first))
    return Batch(
        constants=np.array([tuple(part[0].constants) for part in parts]),
        tick=np.array([part[0].tick for part in parts]),
        start=np.concatenate([[0], np.cumsum([b - first for _, first, _, b in parts])]),
        origin=np.array(origins),
        current_before=np.array([e.trace.current[i - 1] if i else 0.0 for e, i, _, _ in parts]),
        current=np.concatenate([e.trace.current[i:b] for e, i, _, b in parts]),
        spool=np.concatenate([e.spool[i:b] for e, i, _, b in parts]),
        pressure=np.concatenate([e.pressure[i:b] for e, i, _, b in parts]),
        weight=np.hstack(weight),
        anchor=np.array(anchors),
    )


def _origin(experiment: Experiment, first: int) -> float:
    """Spool position before tick `first`, m: where it rests before the test, else measured."""
    if first == 0:
        return experiment.origin
    before = experiment.spool[max(0, first - 5) : first]
    seen = before[np.isfinite(before)]
    return float(seen[-1]) if seen.size else 0.0


def _noise(values: NDArray[np.float64], channel: Channel) -> float:
    """Noise of a channel from second differences in the quietest blocks of what is handed in.

    Second differences do not see a steady slope; the quietest fifth of the blocks is where the
    actuator rests or creeps. Never below what the converter's rounding alone makes.
    """
    second = values[2:] - 2.0 * values[1:-1] + values[:-2]
    blocks = second[: len(second) // QUIET_BLOCK * QUIET_BLOCK].reshape(-1, QUIET_BLOCK)
    enough = np.isfinite(blocks).sum(axis=1) > QUIET_BLOCK // 2
    floor = channel.lsb / np.sqrt(12.0)
    if not enough.any():
        return float(channel.lsb * TYPICAL_NOISE_LSB)
    power = np.sort(np.nanmean(blocks[enough] ** 2, axis=1)) / 6.0
    quiet = power[: max(1, len(power) // 5)]
    return float(max(np.sqrt(np.median(quiet)) / QUIET_SHARE, floor))
