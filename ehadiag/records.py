"""Puts a diagnosis down as a result: every number as JSON can hold it, every text as UTF-8."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, cast

import msgspec

from ehadiag.assess.verdict import Verdict
from ehadiag.core.conventions import __version__, date_text, fingerprint, finite
from ehadiag.estimate import AT_BOUND, NOT_SHOWN, Severity
from ehadiag.request import Request
from ehadiag.result import (
    Configuration,
    Fit,
    InputError,
    LevelsPart,
    Log,
    Mapped,
    Onboard,
    OnboardFault,
    Origin,
    Package,
    Position,
    Quality,
    Result,
    Search,
    Sources,
    State,
    TestOrigin,
    Timing,
)
from firmware_iface.errors import valid_text

if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import Diagnosis
    from ehadiag.assess.response_checks import PositionFit
    from ehadiag.core.actuator import Actuator
    from ehadiag.identify.identification_result import Identification
    from firmware_iface.recording import OnboardResult, Recording
    from firmware_iface.stored_test import StoredTest


def result_of(
    diagnosis: Diagnosis,
    request: Request | None = None,
    *,
    sources: Sources | None = None,
    logs: Sequence[Log | None] = (),
    read_s: float = 0.0,
    after_test_s: float | None = None,
) -> Result:
    """Put a diagnosis down.

    diagnosis: what was found; it stays at hand as `Result.diagnosis`; request: what was asked for;
    None: nothing but the usual; sources: fingerprints of what the request names; logs: log of each
    recording; empty where there was none; read_s: time of reading or acquiring the recordings, s;
    after_test_s: from the end of a live test to the verdict, s. Returns the record.
    """
    request, sources = request or Request(), sources or Sources()
    found, recordings = diagnosis.identification, diagnosis.recordings
    timing = found.timing if found else None
    files = list(logs) or [None] * len(recordings)
    result = Result(
        source=" + ".join(valid_text(item.source) for item in recordings),
        test="+".join(test.name for test in diagnosis.tests if test is not None) or None,
        actuator=diagnosis.actuator.name,
        serial=next((item.serial for item in recordings if item.serial is not None), None),
        state=cast("State", diagnosis.verdict.name),
        reasons=tuple(map(valid_text, diagnosis.reasons)),
        severities=_severities(found, diagnosis.actuator),
        other=diagnosis.other,
        fit=_fit(found),
        culprit=diagnosis.culprit,
        positions=tuple(map(_position, diagnosis.positions)),
        quality=_quality(diagnosis),
        search=_search(request, sources, found),
        timing_s=Timing(
            read=round(read_s, 4),
            first=round(timing.first, 4) if timing else None,
            search=round(timing.search, 4) if timing else None,
            refine=round(timing.refine, 4) if timing else None,
            total=round(read_s + diagnosis.elapsed, 4),
            after_test=None if after_test_s is None else round(after_test_s, 4),
        ),
        error=None,
        date=next(filter(None, (date_text(item.start_ns) for item in recordings)), None),
        origins=tuple(map(_origin, recordings, diagnosis.tests, files)),
        actuator_sha256=fingerprint(diagnosis.actuator),
        configuration=configuration_of(request, sources),
        package=package(),
        effects=diagnosis.effects,
        covariance=_covariance(found),
        request=_printable(request),
    )
    return result.with_diagnosis(diagnosis)


def failed_result(
    source: str,
    error: str,
    exit_code: int,
    request: Request,
    actuator: Actuator,
    *,
    sources: Sources | None = None,
    log: Log | None = None,
) -> Result:
    """Return the result of an input that could not be read: all keys, and no verdict.

    source: the input as it was named; error: what is wrong with it; exit_code: that it would end
    with alone; request: what was asked for; actuator: what would have been diagnosed; sources:
    fingerprints of what the request names; log: the log, if there is one. Returns with `error`.
    """
    sources = sources or Sources()
    return Result(
        source=valid_text(source),
        test=None,
        actuator=actuator.name,
        serial=None,
        state=None,
        reasons=(),
        severities=_severities(None, actuator),
        fit=None,
        quality=None,
        search=_search(request, sources, None),
        timing_s=None,
        error=InputError(text=valid_text(error), exit_code=exit_code, log=log),
        date=None,
        origins=(),
        actuator_sha256=fingerprint(actuator),
        configuration=configuration_of(request, sources),
        package=package(),
        request=_printable(request),
    )


def sources_of(
    tests: object, columns: object, mapping: object, dbc: str, file: str | None, solver: str | None
) -> Sources:
    """Return the fingerprints of what a request names.

    columns: meaning of decoded signals; None: by their names; mapping: meaning of the frames, of
    the DBC `dbc` and the mapping file `file`; solver: name of one that was given as an object.
    """
    return Sources(
        tests_sha256=fingerprint(tests),
        columns_sha256=None if columns is None else fingerprint(columns),
        mapping=Mapped(
            name=valid_text(dbc),
            sha256=fingerprint(mapping),
            file=None if file is None else valid_text(file),
        ),
        solver=solver,
    )


def configuration_of(request: Request, sources: Sources) -> Configuration:
    """Return all that decides results but actuator data and recordings."""
    names = {item.name for item in msgspec.structs.fields(Configuration)}
    parts: dict[str, Any] = {
        "levels": LevelsPart(
            advisory=request.advisory, limit=request.limit, rule=str(request.rule)
        ),
        "tests_sha256": sources.tests_sha256,
        "columns_sha256": sources.columns_sha256,
        "mapping": sources.mapping,
    }
    same = names.intersection(Request.__struct_fields__).difference(parts)
    parts |= {name: getattr(request, name) for name in same}
    return Configuration(**parts | {"solver": sources.solver or request.solver})


@cache
def package() -> Package:
    """Name and version of this package, and of what affects the digits."""
    import platform  # noqa: PLC0415

    import numpy  # noqa: PLC0415

    from ehadiag.compile.libraries import compiler_versions  # noqa: PLC0415 - not for old results

    return Package(
        name="ehadiag",
        version=__version__,
        python=platform.python_version(),
        numpy=numpy.__version__,
        numba=compiler_versions().get("numba", ""),
    )


def _printable(request: Request) -> Request:
    """Make names of files fit for JSON, which is UTF-8."""
    texts = {
        name: valid_text(value) if isinstance(value, str) else tuple(map(valid_text, value))
        for name in request.__struct_fields__
        if isinstance(value := getattr(request, name), str | tuple)
    }
    changed = any(value != getattr(request, name) for name, value in texts.items())
    return msgspec.structs.replace(request, **texts) if changed else request


def _severities(found: Identification | None, actuator: Actuator) -> dict[str, Severity]:
    """Every fault of the registry, in its order."""
    from ehadiag.model.registry import FAULTS  # noqa: PLC0415 - loads kernels

    out = {
        item.name: Severity(
            name=item.name, meaning=item.short, advice=getattr(actuator.advice, item.name)
        )
        for item in FAULTS
    }
    for item in found.estimates if found else ():
        ends = (finite(item.interval95[0]), finite(item.interval95[1]))
        out[item.name] = msgspec.structs.replace(
            out[item.name],
            first=finite(item.first),
            search=finite(item.search),
            estimate=finite(item.value),
            std=finite(item.std),
            interval95=None if ends[0] is None or ends[1] is None else (ends[0], ends[1]),
            flags=(AT_BOUND,) * item.at_bound + (NOT_SHOWN,) * (not item.shown),
            source="final",
        )
    return out


def _fit(found: Identification | None) -> Fit | None:
    if found is None:
        return None
    fit = found.fit
    return Fit(
        spool_rms=finite(fit.spool_rms),
        pressure_rms=finite(fit.pressure_rms),
        outliers=finite(fit.outliers),
        spool_noise_mm=finite(fit.spool_noise * 1e3),
        pressure_noise_MPa=finite(fit.pressure_noise * 1e-6),
        spool_offset_mm=finite(fit.spool_offset * 1e3),
        pressure_offset_MPa=finite(fit.pressure_offset * 1e-6),
        anchored=fit.anchored,
        spool_rms_uncapped=finite(fit.spool_rms_uncapped),
        pressure_rms_uncapped=finite(fit.pressure_rms_uncapped),
    )


def _position(fit: PositionFit | None) -> Position | None:
    if fit is None:
        return None
    return Position(
        gain=finite(fit.gain),
        drift_mm_s=finite(fit.drift * 1e3),
        rms=finite(fit.rms),
        outliers=finite(fit.outliers),
    )


def _search(request: Request, sources: Sources, found: Identification | None) -> Search:
    if found is None:
        return Search(name=sources.solver or request.solver, seed=request.seed)
    return Search(
        name=found.solver,
        seed=found.seed,
        evaluations=found.evaluations,
        generations=found.generations,
        converged=bool(found.converged),
        begun_from=valid_text(found.begun_from) or None,
    )


def _covariance(found: Identification | None) -> tuple[tuple[float, ...], ...] | None:
    if found is None or not all(map(math.isfinite, found.covariance.ravel().tolist())):
        return None
    return tuple(tuple(row) for row in found.covariance.tolist())


def _quality(diagnosis: Diagnosis) -> Quality:
    """Counts of all recordings together."""
    each = [item.quality for item in diagnosis.recordings]
    saturated: dict[str, int] = {}
    for item in each:
        for channel, count in item.saturated.items():
            saturated[channel] = saturated.get(channel, 0) + count

    def total(count: str) -> int:
        return sum(item.total(count) for item in each)

    return Quality(
        frames=total("received"),
        lost=total("lost"),
        repeated=total("repeated"),
        conflicts=total("conflicts"),
        crc_errors=total("crc_errors"),
        out_of_order=total("out_of_order"),
        length_errors=total("length_errors"),
        range_errors=total("range_errors"),
        foreign=sum(item.foreign for item in each),
        error_frames=sum(item.error_frames for item in each),
        saturated=saturated,
        notes=tuple(map(valid_text, diagnosis.notes)),
    )


def _origin(item: Recording, test: StoredTest | None, log: Log | None) -> Origin:
    around = item.environment
    named = None
    if test is not None:
        named = TestOrigin(name=test.name, id=test.id, sha256=fingerprint(test))
    return Origin(
        source=valid_text(item.source),
        date=date_text(item.start_ns),
        length_s=None if item.samples is None else round(item.duration, 6),
        serial=item.serial,
        channel=item.channel,
        test=named,
        oil_temperature_degC=finite(around.oil_temperature),
        supply_pressure_MPa=_mega(around.supply_pressure),
        return_pressure_MPa=_mega(around.return_pressure),
        log=log,
        onboard=_onboard(item.onboard),
        samples_sha256=hash_of_samples(item),
    )


def hash_of_samples(recording: Recording) -> str | None:
    """Return the SHA-256 of the decoded samples: the same for a log, its packed copy or conversion.

    Hexadecimal; None without samples. Times of arrival do not count: formats round them.
    """
    import numpy as np  # noqa: PLC0415 - only with samples

    samples = recording.samples
    if samples is None:
        return None
    out = hashlib.sha256(
        f"{recording.test_id} {recording.serial} {samples.period_ns} {samples.mode}".encode()
    )
    measured = samples.current, samples.spool, samples.pressure, samples.position
    for values in (samples.command, *measured):
        # One zero, one NaN: equal numbers have equal bits.
        plain = np.asarray(values + 0.0, dtype="<f8")
        plain[np.isnan(plain)] = np.nan
        out.update(plain.data)
    return out.hexdigest()


def _mega(value: float | None) -> float | None:
    return None if value is None else finite(value * 1e-6)


def _onboard(found: OnboardResult | None) -> Onboard | None:
    """What the computer found; a number that is no verdict is shown as it is."""
    if found is None:
        return None
    known = {int(item): item.name for item in Verdict}
    verdict = None if found.verdict is None else known.get(found.verdict, str(found.verdict))
    return Onboard(
        verdict=verdict,
        test_id=found.test_id,
        evaluations=found.runs,
        faults={
            name: OnboardFault(estimate=finite(value), std=finite(found.std[name]))
            for name, value in found.severities.items()
        },
    )


def log_of(path: str | os.PathLike[str]) -> Log | None:
    """What can be said of a log without reading it; None where there is none."""
    try:
        info = os.stat(path)
    except (OSError, ValueError):
        return None
    return Log(
        path=valid_text(os.path.abspath(os.fspath(path))),
        bytes=info.st_size,
        modified=date_text(info.st_mtime_ns),
        modified_ns=info.st_mtime_ns,
    )
