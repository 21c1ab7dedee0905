"""What a diagnosis found: one record whose JSON, `ehadiag.diagnosis/3`, is a walk of its fields."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta, field

from ehadiag.assess.verdict import Verdict
from ehadiag.core.conventions import MAX_RESULT_BYTES
from ehadiag.estimate import Culprit, Effect, Severity, without_interval
from ehadiag.request import MOST_SEED, Request
from firmware_iface import FREE_MOTION
from firmware_iface.errors import ConfigurationError, NotTestedError
from firmware_iface.files import read_small_file, write_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ehadiag.assess.diagnosis import Diagnosis
    from firmware_iface.recording import Recording

SCHEMA: Final = "ehadiag.diagnosis/3"
State = Literal["HEALTHY", "DEGRADED", "FAULT", "NOT_TESTED"]
FORMER = "ehadiag.diagnosis/2"
"""Schema of former results, which are still read."""


class Fit(msgspec.Struct, frozen=True, kw_only=True):
    """How well the model explains the recordings."""

    spool_rms: float | None
    """Rms residual in units of the noise, squares capped at nine; about 1."""
    pressure_rms: float | None
    outliers: float | None
    """Share of residuals beyond three times the noise, 0 … 1."""
    spool_noise_mm: float | None
    """Noise as judged from the recording."""
    pressure_noise_MPa: float | None
    spool_offset_mm: float | None
    """Constant error of the sensor."""
    pressure_offset_MPa: float | None
    anchored: int
    """How often the model was put back on the measured spool."""
    spool_rms_uncapped: float | None
    """Rms residual in units of the noise, every residual counted in full."""
    pressure_rms_uncapped: float | None


class Position(msgspec.Struct, frozen=True, kw_only=True):
    """Check of the jack's position sensor."""

    gain: float | None
    """Measured over modelled travel; None where the jack hardly moves."""
    drift_mm_s: float | None
    rms: float | None
    """What is left of the travel, in units of its noise."""
    outliers: float | None


class Quality(msgspec.Struct, frozen=True, kw_only=True):
    """What is known of the frames that the recordings came in."""

    frames: int
    lost: int
    repeated: int
    conflicts: int
    crc_errors: int
    out_of_order: int
    length_errors: int
    range_errors: int
    foreign: int
    error_frames: int
    saturated: dict[str, int]
    """Samples at a converter's end, by channel."""
    notes: tuple[str, ...]
    """What was assumed and what is missing; without effect on the verdict."""


class Search(msgspec.Struct, frozen=True, kw_only=True):
    """The search, and what it cost."""

    name: str
    seed: Annotated[int, Meta(ge=0, le=MOST_SEED)]
    evaluations: int = 0
    """Runs of the model in all stages."""
    generations: int = 0
    converged: bool | None = None
    begun_from: str | None = None
    """Earlier diagnosis that the refinement began from; None: the search of this recording."""


class Timing(msgspec.Struct, frozen=True, kw_only=True):
    """Seconds."""

    read: float
    """Reading the log, or acquiring the test; 0 where the recording was at hand."""
    first: float | None
    search: float | None
    refine: float | None
    total: float
    after_test: float | None
    """From the end of a live test to the verdict."""


class Log(msgspec.Struct, frozen=True, kw_only=True):
    """The log of a recording, as it was when it was read."""

    path: str
    """Absolute."""
    bytes: int
    modified: str | None
    """Time of its last change, UTC, ISO 8601."""
    modified_ns: int
    """The same, ns since 1970."""
    result: int = 1
    """Which of the results that the log gave this is, from 1."""
    results: int = 1


class ListedTest(msgspec.Struct, frozen=True, kw_only=True):
    """One test of a log."""

    number: int
    """In order of time, from 1."""
    test: int | None
    """Number of the stored test; None where the bus does not say and no stored test fits."""
    start: str | None
    """UTC, ISO 8601."""
    length_s: float | None
    """None without samples."""
    outcome: str | None
    """How it ended, by the status frames."""
    serial: int | None
    """Of the unit, as the bus says."""
    channel: int | None
    """Adapter channel; None where it is not said."""
    remarks: tuple[str, ...]
    """Why it cannot be diagnosed; empty where nothing is known against it."""


class TestOrigin(msgspec.Struct, frozen=True, kw_only=True):
    """The stored test that a recording is of."""

    name: str
    id: int
    sha256: str
    """Fingerprint of the test's data."""


class OnboardFault(msgspec.Struct, frozen=True, kw_only=True):
    """A severity as the flight-control computer found it."""

    estimate: float | None
    std: float | None


class Onboard(msgspec.Struct, frozen=True, kw_only=True):
    """Result of the identification on board the flight-control computer."""

    verdict: str | None
    test_id: int | None
    evaluations: int | None
    """Runs of its model."""
    faults: dict[str, OnboardFault]


class Origin(msgspec.Struct, frozen=True, kw_only=True):
    """A recording that was diagnosed."""

    source: str
    date: str | None
    length_s: float | None
    serial: int | None
    channel: int | None
    """Adapter channel."""
    test: TestOrigin | None
    oil_temperature_degC: float | None
    supply_pressure_MPa: float | None
    return_pressure_MPa: float | None
    log: Log | None
    onboard: Onboard | None
    samples_sha256: str | None = None
    """Hash of what was decoded, the same in whatever format it was kept; None without samples."""


class LevelsPart(msgspec.Struct, frozen=True, kw_only=True):
    """Levels that the verdict goes by."""

    advisory: float
    limit: float
    rule: str


class Mapped(msgspec.Struct, frozen=True, kw_only=True):
    """Meaning of the bus's frames."""

    name: str | None = None
    """Of the DBC; None: the recording was at hand."""
    sha256: str | None = None
    """Fingerprint of the meaning."""
    file: str | None = None
    """Mapping file; None: the default bus, or the recording was at hand."""


class Configuration(msgspec.Struct, frozen=True, kw_only=True):
    """All that decides a result but actuator data and recordings."""

    solver: str
    seed: int
    levels: LevelsPart
    nuisances: str
    time_limit_s: float | None
    every_test: bool
    tests_sha256: str | None
    """Fingerprint of the tests that a recording may be of."""
    columns_sha256: str | None
    """Fingerprint of the meaning of columns; None: by their usual names."""
    start_s: float | None
    end_s: float | None
    mapping: Mapped


class InputError(msgspec.Struct, frozen=True, kw_only=True):
    """Why an input could not be read."""

    text: str
    exit_code: int
    """That it would end with alone."""
    log: Log | None = None


class Package(msgspec.Struct, frozen=True, kw_only=True):
    """Versions of this package, and of what affects the digits."""

    name: str
    version: str
    python: str
    numpy: str
    numba: str


class Sources(msgspec.Struct, frozen=True, kw_only=True):
    """Fingerprints and files that stand behind a request."""

    tests_sha256: str | None = None
    columns_sha256: str | None = None
    mapping: Mapped = Mapped()
    solver: str | None = None
    """Name of a solver that was given as an object."""


class Result(msgspec.Struct, frozen=True, kw_only=True, dict=True):
    """The diagnosis of one actuator, from one recording or from several together.

    `print(result)` prints the command line's table; a notebook shows it by itself.
    """

    schema: Literal["ehadiag.diagnosis/3"] = SCHEMA
    source: str
    """File or bus; several joined by ' + '."""
    test: str | None
    """Name of the stored test, several joined by '+'; None if it is not known."""
    actuator: str
    """Name of the actuator's data."""
    serial: int | None
    """Of the unit, as the bus says."""
    state: State | None = field(name="verdict")
    """Name of the verdict; None where the input could not be read."""
    reasons: tuple[str, ...]
    """Why, one sentence each; none for a healthy actuator."""
    severities: dict[str, Severity] = field(name="faults")
    """Each progressive fault by its name."""
    other: tuple[Effect, ...] = ()
    """Effects that have a limit of their own, in the order of the actuator file."""
    fit: Fit | None
    """None where nothing was identified."""
    culprit: Culprit | None = None
    """What may keep the model from explaining the recordings; None where it explains them."""
    positions: tuple[Position | None, ...] = ()
    """Of each recording; None where there are too few samples."""
    quality: Quality | None
    search: Search = field(name="solver")
    timing_s: Timing | None
    error: InputError | None
    """Why the input could not be read; None where it was."""
    date: str | None
    """Start of the test, UTC, ISO 8601; None where the log has no dates."""
    origins: tuple[Origin, ...] = field(name="recordings")
    """Where each recording is from."""
    actuator_sha256: str | None
    """Fingerprint of the actuator's data."""
    configuration: Configuration
    package: Package
    effects: tuple[Effect, ...] = ()
    """Every effect that was estimated."""
    covariance: tuple[tuple[float, ...], ...] | None = None
    """Of the severities, in their order."""
    request: Request
    """What was asked for: with the same recordings at hand it gives the same result."""

    @property
    def verdict(self) -> Verdict:
        """State of the actuator; `str` of it is its name, `int` the command line's exit code."""
        return Verdict[self.state or Verdict.NOT_TESTED.name]

    @property
    def faults(self) -> Mapping[str, Severity]:
        """The severities by name, read only."""
        return MappingProxyType(self.severities)

    @property
    def notes(self) -> tuple[str, ...]:
        """What was assumed and what is missing; without effect on the verdict."""
        return () if self.quality is None else self.quality.notes

    @property
    def solver(self) -> str:
        """Search that was asked for."""
        return self.search.name

    @property
    def seed(self) -> int:
        """Seed that was asked for."""
        return self.search.seed

    @property
    def identified(self) -> bool:
        """Whether there are estimates of a test."""
        return self.fit is not None

    @property
    def estimated(self) -> bool:
        """Whether there are estimates, of a test or of free motion."""
        return self.identified or self.test == FREE_MOTION

    @property
    def relied_on(self) -> bool:
        """Whether stated intervals hold: not those of a test that its best fit does not explain."""
        return not (self.identified and self.verdict is Verdict.NOT_TESTED)

    @property
    def as_shown(self) -> Result:
        """The result as people see it: intervals that do not hold are left out."""
        if self.relied_on:
            return self
        return msgspec.structs.replace(
            self,
            severities={name: without_interval(item) for name, item in self.severities.items()},
            other=tuple(map(without_interval, self.other)),
            effects=tuple(map(without_interval, self.effects)),
        )

    @property
    def exit_code(self) -> int:
        """Of the command line."""
        return int(self.verdict) if self.error is None else self.error.exit_code

    @property
    def diagnosis(self) -> Diagnosis:
        """All that led to the verdict: recordings, experiments, covariance.

        Raises
        ------
        NotTestedError
            The result was read from JSON, or comes from another process.
        """
        found: Diagnosis | None = self.__dict__.get("_diagnosis")
        if found is None:
            raise NotTestedError(f"{self.source}: only its result is at hand; diagnose it again")
        return found

    def with_diagnosis(self, diagnosis: Diagnosis) -> Result:
        """Return the same result with what led to it at hand.

        Parameters
        ----------
        diagnosis : Diagnosis
            Made again from the same recordings.

        Returns
        -------
        Result
            A copy.
        """
        out = msgspec.structs.replace(self)
        out.__dict__["_diagnosis"] = diagnosis
        return out

    @property
    def at_hand(self) -> bool:
        """Whether `diagnosis` is there."""
        return "_diagnosis" in self.__dict__

    @property
    def can_be_drawn(self) -> bool:
        """Whether there are samples at hand, be there an estimate or not."""
        return self.at_hand and any(
            item.samples is not None and item.samples.ticks for item in self.recordings
        )

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """What was diagnosed; see `diagnosis`."""
        return self.diagnosis.recordings

    def to_json(self) -> str:
        """Return the command line's JSON object.

        Returns
        -------
        str
            One line without its end, strict JSON in ASCII.
        """
        return json.dumps(msgspec.to_builtins(self), allow_nan=False)

    @classmethod
    def from_json(cls, line: str | bytes) -> Result:
        """Read what `to_json` wrote, or an object `ehadiag.diagnosis/2`.

        Parameters
        ----------
        line : str | bytes
            One object.

        Returns
        -------
        Result
            Without `diagnosis`.

        Raises
        ------
        ValueError
            It is none of these.
        """
        try:
            tree = msgspec.json.decode(line)
            if isinstance(tree, dict) and tree.get("schema") == FORMER:
                tree = _upgraded(tree)
            return msgspec.convert(tree, cls)
        except (msgspec.MsgspecError, ConfigurationError, RecursionError) as error:
            raise ValueError(f"no object {SCHEMA}: {error}") from None
        except (LookupError, TypeError, AttributeError) as error:
            raise ValueError(f"no object {FORMER}: {error!r}") from None

    def plot(self) -> Figure:
        """Draw measured against modelled response, one column for each recording.

        Without an estimate: against what is expected of a unit as new.

        Returns
        -------
        Figure
            Not one of pyplot's; a notebook shows it by itself.

        Raises
        ------
        NotTestedError
            There are no samples.
        """
        if not self.can_be_drawn:
            raise NotTestedError(f"{self.source}: nothing to plot: {'; '.join(self.reasons)}")
        from ehadiag.report.matplotlib_figures import draw_picture  # noqa: PLC0415 - slow
        from ehadiag.report.response_signals import result_picture  # noqa: PLC0415

        return draw_picture(result_picture(self))

    def write_signals(self, path: str | os.PathLike[str]) -> None:
        """Write recorded and modelled signals, residuals and events to a file.

        With verdict and severities as metadata; the JSON object and the DBC are attached.

        Parameters
        ----------
        path : str | os.PathLike[str]
            File to write, `.mf4` or `.mcap`; one that exists is replaced.

        Raises
        ------
        ConfigurationError
            Another suffix, or the library of the format is not installed.
        NotTestedError
            There are no samples.
        InputOutputError
            The file cannot be written.
        """
        from ehadiag.report.signal_files import signal_file  # noqa: PLC0415 - slow

        place = Path(path)
        write_file(place, signal_file(self, place.suffix.lower().removeprefix(".")), "signals")

    def __str__(self) -> str:
        """Return the command line's table."""
        from ehadiag.report.head import diagnosis_text  # noqa: PLC0415 - only who prints needs rich

        return diagnosis_text(self)

    def __repr__(self) -> str:
        """Return verdict and estimates in one line."""
        values = ", ".join(f"{name} {item.value:.4f}" for name, item in self.severities.items())
        return f"<Result {self.verdict.name} {self.source}: {values}>"

    def _repr_html_(self) -> str:
        from ehadiag.report.head import diagnosis_html  # noqa: PLC0415

        return diagnosis_html(self)


def load_result(path: Path) -> Result:
    """Read a result's JSON file; ConfigurationError: it is none, InputOutputError: unreadable."""
    line = read_small_file(path, MAX_RESULT_BYTES, "result")
    try:
        return Result.from_json(line)
    except ValueError:
        raise ConfigurationError(f"result {path}: is none of ehadiag's JSON results") from None


def result_schema() -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of a result, made from its fields."""
    tree = msgspec.json.schema(Result)
    head = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": "urn:ehadiag:diagnosis:3",
        "title": SCHEMA,
    }
    # A reader may rely on every key; a default is only what an older object is read with.
    for part in tree["$defs"].values():
        if "properties" in part:
            part["required"] = list(part["properties"])
    return head | tree


def _upgraded(tree: dict[str, Any]) -> dict[str, Any]:
    """Make an object of version 3 from one of version 2: what this did not say stays unknown."""
    configuration = tree["configuration"]
    levels, mapping = configuration["levels"], configuration["mapping"]
    names = set(Request.__struct_fields__) & set(configuration) - {"mapping"}
    request = {name: configuration[name] for name in names}
    if request.get("solver") not in ("cga", "pygad"):
        del request["solver"]
    logs = [item["log"] and item["log"]["path"] for item in tree["recordings"]]
    request |= {
        "advisory": levels["advisory"],
        "limit": levels["limit"],
        "rule": levels.get("rule", "interval"),
        "mapping": mapping["file"],
        "logs": [log or item["source"] for log, item in zip(logs, tree["recordings"], strict=True)],
        "joint": len(logs) > 1,
    }
    faults = {
        name: {"name": name, "meaning": _short(name), "source": "final", **fault}
        for name, fault in tree["faults"].items()
    }
    for fault in faults.values():
        if fault["interval95"] is not None and None in fault["interval95"]:
            fault["interval95"] = None
    other = [{"meaning": _short(item["name"]), **item} for item in tree.get("other", [])]
    return {
        **tree,
        "schema": SCHEMA,
        "faults": faults,
        "other": other,
        "effects": other,
        "covariance": None,
        "request": request,
    }


def _short(name: str) -> str:
    from ehadiag.model.registry import parameter  # noqa: PLC0415 - loads kernels

    try:
        return parameter(name).short
    except KeyError:
        return ""
