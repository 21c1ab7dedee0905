"""Takes apart a command line that names several actuators on one bus: a mapping each."""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from ehadiag.core.errors import ConfigurationError

__all__ = ["Unit", "add_unit_options", "units_of"]


@dataclass(frozen=True, slots=True)
class Unit:
    """One of the actuators that a command line names."""

    arguments: argparse.Namespace
    """As if it were the only one."""
    label: str
    """Name of its mapping, which tells its results from the others'; empty of the only one."""


def add_unit_options(parser: argparse.ArgumentParser) -> None:
    """Add `--actuator`, `--mapping` and `--dbc`, the first two once for each actuator."""
    parser.add_argument(
        "--actuator",
        action="append",
        default=[],
        metavar="FILE",
        help="actuator data, TOML (default: the reference actuator); with several --mapping one"
        " for all of them, or one for each",
    )
    parser.add_argument(
        "--mapping",
        action="append",
        default=[],
        metavar="FILE",
        help="which signals of a DBC are which channels, TOML (default: the FCC's own bus); once"
        " for each actuator on the bus, and each is diagnosed",
    )
    parser.add_argument(
        "--dbc",
        metavar="FILE",
        help="DBC to use instead of the mapping's own, or one of the default names",
    )


def units_of(arguments: argparse.Namespace) -> list[Unit]:
    """Return the command line of each actuator.

    Parameters
    ----------
    arguments : argparse.Namespace
        The parsed command line, of a command with `add_unit_options`.

    Returns
    -------
    list[Unit]
        At least one, in the order of the mappings; the namespaces hold one file's name each, or
        None.

    Raises
    ------
    ConfigurationError
        A mapping named twice, actuators that do not pair with the mappings, one DBC for several.
    """
    mappings: list[str | None] = [*arguments.mapping] or [None]
    actuators: list[str | None] = [*arguments.actuator] or [None]
    if len(actuators) == 1:
        actuators *= len(mappings)
    if len(actuators) != len(mappings):
        raise ConfigurationError(
            f"--actuator named {len(actuators)} times, --mapping {len(mappings)} times: name one"
            " actuator for all, or one for each mapping, in the same order"
        )
    twice = [name for name, count in Counter(mappings).items() if count > 1]
    if twice:
        raise ConfigurationError(f"--mapping {twice[0]}: named twice")
    if len(mappings) > 1 and arguments.dbc:
        raise ConfigurationError("--dbc: with several --mapping each names its own DBC")
    return [
        Unit(argparse.Namespace(**{**vars(arguments), "mapping": mapping, "actuator": actuator}),
             label)
        for mapping, actuator, label in zip(mappings, actuators, _labels(mappings), strict=True)
    ]  # fmt: skip


def _labels(mappings: list[str | None]) -> list[str]:
    """Short names of the mappings: of two alike the folders too."""
    if len(mappings) == 1:
        return [""]
    names = [str(name) for name in mappings]
    stems = [Path(name).stem for name in names]
    if len(set(stems)) == len(stems):
        return stems
    return [str(Path(name).with_suffix("")) for name in names]
