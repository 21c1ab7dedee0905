"""What `ehadiag.diagnose` returns: the verdict with its faults by name, and ways to show it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING

from ehadiag.core.errors import NotTestedError
from ehadiag.report.asked import Asked, LogFile
from ehadiag.report.faults import Fault, faults_of
from ehadiag.report.json_line import NEWEST, first_version, json_line, source_name, test_name
from ehadiag.report.spent import Spent

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ehadiag.assess.diagnosis import Diagnosis
    from ehadiag.assess.verdict import Verdict
    from ehadiag.core.recording import Recording

__all__ = ["Result"]


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """The diagnosis of one actuator, from one recording or from several together.

    `print(result)` prints the command line's table; a notebook shows it by itself.
    """

    diagnosis: Diagnosis
    """All that led to the verdict: experiments, covariance, fit, effort."""
    asked: Asked = field(default_factory=Asked)
    """Options that it was made with."""
    spent: Spent = field(default_factory=Spent)
    """Time spent around the diagnosis."""
    logs: tuple[LogFile | None, ...] = ()
    """Log of each recording; None where the recording was given."""

    @property
    def solver(self) -> str:
        """Search that was asked for."""
        return self.asked.solver

    @property
    def seed(self) -> int:
        """Seed that was asked for."""
        return self.asked.seed

    @property
    def verdict(self) -> Verdict:
        """State of the actuator; `str` of it is its name, `int` the command line's exit code."""
        return self.diagnosis.verdict

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why, one sentence each; none for a healthy actuator."""
        return self.diagnosis.reasons

    @property
    def notes(self) -> tuple[str, ...]:
        """What was assumed and what is missing; without effect on the verdict."""
        return self.diagnosis.notes

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """What was diagnosed."""
        return self.diagnosis.recordings

    @property
    def source(self) -> str:
        """File or bus; several joined by ' + '."""
        return source_name(self.diagnosis)

    @property
    def test(self) -> str | None:
        """Name of the stored test, several joined by '+'; None if it is not known."""
        return test_name(self.diagnosis)

    @property
    def identified(self) -> bool:
        """Whether there are estimates; where there are none every number is NaN."""
        return self.diagnosis.identification is not None

    @cached_property
    def faults(self) -> Mapping[str, Fault]:
        """The progressive faults by name."""
        return MappingProxyType(faults_of(self.diagnosis))

    def to_json(self, version: int = NEWEST) -> str:
        """Return the command line's JSON object, one line.

        Parameters
        ----------
        version : int
            2 for `ehadiag.diagnosis/2`, 1 for `ehadiag.diagnosis/1`.

        Returns
        -------
        str
            Strict JSON without a line end.
        """
        line = json_line(self.diagnosis, self.spent, self.asked, self.logs)
        return first_version(line) if version == 1 else line

    def plot(self) -> Figure:
        """Draw measured against modelled response, one column for each recording.

        Without an estimate: against what is expected of a unit as new.

        Returns
        -------
        Figure
            Not one of pyplot's; a notebook shows it by itself.

        Raises
        ------
        NotTestedError
            There are no samples.
        """
        from ehadiag.report.picture import (  # noqa: PLC0415 - matplotlib is slow
            can_be_drawn,
            diagnosis_figure,
        )

        if not can_be_drawn(self.diagnosis):
            raise NotTestedError(f"{self.source}: nothing to plot: {'; '.join(self.reasons)}")
        return diagnosis_figure(self.diagnosis, self.asked.levels)

    def __str__(self) -> str:
        """Return the command line's table."""
        from ehadiag.report.table import text_of  # noqa: PLC0415 - only who prints needs rich

        return text_of(self.diagnosis, self.spent)

    def __repr__(self) -> str:
        """Return verdict and estimates in one line."""
        values = ", ".join(f"{name} {fault.value:.4f}" for name, fault in self.faults.items())
        return f"<Result {self.verdict.name} {self.source}: {values}>"

    def _repr_html_(self) -> str:
        from ehadiag.report.table import html_of  # noqa: PLC0415

        return html_of(self.diagnosis, self.spent)
