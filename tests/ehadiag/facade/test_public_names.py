"""What `import ehadiag` offers, to people, editors and type checkers, and what it loads for it."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib

import pytest
from places import ROOT

import ehadiag

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
    assert sorted([*(n for names in seen.values() for n in names), "__version__"]) == sorted(
        ehadiag.__all__
    )


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
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert ehadiag.__version__ == project["version"]


def test_the_import_alone_loads_nothing() -> None:
    assert modules_after("import ehadiag; dir(ehadiag)") == {"ehadiag"}


@pytest.mark.parametrize(
    ("name", "allowed"),
    [
        ("__version__", set()),
        ("EhadiagError", set()),
        ("Levels", set()),
        ("load_actuator", {"msgspec"}),
        ("load_test", {"msgspec", "numpy"}),
        ("Recording", {"numpy"}),
        ("read", {"msgspec", "numpy"}),
        ("simulate", {"msgspec", "numpy"}),
        ("diagnose", {"msgspec", "numpy"}),
    ],
)
def test_a_name_loads_only_what_it_is_made_of(name: str, allowed: set[str]) -> None:
    assert modules_after(f"import ehadiag; ehadiag.{name}") & HEAVY <= allowed
