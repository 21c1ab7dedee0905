"""Decoded signals in TDMS, HDF5 and MATLAB 7.3: the same as in a table of text."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest

from ehadiag import ConfigurationError, InputOutputError
from firmware_iface.logs.log_files import Budget
from firmware_iface.logs.reader import read_frames
from firmware_iface.signals.columns import ColumnMap, named_columns
from firmware_iface.signals.tables import read_signals

TIME = np.arange(200) / 1000.0
VALUES = {
    "current": 1e-3 * np.sin(TIME),
    "spool": 1e-4 * np.cos(TIME),
    "pressure": 1e6 * np.sin(3.0 * TIME),
    "position": 1e-2 * np.cos(5.0 * TIME),
}


def assert_read(path, columns=None):
    found = read_signals(path, columns or ColumnMap(), Budget())
    for name, values in VALUES.items():
        assert found[f"channels.{name}"].time == pytest.approx(TIME, abs=1e-9)
        assert found[f"channels.{name}"].value == pytest.approx(values, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("waveform", [True, False])
def test_tdms(tmp_path, waveform):
    nptdms = pytest.importorskip("nptdms")
    path = tmp_path / "rig.tdms"
    timing = {"wf_increment": 1e-3, "wf_start_offset": 0.0, "wf_samples": 1}
    with nptdms.TdmsWriter(path) as writer:
        for name, values in VALUES.items():
            scale, unit = (1e3, "mm") if name == "position" else (1.0, None)
            properties = (timing if waveform else {}) | ({"unit_string": unit} if unit else {})
            writer.write_segment(
                [nptdms.ChannelObject("Rig", name, values * scale, properties=properties)]
            )
        if not waveform:
            writer.write_segment([nptdms.ChannelObject("Rig", "time", TIME)])
    assert_read(path)


@pytest.mark.parametrize(("name", "shape"), [("rig.h5", (-1,)), ("rig.mat", (1, -1))])
def test_hdf5_and_matlab(tmp_path, name, shape):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / name
    with h5py.File(path, "w") as file:
        group = file.create_group("run")
        group["t"] = (TIME * 1e3).reshape(shape)
        for key, values in VALUES.items():
            group[key] = values.reshape(shape)
        group["spool"][...] *= 1e3
        group["spool"].attrs["unit"] = "mm"
        group["note"] = "text"
    assert_read(path, named_columns(["time=t:ms"], ColumnMap()))
    with pytest.raises(ConfigurationError, match="no channel of time stamps"):
        read_signals(path, ColumnMap(), Budget())


def test_a_table_in_hdf5(tmp_path):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "table.hdf5"
    table = np.rec.fromarrays([TIME, *VALUES.values()], names=["time", *VALUES])
    with h5py.File(path, "w") as file:
        file["data"] = table
    assert_read(path)


def test_an_old_matlab_file_is_one_line(tmp_path):
    pytest.importorskip("h5py")
    path = tmp_path / "old.mat"
    path.write_bytes(b"MATLAB 5.0 MAT-file" + bytes(600))
    with pytest.raises(InputOutputError, match=r"-v7\.3"):
        read_signals(path, ColumnMap(), Budget())


def test_mf4_needs_no_name_of_its_time(tmp_path):
    asammdf = pytest.importorskip("asammdf")
    path = tmp_path / "rig.mf4"
    with asammdf.MDF() as file:
        file.append([asammdf.Signal(v, TIME, name=k) for k, v in VALUES.items()])
        file.save(path)
    assert_read(path, named_columns(["time=t_s:s"], ColumnMap()))


def test_mf4_of_several_groups(tmp_path):
    """Each group has a time of its own; a name that two groups have is told with its group."""
    asammdf = pytest.importorskip("asammdf")
    path = tmp_path / "rig.mf4"
    slow = np.arange(20) / 10.0
    with asammdf.MDF() as file:
        file.append([asammdf.Signal(slow, slow, name=name) for name in ("oil", "spool")])
        for name, values in VALUES.items():
            file.append([asammdf.Signal(values, TIME, name=name)])
        file.save(path)
    with pytest.raises(ConfigurationError, match="spool"):
        read_signals(path, ColumnMap(), Budget())
    assert_read(path, named_columns(["spool=2/spool"], ColumnMap()))


def packed_bomb(path, method=0, unpacked=96 << 20):
    """Write an MF4 file one of whose blocks unpacks to much more than it states."""
    asammdf = pytest.importorskip("asammdf")
    with asammdf.MDF() as file:
        file.append([asammdf.Signal(values, TIME, name=name) for name, values in VALUES.items()])
        file.save(path, compression=1)
    content = path.read_bytes()
    at = content.index(b"##DZ")
    end = len(content) + -len(content) % 8
    content = content.replace(struct.pack("<Q", at), struct.pack("<Q", end))
    path.write_bytes(content.ljust(end, b"\0") + block(zlib.compress(bytes(unpacked)), method))
    return path


def block(data, method=0):
    head = struct.pack("<4xQQ2sBxIQQ", 48 + len(data), 0, b"DT", method, 0, 6400, len(data))
    return b"##DZ" + head + data


@pytest.mark.parametrize("method", [0, 1])
def test_a_block_of_mf4_that_unpacks_to_more_than_it_states(tmp_path, monkeypatch, method):
    path = packed_bomb(tmp_path / "bomb.mf4", method)
    assert path.stat().st_size < 1 << 20
    asammdf = pytest.importorskip("asammdf")
    monkeypatch.setattr(asammdf, "MDF", None)  # nothing is left to the library
    with pytest.raises(InputOutputError, match="one block of it to more than 64 MiB"):
        read_signals(path, ColumnMap(), Budget())
    with pytest.raises(InputOutputError, match="one block of it to more than 64 MiB"):
        read_frames(path)


def test_damaged_blocks_of_mf4_count_with_what_they_unpack_to(tmp_path):
    """Each is below the limit of one; the work on all of them is not."""
    path = packed_bomb(tmp_path / "bombs.mf4", unpacked=6400)
    damaged = zlib.compress(bytes(63 << 20))[:-4] + b"none"
    with path.open("ab") as file:
        file.write(3 * block(damaged))
    with pytest.raises(InputOutputError, match="unpacks to more than 128 MiB"):
        read_frames(path)


@pytest.mark.parametrize("method", [6, 0])
def test_data_that_look_like_a_block_of_mf4_are_none(tmp_path, method):
    asammdf = pytest.importorskip("asammdf")
    path = tmp_path / "rig.mf4"
    with asammdf.MDF() as file:
        file.append([asammdf.Signal(values, TIME, name=name) for name, values in VALUES.items()])
        file.save(path)
    with path.open("ab") as file:
        file.write(block(b"no deflate", method) + b"##DZ")
    assert_read(path)


def test_another_packing_of_mf4_is_named(tmp_path):
    path = packed_bomb(tmp_path / "bomb.mf4", method=2, unpacked=100)
    with pytest.raises(InputOutputError, match="save it by deflate"):
        read_signals(path, ColumnMap(), Budget())


def test_rows_that_an_mf4_file_states_are_bounded(tmp_path):
    asammdf = pytest.importorskip("asammdf")
    path = tmp_path / "long.mf4"
    with asammdf.MDF() as file:
        file.append([asammdf.Signal(values, TIME, name=name) for name, values in VALUES.items()])
        file.save(path)
    content = bytearray(path.read_bytes())
    at = content.index(b"##CG")
    rows = at + 32 + 8 * int.from_bytes(content[at + 16 : at + 24], "little")
    assert int.from_bytes(content[rows : rows + 8], "little") == len(TIME)
    content[rows : rows + 8] = (10**15).to_bytes(8, "little")
    path.write_bytes(content)
    with pytest.raises(InputOutputError, match="more than 800000 values"):
        read_signals(path, ColumnMap(), Budget())


def test_blocks_of_hdf5_are_bounded(tmp_path):
    """A block is unpacked whole, however few of its values are the data set's."""
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "rig.h5"
    with h5py.File(path, "w") as file:
        for name, values in (VALUES | {"time": TIME}).items():
            shape = {"shape": values.shape, "maxshape": (None,), "dtype": "f8"}
            item = file.create_dataset(name, **shape, chunks=(1 << 24,), compression="gzip")
            assert len(item) == len(values)  # nothing is written: no block is on the disk
    with pytest.raises(InputOutputError, match="blocks of more than 64 MiB"):
        read_signals(path, ColumnMap(), Budget())


def write_hdf(path, **options):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        for name, values in (VALUES | {"time": TIME}).items():
            file.create_dataset(name, data=values, chunks=(64,), **options)


@pytest.mark.parametrize("more", [{}, {"compression": "gzip"}])
def test_blocks_of_hdf5_with_checksums_are_read(tmp_path, more):
    write_hdf(tmp_path / "rig.h5", shuffle=True, fletcher32=True, **more)
    assert_read(tmp_path / "rig.h5")


def test_a_block_of_hdf5_that_is_not_packed_is_read(tmp_path):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "rig.h5"
    write_hdf(path, compression="gzip")
    with h5py.File(path, "r+") as file:
        raw = VALUES["spool"][64:128].astype("<f8").tobytes()
        file["spool"].id.write_direct_chunk((64,), raw, filter_mask=1)
    assert_read(path)


@pytest.mark.parametrize("unpacked", [1 << 20, 1 << 25])
def test_a_block_of_hdf5_that_unpacks_to_more_than_it_states(tmp_path, unpacked):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "bomb.h5"
    write_hdf(path, compression="gzip")
    with h5py.File(path, "r+") as file:
        file["spool"].id.write_direct_chunk((64,), zlib.compress(bytes(unpacked)))
    with pytest.raises(InputOutputError, match="'/spool' is damaged: a block of it unpacks to"):
        read_signals(path, ColumnMap(), Budget())


def test_another_packing_of_hdf5_is_named(tmp_path):
    write_hdf(tmp_path / "rig.h5", compression="lzf")
    with pytest.raises(InputOutputError, match="store it by gzip"):
        read_signals(tmp_path / "rig.h5", ColumnMap(), Budget())
