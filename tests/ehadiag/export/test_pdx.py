"""odxtools reads the diagnostic description, and encodes and decodes what the tables mean."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import odxtools
import pytest
from hypothesis import given
from hypothesis import strategies as st
from odxtools.database import Database

from ehadiag.cli.main import main
from ehadiag.export.pdx import pdx_content
from firmware_iface.mapping_file import UdsIdentifiers
from firmware_iface.uds.services import (
    DATA_RECORDS,
    REFUSALS,
    SOFTWARE,
    TEST_STATUS,
    TROUBLE_CODES,
    DataRecord,
)


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Database]:
    path = tmp_path_factory.mktemp("pdx") / "fcc.pdx"
    assert main(["export", "--pdx", str(path)]) == 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield odxtools.load_pdx_file(path)


def payloads(record: DataRecord) -> st.SearchStrategy[bytes]:
    """Any bytes of a record whose enumerations have a meaning."""
    parts = [
        st.sampled_from([bytes([number]) for number in item.names])
        if item.names is not None
        else st.binary(min_size=item.size, max_size=item.size)
        for item in record.fields
    ]
    return st.tuples(*parts).map(b"".join)


def expected(record: DataRecord, data: bytes) -> dict[str, Any]:
    """What our tables make of it, enumerations by name."""
    values: dict[str, Any] = record.decode(data)
    for item in record.fields:
        if item.names is not None:
            values[item.name] = item.names(values[item.name]).name
    return values


@pytest.mark.parametrize("record", [item for item in DATA_RECORDS.values() if item is not SOFTWARE],
                         ids=lambda item: item.name)  # fmt: skip
@given(data=st.data())
def test_every_value_means_the_same(database: Database, record: DataRecord, data: Any) -> None:
    payload = data.draw(payloads(record))
    number = record.number.to_bytes(2, "big")
    service = database.ecus[0].services[f"Read_{record.name}"]
    assert bytes(service.encode_request()) == b"\x22" + number
    read = service.decode_message(b"\x62" + number + payload)
    values = expected(record, payload)
    assert {key: read.param_dict[key] for key in values} == pytest.approx(values)


@given(payload=payloads(TEST_STATUS))
def test_the_routine_s_status_does(database: Database, payload: bytes) -> None:
    for number, name in enumerate(("Start", "Stop", "Results"), 1):
        service = database.ecus[0].services[f"BuiltInTest_{name}"]
        option = {"test_id": 2} if name == "Start" else {}
        request = bytes([0x31, number, 2, 1, *option.values()])
        assert bytes(service.encode_request(**option)) == request
        read = service.decode_message(bytes([0x71, number, 2, 1]) + payload)
        values = expected(TEST_STATUS, payload)
        assert {key: read.param_dict[key] for key in values} == pytest.approx(values)


def test_units_identifiers_codes_and_refusals(database: Database) -> None:
    ecu = database.ecus[0]
    assert (ecu.get_can_receive_id(), ecu.get_can_send_id()) == (0x7E0, 0x7E8)
    units = {
        item.short_name: item.unit.display_name
        for item in ecu.diag_data_dictionary_spec.data_object_props
        if item.unit is not None
    }
    assert units["SensorOffsets_pressure"] == "MPa"
    assert units["BuiltInTest_elapsed"] == "s"
    (codes,) = ecu.diag_data_dictionary_spec.dtc_dops
    named = {item.trouble_code: item.display_trouble_code for item in codes.dtcs}
    assert named == {item.number: item.code for item in TROUBLE_CODES}
    assert named[0x5A0100] == "C1A01-00"
    request = bytes(ecu.services.BuiltInTest_Start.encode_request(test_id=1))
    for code in set(REFUSALS.values()):
        (read,) = ecu.decode_response(bytes([0x7F, 0x31, code]), request)
        assert read.param_dict["ResponseCode"] == code.name


def test_the_mapping_s_identifiers_are_in_it(tmp_path: Path) -> None:
    path = tmp_path / "sister.pdx"
    assert main(["export", "--pdx", str(path), "--id-offset", "4"]) == 0
    sister = odxtools.load_pdx_file(path)
    assert sister.ecus[0].get_can_receive_id() == 0x7E4
    assert sister.ecus[0].get_can_send_id() == 0x7EC


def test_the_same_services_give_the_same_bytes() -> None:
    assert pdx_content(UdsIdentifiers()) == pdx_content(UdsIdentifiers())
