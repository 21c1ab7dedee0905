from __future__ import annotations

from pathlib import Path

import pytest
from bus_synth import play

from firmware_iface.busmap import default_map
from firmware_iface.encode import Encoder

LOGS = Path(__file__).parent.parent / "data" / "logs"


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
