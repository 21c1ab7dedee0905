from __future__ import annotations

from collections.abc import Iterator

import pytest
from bus_synth import play
from live_ends import cable
from places import LOGS

from firmware_iface.bus_map import default_map
from firmware_iface.codec import Encoder


@pytest.fixture(scope="session")
def bus_map():
    return default_map()


@pytest.fixture
def encoder(bus_map):
    return Encoder(bus_map)


@pytest.fixture
def frames(encoder, truth):
    """What brings the `truth` of a module."""
    return play(encoder, truth)


@pytest.fixture(scope="session")
def logs():
    return LOGS


@pytest.fixture
def wire() -> Iterator[tuple[str, str]]:
    with cable() as ends:
        yield ends
