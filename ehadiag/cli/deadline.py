"""The time limit of an identification (`--time-limit`), and the wait that it bounds."""

from __future__ import annotations

import time
from collections.abc import Callable

from ehadiag.core.errors import NotTestedError

__all__ = ["Deadline"]


class Deadline:
    """A number of seconds, wall clock, from now on.

    The identification tells its progress between two generations of a search and two rounds of a
    refinement, 16 to 32 runs of the model apart; it ends there.

    Parameters
    ----------
    seconds : float
        How long.
    clock : Callable[[], float]
        Gives the time, s; another one than the system's only in tests.
    """

    def __init__(self, seconds: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._seconds = seconds
        self._clock = clock
        self._end = clock() + seconds

    @property
    def passed(self) -> bool:
        """Whether the time is over."""
        return self._clock() >= self._end

    def watch(self, progress: Callable[[str, float], None]) -> Callable[[str, float], None]:
        """Return a progress report that ends what reports to it when the time is over.

        Parameters
        ----------
        progress : Callable[[str, float], None]
            Report that it hands on to.

        Returns
        -------
        Callable[[str, float], None]
            Report of a stage and the share of it that is done; it raises NotTestedError once the
            time is over.
        """

        def tell(stage: str, share: float) -> None:
            if self.passed:
                raise NotTestedError(self.reason(stage))
            progress(stage, share)

        return tell

    def reason(self, stage: str) -> str:
        """Say why there is no estimate."""
        return f"no estimate within {self._seconds:g} s: given up in the {stage} (see --time-limit)"
