"""A user's script, for a type checker: what `ehadiag` offers has these types, and no others."""

from typing import assert_type

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import ehadiag

assert_type(ehadiag.__version__, str)
recordings = ehadiag.read("test.blf")
assert_type(recordings, list[ehadiag.Recording])
assert_type(ehadiag.simulate("open", FSS=0.3, oil_temperature=60.0), ehadiag.Recording)

result = ehadiag.diagnose([*recordings, "other.blf"], advisory=0.3, nuisances="all")
assert_type(result, ehadiag.Result)
assert_type(result.faults["FSS"], ehadiag.Severity)
assert_type(result.faults["FSS"].value, float)
assert_type(result.faults["FSS"].interval, tuple[float, float])
assert_type(result.verdict, ehadiag.Verdict)
assert_type(result.reasons, tuple[str, ...])
assert_type(result.to_json(), str)
assert_type(result.plot(), Figure)
assert_type(result.diagnosis, ehadiag.Diagnosis)

for recording in result.recordings:
    if recording.samples is not None:
        assert_type(recording.samples, ehadiag.Samples)
        assert_type(recording.samples.spool, NDArray[np.float64])
        recording.to_frame()

assert_type(ehadiag.load_actuator("mine.toml"), ehadiag.Actuator)
assert_type(ehadiag.load_test("mine.toml"), ehadiag.StoredTest)
monitor = ehadiag.Monitor(ehadiag.default_actuator(), (0.0, 0.0, 0.0))
assert_type(monitor.push(ehadiag.Tick(0.0, 0.0, 0.0, 0.0, 0.0)), ehadiag.Reading)

# Each of these is an error; a type checker that sees none says that the comment is unused.
ehadiag.diagnoze  # type: ignore[attr-defined]  # noqa: B018
ehadiag.diagnose(3)  # type: ignore[arg-type]
ehadiag.diagnose("test.blf", sead=1)  # type: ignore[call-arg]
result.faults["FSS"].estimated  # type: ignore[attr-defined]  # noqa: B018
result.faults["FSS"].value = 0.3  # type: ignore[misc]
