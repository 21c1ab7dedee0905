"""Defaults from files and variables, templates, completion, `-v`."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from cli_result import COMMAND, Run
from places import LOGS

import ehadiag
from ehadiag.cli.main import _parser_and_commands

HEALTHY = LOGS / "healthy-open.blf"


@pytest.fixture
def own(tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> Path:
    """File of the user's own defaults."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "configuration"))
    folder = tmp_path / "configuration" / "ehadiag"
    folder.mkdir(parents=True)
    return folder / "ehadiag.toml"


def seed(run: Run, *arguments: object) -> int:
    result = run("diagnose", "--json", *arguments, HEALTHY)
    assert result.code == 0, result.err
    found: int = result.objects[0]["configuration"]["seed"]
    return found


def test_the_nearer_default_wins(
    run: Run, own: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    own.write_text("seed = 1\n[diagnose]\nseed = 2\n[bit]\nseed = 9\n")
    assert seed(run) == 2
    (tmp_path / "ehadiag.toml").write_text("seed = 3\n")
    assert seed(run) == 3
    assert run("diagnose", "--json", HEALTHY).err == f"ehadiag: defaults from {own}, ehadiag.toml\n"
    monkeypatch.setenv("EHADIAG_SEED", "4")
    assert seed(run) == 4
    assert seed(run, "--seed", 5) == 5


def test_a_required_option_and_a_repeated_one(run: Run, own: Path) -> None:
    own.write_text('test = ["closed"]\n')
    assert run("sim").code == 2  # no bus, but a test is no matter any more
    namespace = ["diagnose", "--list", "--json", HEALTHY, "--test", "open"]
    assert run(*namespace).code == 0


def test_files_are_looked_for_beside_the_users_own_defaults(run: Run, own: Path) -> None:
    assert run("init", "actuator", own.parent).code == 0
    text = (own.parent / "actuator.toml").read_text()
    (own.parent / "actuator.toml").write_text(text.replace("reference-31", "left aileron"))
    own.write_text('actuator = "actuator.toml"\n')
    result = run("diagnose", "--json", HEALTHY)
    assert result.err == ""
    assert result.objects[0]["actuator"] == "left aileron"


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("seed = -1\n", "a seed is a whole number"),
        ('solver = "guess"\n', "is none of cga, pygad"),
        ("json = 3\n", "need true or false"),
        ("diagnose = 3\n", "need a table [diagnose]"),
        ("seed = [\n", "not valid TOML"),
        ("out = 'x'\n", "out is not for a project's file"),
        ("max_frames = 3\n", "max_frames is not for a project's file"),
        ("jbos = 2\n", "jbos is no option of any command, did you mean jobs?"),
        ("[diagnos]\njobs = 2\n", "[diagnos] is no command, did you mean [diagnose]?"),
        ("[bit]\njobs = 2\n", "[bit] jobs is no option of bit"),
        ("[diagnose]\nsolvr = 'cga'\n", "solvr is no option of diagnose, did you mean solver?"),
    ],
)
def test_wrong_defaults(text: str, why: str, run: Run, tmp_path: Path) -> None:
    (tmp_path / "ehadiag.toml").write_text(text)
    result = run("diagnose", HEALTHY)
    assert result.code == 2
    assert why in result.message
    assert "ehadiag.toml" in result.message


def test_unknown_keys_of_the_users_own_file_are_refused_too(run: Run, own: Path) -> None:
    own.write_text("jbos = 2\n")
    result = run("tests")
    assert result.code == 2
    assert f"{own}: jbos is no option of any command, did you mean jobs?" in result.message


def test_an_option_may_be_called_like_a_command(run: Run, own: Path) -> None:
    own.write_text('history = "none.sqlite"\nreport = true\n')
    assert "no history none.sqlite" in run("history", "list").message
    assert "is a command" not in run("report", "none.json").err


def test_a_variable_that_is_no_option_is_said(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EHADIAG_JBOS", "2")
    result = run("tests")
    assert result.code == 0
    assert result.message == (
        "ehadiag: variable EHADIAG_JBOS: there is no option --jbos; EHADIAG_JOBS?"
    )


def test_verbs_and_options_that_exclude_each_other_have_defaults(
    run: Run, own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run("history", "init", "--history", "h.sqlite")
    monkeypatch.setenv("EHADIAG_SERIAL", "7")
    own.write_text('[history]\nhistory = "h.sqlite"\n[export]\nfmu = true\nlist = false\n')
    result = run("history", "plot", "--out", "x.png")
    assert "serial 7: no diagnosis with severities" in result.message
    assert run("history", "event", "oiled").code == 0
    assert run("history", "list", "--json").objects[0]["serial"] == 7
    assert run("history", "--history", "none.sqlite", "list").code == 2
    assert "need --out DIR" in run("export").message
    assert run("export", "--list").code == 0
    monkeypatch.setenv("EHADIAG_TARGET", "nothing-like-it")
    assert "nothing-like-it" in run("export", "--out", "x").err  # the variable is nearer
    assert run("export", "--list").code == 0
    assert "another-one" in run("export", "--target", "another-one", "--out", "x").err


TRANSMITTING = {
    "bit": ("no bus named", 'interface = "virtual"\nchannel = "x"\n', ["--test", "open"]),
    "sim": ("no bus named", 'interface = "virtual"\n', []),
    "serve": ("no bus named", 'interface = "virtual"\n', ["--allow-tests"]),
    "replay": ("no bus named", 'interface = "virtual"\nchannel = "x"\n', [HEALTHY]),
}


@pytest.mark.parametrize("command", TRANSMITTING)
def test_a_project_makes_nobody_transmit(
    command: str, run: Run, own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    why, text, more = TRANSMITTING[command]
    for content in (text, f"[{command}]\n{text}"):
        (tmp_path / "ehadiag.toml").write_text(content)
        result = run(command, *more)
        assert result.code == 2
        assert f"ignored: {command} can transmit" in result.err
        assert "interface" in result.err.splitlines()[0]
        assert why in result.err
    # What the user says, in a file or a variable of his own, counts.
    (tmp_path / "ehadiag.toml").unlink()
    if command == "serve":  # would begin to serve
        return
    own.write_text('interface = "none-such"\n')
    assert "none-such" in run(command, *more).err
    monkeypatch.setenv("EHADIAG_INTERFACE", "nor-this")
    assert "nor-this" in run(command, *more).err


def test_a_project_starts_no_test(run: Run, tmp_path: Path) -> None:
    (tmp_path / "ehadiag.toml").write_text('test = "open"\nlimit = 0.8\n')
    result = run("bit", "--simulate", "--fast")
    assert result.code == 2
    assert "test ignored: bit can transmit" in result.err
    assert "required: --test" in result.err
    result = run("bit", "--simulate", "--fast", "--test", "open", "--json", "--no-picture")
    assert result.objects[0]["verdict"] == "HEALTHY"
    assert result.objects[0]["configuration"]["levels"]["limit"] == 0.8


def test_who_only_listens_takes_the_bus_of_a_project(run: Run, tmp_path: Path) -> None:
    (tmp_path / "ehadiag.toml").write_text('interface = "none-such"\n')
    for command in ("check-bus", "monitor"):
        assert "none-such" in run(command).err


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="permissions of POSIX")
def test_defaults_that_others_may_write_are_refused(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "ehadiag.toml"
    path.write_text("limit = 0.99\n")
    path.chmod(0o666)
    result = run("diagnose", HEALTHY)
    assert result.code == 2
    assert "others may write to it" in result.message


def test_templates_work_as_they_are(run: Run) -> None:
    for kind in ("actuator", "test", "mapping", "defaults"):
        result = run("init", kind, "new")
        assert result.code == 0
        assert all(Path(name).exists() for name in result.out.splitlines())
        again = run("init", kind, "new")
        assert again.code == 3
        assert "not overwritten" in again.message
    result = run(
        "diagnose", "--json", "--actuator", "new/actuator.toml", "--mapping", "new/mapping.toml",
        "--test", "new/test.toml", HEALTHY,
    )  # fmt: skip
    assert result.objects[0]["verdict"] == "HEALTHY"
    template = Path("new/ehadiag.toml").read_text()
    lines = [line[2:] for line in template.splitlines() if line.startswith(("# [", "# jobs"))]
    Path("ehadiag.toml").write_text("\n".join(lines))
    assert run("diagnose", "--json", HEALTHY).code == 0


def test_a_test_is_named_alike_everywhere(run: Run) -> None:
    assert run("tests", "--csv", "1").out == run("tests", "--csv", "open").out
    for arguments in (
        ["tests", "--csv"],
        ["bit", "--simulate", "--test"],
        ["diagnose", "x", "--test"],
    ):
        result = run(*arguments, "none")
        assert result.code == 2
        assert "neither a stored test (closed or 2, open or 1) nor a test file" in result.message


@pytest.mark.parametrize("shell", ["bash", "zsh", "tcsh"])
def test_completion_knows_commands_and_options(shell: str, run: Run) -> None:
    script = run("completion", shell).out
    for word in ("diagnose", "check-bus", "resume"):
        assert word in script
    if shell == "bash":
        done = subprocess.run(["bash", "-n"], input=script, text=True, check=False)
        assert done.returncode == 0


def test_verbose_tells_versions_and_options(environment: dict[str, str], tmp_path: Path) -> None:
    done = subprocess.run(
        [*COMMAND, "tests", "-v"], env=environment, cwd=tmp_path, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    assert f"ehadiag: ehadiag {ehadiag.__version__} (Python {sys.version.split()[0]}" in done.stderr
    assert "csv=None" in done.stderr


def test_every_command_takes_verbose() -> None:
    commands = _parser_and_commands()[1]
    assert all("-v" in command._option_string_actions for command in commands.values())
