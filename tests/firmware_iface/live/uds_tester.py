"""A tester of its own: udsoncan and can-isotp on python-can, nothing of this project.

python uds_tester.py TEST_NUMBER FILE: runs a whole test of an emulated computer on udp_multicast,
starts another and stops it; writes what was said to FILE.
"""

from __future__ import annotations

import json
import struct
import sys
import time
from pathlib import Path

import can
import isotp
import udsoncan
from udsoncan.client import Client
from udsoncan.connections import PythonIsoTpConnection
from udsoncan.exceptions import NegativeResponseException

REQUEST, RESPONSE, ROUTINE, TELEMETRY = 0x7E0, 0x7E8, 0x0201, 0x110


class Plain(udsoncan.DidCodec):
    """Bytes as they are."""

    def __init__(self, size: int) -> None:
        self._size = size

    def encode(self, value: bytes) -> bytes:
        return value

    def decode(self, data: bytes) -> bytes:
        return data

    def __len__(self) -> int:
        return self._size


class Logged(PythonIsoTpConnection):
    """Keeps all messages."""

    def __init__(self, layer: isotp.TransportLayer) -> None:
        super().__init__(layer)
        self.messages: list[tuple[str, str]] = []

    def specific_send(self, payload: bytes, timeout: float | None = None) -> None:
        self.messages.append(("request", payload.hex()))
        super().specific_send(payload, timeout)

    def specific_wait_frame(self, timeout: float | None = None) -> bytes | None:
        payload = super().specific_wait_frame(timeout)
        if payload is not None:
            self.messages.append(("response", bytes(payload).hex()))
        return payload


def refused(call, *arguments: object) -> int:
    """Return the code of a negative response."""
    try:
        call(*arguments)
    except NegativeResponseException as error:
        return error.response.code
    return 0


def results(client: Client) -> tuple[int, ...]:
    """Return state, reason, number of the test, elapsed time in ms, serial number."""
    data = client.get_routine_result(ROUTINE).service_data.routine_status_record
    return struct.unpack(">BBBHH", data)


def wait_for(client: Client, state: int) -> list[tuple[int, ...]]:
    """Ask until the routine is in a state; return all answers."""
    answers = [results(client)]
    end = time.monotonic() + 60
    while answers[-1][0] != state:
        if time.monotonic() > end:
            raise SystemExit(f"never in state {state}: {answers[-1]}")
        time.sleep(0.05)
        answers.append(results(client))
    return answers


def main(number: int, file: Path) -> None:
    """Run the tests."""
    test, found = bytes([number]), {}
    codecs = {0x0120: Plain(23), 0x0121: Plain(8), 0xF18C: Plain(2), 0xF195: Plain(16)}
    with (
        can.Bus("239.74.163.2", interface="udp_multicast") as bus,
        can.Bus("239.74.163.2", interface="udp_multicast") as listening,
    ):
        reader = can.BufferedReader()
        notifier = can.Notifier(listening, [reader])
        address = isotp.Address(isotp.AddressingMode.Normal_11bits, txid=REQUEST, rxid=RESPONSE)
        layer = isotp.CanStack(bus, address=address, params={"tx_padding": 0x55, "stmin": 1})
        connection = Logged(layer)
        config = dict(udsoncan.configs.default_client_config, data_identifiers=codecs)
        config |= {"request_timeout": 20, "p2_timeout": 10, "extended_data_size": {}}
        with Client(connection, config=config) as client:
            found["results before"] = refused(client.get_routine_result, ROUTINE)
            found["stop before"] = refused(client.stop_routine, ROUTINE)
            found["unknown test"] = refused(client.start_routine, ROUTINE, b"\x63")
            found["unknown routine"] = refused(client.start_routine, 0x0203, test)
            found["no option"] = refused(client.start_routine, ROUTINE)
            found["reset"] = refused(client.ecu_reset, 1)
            client.start_routine(ROUTINE, test)
            found["busy"] = refused(client.start_routine, ROUTINE, test)
            found["answers"] = wait_for(client, 3)
            for identifier in codecs:
                values = client.read_data_by_identifier(identifier).service_data.values
                found[f"{identifier:04x}"] = values[identifier].hex()
            found["unknown data"] = refused(client.test_data_identifier, [0x0199])
            found["codes"] = codes(client)
            dtc = client.get_dtc_snapshot_by_dtc_number(0x5A0200, 1).service_data.dtcs[0]
            found["snapshot"] = [dtc.snapshots[0].did, dtc.snapshots[0].data.hex()]
            found["supported"] = len(client.get_supported_dtc().service_data.dtcs)
            client.start_routine(ROUTINE, test)
            wait_for(client, 2)
            status = client.stop_routine(ROUTINE).service_data.routine_status_record
            found["stopped"] = status[0]
            found["after"] = results(client)[0]
            found["codes after"] = codes(client)
        notifier.stop()
        frames = []
        while (message := reader.get_message(timeout=0)) is not None:
            frames.append((message.arbitration_id, message.dlc))
    found["telemetry"] = sum(1 for name, _ in frames if name == TELEMETRY)
    found["identifiers"] = sorted({name for name, _ in frames})
    found["lengths"] = sorted({dlc for name, dlc in frames if name in (REQUEST, RESPONSE)})
    found["messages"] = connection.messages
    file.write_text(json.dumps(found))


def codes(client: Client) -> list[tuple[int, int]]:
    """Return numbers and status of the trouble codes that are set."""
    found = client.get_dtc_by_status_mask(0x01).service_data.dtcs
    return [(item.id, item.status.get_byte_as_int()) for item in found]


if __name__ == "__main__":
    main(int(sys.argv[1]), Path(sys.argv[2]))
