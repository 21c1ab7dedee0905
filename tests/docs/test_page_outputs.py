"""What the pages say that a command prints, it prints: each command with an output is typed."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from places import ROOT
from printed_output import output_matches

from ehadiag.cli.main import main

PAGES = ["README.md", "docs/tutorials/first-test.md"]
BLOCK = re.compile(r"^```[^\n]*\n(.*?)^```", re.DOTALL | re.MULTILINE)
VERDICT = re.compile(r"(HEALTHY|DEGRADED|FAULT|INCONCLUSIVE|NOT TESTED)  ")
VOLATILE = (
    (r"\d{8}T\d{6}Z", "STAMP"),
    (r"tested \d{4}-\d\d-\d\d \d\d:\d\d UTC", "tested DATE"),
    (r"\d+ model runs, [\d.]+ s( after the test)?", "N model runs, T"),
    (r"frames \d+, lost \d+", "frames N"),
    (r"[\d.]+% outliers", "X% outliers"),
)  # fmt: skip
"""Parts of an output that depend on the time of day and on how busy the machine is."""


def outputs(page: str) -> list[tuple[str, str]]:
    """Commands of a page that an output follows, and that output."""
    blocks = BLOCK.findall((ROOT / page).read_text(encoding="utf-8"))
    out = []
    for number, block in enumerate(blocks):
        if VERDICT.match(block):
            typed = [line for before in blocks[:number] for line in before.splitlines()]
            commands = [
                line[line.rindex("ehadiag bit") :] for line in typed if "ehadiag bit" in line
            ]
            out.append((commands[-1], block))
    return out


def settled(text: str) -> str:
    for pattern, word in VOLATILE:
        text = re.sub(pattern, word, text)
    return "\n".join(line.rstrip() for line in text.splitlines()) + "\n"


CASES = [(page, *case) for page in PAGES for case in outputs(page)]


def test_the_pages_show_outputs() -> None:
    assert {page for page, *_ in CASES} == set(PAGES)


@pytest.mark.parametrize(("page", "command", "output"), CASES, ids=[page for page, *_ in CASES])
def test_a_command_prints_what_its_page_shows(
    page: str, command: str, output: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    # In simulated time: a busy machine must not change what is measured.
    assert main([*shlex.split(command)[1:], "--fast"]) == 10
    printed = capsys.readouterr().out
    assert output_matches(settled(output), settled(printed)), printed


@pytest.mark.parametrize("page", ["docs/tutorials/slcan.md", "docs/tutorials/socketcan.md"])
def test_pages_with_two_terminals_show_the_same_result(page: str) -> None:
    """The same test of the same unit on another bus (their commands: test_cli_quickstart)."""
    (_, shown), (_, expected) = outputs(page)[0], outputs("README.md")[0]
    shown = settled(shown).replace("quickstart/", "ehadiag-out/")
    assert settled(expected).startswith(shown.rstrip("\n"))


@pytest.mark.slow
def test_a_day_at_the_rig_as_its_page_tells_it(tmp_path: Path) -> None:
    """The commands of the tutorial in one shell folder; each line shown is printed, in order."""
    for file in (ROOT / "docs" / "examples" / "rig").iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    page = (ROOT / "docs/tutorials/rig.md").read_text(encoding="utf-8")
    sessions = re.findall(r"^```console\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    assert sessions
    for typed in "".join(sessions).split("$ ")[1:]:
        command, *shown = typed.splitlines()
        done = subprocess.run(
            command, shell=True, cwd=tmp_path, env={**os.environ, "PATH": path, "COLUMNS": "200"},
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        lines = iter([line.rstrip() for line in (done.stdout + done.stderr).splitlines()])
        for line in shown:
            if line != "…":
                same = (output_matches(line, row[: len(line)]) for row in lines)
                assert any(same), f"{command}: {line}\n{done.stdout}{done.stderr}"
