"""Tests whether a unit in free motion has changed, by scores of blocks of ticks, and what changed.

Of each parameter the others, within what is no change, are projected out of the scores. A block
counts at most as much as three mean ones, and by three of its deviations. The estimate over a span
of blocks is divided by its scatter from block to block, since what a motion leaves unmodelled has
no known law, and by what is no change. A change lasts: it counts by the lesser of two spans in a
row that agree in sign.

What shows seldom, such as a clogged filter while the spool slews, is lost in such means. So each
block also votes on a step of each parameter, up and down: for it where the step explains the block
better, against it where worse, and not at all where the step moves the block by less than noise.
Votes are summed up, never below zero, and forgotten within some minutes. The threshold is one of
the largest values in pieces of healthy motion, see `alarm_threshold`. A change is an alarm where
one cause of more than its tolerance explains the last blocks far better.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

import msgspec
import numpy as np

from ehadiag.compile.jit import Array, Array2
from ehadiag.model.registry import FAULT_NAMES, parameter
from ehadiag.monitor.flight import FlightEstimate
from ehadiag.monitor.plan import FALSE_ALARM_HOURS_RANGE
from ehadiag.monitor.score_bank import (
    BANK,
    BANK_NAMES,
    BLOCK_S,
    REST,
    BlockScore,
    ScoreBank,
)
from firmware_iface.errors import ConfigurationError
from firmware_iface.recording import CommandMode, Environment

SETTLING_BLOCKS: Final = 2
"""Blocks that only put the modelled spool where it is seen, 1."""
SPANS: Final = (20, 60)
"""Blocks of a span, 1: 10 and 30 s, the longer one for what shows seldom."""
STRIDE: Final = 10
"""Blocks between two looks, 1."""
MAX_BLOCK_SHARE: Final = 3.0
"""Largest information of a block, in means of the span."""
MAX_BLOCK_DEVIATIONS: Final = 3.0
"""Largest score of a block, in deviations: a jack that stuck in the model alone is one block."""
MIN_BLOCKS: Final = 4.0
"""Least effective number of blocks in a span, 1: fewer have no scatter."""
VOTE_GAIN: Final = 50.0
"""Gain, squares of deviations, at which a block's vote is one half; a vote is below one, so that
no block with a break-away elsewhere than in the model outvotes several others."""
VOTE_MARGIN: Final = 0.4
"""Share of each vote that is taken off its sum, so that one that wins less than seven in ten falls
to zero: in hot oil a sawtooth of current commands won two in three for a clogged filter."""
VOTE_CAP: Final = 1.5
"""Largest sum of votes, thresholds: a change that is over is soon forgotten."""
CAUSES: Final = tuple(index for index in range(len(BANK)) if index != REST)
"""Places of the causes in the bank."""
HEALTHY_SPREADS: Final = np.array([
    (1.5, 1.5), (1.8, 1.8), (1.0, 1.0), (1.0, 1.0), (1.0, 1.0), (1.5, 1.0), (1.0, 1.0), (1.0, 1.0),
    (1.0, 1.0), (1.0, 1.0), (1.0, 1.0), (1.0, 1.0), (1.0, 1.0), (1.0, 1.0),
]).T  # fmt: skip
"""97 % of the values of healthy motion are below, by span and cause (tools/study free-motion
--calibrate)."""
VOTE_SPREADS: Final = np.array([
    2.25, 1.5, 0.75, 0.75, 0.75, 1.75, 2.25, 0.75, 1.0, 0.75, 1.5, 1.5, 0.75, 0.75,
])  # fmt: skip
"""The same of the largest sums of votes of a piece: errors of the model in cold and hot oil look
like a clogged filter, a gain or another supply, seldom like friction of the jack."""
PIECE_H: Final = 1.0 / 12.0
"""Length of the pieces of healthy motion whose largest values make the threshold, h; also the time
constant of the sums of votes, so that those of a piece owe little to the time before it."""
GUMBEL: Final = (-1.2, 0.9)
"""Location and scale of the law of those values: the tail of 30 h of 22 kinds of motion, of which
it holds the scatter from kind to kind. Above 1.8 were 12 of 356 pieces, by 0.95 in the mean: of 176
by tools/study free-motion --calibrate --piece 600 --cases 88 --seed 71000, and of 180 of a run of
ten of the kinds while they were held out (at a5166600 tools/study free-motion --kinds held-out
--cases 30 --piece 1800 --seed 69000). Of that only the six half hours with an alarm were scored
again; the other 24 were taken to lie below."""
TAIL_H: Final = 2.0
"""Mean time between values at which that tail begins, h."""
TRIAL_BLOCKS: Final = 40
"""Blocks in which causes are tried, 1: 20 s, or since votes began."""
TRIAL_RATIO: Final = 2.0
"""Ratio of the sizes in which each cause is tried first."""
TRIAL_SIZES: Final = 11
"""Largest number of these: a current offset's."""
TRIAL_ROUNDS: Final = 5
"""Rounds of closer sizes, 1: to 2 %. A cause a tenth off its size explained less than others."""
REFINED_CAUSES: Final = 5
"""Causes whose sizes are tried more closely, 1."""
LEAST_GAIN: Final = 2.5
"""Least gain of the likeliest cause, see `ScoreBank.gains`: that of changes in the kinds of motion
that the threshold comes from is 3.0 and more, mostly tens, that of one false alarm in two 1 to 2.3.
"""
LEAST_TRIAL: Final = 1.5
"""Least size that is tried, over what is no change, 1."""
LIKELY_SHARE: Final = 0.5
"""Share of the best cause's gain from which another one is named, too."""
LIKELY_DEVIATIONS: Final = 2.0
"""Deviations of its difference from the best cause up to which it is."""
REPEAT_S: Final = 60.0
"""Time after a change was named in which none is named, s: so is one that goes on once a minute."""
SAME_CAUSE_S: Final = 3600.0
"""Time of motion after an alarm within which the same cause, no larger, repeats it, s."""
GROWTH: Final = 1.5
"""Size, over that of its alarm, above which a cause may be another alarm, 1: half again."""
LEAST: Final = 0.02
"""Least change of a severity worth an alarm, 1, by default: some errors of a diagnosis."""


CAUSE_UNITS: Final = {
    "spool_offset": (1e6, " µm"), "pressure_offset": (1e-6, " MPa"), "null_bias": (1e3, " mA"),
    "load": (1.0, " N"), "supply": (1e-6, " MPa"), "oil": (1.0, " K"),
    "current_offset": (1e3, " mA"), "current_gain": (100.0, " %"), "spool_gain": (100.0, " %"),
    "pressure_gain": (100.0, " %"), "position_gain": (100.0, " %"),
}  # fmt: skip
"""Scale and unit of a cause's size, for people; a severity has none."""
BUS_CAUSES: Final = {
    "supply": "supply pressure", "oil": "oil temperature",
    "current_offset": "current sensor offset", "current_gain": "current sensor gain",
}  # fmt: skip
"""Causes that the registry has no name for."""


class Cause(msgspec.Struct, frozen=True):
    """What may have changed, by how much."""

    name: str
    """By the registry's names, or `supply`, `oil`, `current_offset`, `current_gain`."""
    size: float
    """SI."""
    stderr: float
    """Standard error by the scatter of blocks, SI; of a voted cause, which has no scatter, its size
    over the root of the number of votes won: an order of magnitude."""

    def __str__(self) -> str:
        """What it is, its size and its standard error: `spool friction +0.04 ± 0.01`."""
        scale, unit = CAUSE_UNITS.get(self.name, (1.0, ""))
        short = BUS_CAUSES.get(self.name) or parameter(self.name).short
        size, error = self.size * scale, self.stderr * scale
        places = max(0, -math.floor(math.log10(max(error, 1e-6))))
        return f"{short} {size:+.{places}f} ± {error:.{places}f}{unit}"


class Change(msgspec.Struct, frozen=True):
    """A change that was found."""

    causes: tuple[Cause, ...]
    """The most likely one first, then those that explain nearly as much."""
    value: float
    """Of the test, over its threshold."""
    repeated: bool
    """Whether it was named less than a minute ago (then without causes), or its likeliest cause, in
    the same direction and no larger, raised an alarm within the last hour of motion."""


def alarm_threshold(hours: float, law: tuple[float, float] = GUMBEL) -> float:
    """Value of the test that healthy motion exceeds once in so many hours.

    The pieces of motion are exchangeable, whatever the correlation within one; expected numbers of
    alarms add up even where pieces are not independent. Beyond the hours of the study the tail of
    their largest values is extrapolated; before it begins the threshold is that of its beginning.
    Hours out of range raise ConfigurationError.
    """
    if not FALSE_ALARM_HOURS_RANGE[0] <= hours <= FALSE_ALARM_HOURS_RANGE[1]:
        low, high = FALSE_ALARM_HOURS_RANGE
        raise ConfigurationError(f"hours between false alarms {hours:g}: need {low:g} … {high:g}")
    share = -math.expm1(-PIECE_H / max(hours, TAIL_H))
    return law[0] - law[1] * math.log(-math.log1p(-share))


class ChangeTest:
    """Takes ticks and finds changes.

    bank: of the unit; rate: ticks a second; hours: mean time between false alarms, h; least: least
    change of a severity worth an alarm, 1. ConfigurationError: hours or least out of range.
    """

    def __init__(self, bank: ScoreBank, rate: float, hours: float, least: float = LEAST) -> None:
        if not 0.0 <= least <= 1.0:
            raise ConfigurationError(f"least change {least:g}: need 0 … 1")
        self._bank, self._least, self._mode = bank, least, bank.mode
        self._threshold = alarm_threshold(hours)
        self._rate = rate
        self._rows = np.empty((round(BLOCK_S * rate), 5))
        self._count = 0
        self._settling = 0
        self._environment = Environment()
        kept = 2 * max(SPANS)
        self._scores: deque[BlockScore] = deque(maxlen=kept)
        self._kept: deque[tuple[Array2, Environment]] = deque(maxlen=TRIAL_BLOCKS)
        self._spans: deque[list[Array | None]] = deque(maxlen=kept // STRIDE)
        self._elapsed = 0.0  # of motion, s
        self._tried = -math.inf
        self._alarmed: dict[tuple[str, bool], tuple[float, float]] = {}
        self._looks = 0
        self._ignored = 0
        self.flight = FlightEstimate(bank)
        """Severities by all blocks since the beginning, or the last change."""
        self.value = 0.0
        """Of the test when it looked last, over its threshold."""
        self.values: Array2 = np.zeros((len(SPANS) + 2, len(CAUSES)))
        """Of each cause: normal deviates by span, sums of votes for a step up and down."""
        self.reset()

    def reset(self) -> None:
        """Begin anew after a silence: the spool is anywhere."""
        self._count, self._settling = 0, SETTLING_BLOCKS
        self._clear_votes()

    def _clear_votes(self) -> None:
        """Begin the sums of votes anew."""
        self.values[len(SPANS) :] = 0.0
        self._voting = np.zeros((2, len(CAUSES)), dtype=np.int64)

    def tune(self, environment: Environment) -> None:
        """Take this oil and supply from the next block on."""
        self._environment = environment

    def follow(self, mode: CommandMode) -> Change | None:
        """Take commands as of this mode from the next tick on; a change may end a block."""
        if mode is self._mode:
            return None
        found, self._mode = self._end_block(), mode
        self._bank.follow(mode)
        return found

    def push(self, tick: tuple[float, float, float, float, float]) -> Change | None:
        """Take a tick as `Monitor.push`; returns a change with the tick that ends its block."""
        self._rows[self._count] = tick
        self._count += 1
        return self._end_block() if self._count == len(self._rows) else None

    def _end_block(self) -> Change | None:
        rows, self._count = self._rows[: self._count].copy(), 0
        if not len(rows):
            return None
        self._elapsed += len(rows) / self._rate
        self._bank.tune(self._environment)
        if self._settling:
            if self._settling == SETTLING_BLOCKS:
                seen = rows[np.isfinite(rows[:, 2]), 2]
                if not len(seen):
                    return None
                self._bank.reset(float(seen[0]))
            self._settling -= 1
            self._bank.settle(rows)
            return None
        self._scores.append(self._bank.push(rows))
        self.flight.add(self._scores[-1])
        gain = self._scores[-1].gain[:, CAUSES]
        votes = gain / (np.abs(gain) + VOTE_GAIN)
        worn = np.arange(len(FAULT_NAMES))
        # No wear falls; a step down is the second row, or the first one near the limit.
        votes[(self._bank.steps[worn] > 0.0).astype(int), worn] = 0.0
        sums = self.values[len(SPANS) :]
        sums *= math.exp(-BLOCK_S / (3600.0 * PIECE_H))
        sums += votes - VOTE_MARGIN * np.abs(votes)
        np.clip(sums, 0.0, VOTE_CAP * VOTE_SPREADS * self._threshold, out=sums)
        self._voting = np.where(sums < 1.0, 0, self._voting + 1)
        self._kept.append((rows, self._environment))
        self._looks += 1
        return self._look() if self._looks % STRIDE == 0 else None

    def _look(self) -> Change | None:
        scores, steady = list(self._scores), self._bank.steady
        now = [
            span_values(scores[-span:], steady) if len(scores) >= span else None for span in SPANS
        ]
        self._spans.append(now)
        values = self.values.copy()
        values[: len(SPANS)] = 0.0
        for place, (span, found) in enumerate(zip(SPANS, now, strict=True)):
            ago = span // STRIDE + 1
            before = self._spans[-ago][place] if len(self._spans) >= ago else None
            if found is not None and before is not None:
                values[place] = _minmod(found, before)
        self.values = values
        shares = np.abs(values) / self._threshold
        shares[: len(SPANS)] /= HEALTHY_SPREADS
        shares[len(SPANS) :] /= VOTE_SPREADS
        # What changed is tried on blocks after the change: they must be enough.
        shares[len(SPANS) :] *= self._voting >= SPANS[0]
        self.value = float(shares.max())
        if self.value <= 1.0:
            return None
        if self._elapsed - self._tried < REPEAT_S:
            return Change((), self.value, repeated=True)
        if self._looks < self._ignored:
            return None
        best = shares.argmax(axis=0), np.arange(len(CAUSES))
        voted = best[0] >= len(SPANS)
        deviates = np.where(
            voted, np.sqrt(np.abs(values[best]) / (1.0 - VOTE_MARGIN)), values[best]
        )
        row, column = map(int, np.unravel_index(int(shares.argmax()), shares.shape))
        length = TRIAL_BLOCKS
        if row >= len(SPANS):
            length = min(int(self._voting[row - len(SPANS), column]) + 1, TRIAL_BLOCKS)
        blocks = list(self._kept)[-length:]
        causes = self._causes(deviates, blocks)
        if not causes or (causes[0].name in FAULT_NAMES and abs(causes[0].size) < self._least):
            self._ignored = self._looks + max(SPANS)
            self._clear_votes()
            return None
        self._clear_votes()
        self._tried = self._elapsed
        side = causes[0].name, causes[0].size > 0.0
        when, alarmed = self._alarmed.get(side, (-math.inf, 0.0))
        again = self._elapsed - when < SAME_CAUSE_S and not self._has_grown(
            causes[0], alarmed, blocks
        )
        # What else has changed is not what holds the nuisances.
        others = [item for item in causes if item.name not in FAULT_NAMES]
        if others or not again:
            self.flight.begin_anew(f"an alarm named {others[0]}" if others else "")
        if not again:
            self._alarmed[side] = self._elapsed, causes[0].size
        return Change(causes, self.value, repeated=again)

    def _has_grown(
        self, cause: Cause, alarmed: float, blocks: list[tuple[Array2, Environment]]
    ) -> bool:
        """Whether a cause is larger than at its alarm, and blocks tell one size from the other."""
        if abs(cause.size) <= GROWTH * abs(alarmed):
            return False
        place = BANK_NAMES.index(cause.name)
        sizes = np.array([alarmed, cause.size]) / self._bank.steps[place]
        return _is_less(*self._bank.gains(blocks, [(place, size) for size in sizes.tolist()]))

    def _causes(self, values: Array, blocks: list[tuple[Array2, Environment]]) -> tuple[Cause, ...]:
        """Try all causes in all sizes, the best ones closer and closer, and order them by what they
        explain since the time from which they explain most.
        """
        found: dict[int, tuple[float, float, Array]] = {}
        least = LEAST_TRIAL * self._bank.steady[list(CAUSES)]

        def try_sizes(trials: list[tuple[int, float]]) -> list[int]:
            within = [
                item for item in trials if least[item[0]] <= abs(item[1]) <= MAX_SIZES[item[0]]
            ]
            gains = self._bank.gains(blocks, [(CAUSES[place], size) for place, size in within])
            for (place, size), gain in zip(within, gains, strict=True):
                since = np.cumsum(gain[::-1])
                if since.max() > found.get(place, (0.0,))[0]:
                    found[place] = float(since.max()), size, gain[-1 - int(since.argmax()) :]
            return sorted(found, key=lambda place: -found[place][0])[:REFINED_CAUSES]

        ordered = try_sizes(
            [(place, side * least[place] * TRIAL_RATIO**power) for place in range(len(CAUSES))
             for power in range(TRIAL_SIZES) for side in (1.0, -1.0)]
        )  # fmt: skip
        for part in range(1, TRIAL_ROUNDS + 1):
            factors = TRIAL_RATIO ** (0.5**part), TRIAL_RATIO ** -(0.5**part)
            ordered = try_sizes(
                [(place, found[place][1] * factor) for place in ordered for factor in factors]
            )
        best, _, shown = found[ordered[0]] if ordered else (0.0, 0.0, np.empty(0))
        ordered = [
            place for place in ordered
            if found[place][0] >= max(LEAST_GAIN, LIKELY_SHARE * best)
            and not _is_less(found[place][2], shown)
        ]  # fmt: skip
        steps = self._bank.steps[list(CAUSES)]
        return tuple(
            Cause(
                BANK_NAMES[CAUSES[place]],
                float(found[place][1] * steps[place]),
                float(abs(found[place][1] * steps[place]) / max(abs(values[place]), 1.0)),
            )
            for place in ordered
        )


def _is_less(gain: Array, best: Array) -> bool:
    """Whether a cause explains the last blocks less than the best one beyond the scatter of blocks.

    By Q. H. Vuong, Econometrica 57, 1989.
    """
    less = np.zeros(max(len(gain), len(best)))
    less[-len(best) :] += best
    less[-len(gain) :] -= gain
    return bool(less.sum() > LIKELY_DEVIATIONS * math.sqrt(len(less)) * less.std())


def span_values(scores: list[BlockScore], steady: Array) -> Array:
    """Value of each cause over a span of blocks.

    steady: standard deviations of what is no change, steps. Values are normal deviates where blocks
    are alike.
    """
    causes = np.array(CAUSES)
    score = np.array([item.score for item in scores])[:, causes]
    information = np.array([item.information for item in scores])[:, causes[:, None], causes]
    own = steady[causes]
    root = np.linalg.inv(information.sum(axis=0) + np.diag(own**-2.0))
    # Column k leaves of k what the others, by their own spread, do not explain.
    apart = root / np.diagonal(root)
    score = score @ apart
    weight = np.maximum(np.einsum("bkj,jk->bk", information, apart), 1e-12)
    share = np.minimum(1.0, MAX_BLOCK_SHARE * weight.mean(axis=0) / weight)
    deviations = share * np.abs(score) / np.sqrt(share * weight)
    share *= np.minimum(1.0, MAX_BLOCK_DEVIATIONS / np.maximum(deviations, MAX_BLOCK_DEVIATIONS))
    score, weight = score * share, weight * share
    total = weight.sum(axis=0)
    size = score.sum(axis=0) / total
    count = total**2 / (weight**2).sum(axis=0)
    scatter = ((score - weight * size) ** 2).sum(axis=0) * count / np.maximum(count - 1.0, 0.1)
    ticks = sum(item.ticks for item in scores)
    spread = np.sqrt(
        np.maximum(scatter, total) / total**2 + own**2 + MODEL_ERRORS**2 * ticks / total
    )
    shown = (total > MIN_INFORMATION) & (count >= MIN_BLOCKS)
    return np.where(shown, size / spread, 0.0)


MODEL_ERRORS: Final = np.array(
    [0.05, 0.05, 0.02, 0.025, 0.01, 0.05, 0.03, 0.014, 0.05, 0.01, 0.014, 0.04, 0.01, 0.01]
)
"""Error of the model that looks like a cause for as long as a span, deviations: what 97 % of
healthy spans are below, at most 0.05 (tools/study free-motion --calibrate). A held spool that rests
elsewhere than in the model looked like its sensor's gain, with a small scatter, by up to 0.15."""
MIN_INFORMATION: Final = 1e-3
"""Least information of a span, squares of steps: below there is nothing to see."""
MAX_SIZES: Final = np.array(
    [4.5, 6.0, 6.0, 60.0, 60.0, 5.0, 5.0, 10.0, 25.0, 200.0, 30.0, 30.0, 200.0, 50.0]
)
"""Largest sizes that are tried, steps, by cause: `Kintas` by 0.45 and frictions by 0.3, offsets of
spool and pressure by 60 µm and 6 MPa, gains of the sensors by 10 to 50 %, null bias by 0.5 mA, load
by 20 kN, supply and oil by 9 MPa and 90 K, current offset by 2 mA."""


def _minmod(now: Array, before: Array) -> Array:
    """The lesser of two values that agree in sign, else 0."""
    return np.where(now * before > 0.0, np.sign(now) * np.minimum(np.abs(now), np.abs(before)), 0.0)
