"""Frames of a computer that identifies by itself (BUS-17, BUS-18), as cantools encodes them."""

from importlib import resources

import cantools.database

from firmware_iface.protection import crc8
from firmware_iface.transport.frames import Frame

TEXT = resources.files("firmware_iface").joinpath("data/eha_fcc.dbc").read_text()
DATABASE = cantools.database.load_string(TEXT, "dbc")
SEVERITIES = {"Kintas": (0.3, 0.001), "FSS": (0.6, 0.002), "FDJ": (0.1, 0.003)}


def sealed(name, values, time_ns=0):
    """One frame with its check sum."""
    message = DATABASE.get_message_by_name(name)
    plain = {signal.name: 0 for signal in message.signals} | values
    data = message.encode(plain, scaling=True, strict=True)[:7]
    check = crc8(message.frame_id.to_bytes(2, "little") + data)
    return Frame(time_ns, message.frame_id, data + bytes([check]))


def progress(state, test_id=1, verdict=30, runs=0, time_ns=0):
    """How far the computer is."""
    values = {"OnboardState": state, "OnboardTestId": test_id, "OnboardRuns": runs}
    return sealed("OnboardVerdict", values | {"OnboardVerdict": verdict}, time_ns)


def findings(severities=None, time_ns=0):
    """The three messages of the severities."""
    return [
        sealed(f"Onboard{name}", {f"Severity{name}": value, f"Deviation{name}": std}, time_ns)
        for name, (value, std) in (severities or SEVERITIES).items()
    ]
