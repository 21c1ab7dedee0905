"""Defaults of options: from `ehadiag.toml` of project and user, and from `EHADIAG_*` variables.

An option on the command line wins over its variable, that over the project's file (in the working
folder), that over the user's. A project's file may come from others: it sets only what cannot
reach beyond a diagnosis (`PROJECT`), must belong to the caller or root, and is named when it is
used. Of a command that can transmit it names neither test nor bus: nobody shall move a surface by
entering a folder. The user's own may set every option that has a value.
"""

from __future__ import annotations

import argparse
import os
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ehadiag.cli.option_keys import Called, key_of, keys_of
from ehadiag.core.errors import ConfigurationError, reason_of
from ehadiag.core.folder import refuse_foreign
from ehadiag.core.toml_file import read_toml

__all__ = ["NAME", "PREFIX", "Defaults", "apply_defaults", "user_file"]

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
LISTENING = frozenset({"check-bus", "monitor"})
"""Commands with a bus that send nothing on it."""
SENT = frozenset(
    {"test", "interface", "channel", "bitrate", "fd", "data_bitrate", "app_name"}
)  # fmt: skip
"""What says of the other commands with a bus which test runs, and where."""
NAMING = frozenset({"actuator", "mapping", "dbc", "test"})
"""Options whose values are files."""
RESERVED = frozenset({"CACHE_DIR", "THREADS", "HISTORY"})
"""Variables of `EHADIAG_` that are no options."""


class Defaults(NamedTuple):
    """What defaults did."""

    used: tuple[str, ...]
    """Files and variables that set something."""
    ignored: tuple[str, ...]
    """Sentences on what was not taken."""


def user_file() -> Path | None:
    """Return where the user's own defaults are: in the folder of the system for configuration."""
    if not (os.environ.get("HOME") or os.environ.get("APPDATA")):
        return None
    import platformdirs  # noqa: PLC0415

    return Path(platformdirs.user_config_dir("ehadiag", appauthor=False)) / NAME


def apply_defaults(
    commands: Mapping[str, argparse.ArgumentParser], given: Sequence[str]
) -> Defaults:
    """Set the defaults of the options of the command that is called.

    A file has keys for all commands at its top, and for one in a table of its name:
    `actuator = "left.toml"`, `[diagnose]`, `jobs = 2`. A key is an option's name with `_` or `-`;
    the options of a command's verbs are its own.

    Parameters
    ----------
    commands : Mapping[str, argparse.ArgumentParser]
        All commands by name; what was a required option is none where it has a default now.
    given : Sequence[str]
        The command line.

    Returns
    -------
    Defaults
        What was used, and what was not.

    Raises
    ------
    ConfigurationError
        A key or a value that no option has, a file that others may write to.
    InputOutputError
        A file cannot be read.
    """
    command = next((item for item in given if not item.startswith("-")), "")
    if command not in commands:
        return Defaults((), ())
    chosen = Called(commands[command], given)
    known = {name: keys_of(parser) for name, parser in commands.items()}
    used: list[str] = []
    ignored: list[str] = []
    for path, of_project in ((user_file(), False), (Path(NAME), True)):
        if path is None or not os.path.lexists(path):
            continue
        where = f"defaults {path}"
        _refuse_others(path, where)
        tree = read_toml(path, dict[str, Any], "defaults")
        _refuse_unknown(tree, known, where)
        values = _of_command(tree, command)
        if of_project:
            _refuse_what_is_not_for_projects(values, where)
            if "interface" in known[command] and command not in LISTENING:
                if sent := sorted(SENT & values.keys() & known[command]):
                    ignored.append(
                        f"{where}: {', '.join(sent)} ignored: {command} can transmit, and takes"
                        " test and bus from no project's file; name them on the command line, in"
                        f" {user_file()} or by {PREFIX}…"
                    )
                values = {key: value for key, value in values.items() if key not in SENT}
        for key, value in values.items():
            chosen.set(key, _beside(path, key, value), where)
        if any(key in known[command] for key in values):
            used.append(str(path))
    everywhere = set().union(*known.values())
    for name, text in _variables():
        key = name[len(PREFIX) :].lower()
        if chosen.set(key, text, f"variable {name}"):
            used.append(name)
        elif key not in everywhere:
            near = _near(key, everywhere)
            hint = f"; {PREFIX}{near.upper()}?" if near else ""
            ignored.append(f"variable {name}: there is no option --{_spelt(key)}{hint}")
    return Defaults(tuple(used), tuple(ignored))


def _spelt(key: str) -> str:
    return key.replace("_", "-")


def _near(word: str, known: Iterable[str]) -> str | None:
    from difflib import get_close_matches  # noqa: PLC0415 - only for what nobody knows

    return next(iter(get_close_matches(word, sorted(known), n=1)), None)


def _refuse_unknown(tree: Mapping[str, Any], known: Mapping[str, set[str]], where: str) -> None:
    """Refuse the first key that no option has, the first table that no command has."""
    everywhere = set().union(*known.values())
    for name, value in tree.items():
        if isinstance(value, dict):
            if name not in known:
                raise _unknown(where, f"[{name}]", "command", _near(name, known), "[{}]")
            for key in value:
                if key_of(key) not in known[name]:
                    near = _near(key_of(key), known[name])
                    raise _unknown(where, f"[{name}] {key}", f"option of {name}", near, "{}")
        elif key_of(name) not in everywhere:
            if name in known:
                raise ConfigurationError(f"{where}: {name} is a command, need a table [{name}]")
            near = _near(key_of(name), everywhere)
            raise _unknown(where, name, "option of any command", near, "{}")


def _unknown(
    where: str, what: str, kind: str, near: str | None, spelling: str
) -> ConfigurationError:
    hint = f", did you mean {spelling.format(near)}?" if near else ""
    return ConfigurationError(f"{where}: {what} is no {kind}{hint}")


def _refuse_what_is_not_for_projects(values: Mapping[str, Any], where: str) -> None:
    for key in values:
        if key not in PROJECT:
            raise ConfigurationError(
                f"{where}: {key} is not for a project's file; set it in {user_file()}, by"
                f" {PREFIX}{key.upper()}, or on the command line"
            )


def _variables() -> Iterator[tuple[str, str]]:
    for name, text in sorted(os.environ.items()):
        if name.startswith(PREFIX) and name[len(PREFIX) :] not in RESERVED and text:
            yield name, text


def _of_command(tree: Mapping[str, Any], command: str) -> dict[str, Any]:
    """What a file sets for a command: what it sets for all, then what for this one."""
    common = {key: value for key, value in tree.items() if not isinstance(value, dict)}
    own = tree.get(command)  # some commands are called like options
    own = own if isinstance(own, dict) else {}
    return {key_of(key): value for key, value in (common | own).items()}


def _beside(path: Path, key: str, value: Any) -> Any:
    """Take a file that defaults name from their own folder, if it is there."""
    if key not in NAMING or os.path.isabs(str(value)):
        return value
    if isinstance(value, list):
        return [_beside(path, key, item) for item in value]
    there = path.parent / str(value)
    return str(there) if there.exists() else value


def _refuse_others(path: Path, where: str) -> None:
    """Refuse a file that others may have written: it could change a verdict."""
    try:
        info = path.stat()
        if hasattr(os, "getuid") and info.st_uid == 0 and not info.st_mode & stat.S_IWOTH:
            return
        refuse_foreign(info, stat.S_ISREG)
    except OSError as error:
        raise ConfigurationError(f"{where}: {reason_of(error)}") from None
