"""Compares a program's output with what a page says, independent of the machine."""

from __future__ import annotations

import doctest
import re

DECIMAL = re.compile(r"-?\d+\.\d+")
ABSOLUTE = 2e-3
"""Decimals may differ by so much: the last digits of an estimate are the machine's."""


class NearlyAsTold(doctest.OutputChecker):
    """Compares all but decimals to the letter; `...` in what was told stands for anything."""

    def check_output(self, want: str, got: str, optionflags: int) -> bool:
        """Whether `got` is what `want` told."""
        given = iter(DECIMAL.findall(got))

        def taken(match: re.Match[str]) -> str:
            number = next(given, "nothing more")
            try:
                near = abs(float(number) - float(match[0])) <= ABSOLUTE
            except ValueError:
                near = False
            return number if near else match[0]

        return super().check_output(
            DECIMAL.sub(taken, want), got, optionflags | doctest.ELLIPSIS | doctest.REPORT_NDIFF
        )


def as_told(want: str, got: str) -> bool:
    """Whether a program printed what a page says."""
    return NearlyAsTold().check_output(want, got, 0)
