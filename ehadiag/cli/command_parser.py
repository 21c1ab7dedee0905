"""Parser of every command: a short help and a long one, and errors that say what was meant."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn

from firmware_iface.errors import printable

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
