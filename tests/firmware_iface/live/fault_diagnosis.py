"""Runs a whole stored test, from request to verdict, under a harness fault."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from fault_cases import Case, Run, run

from ehadiag import Diagnosis, Recording, StoredTest, Verdict, bundled_tests, default_actuator
from ehadiag.assess.diagnosis import diagnose, not_tested

STRIKE = 2.6
"""s after the first frame: 2.44 s into the test, amidst the steps that show the filter."""
TWICE = 2.0 * 1.96
"""Standard deviations within which estimates count as the same: twice the error told."""


@dataclass(frozen=True)
class Judged:
    """A run and what was concluded from it."""

    run: Run
    diagnosis: Diagnosis


class Diagnoser:
    """Runs cases and diagnoses them as the command line does; the same samples only once."""

    def __init__(self, name: str = "open") -> None:
        self.test: StoredTest = bundled_tests()[name]
        self._known: dict[bytes, Diagnosis] = {}

    def judge(self, case: Case) -> Judged:
        """Run a case from request to verdict."""
        came = run(case, test=self.test, at=STRIKE)
        if not came.outcome.complete:
            why = not_tested([came.recording], [self.test], default_actuator(), [came.outcome.why])
            return Judged(came, why)
        return Judged(came, self.diagnose(came.recording))

    def diagnose(self, recording: Recording) -> Diagnosis:
        """Diagnose a recording."""
        key = content(recording)
        if key not in self._known:
            tests = bundled_tests().values()
            self._known[key] = diagnose([recording], default_actuator(), tests, default=self.test)
        return self._known[key]


def content(recording: Recording) -> bytes:
    """All that a diagnosis goes by."""
    samples = recording.samples
    parts: list[bytes] = [
        repr(
            (recording.test_id, recording.serial, recording.outcome, recording.environment)
        ).encode()
    ]
    if samples is not None:
        parts.append(repr((samples.period_ns, samples.mode)).encode())
        for name in ("current", "spool", "pressure", "position", "command", "saturated"):
            parts.append(np.ascontiguousarray(getattr(samples, name)).tobytes())
    return b"|".join(parts)


def deviations(clean: Diagnosis, came: Diagnosis) -> dict[str, float]:
    """Differences of estimates to those of a sound bus, in the standard deviation told."""
    if clean.identification is None or came.identification is None:
        raise AssertionError("nothing was identified")
    return {
        ours.name: abs(ours.value - sound.value) / ours.std
        for sound, ours in zip(
            clean.identification.estimates, came.identification.estimates, strict=True
        )
    }


def objection(case: Case, clean: Diagnosis, came: Diagnosis) -> str:
    """What contradicts the stated outcome of a case; empty if nothing does."""
    expected = case.why or case.unfit
    if expected:
        told = "; ".join(came.reasons)
        if came.verdict is not Verdict.NOT_TESTED:
            return f"{came.verdict.name} where NOT TESTED was stated"
        return "" if re.search(expected, told) else f"NOT TESTED with other reasons: {told}"
    if came.verdict is not clean.verdict:
        return f"{came.verdict.name} ({'; '.join(came.reasons)}) instead of {clean.verdict.name}"
    far = {name: size for name, size in deviations(clean, came).items() if not size <= TWICE}
    return f"estimates differ by {far} standard deviations" if far else ""
