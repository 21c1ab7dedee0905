"""Result of a command-line run: exit code, output, error line, JSON objects."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from places import ROOT

REPOSITORY = ROOT
COMMAND = (sys.executable, "-m", "ehadiag")


@dataclass(frozen=True)
class Result:
    code: int
    out: str
    err: str

    @property
    def objects(self) -> list[dict[str, Any]]:
        """Standard output as strict JSON, one object a line."""

        def refuse(constant: str) -> None:
            raise ValueError(f"{constant} is no JSON")

        return [json.loads(line, parse_constant=refuse) for line in self.out.splitlines()]

    @property
    def message(self) -> str:
        """Standard error, which must be one line of ours."""
        assert "Traceback" not in self.err
        lines = self.err.splitlines()
        assert len(lines) == 1, self.err
        assert lines[0].startswith("ehadiag: ")
        return lines[0]


Run = Callable[..., Result]
