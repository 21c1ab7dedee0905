"""Parser of every command, and the defaults of its options.

The parser has a short help and a long one, and its errors say what was meant. Defaults come from
`ehadiag.toml` of project and user, and from `EHADIAG_*` variables: an option on the command line
wins over its variable, that over the project's file (in the working folder), that over the user's.
A project's file may come from others: it sets only what cannot reach beyond a diagnosis
(`project_keys`), must belong to the caller or root, and is named when it is used. Of a command that
can transmit it names neither test nor bus: nobody shall move a surface by entering a folder. The
user's own may set every option that has a value.
"""

from __future__ import annotations

import argparse
import os
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from firmware_iface.errors import ConfigurationError, printable, reason_of

FORMER_OPTIONS = {
    "--serial": "--port URL for a serial port, --unit N for the unit",
    "--serial-number": "--unit N",
}
"""Options of earlier versions, with what is given instead."""


def closest_name(word: str, known: Iterable[str]) -> str | None:
    """Return the known name that a misspelt one is most like; None where it is like none."""
    from difflib import get_close_matches  # noqa: PLC0415 - not where nothing is misspelt

    return next(iter(get_close_matches(word, sorted(known), n=1)), None)


class CommandParser(argparse.ArgumentParser):
    """Says what is wrong in one line, and where to read on; its help shows the usual options."""

    usual: Sequence[str] = ()
    """Options, or positional arguments, that the short help shows; none: it shows all."""
    examples: Sequence[str] = ()
    """Command lines at the end of the help."""

    def error(self, message: str) -> NoReturn:
        """End with exit code 2 and one line."""
        command = self.prog.partition(" ")[2]
        where = f"{command}: " if command else ""
        self.exit(2, f"ehadiag: {where}{printable(message)}; see {self.prog} --help\n")

    def refuse_unknown(self, words: Sequence[str]) -> NoReturn:
        """End for options that the command does not have; name the one most alike."""
        known = [name for action in self._actions for name in action.option_strings]
        texts = []
        for word in words:
            name = word.split("=", 1)[0]
            near = closest_name(name, known) if name.startswith("-") else None
            texts.append(word + (f" (did you mean {near}?)" if near else ""))
        self.error(f"unrecognized arguments: {' '.join(texts)}")

    def format_help(self) -> str:
        """Return the help: of the usual options only, where the command names them."""
        examples = "".join(f"  {line}\n" for line in self.examples)
        if not self.usual:
            return super().format_help() + (f"\nexamples:\n{examples}" if examples else "")
        formatter = self._get_formatter()
        named = {
            name: item for item in self._actions for name in item.option_strings or [item.dest]
        }
        chosen = [named[name] for name in self.usual]
        shown = [item for item in chosen if item.required or not item.option_strings]
        formatter.add_usage(None, shown, (), f"usage: {self.prog} [options] ")
        formatter.add_text(self.description)
        formatter.start_section("most used")
        formatter.add_arguments(chosen)
        formatter.end_section()
        rest = sum(item.help is not argparse.SUPPRESS for item in self._actions) - len(chosen)
        text = formatter.format_help().replace(f"[options] {self.prog}", "[options]", 1)
        more = f"\n{self.prog} --help-all shows {rest} more options.\n"
        return f"{text}\nexamples:\n{examples}{more}"

    def format_full_help(self) -> str:
        """Return the help of all options."""
        return super().format_help()

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if isinstance(action, argparse._SubParsersAction) and value not in action.choices:
            near = closest_name(str(value), action.choices)
            hint = f", did you mean {near}?" if near else ""
            raise argparse.ArgumentError(None, f"there is no command {value!r}{hint}")
        super()._check_value(action, value)


class FullHelpAction(argparse.Action):
    """Print the help of all options, and end."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        """Print and end."""
        assert isinstance(parser, CommandParser)
        print(parser.format_full_help(), end="")
        parser.exit()


def show_help(parser: argparse.ArgumentParser, *examples: str, usual: str = "") -> None:
    """Let `--help` end with examples, and show only the usual options, if any: words of a text."""
    assert isinstance(parser, CommandParser)
    parser.usual, parser.examples = usual.split(), examples
    if usual:
        parser.add_argument(
            "--help-all", action=FullHelpAction, nargs=0, help="show all options and exit"
        )


def refuse_former_options(parser: argparse.ArgumentParser, given: Sequence[str]) -> None:
    """End where an option of an earlier version is given; the error names the new ones."""
    for word in given:
        name = word.split("=", 1)[0]
        if name in FORMER_OPTIONS:
            parser.error(f"{name} has another name now: {FORMER_OPTIONS[name]}")


BOOLEAN_TEXTS = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}


class _ReplaceableDefault(list[Any]):
    """Default of an option that may be repeated: gone with the first that the user gives."""

    def __copy__(self) -> list[Any]:
        return []


def option_key(name: str) -> str:
    """Key of an option, or of what a file calls so: with `_` for `-`, in lower case."""
    return name.replace("-", "_").lower()


def option_keys(parser: argparse.ArgumentParser) -> set[str]:
    """Keys that a command or one of its verbs knows."""
    found = set(_options_by_key(parser))
    for verbs in _verbs(parser):
        found.update(key for verb in verbs.values() for key in _options_by_key(verb))
    return found


class CalledOptions:
    """The options of the command that is called, and of its verb where it has verbs.

    parser: of the command; given: the command line: where one of several options that exclude each
    other is given, none of them has a default.
    """

    def __init__(self, parser: argparse.ArgumentParser, given: Sequence[str]) -> None:
        self._given = given
        self._parsers = [parser]
        for verbs in _verbs(parser):
            verb = next((item for item in given if item in verbs), None)
            if verb is not None:
                self._parsers.append(verbs[verb])

    def set(self, key: str, value: Any, where: str) -> bool:
        """Set a default; False where no option is called so.

        value: as a file or a variable has it; where: which file or variable, for errors.
        ConfigurationError: the option takes no such value.
        """
        done = False
        for parser in self._parsers:
            action = _options_by_key(parser).get(key)
            # What the command has already, its verb only hands on.
            if action is None or (done and action.default is argparse.SUPPRESS):
                continue
            self._set(parser, action, value, where)
            done = True
        return done

    def _set(
        self, parser: argparse.ArgumentParser, action: argparse.Action, value: Any, where: str
    ) -> None:
        at = f"{where}: {action.option_strings[-1]}"
        checked = _checked_value(action, value, at)
        for group in parser._mutually_exclusive_groups:
            if action not in group._group_actions:
                continue
            flags = [flag for other in group._group_actions for flag in other.option_strings]
            if any(item.split("=", 1)[0] in flags for item in self._given):
                return  # the command line has chosen among them
            if checked is not False:  # one of them, as on the command line; the nearer wins
                for other in group._group_actions:
                    parser.set_defaults(**{other.dest: False if other.nargs == 0 else None})
                group.required = False
        parser.set_defaults(**{action.dest: checked})
        action.required = False


def _verbs(parser: argparse.ArgumentParser) -> Iterator[Mapping[str, argparse.ArgumentParser]]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            yield action.choices


def _options_by_key(parser: argparse.ArgumentParser) -> dict[str, argparse.Action]:
    """Options by the keys that set them."""
    return {
        option_key(name[2:]): action
        for action in parser._actions
        for name in action.option_strings
        if name.startswith("--") and name != "--help"
    }


def _checked_value(action: argparse.Action, value: Any, at: str) -> Any:
    """Read a value as the command line does."""
    if action.nargs == 0:
        flag = BOOLEAN_TEXTS.get(str(value).lower())
        if flag is None:
            raise ConfigurationError(f"{at}: need true or false, not {value!r}")
        return flag
    if isinstance(value, list) or isinstance(action, argparse._AppendAction):
        items = value if isinstance(value, list) else [value]
        many = [_single_value(action, item, at) for item in items]
        return _ReplaceableDefault(many) if isinstance(action, argparse._AppendAction) else many
    return _single_value(action, value, at)


def _single_value(action: argparse.Action, value: Any, at: str) -> Any:
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


DEFAULTS_FILE_NAME = "ehadiag.toml"
VARIABLE_PREFIX = "EHADIAG_"
PROJECT_KEYS = frozenset(
    {
        "json", "no_picture", "jobs", "interface", "channel", "context", "bitrate", "fd",
        "data_bitrate", "app_name",
    }
)  # fmt: skip
"""Options that a project's file may set beside those of a request."""
LISTENING_COMMANDS = frozenset({"check-bus", "monitor"})
"""Commands with a bus that send nothing on it."""
TRANSMISSION_KEYS = frozenset(
    {"test", "interface", "channel", "bitrate", "fd", "data_bitrate", "app_name"}
)  # fmt: skip
"""What says of the other commands with a bus which test runs, and where."""
RESERVED_VARIABLES = frozenset({"CACHE_DIR", "THREADS", "HISTORY"})
"""Variables of `EHADIAG_` that are no options."""


@cache
def project_keys() -> frozenset[str]:
    """Options that a project's file may set."""
    from ehadiag.request import request_options  # noqa: PLC0415 - not for the help of all commands

    options = request_options().values()
    return PROJECT_KEYS.union(option_key(item.flag[2:]) for item in options if item.project)


@cache
def file_keys() -> frozenset[str]:
    """Options whose values are files."""
    from ehadiag.request import request_options  # noqa: PLC0415 - not for the help of all commands

    return frozenset(option_key(item.flag[2:]) for item in request_options().values() if item.file)


class AppliedDefaults(NamedTuple):
    """What defaults did."""

    used: tuple[str, ...]
    """Files and variables that set something."""
    ignored: tuple[str, ...]
    """Sentences on what was not taken."""


def user_defaults_file() -> Path | None:
    """Return where the user's own defaults are: in the folder of the system for configuration."""
    if not (os.environ.get("HOME") or os.environ.get("APPDATA")):
        return None
    import platformdirs  # noqa: PLC0415

    return Path(platformdirs.user_config_dir("ehadiag", appauthor=False)) / DEFAULTS_FILE_NAME


def apply_defaults(
    command: str,
    parser: argparse.ArgumentParser,
    given: Sequence[str],
    commands: Callable[[], Mapping[str, argparse.ArgumentParser]],
) -> AppliedDefaults:
    """Set the defaults of the options of the command that is called.

    A file has keys for all commands at its top, and for one in a table of its name:
    `actuator = "left.toml"`, `[diagnose]`, `jobs = 2`. A key is an option's name with `_` or `-`;
    the options of a command's verbs are its own.

    parser: its own, in which a required option is none where it has a default now; given: the
    command line; commands: makes the parsers of all. ConfigurationError: a key or a value that no
    option has, a file that others may write to; InputOutputError: a file cannot be read.
    """
    files = [
        (path, of_project)
        for path, of_project in ((user_defaults_file(), False), (Path(DEFAULTS_FILE_NAME), True))
        if path is not None and os.path.lexists(path)
    ]
    variables = list(_variables())
    if not files and not variables:
        return AppliedDefaults((), ())
    from firmware_iface.files import read_toml  # noqa: PLC0415 - not for help texts

    chosen = CalledOptions(parser, given)
    known = {name: option_keys(item) for name, item in commands().items()}
    used: list[str] = []
    ignored: list[str] = []
    for path, of_project in files:
        where = f"defaults {path}"
        _refuse_foreign_file(path, where)
        tree = read_toml(path, dict[str, Any], "defaults")
        _refuse_unknown_keys(tree, known, where)
        values = _values_of_command(tree, command)
        if of_project:
            _refuse_user_keys(values, where)
            if "interface" in known[command] and command not in LISTENING_COMMANDS:
                if sent := sorted(TRANSMISSION_KEYS & values.keys() & known[command]):
                    ignored.append(
                        f"{where}: {', '.join(sent)} ignored: {command} can transmit, and takes"
                        " test and bus from no project's file; name them on the command line, in"
                        f" {user_defaults_file()} or by {VARIABLE_PREFIX}…"
                    )
                values = {
                    key: value for key, value in values.items() if key not in TRANSMISSION_KEYS
                }
        for key, value in values.items():
            chosen.set(key, _relative_to_file(path, key, value), where)
        if any(key in known[command] for key in values):
            used.append(str(path))
    everywhere = set().union(*known.values())
    for name, text in variables:
        key = name[len(VARIABLE_PREFIX) :].lower()
        if chosen.set(key, text, f"variable {name}"):
            used.append(name)
        elif key not in everywhere:
            near = closest_name(key, everywhere)
            hint = f"; {VARIABLE_PREFIX}{near.upper()}?" if near else ""
            option = key.replace("_", "-")
            ignored.append(f"variable {name}: there is no option --{option}{hint}")
    return AppliedDefaults(tuple(used), tuple(ignored))


def _refuse_unknown_keys(
    tree: Mapping[str, Any], known: Mapping[str, set[str]], where: str
) -> None:
    """Refuse the first key that no option has, the first table that no command has."""
    everywhere = set().union(*known.values())
    for name, value in tree.items():
        if isinstance(value, dict):
            if name not in known:
                raise _unknown_key_error(
                    where, f"[{name}]", "command", closest_name(name, known), "[{}]"
                )
            for key in value:
                if option_key(key) not in known[name]:
                    near = closest_name(option_key(key), known[name])
                    raise _unknown_key_error(
                        where, f"[{name}] {key}", f"option of {name}", near, "{}"
                    )
        elif option_key(name) not in everywhere:
            if name in known:
                raise ConfigurationError(f"{where}: {name} is a command, need a table [{name}]")
            near = closest_name(option_key(name), everywhere)
            raise _unknown_key_error(where, name, "option of any command", near, "{}")


def _unknown_key_error(
    where: str, what: str, kind: str, near: str | None, spelling: str
) -> ConfigurationError:
    hint = f", did you mean {spelling.format(near)}?" if near else ""
    return ConfigurationError(f"{where}: {what} is no {kind}{hint}")


def _refuse_user_keys(values: Mapping[str, Any], where: str) -> None:
    for key in values:
        if key not in project_keys():
            raise ConfigurationError(
                f"{where}: {key} is not for a project's file; set it in {user_defaults_file()}, by"
                f" {VARIABLE_PREFIX}{key.upper()}, or on the command line"
            )


def _variables() -> Iterator[tuple[str, str]]:
    for name, text in sorted(os.environ.items()):
        if (
            name.startswith(VARIABLE_PREFIX)
            and name[len(VARIABLE_PREFIX) :] not in RESERVED_VARIABLES
            and text
        ):
            yield name, text


def _values_of_command(tree: Mapping[str, Any], command: str) -> dict[str, Any]:
    """What a file sets for a command: what it sets for all, then what for this one."""
    common = {key: value for key, value in tree.items() if not isinstance(value, dict)}
    own = tree.get(command)  # some commands are called like options
    own = own if isinstance(own, dict) else {}
    return {option_key(key): value for key, value in (common | own).items()}


def _relative_to_file(path: Path, key: str, value: Any) -> Any:
    """Take a file that defaults name from their own folder, if it is there."""
    if key not in file_keys() or os.path.isabs(str(value)):
        return value
    if isinstance(value, list):
        return [_relative_to_file(path, key, item) for item in value]
    there = path.parent / str(value)
    return str(there) if there.exists() else value


def _refuse_foreign_file(path: Path, where: str) -> None:
    """Refuse a file that others may have written: it could change a verdict."""
    from firmware_iface.files import refuse_foreign  # noqa: PLC0415 - not for help texts

    try:
        info = path.stat()
        if hasattr(os, "getuid") and info.st_uid == 0 and not info.st_mode & stat.S_IWOTH:
            return
        refuse_foreign(info, stat.S_ISREG)
    except OSError as error:
        raise ConfigurationError(f"{where}: {reason_of(error)}") from None
