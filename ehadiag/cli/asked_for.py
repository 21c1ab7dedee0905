"""Makes what the options of a command line ask for: actuator, bus map, tests, limits of reading."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ehadiag.assess.verdict import Levels, Rule
from ehadiag.core.actuator import Actuator, with_tolerance
from ehadiag.core.errors import ConfigurationError
from ehadiag.core.find_test import Sought
from ehadiag.core.fingerprint import fingerprint
from ehadiag.core.stored_test import StoredTest
from ehadiag.facade import inputs
from ehadiag.report.asked import Asked

if TYPE_CHECKING:
    from firmware_iface.logs.budget import Budget
    from firmware_iface.mapping.bus_map import BusMap
    from firmware_iface.signals.columns import ColumnMap

__all__ = [
    "known_tests",
    "the_actuator",
    "the_asked",
    "the_budget",
    "the_bus_map",
    "the_columns",
    "the_sought",
]


def the_actuator(arguments: argparse.Namespace) -> Actuator:
    """Return the actuator that was asked for."""
    found = inputs.the_actuator(arguments.actuator or None)
    tolerance = getattr(arguments, "tolerance", None)
    return found if tolerance is None else with_tolerance(found, tolerance)


def the_bus_map(arguments: argparse.Namespace) -> BusMap:
    """Return the meaning of the bus's frames."""
    if arguments.mapping and _maps_columns(arguments):
        found = inputs.the_bus_map(None, None)
    else:
        found = inputs.the_bus_map(arguments.mapping or None, arguments.dbc or None)
    channel = getattr(arguments, "log_channel", None)
    return found if channel is None else replace(found, channel=channel)


def the_columns(arguments: argparse.Namespace) -> ColumnMap | None:
    """Return the meaning of the columns of decoded signals; None where none are named."""
    from firmware_iface.signals.columns import (  # noqa: PLC0415
        ColumnMap,
        load_columns,
        named_columns,
    )

    known = load_columns(arguments.mapping) if _maps_columns(arguments) else None
    if known is None and not arguments.column:
        return None
    return named_columns(arguments.column, known or ColumnMap())


def _maps_columns(arguments: argparse.Namespace) -> bool:
    """Whether the mapping file is one of columns."""
    if not arguments.mapping or not hasattr(arguments, "column"):
        return False
    from ehadiag.core.small_file import read_small_file  # noqa: PLC0415
    from ehadiag.core.toml_file import MAX_BYTES  # noqa: PLC0415
    from firmware_iface.signals.columns import SCHEMA  # noqa: PLC0415

    text = read_small_file(Path(arguments.mapping), MAX_BYTES, "mapping file")
    return f'"{SCHEMA}"'.encode() in text


def the_budget(arguments: argparse.Namespace) -> Budget:
    """Return what reading a recording may cost."""
    from firmware_iface.logs.budget import Budget  # noqa: PLC0415

    return Budget(
        frames=arguments.max_frames,
        size=round(arguments.max_log_size * (1 << 20)),
        seconds=arguments.max_read_time,
    )


def the_asked(arguments: argparse.Namespace, bus_map: BusMap, tests: Sequence[StoredTest]) -> Asked:
    """Return the options of a diagnosis, for its JSON result.

    tests: that a recording may be of; the one that stands for all the others comes first.
    """
    columns = the_columns(arguments) if hasattr(arguments, "column") else None
    return Asked(
        solver=arguments.solver,
        seed=arguments.seed,
        levels=Levels(arguments.advisory, arguments.limit, Rule(arguments.rule)),
        nuisances=arguments.nuisances,
        time_limit_s=arguments.time_limit,
        every=getattr(arguments, "all", False),
        mapping=bus_map.name,
        mapping_sha256=fingerprint(bus_map),
        mapping_file=arguments.mapping or None,
        tests_sha256=fingerprint(tuple(tests)),
        columns_sha256=None if columns is None else fingerprint(columns),
        start_s=getattr(arguments, "start", None),
        end_s=getattr(arguments, "end", None),
    )


def the_sought(
    arguments: argparse.Namespace, tests: Sequence[StoredTest], actuator: Actuator
) -> Sought:
    """Return what to look for in a recording whose bus does not say when which test ran."""
    start, end = arguments.start, arguments.end
    if start is not None and end is not None and end <= start:
        raise ConfigurationError(f"--end {end:g}: not after --start {start:g}")
    return Sought(tuple(tests), actuator.controller, start, end)


def known_tests(names: list[str]) -> tuple[StoredTest, ...]:
    """Return the bundled tests and the named ones; of one number the one named last."""
    return inputs.the_tests(names)
