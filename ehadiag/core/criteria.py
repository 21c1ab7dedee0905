"""Every threshold of what is good enough, explained, beyond explanation, or plausible.

Each has a quantity, a unit and how it was set: by the statistics of noise, by a bound, by a source,
or by a study whose command shows it. Those that no study is named for are bounds of judgement.
Recorded units: `tools/study recorded-units`; random units: `tools/study units`; broken hardware:
`tools/study hardware`; buses with losses: `tools/study foreign-buses`. Last come the numbers that
the identification on the host and the one on board share.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from statistics import NormalDist
from typing import NamedTuple

import msgspec

NOISE_OUTLIER_SHARE = 2.0 * NormalDist().cdf(-3.0)
"""Share of residuals of noise alone beyond three deviations, 1: 0.0027."""
NORMAL_HALF_WIDTH_95 = NormalDist().inv_cdf(0.975)
"""Half of the central 95 % of a normal density, in deviations."""
STD_OF_MEDIAN_SIZE = 1.0 / NormalDist().inv_cdf(0.75)
"""Deviation of a normal density over the median of its sizes, 1: 1.4826."""
FALSE_ALARM_CHANCE = 1e-6
"""Chance that noise alone exceeds a limit in deviations, 1: of a delay, a changed effect, a step of
the spool in a tick, of which six are needed."""
NOISE_LIMIT = -NormalDist().inv_cdf(0.5 * FALSE_ALARM_CHANCE)
"""Deviations that noise alone exceeds by that chance: 4.9."""
ROUNDS = 3
"""Times that severities and what they were found from (samples, delays, instants) are found from
one another at most, 1: each ends sooner where it changes nothing."""
FIT_ITERATIONS = 8
"""Iterations of a robust linear fit, 1."""
NUMERICAL_ZERO = 1e-9
"""Share of a quantity that counts as none, 1: the rounding of a double, 2e-16, after equations that
lose some six digits of it."""
CAUCHY_SCALE = 3.0
"""Scale of Cauchy's cost, in deviations: larger residuals count little. Noise alone has 0.3 % of
them, `NOISE_OUTLIER_SHARE`."""


def rms_with_outliers(share: float) -> float:
    """Rms, in deviations of the noise, of normal residuals with a share beyond three of them."""
    return 3.0 / -NormalDist().inv_cdf(0.5 * share)


def _mean_of_normal(function: Callable[[float], float]) -> float:
    """Mean of a function of a standard normal variable, by the trapezoidal rule."""
    places = [0.1 * k for k in range(-80, 81)]
    return 0.1 * sum(NormalDist().pdf(place) * function(place) for place in places)


class VerdictCriteria(msgspec.Struct, frozen=True):
    """Levels of a severity and chances that decide a verdict."""

    advisory: float = 0.25
    """Severity from which a unit is DEGRADED, 1 (PHY-12)."""
    limit: float = 0.75
    """Severity from which a unit has a FAULT, 1 (PHY-12)."""
    max_chance_false_healthy: float = 0.025
    """Largest chance that a severity is at or above the advisory level for HEALTHY, or another
    fault beyond its limit without a note, 1: the specific consumer's risk of JCGM 106:2012."""
    min_chance_fault: float = 0.5
    """Least chance that a severity is at or above the limit for FAULT, or another fault beyond its
    limit for DEGRADED, 1: simple acceptance, JCGM 106:2012, 8.2."""


VERDICT = VerdictCriteria()


class RecordingCriteria(msgspec.Struct, frozen=True):
    """Limits of a recording that can be judged."""

    max_frame_delay_s: float = 0.05
    """Longest delay of a frame after its tick, s; a later one counts as lost, and a longer span
    missing at an end of the test is noted. Stamps up to that late left a verdict as it was
    (docs/reference/bus-faults.md)."""
    min_sample_share: float = 0.25
    """Least share of the samples of a test, and of a window for its search, 1: tests of 2000
    samples are as good with 500."""
    max_sample_gap_s: float = 0.25
    """Longest span without a sample, s: a diagnosis without 0.2 s of the steps stayed the same
    (docs/reference/bus-faults.md)."""
    min_samples: int = 100
    """Least number of samples that show a relation, a delay, a gain or the command's resolution, 1:
    deviations by them are known to 7 %."""
    oil_temperature_range_degc: tuple[float, float] = (-54.0, 135.0)
    """Range of oil temperatures in which the oil's law is used, degC: from MIL-PRF-83282's lowest
    to the usual limit of seals."""
    max_control_residual_lsb: float = 4.0
    """Largest rms residual of the current against the control law, LSB: seven times the noise of
    a 12-bit channel; of noisier converters as many times theirs."""


RECORDING = RecordingCriteria()


class ReadingCriteria(msgspec.Struct, frozen=True):
    """Limits of plausible units, signs, motion and actuator data."""

    max_reading_factor: float = 10.0
    """Largest reading over what the actuator can reach, 1: no sensor reads more, whatever is wrong
    with it."""
    min_correlation: float = math.sqrt(0.5)
    """Least correlation of two channels that follow one another, 1: one shows half the variance of
    the other. Of travel and flow 0.988 at least on 80 sound units with all effects, data 5 % off
    and orifices, 0.84 with a sensor 50 ms late; 0.33 to -1 with another signal."""
    max_channel_ratio_error: float = 0.25
    """Largest relative error of the ratio of two channels by faults, load and supply, 1; also of
    the position sensor's gain on a unit calibrated with effects of its own, whose flow gain and
    jack area may replace what the model leaves out."""
    min_supply_pressure_share: float = (1.0 - max_channel_ratio_error) ** 2
    """Least supply pressure, as a share of that in the actuator file, 1: flow gain, which is stated
    for that, goes with its root."""
    max_actuator_ratio_factor: float = math.sqrt(1000.0)
    """Largest factor between a ratio of actuator data and that of the reference actuator, 1: half
    of a prefix of units, in the logarithm."""


READINGS = ReadingCriteria()


class FitCriteria(msgspec.Struct, frozen=True):
    """Limits of residuals that count as explained, and signs of what explains the others."""

    max_outlier_share: float = 0.015
    """Largest share of residuals beyond three deviations for a verdict, 1: five to six times that
    of noise, `NOISE_OUTLIER_SHARE`. Textbook units had 0.0058 at most (`tools/study cube`), with
    1 % of hysteresis more than 0.02 (ADR 4 at 4fd82576)."""
    max_rms: float = rms_with_outliers(max_outlier_share)
    """Largest rms residual for a verdict, in deviations of the noise: 1.23, that of normal ones
    with as many outliers."""
    max_outlier_share_poor_calibration: float = 0.1
    """Largest share of residuals beyond three deviations after whatever calibration, 1: recorded
    worn units whose estimates held had up to 0.08, two that were sure and wrong 0.16 and 0.21."""
    wear_excess_factor: float = 2.0
    """By which wear may make more of what a model leaves, 1: friction acts on more of it."""
    expected_cauchy_cost: float = _mean_of_normal(
        lambda residual: CAUCHY_SCALE**2 * math.log1p((residual / CAUCHY_SCALE) ** 2)
    )
    """Mean of Cauchy's cost of a standard normal residual, that an excess is over, 1: 0.874."""
    max_outliers_of_noise: float = 0.01
    """Largest share of residuals beyond three deviations where nothing is left to explain, and no
    further unknowns are needed, 1."""
    max_explained_excess: float = 1.25
    """Largest excess of an explained signal, 1: 1.02 to 1.15 at the optimum of 80 simulated
    tests."""
    min_likelihood_ratio: float = 10.0
    """Least likelihood of an exponent of 0 over that of the largest one, 1, where a recording bears
    it out: strong evidence (Kass and Raftery, J. Am. Stat. Assoc. 90, 1995)."""
    max_shown_std: float = 0.1
    """Largest standard deviation of a severity that the test shows, 1."""
    max_start_outliers: float = 0.15
    """Largest share of outliers of a start for the severities alone, 1: mostly 0.04 at most on a
    textbook's actuator, 0.126 on one of 60 in closed loop, 0.29 and more on others (ADR 24)."""
    max_anchor_count: int = 4
    """Largest number of re-anchorings at an optimum, 1: in all but one of 200 tests there were
    none."""
    max_outliers_near: float = 0.05
    """Largest share of outliers of a point that is near the optimum, so that residuals there show
    the noise, 1: 0.04 at most on a textbook's actuator."""
    min_suspect_share: float = 0.1
    """Least share of the unexplained cost that a suspect would explain, 1; also what is left out at
    either end of the time that is named."""
    min_advice_share: float = 0.6
    """Least share of the unexplained cost that a suspect explains to be named the cause, 1: gain of
    the spool sensor explained 0.53 to 0.58 of another valve."""


FIT = FitCriteria()


class GiveUpCriteria(msgspec.Struct, frozen=True):
    """Residuals after which a search is repeated, ends, or is given up."""

    outliers: float = 0.5
    """Outliers after a start beyond which none follows, 1: half of all samples. Starts of sound
    units left 0.45 at most (ADR 24, constants)."""
    near_outliers: float = 0.1
    """Outliers up to which what is left may be of break-aways at wrong ticks, 1: half a second of
    the test. Twice two searches of sound units ended at one wrong place, with 0.01 and 0.04."""
    starts: int = 5
    """Starts after which none follows, 1: of 100 sound units in closed loop with less than 0.5 % of
    hysteresis (seed 880431) one needed the fifth, of 120 others two the third, a known hard one the
    fourth (`test_a_search_that_went_astray_on_a_sound_unit_goes_on`)."""
    max_trial_share: float = 0.5
    """Largest share of the excess over noise that a further look, effects that have changed since a
    calibration, or another exponent leave, 1: the larger part is explained. Loads of 20 to 80 N
    left 1.1 of 1.3 to 2.0, broken hardware as much as before."""
    min_unambiguous_hysteresis: float = 5e-3
    """Full relative width of hysteresis below which closed loop keeps the spool breaking away,
    1."""


GIVE_UP = GiveUpCriteria()


class BreakAwayRules(msgspec.Struct, frozen=True):
    """Break-aways at wrong ticks."""

    block: int = 25
    """Ticks of a block, 1: a break-away at a wrong tick is made good after some."""
    event_cost: float = 40.0
    """Least cost of a block, beyond the usual one, with such a break-away: noise alone makes that
    of one block in 100 000, so in one of 500 recordings."""
    max_end_cost: float = 2.0
    """Cost of an end of a search, noise included, over the best one's, 1, up to which it differs by
    break-aways: of a unit with 0.08 % of hysteresis four of five ends cost 1.2 to 1.4 times as
    much, and `FDJ` was 5 deviations off without them."""


BREAK_AWAYS = BreakAwayRules()


class ResponseCriteria(msgspec.Struct, frozen=True):
    """Limits of position sensor, supply, delays and still signals against the response."""

    travel_span_s: float = 0.1
    """Span over which travels of the jack are compared, s: velocities of the stored tests, of
    1 to 10 mm/s in ramps, make three steps of the converter or more of it."""
    max_still_lsb: float = 4.0
    """Largest range of a signal that stands still, LSB: 7 deviations of the noise, `noise_lsb`,
    which is the mean range of 2500 samples of noise."""
    min_gain: float = 0.5
    """Least gain of a signal that follows the model, 1; below minus that its sign is wrong: nearer
    to 1 or -1 than to none."""
    max_position_gain_error: float = 0.1
    """Largest error of the position sensor's gain, 1: twice that of flow gain and jack area 5 %
    off."""
    max_travel_rms: float = 4.0
    """Largest rms residual of the travel, in deviations of its noise: 1.0 to 2.5 on sound units;
    three times as far a travel is an outlier."""
    min_pressure_excess_share: float = 0.12
    """Least excess of the modelled over the largest measured pressure, as a share of it, 1: a sound
    unit with another law of friction had 10 % for two ticks. Farther below its largest value than
    that share the pressure is not cut off: beside the peak a pressure that the supply cut off was
    2 to 4 % lower, the swing of a sound unit 18 %."""
    whole_tick: float = 0.15
    """Distance from a whole number of ticks up to which a delay is one, ticks: of frames it always
    is. A smaller delay is none."""


RESPONSE = ResponseCriteria()


class LossCriteria(msgspec.Struct, frozen=True):
    """Limits of lost, misplaced and wrong samples."""

    max_wrong_share: float = FIT.max_outlier_share
    """Largest share of samples that may be wrong in one way, 1: guessed currents in closed loop,
    commands at other ticks than their own, samples at the converter's end, readings beyond what the
    actuator can reach. As many residuals may be outliers (docs/reference/bus-faults.md)."""
    max_guessed_share: float = 0.13
    """Largest share of guessed currents that is reconstructed, or with which jack friction is
    estimated, 1: jack friction was tried up to it, and off by 0.001 at most."""
    min_outlier_share_misplaced: float = 2.0 * NOISE_OUTLIER_SHARE
    """Least share of outliers from which rows placed by time may be misplaced, 1: twice that of
    noise."""
    min_gain: float = 2.0 * math.log(FIT.min_likelihood_ratio)
    """Least gain in fit by moving rows, or of the best lost position over the second, in variances:
    strong evidence."""
    reconstruction_std: float = 1e-3
    """Standard deviation of a severity that a reconstruction adds, 1: errors up to 0.0014 were
    seen."""
    min_severity_std: float = 0.01
    """Least standard deviation of a severity with lost samples, 1: off by 0.001 at most in closed
    loop with up to 13 % guessed, and in open loop sorted by stamps that jitter by a tick."""
    guessed_current_std: float = 2e-4
    """Standard deviation of a severity where the model was re-anchored more often, 1: 3e-4 off was
    seen with a tenth of the positions guessed."""


LOSSES = LossCriteria()


def _capped_variance(deviations: float) -> float:
    """Mean square of a standard normal variable without its values beyond some deviations."""
    normal = NormalDist()
    inside = 2.0 * normal.cdf(deviations) - 1.0
    return 1.0 - 2.0 * deviations * normal.pdf(deviations) / inside


def _kept_mean(share: float) -> float:
    """Mean absolute value of a standard normal variable without its largest values."""
    normal = NormalDist()
    most = normal.inv_cdf(0.5 + 0.5 * share)
    return 2.0 * (normal.pdf(0.0) - normal.pdf(most)) / share


class EstimationRules(NamedTuple):
    """Noise, cost and uncertainty of residuals; those of a refinement are `RefinementRules`."""

    noise_lsb: float = math.sqrt(0.5**2 + 1.0 / 12.0)
    """Noise of a 12-bit channel with its rounding (PHY-21, PHY-22), LSB."""
    noise_kept_share: float = 0.98
    """Share of samples, or of second differences, from which a deviation is judged, 1: the largest
    ones are of lost samples and break-aways."""
    noise_kept_mean: float = _kept_mean(noise_kept_share)
    """Mean absolute value of a standard normal variable without its largest 2 %, 1."""
    min_samples: int = 20
    """Least number of samples, or of blocks, for a mean, 1: it is off by a fifth of their
    deviation."""
    min_ticks: int = 100
    """Least number of ticks for a deviation, 1: it is off by 7 % (one over the root of twice the
    number), and a null bias lets the spool settle for 71 (a unit of `test_few_effects`)."""
    cauchy_scale: float = CAUCHY_SCALE
    """The same, in deviations."""
    residual_cap: float = cauchy_scale**2
    """Largest square of one weighted residual that counts, in variances: of `cauchy_scale`."""
    max_row_scatter: float = 1.0
    """Scatter about the linear model from which a sample is left out, in variances: as large as the
    noise, it tells nothing."""
    max_informative_scatter: float = 0.03
    """The same, for how sure an optimum is: that of a jump by 0.6 deviations, twice what is taken
    for a break-away between two-sided differences; 0.02 on a cross, 0.033 in a regression."""
    max_noise_judgements: int = 3
    """Largest number of judgements of the noise, 1: a bound that ends the loop."""
    noise_tolerance: float = 0.15
    """Relative change of the noise up to which the refinement is not repeated, 1: it
    widens or narrows the intervals by as much, and hardly moves an estimate."""
    correlation_lags: int = 20
    """Ticks over which residuals are correlated, 1: twice the rule of Newey and West (Rev. Econ.
    Stud. 61, 1994), 4 (n / 100)^(2/9), 10 of 5500 ticks."""
    capped_variance: float = _capped_variance(cauchy_scale)
    """Mean square of a standard normal variable without its values beyond `cauchy_scale`, 1."""
    refined_std: float = 3e-4
    """Standard deviation of a severity about a refined optimum, 1."""
    discrepancy_std: float = 3e-5
    """Standard deviation of a severity between different integrations of a plant, 1: what estimates
    differ by beyond the noise (ADR 4)."""
    uniform_std: float = 1.0 / math.sqrt(12.0)
    """Standard deviation of a severity that is uniform on 0 … 1, 1."""
    sampling_lead_std: float = 0.15e-6
    """Standard deviation of the instant of sampling, s: half a step of a plant that is integrated
    at 0.25 µs is of this size."""


ESTIMATION = EstimationRules()


class RefinementRules(NamedTuple):
    """A round that narrows a density, see `ehadiag.identify.posterior`."""

    cross_variances: float = 3.0
    """Variances from the mean of a density to the points on a coordinate, 1: the three
    nodes of Gauss and Hermite's rule."""
    min_bound_distance: float = 0.25
    """Share of that distance to a bound below which the points lie on its other side, 1: a
    bound of judgement."""
    min_linear_ratio: float = 0.05
    """Least ratio of widths in a round where the model is linear over the density, 1: there is no
    break-away to look past, and the width of the noise is reached at once."""
    max_linear_scatter: float = 0.1
    """Scatter of a sample up to which the model is linear, in variances: that of a jump by a
    deviation (0.6 deviations have 0.03, `ESTIMATION.max_informative_scatter`)."""
    max_nonlinear_share: float = 0.01
    """Share of samples with more scatter up to which the model is linear, 1: 55 ticks, those
    of two break-aways at wrong ticks (`BREAK_AWAYS.block`)."""
    damping: float = 0.1
    """Share of the density's information that holds a step back, 1: where the rows
    say as much as the density, a step is a tenth shorter."""
    min_information: float = NUMERICAL_ZERO
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
    """Filtered innovation beyond which the model is re-anchored, LSB: 5.4 deviations of the
    filtered noise (`noise_lsb` by the root of gain / (2 - gain))."""
    large_lsb: float = 6.0
    """Single innovation beyond which the model is re-anchored, LSB: 10 deviations of the noise,
    `noise_lsb`."""


ANCHORING = AnchorRules()
