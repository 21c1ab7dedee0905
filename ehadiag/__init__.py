"""Diagnosis of electrohydraulic actuators from a short built-in test.

>>> import ehadiag
>>> result = ehadiag.diagnose("test.blf")
>>> print(result)

The names below are loaded when they are first used: the import itself costs nothing.
"""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from ehadiag.api import calibrate, diagnose, diagnose_many, read, save_actuator, simulate
    from ehadiag.assess.diagnosis import Diagnosis
    from ehadiag.assess.verdict import Levels, Verdict
    from ehadiag.calibration.unit_models import Calibrated
    from ehadiag.core.actuator import Actuator, default_actuator, load_actuator
    from ehadiag.core.conventions import __version__
    from ehadiag.estimate import Effect, Severity
    from ehadiag.history.records import Usage
    from ehadiag.history.store import History
    from ehadiag.monitor.streaming import Monitor, Reading, Tick
    from ehadiag.prognosis.units import Prognosis, forecast
    from ehadiag.request import Request
    from ehadiag.result import Result
    from ehadiag.session.bus_calls import check_bus, record, run_simulator, run_test, watch
    from firmware_iface.errors import (
        BusLostError,
        ConfigurationError,
        EhadiagError,
        InputOutputError,
        NotTestedError,
    )
    from firmware_iface.recording import CommandMode, Recording, Samples
    from firmware_iface.stored_test import StoredTest, bundled_tests, load_test

__all__ = [
    "Actuator",
    "BusLostError",
    "Calibrated",
    "CommandMode",
    "ConfigurationError",
    "Diagnosis",
    "Effect",
    "EhadiagError",
    "History",
    "InputOutputError",
    "Levels",
    "Monitor",
    "NotTestedError",
    "Prognosis",
    "Reading",
    "Recording",
    "Request",
    "Result",
    "Samples",
    "Severity",
    "StoredTest",
    "Tick",
    "Usage",
    "Verdict",
    "__version__",
    "bundled_tests",
    "calibrate",
    "check_bus",
    "default_actuator",
    "diagnose",
    "diagnose_many",
    "forecast",
    "load_actuator",
    "load_test",
    "read",
    "record",
    "run_simulator",
    "run_test",
    "save_actuator",
    "simulate",
    "watch",
]

_HOMES = {
    "ehadiag.assess.diagnosis": ("Diagnosis",),
    "ehadiag.assess.verdict": ("Levels", "Verdict"),
    "ehadiag.calibration.unit_models": ("Calibrated",),
    "ehadiag.core.actuator": ("Actuator", "default_actuator", "load_actuator"),
    "ehadiag.core.conventions": ("__version__",),
    "firmware_iface.errors": (
        "BusLostError",
        "ConfigurationError",
        "EhadiagError",
        "InputOutputError",
        "NotTestedError",
    ),
    "firmware_iface.recording": ("CommandMode", "Recording", "Samples"),
    "firmware_iface.stored_test": ("StoredTest", "bundled_tests", "load_test"),
    "ehadiag.estimate": ("Effect", "Severity"),
    "ehadiag.history.records": ("Usage",),
    "ehadiag.history.store": ("History",),
    "ehadiag.prognosis.units": ("Prognosis", "forecast"),
    "ehadiag.api": (
        "calibrate",
        "diagnose",
        "diagnose_many",
        "read",
        "save_actuator",
        "simulate",
    ),
    "ehadiag.monitor.streaming": ("Monitor", "Reading", "Tick"),
    "ehadiag.request": ("Request",),
    "ehadiag.result": ("Result",),
    "ehadiag.session.bus_calls": ("check_bus", "record", "run_simulator", "run_test", "watch"),
}
"""Which module has which name; the imports above tell the same to type checkers and editors."""


if not TYPE_CHECKING:  # or a type checker would take any name for granted

    def __getattr__(name: str) -> object:
        """Load a public name when it is first used (PEP 562)."""
        home = next((home for home, names in _HOMES.items() if name in names), None)
        if home is None:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from importlib import import_module  # noqa: PLC0415

        value: object = getattr(import_module(home), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    """List the public names, loaded or not."""
    return list(__all__)
