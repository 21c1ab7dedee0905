"""From decorated functions to LLVM's modules, by numba. Only processes that compile load this.

numba would optimise each function by itself, make machine code of it and link it into each one that
calls it, to optimise all of it anew there. Here it only translates: what a library needs is linked,
optimised and emitted once (`ehadiag.compile.object_code`). That changes numba for the whole
process, which therefore is one of its own (`ehadiag.compile.worker`).
"""

from __future__ import annotations

import sys
import warnings
from typing import Any

from ehadiag.compile.jit import ArrayKind, Kernel, Kind


def _load_numba() -> None:
    """Load numba without `.numba_config.yaml`: anybody may have put it into the working folder.

    numba reads the file once, while it is loaded, and only where it finds a parser of YAML.
    """
    if "numba" in sys.modules:
        return
    parser = sys.modules.get("yaml")
    sys.modules["yaml"] = None  # type: ignore[assignment] # so that importing it fails
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "A Numba config file is found")
            import numba  # noqa: F401, PLC0415
    finally:
        del sys.modules["yaml"]
        if parser is not None:
            sys.modules["yaml"] = parser


_load_numba()

import numba  # noqa: E402 - after its configuration is kept away
from numba import types  # noqa: E402
from numba.core import codegen, cpu, dispatcher, ir, postproc, targetconfig, transforms  # noqa: E402

import ehadiag.compile.vector_types  # noqa: E402, F401 - makes the vectors known to numba

_DISPATCHERS: dict[int, Any] = {}
"""numba's objects by the identity of kernels, of this process, which ends with its work."""


def dispatcher_type(kernel: Kernel) -> Any:
    """Return numba's type of a kernel."""
    if id(kernel) not in _DISPATCHERS:
        _DISPATCHERS[id(kernel)] = numba.njit(**kernel.targetoptions)(kernel.py_func)
    return _DISPATCHERS[id(kernel)]._numba_type_


def compiled(kernel: Kernel, kinds: tuple[Any, ...]) -> Any:
    """What numba keeps of a kernel for arguments of these types."""
    made = dispatcher_type(kernel).dispatcher
    made.compile(kinds)
    return made.overloads[kinds]


def modules_of(libraries: list[Any]) -> list[Any]:
    """Modules of functions and of all functions that they call, each once."""
    found, pending = {}, list(libraries)
    while pending:
        item = pending.pop()
        if id(item) not in found:
            found[id(item)] = item._final_module
            pending += item._linking_libraries
    return list(found.values())


NUMBER_TYPES = {"d": types.float64, "q": types.int64, "?": types.boolean}


def numba_type(kind: Kind) -> Any:
    """Return numba's type of a kind of argument."""
    if isinstance(kind, ArrayKind):
        return types.Array(numba.from_dtype(kind.dtype), kind.ndim, "C")
    if not isinstance(kind, tuple):
        return NUMBER_TYPES[kind]
    parts = [numba_type(item) for item in kind[1]]
    if kind[0] is tuple:
        return types.Tuple(parts)
    if len(set(parts)) == 1:
        return types.NamedUniTuple(parts[0], len(parts), kind[0])
    return types.NamedTuple(parts, kind[0])


def _only_translate() -> None:
    """Let numba neither optimise nor emit nor wrap for Python.

    Constants among the arguments of a call are plain numbers: a function would be compiled for each
    of them anew.
    """

    def finalize(library: Any) -> None:
        library._raise_if_finalized()
        library._finalized = True

    def keep_layout(library: Any, module: Any) -> None:
        module.data_layout = library._codegen._data_layout

    def add_overload(self: Any, result: Any) -> None:
        self.overloads[tuple(result.signature.args)] = result

    resolve = types.Dispatcher.get_call_type

    def call_of_plain(self: Any, context: Any, args: Any, kws: Any) -> Any:
        plain = {name: types.unliteral(kind) for name, kind in kws.items()}
        return resolve(self, context, tuple(map(types.unliteral, args)), plain)

    types.Dispatcher.get_call_type = call_of_plain
    codegen.CPUCodeLibrary.finalize = finalize
    codegen.CPUCodeLibrary._optimize_functions = keep_layout
    cpu.CPUContext.create_cpython_wrapper = lambda *_, **__: None
    cpu.CPUContext.create_cfunc_wrapper = lambda *_, **__: None
    cpu.CPUContext.get_executable = lambda *_: object()  # a key, and nothing else
    dispatcher.Dispatcher.add_overload = add_overload  # type: ignore[assignment]


_only_translate()


_write_array = cpu.CPUContext.make_constant_array


def order_bytes(order: str) -> None:
    """Give constant arrays the byte order of the target, < or >; numba takes this computer's."""

    def in_order(context: Any, builder: Any, kind: Any, values: Any) -> Any:
        return _write_array(context, builder, kind, values.astype(values.dtype.newbyteorder(order)))

    cpu.CPUContext.make_constant_array = in_order


def _skip_repetition() -> None:
    """Let numba not work out what nobody reads, or twice: a third of its time for the same code.

    The variables in use after each pass, where only the last pass needs them; variables in parts of
    instructions that hold none; options, one after the other, for comparisons; for each operation
    anew what it is on arguments of these types.
    """
    process, variables = postproc.PostProcessor.run, ir.Inst._rec_list_vars
    resolve, resolved = types.BaseFunction.get_call_type, dict[Any, Any]()
    without = {str, int, float, bool, type(None), ir.Loc}

    def process_last(self: Any, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
        if emit_dels or self.func_ir.is_generator:
            process(self, emit_dels, extend_lifetimes)
            return
        self.func_ir.blocks = transforms.canonicalize_cfg(self.func_ir.blocks)
        self.func_ir.variable_lifetime = postproc.VariableLifetime(self.func_ir.blocks)
        self.func_ir.generator_info = None

    def option_values(self: Any) -> dict[str, Any]:
        return {key: self._values.get(key, item.default) for key, item in self.options.items()}

    def call_resolved_once(self: Any, context: Any, args: Any, kws: Any) -> Any:
        key = self, args, tuple(kws.items())
        if key not in resolved:
            resolved[key] = resolve(self, context, args, kws)
        return resolved[key]

    types.BaseFunction.get_call_type = call_resolved_once
    postproc.PostProcessor.run = process_last
    ir.Inst._rec_list_vars = lambda self, part: (
        [] if type(part) in without else variables(self, part)
    )
    targetconfig.TargetConfig.values = option_values


_skip_repetition()
