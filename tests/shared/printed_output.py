"""Compares a program's output with what a page says, independent of the machine."""

from __future__ import annotations

import doctest
import re

DECIMAL = re.compile(r"-?\d+\.\d+")
ABSOLUTE = 2e-3
"""Decimals may differ by so much: the last digits of an estimate are the machine's."""


class TolerantChecker(doctest.OutputChecker):
    """Compares all but decimals to the letter; `...` in a page stands for anything."""

    def check_output(self, want: str, got: str, optionflags: int) -> bool:
        """Whether `got` is what `want` says."""
        given = iter(DECIMAL.findall(got))

        def replaced(match: re.Match[str]) -> str:
            number = next(given, "none")
            try:
                near = abs(float(number) - float(match[0])) <= ABSOLUTE
            except ValueError:
                near = False
            return number if near else match[0]

        return super().check_output(
            DECIMAL.sub(replaced, want), got, optionflags | doctest.ELLIPSIS | doctest.REPORT_NDIFF
        )


def output_matches(want: str, got: str) -> bool:
    """Whether a program printed what a page says."""
    return TolerantChecker().check_output(want, got, 0)
