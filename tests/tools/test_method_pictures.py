"""The pictures of the method: small, and of what their page says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

import ehadiag
from ehadiag_tools.accuracy.method_pictures import PICTURES, WORN, gap_of, main

REPOSITORY = Path(__file__).parents[2]
MOST_BYTES = 150_000


def test_every_picture_of_the_page_is_there_and_small() -> None:
    page = (REPOSITORY / "docs" / "explanation" / "method.md").read_text()
    for name in PICTURES:
        assert f"../img/method-{name}.png)" in page
        assert (REPOSITORY / "docs" / "img" / f"method-{name}.png").stat().st_size < MOST_BYTES


def test_a_picture_is_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path), "--only", "Kintas"]) == 0
    path = tmp_path / "method-Kintas.png"
    assert str(path) in capsys.readouterr().out
    with Image.open(path) as picture:
        assert picture.size == (900, 360)


@pytest.mark.parametrize("name", ["Kintas", "FSS", "FDJ"])
def test_each_search_has_its_least_gap_at_the_truth(name: str) -> None:
    (experiment,) = ehadiag.diagnose(
        ehadiag.simulate("open", faults=WORN, seed=1)
    ).diagnosis.experiments
    truth = getattr(WORN, name)
    below, there, above = (
        gap_of(experiment, replace(WORN, **{name: value}), name)
        for value in (truth - 0.01, truth, truth + 0.01)
    )
    assert there < 1.2
    assert min(below, above) > 2.0 * there
