#!/usr/bin/env python3
"""Fuzz one target with atheris: `python tools/fuzz/run.py TARGET [FOLDER...] [-option...]`.

Options are libFuzzer's; docs/maintainers/fuzz.md says how to start it and what a finding is.
"""

from __future__ import annotations

import operator
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import atheris
import numpy as np
from atheris.version_dependent import CMP_OP_SHIFT_AMOUNT

NAMES = ("frames", "windows", "serial", "logs", "mappings", "signals", "configurations")
SEEN = ("firmware_iface", "ehadiag", "cantools", "textparser", "tomllib", "can")
"""Packages whose branches guide the search."""
TARGET_VARIABLE = "EHADIAG_FUZZ_TARGET"
COMPARISONS: tuple[Callable[[Any, Any], Any], ...] = (
    operator.lt, operator.le, operator.eq, operator.ne, operator.gt, operator.ge
)  # fmt: skip
"""By atheris's numbers."""


def main() -> None:
    """Run until a finding, or until what the options say."""
    # libFuzzer starts this program again for a merge, without the target among the options.
    if len(sys.argv) > 1 and sys.argv[1] in NAMES:
        os.environ[TARGET_VARIABLE] = sys.argv.pop(1)
    name = os.environ.get(TARGET_VARIABLE)
    if name not in NAMES:
        raise SystemExit(f"usage: run.py {'|'.join(NAMES)} [FOLDER...] [-option...]")
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    with atheris.instrument_imports(include=list(SEEN)):
        from fuzz import targets  # noqa: PLC0415 - the fuzzer must see its imports
    options = ["-timeout=20", "-rss_limit_mb=2048", *sys.argv[1:]]
    atheris.Setup([sys.argv[0], *options], _without_leak(targets.target(name, targets.SHARE)))
    atheris.Fuzz()


def _without_leak(check: Callable[[bytes], None]) -> Callable[[bytes], None]:
    """Atheris 3.0 never frees what a comparison it watches returns: an array each time here.

    It puts its own function in place when it starts; the first input comes after that.
    """
    watched: Callable[..., object] | None = None

    def compare(left: object, right: object, which: int, place: int, constant: bool) -> object:
        if watched is None or isinstance(left, np.ndarray) or isinstance(right, np.ndarray):
            return COMPARISONS[which >> CMP_OP_SHIFT_AMOUNT](left, right)
        return watched(left, right, which, place, constant)

    def run(data: bytes) -> None:
        nonlocal watched
        if watched is None:
            watched, atheris._trace_cmp = atheris._trace_cmp, compare
        check(data)

    return run


if __name__ == "__main__":
    main()
