"""The exit code of a call that several things came of."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from ehadiag.core.errors import ConfigurationError, InputOutputError

__all__ = ["FAILED", "code_of_inputs", "worst_code"]

FAILED = InputOutputError.exit_code
ORDER = (20, 40, FAILED, 30, 10, 0)
"""Exit codes, the worst first."""


def worst_code(codes: Iterable[int]) -> int:
    """Return the worst of several exit codes; 0 of none.

    FAULT (20), an alarm (40), an input or output that failed (3, 2), NOT TESTED (30), DEGRADED
    (10), HEALTHY.
    """
    known = {FAILED if code == ConfigurationError.exit_code else code for code in codes}
    return next((code for code in ORDER if code in known), 0)


def code_of_inputs(codes: Sequence[int]) -> int:
    """Return the exit code of a call by those of its inputs: that of one, the worst of several."""
    return codes[0] if len(codes) == 1 else worst_code(codes)
