"""Diagnosis of electrohydraulic actuators from a short built-in test.

>>> import ehadiag
>>> result = ehadiag.diagnose("test.blf")
>>> print(result)

The names below are loaded when they are first used: the import itself costs nothing.
"""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from ehadiag.assess.diagnosis import Diagnosis
    from ehadiag.assess.verdict import Levels, Verdict
    from ehadiag.calibration.result import Calibrated
    from ehadiag.core.actuator import Actuator, default_actuator, load_actuator
    from ehadiag.core.errors import (
        BusLostError,
        ConfigurationError,
        EhadiagError,
        InputOutputError,
        NotTestedError,
    )
    from ehadiag.core.recording import CommandMode, Recording, Samples
    from ehadiag.core.stored_test import StoredTest, bundled_tests, load_test
    from ehadiag.facade.calls import calibrate, diagnose, read, save_actuator, simulate
    from ehadiag.facade.result import Result
    from ehadiag.monitor import Monitor, Reading, Tick
    from ehadiag.report.faults import Fault

    __version__: str

__all__ = [
    "Actuator",
    "BusLostError",
    "Calibrated",
    "CommandMode",
    "ConfigurationError",
    "Diagnosis",
    "EhadiagError",
    "Fault",
    "InputOutputError",
    "Levels",
    "Monitor",
    "NotTestedError",
    "Reading",
    "Recording",
    "Result",
    "Samples",
    "StoredTest",
    "Tick",
    "Verdict",
    "__version__",
    "bundled_tests",
    "calibrate",
    "default_actuator",
    "diagnose",
    "load_actuator",
    "load_test",
    "read",
    "save_actuator",
    "simulate",
]

_HOMES = {
    "ehadiag.assess.diagnosis": ("Diagnosis",),
    "ehadiag.assess.verdict": ("Levels", "Verdict"),
    "ehadiag.calibration.result": ("Calibrated",),
    "ehadiag.core.actuator": ("Actuator", "default_actuator", "load_actuator"),
    "ehadiag.core.errors": (
        "BusLostError",
        "ConfigurationError",
        "EhadiagError",
        "InputOutputError",
        "NotTestedError",
    ),
    "ehadiag.core.recording": ("CommandMode", "Recording", "Samples"),
    "ehadiag.core.stored_test": ("StoredTest", "bundled_tests", "load_test"),
    "ehadiag.facade.calls": ("calibrate", "diagnose", "read", "save_actuator", "simulate"),
    "ehadiag.facade.result": ("Result",),
    "ehadiag.monitor": ("Monitor", "Reading", "Tick"),
    "ehadiag.report.faults": ("Fault",),
}
"""Which module has which name; the imports above tell the same to type checkers and editors."""


if not TYPE_CHECKING:  # or a type checker would take any name for granted

    def __getattr__(name: str) -> object:
        """Load a public name when it is first used (PEP 562)."""
        if name == "__version__":
            from importlib.metadata import version  # noqa: PLC0415 - as lazy as the rest

            value: object = version("ehadiag")
        else:
            home = next((home for home, names in _HOMES.items() if name in names), None)
            if home is None:
                raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
            from importlib import import_module  # noqa: PLC0415

            value = getattr(import_module(home), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    """List the public names, loaded or not."""
    return list(__all__)
