"""Defaults of options: from `ehadiag.toml` of project and user, and from `EHADIAG_*` variables.

An option on the command line wins over its variable, that over the project's file (in the working
folder), that over the user's. A project's file may come from others: it sets only what cannot
reach beyond a diagnosis (`PROJECT`), must belong to the caller or root, and is named when it is
used. The user's own may set every option that has a value.
"""

from __future__ import annotations

import argparse
import os
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ehadiag.core.errors import ConfigurationError
from ehadiag.core.folder import refuse_foreign
from ehadiag.core.toml_file import read_toml

__all__ = ["NAME", "PREFIX", "apply_defaults", "user_file"]

NAME = "ehadiag.toml"
PREFIX = "EHADIAG_"
PROJECT = frozenset(
    {
        "actuator", "mapping", "dbc", "test", "log_channel", "solver", "nuisances", "seed",
        "advisory", "limit", "rule", "json", "json_version", "no_picture", "jobs", "interface",
        "channel", "context", "bitrate", "fd", "data_bitrate", "app_name",
    }
)  # fmt: skip
"""Options that a project's file may set."""
NAMING = frozenset({"actuator", "mapping", "dbc", "test"})
"""Options whose values are files."""
RESERVED = frozenset({"CACHE_DIR", "THREADS", "HISTORY"})
"""Variables of `EHADIAG_` that are no options."""
BOOLEANS = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}


class _Replaced(list[Any]):
    """Default of an option that may be repeated: gone with the first that the user gives."""

    def __copy__(self) -> list[Any]:
        return []


def user_file() -> Path | None:
    """Return where the user's own defaults are: in the folder of the system for configuration."""
    if not (os.environ.get("HOME") or os.environ.get("APPDATA")):
        return None
    import platformdirs  # noqa: PLC0415

    return Path(platformdirs.user_config_dir("ehadiag", appauthor=False)) / NAME


def apply_defaults(parser: argparse.ArgumentParser, command: str) -> list[str]:
    """Set the defaults of a command's options.

    A file has keys for all commands at its top, and for one in a table of its name:
    `actuator = "left.toml"`, `[diagnose]`, `jobs = 2`. A key is an option's name with `_` or `-`.

    Parameters
    ----------
    parser : argparse.ArgumentParser
        Of the command; what was a required option is none where it has a default now.
    command : str
        Its name.

    Returns
    -------
    list[str]
        Files and variables that set something.

    Raises
    ------
    ConfigurationError
        A key or a value that no option has, a file that others may write to.
    InputOutputError
        A file cannot be read.
    """
    actions = _options(parser)
    used: list[str] = []
    for path, allowed in ((user_file(), None), (Path(NAME), PROJECT)):
        if path is None or not os.path.lexists(path):
            continue
        where = f"defaults {path}"
        _refuse_others(path, where)
        tree = read_toml(path, dict[str, Any], "defaults")
        values = _of_command(tree, command, where)
        for key, value in values.items():
            if allowed is not None and key not in allowed:
                raise ConfigurationError(
                    f"{where}: {key} is not for a project's file; set it in {user_file()}, by"
                    f" {PREFIX}{key.upper()}, or on the command line"
                )
            if key in actions:
                _set(parser, actions[key], _beside(path, key, value), where)
        if any(key in actions for key in values):
            used.append(str(path))
    for name, text in _variables():
        key = name[len(PREFIX) :].lower()
        if key in actions:
            _set(parser, actions[key], text, f"variable {name}")
            used.append(name)
    return used


def _options(parser: argparse.ArgumentParser) -> dict[str, argparse.Action]:
    """Options by the keys that set them."""
    return {
        name[2:].replace("-", "_").lower(): action
        for action in parser._actions
        for name in action.option_strings
        if name.startswith("--") and name != "--help"
    }


def _variables() -> Iterator[tuple[str, str]]:
    for name, text in sorted(os.environ.items()):
        if name.startswith(PREFIX) and name[len(PREFIX) :] not in RESERVED and text:
            yield name, text


def _of_command(tree: Mapping[str, Any], command: str, where: str) -> dict[str, Any]:
    """What a file sets for a command: what it sets for all, then what for this one."""
    common = {key: value for key, value in tree.items() if not isinstance(value, dict)}
    own = tree.get(command, {})
    if not isinstance(own, dict):
        raise ConfigurationError(f"{where}: {command} is a command, need a table [{command}]")
    return {key.replace("-", "_").lower(): value for key, value in (common | own).items()}


def _beside(path: Path, key: str, value: Any) -> Any:
    """Take a file that defaults name from their own folder, if it is there."""
    if key not in NAMING or os.path.isabs(str(value)):
        return value
    if isinstance(value, list):
        return [_beside(path, key, item) for item in value]
    there = path.parent / str(value)
    return str(there) if there.exists() else value


def _set(parser: argparse.ArgumentParser, action: argparse.Action, value: Any, where: str) -> None:
    key = action.option_strings[-1]
    checked = _checked(action, value, f"{where}: {key}")
    parser.set_defaults(**{action.dest: checked})
    action.required = False


def _checked(action: argparse.Action, value: Any, at: str) -> Any:
    """Read a value as the command line does."""
    if action.nargs == 0:
        flag = BOOLEANS.get(str(value).lower())
        if flag is None:
            raise ConfigurationError(f"{at}: need true or false, not {value!r}")
        return flag
    if isinstance(value, list) or isinstance(action, argparse._AppendAction):
        items = value if isinstance(value, list) else [value]
        many = [_single(action, item, at) for item in items]
        return _Replaced(many) if isinstance(action, argparse._AppendAction) else many
    return _single(action, value, at)


def _single(action: argparse.Action, value: Any, at: str) -> Any:
    if isinstance(value, dict | list | bool):
        raise ConfigurationError(f"{at}: need one text or number, not {value!r}")
    kind = action.type if callable(action.type) else str
    try:
        read = kind(str(value))
    except (ValueError, argparse.ArgumentTypeError) as error:
        raise ConfigurationError(f"{at}: {error}") from None
    if action.choices is not None and read not in action.choices:
        choice = ", ".join(map(str, action.choices))
        raise ConfigurationError(f"{at}: {read!r} is none of {choice}")
    return read


def _refuse_others(path: Path, where: str) -> None:
    """Refuse a file that others may have written: it could change a verdict."""
    try:
        info = path.stat()
        if hasattr(os, "getuid") and info.st_uid == 0 and not info.st_mode & stat.S_IWOTH:
            return
        refuse_foreign(info, stat.S_ISREG)
    except OSError as error:
        raise ConfigurationError(f"{where}: {error.strerror or error}") from None
