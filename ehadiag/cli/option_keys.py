"""Options of a command by the keys that defaults have for them, and setting a default."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ehadiag.core.errors import ConfigurationError

__all__ = ["Called", "key_of", "keys_of"]

BOOLEANS = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}


class _Replaced(list[Any]):
    """Default of an option that may be repeated: gone with the first that the user gives."""

    def __copy__(self) -> list[Any]:
        return []


def key_of(name: str) -> str:
    """Key of an option, or of what a file calls so: with `_` for `-`, in lower case."""
    return name.replace("-", "_").lower()


def keys_of(parser: argparse.ArgumentParser) -> set[str]:
    """Keys that a command or one of its verbs knows."""
    found = set(_options(parser))
    for verbs in _verbs(parser):
        found.update(key for verb in verbs.values() for key in _options(verb))
    return found


class Called:
    """The options of the command that is called, and of its verb where it has verbs.

    Parameters
    ----------
    parser : argparse.ArgumentParser
        Of the command.
    given : Sequence[str]
        The command line: where one of several options that exclude each other is given, none of
        them has a default.
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

        Parameters
        ----------
        key : str
            Of the option.
        value : Any
            As a file or a variable has it.
        where : str
            Which file or variable, for errors.

        Returns
        -------
        bool
            Whether there is such an option.

        Raises
        ------
        ConfigurationError
            The option takes no such value.
        """
        done = False
        for parser in self._parsers:
            action = _options(parser).get(key)
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
        checked = _checked(action, value, at)
        for group in parser._mutually_exclusive_groups:
            if action not in group._group_actions:
                continue
            if any(self._is_given(other) for other in group._group_actions):
                return  # the command line has chosen among them
            if checked is not False:  # one of them, as on the command line; the nearer wins
                for other in group._group_actions:
                    parser.set_defaults(**{other.dest: False if other.nargs == 0 else None})
                group.required = False
        parser.set_defaults(**{action.dest: checked})
        action.required = False

    def _is_given(self, action: argparse.Action) -> bool:
        return any(item.split("=", 1)[0] in action.option_strings for item in self._given)


def _verbs(parser: argparse.ArgumentParser) -> Iterator[Mapping[str, argparse.ArgumentParser]]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            yield action.choices


def _options(parser: argparse.ArgumentParser) -> dict[str, argparse.Action]:
    """Options by the keys that set them."""
    return {
        key_of(name[2:]): action
        for action in parser._actions
        for name in action.option_strings
        if name.startswith("--") and name != "--help"
    }


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
