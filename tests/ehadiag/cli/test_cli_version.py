"""`ehadiag --version`: one line, the package first, then what its digits depend on."""

from __future__ import annotations

import platform
import re
from importlib.metadata import version

from cli_result import Run

import ehadiag


def test_versions_of_the_package_python_and_libraries(run: Run) -> None:
    result = run("--version")
    assert (result.code, result.err) == (0, "")
    libraries = ", ".join(f"{name} {version(name)}" for name in ("numpy", "numba", "python-can"))
    expected = f"ehadiag {ehadiag.__version__} (Python {platform.python_version()}, {libraries})\n"
    assert result.out == expected
    assert re.match(r"ehadiag \d+\.\d+", result.out)
