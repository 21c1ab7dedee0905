"""Shared libraries of the kernels: which there are, where they come from, how they are loaded.

A library that came with the package is taken where it was made of the sources that are here, for a
level of instructions that this processor has, and has the digest that the manifest names. Else one
of the cache folder, else one is compiled into it. All levels of a processor give the same digits.
The hash of a library's sources covers its modules and all project modules that they import, without
docstrings and comments.
"""

from __future__ import annotations

import ast
import contextlib
import ctypes
import hashlib
import json
import os
import platform
import struct
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from msgspec.structs import replace

from ehadiag.compile.jit import Kernel
from ehadiag.compile.worker import (
    GROUND_LANES,
    CFunction,
    ObjectFile,
    Processor,
    SlotArguments,
    object_code,
)
from firmware_iface.errors import reason_of
from firmware_iface.files import Folder, private_folder, warn_once

PACKAGES = ("ehadiag", "firmware_iface", "ehadiag_sim")
"""Packages whose modules hold kernels, or numbers and functions that kernels use."""
KERNEL_DIGEST = hashlib.sha256
MAX_LIBRARY_BYTES = 64 << 20
"""Size of a file in the folder, bytes, at most; the largest library has half a megabyte."""
SOURCE_DIGESTS_FILE = "sources.json"
"""Digests of source files by the hash of their bytes: parsing all of them takes 0.3 s."""
PREBUILT = Path(__file__).parent.parent / "_kernels"
"""Folder of the libraries that came with the package."""
LIBRARIES: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "search": {
        "ehadiag.model.simd_residuals": ("run_blocks",),
        "ehadiag.model.simd_jack": ("fill_driven_jack_costs",),
        "ehadiag.identify.residual_lines": ("fill_lines", "fill_sums"),
    },
    "model": {
        "ehadiag.model.simd_residuals": ("run_single", "respond"),
        "ehadiag.monitor.monitor_memory": ("prepare_monitor", "reset_monitor"),
        "ehadiag.monitor.push_kernel": ("push_tick", "push_ticks"),
        "ehadiag.model.laws": ("fill_control_currents",),
        "ehadiag.identify.compact_ga": ("draw_generation", "update_state"),
    },
    "simulator": {"ehadiag_sim.plant_dynamics": ("advance_plant",)},
}
"""Kernels of each library by their modules, the one that takes longest to compile first. A kernel
in none of them is a library of its own."""
LANES_OF = {"search": GROUND_LANES}
"""Candidates side by side in a library's kernels, where they are more than one."""
SHIPPED = ("search", "model", "simulator")
"""Libraries that come with the package: all of several kernels."""
IDENTIFICATION, SIMULATION = ("search", "model"), ("simulator",)
"""Libraries that every identification and every simulation needs."""
_X86, _ARM = "x86_64-unknown-linux-gnu", "aarch64-unknown-linux-gnu"
LEVELS: Mapping[tuple[str, str], Processor] = {
    ("x86_64", "avx512"): Processor(_X86, "x86-64-v4", shared=True, fast=True),
    ("x86_64", "avx2"): Processor(_X86, "x86-64-v3", shared=True, fast=True),
    ("x86_64", "sse2"): Processor(_X86, "x86-64", shared=True, rounds=False, fast=True),
    ("aarch64", "neon"): Processor(_ARM, "generic", shared=True, fast=True),
}
"""Levels of instructions by architecture, best first, for which there are shared libraries."""
_V3 = frozenset({"avx2", "fma", "bmi1", "bmi2", "f16c", "movbe", "abm"})
_V4 = _V3 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}
LEVEL_FLAGS: Mapping[str, frozenset[str]] = {"avx512": _V4, "avx2": _V3}
"""What Linux must say of a processor that has a level, as LLVM's x86-64-v3 and v4 need it."""
NO_LEVEL = ("", "host")
"""Elsewhere: object files for this very processor, which LLVM loads."""
HOST = Processor("", "host", fast=True)
MANIFEST = "manifest.json"


@cache
def processor_level() -> tuple[str, str]:
    """Architecture and best level of instructions of this processor."""
    machine, flags = platform.machine(), frozenset[str]()
    if sys.platform != "linux":
        return NO_LEVEL
    if machine == "x86_64":
        lines = Path("/proc/cpuinfo").read_text("ascii", "replace").splitlines()
        shown = next((line for line in lines if line.startswith("flags")), "")
        flags = frozenset(shown.partition(":")[2].split())
    levels = (key for key in LEVELS if key[0] == machine)
    return next((key for key in levels if LEVEL_FLAGS.get(key[1], set()) <= flags), NO_LEVEL)


def entry_address(kernel: Kernel) -> int:
    """Address of a kernel's C function; its library is loaded, or made."""
    module, name = kernel.py_func.__module__, kernel.py_func.__qualname__
    held = (key for key, parts in LIBRARIES.items() if name in parts.get(module, ()))
    return _loaded(next(held, f"{module}:{name}"))(_symbol(module, name))


def prepare(names: Iterable[str], progress: Callable[[str], None] = lambda _text: None) -> None:
    """Find or make libraries, several at a time.

    names: of the libraries; progress: is given a line of text when one has been compiled.
    """
    absent = missing(names)
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        waiting = {pool.submit(_content, name): name for name in absent}
        for left, done in enumerate(as_completed(waiting), 1 - len(absent)):
            done.result()
            progress(f"compiled: {waiting[done]}, {-left} left")


def compile_kernels(
    notify: Callable[[str], None], *, simulation: bool = False, identification: bool = True
) -> None:
    """Compile the kernels that are needed and not there, several at a time.

    notify: is given lines for who waits, none where nothing is compiled; simulation: whether
    something is simulated; identification: whether something is identified.
    """
    needed = SIMULATION * simulation + IDENTIFICATION * identification
    absent = missing(needed)
    if absent:
        kept = cache_folder() is not None
        often = "once for this installation" if kept else "in memory, at each start"
        notify(f"compiling the model's kernels ({', '.join(absent)}), {often}: up to a minute")
        prepare(absent, notify)


def missing(names: Iterable[str]) -> list[str]:
    """Libraries of these that must be compiled."""
    return [name for name in names if _prebuilt(name) is None and read_cached(_file(name)) is None]


def build(folder: Path, levels: Collection[tuple[str, str]]) -> None:
    """Write all libraries for levels of instructions into a folder, with their manifest.

    folder: where to; it is made; levels: keys of LEVELS.
    """
    folder.mkdir(parents=True, exist_ok=True)
    jobs = [(name, level) for name in SHIPPED for level in levels]
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        made = list(pool.map(lambda job: _compiled(*job), jobs))
    digests = {}
    for (name, level), content in zip(jobs, made, strict=True):
        file = f"{name}-{'-'.join(level)}.so"
        (folder / file).write_bytes(content)
        digests[file] = KERNEL_DIGEST(content).hexdigest()
    manifest = {
        "sources": {name: _sources(name) for name in SHIPPED},
        "compiler": tool_versions(),
        "sha256": digests,
    }
    (folder / MANIFEST).write_text(json.dumps(manifest, indent=1))
    modules = {part for name in SHIPPED for part in _modules(name)}
    kept = {item.key: item[1:] for part in modules for item in sources_of(part).values()}
    (folder / SOURCE_DIGESTS_FILE).write_text(json.dumps(kept, sort_keys=True))


def _symbol(module: str, name: str) -> str:
    return f"{module.replace('.', '_')}__{name}"


def _parts(library: str) -> Mapping[str, tuple[str, ...]]:
    """Kernels of a library by their modules."""
    module, _, name = library.partition(":")
    return LIBRARIES.get(library, {module: (name,)})


def _modules(library: str) -> tuple[str, ...]:
    """Modules of a library's kernels, and of what makes code of them."""
    return (*_parts(library), "ehadiag.compile.object_code", "ehadiag.compile.elf")


@cache
def _sources(library: str) -> str:
    """Hash of all that a library is made of."""
    made_of = [source_hash(item) for item in _modules(library)], LANES_OF.get(library, 1)
    return KERNEL_DIGEST(repr(made_of).encode()).hexdigest()[:16]


def compiler_versions() -> dict[str, str]:
    """Versions of what compiled the kernels: where the package came with them, or here."""
    if _prebuilt(SHIPPED[0]) is None:
        return tool_versions()
    found: dict[str, str] = _manifest()["compiler"]
    return found


@cache
def _manifest() -> dict[str, Any]:
    """What the package says of its libraries; nothing where it came without."""
    try:
        manifest: dict[str, Any] = json.loads((PREBUILT / MANIFEST).read_bytes())
    except FileNotFoundError:
        return {}
    return manifest


@cache
def _prebuilt(library: str) -> bytes | None:
    """A library that came with the package, if it fits."""
    manifest, level = _manifest(), processor_level()
    if library not in SHIPPED or not manifest:
        return None
    if manifest["sources"].get(library) != _sources(library):
        warn_once("the kernels that came with the package are not those of its sources: compiling")
        return None
    usable = [key for key in LEVELS if key[0] == level[0]]
    usable = usable[usable.index(level) :] if level in usable else []
    for key in usable:
        file = f"{library}-{'-'.join(key)}.so"
        if file in manifest["sha256"]:
            content = (PREBUILT / file).read_bytes()
            if KERNEL_DIGEST(content).hexdigest() == manifest["sha256"][file]:
                return content
            warn_once(f"{PREBUILT / file}: not the file that the package came with: compiling")
            return None
    warn_once("the package came without kernels for this processor: compiling")
    return None


@cache
def _file(library: str) -> str:
    """Name in the cache folder."""
    processor = LEVELS.get(processor_level(), HOST)
    made_by = repr((_sources(library), processor, tool_versions())).encode()
    stem = library.replace(":", "-").replace(".", "_")
    return f"{stem}-{KERNEL_DIGEST(made_by).hexdigest()[:16]}.kernel"


@cache
def _content(library: str) -> bytes:
    """A library, wherever it comes from."""
    return _prebuilt(library) or _compiled(library, processor_level())


def _compiled(library: str, level: tuple[str, str]) -> bytes:
    """Compile a library; one for this processor is kept in the cache folder."""
    if level != processor_level():
        return _made(library, level)
    return cached(_file(library), lambda: _made(library, level))


def _made(library: str, level: tuple[str, str]) -> bytes:
    """Compile a library."""
    from ehadiag.compile.elementary import C_FUNCTIONS, ROUNDING_FUNCTIONS  # noqa: PLC0415
    from ehadiag.compile.elf import shared_library  # noqa: PLC0415 - not where nothing is compiled

    functions = [
        CFunction(_symbol(module, name), getattr(import_module(module), name), SlotArguments())
        for module, names in _parts(library).items()
        for name in names
    ]
    processor = LEVELS.get(level, HOST)
    replaced = C_FUNCTIONS if processor.rounds else C_FUNCTIONS | ROUNDING_FUNCTIONS
    lanes = LANES_OF.get(library, 1)
    (code,) = object_code(ObjectFile(functions, processor, replaced=replaced, lanes=lanes))
    names = [item.name for item in functions]
    return code if level == NO_LEVEL else shared_library(code, names)


def object_files(*wanted: ObjectFile) -> list[bytes]:
    """Object code with its tables, compiled or from the cache folder.

    wanted: what is to be in each; of one order of bytes. The code does not depend on the values in
    its tables. Returns the object files, of the formats of their targets. EhadiagError: the
    compiler is not installed, or has no such target.
    """
    blank = {
        _export_file(item): replace(
            item, tables={name: _placeholder(name, len(row)) for name, row in item.tables.items()}
        )
        for item in wanted
    }
    codes = {file: code for file in blank if (code := read_cached(file)) is not None}
    absent = [file for file in blank if file not in codes]
    made: dict[str, bytes] = {}

    def code_of(file: str) -> bytes:
        if not made:
            made.update(zip(absent, object_code(*map(blank.__getitem__, absent)), strict=True))
        return made[file]

    codes |= {file: cached(file, partial(code_of, file)) for file in absent}
    filled = []
    for item, (file, empty) in zip(wanted, blank.items(), strict=True):
        code = codes[file]
        for name, numbers in item.tables.items():
            code = _with_table(code, empty.tables[name], numbers)
        filled.append(code)
    return filled


def _export_file(wanted: ObjectFile) -> str:
    """Name in the cache folder."""
    kernels = [item.kernel.py_func for item in wanted.functions]
    kernels += [item.py_func for item in wanted.replaced.values()]
    modules = {item.__module__ for item in kernels} | {"ehadiag.compile.object_code"}
    made_by = (
        [(item.name, item.arguments) for item in wanted.functions],
        [f"{item.__module__}.{item.__qualname__}" for item in kernels],
        sorted(wanted.replaced),
        sorted(wanted.allowed),
        sorted(item.py_func.__qualname__ for item in wanted.exact),
        [(name, len(numbers)) for name, numbers in wanted.tables.items()],
        [source_hash(item) for item in sorted(modules)],
        wanted.processor,
        tool_versions(),
    )
    return f"export-{KERNEL_DIGEST(repr(made_by).encode()).hexdigest()[:16]}.kernel"


def _placeholder(name: str, count: int) -> list[float]:
    """Numbers that stand for a table in compiled code, and nowhere else."""
    digits = hashlib.shake_256(name.encode()).digest(6 * count)
    return [2.0**52 + int.from_bytes(digits[6 * i : 6 * i + 6], "big") for i in range(count)]


def _with_table(code: bytes, blank: Sequence[float], numbers: Sequence[float]) -> bytes:
    """Write a table over its placeholder, in the target's order of bytes."""
    for order in "<>":
        kind = f"{order}{len(blank)}d"
        if code.count(struct.pack(kind, *blank)) == 1:
            return code.replace(struct.pack(kind, *blank), struct.pack(kind, *numbers))
    raise RuntimeError("compiled code does not have its table in one piece")


@cache
def _loaded(library: str) -> Callable[[str], int]:
    """Load a library; returns the function that finds the address of a name."""
    content = _content(library)
    if processor_level() == NO_LEVEL:
        return _loaded_object(content)
    # What was checked is what is loaded: a file of its own, which no other process can change. It
    # stays open, since the loader takes two files of one path for the same.
    handle = os.memfd_create(library)
    os.write(handle, content)
    shared = ctypes.CDLL(f"/proc/self/fd/{handle}")

    def address(name: str) -> int:
        return ctypes.cast(getattr(shared, name), ctypes.c_void_p).value or 0

    return address


def _loaded_object(content: bytes) -> Callable[[str], int]:
    """Load an object file by LLVM, where there are no shared libraries."""
    import llvmlite.binding as llvm  # noqa: PLC0415 - not where it is not needed

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    machine = llvm.Target.from_default_triple().create_target_machine()
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
    engine.add_object_file(llvm.ObjectFileRef.from_data(content))
    engine.finalize_object()
    found: Callable[[str], int] = engine.get_function_address
    return found


@cache
def cache_folder() -> Folder | None:
    """Folder of compiled libraries, opened once; None where there is none."""
    return private_folder("kernels")


def read_cached(file: str) -> bytes | None:
    """Read compiled code from the cache folder; a damaged file is removed."""
    folder = cache_folder()
    if folder is None:
        return None
    try:
        content = folder.read(file, MAX_LIBRARY_BYTES)
        size = KERNEL_DIGEST().digest_size
        if KERNEL_DIGEST(content[size:]).digest() == content[:size]:
            return content[size:]
        why = "damaged"
    except FileNotFoundError:
        return None
    except OSError as error:
        why = reason_of(error)
    warn_once(f"cache folder {folder.path}: a compiled kernel is {why}; thrown away")
    try:
        folder.remove(file)
    except OSError as error:
        warn_once(f"cache folder {folder.path}: {reason_of(error)}")
    return None


def cached(file: str, compile_code: Callable[[], bytes]) -> bytes:
    """Compiled code of the cache folder; code that is not in it is compiled, and kept there."""
    folder, found = cache_folder(), read_cached(file)
    if found is not None or folder is None:
        return found or compile_code()
    from filelock import FileLock  # noqa: PLC0415 - only where something is compiled

    content = b""
    try:
        with FileLock(folder.path / f"{file}.lock"):  # another process may be compiling the same
            content = read_cached(file) or compile_code()
            folder.write(file, KERNEL_DIGEST(content).digest() + content, synced=False)
    except OSError as error:
        warn_once(
            f"cache folder {folder.path}: {reason_of(error)}; the compiled kernels are"
            " not kept for the next run"
        )
    return content or compile_code()


@cache
def source_hash(module: str) -> str:
    """Hash of a module and of all project modules that it imports, without docstrings and comments.

    Imports within functions do not count: kernels know the names of their module only.
    """
    digests = sorted((name, item.digest) for name, item in sources_of(module).items())
    return KERNEL_DIGEST(repr(digests).encode()).hexdigest()[:16]


class Source(NamedTuple):
    """Source file of a module."""

    key: str
    """Hash of its bytes."""
    digest: str
    """Hash of its code."""
    imported: tuple[str, ...]
    """Project modules that it imports, and names that may be modules."""


def sources_of(module: str) -> dict[str, Source]:
    """Source files of a module and of all project modules that it imports, by module."""
    found: dict[str, Source] = {}
    pending = [module]
    while pending:
        name = pending.pop()
        if name not in found and (item := _source(name)) is not None:
            found[name] = item
            pending += item.imported
    return found


@cache
def _source(module: str) -> Source | None:
    """Source file of a module; None where it is no module."""
    package, *parts = module.split(".")
    root = _folder_of(package)
    if root is None:
        return None
    folder = os.path.join(root, package, *parts)
    for path in (os.path.join(folder, "__init__.py"), f"{folder}.py"):
        if os.path.basename(path) in _names(os.path.dirname(path)):
            return _digest(Path(path).read_bytes(), package)
    return None


@cache
def _folder_of(package: str) -> str | None:
    """Where a package or a module of the top level is; hundreds of names are looked up there."""
    roots = dict.fromkeys((str(Path(__file__).parents[2]), *sys.path))
    return next((root for root in roots if {package, f"{package}.py"} & _names(root)), None)


@cache
def _names(folder: str) -> frozenset[str]:
    with contextlib.suppress(OSError):
        return frozenset(os.listdir(folder))
    return frozenset()


def _digest(content: bytes, package: str) -> Source:
    key, kept = KERNEL_DIGEST(content).hexdigest(), kept_digests()
    if key not in kept:
        tree = ast.parse(content)
        imported = sorted(_imported(tree, {package, *PACKAGES}))
        for node in ast.walk(tree):
            if isinstance(body := getattr(node, "body", None), list):
                body[:] = [item for item in body if not _is_text(item)]
        kept[key] = [KERNEL_DIGEST(ast.dump(tree).encode()).hexdigest(), imported]
        _keep_digests(kept)
    digest, imported = kept[key]
    return Source(key, digest, tuple(imported))


def _is_text(node: ast.AST) -> bool:
    """Whether a statement is a docstring."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _imported(tree: ast.Module, packages: set[str]) -> Iterator[str]:
    """Project modules that a module imports when it is loaded; also names that may be modules."""
    for node in tree.body:
        if isinstance(node, ast.Import):
            names = [item.name for item in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module, *(f"{node.module}.{item.name}" for item in node.names)]
        else:
            continue
        yield from (name for name in names if name.split(".")[0] in packages)


@cache
def kept_digests() -> dict[str, Any]:
    """Digests of source files that came with the package or that earlier processes worked out."""
    kept: dict[str, Any] = {}
    with contextlib.suppress(OSError, ValueError):
        kept |= json.loads((PREBUILT / SOURCE_DIGESTS_FILE).read_bytes())
    folder = cache_folder()
    if folder is not None:
        with contextlib.suppress(OSError, ValueError, TypeError):
            kept |= json.loads(folder.read(SOURCE_DIGESTS_FILE, MAX_LIBRARY_BYTES))
    return kept


def _keep_digests(digests: dict[str, Any]) -> None:
    folder = cache_folder()
    if folder is not None:
        with contextlib.suppress(OSError):  # the next process works them out, too
            folder.write(SOURCE_DIGESTS_FILE, json.dumps(digests).encode(), synced=False)


def tool_versions() -> dict[str, str]:
    """Versions of what makes the code; empty where there is none of it."""
    from importlib.metadata import PackageNotFoundError, version  # noqa: PLC0415 - reads files

    try:
        return {name: version(name) for name in ("numba", "llvmlite")}
    except PackageNotFoundError:
        return {}
