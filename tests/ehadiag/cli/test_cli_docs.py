"""The documentation matches the program: options, keys, limits, links."""

from __future__ import annotations

import argparse
import re
import tomllib
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

import pytest
from cli_result import REPOSITORY, Run
from places import LOGS

from ehadiag.assess import acceptance, unobservable
from ehadiag.cli.main import _parser

DOCS = REPOSITORY / "docs"
PAGES = [
    REPOSITORY / "README.md",
    REPOSITORY / "CHANGELOG.md",
    REPOSITORY / "examples" / "README.md",
    *sorted(DOCS.rglob("*.md")),
]


def options(parser: argparse.ArgumentParser) -> Iterator[str]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from options(command)
        else:
            yield from (name for name in action.option_strings if name.startswith("--"))


def test_every_option_is_documented() -> None:
    page = (DOCS / "reference" / "command-line.md").read_text()
    documented = set(re.findall(r"--[A-Za-z][A-Za-z-]*", page))
    aliases = {"--kintas", "--fss", "--fdj", "--data_bitrate"}
    assert set(options(_parser())) - aliases - documented == set()
    assert documented - set(options(_parser())) == set()


def test_every_key_of_the_json_result_is_documented(run: Run) -> None:
    page = (DOCS / "reference" / "json.md").read_text()
    (found,) = run("diagnose", "--json", LOGS / "healthy-open.blf").objects
    paths = set()
    for key, value in found.items():
        if key == "faults":
            paths |= {f"faults.*.{name}" for name in value["FSS"]}
        elif isinstance(value, dict):
            paths |= {f"{key}.{name}" for name in value}
        else:
            paths.add(key)
    assert {path for path in paths if f"`{path}`" not in page} == set()


@pytest.mark.parametrize(
    ("page", "data"), [("actuator-file", "actuator.toml"), ("test-file", "tests/open.toml")]
)
def test_every_key_of_the_data_files_is_documented(page: str, data: str) -> None:
    text = (DOCS / "reference" / f"{page}.md").read_text()
    tree = tomllib.loads(resources.files("ehadiag").joinpath("data", data).read_text())
    keys = {key for key in tree if not isinstance(tree[key], dict)}
    keys |= {key for part in tree.values() if isinstance(part, dict) for key in part}
    assert {key for key in keys if not re.search(rf"[`.]{key}`", text)} == set()


def test_limits_are_the_documented_ones() -> None:
    page = (DOCS / "reference" / "verdicts.md").read_text()
    low, high = acceptance.TEMPERATURES
    for limit in (
        f"missing | {100 * acceptance.MOST_LOST:g} % |",
        f"for x s | {acceptance.LONGEST_GAP_S:g} s |",
        f"are lost (closed loop) | {100 * unobservable.MOST_GUESSED:g} %, see",
        f"the command too | {acceptance.LEAST_COMMANDS} frames |",
        f"at least {1000 * acceptance.LEAST_MISSED_S:g} ms missing",
        f"converter's end | {100 * acceptance.MOST_SATURATED:g} % |",
        f"outside −{-low:g} … {high:g} °C",
        f"more than {100 * acceptance.MOST_OUTLIERS:g} % of the residuals",
        f"rms residual above {acceptance.MOST_RMS:g} times",
    ):
        assert limit in page


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_links_and_named_files_exist(page: Path) -> None:
    text = page.read_text()
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
        assert (page.parent / target).exists(), target
    for name in re.findall(r"`((?:tests|tools|docs|firmware_iface|ehadiag)/[\w./-]+)`", text):
        assert (REPOSITORY / name).exists(), name
