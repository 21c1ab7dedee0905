"""Severities of a unit in free motion: the scores of a flight's blocks as one linear estimate.

About the severities that the monitor has, the bank's steps are a linear model. Nuisances are held
by what is no change of them, severities by their range. Blocks are summed up in parts, whose
scatter gives the errors, however residuals within a part are correlated (P. J. Huber, Fifth
Berkeley Symposium, 1967). An error of the model is added, which no length of motion averages out.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from ehadiag.compile.jit import Array, Array2
from ehadiag.core.criteria import NORMAL_HALF_WIDTH_95
from ehadiag.estimate import AT_BOUND, NOT_SHOWN, Severity
from ehadiag.model.registry import FAULTS
from ehadiag.monitor.score_bank import BLOCK_S, REST, BlockScore, ScoreBank
from firmware_iface import FREE_MOTION

PART_BLOCKS: Final = 20
"""Blocks of a part, 1: 10 s, longer than what a motion repeats."""
PARTS: Final = (30, 120)
"""Least number of parts for a scatter, 1: 5 min; number at which pairs are joined."""
MAX_STD: Final = 0.05
"""Largest standard error with which a severity is stated, 1."""
MAX_STEPS: Final = 1.0
"""Largest change that is stated, steps of the bank, whose sensitivities are those of one step."""
SEVERITY_MODEL_ERRORS: Final = np.array([0.05, 0.1, 0.02])
"""Standard error of the model that looks like a severity, deviations of the noise, by 21 pieces of
10 min of the twelve kinds that the thresholds of changes come from."""
NONLINEARITY: Final = 0.3
"""Standard error of the linear model, shares of the change."""


class FlightEstimate:
    """Sums up the blocks of a flight; bank: that they are of."""

    def __init__(self, bank: ScoreBank) -> None:
        self._bank, self._why = bank, ""
        self.begin_anew()

    def begin_anew(self, why: str = "") -> None:
        """Forget all blocks; why: nothing is stated from now on, whatever comes later."""
        self._why = self._why or why
        self._steady = self._bank.steady
        self._parts: list[tuple[Array, Array2]] = []
        self._length, self._blocks, self._ticks = PART_BLOCKS, 0, 0

    def add(self, block: BlockScore) -> None:
        """Add a block; where oil or supply are stated at last, begin with it."""
        if (self._bank.steady < self._steady).any():
            self.begin_anew()
        self._steady = self._bank.steady
        if self._blocks % self._length == 0:
            if len(self._parts) == PARTS[1]:
                pairs = zip(self._parts[::2], self._parts[1::2], strict=True)
                self._parts = [(one[0] + two[0], one[1] + two[1]) for one, two in pairs]
                self._length *= 2
            self._parts.append((np.zeros_like(block.score), np.zeros_like(block.information)))
        score, information = self._parts[-1]
        self._parts[-1] = score + block.score, information + block.information
        self._blocks += 1
        self._ticks += block.ticks

    def severities(self) -> tuple[tuple[Severity, ...], tuple[str, ...]]:
        """Return all severities, and why some have no number."""
        steps, why = self._bank.steps[: len(FAULTS)], self._why
        changes = stds = np.full(len(FAULTS), np.inf)
        if not why and len(self._parts) < PARTS[0]:
            why = f"less than {PARTS[0] * PART_BLOCKS * BLOCK_S / 60.0:.0f} min of free motion"
        if not why:
            changes, stds = self._changes()
            for item, change, std, step in zip(FAULTS, changes, stds, np.abs(steps), strict=True):
                if std * step <= MAX_STD and abs(change) > MAX_STEPS:
                    why = f"{item.short} has changed by more than {MAX_STEPS * step:g}"
        out, reasons = [], [f"{why}: run a test"] if why else []
        for item, given, change, std, step in zip(
            FAULTS, self._bank.faults, changes, stds * np.abs(steps), steps, strict=True
        ):
            if why or std > MAX_STD:
                if not why:
                    reasons.append(f"this motion shows {item.short} to {std:.2g} only: run a test")
                unknown = Severity(name=item.name, meaning=item.short, flags=(NOT_SHOWN,))
                out.append(unknown)
                continue
            value, reach = min(max(given + change * step, 0.0), 1.0), NORMAL_HALF_WIDTH_95 * std
            out.append(Severity(
                name=item.name, meaning=item.short, estimate=float(value), std=float(std),
                interval95=(float(max(value - reach, 0.0)), float(min(value + reach, 1.0))),
                flags=(AT_BOUND,) * (value in (0.0, 1.0)), source=FREE_MOTION,
            ))  # fmt: skip
        return tuple(out), tuple(reasons)

    def _changes(self) -> tuple[Array, Array]:
        """Changes of the severities and their standard errors, steps."""
        steady, severities = self._steady.copy(), slice(0, len(FAULTS))
        steady[severities] = 1.0 / np.abs(self._bank.steps[severities])
        kept = np.arange(len(steady)) != REST
        scores = np.array([score[kept] for score, _ in self._parts])
        every = np.array([information[np.ix_(kept, kept)] for _, information in self._parts])
        held = np.diag(steady[kept] ** -2.0)
        root = np.linalg.inv(every.sum(axis=0) + held)
        sizes = root @ scores.sum(axis=0)
        left = scores - every @ sizes
        scatter = root @ (left.T @ left + held) @ root
        own, change = np.diagonal(root)[severities], sizes[severities]
        variance = np.maximum(np.diagonal(scatter)[severities], own)
        variance += SEVERITY_MODEL_ERRORS**2 * self._ticks * own + (NONLINEARITY * change) ** 2
        return change, np.sqrt(variance)
