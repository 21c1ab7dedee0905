"""Results that an earlier version wrote, `ehadiag.diagnosis/2`."""

from __future__ import annotations

import json
from typing import Any

from places import ROOT

LINES = (ROOT / "tests" / "data" / "results-2.jsonl").read_text().splitlines()
"""Healthy; with freed effects; not readable; joint; not explained."""


def former_result(severities: dict[str, float] | None = None, **changes: Any) -> dict[str, Any]:
    """The healthy one, with other severities and keys."""
    tree: dict[str, Any] = json.loads(LINES[0])
    for name, value in (severities or {}).items():
        tree["faults"][name] |= {"estimate": value, "std": 0.001}
    return tree | changes
