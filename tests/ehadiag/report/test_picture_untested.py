"""The picture of a recording that carries no verdict."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from places import LOGS

import ehadiag
from ehadiag.core.recording import CommandMode


def cut(log: str, tmp_path: Path) -> ehadiag.Result:
    content = (LOGS / log).read_bytes()
    half = tmp_path / "half$x^2$.blf"
    half.write_bytes(content[: len(content) // 2])
    return ehadiag.diagnose(half)


@pytest.mark.parametrize("log", ["paper-open-3.blf", "paper-closed-3.blf"])
def test_measured_beside_expected(log: str, tmp_path: Path) -> None:
    result = cut(log, tmp_path)
    assert result.verdict.name == "NOT_TESTED"
    figure = result.plot()
    title = figure.get_suptitle()
    assert title.startswith("NOT TESTED: half$x^2$.blf\n")
    assert all(reason[:40] in title for reason in result.reasons[:3])
    assert "serial 1,  2023-11-14T22:13:20" in title
    assert "DEGRADED from 0.25, FAULT from 0.75" in title
    current, spool, pressure, position = figure.axes
    assert len(spool.lines) == len(pressure.lines) == 2
    assert len((position if "closed" in log else current).lines) == 2
    assert spool.get_xlim() == (0.0, 5.5)
    assert figure._repr_png_()[:4] == b"\x89PNG"  # type: ignore[attr-defined]


def test_where_a_signal_is_stuck_they_part(tmp_path: Path) -> None:
    (recording,) = ehadiag.read(LOGS / "healthy-open.blf")
    assert recording.samples is not None
    stuck = replace(recording.samples, spool=np.zeros(recording.samples.ticks))
    result = ehadiag.diagnose(replace(recording, samples=stuck))
    spool = next(axes for axes in result.plot().axes if axes.get_ylabel() == "spool, mm")
    assert result.verdict.name == "NOT_TESTED"
    assert spool.patches


def test_of_an_unknown_test_only_what_was_measured() -> None:
    (recording,) = ehadiag.read(LOGS / "healthy-open.blf")
    assert recording.samples is not None
    other = replace(recording, test_id=77)
    figure = ehadiag.diagnose(other).plot()
    assert [len(axes.lines) for axes in figure.axes] == [1, 1, 1, 1]
    samples = replace(recording.samples, mode=CommandMode.POSITION)
    figure = ehadiag.diagnose(replace(recording, samples=samples)).plot()
    assert [len(axes.lines) for axes in figure.axes] == [1, 1, 1, 1]


def test_no_picture_where_there_are_no_samples() -> None:
    (recording,) = ehadiag.read(LOGS / "healthy-open.blf")
    with pytest.raises(ehadiag.NotTestedError, match="nothing to plot"):
        ehadiag.diagnose(replace(recording, samples=None)).plot()
