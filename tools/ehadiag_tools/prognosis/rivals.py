"""What the prognosis is measured beside: lines, a Bayesian line, and progpy's particle filter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ehadiag.prognosis.lives import Life

__all__ = ["Guess", "Rival", "bayesian_line", "line", "particle_filter"]

Array = NDArray[np.float64]
DRAWS = 2000
PARTICLES = 1000
LEAST = 3
LONGEST_H = 1e6


@dataclass(frozen=True, slots=True)
class Guess:
    """Remaining hours: 10, 50 and 90 % quantiles; infinite for never."""

    low: float
    median: float
    high: float


Rival = Callable[[Life, Sequence[Life], float, np.random.Generator], Guess | None]
"""From the present life and the fleet's; None: no number."""


def line(
    life: Life, _fleet: Sequence[Life], limit: float, rng: np.random.Generator
) -> Guess | None:
    """Least squares through the life's own diagnoses, drawn from its t density."""
    if len(life.age) < LEAST:
        return None
    design = np.column_stack([np.ones_like(life.age), life.age])
    best, *_ = np.linalg.lstsq(design, life.value, rcond=None)
    freedom = len(life.age) - 2
    left = life.value - design @ best
    variance = float(left @ left) / freedom + 1e-12
    root = np.linalg.cholesky(variance * np.linalg.inv(design.T @ design))
    t = np.sqrt(freedom / rng.chisquare(freedom, DRAWS))
    drawn = best + (rng.standard_normal((DRAWS, 2)) @ root.T) * t[:, None]
    return _crossed(drawn, life, limit)


def bayesian_line(
    life: Life, fleet: Sequence[Life], limit: float, rng: np.random.Generator
) -> Guess | None:
    """Conjugate regression: intercept and slope have the fleet's mean and spread before."""
    fits, spreads = [], []
    for other in fleet:
        if len(other.age) >= LEAST:
            design = np.column_stack([np.ones_like(other.age), other.age])
            best, *_ = np.linalg.lstsq(design, other.value, rcond=None)
            fits.append(best)
            spreads.append(float(np.mean((other.value - design @ best) ** 2)))
    mean = np.mean(fits, axis=0)
    before = np.linalg.inv(np.cov(np.array(fits).T) + np.diag([1e-8, 1e-16]))
    weight = 1.0 / float(np.mean(spreads))
    design = np.column_stack([np.ones_like(life.age), life.age])
    covariance = np.linalg.inv(before + weight * design.T @ design)
    best = covariance @ (before @ mean + weight * design.T @ life.value)
    root = np.linalg.cholesky(covariance)
    return _crossed(best + rng.standard_normal((DRAWS, 2)) @ root.T, life, limit)


def _crossed(lines: Array, life: Life, limit: float) -> Guess:
    with np.errstate(divide="ignore", invalid="ignore"):
        at = np.where(lines[:, 1] > 0.0, (limit - lines[:, 0]) / lines[:, 1], np.inf)
    return _guess(np.maximum(at - life.age[-1], 0.0))


def _guess(left: Array) -> Guess:
    return Guess(*(float(np.quantile(left, q, method="lower")) for q in (0.1, 0.5, 0.9)))


def particle_filter() -> Rival | None:
    """Filter of NASA's progpy on a severity that grows at a wandering rate; None: not installed.

    The states are severity and rate, with process noise on both, sized by the fleet; progpy's own
    `ParticleFilter` follows the diagnoses, and its particles are run on by the same model until
    they reach the limit.
    """
    try:
        from progpy import PrognosticsModel  # noqa: PLC0415 - of the bench group
        from progpy.state_estimators import ParticleFilter  # noqa: PLC0415
        from progpy.uncertain_data import UnweightedSamples  # noqa: PLC0415
    except ImportError:
        return None

    class Wear(PrognosticsModel):
        inputs: list[str] = []  # noqa: RUF012 - progpy's own form
        states = ["severity", "rate"]  # noqa: RUF012
        outputs = ["severity"]  # noqa: RUF012
        events = ["limit"]  # noqa: RUF012
        is_vectorized = True

        def initialize(self, *_: Any, **__: Any) -> Any:
            return self.StateContainer({"severity": 0.0, "rate": 0.0})

        def dx(self, x: Any, _u: Any) -> Any:
            return self.StateContainer({"severity": x["rate"], "rate": x["rate"] * 0.0})

        def output(self, x: Any) -> Any:
            return self.OutputContainer({"severity": x["severity"]})

    def guess(
        life: Life, fleet: Sequence[Life], limit: float, rng: np.random.Generator
    ) -> Guess | None:
        rates = np.array([item.value[-1] / item.age[-1] for item in fleet])
        steps = np.concatenate([np.diff(item.age) for item in fleet])
        slopes = [np.diff(item.value) / np.diff(item.age) for item in fleet]
        mean_step = float(np.mean(steps))
        jitter = float(np.mean([np.std(item) for item in slopes])) * np.sqrt(mean_step)
        wander = float(np.std(rates)) / np.sqrt(np.mean([item.age[-1] for item in fleet]))
        np.random.seed(int(rng.integers(1 << 31)))
        # progpy multiplies its noise by the step, not by the step's root.
        noise = {"severity": jitter / np.sqrt(mean_step), "rate": wander / np.sqrt(mean_step)}
        # A particle must be near a diagnosis: below this width the filter loses all but one.
        spread = max(float(np.median(life.std)), 2e-3)
        model = Wear(process_noise=noise, measurement_noise={"severity": spread})
        start = UnweightedSamples(
            [
                {"severity": 0.0, "rate": rate}
                for rate in np.maximum(rng.normal(rates.mean(), rates.std(), PARTICLES), 1e-6)
            ]
        )
        follow = ParticleFilter(
            model, start, num_particles=PARTICLES, t0=0.0, measurement_noise={"severity": spread}
        )
        for age, value in zip(life.age.tolist(), life.value.tolist(), strict=True):
            follow.parameters["dt"] = mean_step
            follow.estimate(
                age, model.InputContainer({}), model.OutputContainer({"severity": value})
            )
        particles = follow.particles
        severity, rate = (np.asarray(particles[key], dtype=float) for key in ("severity", "rate"))
        return _guess(_run_on(severity, rate, noise, mean_step, limit, rng))

    return guess


def _run_on(
    severity: Array, rate: Array, noise: dict[str, float], step: float, limit: float,
    rng: np.random.Generator,
) -> Array:  # fmt: skip
    """Run particles until each has reached the limit."""
    left = np.full(len(severity), np.inf)
    severity, rate = np.repeat(severity, 2), np.repeat(rate, 2)
    left = np.repeat(left, 2)
    at = 0.0
    for _ in range(400):
        grown = step * (rate + noise["severity"] * rng.standard_normal(len(rate)))
        crossed = np.isinf(left) & (severity + grown >= limit)
        share = np.clip((limit - severity) / np.where(grown > 0.0, grown, 1.0), 0.0, 1.0)
        left[crossed] = at + step * share[crossed]
        severity = severity + grown
        rate = rate + step * noise["rate"] * rng.standard_normal(len(rate))
        at += step
        if not np.isinf(left).any():
            break
    return left
