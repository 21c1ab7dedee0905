"""Says which column of a table of decoded signals is which channel, and in which unit."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from firmware_iface.bus_map import ROLE_DIMENSIONS, si_factor
from firmware_iface.errors import ConfigurationError, printable
from firmware_iface.files import read_toml

COLUMNS_SCHEMA = "ehadiag.columns/1"
TIME_ROLE = "time"
SI_UNITS = {
    "current": "A",
    "length": "m",
    "pressure": "Pa",
    "temperature": "degC",
    "time": "s",
}
COLUMN_ROLES: dict[str, str] = {
    TIME_ROLE: "time",
    **{
        f"{section}.{key}": str(dimension)
        for section in ("channels", "command", "environment")
        for key, dimension in ROLE_DIMENSIONS[section].items()
        if dimension is not None
    },
}
"""Role: the quantity that it is."""
SHORT_COLUMN_NAMES = {
    **{key: f"channels.{key}" for key in ("current", "spool", "pressure", "position")},
    "current_command": "command.current",
    "position_command": "command.position",
    **{key.split(".")[1]: key for key in COLUMN_ROLES if key.startswith("environment.")},
    TIME_ROLE: TIME_ROLE,
}
"""Name of a column that needs no mapping: its role."""
NEEDED_COLUMN_ROLES = ("channels.spool", "channels.pressure", "channels.position")
UNIT_PATTERN = re.compile(r"^(?P<name>.*?)\s*[\[(](?P<unit>[^\])]*)[\])]\s*$")
MAX_LISTED_COLUMNS = 12

ColumnName = Annotated[str, msgspec.Meta(min_length=1, max_length=200)]


class Column(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One column. SI value = SI(unit, value * scale + offset)."""

    column: ColumnName
    unit: str | None = None
    """None: that in brackets behind the column's name or in the file's row of units, else SI."""
    scale: float = 1.0
    offset: float = 0.0


class _Channels(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    spool: Column
    pressure: Column
    position: Column
    current: Column | None = None


class _Command(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    current: Column | None = None
    position: Column | None = None


class _Environment(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    supply_pressure: Column | None = None
    return_pressure: Column | None = None
    oil_temperature: Column | None = None


class _ColumnsFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    schema: Literal["ehadiag.columns/1"]
    channels: _Channels
    time: Column | None = None
    tick_ms: Annotated[float, msgspec.Meta(ge=0.05, le=1000)] = 1.0
    command: _Command = _Command()
    environment: _Environment = _Environment()


class ColumnMap(msgspec.Struct, frozen=True):
    """Columns by role; roles without one are looked for by their usual names."""

    columns: Mapping[str, Column] = msgspec.field(default_factory=dict)
    """By role, as `channels.spool`; `time` for the time stamps."""
    tick_ns: int = 1_000_000
    """Control period."""

    def resolve(self, present: Sequence[str], where: str) -> dict[str, Column]:
        """Find the column of each role in a file.

        present: names of the file's columns; where: begins the error texts. Returns columns by
        role, with names that the file has. ConfigurationError: a named column is missing.
        """
        bare = {bare_name(name): name for name in reversed(present)}
        found: dict[str, Column] = {}
        for role, item in self.columns.items():
            name = item.column if item.column in present else bare.get(item.column)
            if name is None:
                raise ConfigurationError(
                    f"{where}: no column {printable(item.column)!r} for {role}; "
                    f"{_column_list(present)}"
                )
            found[role] = msgspec.structs.replace(item, column=name)
        for short, role in SHORT_COLUMN_NAMES.items():
            if role not in found and (name := bare.get(short) or bare.get(role)) is not None:
                found[role] = Column(name)
        return found


def bare_name(name: str) -> str:
    """Name of a column without the unit in brackets behind it."""
    parts = UNIT_PATTERN.match(name)
    return parts["name"].strip() if parts else name.strip()


def column_unit(column: Column, stated: str, role: str, where: str) -> tuple[float, float]:
    """Gain and bias of a column: SI value = gain * number + bias.

    column: as mapped; stated: unit that the file says; empty: none; role: what it is; where: begins
    the error texts. Returns gain and bias, the mapping's own scale and offset among them.
    ConfigurationError: the unit is none of the quantity.
    """
    parts = UNIT_PATTERN.match(column.column)
    dimension = COLUMN_ROLES[role]
    unit = column.unit or (parts["unit"] if parts else "") or stated or SI_UNITS[dimension]
    gain, bias = si_factor(unit, dimension, f"{where}: {role} ({printable(column.column)})")
    return gain * column.scale, gain * column.offset + bias


def missing_channels(found: Mapping[str, Column], present: Sequence[str]) -> str:
    """Say which channels a file lacks, and what it has; empty where all are there."""
    lacking = [role for role in NEEDED_COLUMN_ROLES if role not in found]
    if not lacking:
        return ""
    return (
        f"no column for {', '.join(lacking)}: name it by --column ROLE=NAME:UNIT or in a mapping"
        f" file ({COLUMNS_SCHEMA}); {_column_list(present)}"
    )


def _column_list(present: Sequence[str]) -> str:
    listed = ", ".join(printable(name) for name in present[:MAX_LISTED_COLUMNS])
    return f"the file has {listed}" + (" …" if len(present) > MAX_LISTED_COLUMNS else "")


def load_columns(path: Path | str) -> ColumnMap:
    """Read a mapping file of columns.

    path: file to read. Returns the columns. InputOutputError: the file cannot be read;
    ConfigurationError: not such a file, or a unit that is none.
    """
    tree = read_toml(Path(path), _ColumnsFile, "mapping file")
    found = {} if tree.time is None else {TIME_ROLE: tree.time}
    for section in ("channels", "command", "environment"):
        signals = getattr(tree, section)
        for key in signals.__struct_fields__:
            if (item := getattr(signals, key)) is not None:
                found[f"{section}.{key}"] = item
    for role, item in found.items():
        column_unit(item, "", role, f"mapping file {path}")
    return ColumnMap(found, round(tree.tick_ms * 1e6))


def named_columns(options: Sequence[str], known: ColumnMap) -> ColumnMap:
    """Add columns named on the command line, `ROLE=NAME` or `ROLE=NAME:UNIT`.

    options: as typed; known: those of a mapping file. Returns both; the options win.
    ConfigurationError: not of that form, an unknown role, a unit that is none.
    """
    found = dict(known.columns)
    for text in options:
        short, separator, rest = text.partition("=")
        role = SHORT_COLUMN_NAMES.get(short, short)
        if not separator or not rest or role not in COLUMN_ROLES:
            raise ConfigurationError(
                f"--column {printable(text)}: need ROLE=NAME or ROLE=NAME:UNIT, ROLE one of"
                f" {', '.join(SHORT_COLUMN_NAMES)}"
            )
        name, colon, unit = rest.rpartition(":")
        found[role] = Column(name, unit) if colon and name else Column(rest)
        column_unit(found[role], "", role, f"--column {printable(text)}")
    return ColumnMap(found, known.tick_ns)
