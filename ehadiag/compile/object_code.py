"""Object files for other computers from compiled kernels, by the compiler that is in numba.

numba keeps with each compiled kernel its LLVM module. Of it the kernel itself is taken, with a
C function in front that converts nothing but pointers, and code for the target is emitted: each
product and each sum rounded by itself, so that every processor comes to the same digits. numba's
run-time library stays behind: kernels that need it are refused. Of a C library only `RUNTIME` is
called, which compilers too may call in any program.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import llvmlite.binding as llvm
import numba
import numpy as np
from numba import types

from ehadiag.compile.single import single_precision
from ehadiag.core.errors import ConfigurationError

__all__ = [
    "RUNTIME",
    "Function",
    "Numbers",
    "Pointer",
    "Processor",
    "Table",
    "object_code",
    "tool_versions",
]

RUNTIME = frozenset({"memcpy", "memset", "memmove"})
"""What of a C library the code may call."""
OPTIMISE = 2
LEAVE = re.compile(r"\b(?:contract|nnan|nsz|ninf|arcp|afn|reassoc|fast) (?=[^\"]*$)", re.M)
"""Leave to round otherwise, to fuse a product and a sum above all: what a compiler makes of it
depends on the processor, and with it the last digit."""


@dataclass(frozen=True, slots=True)
class Pointer:
    """Argument of a C function whose address the kernel is given."""


@dataclass(frozen=True, slots=True)
class Numbers:
    """Argument of a C function that points to doubles, which the kernel is given as a tuple.

    Attributes
    ----------
    count : int
        How many; 1: a number, not a tuple.
    """

    count: int


@dataclass(frozen=True, slots=True)
class Table:
    """Not an argument of the C function: the kernel is given the address of constants.

    Attributes
    ----------
    name : str
        Of the table.
    """

    name: str


@dataclass(frozen=True, slots=True)
class Function:
    """A C function, `int name(pointer, …)`, and the kernel behind it.

    Attributes
    ----------
    name : str
        Of the C function.
    kernel : Any
        Decorated kernel that returns a whole number; it takes addresses, numbers and tuples of
        numbers.
    arguments : tuple[Pointer | Numbers | Table, ...]
        In the order of the kernel's.
    """

    name: str
    kernel: Any
    arguments: tuple[Pointer | Numbers | Table, ...]


@dataclass(frozen=True, slots=True)
class Processor:
    """What code is emitted for, in LLVM's names.

    Attributes
    ----------
    triple : str
        Empty: this computer.
    cpu : str
        Processor; "host": this one.
    features : str
        What it has beyond or less than its name says.
    abi : str
        Calling convention, empty: the triple's.
    shared : bool
        Whether the code may be part of a shared library.
    rounds : bool
        Whether it rounds to whole numbers by an instruction. Where not, a function of the C library
        would be called, and no Arm code can hand it a number in both calling conventions.
    doubles : bool
        Whether it has instructions for doubles. Where not, the compiler's run-time library has
        their arithmetic, but no square root.
    single : bool
        Whether results are rounded to single precision, see `ehadiag.compile.single`.
    """

    triple: str
    cpu: str = ""
    features: str = ""
    abi: str = ""
    shared: bool = False
    rounds: bool = True
    doubles: bool = True
    single: bool = False


@dataclass(frozen=True, slots=True)
class _Machine:
    """Of LLVM, with what a module must be marked with."""

    triple: str
    layout: str
    target: Any = field(repr=False)


def object_code(
    functions: Sequence[Function],
    tables: Mapping[str, Sequence[float]],
    replaced: Mapping[str, Any],
    processor: Processor,
    *,
    allowed: frozenset[str] = frozenset(),
    exact: frozenset[Any] = frozenset(),
) -> bytes:
    """Emit an object file with these C functions.

    Parameters
    ----------
    functions : Sequence[Function]
        The functions.
    tables : Mapping[str, Sequence[float]]
        Constants by name.
    replaced : Mapping[str, Any]
        Functions of one number of the C library, and the kernels that stand for them.
    processor : Processor
        The target.
    allowed : frozenset[str]
        What else of the C library the code may call.
    exact : frozenset[Any]
        Kernels of which no result is rounded to single precision.

    Returns
    -------
    bytes
        The object file, of the format of the target.

    Raises
    ------
    ConfigurationError
        The compiler has no such target.
    """
    machine = _machine(processor)
    main = _parsed(_head(machine) + _front(functions, tables, replaced), machine)
    wanted = {item.name for item in functions}
    for kernel, kinds in _kernels(functions, replaced):
        main.link_in(
            _module(kernel, kinds, machine, replaced, processor.single and kernel not in exact)
        )
    text = _closed(str(main), wanted)
    whole = _parsed(text, machine)
    _optimise(whole, machine)
    foreign = {item.name for item in whole.functions if item.is_declaration} - RUNTIME - allowed
    foreign = {name for name in foreign if not name.startswith("llvm.")}
    if foreign:
        raise RuntimeError(f"kernels that call {', '.join(sorted(foreign))} cannot be exported")
    code: bytes = machine.target.emit_object(whole)
    return code


def _machine(processor: Processor) -> _Machine:
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    triple = processor.triple or llvm.get_process_triple()
    cpu, features = processor.cpu, processor.features
    if cpu == "host":
        cpu, features = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
    try:
        target = llvm.Target.from_triple(triple).create_target_machine(
            cpu=cpu,
            features=features,
            opt=OPTIMISE,
            reloc="pic" if processor.shared else "static",
            codemodel="default",
            **({"abiname": processor.abi} if processor.abi else {}),
        )
    except RuntimeError as error:
        raise ConfigurationError(f"no code for {triple}: {error}") from None
    return _Machine(triple, str(target.target_data), target)


def _head(machine: _Machine) -> str:
    return f'target datalayout = "{machine.layout}"\ntarget triple = "{machine.triple}"\n'


def _parsed(text: str, machine: _Machine) -> Any:
    module = llvm.parse_assembly(text)
    module.triple, module.data_layout = machine.triple, machine.layout
    module.verify()
    return module


def _kernels(
    functions: Sequence[Function], replaced: Mapping[str, Any]
) -> Iterable[tuple[Any, tuple[Any, ...]]]:
    """Every kernel once, with the types of its arguments."""
    seen = set()
    for item in functions:
        if id(item.kernel) not in seen:
            seen.add(id(item.kernel))
            yield item.kernel, _types(item)
    for kernel in replaced.values():
        yield kernel, (types.float64,)


def _types(item: Function) -> tuple[Any, ...]:
    return tuple(
        (types.UniTuple(types.float64, kind.count) if kind.count > 1 else types.float64)
        if isinstance(kind, Numbers)
        else types.intp
        for kind in item.arguments
    )


def _compiled(kernel: Any, kinds: tuple[Any, ...]) -> Any:
    """What numba keeps of a kernel for these types."""
    kernel.compile(kinds)
    return kernel.overloads[kinds]


def _module(
    kernel: Any,
    kinds: tuple[Any, ...],
    machine: _Machine,
    replaced: Mapping[str, Any],
    single: bool,
) -> Any:
    """Take a kernel's module, without the parts that only Python calls."""
    result = _compiled(kernel, kinds)
    name = result.fndesc.llvm_func_name
    # What numba itself would link into another kernel that calls this one.
    module = llvm.parse_bitcode(result.library._get_module_for_linking().as_bitcode())
    for item in module.functions:
        if not item.is_declaration:
            item.linkage = "external" if item.name == name else "internal"
    _tidy(module)
    text = str(module)
    text = LEAVE.sub("", text)
    # The intrinsic is one instruction where there is one.
    text = re.sub(r"^declare double @sqrt\(.*$", "", text, flags=re.M)
    if "@sqrt(" in text:
        text = text.replace("@sqrt(", "@llvm.sqrt.f64(")
        if "declare double @llvm.sqrt.f64(" not in text:
            text += "\ndeclare double @llvm.sqrt.f64(double)\n"
    if single:
        text = single_precision(text)
    for function in replaced:
        for called in (f"llvm.{function}.f64", function):
            text = re.sub(rf"^declare double @{re.escape(called)}\(.*$", "", text, flags=re.M)
            text = re.sub(rf"@{re.escape(called)}\(", f"@{_stand_in(function)}(", text)
        if f"@{_stand_in(function)}(" in text:
            text += f"\ndeclare double @{_stand_in(function)}(double)\n"
    text = re.sub(
        r'^(source_filename|target datalayout|target triple) = ".*"\n', "", text, flags=re.M
    )
    return _parsed(_head(machine) + text, machine)


def _tidy(module: Any) -> None:
    """Drop what nothing calls."""
    machine = llvm.Target.from_triple(module.triple).create_target_machine()
    builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(1))
    builder.getModulePassManager().run(module, builder)


def _stand_in(function: str) -> str:
    return f"eha_own_{function}"


def _front(
    functions: Sequence[Function],
    tables: Mapping[str, Sequence[float]],
    replaced: Mapping[str, Any],
) -> str:
    """The C functions, the tables and the stand-ins, as LLVM's text."""
    parts = [
        f"@{name} = constant [{len(values)} x double] [{_doubles(values)}], align 8"
        for name, values in tables.items()
    ]
    parts += [_c_function(item) for item in functions]
    for function, kernel in replaced.items():
        name = _compiled(kernel, (types.float64,)).fndesc.llvm_func_name
        parts.append(
            f'declare i32 @"{name}"(ptr, ptr, double)\n'
            f"define double @{_stand_in(function)}(double %x) {{\n"
            "  %result = alloca double\n  %error = alloca ptr\n"
            f'  call i32 @"{name}"(ptr %result, ptr %error, double %x)\n'
            "  %value = load double, ptr %result\n  ret double %value\n}"
        )
    return "\n".join(parts) + "\n"


def _doubles(values: Sequence[float]) -> str:
    bits = np.asarray(values, dtype=np.float64).view(np.uint64).tolist()
    return ", ".join(f"double 0x{value:016X}" for value in bits)


def _c_function(item: Function) -> str:
    """A function of pointers that returns an int: the same in every calling convention."""
    result = _compiled(item.kernel, _types(item))
    name, whole = result.fndesc.llvm_func_name, "i64"
    if types.unliteral(result.signature.return_type) != types.int64:
        raise RuntimeError(f"{item.name}: the kernel returns {result.signature.return_type}")
    parameters, lines = [], []
    passed, kinds = ["ptr %result", "ptr %error"], ["ptr", "ptr"]
    for index, kind in enumerate(item.arguments):
        if not isinstance(kind, Table):
            parameters.append(f"ptr %a{index}")
        if isinstance(kind, Numbers):
            for n in range(kind.count):
                lines.append(f"%g{index}_{n} = getelementptr double, ptr %a{index}, i32 {n}")
                lines.append(f"%n{index}_{n} = load double, ptr %g{index}_{n}, align 8")
                passed.append(f"double %n{index}_{n}")
                kinds.append("double")
            continue
        source = f"@{kind.name}" if isinstance(kind, Table) else f"%a{index}"
        lines.append(f"%p{index} = ptrtoint ptr {source} to i64")
        passed.append(f"i64 %p{index}")
        kinds.append("i64")
    body = "\n  ".join(lines)
    return (
        f'declare i32 @"{name}"({", ".join(kinds)})\n'
        f"define i32 @{item.name}({', '.join(parameters)}) {{\n"
        f"  %result = alloca {whole}\n  %error = alloca ptr\n  {body}\n"
        f'  %status = call i32 @"{name}"({", ".join(passed)})\n'
        f"  %wide = load {whole}, ptr %result\n  %value = trunc {whole} %wide to i32\n"
        "  ret i32 %value\n}"
    )


def _closed(text: str, wanted: set[str]) -> str:
    """Make everything but the wanted functions private, so that what is not called goes."""
    module = llvm.parse_assembly(text)
    for item in (*module.functions, *module.global_variables):
        if not item.is_declaration:
            item.linkage = "external" if item.name in wanted else "internal"
    return str(module)


def _optimise(module: Any, machine: _Machine) -> None:
    options = llvm.create_pipeline_tuning_options(OPTIMISE)
    options.loop_vectorization = options.slp_vectorization = False
    options.loop_unrolling = False
    builder = llvm.create_pass_builder(machine.target, options)
    builder.getModulePassManager().run(module, builder)


def tool_versions() -> dict[str, str]:
    """Versions of what emits the code."""
    return {
        "numba": numba.__version__,
        "llvm": ".".join(map(str, llvm.llvm_version_info)),
    }
