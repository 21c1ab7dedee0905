"""Write the first inputs of each target: `python tools/fuzz/seeds.py tests/data/fuzz`."""

from __future__ import annotations

import gzip
import io
import sys
import tempfile
from dataclasses import replace
from importlib import resources
from pathlib import Path

import pandas

from firmware_iface.codec.encode import Encoder
from firmware_iface.logs.recorder import Recorder
from firmware_iface.transport.frames import Frame
from firmware_iface.transport.serial_link import packet_of

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from fuzz.files import SIGNALS
from fuzz.targets import KINDS, RECORD, SEALED

TELEMETRY = 0x110


def _bus(ticks: int, serial: int = 7, codes: int = 2048) -> list[Frame]:
    """A short test as the computer sends it."""
    encoder = Encoder()
    frames: list[Frame] = []
    for tick in range(ticks):
        now = tick * 1_000_000
        if tick % 20 == 0:
            frames += encoder.status(2, 0, 1, tick / 1000, serial, now)
        frames += encoder.command(1, 1e-6 * tick, 1, now + 130_000)
        frames += encoder.telemetry((codes + tick, 2048, 2000, 2050), now + 260_000)
    frames += encoder.environment(20.7e6, 0.7e6, 40.0, ticks * 1_000_000)
    frames += encoder.status(3, 0, 1, ticks / 1000, serial, ticks * 1_000_000 + 130_000)
    return frames


def _many_signals(count: int) -> bytes:
    """A message of many multiplexed signals."""
    rows = [f' SG_ S{n} m{n} : 16|8@1+ (1,0) [0|255] "" A' for n in range(count)]
    head = 'VERSION ""\nBU_: A\nBO_ 1 M: 8 A\n SG_ X M : 0|16@1+ (1,0) [0|0] "" A\n'
    return (head + "\n".join(rows) + "\n").encode()


def _records(frames: list[Frame]) -> bytes:
    places = {0x110: 0, 0x111: 1, 0x120: 2, 0x200: 3, 0x201: 4}
    out, last = b"", 0
    for frame in frames:
        step = (frame.time_ns - last) // 1000
        choice = places[frame.can_id] | frame.channel << 6
        out += RECORD.pack(SEALED, choice, step, 8, frame.data)
        last = frame.time_ns
    return out


def _log(suffix: str, frames: list[Frame]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"log{suffix}"
        with Recorder(path) as recorder:
            for frame in frames:
                recorder.write(frame)
        return path.read_bytes()


def _decoded(rows: int) -> pandas.DataFrame:
    """Decoded signals by their usual names."""
    at = [row / 1000 for row in range(rows)]
    columns = ("current", "spool", "pressure", "position")
    return pandas.DataFrame(
        {
            "time": at,
            **{f"channels.{name}": [1e-5 * row for row in range(rows)] for name in columns},
        }
    )


def _signals(frames: list[Frame]) -> dict[str, bytes]:
    """Recordings of the target `signals`, by name."""
    lines = "".join(
        f"({frame.time_ns * 1e-9:.6f}) can0 {frame.can_id:03X}#{frame.data.hex().upper()}\n"
        for frame in frames
    ).encode()
    table = _decoded(40)
    parquet = io.BytesIO()
    table.to_parquet(parquet, index=False)
    plain = table.to_csv(index=False).encode()
    german = table.to_csv(index=False, sep=";", decimal=",").encode()
    contents = {
        "candump": (".log", lines),
        "table": (".csv", plain),
        "german": (".csv", german),
        "parquet": (".parquet", parquet.getvalue()),
        "packed-log": (".log.gz", gzip.compress(lines, mtime=0)),
        "torn-gzip": (".csv.gz", gzip.compress(plain, mtime=0)[:-20]),
        "packed-table": ("packed.csv.gz", plain),
        "packed-candump": ("packed.log.gz", lines),
    }
    return {
        f"signals/{name}": bytes((SIGNALS.index(kind),)) + content
        for name, (kind, content) in contents.items()
    }


def _configurations() -> dict[str, bytes]:
    """Files of the target `configurations`, by name."""
    data = resources.files("ehadiag").joinpath("data")
    bus = resources.files("firmware_iface").joinpath("data")
    columns = '[time]\ncolumn = "t"\nunit = "s"\n[channels.spool]\ncolumn = "x"\nunit = "mm"\n'
    mapping = bus.joinpath("eha_fcc.toml").read_bytes()
    return {
        "configurations/actuator": b"\0" + data.joinpath("actuator.toml").read_bytes(),
        "configurations/test": b"\1" + data.joinpath("tests/open.toml").read_bytes(),
        "configurations/columns": b"\2" + columns.encode(),
        "configurations/mapping": b"\3" + mapping,
        "configurations/dbc-elsewhere": b"\3" + mapping.replace(b"eha_fcc.dbc", b"/dev/zero"),
        "configurations/deep": b"\0" + b"a" + b".a" * 200 + b" = 1",
    }


def main() -> None:
    """Write the files."""
    root = Path(sys.argv[1])
    frames = _bus(12)
    second = _bus(12, serial=8, codes=1000)
    both = sorted(frames + second, key=lambda frame: frame.time_ns)
    shifted = [replace(frame, channel=2) for frame in second]
    long = [replace(f, time_ns=f.time_ns + k * 12_000_000) for k in range(5) for f in frames]
    data = resources.files("firmware_iface").joinpath("data")
    inputs = {
        "frames/test": _records(frames),
        "frames/one": _records(frames[1:2]),
        "frames/two-senders": _records(both),
        "frames/two-channels": _records(frames + shifted),
        "frames/standing-counter": _records([frames[2]] * 3 + second[2:6]),
        "windows/long": _records(long),
        "windows/two-senders": _records(both),
        "windows/no-status": _records([f for f in long if f.can_id == TELEMETRY]),
        "mappings/many-signals": b"\1" + _many_signals(40),
        "mappings/deep-key": b"\0" + b"a" + b".a" * 40 + b" = 1",
        "mappings/not-a-dbc": b"\1root:x:0:0:root:/root:/bin/sh\n",
        "mappings/huge-scale": b"\1"
        + data.joinpath("eha_fcc.dbc").read_bytes().replace(b"(0.0005,", b"(1e308,"),
        "serial/packets": b"".join(packet_of(frame) for frame in frames[:6]),
        "serial/torn": packet_of(frames[0])[5:] + packet_of(frames[1]),
        "mappings/mapping": b"\0" + data.joinpath("eha_fcc.toml").read_bytes(),
        "mappings/dbc": b"\1" + data.joinpath("eha_fcc.dbc").read_bytes(),
    }
    inputs |= {**_signals(frames), **_configurations()}
    for number, suffix in enumerate(KINDS):
        if suffix.startswith("."):
            inputs[f"logs/{suffix[1:]}"] = bytes((number,)) + _log(suffix, frames)
            inputs[f"logs/two-channels-{suffix[1:]}"] = bytes((number,)) + _log(
                suffix, frames + shifted
            )
    for name, content in inputs.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


if __name__ == "__main__":
    main()
