"""The built wheel, in an environment that does not see this repository: it runs, and is typed."""

from __future__ import annotations

import os
import re
import shutil
import site
import subprocess
import sys
import venv
from collections.abc import Sequence
from pathlib import Path

import pytest
from places import LOGS, ROOT

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("wheel")]

CLIENT = Path(__file__).with_name("typed_client.py")


@pytest.fixture(scope="module")
def interpreter(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Interpreter of an environment with the wheel; libraries are those of this environment."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    built = Path(os.environ.get("CI_WHEELS", folder))  # .ci/run has built it already
    if built == folder:
        output_of([*pip, "wheel", "--no-deps", "--wheel-dir", folder, ROOT], folder)
    (wheel,) = built.glob("ehadiag-*.whl")
    venv.create(folder / "env", symlinks=True)
    python = folder / "env" / "bin" / "python"
    output_of([*pip, "--python", python, "install", "--no-deps", wheel], folder)
    (packages,) = (folder / "env").glob("lib/python*/site-packages")
    # A path that is added so has its own .pth files left unread: that to this repository too.
    (packages / "libraries.pth").write_text("\n".join(site.getsitepackages()), encoding="utf-8")
    return python


def output_of(command: Sequence[str | Path], folder: Path) -> str:
    """Run a command in a folder; return its standard output."""
    done = subprocess.run(
        [str(part) for part in command],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_readme_lines_from_log_to_estimate_and_plot(interpreter: Path, tmp_path: Path) -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (lines,) = re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    shutil.copy(LOGS / "paper-closed-2.blf", tmp_path / "test.blf")
    script = tmp_path / "script.py"
    script.write_text(lines + "\nprint(ehadiag.__file__)\n", encoding="utf-8")
    printed = output_of([interpreter, "-I", script], tmp_path).splitlines()
    assert printed[0].startswith("DEGRADED  Spool friction is at 60 %")
    assert re.match(r"0\.(60|59)\d* \(0\.[56]\d*, 0\.6\d*\)$", printed[-2])
    assert Path(printed[-1]).is_relative_to(interpreter.parents[1])
    assert (tmp_path / "test.png").stat().st_size > 10_000


def test_mypy_strict_sees_the_types_of_the_wheel(interpreter: Path, tmp_path: Path) -> None:
    pytest.importorskip("mypy")
    examples = sorted((ROOT / "examples").glob("*.py"))
    assert examples
    names = [CLIENT.name, *(path.name for path in examples)]
    for path in (CLIENT, *examples):
        shutil.copy(path, tmp_path)
    mypy = [sys.executable, "-m", "mypy", "--strict", "--python-executable", interpreter]
    assert output_of([*mypy, *names], tmp_path).startswith("Success: no issues found")
