"""Runs the model with all that was identified from a recording."""

from __future__ import annotations

from ehadiag.identify.experiment import Experiment
from ehadiag.identify.result import Identification
from ehadiag.model.scalar.response import Response, respond

__all__ = ["response_of"]


def response_of(experiment: Experiment, identification: Identification) -> Response:
    """Return the response of the identified actuator to the current of an experiment."""
    return respond(
        identification.constants(experiment.constants),
        experiment.trace.current,
        experiment.tick,
        origin=experiment.origin,
    )
