"""What a diagnosis was asked to do, and the logs it was made from: stated in its JSON result."""

from __future__ import annotations

from dataclasses import dataclass, field

from ehadiag.assess.verdict import Levels

__all__ = ["Asked", "LogFile"]


@dataclass(frozen=True, slots=True)
class LogFile:
    """The log of a recording, as it was when it was read."""

    path: str
    """Absolute."""
    size: int
    """Bytes."""
    modified_ns: int
    """Time of its last change, ns since 1970."""
    number: int = 1
    """Which of the results that its log gave this is, from 1."""
    results: int = 1
    """Results that its log gave; more than one only where every test was asked for."""


@dataclass(frozen=True, slots=True)
class Asked:
    """Options of a diagnosis."""

    solver: str = "cga"
    """Search by its name."""
    seed: int = 0
    """Of the search."""
    levels: Levels = field(default_factory=Levels)
    """From where on an actuator is degraded, or at fault."""
    nuisances: str = "auto"
    """Which effects of the installation are estimated."""
    time_limit_s: float | None = None
    """Of the identification, s; None: none."""
    every: bool = False
    """Whether each test of a log was to be diagnosed, not only its last complete one."""
    mapping: str | None = None
    """Name of the DBC that gave the frames their meaning; None: the recording was at hand."""
    mapping_sha256: str | None = None
    """Fingerprint of that meaning."""
    mapping_file: str | None = None
    """File that names the signals; None: the default bus, or the recording was at hand."""
    tests_sha256: str | None = None
    """Fingerprint of the tests that a recording may be of; None: not said."""
    columns_sha256: str | None = None
    """Of the meaning of columns; None: frames, or columns by their usual names."""
    start_s: float | None = None
    """Where the test begins, s from the first sample of the log; None: it was looked for."""
    end_s: float | None = None
    """Where it has ended."""
