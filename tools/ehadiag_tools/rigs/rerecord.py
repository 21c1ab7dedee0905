"""Plays a recording again on another bus: other messages, late time stamps, idle time before it.

The buses are the DBC files of this folder.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas
from cantools.database.can import Database
from msgspec.structs import replace
from numpy.typing import NDArray

from ehadiag.core.actuator import Actuator, default_actuator
from firmware_iface.bus_map import BusMap, default_map, resolve
from firmware_iface.codec import TickEncoder
from firmware_iface.dbc import parse_dbc
from firmware_iface.files import decode_toml
from firmware_iface.find_test import CandidateTests
from firmware_iface.mapping_file import MappingFile
from firmware_iface.recording import CHANNELS, BitState, CommandMode, Recording, Samples
from firmware_iface.signals.recordings import Interpretation, choose_recording, recorded_tests
from firmware_iface.stored_test import bundled_tests
from firmware_iface.transport.frames import Frame, FrameTable

TESTS = tuple(bundled_tests().values())
START_NS = 1_700_000_000_000_000_000
REST_S = 0.15
"""Beginning of each test in which nothing moves; it is what lies before and after the test too."""


@dataclass(frozen=True, slots=True)
class ForeignBus:
    """A bus by its DBC, whose signals have the names of their roles, `channels_spool`.

    The attributes `GenMsgCycleTime` and `GenMsgStartDelayTime` say when a message is sent, ms.
    """

    name: str
    dbc: str

    def schedule(self) -> dict[str, tuple[int, float]]:
        """Ticks between two messages of a name, and the instant within the tick, both 1 ms."""
        database, name, out = self._database(), "GenMsgStartDelayTime", {}
        assert database.dbc is not None
        usual = database.dbc.attribute_definitions[name].default_value
        for message in database.messages:
            assert message.dbc is not None
            own = message.dbc.attributes.get(name)
            at = float((usual if own is None else own.value) or 0.0)
            out[message.name] = message.cycle_time or 1, at
        return out

    def _database(self) -> Database:
        database = Database()
        database.add_dbc_string(self.dbc)
        return database

    def mapping(self) -> str:
        """The mapping file."""
        lines = ['schema = "ehadiag.mapping/1"', f'dbc = "{self.name}.dbc"', "tick_ms = 1.0"]
        for message in self._database().messages:
            for signal in message.signals:
                role = signal.name.replace("_", ".", 1)
                lines.append(f'{role} = {{ message = "{message.name}", signal = "{signal.name}" }}')
        return "\n".join(lines) + "\n"

    def bus_map(self) -> BusMap:
        """What decoder and encoder work from."""
        where = f"mapping of {self.name}"
        tree = decode_toml(self.mapping().encode(), MappingFile, where)
        return resolve(tree, parse_dbc(self.dbc.encode(), self.name), where, f"{self.name}.dbc")


BUSES = {
    name: ForeignBus(name, Path(__file__).with_name(f"{name}.dbc").read_text(encoding="ascii"))
    for name in ("psi29", "single", "canfd", "status", "command")
}
"""Foreign buses by name; what each tries is the comment of its DBC."""


@dataclass(frozen=True, slots=True)
class Disturbance:
    """What the bus, its adapter and the host's clock do to the time stamps.

    `jitter_ms`: deviation of a half-normal delay of each frame; the log keeps the order of arrival.
    """

    jitter_ms: float = 0.0
    lead_in_s: float = 0.0
    drift_ppm: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Played:
    """A recording with idle time before `begin` and from `end` on, ticks.

    Channels: current, spool, pressure, position, SI, NaN where lost, shape (4, ticks); commands in
    A or m, shape (ticks,).
    """

    channels: NDArray[np.float64]
    command: NDArray[np.float64]
    mode: CommandMode
    begin: int
    end: int


def played(samples: Samples, command: NDArray[np.float64], lead_in_s: float) -> Played:
    """Put idle time before and after a test, made of its own rest."""
    rest = round(REST_S * 1e9 / samples.period_ns)
    channels = np.stack([samples.current, samples.spool, samples.pressure, samples.position])
    before = round(lead_in_s * 1e9 / samples.period_ns)
    around = np.concatenate(
        [np.resize(np.arange(rest), before), np.arange(samples.ticks), np.arange(rest)]
    )
    idle = np.concatenate([np.zeros(before), command, np.zeros(rest)])
    return Played(channels[:, around], idle, samples.mode, before, before + samples.ticks)


def frames_on(
    bus: ForeignBus, recording: Recording, this: Played, how: Disturbance, seed: int
) -> tuple[FrameTable, BusMap]:
    """Frames of a recording on a bus, in order of arrival, and what they mean."""
    bus_map, rng = bus.bus_map(), np.random.default_rng(seed)
    tick_ns, schedule, encoder = default_map().tick_ns, bus.schedule(), TickEncoder(bus_map)
    messages = {(item.can_id, item.extended): item for item in bus_map.messages.values()}
    sent: dict[str, list[tuple[float, Frame]]] = {name: [] for name in schedule}
    sections = {role.name.partition(".")[0] for item in messages.values() for role in item.roles}
    for tick in range(len(this.command)):
        lost = bool(np.isnan(this.channels[:, tick]).any())
        _take_tick(encoder, sections - ({"channels"} if lost else set()), recording, this, tick)
        for frame in encoder.frames(0):
            message = messages[frame.can_id, frame.extended]
            every, at = schedule[message.name]
            # With a lost sample that shares its message a command is lost too.
            if tick % every == 0 and not (lost and message.measures):
                sent[message.name].append((tick + at, frame))
    rows: list[tuple[float, int, Frame]] = []
    for items in sent.values():
        stamps = _stamps(np.array([at for at, _ in items]), how, tick_ns, rng)
        for order, (late, (_, frame)) in enumerate(zip(stamps, items, strict=True)):
            time_ns = START_NS + round(late * (1.0 + how.drift_ppm * 1e-6) * tick_ns)
            rows.append((late, order, replace(frame, time_ns=time_ns)))
    rows.sort(key=lambda row: row[:2])
    return FrameTable.from_frames(frame for _, _, frame in rows), bus_map


def _take_tick(
    encoder: TickEncoder, sections: set[str], recording: Recording, this: Played, tick: int
) -> None:
    """Give the encoder the values of a tick in these sections of the mapping."""
    if "channels" in sections:
        pairs = zip(CHANNELS, this.channels[:, tick], strict=True)
        encoder.telemetry([int(item.encode(value)) for item, value in pairs], 0)
    if "command" in sections:
        encoder.command(this.mode, float(this.command[tick]), 0, 0)
    if "environment" in sections:
        known = recording.environment
        probes = known.supply_pressure, known.return_pressure, known.oil_temperature
        supply, back, oil = (value or 0.0 for value in probes)
        encoder.environment(supply, back, oil, 0)
    if "status" in sections:
        begun = BitState.COMPLETE if tick >= this.end else BitState.RUNNING
        state = begun if tick >= this.begin else BitState.IDLE
        number = (recording.test_id or 0) * (tick >= this.begin)
        elapsed = max(min(tick, this.end) - this.begin, 0) * 1e-3
        encoder.status(state, 0, number, elapsed, recording.serial or 0, 0)


def _stamps(
    true: NDArray[Any], how: Disturbance, tick_ns: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Time stamps in ticks, of the instants at which frames were sent."""
    late = true + np.abs(rng.normal(0.0, how.jitter_ms * 1e6 / tick_ns, len(true)))
    return np.maximum.accumulate(late)


def logged(
    this: Played, how: Disturbance, rate: float, tick_ns: int, seed: int
) -> dict[str, NDArray[np.float64]]:
    """What a data-acquisition system with a clock of its own writes of the bus's values.

    Its clock is fast by the drift, its rate in Hz. Columns: time in s, channels and command in SI,
    each value held until the next comes.
    """
    rng = np.random.default_rng(seed)
    ticks = this.channels.shape[1]
    known = np.flatnonzero(~np.isnan(this.channels).any(axis=0))
    telemetry = _stamps(np.asarray(known + 0.53), how, tick_ns, rng) * tick_ns * 1e-9
    command = _stamps(np.asarray(np.arange(ticks) + 0.4), how, tick_ns, rng) * tick_ns * 1e-9
    period = (1.0 + how.drift_ppm * 1e-6) / rate
    true = np.arange(int(ticks * tick_ns * 1e-9 / period)) * period
    true = true[true > max(telemetry[0], command[0])]
    sample = known[np.searchsorted(telemetry, true, side="right") - 1]
    heard = np.searchsorted(command, true, side="right") - 1
    channels = dict(zip(("current", "spool", "pressure", "position"), this.channels, strict=True))
    columns = {"time": np.arange(len(true)) / rate}
    columns |= {name: values[sample] for name, values in channels.items()}
    return columns | {f"{this.mode.name.lower()}_command": this.command[heard]}


def read_columns(
    columns: Mapping[str, NDArray[np.float64]], actuator: Actuator | None = None, name: str = "daq"
) -> Recording:
    """Write columns as a decoded CSV, and read its best test as `diagnose` does."""
    controller = (actuator or default_actuator()).controller
    meaning = Interpretation(default_map(), None, CandidateTests(TESTS, controller))
    with tempfile.TemporaryDirectory(prefix="ehadiag-") as folder:
        path = Path(folder) / f"{name}.csv"
        pandas.DataFrame(dict(columns)).to_csv(path, index=False, float_format="%.9g")
        return choose_recording(recorded_tests([path], meaning))
