"""The documentation site: built without a warning, with every public name."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import ehadiag

REPOSITORY = Path(__file__).parents[2]


@pytest.mark.slow
def test_the_site_is_built_without_a_warning_and_has_every_public_name(tmp_path: Path) -> None:
    site = Path(os.environ.get("CI_SITE", tmp_path / "site"))  # .ci/run has built it already
    if not site.exists():
        for name in ("sphinx", "myst_parser", "numpydoc", "furo"):
            pytest.importorskip(name)
        options = ["-q", "-W", "--keep-going", "-b", "html", "-d", str(tmp_path / "trees")]
        done = subprocess.run(
            [sys.executable, "-m", "sphinx", *options, REPOSITORY / "docs", site],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
    page = (site / "reference" / "api.html").read_text()
    names = set(ehadiag.__all__) - {"__version__"}
    assert {name for name in names if f'id="ehadiag.{name}"' not in page} == set()
    first = (site / "index.html").read_text()
    assert "explanation/method.html" in first
    assert 'src="http' not in first
    # What axe-core objects to in the theme.
    assert 'role="heading" aria-level="2"' in first
    assert 'role="heading">' not in first
    assert "<pre>" not in first


def test_each_tutorial_and_how_to_shows_a_small_picture_and_none_is_unused() -> None:
    docs, examples, shown = REPOSITORY / "docs", REPOSITORY / "examples" / "README.md", set()
    for page in (*docs.rglob("*.md"), REPOSITORY / "README.md", examples):
        names = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", page.read_text("utf-8"))
        pictures = [page.parent / name for name in names]
        assert pictures or page.parent.name not in ("tutorials", "how-to"), page
        shown |= {path.resolve() for path in pictures}
    assert {path for path in shown if path.stat().st_size > 150_000} == set()
    assert set((docs / "img").iterdir()) == {path for path in shown if path.parent.name == "img"}
