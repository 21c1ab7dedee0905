"""What `import ehadiag` offers, to people, editors and type checkers, and what it loads for it.

The Python page: every example runs and gives what the page says; every name is on it. A result
shown: the picture, a notebook's cell, samples as a data frame.
"""

from __future__ import annotations

import ast
import doctest
import re
import shutil
import subprocess
import sys
from html import unescape
from importlib.metadata import version
from pathlib import Path

import msgspec
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from msgspec.structs import replace
from places import LOGS, ROOT
from printed_output import TolerantChecker, output_matches

import ehadiag
from ehadiag.cli.main import main
from firmware_iface.errors import install_command

HEAVY = {"numpy", "numba", "scipy", "can", "cantools", "matplotlib", "rich", "pandas", "msgspec"}


def modules_after(code: str, *, besides: str = "") -> set[str]:
    """Modules that a fresh interpreter has loaded after `code`, less those after `besides`."""

    def loaded(text: str) -> set[str]:
        show = "import sys; print(*sys.modules)"
        command = [sys.executable, "-c", f"{text}\n{show}"]
        return set(subprocess.check_output(command, text=True, timeout=60).split())

    return loaded(code) - loaded(besides)


def test_what_runs_and_what_type_checkers_see_are_the_same_names() -> None:
    tree = ast.parse((ROOT / "ehadiag" / "__init__.py").read_text(encoding="utf-8"))
    typed = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {
        node.module: tuple(alias.name for alias in node.names)
        for node in typed.body
        if isinstance(node, ast.ImportFrom)
    }
    assert seen == ehadiag._HOMES
    assert sorted(n for names in seen.values() for n in names) == sorted(ehadiag.__all__)


def test_every_public_name_is_there_and_listed() -> None:
    for name in ehadiag.__all__:
        assert getattr(ehadiag, name) is getattr(ehadiag, name)
    assert dir(ehadiag) == sorted(ehadiag.__all__)
    everything: dict[str, object] = {}
    exec("from ehadiag import *", everything)
    assert set(ehadiag.__all__) <= set(everything)


def test_a_name_that_is_not_there() -> None:
    with pytest.raises(AttributeError, match="module 'ehadiag' has no attribute 'diagnoze'"):
        ehadiag.diagnoze  # noqa: B018


def test_the_version_is_that_of_the_project() -> None:
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {ehadiag.__version__}\n" in citation
    assert version("ehadiag") == ehadiag.__version__


def test_the_import_alone_loads_nothing() -> None:
    assert modules_after("import ehadiag; dir(ehadiag)") == {"ehadiag"}


@pytest.mark.parametrize(
    ("name", "allowed"),
    [
        ("__version__", {"msgspec"}),
        ("EhadiagError", set()),
        ("Levels", {"msgspec"}),
        ("load_actuator", {"msgspec", "numpy"}),
        ("load_test", {"msgspec", "numpy"}),
        ("Recording", {"numpy", "msgspec"}),
        ("read", {"msgspec", "numpy"}),
        ("simulate", {"msgspec", "numpy"}),
        ("diagnose", {"msgspec", "numpy"}),
        ("run_test", {"msgspec", "numpy"}),
    ],
)
def test_a_name_loads_only_what_it_is_made_of(name: str, allowed: set[str]) -> None:
    assert modules_after(f"import ehadiag; ehadiag.{name}") & HEAVY <= allowed


TEXT_SUFFIXES = {".py", ".md", ".ipynb"}
PAGE = ROOT / "docs" / "reference" / "python.md"
TEXT = PAGE.read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```", TEXT, re.DOTALL | re.MULTILINE)


def test_the_page_has_its_examples() -> None:
    assert len(BLOCKS) == 10
    assert all(block.startswith(">>> ") for block in BLOCKS)


def test_every_example_gives_what_the_page_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("open", "closed"):
        shutil.copy(LOGS / f"paper-{name}-4.blf", tmp_path / f"{name}.blf")
    monkeypatch.chdir(tmp_path)
    examples = doctest.DocTestParser().get_doctest("\n".join(BLOCKS), {}, "python.md", None, 0)
    outcome = doctest.DocTestRunner(checker=TolerantChecker()).run(examples)
    assert outcome.attempted == len(examples.examples) > 20
    assert outcome.failed == 0, capsys.readouterr().out
    assert (tmp_path / "closed.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("want", "got", "same"),
    [
        ("FSS 0.6000 … 0.7\n", "FSS 0.6004 … 0.7\n", True),
        ("FSS 0.6000\n", "FSS 0.6100\n", False),
        ("FSS 0.6000 0.5\n", "FSS 0.6000\n", False),
        ("FSS 0.6\n", "FSS 0.6 0.7\n", False),
        ("5500 ticks\n", "5501 ticks\n", False),
        ("took ...\n", "took 0.123 s\n", True),
    ],
)
def test_what_counts_output_matches(want: str, got: str, same: bool) -> None:
    assert output_matches(want, got) is same


@pytest.fixture(scope="module")
def recording() -> ehadiag.Recording:
    (found,) = ehadiag.read(LOGS / "lossy-open.blf")
    return found


@pytest.fixture(scope="module")
def result(recording: ehadiag.Recording) -> ehadiag.Result:
    return ehadiag.diagnose(recording)


def test_the_plot_is_the_command_lines_picture(result: ehadiag.Result, tmp_path: Path) -> None:
    assert main(["diagnose", "--out", str(tmp_path), result.source]) == int(result.verdict)
    theirs = (tmp_path / "lossy-open.png").read_bytes()
    figure = result.plot()
    assert isinstance(figure, Figure)
    figure.savefig(tmp_path / "ours.png", dpi=110)
    assert (tmp_path / "ours.png").read_bytes() == theirs
    assert result.plot()._repr_png_() == theirs  # type: ignore[attr-defined]


def test_the_plot_leaves_pyplot_alone(result: ehadiag.Result) -> None:
    from matplotlib import pyplot

    before = pyplot.get_fignums()
    result.plot()
    assert pyplot.get_fignums() == before


def test_a_notebook_shows_the_table(result: ehadiag.Result) -> None:
    html = result._repr_html_()
    text = unescape(re.sub(r"<style>.*?</style>|<[^>]*>", "", html, flags=re.DOTALL))
    assert text.split()[:3] == ["Unit", f"{result.serial}:", result.verdict.name]
    for item in result.severities.values():
        assert item.meaning in text
        assert f"{item.value:.5f}" in text


def test_names_from_outside_are_text_only(recording: ehadiag.Recording) -> None:
    name = "<script>alert(1)</script>[/red][bold]:warning:&amp;.blf"
    actuator = msgspec.structs.replace(ehadiag.default_actuator(), name=name)
    result = ehadiag.diagnose(replace(recording, source=name), actuator=actuator)
    assert f"  recording {name}" in str(result).splitlines()
    assert f"actuator type {name}" in str(result)
    html = result._repr_html_()
    assert "<script" not in html
    assert html.count("&lt;script&gt;alert(1)&lt;/script&gt;[/red][bold]:warning:&amp;amp;") == 1


def test_samples_as_a_data_frame(recording: ehadiag.Recording) -> None:
    samples = recording.samples
    assert samples is not None
    frame = recording.to_frame()
    assert list(frame.columns) == ["command", "current", "spool", "pressure", "position"]
    assert frame.index.name == "time"
    np.testing.assert_array_equal(frame.index, samples.time)
    for name in frame.columns:
        np.testing.assert_array_equal(frame[name], getattr(samples, name))
    assert isinstance(frame, pd.DataFrame)
    assert frame["spool"].isna().sum() == np.isnan(samples.spool).sum() > 0
    assert samples.time[-1] == pytest.approx((samples.ticks - 1) * 1e-3)


def test_without_pandas_it_is_said_how_to_get_it(
    recording: ehadiag.Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r"needs pandas: (uv )?pip install 'pandas"):
        recording.to_frame()


def test_no_hint_names_a_package_that_no_index_has() -> None:
    """The package is on no index: hints name what is to be installed (`install_command`)."""
    places = [ROOT / name for name in ("ehadiag", "firmware_iface", "docs", "examples")]
    texts = [path for place in places for path in place.rglob("*") if path.suffix in TEXT_SUFFIXES]
    assert len(texts) > 200
    found = [path for path in texts if "install 'ehadiag[" in path.read_text(encoding="utf-8")]
    assert found == []
    for extra in ("mf4", "mcap", "daq", "multicast", "dask", "parquet", "cross", "completion"):
        assert re.fullmatch(r"(uv )?pip install('\S+'| )+|pipx .*", install_command(extra))
