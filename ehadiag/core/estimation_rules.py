"""Numbers that the identification on the host and the one on board share."""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import NamedTuple


def _capped_variance(deviations: float) -> float:
    """Mean square of a standard normal variable without its values beyond some deviations."""
    normal = NormalDist()
    inside = 2.0 * normal.cdf(deviations) - 1.0
    return 1.0 - 2.0 * deviations * normal.pdf(deviations) / inside


class EstimationRules(NamedTuple):
    """Noise, cost and uncertainty of residuals; those of a refinement are `RefinementRules`."""

    noise_lsb: float = math.sqrt(0.5**2 + 1.0 / 12.0)
    """Noise of a 12-bit channel with its rounding (PHY-21, PHY-22), LSB."""
    noise_kept_share: float = 0.98
    """Share of second differences from which noise is judged, 1: the largest ones are left out."""
    noise_kept_mean: float = 0.75978
    """Mean absolute value of a standard normal variable without its largest 2 %, 1."""
    min_rest_samples: int = 20
    """Least number of samples at rest from which an offset is taken, 1."""
    residual_cap: float = 9.0
    """Largest square of one weighted residual that counts, in variances."""
    cauchy_scale: float = 3.0
    """Scale of Cauchy's cost, in deviations: larger residuals count little."""
    max_row_scatter: float = 1.0
    """Scatter about the linear model from which a sample is left out, in variances."""
    max_noise_judgements: int = 3
    """Largest number of judgements of the noise, 1."""
    noise_tolerance: float = 0.15
    """Relative change of the noise up to which the refinement is not repeated, 1."""
    correlation_lags: int = 20
    """Ticks over which residuals are correlated, 1."""
    capped_variance: float = _capped_variance(3.0)
    """Mean square of a standard normal variable without its values beyond `cauchy_scale`, 1."""
    refined_std: float = 3e-4
    """Standard deviation of a severity about a refined optimum, 1."""
    discrepancy_std: float = 3e-5
    """Standard deviation of a severity between different integrations of a plant, 1."""
    uniform_std: float = 1.0 / math.sqrt(12.0)
    """Standard deviation of a severity that is uniform on 0 … 1, 1."""
    sampling_lead_std: float = 0.15e-6
    """Standard deviation of the instant of sampling, s: half a step of a plant that is integrated
    at 0.25 µs is of this size."""


ESTIMATION = EstimationRules()


class RefinementRules(NamedTuple):
    """A round that narrows a density, see `ehadiag.identify.posterior`."""

    cross_variances: float = 3.0
    """Variances from the mean of a density to the points on a coordinate, 1."""
    min_bound_distance: float = 0.25
    """Share of that distance to a bound below which the points lie on its other side, 1."""
    min_linear_ratio: float = 0.05
    """Least ratio of widths in a round where the model is linear over the density, 1."""
    max_linear_scatter: float = 0.1
    """Scatter of a sample up to which the model is linear, in variances."""
    max_nonlinear_share: float = 0.01
    """Share of samples with more scatter up to which the model is linear, 1."""
    damping: float = 0.1
    """Share of the density's information that holds a step back, 1."""
    min_information: float = 1e-9
    """Information on what nothing shows, in units of the scales."""
    max_mean_step: float = 0.25
    """Last step of a mean of rounds, in widths of the density, below which it has converged: where
    the cost has steps as wide as the density no single round does."""


REFINEMENT = RefinementRules()


class AnchorRules(NamedTuple):
    """Re-anchoring of the modelled spool on the measured one."""

    gain: float = 0.3
    """Gain of the filtered innovation, 1."""
    small_lsb: float = 1.3
    """Filtered innovation beyond which the model is re-anchored, LSB."""
    large_lsb: float = 6.0
    """Single innovation beyond which the model is re-anchored, LSB."""


ANCHORING = AnchorRules()
