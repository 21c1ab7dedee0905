"""The bus that python-can's own configuration names: file, contexts, variables."""

from __future__ import annotations

from pathlib import Path

import can.util
import pytest

from ehadiag import ConfigurationError
from firmware_iface.transport.adapters import BusOptions, configures_a_bus, with_configuration

FILE = """
[default]
interface = virtual
channel = rig
bitrate = 500000

[HS]
channel = high
data_bitrate = 2000000
fd = true
receive_timeout = 3
"""


@pytest.fixture(autouse=True)
def conf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """python-can's only file; empty, and no variable is set."""
    path = tmp_path / "can.conf"
    path.touch()
    monkeypatch.setattr(can.util, "CONFIG_FILES", [str(path)])
    for name in ("INTERFACE", "CHANNEL", "BITRATE", "CONFIG"):
        monkeypatch.delenv(f"CAN_{name}", raising=False)
    return path


def test_default_section_names_the_bus(conf: Path) -> None:
    conf.write_text(FILE)
    found = with_configuration(BusOptions(""), None)
    assert found == BusOptions("virtual", "rig", 500_000)
    assert configures_a_bus()


def test_a_context_comes_before_the_default_section_and_inherits_from_it(conf: Path) -> None:
    conf.write_text(FILE)
    found = with_configuration(BusOptions("", bitrate=250_000), "HS")
    assert (found.interface, found.channel, found.bitrate) == ("virtual", "high", 250_000)
    assert (found.data_bitrate, found.fd) == (2_000_000, True)
    assert found.extra == {"receive_timeout": 3}


def test_variables_of_a_context_come_before_plain_ones_and_the_file(
    conf: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    conf.write_text(FILE)
    monkeypatch.setenv("CAN_CHANNEL", "plain")
    monkeypatch.setenv("CAN_CHANNEL_MS", "slow")
    monkeypatch.setenv("CAN_CONFIG_MS", '{"bitrate": 125000}')
    found = with_configuration(BusOptions("", channel="plain"), "MS")
    assert (found.interface, found.channel, found.bitrate) == ("virtual", "slow", 125_000)


def test_what_is_given_comes_first(conf: Path) -> None:
    conf.write_text(FILE)
    found = with_configuration(BusOptions("udp_multicast", "224.0.0.9"), "HS")
    assert (found.interface, found.channel) == ("udp_multicast", "224.0.0.9")


@pytest.mark.parametrize(
    ("content", "variable", "context", "why"),
    [
        ("", None, "HS", r"--context HS: no section \[HS\] in .*can.conf"),
        ("no section", None, None, "configuration file"),
        ("[default]\nchannel = can0", None, None, "Unknown interface"),
        ("", "[1, 2", None, "variable CAN_CONFIG: no JSON object"),
    ],
)
def test_a_configuration_that_names_no_bus_is_refused(
    conf: Path,
    monkeypatch: pytest.MonkeyPatch,
    content: str,
    variable: str | None,
    context: str | None,
    why: str,
) -> None:
    conf.write_text(content)
    if variable is not None:
        monkeypatch.setenv("CAN_CONFIG", variable)

    def ask() -> None:
        if not configures_a_bus() or context:
            with_configuration(BusOptions(""), context)

    with pytest.raises(ConfigurationError, match=why):
        ask()


def test_nothing_is_configured_where_nothing_is_said() -> None:
    assert not configures_a_bus()
