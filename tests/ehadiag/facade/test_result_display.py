"""A result shown: the picture, a notebook's cell, samples as a data frame."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from html import unescape
from pathlib import Path

import msgspec
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from places import LOGS

import ehadiag
from ehadiag.cli.main import main


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
    text = unescape(re.sub(r"<[^>]*>", "", html))
    assert [line.rstrip() for line in text.splitlines()] == str(result).splitlines()


def test_names_from_outside_are_text_only(recording: ehadiag.Recording) -> None:
    name = "<script>alert(1)</script>[/red][bold]:warning:&amp;.blf"
    actuator = msgspec.structs.replace(ehadiag.default_actuator(), name=name)
    result = ehadiag.diagnose(replace(recording, source=name), actuator=actuator)
    assert str(result).splitlines()[0].endswith(f"  {name}")
    assert f"actuator {name}, serial" in str(result).splitlines()[1]
    html = result._repr_html_()
    assert "<script" not in html
    assert html.count("&lt;script&gt;alert(1)&lt;/script&gt;[/red][bold]:warning:&amp;amp;") == 2


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
    with pytest.raises(ImportError, match=r"needs pandas: pip install 'ehadiag\[pandas\]'"):
        recording.to_frame()
