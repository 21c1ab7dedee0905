"""Severities with everything else free beside them, and what is tried where that does not do.

A load is tried where the effects do not explain a recording, looser effects where a calibrated
unit may have changed since.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from ehadiag.identify.experiment import Experiment
from ehadiag.identify.nuisance.estimate import Estimated, estimate
from ehadiag.identify.nuisance.explained import is_of_the_pressure
from ehadiag.identify.nuisance.knowledge import Knowledge
from ehadiag.identify.nuisance.trial import would_explain
from ehadiag.identify.refine.first_part import considered_in
from ehadiag.model.parameters import OFFSETS, Parameter, parameter

__all__ = ["Freeing"]

BEYOND_LOAD = 15.0
"""Excess after all nuisances from which on a load is not tried besides."""
NEARLY = 1.3
"""Excess with a calibration's knowledge up to which a unit is taken not to have changed since: wear
brings out what its model leaves, and loosened effects would stand in for that."""
CHANGE = 0.5
"""Share of what is left beyond noise that may remain where effects have changed since."""


@dataclass(frozen=True, slots=True)
class Freeing:
    """How severities are estimated with other parameters free.

    Attributes
    ----------
    knowledge : Knowledge
        Of the unit.
    effects : tuple of Parameter
        What is free beside the severities, the sensors' offsets and what the knowledge doubts.
    seed : int
        The same seed gives the same answer.
    tell : callable
        Called again and again with the share of a search's budget that is spent.
    """

    knowledge: Knowledge
    effects: tuple[Parameter, ...]
    seed: int
    tell: Callable[[float], None]

    def estimated(
        self,
        experiments: Sequence[Experiment],
        hint: Mapping[str, float] | None,
        before: float,
    ) -> Estimated:
        """Estimate severities and all that is free from recordings of one actuator.

        Parameters
        ----------
        experiments : sequence of Experiment
            One or more.
        hint : mapping, optional
            Values by name beside which the optimum probably lies.
        before : float
            Excess that the severities alone leave.
        """
        found = self._with(experiments, self.knowledge, hint, before)
        if found.explained:
            return found
        if not self.knowledge.doubts:
            return self._with_load(experiments, found)
        if self.knowledge.joint is None or found.excess <= NEARLY:
            return found
        loose = self._with(experiments, self.knowledge.loosened(), hint)
        return loose if loose.excess - 1.0 < CHANGE * (found.excess - 1.0) else found

    def _with_load(self, experiments: Sequence[Experiment], found: Estimated) -> Estimated:
        """Estimate a constant load, too, where that explains what the others do not."""
        load = parameter("load")
        if found.excess > BEYOND_LOAD or is_of_the_pressure(found.refined.residuals):
            return found
        if not would_explain(load, found, self.seed):
            return found
        values = found.refined.values
        more = self._with(experiments, self.knowledge, values, found.excess, (load,))
        best = more if more.explained or more.excess < found.excess else found
        return replace(
            best,
            evaluations=found.evaluations + more.evaluations,
            starts=found.starts + more.starts,
        )

    def _with(
        self,
        experiments: Sequence[Experiment],
        knowledge: Knowledge,
        hint: Mapping[str, float] | None,
        before: float = float("inf"),
        further: tuple[Parameter, ...] = (),
    ) -> Estimated:
        effects = (*self.effects, *further)
        free = (*knowledge.severities, *OFFSETS, *knowledge.beside(effects))
        return estimate(
            experiments,
            free,
            known=knowledge.known,
            joint=knowledge.joint,
            considered=considered_in(experiments, free),
            hint=hint,
            seed=self.seed,
            tell=self.tell,
            # Else the first starts may leave as much as of a stranger.
            give_up=knowledge.explains_sound,
            explains=knowledge.explains,
            patient=any(item.test.closed_loop for item in experiments),
            left_before=before,
        )
