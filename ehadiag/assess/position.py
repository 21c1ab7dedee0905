"""Checks the jack's position sensor against the motion that the identified actuator must have made.

The severities are identified from spool and pressure alone, so a broken position sensor would pass
unseen. Travel over `SPAN_S` is compared, not position: what is off by little adds up in a position,
and hardly shows in a short travel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator
from ehadiag.core.channels import SPOOL
from ehadiag.identify.experiment import Experiment
from ehadiag.model.scalar.response import Response

__all__ = [
    "LEAST_SAMPLES",
    "LEAST_TRAVEL_LSB",
    "SPAN_S",
    "PositionFit",
    "middle_of_three",
    "most_gain_error",
    "objections_to_position",
    "position_fit",
]

SPAN_S = 0.1
"""Over which travel is taken."""
LEAST_SAMPLES = 0.25
"""Share of the travels that must be known, else the sensor is not judged."""
LEAST_TRAVEL_LSB = 10.0
"""Rms travel over the span (LSB) below which a gain is not judged."""
MOST_GAIN_ERROR = 0.1
"""Twice what flow gain and jack area, each 5 % off, make of it."""
STANDS_IN = 0.25
"""The same for a unit that was calibrated with effects of its own: flow gain and jack area, which
the pressure shows by their ratio to others, may stand in for what the model does not have."""
MOST_DRIFT = 0.8e-3
"""m/s; a spool offset of 1 µm that goes unseen makes half of it. So on a spool of the default
range; of another one it is greater in proportion."""
MOST_RMS = 4.0
"""Rms residual of the travel, in units of its noise or LSB: 1.0 to 2.5 on sound units."""
OUTLIER = 12.0
"""In the same units."""
MOST_OUTLIERS = 0.01
"""Share of travels; those of a single bad sample do not count."""
DEAD, REVERSED = 0.2, -0.5
"""Gain below which a sensor does not follow, and below which it is wired the wrong way round."""
ROUNDS = 8
TAIL = 3.0


@dataclass(frozen=True, slots=True)
class PositionFit:
    """Measured travel of the jack against the modelled one.

    Attributes
    ----------
    gain : float
        Measured over modelled travel; NaN where the jack hardly moves.
    drift : float
        Of measured less modelled position, m/s.
    rms : float
        Of the travels that are left, in units of their noise (not below that of 1 LSB).
    outliers : float
        Share of travels far off.
    most_drift : float
        Drift of a sound sensor at most, m/s.
    """

    gain: float
    drift: float
    rms: float
    outliers: float
    most_drift: float = MOST_DRIFT


def position_fit(experiment: Experiment, modelled: Response) -> PositionFit | None:
    """Fit the sensor's gain and drift; None where there are too few samples of the position.

    Parameters
    ----------
    experiment : Experiment
        What was measured.
    modelled : Response
        Of the identified actuator, over the same ticks.

    Returns
    -------
    PositionFit | None
        What the sensor shows of the modelled motion.
    """
    span = round(SPAN_S / experiment.tick)
    measured = experiment.position[span:] - experiment.position[:-span]
    seen = np.isfinite(measured)
    if seen.mean() < LEAST_SAMPLES:
        return None
    model = modelled.position
    channels = experiment.channels
    unit = np.sqrt(2.0) * max(experiment.position_noise, channels.position.lsb)
    travel = (model[span:] - model[:-span])[seen] / unit
    moves = float(np.sqrt(np.mean(travel**2))) * unit >= LEAST_TRAVEL_LSB * channels.position.grain
    columns = [travel, np.ones_like(travel)] if moves else [np.ones_like(travel)]
    values = measured[seen] / unit - (0.0 if moves else travel)
    solution, left = _robust(np.column_stack(columns), values)
    lasting = np.abs(middle_of_three(left))
    most = np.minimum(left**2, OUTLIER**2)
    return PositionFit(
        gain=float(solution[0]) if moves else float("nan"),
        drift=float(solution[-1]) * unit / SPAN_S,
        rms=float(np.sqrt(np.mean(most))),
        outliers=float(np.mean(lasting > OUTLIER)),
        most_drift=MOST_DRIFT * (channels.spool.full_scale / SPOOL.full_scale),
    )


def most_gain_error(actuator: Actuator) -> float:
    """Gain of the sensor that is not told from data of the actuator, as a share."""
    calibration = actuator.calibration
    return STANDS_IN if calibration is not None and calibration.plays > 1 else MOST_GAIN_ERROR


def objections_to_position(fit: PositionFit, most: float = MOST_GAIN_ERROR) -> list[str]:
    """Why the position sensor cannot be believed; empty if it can.

    Parameters
    ----------
    fit : PositionFit
        What the sensor shows.
    most : float
        Largest error of its gain, see `most_gain_error`.

    Returns
    -------
    list[str]
        Reasons.
    """
    if fit.gain < REVERSED:
        return ["the position sensor reads with the wrong sign"]
    if fit.gain < DEAD:
        return ["the position sensor does not follow the jack: dead, frozen, or another signal"]
    if fit.outliers > MOST_OUTLIERS or fit.rms > MOST_RMS:
        return [
            f"the position sensor does not follow the jack: travel over {SPAN_S:g} s is off by "
            f"{fit.rms:.1f} times the noise rms (limit {MOST_RMS:g}), {fit.outliers:.1%} of it by "
            f"more than {OUTLIER:g} times (limit {MOST_OUTLIERS:.0%})"
        ]
    off = abs(fit.gain - 1.0)
    if off > most:
        side = "high" if fit.gain > 1.0 else "low"
        return [
            f"the position sensor reads {off:.0%} too {side} (limit {most:.0%}), or "
            "flow gain and jack area are not those of the actuator file"
        ]
    if abs(fit.drift) > fit.most_drift:
        return [
            f"the position sensor runs away by {fit.drift * 1e3:.2g} mm/s "
            f"(limit {fit.most_drift * 1e3:g})"
        ]
    return []


def _robust(
    columns: NDArray[np.float64], values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Least squares reweighted by Cauchy's weights; the solution, and what is left."""
    weight = np.ones_like(values)
    for _ in range(ROUNDS):
        weighed = columns * weight[:, None]
        solution = np.linalg.pinv(weighed.T @ columns) @ (weighed.T @ values)
        left = values - columns @ solution
        weight = 1.0 / (1.0 + (left / TAIL) ** 2)
    return solution, left


def middle_of_three(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Take the median of each value and its neighbours: a single bad one leaves no trace.

    Parameters
    ----------
    values : NDArray[np.float64]
        Shape (n,), n at least 3.

    Returns
    -------
    NDArray[np.float64]
        Shape (n - 2,), of all but the first and the last.
    """
    return np.asarray(np.median(np.stack([values[:-2], values[1:-1], values[2:]]), axis=0))
