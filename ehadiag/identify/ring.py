"""Finds the oil's stiffness from the ring, the oscillation of the jack's mass on the chambers' oil.

Hardly damped, the ring shows in the pressure for dozens of periods. Half a percent of
frequency is a wrong phase, so the cost of the pressure has a valley for each period by which model
and unit may differ, and a search that begins 2 % off ends in a wrong one. Here the stiffness is
scanned where nothing but the ring moves; a search then begins in the right valley.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.experiment import Experiment, lay_out_spans, unknowns_of
from ehadiag.identify.prior import JointPrior, ParameterPrior
from ehadiag.model.batch import PRESSURE_ROW
from ehadiag.model.registry import SENSOR_OFFSETS, parameter
from ehadiag.model.residual_models import SimdModel


class RingScan(msgspec.Struct, frozen=True):
    """Range, step and criteria of the scan of the oil's stiffness."""

    step: float = 2.5e-3
    """Step of the scan, 1: a quarter of the width of a valley, which is half a period in forty."""
    still_s: float = 0.1
    """Time for which the current has not changed, s: nothing but the ring moves; as long as the
    run-in before a window."""
    cap: float = 400.0
    """Largest square of one residual, in variances, 20 deviations: a ring out of phase counts in
    full, a break-away does not decide."""
    std: float = 4e-3
    """Standard deviation of the ratio of stiffness and mass, 1: the width of a valley."""
    max_cost_ratio: float = 0.6
    """Largest cost of the best valley over the median, 1, for a ring that shows: in phase nothing
    of it is left, at random twice its variance, so a ring of a third of the noise's makes it."""
    max_factor_error: float = 0.15
    """Largest relative error of the stiffness, against 2 or 1/2, for a volume of the other
    meaning, 1: data 5 % off in bulk modulus, volume and mass make 0.09."""


SCAN = RingScan()
SPOOL_PARAMETERS = (
    *(item.name for item in SENSOR_OFFSETS),
    "null_bias", "torque_motor_gain", "hysteresis", "backlash", "datum_KSF", "datum_KF",
)  # fmt: skip
"""What moves the spool as a first search found it: the rest is the file's in the scan, since the
search may have bent it to a wrong phase."""


class Ring(msgspec.Struct, frozen=True):
    """Stiffness of the oil that explains the ring."""

    stiffness: float
    """Relative change of β / V over the mass, from that of the file."""
    frequency: float
    """Hz."""

    @property
    def is_of_other_volume(self) -> bool:
        """Whether the frequency is off by √2, as with a volume of the other meaning."""
        ratio = 1.0 + self.stiffness
        return min(abs(ratio / 2.0 - 1.0), abs(2.0 * ratio - 1.0)) < SCAN.max_factor_error

    def agrees_with(self, values: Mapping[str, float]) -> bool:
        """Whether an estimate has this stiffness of the oil.

        values: relative changes by the parameters' names; 0 of those that are missing.
        """
        volume, mass = values.get("datum_volume_of_one_chamber", 0.0), values.get("datum_MJ", 0.0)
        estimated = (1.0 + values.get("bulk_modulus", 0.0)) / (1.0 + volume) / (1.0 + mass)
        return abs(estimated / (1.0 + self.stiffness) - 1.0) < SCAN.max_factor_error

    @property
    def words(self) -> str:
        """What is wrong with the volume."""
        more = self.stiffness > 0.0
        return (
            f"the pressure rings at {self.frequency:.0f} Hz, {'√2 times' if more else '1/√2 of'}"
            " what the actuator file's second stage would: volume_of_one_chamber is"
            f" {'twice' if more else 'half'} the volume of one chamber"
            + (": that of both together, perhaps" if more else "")
        )


def is_same_ring(ring: Ring | None, other: Ring | None) -> bool:
    """Whether two scans say the same, so that a search by the one ends where that by the other."""
    if ring is None or other is None:
        return ring is other
    return abs(ring.stiffness - other.stiffness) < SCAN.std


def find_ring(experiments: Sequence[Experiment], values: Mapping[str, float]) -> Ring | None:
    """Find the stiffness that explains the phase of the ring; None where none rings.

    Parameters
    ----------
    experiments : Sequence[Experiment]
        Of a unit with orifices.
    values : Mapping[str, float]
        Of a first search, of which those that move the spool are taken.

    Returns
    -------
    Ring | None
        The best valley.
    """
    names = [name for name in SPOOL_PARAMETERS if name in values]
    free = tuple(parameter(name) for name in (*names, "bulk_modulus"))
    batch = lay_out_spans(experiments)
    still = np.concatenate([_still(item) for item in experiments])
    still &= batch.weight[PRESSURE_ROW] > 0.0
    if not still.any():
        return None
    # From half the stiffness, a total volume in the file, to twice.
    least, most = (
        0.5 * (1.0 - SCAN.max_factor_error) - 1.0,
        2.0 * (1.0 + SCAN.max_factor_error) - 1.0,
    )
    stiffness = np.arange(least, most, SCAN.step)
    points = np.zeros((len(stiffness), len(free)))
    points[:, :-1] = [values[name] for name in names]
    points[:, -1] = stiffness
    runs = SimdModel(batch, unknowns_of(experiments, free)).residuals(points)[0]
    costs = np.minimum(runs[:, PRESSURE_ROW][:, still] ** 2, SCAN.cap).mean(axis=1)
    best = int(costs.argmin())
    if costs[best] > SCAN.max_cost_ratio * float(np.median(costs)):
        return None
    c = experiments[0].constants
    rate = math.sqrt(c.OIL * (1.0 + stiffness[best]) * c.AJ * c.AJ / c.MJ)
    return Ring(float(stiffness[best]), rate / (2.0 * math.pi))


def _still(experiment: Experiment) -> NDArray[np.bool_]:
    """Ticks before which the current has not changed for a while."""
    current = experiment.trace.current
    changed = np.flatnonzero(np.concatenate([[True], np.diff(current) != 0.0]))
    ticks = np.arange(len(current))
    last = changed[np.searchsorted(changed, ticks, side="right") - 1]
    return np.asarray((ticks - last) * experiment.tick > SCAN.still_s)


def ring_prior(ring: Ring, oil: ParameterPrior, mass: ParameterPrior) -> JointPrior:
    """Prior of bulk modulus and mass: their ratio is the ring's, each alone that of any unit.

    oil, mass: their priors where no ring shows.
    """
    common = min(mass.std, oil.std)
    scale = 1.0 + ring.stiffness
    covariance = np.array([[scale * scale, scale], [scale, 1.0]]) * common**2
    covariance[0, 0] += SCAN.std**2
    return JointPrior(("bulk_modulus", "datum_MJ"), np.array([ring.stiffness, 0.0]), covariance)
