"""The page of parameters says what the registry holds."""

from __future__ import annotations

import numpy as np
from places import ROOT

from ehadiag.model.parameters import REGISTRY


def test_the_page_lists_the_registry():
    page = (ROOT / "docs" / "reference" / "parameters.md").read_text(encoding="utf-8")
    rows = [line for line in page.splitlines() if line.startswith("| `")]
    expected = []
    for item in REGISTRY:
        bounded = np.isfinite(item.lower) and np.isfinite(item.upper)
        span = f"{item.lower:g} … {item.upper:g}" if bounded else "any"
        expected.append(
            f"| `{item.name}` | {item.symbol} | {item.unit} | {span} | {item.kind.value} | "
            f"{item.meaning} |"
        )
    assert rows == expected
