"""An exported object file loaded into this process, without a linker."""

import ctypes
from functools import cache

import llvmlite.binding as llvm

from ehadiag.core.actuator import default_actuator
from ehadiag.core.folder import RESULT_MODE, Folder
from ehadiag.export.library import export_library
from ehadiag.export.targets import target

HEAD = 68
"""Bytes of an archive before its index."""


@cache
def exported(name, place):
    """Folder of an export for a target."""
    out = place / name
    out.mkdir()
    with Folder.at(out, RESULT_MODE) as folder:
        export_library(default_actuator(), target(name), folder)
    return out


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
