"""Turns a diagnosis into what the history keeps of it."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from ehadiag.core.dates import date_text, utc_text
from ehadiag.core.printable import valid_text
from ehadiag.history.fingerprint import hash_of_file, hash_of_samples
from ehadiag.history.records import Effect, Entry, Severity, Source, Usage

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import Diagnosis

__all__ = ["entry_of", "now"]


def now() -> str:
    """Time of day: UTC, ISO 8601, to the millisecond."""
    return utc_text(datetime.now(UTC))


def entry_of(
    diagnosis: Diagnosis, result: str, usage: Usage, version: str, *, simulated: bool
) -> Entry:
    """Return what is kept of a diagnosis.

    Parameters
    ----------
    diagnosis : Diagnosis
        What was found.
    result : str
        Its JSON result.
    usage : Usage
        Hours and cycles of the unit when the test was made.
    version : str
        Of this program.
    simulated : bool
        Whether the unit is known to be a simulated one.

    Returns
    -------
    Entry
        Not appended yet.
    """
    found = diagnosis.identification
    recordings = diagnosis.recordings
    covariance = None
    if found is not None and all(map(math.isfinite, found.covariance.ravel().tolist())):
        covariance = tuple(tuple(row) for row in found.covariance.tolist())
    tests = [test.name for test in diagnosis.tests if test is not None]
    return Entry(
        appended=now(),
        tested=date_text(recordings[0].start_ns) if recordings else None,
        actuator=valid_text(diagnosis.actuator.name),
        serial=next((item.serial for item in recordings if item.serial is not None), None),
        test=valid_text("+".join(tests)) or None,
        verdict=diagnosis.verdict.name,
        reasons=tuple(valid_text(reason) for reason in diagnosis.reasons),
        usage=usage,
        sources=tuple(
            Source(valid_text(item.source), hash_of_file(item.source), hash_of_samples(item))
            for item in recordings
        ),
        severities=()
        if found is None
        else tuple(
            Severity(
                name=item.name,
                estimate=_finite(item.value),
                std=_finite(item.std),
                low=_finite(item.interval95[0]),
                high=_finite(item.interval95[1]),
                at_bound=item.at_bound,
                shown=item.shown,
            )
            for item in found.estimates
        ),
        covariance=covariance,
        effects=()
        if found is None
        else tuple(
            Effect(name, _finite(item.value), _finite(item.std), item.at_bound)
            for name, item in found.nuisances.items()
        ),
        version=version,
        simulated=simulated,
        result=result,
    )


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
