"""What a diagnosis can be asked for: one record that command line, Python and results share.

The options of the commands, the keys of `ehadiag.toml`, the keyword arguments of
`ehadiag.diagnose`, the key `request` of a JSON result and its schema follow from the fields.
"""

from __future__ import annotations

import math
import numbers
import operator
import os
from functools import cache
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta

from ehadiag.assess.verdict import Levels, VerdictRule
from ehadiag.core.actuator import MAX_TOLERANCE
from firmware_iface.errors import ConfigurationError
from firmware_iface.recording import MAX_CAN_ID

MOST_SEED = (1 << 32) - 1
"""Largest seed of random numbers, 1."""
TEST = "open|closed|NUMBER|FILE"
"""Ways to name a test, in the help of every command."""


def _option(name: str, text: str, metavar: str | None = None, **extra: Any) -> Meta:
    """Describe a field: its option, and one line for the help."""
    return Meta(description=text, extra={"option": name, "metavar": metavar, **extra})


class Request(msgspec.Struct, frozen=True, kw_only=True):
    """All that decides a diagnosis but the recordings themselves.

    A value that its option does not take, and levels or instants in the wrong order, are a
    ConfigurationError.
    """

    logs: Annotated[
        tuple[str, ...],
        Meta(
            description="recording, folder of recordings, pattern, or - for a list of names on"
            " standard input; a log with several tests gives its last complete one"
        ),
    ] = ()
    test: Annotated[
        tuple[str, ...],
        _option(
            "--test",
            "further test that a log may contain; repeatable."
            " One alone also applies to logs without a test number",
            TEST,
            project=True,
            file=True,
        ),
    ] = ()
    joint: Annotated[
        bool, _option("--joint", "the logs are of one actuator: one estimate from all of them")
    ] = False
    every_test: Annotated[
        bool, _option("--all", "every test in a log (default: the last complete one)")
    ] = False
    merge: Annotated[
        bool,
        _option(
            "--merge",
            "the logs are files of one recording: split in time, or one for each bus",
        ),
    ] = False
    start_s: Annotated[
        Annotated[float, Meta(ge=0)] | None,
        _option(
            "--start",
            "where the test begins, s from the first sample of the recording, on a bus that"
            " does not say (default: found by its command or current)",
            "S",
        ),
    ] = None
    end_s: Annotated[
        Annotated[float, Meta(ge=0)] | None,
        _option(
            "--end",
            "where the test has ended, s from the first sample of the recording, on a bus that"
            " does not say (default: found by its command or current)",
            "S",
        ),
    ] = None
    actuator: Annotated[
        str | None,
        _option(
            "--actuator",
            "actuator data, TOML (default: the reference actuator)",
            "FILE",
            project=True,
            file=True,
        ),
    ] = None
    tolerance: Annotated[
        Annotated[float, Meta(ge=0, le=MAX_TOLERANCE)] | None,
        _option(
            "--tolerance",
            f"each datum of the actuator file may be off by this share, 0 … {MAX_TOLERANCE:g}"
            " (default: as the file says)",
            "SHARE",
        ),
    ] = None
    mapping: Annotated[
        str | None,
        _option(
            "--mapping",
            "which signals of a DBC are which channels, TOML (default: the FCC's own bus)",
            "FILE",
            project=True,
            file=True,
        ),
    ] = None
    dbc: Annotated[
        str | None,
        _option(
            "--dbc",
            "DBC to use instead of the mapping's own, or one of the default names",
            "FILE",
            project=True,
            file=True,
        ),
    ] = None
    id_offset: Annotated[
        Annotated[int, Meta(ge=-MAX_CAN_ID, le=MAX_CAN_ID)] | None,
        _option(
            "--id-offset",
            "added to the identifiers of all messages: that of a sister unit on the same bus"
            " (default: the mapping's, else 0)",
            "N",
            project=True,
        ),
    ] = None
    columns: Annotated[
        tuple[str, ...],
        _option(
            "--column",
            "column of a recording of decoded signals, as"
            " position='Stroke':mm; repeatable (default: the mapping's, else by name)",
            "ROLE=NAME[:UNIT]",
        ),
    ] = ()
    log_channel: Annotated[
        Annotated[int, Meta(ge=1)] | None,
        _option(
            "--log-channel",
            "adapter channel of the recording that is the actuator's, from 1"
            " (default: the mapping's, else the only one)",
            "N",
            project=True,
        ),
    ] = None
    max_frames: Annotated[
        Annotated[int, Meta(ge=1)],
        _option(
            "--max-frames",
            "frames that a recording may have (default 20000000, some three hours)",
            "N",
        ),
    ] = 20_000_000
    max_log_size_MiB: Annotated[
        Annotated[float, Meta(gt=0)],
        _option(
            "--max-log-size",
            "size of a recording, and of what it unpacks to (default 4096)",
            "MiB",
        ),
    ] = 4096.0
    max_read_time_s: Annotated[
        Annotated[float, Meta(gt=0)],
        _option("--max-read-time", "time that reading one recording may take (default 900)", "S"),
    ] = 900.0
    solver: Annotated[
        Literal["cga", "pygad"],
        _option("--solver", "search: compact GA (default) or pygad", project=True),
    ] = "cga"
    nuisances: Annotated[
        Literal["auto", "none", "all"],
        _option(
            "--nuisances",
            "estimate null bias, gain, hysteresis and backlash beside the faults: where the faults"
            " alone do not explain a recording (auto, the default), never, or always",
            project=True,
        ),
    ] = "auto"
    seed: Annotated[
        Annotated[int, Meta(ge=0, le=MOST_SEED)],
        _option(
            "--seed", "seed of the search (default 0); the same seed, the same answer", "N",
            project=True,
        ),
    ] = 0  # fmt: skip
    prior: Annotated[
        str | None,
        _option(
            "--prior",
            "JSON result of the unit's last diagnosis: the estimate begins there if that explains"
            " the recording (default: the last one in the health history)",
            "FILE",
            file=True,
        ),
    ] = None
    advisory: Annotated[
        float,
        _option(
            "--advisory", "DEGRADED at or above this severity (default 0.25)", "K", project=True
        ),
    ] = 0.25
    limit: Annotated[
        float,
        _option("--limit", "FAULT at or above this severity (default 0.75)", "K", project=True),
    ] = 0.75
    rule: Annotated[
        Literal["interval", "estimate"],
        _option(
            "--rule",
            "verdict by the chance that a severity is at or above a level (default), or by the"
            " estimates alone",
            project=True,
        ),
    ] = "interval"
    time_limit_s: Annotated[
        Annotated[float, Meta(gt=0)] | None,
        _option(
            "--time-limit",
            "NOT TESTED where the identification takes longer, wall clock (default 600)",
            "S",
        ),
    ] = 600.0

    def __post_init__(self) -> None:
        for name, option in request_options().items():
            given = getattr(self, name)
            value = option.checked(given)
            if value is not given:
                msgspec.structs.force_setattr(self, name, value)
        _ = self.levels
        start, end = self.start_s, self.end_s
        if start is not None and end is not None and end <= start:
            raise ConfigurationError(f"--end {end:g}: not after --start {start:g}")

    @property
    def levels(self) -> Levels:
        """Advisory level and limit, with the rule that compares a severity with them."""
        return Levels(self.advisory, self.limit, VerdictRule(self.rule))

    @property
    def max_log_bytes(self) -> int:
        """Size of a recording that is read, bytes."""
        return round(self.max_log_size_MiB * (1 << 20))


class Option(msgspec.Struct, frozen=True):
    """A field of `Request`, as command line, files of defaults and errors need it."""

    name: str
    flag: str
    """Name of the command-line option; empty for a field that has none."""
    kind: type[Any]
    """`bool`, `int`, `float` or `str`."""
    many: bool
    """Whether it has several values."""
    optional: bool
    """Whether it may be None."""
    default: Any
    choices: tuple[str, ...]
    """Values of a text; empty: any."""
    bounds: Meta
    metavar: str | None
    help: str
    project: bool
    """Whether a project's `ehadiag.toml` may set it."""
    file: bool
    """Whether its values name files."""

    @property
    def need(self) -> str:
        """What the option takes, for the end of an error."""
        if self.choices:
            return f"need one of {', '.join(self.choices)}"
        if self.kind is bool:
            return "need true or false"
        if self.kind is str:
            return "need a text or a path"
        noun = "a whole number" if self.kind is int else "a number"
        least, most, above = self.bounds.ge, self.bounds.le, self.bounds.gt
        if least is not None and most is not None:
            return f"need {noun}, {least:g} … {most if self.kind is int else f'{most:g}'}"
        if above is not None or (self.kind is int and least == 1):
            return f"need {noun} above 0"
        return f"need {noun}" if least is None else f"need {noun} of at least {least:g}"

    def read(self, text: str) -> Any:
        """Read one value from the command line.

        ValueError: the option takes no such value.
        """
        value: Any = text
        if self.kind is int:
            value = int(text) if text.isascii() and text.isdigit() else None
        elif self.kind is float:
            value = float(text)
        if value is None or not self._allows(value):
            raise ValueError(f"{text!r}: {self.need}")
        return value

    def checked(self, value: Any) -> Any:
        """Return a value as the field holds it.

        value: of the field; one text or path may stand for a tuple of one. Returns a plain number,
        text, or tuple of texts. ConfigurationError: the option takes no such value.
        """
        if value is None and self.optional:
            return None
        try:
            if self.many:
                items = (value,) if isinstance(value, str | os.PathLike) else value
                return tuple(os.fspath(item) for item in items)
            plain = self._plain(value)
        except (TypeError, ValueError):
            plain = None
        if plain is None or not self._allows(plain):
            raise ConfigurationError(f"{self.name} {value!r}: {self.need}")
        return value if type(value) is type(plain) else plain

    def _plain(self, value: Any) -> Any:
        if self.kind is bool:
            return value if isinstance(value, bool) else None
        if self.kind is int:
            return operator.index(value)
        if self.kind is float:
            real = isinstance(value, numbers.Real) and not isinstance(value, bool)
            return float(value) if real else None
        return os.fspath(value)

    def _allows(self, value: Any) -> bool:
        if self.choices:
            return value in self.choices
        if self.kind in (bool, str):
            return True
        least, most, above = self.bounds.ge, self.bounds.le, self.bounds.gt
        return (
            math.isfinite(value)
            and (least is None or value >= least)
            and (most is None or value <= most)
            and (above is None or value > above)
        )


@cache
def request_options() -> dict[str, Option]:
    """Fields of `Request` by name, with what their annotations state.

    Returns in the order of the fields.
    """
    hints = get_type_hints(Request, include_extras=True)
    return {
        field.name: _option_of(field, hints[field.name])
        for field in msgspec.structs.fields(Request)
    }


def _option_of(field: msgspec.structs.FieldInfo, hint: Any) -> Option:
    """Describe a field by its annotation; the `Meta` of nested ones are joined, innermost first."""
    metas = [item for item in get_args(hint) if isinstance(item, Meta)]
    kind = get_args(hint)[0] if get_origin(hint) is Annotated else hint
    optional = type(None) in get_args(kind)
    if optional:
        kind = next(item for item in get_args(kind) if item is not type(None))
    if get_origin(kind) is Annotated:
        metas = [*(item for item in get_args(kind) if isinstance(item, Meta)), *metas]
        kind = get_args(kind)[0]
    many = get_origin(kind) is tuple
    choices = tuple(get_args(kind)) if get_origin(kind) is Literal else ()
    extra: dict[str, Any] = metas[-1].extra or {}
    return Option(
        name=field.name,
        flag=extra.get("option", ""),
        kind=str if many or choices else kind,
        many=many,
        optional=optional,
        default=field.default,
        choices=choices,
        bounds=metas[0],
        metavar=extra.get("metavar"),
        help=metas[-1].description or "",
        project=bool(extra.get("project")),
        file=bool(extra.get("file")),
    )
