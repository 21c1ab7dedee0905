#!/usr/bin/env python3
"""Undo the fix of each break in a copy of the sources and run its tests: they must fail.

`python tools/undone_fixes.py [BREAK...]` prints a row for each (docs/explanation/attacks.md).
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
TIMEOUT_S = 120
"""Longest time of a test whose fix is undone, s: some fixes are what brings it to an end."""
FAILED = 1
"""Exit code of pytest where tests failed, and nothing else went wrong."""


def main() -> int:
    """Print a row for each; 1 where a test does not fail."""
    wanted, missed = set(sys.argv[1:]), 0
    with (ROOT / "tools" / "undone_fixes.toml").open("rb") as file:
        fixes = tomllib.load(file)["fix"]
    with tempfile.TemporaryDirectory(prefix="ehadiag-") as place:
        archive = subprocess.run(
            ["git", "archive", "HEAD"], cwd=ROOT, capture_output=True, check=True
        )
        subprocess.run(["tar", "x", "-C", place], input=archive.stdout, check=True)
        for fix in fixes:
            if not wanted or fix["break"] in wanted:
                failure = _failure_without(fix, Path(place))
                missed += not failure
                name = fix["test"].replace("::", "`, `")
                row = fix["break"], fix["what"], f"`{name}…`", failure or "PASSED"
                print(f"| {' | '.join(row)} |", flush=True)
    return int(missed > 0)


def _failure_without(fix: dict[str, Any], place: Path) -> str:
    """How the tests fail without the fix; empty where they do not."""
    path = place / fix["file"]
    before = text = path.read_text()
    for old, new in fix["pairs"]:
        if text.count(old) != 1:
            raise SystemExit(f"{fix['file']}: {old!r} {text.count(old)} times")
        text = text.replace(old, new)
    path.write_text(text)
    try:
        return _failure(fix["test"], place)
    finally:
        path.write_text(before)


def _failure(test: str, place: Path) -> str:
    file, name = test.split("::")
    paths = os.pathsep.join(str(place / folder) for folder in ("", "sim", "tools"))
    environment = {**os.environ, "PYTHONPATH": paths}
    command = [
        sys.executable, "-m", "pytest", "-q", "-n", "0", "-k", name, "-m", "slow or not slow",
        f"--timeout={TIMEOUT_S}", "-p", "no:cacheprovider", file,
    ]  # fmt: skip
    done = subprocess.run(
        command, cwd=place, env=environment, capture_output=True, text=True, check=False
    )
    late = "from pytest-timeout" in done.stdout
    if done.returncode != FAILED and not late:
        return ""
    counts = re.findall(
        r"\d+ failed|\d+ passed", done.stdout.splitlines()[-1] if done.stdout else ""
    )
    reasons = re.findall(r"^E +(\S.*)$", done.stdout, re.M)
    why = "without end" if late else reasons[0][:90].replace("|", "/") if reasons else ""
    return f"{', '.join(counts)}: `{why}`" if counts else why


if __name__ == "__main__":
    raise SystemExit(main())
