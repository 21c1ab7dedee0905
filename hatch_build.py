"""Compiles the kernels for this processor while a wheel is built, unless they are there.

An editable installation has none, and compiles at first use.
"""

import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class KernelHook(BuildHookInterface):
    """Puts compiled kernels into the wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile; where the wheel is without kernels it depends on the compiler.

        version: `editable` or `standard`; build_data: what goes into the wheel.
        """
        root = Path(self.root)
        if (root / "ehadiag" / "_kernels" / "manifest.json").exists():
            return
        machine = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        if version == "editable" or machine not in ("linux_x86_64", "linux_aarch64"):
            build_data["dependencies"].append("numba>=0.61")
            return
        self._folder = tempfile.TemporaryDirectory()
        made = Path(self._folder.name) / "kernels"
        # No PYTHONPATH: pip's own start-up drops from it what an editable installation names.
        begin = (
            "import runpy, sys;"
            f"sys.path[:0] = {[str(root), str(root / 'sim')]!r};"
            f"sys.argv[1:] = [{str(made)!r}, '--here'];"
            "runpy.run_module('ehadiag.compile', run_name='__main__')"
        )
        subprocess.run([sys.executable, "-c", begin], check=True)
        build_data["force_include"][str(made)] = "ehadiag/_kernels"
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{machine}"

    def finalize(self, *_: Any) -> None:
        """Delete what is in the wheel now."""
        if hasattr(self, "_folder"):
            self._folder.cleanup()
