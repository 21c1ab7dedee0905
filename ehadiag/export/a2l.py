"""Writes the A2L file (ASAM MCD-2 MC 1.6) of what a flight-control computer offers by XCP."""

from __future__ import annotations

from collections.abc import Iterator

from ehadiag.core.actuator import Actuator
from ehadiag.core.conventions import __version__
from ehadiag_sim.simulation import scales_of
from firmware_iface.bus_map import BusMap
from firmware_iface.xcp import (
    IDENTITY,
    MAX_DTO_BYTES,
    MAX_ENTRY_BYTES,
    MAX_ODTS,
    TICK_EVENT,
    TICK_EVENT_NAME,
    Command,
    Measurement,
    XcpIds,
    event_cycle,
    is_extended,
    measurements_of,
)

A2L_FILE = f"{IDENTITY}.a2l"
EXTENDED_ID = 0x80000000
"""Marks an identifier of 29 bits."""
DECIMALS = {"mA": 4, "mm": 5, "MPa": 4, "degC": 2}
"""Digits after the point in which a unit is shown; 0 of others."""
INTERFACE_DATA = """\
    /begin A2ML
      block "IF_DATA" taggedunion if_data {
        "XCP" struct {
          taggedstruct {
            block "PROTOCOL_LAYER" struct {
              uint; /* version of the protocol layer */
              uint; uint; uint; uint; uint; uint; uint; /* T1 to T7, ms */
              uchar; /* MAX_CTO */
              uint; /* MAX_DTO */
              enum { "BYTE_ORDER_MSB_LAST" = 0, "BYTE_ORDER_MSB_FIRST" = 1 };
              enum { "ADDRESS_GRANULARITY_BYTE" = 1, "ADDRESS_GRANULARITY_WORD" = 2,
                     "ADDRESS_GRANULARITY_DWORD" = 4 };
              taggedstruct { ("OPTIONAL_CMD" enum { @COMMANDS@ })*; };
            };
            block "DAQ" struct {
              enum { "STATIC" = 0, "DYNAMIC" = 1 };
              uint; uint; uchar; /* MAX_DAQ, MAX_EVENT_CHANNEL, MIN_DAQ */
              enum { "OPTIMISATION_TYPE_DEFAULT" = 0 };
              enum { "ADDRESS_EXTENSION_FREE" = 0 };
              enum { "IDENTIFICATION_FIELD_TYPE_ABSOLUTE" = 0 };
              enum { "GRANULARITY_ODT_ENTRY_SIZE_DAQ_BYTE" = 1 };
              uchar; /* MAX_ODT_ENTRY_SIZE_DAQ */
              enum { "NO_OVERLOAD_INDICATION" = 0 };
              taggedstruct {
                "PRESCALER_SUPPORTED";
                block "TIMESTAMP_SUPPORTED" struct {
                  uint; /* ticks */
                  enum { "NO_TIME_STAMP" = 0, "SIZE_BYTE" = 1, "SIZE_WORD" = 2, "SIZE_DWORD" = 4 };
                  enum { "UNIT_1NS" = 0, "UNIT_10NS" = 1, "UNIT_100NS" = 2, "UNIT_1US" = 3 };
                };
                (block "EVENT" struct {
                  char[101]; char[9]; /* name, short name */
                  uint; /* channel */
                  enum { "DAQ" = 1, "STIM" = 2, "DAQ_STIM" = 3 };
                  uchar; uchar; uchar; uchar; /* MAX_DAQ_LIST, cycle, unit, priority */
                })*;
              };
            };
            block "XCP_ON_CAN" struct {
              uint; /* version of the transport layer */
              taggedstruct {
                "CAN_ID_MASTER" ulong;
                "CAN_ID_SLAVE" ulong;
              };
            };
          };
        };
      };
    /end A2ML"""
"""Types of the interface's data, as far as this file has them (ASAM MCD-1 XCP 1.1)."""


def a2l_text(actuator: Actuator, bus_map: BusMap, ids: XcpIds) -> str:
    """Return the A2L file of a computer.

    bus_map: what it states of converters comes before the actuator file. Returns ASCII.
    """
    measurements = measurements_of(scales_of(bus_map, actuator).channels)
    period_ns = round(1e9 / actuator.controller.rate)
    return "\n".join(
        (
            "ASAP2_VERSION 1 61",
            f'/begin PROJECT {IDENTITY} "flight-control computer of an electrohydraulic actuator"',
            f'  /begin HEADER "written by ehadiag {__version__}"',
            "  /end HEADER",
            f'  /begin MODULE {IDENTITY} ""',
            INTERFACE_DATA.replace("@COMMANDS@", _listed(Command)),
            '    /begin MOD_COMMON ""',
            "      BYTE_ORDER MSB_LAST",
            *(f"      ALIGNMENT_{name} {size}" for size, name in ((1, "BYTE"), (2, "WORD"))),
            "      ALIGNMENT_LONG 4",
            "    /end MOD_COMMON",
            *_interface(ids, period_ns),
            *(line for item in measurements for line in _measurement(item)),
            '    /begin GROUP telemetry "all measurements" ROOT',
            "      /begin REF_MEASUREMENT",
            *(f"        {item.name}" for item in measurements),
            "      /end REF_MEASUREMENT",
            "    /end GROUP",
            "  /end MODULE",
            "/end PROJECT",
            "",
        )
    )


def _listed(commands: type[Command]) -> str:
    return ", ".join(f'"{item.name}" = {item.value}' for item in commands)


def _interface(ids: XcpIds, period_ns: int) -> Iterator[str]:
    required = (Command.CONNECT, Command.DISCONNECT, Command.GET_STATUS, Command.SYNCH)
    cycle, unit = event_cycle(period_ns)
    master, slave = (item | (EXTENDED_ID if is_extended(item) else 0) for item in ids)
    yield from (
        "    /begin IF_DATA XCP",
        "      /begin PROTOCOL_LAYER",
        f"        0x0101 2000 2000 2000 2000 2000 2000 2000 {MAX_DTO_BYTES} {MAX_DTO_BYTES}",
        "        BYTE_ORDER_MSB_LAST ADDRESS_GRANULARITY_BYTE",
        *(f"        OPTIONAL_CMD {item.name}" for item in Command if item not in required),
        "      /end PROTOCOL_LAYER",
        "      /begin DAQ",
        f"        DYNAMIC {MAX_ODTS} 1 0 OPTIMISATION_TYPE_DEFAULT ADDRESS_EXTENSION_FREE",
        "        IDENTIFICATION_FIELD_TYPE_ABSOLUTE GRANULARITY_ODT_ENTRY_SIZE_DAQ_BYTE",
        f"        {MAX_ENTRY_BYTES} NO_OVERLOAD_INDICATION",
        "        PRESCALER_SUPPORTED",
        "        /begin TIMESTAMP_SUPPORTED 1 SIZE_DWORD UNIT_1US",
        "        /end TIMESTAMP_SUPPORTED",
        f'        /begin EVENT "{TICK_EVENT_NAME}" "{TICK_EVENT_NAME}" {TICK_EVENT} DAQ 255'
        f" {cycle} {unit} 255",
        "        /end EVENT",
        "      /end DAQ",
        "      /begin XCP_ON_CAN 0x0101",
        f"        CAN_ID_MASTER 0x{master:X}",
        f"        CAN_ID_SLAVE 0x{slave:X}",
        "      /end XCP_ON_CAN",
        "    /end IF_DATA",
    )


def _measurement(item: Measurement) -> Iterator[str]:
    low, high = (item.step * (raw - item.zero) for raw in item.raw_ends)
    conversion = "NO_COMPU_METHOD"
    if item.unit:
        conversion = f"{item.name}_{item.unit}"
        yield f'    /begin COMPU_METHOD {conversion} "" LINEAR "%9.{DECIMALS[item.unit]}"'
        yield f'      "{item.unit}" COEFFS_LINEAR {item.step!r} {0.0 - item.step * item.zero!r}'
        yield "    /end COMPU_METHOD"
    yield f'    /begin MEASUREMENT {item.name} "{item.meaning}"'
    yield f"      {item.datatype} {conversion} 0 0 {low!r} {high!r}"
    yield f"      ECU_ADDRESS 0x{item.address:X}"
    yield "    /end MEASUREMENT"
