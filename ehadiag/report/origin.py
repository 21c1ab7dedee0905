"""Where a result comes from: the part of its JSON object that lets it be archived alone."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

from ehadiag.core.dates import date_text
from ehadiag.core.fingerprint import fingerprint
from ehadiag.core.printable import valid_text
from ehadiag.report.onboard import onboard_tree

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import Diagnosis
    from ehadiag.core.recording import Recording
    from ehadiag.core.stored_test import StoredTest
    from ehadiag.report.asked import Asked, LogFile

__all__ = ["configuration", "log_tree", "package", "recordings"]


@cache
def package() -> dict[str, str]:
    """Name and version of this package, and of what affects the digits."""
    import platform  # noqa: PLC0415
    from importlib.metadata import version  # noqa: PLC0415 - reads a file for each

    names = ("numpy", "numba")
    return {
        "name": "ehadiag",
        "version": version("ehadiag"),
        "python": platform.python_version(),
        **{name: version(name) for name in names},
    }


def configuration(asked: Asked) -> dict[str, Any]:
    """Options that can change the result.

    Parameters
    ----------
    asked : Asked
        What was asked for.

    Returns
    -------
    dict[str, Any]
        The part `configuration` of the object.
    """
    return {
        "solver": asked.solver,
        "seed": asked.seed,
        "levels": {
            "advisory": asked.levels.advisory,
            "limit": asked.levels.limit,
            "rule": str(asked.levels.rule),
        },
        "nuisances": asked.nuisances,
        "time_limit_s": asked.time_limit_s,
        "every_test": asked.every,
        "tests_sha256": asked.tests_sha256,
        "columns_sha256": asked.columns_sha256,
        "start_s": asked.start_s,
        "end_s": asked.end_s,
        "mapping": {
            "name": None if asked.mapping is None else valid_text(asked.mapping),
            "sha256": asked.mapping_sha256,
            "file": None if asked.mapping_file is None else valid_text(asked.mapping_file),
        },
    }


def recordings(diagnosis: Diagnosis, logs: Sequence[LogFile | None]) -> list[dict[str, Any]]:
    """What is known of each recording.

    Parameters
    ----------
    diagnosis : Diagnosis
        What was found.
    logs : Sequence[LogFile | None]
        Their logs; none at all where they were at hand.

    Returns
    -------
    list[dict[str, Any]]
        The part `recordings` of the object.
    """
    known = list(logs) or [None] * len(diagnosis.recordings)
    return [
        _recording(item, test, log)
        for item, test, log in zip(diagnosis.recordings, diagnosis.tests, known, strict=True)
    ]


def log_tree(log: LogFile | None) -> dict[str, Any] | None:
    """Size, date and number of a log, for the object; None where there is no log."""
    if log is None:
        return None
    return {
        "path": valid_text(log.path),
        "bytes": log.size,
        "modified": date_text(log.modified_ns),
        "modified_ns": log.modified_ns,
        "result": log.number,
        "results": log.results,
    }


def _recording(item: Recording, test: StoredTest | None, log: LogFile | None) -> dict[str, Any]:
    around = item.environment
    return {
        "source": valid_text(item.source),
        "date": date_text(item.start_ns),
        "length_s": None if item.samples is None else round(item.duration, 6),
        "serial": item.serial,
        "channel": item.channel,
        "test": None
        if test is None
        else {"name": test.name, "id": test.id, "sha256": fingerprint(test)},
        "oil_temperature_degC": around.oil_temperature,
        "supply_pressure_MPa": _mega(around.supply_pressure),
        "return_pressure_MPa": _mega(around.return_pressure),
        "log": log_tree(log),
        "onboard": onboard_tree(item.onboard),
    }


def _mega(value: float | None) -> float | None:
    return None if value is None else value * 1e-6
