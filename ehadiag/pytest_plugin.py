"""Fixtures of pytest that run built-in tests on a rig: `ehadiag_bus`, `ehadiag_unit`.

Bus and limits are named once, on the command line and by the marker `ehadiag_limits`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from ehadiag.result import Result

LIMITS_MARKER = "ehadiag_limits"
RunTest = Callable[..., "Result"]


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options that name the bus."""
    group = parser.getgroup("ehadiag", "built-in tests of electrohydraulic actuators")
    group.addoption("--ehadiag-interface", metavar="NAME", help="interface of python-can")
    group.addoption("--ehadiag-channel", metavar="NAME", help="channel of the interface")


def pytest_configure(config: pytest.Config) -> None:
    """Add the marker."""
    config.addinivalue_line(
        "markers",
        f"{LIMITS_MARKER}(Kintas=…, FSS=…, FDJ=…): severities below which each result of"
        " ehadiag_unit must stay, its 95 % interval included",
    )


@pytest.fixture
def ehadiag_bus(request: pytest.FixtureRequest) -> Iterator[Any]:
    """Open bus of python-can that the command line names; override it for a bus of your own."""
    interface = request.config.getoption("--ehadiag-interface")
    if interface is None:
        pytest.skip("no bus: name it by --ehadiag-interface and --ehadiag-channel")
    import can  # noqa: PLC0415 - only with a bus

    channel = request.config.getoption("--ehadiag-channel")
    with can.Bus(interface=interface, channel=channel) as bus:
        yield bus


@pytest.fixture
def ehadiag_unit(request: pytest.FixtureRequest, ehadiag_bus: Any) -> RunTest:
    """Call that runs a test on the bus, and fails where it was not tested or beyond its limits.

    Its arguments are those of `ehadiag.run_test` behind the bus; the surface moves.
    """
    from ehadiag import Verdict, run_test  # noqa: PLC0415 - slow

    marker = request.node.get_closest_marker(LIMITS_MARKER)
    limits = dict(marker.kwargs) if marker else {}

    def run(test: Any, **options: Any) -> Result:
        result = run_test(ehadiag_bus, test, transmit=True, **options)
        request.node.user_properties.extend(
            (name, f"{item.value:.5f}") for name, item in result.severities.items()
        )
        if result.verdict is Verdict.NOT_TESTED:
            pytest.fail(f"NOT TESTED: {'; '.join(result.reasons)}", pytrace=False)
        if beyond := exceeded_limits(result, limits):
            pytest.fail("; ".join(beyond), pytrace=False)
        return result

    return run


def exceeded_limits(result: Result, limits: dict[str, float]) -> list[str]:
    """Say which severities are not below their limits, their intervals included.

    result: with a verdict; limits: by name of the severity. Returns one clause each; empty where
    all are below. ValueError: a limit of no severity.
    """
    if strangers := limits.keys() - result.severities.keys():
        raise ValueError(f"{LIMITS_MARKER}: no severity {', '.join(sorted(strangers))}")
    return [
        f"{name} {item.value:.3f}, at most {item.interval[1]:.3f}: limit {limits[name]:g}"
        for name, item in result.severities.items()
        if name in limits and not item.interval[1] < limits[name]
    ]
