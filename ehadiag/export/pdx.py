"""Writes the diagnostic description of the computer's UDS services (PDX, ODX 2.2.0)."""

from __future__ import annotations

import io
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from firmware_iface.mapping_file import UdsIdentifiers
from firmware_iface.uds.services import (
    DATA_RECORDS,
    NEGATIVE_RESPONSE,
    ONBOARD_RESULT,
    POSITIVE_OFFSET,
    SNAPSHOT_RECORD,
    TEST_OPTION,
    TEST_STATUS,
    TROUBLE_CODES,
    DataField,
    DataRecord,
    DtcReport,
    ResponseCode,
    RoutineAction,
    ServiceId,
)

ODX_VERSION = "2.2.0"
XSI = "http://www.w3.org/2001/XMLSchema-instance"
ECU = "FlightControlComputer"
PROTOCOL, SUBSET = "ISO_15765_3_on_ISO_15765_2", "ISO_15765_2"
DATE = "2000-01-01T00:00:00"
"""Stated for each file, so that the same tables give the same bytes."""

Node = ET.Element


def _node(tag: str, *content: Node | str | None, **attributes: str) -> Node:
    """Make an element of a text or of others; in names of attributes `_` stands for `-`."""
    made = ET.Element(tag, {key.replace("_", "-"): value for key, value in attributes.items()})
    for item in content:
        if isinstance(item, str):
            made.text = item
        elif item is not None:
            made.append(item)
    return made


def _typed(tag: str, kind: str, *content: Node | str | None, **attributes: str) -> Node:
    made = _node(tag, *content, **attributes)
    made.set(f"{{{XSI}}}type", kind)
    return made


def _named(tag: str, name: str, *content: Node | None, text: str = "", **attributes: str) -> Node:
    described = _node("DESC", _node("p", text)) if text else None
    return _node(tag, _node("SHORT-NAME", name), described, *content, **attributes)


def _list(tag: str, items: Iterable[Node]) -> Node:
    return _node(tag, *items)


def _coded(data_bytes: int, base: str = "A_UINT32") -> Node:
    length = _node("BIT-LENGTH", str(8 * data_bytes))
    return _typed("DIAG-CODED-TYPE", "STANDARD-LENGTH-TYPE", length, BASE_DATA_TYPE=base)


def _param(kind: str, name: str, *content: Node, at: int | None = None, semantic: str = "") -> Node:
    place = None if at is None else _node("BYTE-POSITION", str(at))
    marked = {"SEMANTIC": semantic} if semantic else {}
    return _typed("PARAM", kind, _node("SHORT-NAME", name), place, *content, **marked)


def _constant(name: str, value: int, size: int, at: int, semantic: str = "") -> Node:
    coded = _node("CODED-VALUE", str(value))
    return _param("CODED-CONST", name, coded, _coded(size), at=at, semantic=semantic)


def _value(name: str, dop: str, at: int | None, semantic: str = "DATA") -> Node:
    return _param("VALUE", name, _node("DOP-REF", ID_REF=dop), at=at, semantic=semantic)


def _identity() -> Node:
    return _node("COMPU-METHOD", _node("CATEGORY", "IDENTICAL"))


def _scaling(category: str, scales: Iterable[Node]) -> Node:
    forward = _node("COMPU-INTERNAL-TO-PHYS", _list("COMPU-SCALES", scales))
    return _node("COMPU-METHOD", _node("CATEGORY", category), forward)


def _texts(names: Iterable[tuple[int, str]]) -> Node:
    return _scaling(
        "TEXTTABLE",
        (
            _node(
                "COMPU-SCALE",
                _node("LOWER-LIMIT", str(number)),
                _node("UPPER-LIMIT", str(number)),
                _node("COMPU-CONST", _node("VT", name)),
            )
            for number, name in names
        ),
    )


def _linear(scale: float) -> Node:
    up = _node("COMPU-NUMERATOR", _node("V", "0"), _node("V", repr(scale)))
    down = _node("COMPU-DENOMINATOR", _node("V", "1"))
    return _scaling("LINEAR", [_node("COMPU-SCALE", _node("COMPU-RATIONAL-COEFFS", up, down))])


def _property(name: str, method: Node, coded: Node, physical: str, unit: str = "") -> Node:
    """Make a simple type: how a number on the wire becomes a value."""
    return _named(
        "DATA-OBJECT-PROP",
        name,
        method,
        coded,
        _node("PHYSICAL-TYPE", BASE_DATA_TYPE=physical),
        _node("UNIT-REF", ID_REF=f"Unit.{unit}") if unit else None,
        ID=f"Dop.{name}",
    )


def _field_property(record: DataRecord, item: DataField) -> Node:
    name = _property_name(record, item)
    if item.text:
        return _property(name, _identity(), _coded(item.size, "A_ASCIISTRING"), "A_UNICODE2STRING")
    if item.names is not None:
        names = ((int(number), number.name) for number in item.names)
        return _property(name, _texts(names), _coded(item.size), "A_UNICODE2STRING")
    base = "A_INT32" if item.signed else "A_UINT32"
    if item.scale == 1.0:
        return _property(name, _identity(), _coded(item.size, base), base)
    return _property(name, _linear(item.scale), _coded(item.size, base), "A_FLOAT64", item.unit)


def _property_name(record: DataRecord, item: DataField) -> str:
    return f"{record.name}_{item.name}"


def _fields(record: DataRecord, at: int) -> list[Node]:
    made = []
    for item in record.fields:
        made.append(_value(item.name, f"Dop.{_property_name(record, item)}", at))
        at += item.size
    return made


class _Service(NamedTuple):
    """A service, its request and its positive response behind their first byte."""

    name: str
    sid: ServiceId
    semantic: str
    request: Sequence[Node]
    response: Sequence[Node]
    text: str

    def comm(self) -> Node:
        return _named(
            "DIAG-SERVICE",
            self.name,
            _node("REQUEST-REF", ID_REF=f"Request.{self.name}"),
            _list("POS-RESPONSE-REFS", [_node("POS-RESPONSE-REF", ID_REF=f"Response.{self.name}")]),
            text=self.text,
            ID=f"Service.{self.name}",
            SEMANTIC=self.semantic,
        )

    def message(self, tag: str, kind: str, first: int, params: Sequence[Node]) -> Node:
        sid = _constant("SID", first, 1, 0, "SERVICE-ID")
        name = f"{self.name}_{kind}"
        return _named(tag, name, _list("PARAMS", [sid, *params]), ID=f"{kind}.{self.name}")


def _services() -> list[_Service]:
    made = []
    for action in RoutineAction:
        head = [
            _constant("RoutineControlType", action, 1, 1, "SUBFUNCTION"),
            _constant("RoutineIdentifier", TEST_STATUS.number, 2, 2, "ID"),
        ]
        option = _fields(TEST_OPTION, 4) if action is RoutineAction.START else []
        name, text = f"{TEST_STATUS.name}_{action.name.title()}", f"{action.name.lower()} of a test"
        made.append(
            _Service(name, ServiceId.ROUTINE_CONTROL, "ROUTINE", [*head, *option],
                     [*head, *_fields(TEST_STATUS, 4)], text)
        )  # fmt: skip
    for record in DATA_RECORDS.values():
        head = [_constant("DataIdentifier", record.number, 2, 1, "ID")]
        made.append(
            _Service(f"Read_{record.name}", ServiceId.READ_DATA_BY_IDENTIFIER, "IDENTIFICATION",
                     head, [*head, *_fields(record, 3)], record.meaning)
        )  # fmt: skip
    for report, text in (
        (DtcReport.BY_STATUS_MASK, "trouble codes with a bit of the mask"),
        (DtcReport.SUPPORTED, "all trouble codes"),
        (DtcReport.SNAPSHOT, "severities that set a trouble code"),
    ):
        head = [_constant("ReportType", report, 1, 1, "SUBFUNCTION")]
        listed = [_value("Availability", "Dop.Byte", 2), _value("Codes", "Field.Codes", 3)]
        request, response = list(head), head + listed
        if report is DtcReport.BY_STATUS_MASK:
            request.append(_value("StatusMask", "Dop.Byte", 2))
        elif report is DtcReport.SNAPSHOT:
            record_number = _constant("RecordNumber", SNAPSHOT_RECORD, 1, 5)
            request += [_value("Code", "Dop.TroubleCode", 2), record_number]
            response = [*head, *_code_and_status(2), _value("Snapshot", "Field.Snapshots", 6)]
        name = f"TroubleCodes_{report.name.title().replace('_', '')}"
        made.append(
            _Service(name, ServiceId.READ_DTC_INFORMATION, "FAULTREAD", request, response, text)
        )
    return made


def _code_and_status(at: int) -> list[Node]:
    return [_value("Code", "Dop.TroubleCode", at), _value("Status", "Dop.Byte", at + 3)]


def _dictionary(records: Sequence[DataRecord]) -> Node:
    """Make the types of all values, the trouble codes and the units."""
    codes = [
        _node(
            "DTC",
            _node("SHORT-NAME", item.verdict.name),
            _node("TROUBLE-CODE", str(item.number)),
            _node("DISPLAY-TROUBLE-CODE", item.code),
            _node("TEXT", item.meaning),
            ID=f"Dtc.{item.verdict.name}",
        )
        for item in TROUBLE_CODES
    ]
    number = _node("PHYSICAL-TYPE", BASE_DATA_TYPE="A_UINT32")
    listed = _list("DTCS", codes)
    dtc = _named(
        "DTC-DOP", "TroubleCode", _coded(3), number, _identity(), listed, ID="Dop.TroubleCode"
    )
    responses = ((int(item), item.name) for item in ResponseCode)
    simple = [
        _property("Byte", _identity(), _coded(1), "A_UINT32"),
        _property("ResponseCode", _texts(responses), _coded(1), "A_UNICODE2STRING"),
        *(_field_property(record, item) for record in records for item in record.fields),
    ]
    snapshot = [
        _constant("RecordNumber", SNAPSHOT_RECORD, 1, 0),
        _constant("Identifiers", 1, 1, 1),
        _constant("DataIdentifier", ONBOARD_RESULT.number, 2, 2),
        *_fields(ONBOARD_RESULT, 4),
    ]
    structures = [
        _named("STRUCTURE", name, _list("PARAMS", params), ID=f"Structure.{name}")
        for name, params in (("Code", _code_and_status(0)), ("Snapshot", snapshot))
    ]
    lists = [
        _named(
            "END-OF-PDU-FIELD",
            f"{name}s",
            _node("BASIC-STRUCTURE-REF", ID_REF=f"Structure.{name}"),
            ID=f"Field.{name}s",
        )
        for name in ("Code", "Snapshot")
    ]
    units = sorted({item.unit for record in records for item in record.fields} - {""})
    named = {"1": "one"}
    unit_nodes = [
        _named("UNIT", named.get(item, item), _node("DISPLAY-NAME", item), ID=f"Unit.{item}")
        for item in units
    ]
    return _node(
        "DIAG-DATA-DICTIONARY-SPEC",
        _list("DTC-DOPS", [dtc]),
        _list("DATA-OBJECT-PROPS", simple),
        _list("STRUCTURES", structures),
        _list("END-OF-PDU-FIELDS", lists),
        _node("UNIT-SPEC", _list("UNITS", unit_nodes)),
    )


def _layer(identifiers: UdsIdentifiers) -> Node:
    """Make protocol, base variant with all services, and the computer as its only variant."""
    services = _services()
    echo = _node("REQUEST-BYTE-POS", "0"), _node("BYTE-LENGTH", "1")
    negative = [
        _constant("SID", NEGATIVE_RESPONSE, 1, 0, "SERVICE-ID"),
        _param("MATCHING-REQUEST-PARAM", "RequestSID", *echo, at=1),
        _value("ResponseCode", "Dop.ResponseCode", 2),
    ]
    table = _node(
        "COMPLEX-VALUE",
        *(
            _node("SIMPLE-VALUE", str(number))
            for number in (identifiers.request_id, identifiers.response_id)
        ),
    )
    variant = _named(
        "BASE-VARIANT",
        f"{ECU}_Base",
        _dictionary((TEST_OPTION, TEST_STATUS, *DATA_RECORDS.values())),
        _list("DIAG-COMMS", (item.comm() for item in services)),
        _list(
            "REQUESTS",
            (item.message("REQUEST", "Request", item.sid, item.request) for item in services),
        ),
        _list(
            "POS-RESPONSES",
            (
                item.message("POS-RESPONSE", "Response", item.sid + POSITIVE_OFFSET, item.response)
                for item in services
            ),
        ),
        _list(
            "GLOBAL-NEG-RESPONSES",
            [
                _named("GLOBAL-NEG-RESPONSE", "NegativeResponse", _list("PARAMS", negative),
                       ID="Response.Negative")
            ],
        ),
        _list(
            "COMPARAM-REFS",
            [
                _node("COMPARAM-REF", table, _node("PROTOCOL-SNREF", SHORT_NAME=PROTOCOL),
                      ID_REF="Comparam.UniqueRespIdTable", DOCREF=SUBSET, DOCTYPE="COMPARAM-SUBSET")
            ],
        ),
        _list("PARENT-REFS", [_typed("PARENT-REF", "PROTOCOL-REF", ID_REF="Layer.Protocol")]),
        ID="Layer.Base",
    )  # fmt: skip
    spec = {"ID_REF": "Comparam.Spec", "DOCREF": PROTOCOL, "DOCTYPE": "COMPARAM-SPEC"}
    reference = _node("COMPARAM-SPEC-REF", **spec)
    protocol = _named("PROTOCOL", PROTOCOL, reference, ID="Layer.Protocol")
    parent = _list("PARENT-REFS", [_typed("PARENT-REF", "BASE-VARIANT-REF", ID_REF="Layer.Base")])
    return _named(
        "DIAG-LAYER-CONTAINER",
        ECU,
        _list("PROTOCOLS", [protocol]),
        _list("BASE-VARIANTS", [variant]),
        _list("ECU-VARIANTS", [_named("ECU-VARIANT", ECU, parent, ID="Layer.Computer")]),
        ID="Container",
    )


def _communication() -> tuple[Node, Node]:
    """Make the parameters of the transport that the description names, and their stack."""
    parts = [
        _named(
            "COMPARAM",
            name,
            _node("PHYSICAL-DEFAULT-VALUE", str(number)),
            _node("DATA-OBJECT-PROP-REF", ID_REF="Dop.Identifier"),
            ID=f"Comparam.{name}",
            PARAM_CLASS="UNIQUE_ID",
            CPTYPE="STANDARD",
            CPUSAGE="ECU-COMM",
        )
        for name, number in (
            ("CP_CanPhysReqId", UdsIdentifiers().request_id),
            ("CP_CanRespUSDTId", UdsIdentifiers().response_id),
        )
    ]
    table = _named(
        "COMPLEX-COMPARAM",
        "CP_UniqueRespIdTable",
        *parts,
        ID="Comparam.UniqueRespIdTable",
        PARAM_CLASS="UNIQUE_ID",
        CPTYPE="STANDARD",
        CPUSAGE="ECU-COMM",
        ALLOW_MULTIPLE_VALUES="true",
    )
    number = _property("Identifier", _identity(), _coded(4), "A_UINT32")
    subset = _named("COMPARAM-SUBSET", SUBSET, _list("COMPLEX-COMPARAMS", [table]),
                    _list("DATA-OBJECT-PROPS", [number]), ID="Comparam.Subset",
                    CATEGORY="TRANSPORT")  # fmt: skip
    reference = _node("COMPARAM-SUBSET-REF", ID_REF="Comparam.Subset", DOCREF=SUBSET,
                      DOCTYPE="COMPARAM-SUBSET")  # fmt: skip
    stack = _named("PROT-STACK", PROTOCOL, _node("PDU-PROTOCOL-TYPE", "ISO_15765_3_on_ISO_15765_2"),
                   _node("PHYSICAL-LINK-TYPE", "ISO_11898_2_DWCAN"),
                   _list("COMPARAM-SUBSET-REFS", [reference]), ID="Comparam.Stack")  # fmt: skip
    spec = _named("COMPARAM-SPEC", PROTOCOL, _list("PROT-STACKS", [stack]), ID="Comparam.Spec")
    return subset, spec


def pdx_content(identifiers: UdsIdentifiers) -> bytes:
    """Return the description as one archive.

    identifiers: of requests and responses. Returns the same bytes for the same services.
    """
    ET.register_namespace("xsi", XSI)
    subset, spec = _communication()
    files = {
        f"{ECU}.odx-d": _layer(identifiers),
        f"{SUBSET}.odx-cs": subset,
        f"{PROTOCOL}.odx-c": spec,
    }
    content = {
        name: _document(_node("ODX", item, MODEL_VERSION=ODX_VERSION))
        for name, item in files.items()
    }
    blocks = []
    for name in files:
        stem, _, suffix = name.partition(".")
        kind = f"application/x-asam.odx.{suffix}"
        file = _node("FILE", name, CREATION_DATE=DATE, MIME_TYPE=kind)
        named = _node("SHORT-NAME", stem)
        blocks.append(_node("ABLOCK", named, _list("FILES", [file]), UPD="UNCHANGED"))
    catalogue = _named("CATALOG", ECU, _list("ABLOCKS", blocks), F_DTD_VERSION=f"ODX-{ODX_VERSION}")
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as packed:
        for name, data in {"index.xml": _document(catalogue), **content}.items():
            packed.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED)
    return archive.getvalue()


def _document(root: Node) -> bytes:
    ET.indent(root, " ")
    return ET.tostring(root, "utf-8", xml_declaration=True)
