"""A short stored test, an emulated computer that plays it, and health checks at teardown."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import fault_cases
import pytest

from ehadiag import StoredTest, default_actuator
from ehadiag_sim.conditions import Faults
from ehadiag_sim.emulator import FccCore

CoreFactory = Callable[..., FccCore]


@pytest.fixture(scope="session")
def short_test() -> StoredTest:
    return fault_cases.short_test()


@pytest.fixture
def make_core(short_test: StoredTest) -> CoreFactory:
    def make(**options: object) -> FccCore:
        defaults: dict[str, object] = {"faults": Faults(0.3, 0.3, 0.3), "serial": 77, "seed": 5}
        return FccCore(default_actuator(), [short_test], **(defaults | options))

    return make


@pytest.fixture(autouse=True)
def _no_thread_left() -> Iterator[None]:
    before = set(threading.enumerate())
    yield
    left = [item.name for item in threading.enumerate() if item not in before and item.is_alive()]
    assert not left, f"threads left running: {left}"
