"""Libraries that come with the package: which one is loaded, and which is not."""

from __future__ import annotations

import json
import os
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import pytest
from msgspec.structs import replace

from ehadiag.compile import libraries, worker
from ehadiag.compile.elementary import C_FUNCTIONS
from ehadiag.compile.elf import shared_library
from ehadiag.export.targets import find_target
from ehadiag.monitor.monitor_memory import prepare_monitor
from firmware_iface.errors import ConfigurationError
from firmware_iface.files import Folder

LEVEL = libraries.processor_level()
needs_levels = pytest.mark.skipif(LEVEL == libraries.NO_LEVEL, reason="no shared libraries here")


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The smallest library for this processor, as a package has it."""
    folder = tmp_path_factory.mktemp("built")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(libraries, "SHIPPED", ("simulator",))
        libraries.build(folder, [LEVEL])
    return folder


@pytest.fixture
def package(built: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package with that library."""
    folder = tmp_path / "_kernels"
    shutil.copytree(built, folder)
    monkeypatch.setattr(libraries, "PREBUILT", folder)
    for function in (libraries._manifest, libraries._prebuilt):
        function.cache_clear()
        monkeypatch.setattr(libraries, "warn_once", print)
    yield folder
    for function in (libraries._manifest, libraries._prebuilt):
        function.cache_clear()


@needs_levels
def test_a_library_of_the_package_is_that_compiled_here(package: Path) -> None:
    found = libraries._prebuilt("simulator")
    assert found == libraries._made("simulator", LEVEL)
    assert found is not None
    assert libraries.missing(["simulator"]) == []


@needs_levels
def test_a_damaged_library_is_not_loaded(package: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (file,) = package.glob("*.so")
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    assert libraries._prebuilt("simulator") is None
    assert capsys.readouterr().out == (
        f"{file}: not the file that the package came with: compiling\n"
    )


@needs_levels
def test_a_library_of_other_sources_is_not_loaded(
    package: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(libraries, "_sources", lambda _library: "other")
    assert libraries._prebuilt("simulator") is None
    assert "not those of its sources: compiling" in capsys.readouterr().out


@needs_levels
def test_a_processor_without_a_library_compiles(
    package: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(libraries, "processor_level", lambda: ("m68k", "68060"))
    assert libraries._prebuilt("simulator") is None
    assert "without kernels for this processor: compiling" in capsys.readouterr().out


@needs_levels
def test_results_name_the_compiler_that_made_the_library(package: Path) -> None:
    manifest = package / libraries.MANIFEST
    content = json.loads(manifest.read_text())
    content["compiler"]["numba"] = "0.1"
    manifest.write_text(json.dumps(content))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(libraries, "SHIPPED", ("simulator",))
        assert libraries.compiler_versions()["numba"] == "0.1"


def test_without_a_compiler_the_error_names_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(worker, "find_spec", lambda _name: None)
    with pytest.raises(ConfigurationError, match=r"needs numba: .*install .*numba"):
        worker.object_code(worker.ObjectFile((), libraries.HOST))


def test_one_compilation_serves_all_values_of_a_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also for 32 bits, the other order of bytes, and where LLVM folds constants late."""
    arguments = (worker.PointerArgument(), worker.TableArgument("plan"), worker.PointerArgument())
    functions = (worker.CFunction("prepare", prepare_monitor, arguments),)
    one, two = ([n + 0.25 * k for n in range(171)] for k in (1, 2))
    target = find_target("powerpc-e500mc").processor
    blank = worker.ObjectFile(functions, target, replaced=C_FUNCTIONS)
    whole, made = replace(blank, tables={"plan": one}), []

    def compiled(wanted: worker.ObjectFile) -> list[bytes]:
        made.extend(worker.object_code(wanted, whole))  # in one process: translated once
        return made[:1]

    with Folder.at(tmp_path, 0o600) as folder:
        monkeypatch.setattr(libraries, "cache_folder", lambda: folder)
        monkeypatch.setattr(libraries, "object_code", compiled)
        (first,) = libraries.object_files(whole)
        assert first == made[1] != made[0]
        compiled_again = pytest.fail
        monkeypatch.setattr(libraries, "object_code", compiled_again)
        (second,) = libraries.object_files(replace(blank, tables={"plan": two}))
    assert struct.pack(">171d", *two) in second
    assert second == first.replace(struct.pack(">171d", *one), struct.pack(">171d", *two))


RANDOM_COMPILER = """
import os, runpy
from ehadiag.compile import libraries
libraries.SHIPPED = ("simulator",)
libraries._made = lambda *_: os.urandom(8)
runpy.run_module("ehadiag.compile", run_name="__main__")
"""


@needs_levels
@pytest.mark.parametrize("named", ["", "kernels"])
def test_only_a_named_cache_spares_a_build_the_compiler(named: str, tmp_path: Path) -> None:
    """What two builds make is compared before a release."""
    where = {"HOME": str(tmp_path), "XDG_CACHE_HOME": "", "EHADIAG_CACHE_DIR": named}
    for folder in ("once", "again"):
        command = [sys.executable, "-c", RANDOM_COMPILER, folder, "--here"]
        subprocess.run(command, env=os.environ | where, cwd=tmp_path, check=True)
    once, again = (tmp_path / folder / libraries.MANIFEST for folder in ("once", "again"))
    assert (once.read_bytes() == again.read_bytes()) is bool(named)


def test_what_is_no_object_file_of_this_kind_is_refused() -> None:
    with pytest.raises(ValueError, match="no object file of ELF-64"):
        shared_library(b"\x7fELF\x01\x01".ljust(64, b"\0"), [])


def test_the_digests_of_the_sources_come_with_the_package(built: Path) -> None:
    assert (built / libraries.SOURCE_DIGESTS_FILE).stat().st_size > 0
