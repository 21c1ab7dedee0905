"""Object files for other computers from compiled kernels, by the LLVM that is in numba.

Each product and each sum is rounded by itself, so that every processor comes to the same digits.
Kernels that need numba's run-time library are refused; of a C library only RUNTIME_FUNCTIONS are
called. For a processor without doubles each result is rounded to single precision, on LLVM's text.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from numba import types
from numba.core.registry import cpu_target

from ehadiag.compile.frontend import compiled, modules_of, numba_type, order_bytes
from ehadiag.compile.worker import (
    CFunction,
    DoublesArgument,
    ObjectFile,
    Processor,
    SlotArguments,
    TableArgument,
)
from firmware_iface.errors import ConfigurationError

LLVM_NAME = r'%(?:"[^"]+"|[\w.$-]+)'
LLVM_KIND = r"double|<\d+ x double>"
LLVM_ARITHMETIC = re.compile(
    rf"^  ({LLVM_NAME}) = ((?:fadd|fsub|fmul|fdiv) ({LLVM_KIND}) |(?:sitofp|uitofp) .* to "
    rf"({LLVM_KIND}))(.*)$",
    re.M,
)
LLVM_ROOT = re.compile(
    rf"^  ({LLVM_NAME}) = (?:tail )?call double @llvm\.sqrt\.f64\(double ([^)]+)\).*$", re.M
)
LLVM_CONSTANT = re.compile(r"(?<![\w.%\"-])(-?\d+\.\d+e[+-]\d+|0x[0-9A-F]{16})\b")


def single_precision(text: str) -> str:
    """Round results of arithmetic on doubles in a module's text to single precision."""
    text = LLVM_ROOT.sub(_root, LLVM_ARITHMETIC.sub(_rounded, text))
    if "@llvm.sqrt.f32(" in text:
        text += "\ndeclare float @llvm.sqrt.f32(float)\n"
    return text


def _inner(name: str, what: str) -> str:
    plain = name[1:].strip('"')
    return f'%"{plain}.{what}"'


def _rounded(found: re.Match[str]) -> str:
    name, operation, kind, made, rest = found.groups()
    kind = kind or made
    narrow = kind.replace("double", "float")
    wide, cut = _inner(name, "wide"), _inner(name, "single")
    return (
        f"  {wide} = {operation}{LLVM_CONSTANT.sub(_constant, rest)}\n"
        f"  {cut} = fptrunc {kind} {wide} to {narrow}\n"
        f"  {name} = fpext {narrow} {cut} to {kind}"
    )


def _root(found: re.Match[str]) -> str:
    name, of = found.groups()
    cut, root = _inner(name, "of"), _inner(name, "single")
    return (
        f"  {cut} = fptrunc double {of} to float\n"
        f"  {root} = call float @llvm.sqrt.f32(float {cut})\n"
        f"  {name} = fpext float {root} to double"
    )


def _constant(found: re.Match[str]) -> str:
    digits = found[0]
    number = (
        struct.unpack(">d", bytes.fromhex(digits[2:]))[0]
        if digits.startswith("0x")
        else float(digits)
    )
    try:
        rounded = struct.unpack(">f", struct.pack(">f", number))[0]
    except OverflowError:  # no number of single precision
        return digits
    return f"0x{struct.pack('>d', rounded).hex().upper()}"


RUNTIME_FUNCTIONS = frozenset({"memcpy", "memset", "memmove"})
"""What of a C library the code may call."""
MEMORY_FUNCTIONS = """
define hidden ptr @memset(ptr %to, i32 %byte, i64 %count) "no-builtins" {
begin:
  %value = trunc i32 %byte to i8
  br label %next
next:
  %n = phi i64 [0, %begin], [%m, %step]
  %more = icmp ult i64 %n, %count
  br i1 %more, label %step, label %end
step:
  %place = getelementptr i8, ptr %to, i64 %n
  store i8 %value, ptr %place
  %m = add i64 %n, 1
  br label %next
end:
  ret ptr %to
}
define hidden ptr @memcpy(ptr %to, ptr %from, i64 %count) "no-builtins" {
begin:
  br label %next
next:
  %n = phi i64 [0, %begin], [%m, %step]
  %more = icmp ult i64 %n, %count
  br i1 %more, label %step, label %end
step:
  %source = getelementptr i8, ptr %from, i64 %n
  %byte = load i8, ptr %source
  %place = getelementptr i8, ptr %to, i64 %n
  store i8 %byte, ptr %place
  %m = add i64 %n, 1
  br label %next
end:
  ret ptr %to
}
"""
"""The functions of a C library that LLVM calls for what it takes them for; for a library that has
no other beside it."""
EXCEPTION = re.compile(r'store ptr @"?\.const\.picklebuf[^,]*, ptr')
"""Where a function of numpy that a kernel uses would raise an error: its status says that, too."""
FAST_MATH_FLAGS = re.compile(
    r"(?<!%)\b(?:contract|nnan|nsz|ninf|arcp|afn|reassoc|fast) (?=[^\"]*$)", re.M
)
"""Leave to round otherwise, to fuse a product and a sum above all: what a compiler makes of it
depends on the processor, and with it the last digit."""


DEFINITION = re.compile(r"^(define .*?)((?: align \d+)?(?: ![^{]*)?) \{$", re.M)
"""First line of a function. Its stack is to begin where a line of the cache does: a vector that
straddles two takes longer, 7 % of a run of the model."""


@dataclass(frozen=True, slots=True)
class _Machine:
    """Target of LLVM, and how modules for it are marked."""

    triple: str
    layout: str
    target: Any = field(repr=False)


def emitted(wanted: ObjectFile) -> bytes:
    """Emit an object file.

    wanted: what is to be in it. Returns the object file, of the format of the target.
    ConfigurationError: the compiler has no such target.
    """
    processor, replaced = wanted.processor, wanted.replaced
    machine = _machine(processor)
    order_bytes("<" if machine.layout.startswith("e") else ">")
    main = _parsed(_head(machine) + _front(wanted.functions, wanted.tables, replaced), machine)
    names = {item.name for item in wanted.functions}
    kernels = list(_kernels(wanted.functions, replaced))
    for single in (False, True):
        some = [
            item for item in kernels if (processor.single and item[0] not in wanted.exact) is single
        ]
        if some:
            main.link_in(_module(some, machine, replaced, processor, single))
    whole = _parsed(_closed(str(main), names), machine)
    _optimise(whole, machine, processor)
    if processor.fast:
        whole = _parsed(DEFINITION.sub(r'\1 "stackrealign"\2 {', str(whole)), machine)
        whole.link_in(_parsed(_head(machine) + MEMORY_FUNCTIONS, machine))
    # After the optimisation, and weak for what follows it: no code depends on a table's values.
    whole.link_in(_parsed(_head(machine) + _definitions(wanted.tables), machine))
    foreign = {item.name for item in whole.functions if item.is_declaration}
    foreign -= RUNTIME_FUNCTIONS | wanted.allowed
    foreign = {name for name in foreign if not name.startswith("llvm.")}
    if foreign:
        raise RuntimeError(f"kernels that call {', '.join(sorted(foreign))} cannot be compiled")
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
            opt=_level(processor),
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
    functions: Sequence[CFunction], replaced: Mapping[str, Any]
) -> Iterable[tuple[Any, tuple[Any, ...]]]:
    """Every kernel once, with the types of its arguments."""
    seen = set()
    for item in functions:
        if id(item.kernel) not in seen:
            seen.add(id(item.kernel))
            yield item.kernel, _types(item)
    for kernel in replaced.values():
        yield kernel, (types.float64,)


def _types(item: CFunction) -> tuple[Any, ...]:
    if isinstance(item.arguments, SlotArguments):
        return tuple(numba_type(kind) for kind in item.kernel.kinds[0])
    return tuple(
        (types.UniTuple(types.float64, kind.count) if kind.count > 1 else types.float64)
        if isinstance(kind, DoublesArgument)
        else types.intp
        for kind in item.arguments
    )


def _module(
    kernels: Sequence[tuple[Any, tuple[Any, ...]]],
    machine: _Machine,
    replaced: Mapping[str, Any],
    processor: Processor,
    single: bool,
) -> Any:
    """Link the modules of kernels and of all that they call."""
    results = [compiled(kernel, kinds) for kernel, kinds in kernels]
    names = {item.fndesc.llvm_func_name for item in results}
    module = llvm.parse_assembly(_head(machine))
    for item in modules_of([result.library for result in results]):
        module.link_in(item, preserve=True)
    for item in module.functions:
        if not item.is_declaration:
            item.linkage = "external" if item.name in names else "internal"
    if single:
        _tidy(module)  # so that constants stand where they are used
    text = EXCEPTION.sub("store ptr null, ptr", str(module))
    if not processor.fast:
        text = FAST_MATH_FLAGS.sub("", text)
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
    functions: Sequence[CFunction],
    tables: Mapping[str, Sequence[float]],
    replaced: Mapping[str, Any],
) -> str:
    """The C functions, the stand-ins and the declarations of the tables, as LLVM's text."""
    parts = [
        f"@{name} = external constant [{len(values)} x double], align 8"
        for name, values in tables.items()
    ]
    parts += [_c_function(item) for item in functions]
    for function, kernel in replaced.items():
        name = compiled(kernel, (types.float64,)).fndesc.llvm_func_name
        parts.append(
            f'declare i32 @"{name}"(ptr, ptr, double)\n'
            f"define double @{_stand_in(function)}(double %x) {{\n"
            "  %result = alloca double\n  %error = alloca ptr\n"
            f'  call i32 @"{name}"(ptr %result, ptr %error, double %x)\n'
            "  %value = load double, ptr %result\n  ret double %value\n}"
        )
    return "\n".join(parts) + "\n"


def _definitions(tables: Mapping[str, Sequence[float]]) -> str:
    return "".join(
        f"@{name} = weak hidden constant [{len(values)} x double] [{_doubles(values)}], align 8\n"
        for name, values in tables.items()
    )


def _doubles(values: Sequence[float]) -> str:
    bits = np.asarray(values, dtype=np.float64).view(np.uint64).tolist()
    return ", ".join(f"double 0x{value:016X}" for value in bits)


def _c_function(item: CFunction) -> str:
    """A function of pointers that returns an int: the same in every calling convention."""
    result = compiled(item.kernel, _types(item))
    if isinstance(item.arguments, SlotArguments):
        return _slot_function(item.name, result)
    name, whole = result.fndesc.llvm_func_name, "i64"
    if types.unliteral(result.signature.return_type) != types.int64:
        raise RuntimeError(f"{item.name}: the kernel returns {result.signature.return_type}")
    parameters, lines = [], []
    passed, kinds = ["ptr %result", "ptr %error"], ["ptr", "ptr"]
    for index, kind in enumerate(item.arguments):
        if not isinstance(kind, TableArgument):
            parameters.append(f"ptr %a{index}")
        if isinstance(kind, DoublesArgument):
            for n in range(kind.count):
                lines.append(f"%g{index}_{n} = getelementptr double, ptr %a{index}, i32 {n}")
                lines.append(f"%n{index}_{n} = load double, ptr %g{index}_{n}, align 8")
                passed.append(f"double %n{index}_{n}")
                kinds.append("double")
            continue
        source = f"@{kind.name}" if isinstance(kind, TableArgument) else f"%a{index}"
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


def _slot_function(name: str, result: Any) -> str:
    """A function of a pointer to arguments in slots of 8 bytes, behind that of the result."""
    kind = cpu_target.target_context.call_conv.get_function_type(
        result.fndesc.restype, result.fndesc.argtypes
    )
    lines, passed, kinds = [], ["ptr %slots", "ptr %error"], ["ptr", "ptr"]
    for place, given in enumerate(kind.args[2:]):
        shown = "ptr" if given.is_pointer else str(given)
        lines.append(f"%g{place} = getelementptr i64, ptr %slots, i32 {place + 1}")
        lines.append(f"%v{place} = load {shown}, ptr %g{place}, align 8")
        passed.append(f"{shown} %v{place}")
        kinds.append(shown)
    body = "\n  ".join(lines)
    called = result.fndesc.llvm_func_name
    return (
        f'declare i32 @"{called}"({", ".join(kinds)})\n'
        f"define i32 @{name}(ptr %slots) {{\n  %error = alloca ptr\n  {body}\n"
        f'  %status = call i32 @"{called}"({", ".join(passed)})\n  ret i32 %status\n}}'
    )


def _closed(text: str, wanted: set[str]) -> str:
    """Make everything but the wanted functions private, so that what is not called goes."""
    module = llvm.parse_assembly(text)
    for item in (*module.functions, *module.global_variables):
        if not item.is_declaration:
            item.linkage = "external" if item.name in wanted else "internal"
    return str(module)


def _optimise(module: Any, machine: _Machine, processor: Processor) -> None:
    options = llvm.create_pipeline_tuning_options(_level(processor))
    options.loop_vectorization = options.loop_unrolling = processor.fast
    options.slp_vectorization = False
    builder = llvm.create_pass_builder(machine.target, options)
    builder.getModulePassManager().run(module, builder)


def _level(processor: Processor) -> int:
    return 3 if processor.fast else 2
