"""Searches in stages, each beginning where the one before ended: the easy part comes first.

Open loop before closed loop: there the spool breaks away again and again, and a search from the
usual sizes of all effects ends where the break-aways come at wrong ticks. In open loop they are
few, and what is believed after it, correlations and all, is narrow enough for the rest. The spool
before the pressure where the oil stores it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ehadiag.identify.experiment import Experiment
from ehadiag.identify.nuisance.explained import Explains, excess, is_hopeless, is_noise
from ehadiag.identify.nuisance.prior import (
    ALIAS,
    Joint,
    Known,
    belief_of,
    beside,
    information_of,
    small_effects,
)
from ehadiag.identify.nuisance.starts import AGAIN, Found, search
from ehadiag.identify.refine.derivatives import Considered, Derivatives
from ehadiag.identify.refine.linearisation import Belief
from ehadiag.identify.spans import lay_out, unknowns_of
from ehadiag.model.batch import SPOOL_ROW
from ehadiag.model.parameters import Parameter
from ehadiag.model.simd.model import SimdModel

__all__ = ["Settings", "Staged", "carried_over", "free_running", "scaled", "search_in_stages"]

NEARLY_EXPLAINED = 1.3
"""Excess of open loop alone up to which what is believed after it is gone on with: where more is
left the search has ended beside the optimum, and believes too much."""
CLOSER = 0.3
"""Spread of a further look about the best place, in spreads of what open loop alone leaves."""
PATIENCE = 3
"""Budgets of a search in closed loop that open loop does not lead, which may go astray several
times: ten of 300 units were given up with one, one with two, none with three."""
RELAXED = 100.0
"""Weight of the spool over the pressure while the spool is explained first."""
Hopeless = Callable[[NDArray[np.float64], int], bool]


@dataclass(frozen=True, slots=True, eq=False)
class Settings:
    """What is searched for, and how; see `ehadiag.identify.nuisance.estimate.estimate`."""

    free: tuple[Parameter, ...]
    known: Mapping[str, Known]
    joint: Joint | None
    hint: Mapping[str, float] | None
    hint_of_open: bool
    budget: int
    seed: int
    tell: Callable[[float], None] | None
    give_up: bool
    left_before: float
    explains: Explains
    patient: bool


@dataclass(frozen=True, slots=True, eq=False)
class Staged:
    """What a search found.

    Attributes
    ----------
    model : Derivatives
        Of whole tests, which it ran.
    found : Found
    levels : NDArray[np.int64]
        Of that model.
    again : shape (c, c)
        Root of the covariance over which a further look is taken.
    evaluations : int
        Runs of the model, with those of all stages.
    """

    model: Derivatives
    found: Found
    levels: NDArray[np.int64]
    again: NDArray[np.float64]
    evaluations: int


def search_in_stages(experiments: Sequence[Experiment], settings: Settings) -> Staged:
    """Search with the open-loop recordings alone, if there are others, then with all.

    Parameters
    ----------
    experiments : Sequence[Experiment]
        Of one actuator.
    settings : Settings
        What is searched for.

    Returns
    -------
    Staged
        Of all recordings.
    """
    part = [item for item in experiments if not item.test.closed_loop]
    if not 0 < len(part) < len(experiments):
        return _searched(experiments, settings)
    before = _searched(part, settings)
    led = excess(before.found.residuals) <= NEARLY_EXPLAINED
    whole = _searched(experiments, settings, before if led else None)
    return replace(whole, evaluations=before.evaluations + whole.evaluations)


def _searched(
    experiments: Sequence[Experiment], settings: Settings, before: Staged | None = None
) -> Staged:
    """Search with some recordings; before: with the open-loop ones among them."""
    known, joint, hint = settings.known, settings.joint, settings.hint
    patient = (
        settings.patient and before is None and any(item.test.closed_loop for item in experiments)
    )
    coarse = free_running(experiments, settings.free)
    model = scaled(coarse, experiments)
    first, information = belief_of(model, known, joint), information_of(model, known, joint)
    origins = [first] if patient else [first, small_effects(model, first)]
    if hint is not None:
        origins = [beside(model, first, hint), *origins[::-1]]
    guide: Derivatives | None = None
    again = AGAIN * first.root
    if before is not None:
        there = carried_over(before.model, before.found.belief, model)
        origins, again = [there], CLOSER * there.root
        if hint is not None and not settings.hint_of_open:
            origins = [Belief(beside(model, first, hint).x, again), there]
    elif any(item.constants.OIL > 0.0 for item in experiments):
        guide = _spool_guide(experiments, settings.free, coarse.levels)
        guided = search(
            guide,
            first,
            information,
            origins,
            _spool_is_noise,
            budget=settings.budget // 2,
            seed=settings.seed,
            hopeless=_spool_is_hopeless if settings.give_up else None,
            tell=settings.tell,
        )
        values = (guided.belief.x * guide.scale).tolist()
        names = [item.name for item in guide.estimated]
        origins = [beside(model, first, dict(zip(names, values, strict=True))), *origins]
    found = search(
        model,
        first,
        information,
        origins,
        settings.explains,
        again=again,
        calmly=before is not None,
        alias=ALIAS,
        budget=settings.budget * (PATIENCE if patient and settings.give_up else 1),
        seed=settings.seed,
        tell=settings.tell,
        hopeless=_hopeless(give_up=settings.give_up, patient=patient),
        patient=patient,
        confirms=settings.give_up,
        before=settings.left_before,
    )
    runs = sum(item.evaluations for item in (guide, model) if item)
    return Staged(model, found, coarse.levels, again, runs)


def carried_over(part: Derivatives, found: Belief, whole: Derivatives) -> Belief:
    """Return what a part of the recordings says, in the coordinates of a model of all of them.

    Both models have the same parameters. A constant error of a sensor that each recording has for
    itself begins at that of the first.
    """
    values: dict[str, float] = {}
    for item, value in zip(part.estimated, (found.x * part.scale).tolist(), strict=True):
        values.setdefault(item.name, value)
    x = np.array([values[item.name] for item in whole.estimated]) / whole.scale
    widths = part.scale[part.curved] / whole.scale[whole.curved]
    return Belief(np.clip(x, whole.lower, whole.upper), widths[:, None] * found.root)


def _hopeless(*, give_up: bool, patient: bool) -> Hopeless | None:
    """Judge when further starts will not help."""
    if not give_up:
        return None
    return partial(is_hopeless, astray=True) if patient else is_hopeless


def free_running(
    experiments: Sequence[Experiment],
    parameters: Sequence[Parameter],
    levels: NDArray[np.int64] | None = None,
) -> SimdModel:
    """Model of whole tests; `levels`: of one of the same tests, if there was one."""
    return SimdModel(lay_out(experiments), unknowns_of(experiments, parameters), levels=levels)


def scaled(
    model: SimdModel, experiments: Sequence[Experiment], considered: Sequence[Considered] = ()
) -> Derivatives:
    """Coordinates scaled by the noise."""
    return Derivatives(model, experiments[0].noise, considered)


def _spool_guide(
    experiments: Sequence[Experiment], free: Sequence[Parameter], levels: NDArray[np.int64]
) -> Derivatives:
    """Model that shows where to begin where the oil stores the pressure: it goes by the spool.

    Compressible oil remembers what the spool did for tenths of a second and rings, so that far from
    the optimum the pressure says little and leads the search astray; the spool, which does not feel
    it, is explained first.
    """
    relaxed = [
        item.with_noise((item.spool_noise, RELAXED * item.pressure_noise, item.position_noise))
        for item in experiments
    ]
    return Derivatives(free_running(relaxed, free, levels), experiments[0].noise)


def _spool_is_noise(residuals: NDArray[np.float64]) -> bool:
    return is_noise(residuals[SPOOL_ROW : SPOOL_ROW + 1])


def _spool_is_hopeless(residuals: NDArray[np.float64], starts: int) -> bool:
    return is_hopeless(residuals[SPOOL_ROW : SPOOL_ROW + 1], starts)
