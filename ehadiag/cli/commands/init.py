"""`ehadiag init`: writes a commented template of an actuator, test or mapping file."""

from __future__ import annotations

import argparse
import os
from importlib import resources
from pathlib import Path

from ehadiag.cli.output import put, say
from ehadiag.core.errors import InputOutputError, reason_of
from ehadiag.core.folder import RESULT_MODE, Folder

__all__ = ["add_parser", "run"]

TEMPLATES = {
    "actuator": (("ehadiag", "data/actuator.toml", "actuator.toml"),),
    "test": (("ehadiag", "data/tests/open.toml", "test.toml"),),
    "mapping": (
        ("firmware_iface", "data/eha_fcc.toml", "mapping.toml"),
        ("firmware_iface", "data/eha_fcc.dbc", "eha_fcc.dbc"),
    ),
    "defaults": (("ehadiag", "data/templates/ehadiag.toml", "ehadiag.toml"),),
}
PAGES = {
    "actuator": "actuator-file.md",
    "test": "test-file.md",
    "mapping": "mapping-file.md",
    "defaults": "command-line.md",
}


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "init",
        help="write a commented template of an actuator, test, mapping or defaults file",
        description="Write a commented template that works as it is: the reference actuator, the"
        " open-loop test, the computer's own bus with its DBC, or defaults of options.",
        allow_abbrev=False,
    )
    parser.add_argument("kind", choices=tuple(TEMPLATES), help="which file")
    parser.add_argument(
        "folder", nargs="?", default=".", metavar="DIR", help="where (default: the working folder)"
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Write the files; none that is there is changed."""
    folder = Path(arguments.folder)
    files = TEMPLATES[arguments.kind]
    if os.path.lexists(folder) and not folder.is_dir():
        raise InputOutputError(f"{folder}: is no folder; name the one to write {files[0][2]} into")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with Folder.at(folder, RESULT_MODE, follow=True) as place:
            for _, _, name in files:
                if place.exists(name):
                    raise InputOutputError(f"{folder / name}: is there already, not overwritten")
            for package, source, name in files:
                content = resources.files(package).joinpath(source).read_bytes()
                place.write_new(name, content)
                put(os.fspath(folder / name))
    except FileExistsError as error:
        raise InputOutputError(
            f"{folder / str(error)}: is there already, not overwritten"
        ) from None
    except OSError as error:
        raise InputOutputError(f"folder {folder}: {reason_of(error)}") from None
    say(f"each key is explained in docs/reference/{PAGES[arguments.kind]}")
    return 0
