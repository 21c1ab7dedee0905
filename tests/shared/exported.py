"""An exported object file loaded into this process, without a linker."""

import ctypes
from contextlib import suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import llvmlite.binding as llvm
import msgspec

from ehadiag import default_actuator
from ehadiag.compile import libraries
from ehadiag.compile.worker import object_code
from ehadiag.export.library import export_library
from ehadiag.export.targets import find_target
from firmware_iface.files import RESULT_MODE, Folder
from firmware_iface.stored_test import Line, SearchWindows, bundled_tests

HEAD = 68
"""Bytes of an archive before its index."""


def exported(name, place, ticks=0):
    """Folder of an export for a target; ticks: of a short test that it identifies, 0: its own."""
    return _exported(name, place, ticks)


@cache
def _exported(name, place, ticks):
    return _export(name, place / f"{name}-{ticks}", ticks)


def _export(name, out, ticks=0, actuator=None):
    out.mkdir()
    tests = [short_test(ticks)] if ticks else None
    with Folder.at(out, RESULT_MODE) as folder:
        export_library(actuator or default_actuator(), find_target(name), folder, tests=tests)
    return out


class _WantedError(Exception):
    """Instead of compiling an export."""


def compile_together(names, place):
    """Compile exports for targets of one order of bytes in one process, into the kernel cache.

    numba translates the kernels once, which for one target is two thirds of the time.
    """

    wanted = {}

    def refuse(item):
        wanted[name] = item
        raise _WantedError

    for name in names:
        with patch.object(libraries, "object_code", refuse), suppress(_WantedError):
            _export(name, place / f"wanted-{name}")
    if not wanted:  # all of them are in the cache
        return
    for name, code in zip(wanted, object_code(*wanted.values()), strict=True):
        with patch.object(libraries, "object_code", lambda _, code=code: [code]):
            _export(name, place / f"together-{name}")


def short_test(ticks):
    """A test in open loop of so many ticks."""
    end = ticks / 1000.0
    windows = SearchWindows(
        FDJ=((0.0, 0.5 * end),), Kintas=((0.3 * end, end),), FSS=((0.3 * end, end),),
        refinement=((0.3 * end, end),),
    )  # fmt: skip
    return msgspec.structs.replace(
        bundled_tests()["open"], segment=(Line(points=((0.0, 0.0), (end, 0.0))),), windows=windows
    )


def object_of(library):
    """The one object file in an archive."""
    place = int.from_bytes(library[HEAD + 4 : HEAD + 8], "big")
    return library[place + 60 : place + 60 + int(library[place + 48 : place + 58])]


class Loaded:
    """Functions of an object file for this computer."""

    def __init__(self, code):
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        machine = llvm.Target.from_default_triple().create_target_machine()
        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
        self._engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        self._engine.finalize_object()

    def function(self, name, arguments):
        """A function of so many pointers."""
        address = self._engine.get_function_address(name)
        return ctypes.CFUNCTYPE(ctypes.c_int32, *[ctypes.c_void_p] * arguments)(address)


@cache
def host_library(actuator=None):
    """The export for this computer, of an actuator; None: the reference."""
    with TemporaryDirectory() as place:
        out = _export("host", Path(place, "host"), actuator=actuator)
        code = (out / "libeha.a").read_bytes()
    return Loaded(object_of(code))
