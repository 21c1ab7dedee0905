"""The examples of the monitor's page run and print what the page says."""

import re

import pytest
from places import ROOT

PAGE = ROOT / "docs" / "how-to" / "monitor.md"
EXAMPLES = re.findall(
    r"```python\n(.*?)```.*?```\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL
)


def test_the_page_has_its_examples():
    assert len(EXAMPLES) == 2


@pytest.mark.parametrize(("example", "expected"), EXAMPLES, ids=["pushed", "received"])
def test_example_prints_what_the_page_says(example, expected, capsys):
    exec(compile(example, str(PAGE), "exec"), {})
    assert capsys.readouterr().out == expected
