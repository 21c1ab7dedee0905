"""Stochastic processes of wear: likelihood of increments, and first passage of a level.

Both run on a clock of their own, `(age / scale)**power` (Whitmore and Schenkelberg, Modelling
accelerated degradation data using Wiener diffusion with a time scale transformation, Lifetime Data
Analysis 3, 1997), so that wear may speed up or slow down with age; and on a scale of their own,
`log(1 + feedback*severity) / feedback`, so that it may grow with what is worn already (Park and
Padgett, Accelerated degradation models for failure based on geometric Brownian motion and gamma
processes, Lifetime Data Analysis 11, 2005). In both each life has a rate of its own, drawn from the
fleet's.

- Wiener process with drift: increments over a step h of the clock are normal, mean `rate*h`,
  variance `(spread*mean rate)**2*h`; rates are normal. First passage of a level is inverse
  Gaussian. Whitmore, Estimating degradation by a Wiener diffusion process subject to measurement
  error, Lifetime Data Analysis 1, 1995; Peng and Tseng, Mis-specification analysis of linear
  degradation models, IEEE Transactions on Reliability 58, 2009.
- Gamma process: increments have a gamma density with shape `h/spread**2`, so that they never are
  negative; its inverse scale has a gamma density over lives. Lawless and Crowder, Covariates and
  random effects in a gamma process model with application to degradation and failure, Lifetime
  Data Analysis 10, 2004; van Noortwijk, A survey of the application of gamma processes in
  maintenance, Reliability Engineering and System Safety 94, 2009.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import betainc, gammaln, gdtrib, ndtr

from ehadiag.prognosis.lives import Increments

__all__ = ["PROCESSES", "Gamma", "Law", "Process", "Wiener"]

Array = NDArray[np.float64]
LEAST = 1e-300
NEAR = 1e-9


class Law(NamedTuple):
    """Parameters that all lives of a severity share."""

    power: float
    """Of the clock: above 1 wear speeds up."""
    rate: float
    """Growth over one unit of the clock, the mean over lives."""
    variety: float
    """Standard deviation of the lives' rates, over their mean."""
    spread: float
    """Standard deviation of the growth over one unit of the clock, over the mean rate."""
    feedback: float
    """How much faster a part wears at severity 1 than as new, less 1."""


class Process(Protocol):
    """A process of wear."""

    name: str

    def log_likelihood(self, increments: Increments, law: Law, scale: float) -> float:
        """Log density of the increments, the lives' own rates integrated out."""

    def chances(
        self, own: Increments, tried: Increments, law: Law, scale: float
    ) -> tuple[float, float]:
        """Chance of a growth of at most, and of at least, the tried one, knowing the own."""

    def passage(
        self,
        own: Increments,
        law: Law,
        scale: float,
        now: Array,
        level: float,
        rng: np.random.Generator,
    ) -> Array:
        """Draw how long on the clock from each severity to a level; infinite: never."""


class Wiener:
    """Wiener process with drift, variance and a normal spread of the lives' drifts."""

    name = "Wiener"

    def log_likelihood(self, increments: Increments, law: Law, scale: float) -> float:
        """Log density of the increments, the lives' own rates integrated out."""
        step, growth, variance = self._columns(increments, law, scale)
        jacobian = float(np.sum(np.log1p(law.feedback * np.maximum(increments.high, 0.0))))
        life, lives = increments.life, increments.lives
        information = np.bincount(life, step**2 / variance, lives)
        about = np.bincount(life, step * (growth - law.rate * step) / variance, lives)
        before = 1.0 / (law.variety * law.rate) ** 2
        loss = float(np.sum((growth - law.rate * step) ** 2 / variance + np.log(variance)))
        loss += float(np.sum(np.log1p(information / before) - about**2 / (before + information)))
        return -0.5 * (loss + len(step) * float(np.log(2.0 * np.pi))) - jacobian

    def chances(
        self, own: Increments, tried: Increments, law: Law, scale: float
    ) -> tuple[float, float]:
        """Chance of a growth of at most, and of at least, the tried one, knowing the own."""
        mean, variance = self._rate(own, law, scale)
        step, growth, noise = self._columns(tried, law, scale)
        z = float((growth[0] - mean * step[0]) / np.sqrt(noise[0] + variance * step[0] ** 2))
        return float(ndtr(z)), float(ndtr(-z))

    def passage(
        self, own: Increments, law: Law, scale: float, now: Array, level: float,
        rng: np.random.Generator,
    ) -> Array:  # fmt: skip
        """Draw how long on the clock from each severity to a level; infinite: never."""
        distance = np.maximum(_scaled(level, law) - _scaled(now, law), NEAR)
        mean, variance = self._rate(own, law, scale)
        rate = rng.normal(mean, np.sqrt(variance), distance.shape)
        diffusion = (law.spread * law.rate) ** 2
        out = np.full(distance.shape, np.inf)
        ever = (rate > 0.0) | (
            rng.random(distance.shape) < np.exp(np.minimum(2.0 * rate * distance / diffusion, 0.0))
        )
        size = np.maximum(np.abs(rate[ever]), LEAST)
        out[ever] = rng.wald(distance[ever] / size, distance[ever] ** 2 / diffusion)
        return out

    def _rate(self, own: Increments, law: Law, scale: float) -> tuple[float, float]:
        """Mean and variance of one life's rate, from its own growth and the fleet's rates."""
        step, growth, variance = self._columns(own, law, scale)
        before = 1.0 / (law.variety * law.rate) ** 2
        information = before + float(np.sum(step**2 / variance))
        mean = (before * law.rate + float(np.sum(step * growth / variance))) / information
        return mean, 1.0 / information

    @staticmethod
    def _columns(item: Increments, law: Law, scale: float) -> tuple[Array, Array, Array]:
        step = _steps(item, law, scale)
        growth, noise = _growth(item, law)
        return step, growth, (law.spread * law.rate) ** 2 * step + noise


class Gamma:
    """Gamma process whose inverse scale differs from life to life, by a gamma density."""

    name = "gamma"

    def log_likelihood(self, increments: Increments, law: Law, scale: float) -> float:
        """Log density of the increments, the lives' own rates integrated out."""
        (growth, _), lives = _growth(increments, law), increments.lives
        if np.any(growth <= 0.0):
            return -np.inf
        jacobian = float(np.sum(np.log1p(law.feedback * np.maximum(increments.high, 0.0))))
        shape, alpha, beta = self._columns(increments, law, scale)
        whole = np.bincount(increments.life, shape, lives)
        grown = np.bincount(increments.life, growth, lives)
        out = float(np.sum((shape - 1.0) * np.log(growth) - gammaln(shape)))
        out += float(np.sum(gammaln(whole + alpha) - (whole + alpha) * np.log(beta + grown)))
        return out + lives * float(alpha * np.log(beta) - gammaln(alpha)) - jacobian

    def chances(
        self, own: Increments, tried: Increments, law: Law, scale: float
    ) -> tuple[float, float]:
        """Chance of a growth of at most, and of at least, the tried one, knowing the own."""
        alpha, beta = self._inverse_scale(own, law, scale)
        shape, _, _ = self._columns(tried, law, scale)
        growth, noise = _growth(tried, law)
        slack = 3.0 * float(np.sqrt(noise[0]))
        # A gamma variable over an independent one is a beta-prime variable.
        most, least = (max(float(growth[0]) + side, 0.0) for side in (slack, -slack))
        low = float(betainc(shape[0], alpha, most / (most + beta)))
        high = float(betainc(alpha, shape[0], beta / (least + beta)))
        return low, high

    def passage(
        self, own: Increments, law: Law, scale: float, now: Array, level: float,
        rng: np.random.Generator,
    ) -> Array:  # fmt: skip
        """Draw how long on the clock from each severity to a level; infinite: never."""
        distance = np.maximum(_scaled(level, law) - _scaled(now, law), NEAR)
        alpha, beta = self._inverse_scale(own, law, scale)
        inverse = rng.gamma(alpha, 1.0 / beta, distance.shape)
        # The process never falls: it has passed a level by then where it stands above it.
        shape = gdtrib(inverse, rng.random(distance.shape), distance)
        return np.asarray(shape * law.spread**2)

    def _inverse_scale(self, own: Increments, law: Law, scale: float) -> tuple[float, float]:
        """Shape and inverse scale of the density of one life's own inverse scale."""
        shape, alpha, beta = self._columns(own, law, scale)
        return alpha + float(np.sum(shape)), beta + float(np.sum(_growth(own, law)[0]))

    @staticmethod
    def _columns(item: Increments, law: Law, scale: float) -> tuple[Array, float, float]:
        alpha = law.variety**-2
        return _steps(item, law, scale) / law.spread**2, alpha, alpha * law.rate * law.spread**2


def _steps(item: Increments, law: Law, scale: float) -> Array:
    """Length of each increment on the clock."""
    return np.maximum((item.end / scale) ** law.power - (item.start / scale) ** law.power, LEAST)


def _growth(item: Increments, law: Law) -> tuple[Array, Array]:
    """Growth on the law's scale, and its variance by the diagnoses' noise."""
    low, high = (1.0 + law.feedback * np.maximum(at, 0.0) for at in (item.low, item.high))
    noise = (item.low_std / low) ** 2 + (item.high_std / high) ** 2
    return _scaled(item.high, law) - _scaled(item.low, law), noise


def _scaled(severity: Array | float, law: Law) -> Array:
    """Severity on the law's scale, equal to it near 0."""
    return np.asarray(np.log1p(law.feedback * np.maximum(severity, 0.0)) / law.feedback)


PROCESSES: Mapping[str, Process] = MappingProxyType({p.name: p for p in (Wiener(), Gamma())})
"""By name."""
