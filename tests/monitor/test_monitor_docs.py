"""The how-to's example runs and prints what the page says."""

import re
from pathlib import Path

PAGE = Path(__file__).parent.parent.parent / "docs" / "how-to" / "monitor.md"


def test_example_prints_what_the_page_says(capsys):
    text = PAGE.read_text(encoding="utf-8")
    example, expected = re.search(r"```python\n(.*?)```.*?```\n(.*?)```", text, re.DOTALL).groups()
    exec(compile(example, str(PAGE), "exec"), {})
    assert capsys.readouterr().out == expected
