"""The documentation matches the program: options, keys, limits, links.

The pages for one's own bus, own test, decoded signals and monitor, typed word for word.
"""

from __future__ import annotations

import argparse
import re
import runpy
import shlex
import shutil
import tomllib
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

import can
import numpy as np
import pandas
import pytest
from cli_result import REPOSITORY, Result, Run
from places import LOGS

from ehadiag.assess import acceptance, lost_samples
from ehadiag.cli.main import parser_and_commands
from ehadiag.core.criteria import FIT
from ehadiag_tools.rigs.replay import as_sent
from ehadiag_tools.rigs.rerecord import Disturbance, ForeignBus, frames_on, logged, played
from firmware_iface.signals.recordings import read_recording
from firmware_iface.stored_test import resolve_test
from firmware_iface.transport.frames import FrameTable

DOCS = REPOSITORY / "docs"
PAGES = [
    REPOSITORY / "README.md",
    REPOSITORY / "CHANGELOG.md",
    REPOSITORY / "examples" / "README.md",
    *sorted(DOCS.rglob("*.md")),
]


def options(parser: argparse.ArgumentParser) -> Iterator[str]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from options(command)
        else:
            yield from (name for name in action.option_strings if name.startswith("--"))


def test_every_option_is_documented() -> None:
    """The page as the site shows it, with the tables that are made from the help."""
    page = (DOCS / "reference" / "command-line.md").read_text()
    site = runpy.run_path(str(DOCS / "conf.py"))["with_tables"](page)
    known = set(options(parser_and_commands()[0]))
    tables = "\n".join(line for line in site.splitlines() if line.startswith("| "))
    assert known - set(re.findall(r"--[A-Za-z][\w-]*", tables)) == {
        "--help", "--help-all", "--version",
    }  # fmt: skip
    assert set(re.findall(r"--[A-Za-z][\w-]*", site)) - known == set()
    assert "%(" not in site


def test_every_key_of_the_json_result_is_documented(run: Run) -> None:
    page = (DOCS / "reference" / "json.md").read_text()
    (found,) = run("diagnose", "--json", LOGS / "healthy-open.blf").objects
    paths = set()
    for key, value in found.items():
        if key == "faults":
            paths |= {f"faults.*.{name}" for name in value["FSS"]}
        elif isinstance(value, dict):
            paths |= {f"{key}.{name}" for name in value}
        else:
            paths.add(key)
    assert {path for path in paths if f"`{path}`" not in page} == set()


@pytest.mark.parametrize(
    ("page", "package", "data"),
    [
        ("actuator-file", "ehadiag", "actuator.toml"),
        ("test-file", "firmware_iface", "tests/open.toml"),
    ],
)
def test_every_key_of_the_data_files_is_documented(page: str, package: str, data: str) -> None:
    text = (DOCS / "reference" / f"{page}.md").read_text()
    tree = tomllib.loads(resources.files(package).joinpath("data", data).read_text())
    keys = {key for key in tree if not isinstance(tree[key], dict)}
    keys |= {key for part in tree.values() if isinstance(part, dict) for key in part}
    assert {key for key in keys if not re.search(rf"[`.]{key}`", text)} == set()


def test_limits_are_the_documented_ones() -> None:
    page = (DOCS / "reference" / "verdicts.md").read_text()
    low, high = acceptance.RECORDING.oil_temperature_range_degc
    for limit in (
        f"missing | {100 * (1 - acceptance.RECORDING.min_sample_share):g} % |",
        f"for x s | {acceptance.RECORDING.max_sample_gap_s:g} s |",
        f"are lost (closed loop) | {100 * lost_samples.LOSSES.max_wrong_share:g} %, see",
        f"the command too | {acceptance.RECORDING.min_samples} frames |",
        f"at least {1000 * acceptance.RECORDING.max_frame_delay_s:g} ms missing",
        f"converter's end | {100 * lost_samples.LOSSES.max_wrong_share:g} % |",
        f"outside −{-low:g} … {high:g} °C",
        f"more than {100 * FIT.max_outlier_share:g} % of the residuals",
        f"rms residual above {FIT.max_rms:.3g} times",
    ):
        assert limit in page


def test_every_folder_of_the_documentation_has_pages() -> None:
    folders = {page.parent.name for page in PAGES}
    assert folders >= {"docs", "reference", "how-to", "tutorials", "explanation"}


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_links_and_named_files_exist(page: Path) -> None:
    text = page.read_text()
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
        assert (page.parent / target).exists(), target
    for name in re.findall(r"`((?:tests|tools|docs|firmware_iface|ehadiag)/[\w./-]+)`", text):
        assert (REPOSITORY / name).exists(), name


HOW_TO = REPOSITORY / "docs" / "how-to"
WORN = (0.6, 0.6, 0.3)
TICK_NS = 1_000_000


def page(name: str) -> str:
    return (HOW_TO / f"{name}.md").read_text(encoding="utf-8")


def typed(text: str, beginning: str) -> list[str]:
    """Words of the command that begins so, its continued lines too."""
    (line,) = re.findall(rf"(ehadiag {re.escape(beginning)}(?:.*\\\n)*[^`\n]*)", text)[:1]
    program, *words = shlex.split(line.replace("\\\n", " "))
    assert program == "ehadiag"
    return words


def block(text: str, word: str) -> str:
    """The TOML example that has a word."""
    (found,) = [item for item in re.findall(r"```toml\n(.*?)```", text, re.DOTALL) if word in item]
    indent = re.match(r" *", found.splitlines()[-1])
    assert indent is not None
    return re.sub(rf"^{indent[0]}", "", found, flags=re.MULTILINE)


def assert_worn(result: Result, truth: tuple[float, ...] = WORN) -> None:
    assert result.code == 10, result.err
    rows = dict(re.findall(r"\((Kintas|FSS|FDJ)\) +([\d.]+)", result.out, re.MULTILINE))
    found = [float(rows[name]) for name in ("Kintas", "FSS", "FDJ")]
    assert found == pytest.approx(truth, abs=2e-3)


RIG = f"""VERSION "1.0"
BU_: FCC RIG
BO_ 769 Servo: 4 FCC
 SG_ channels_current : 0|16@1- ({24 / 4096},0) [0|0] "mA" RIG
 SG_ channels_spool : 16|16@1- ({1 / 4096},0) [0|0] "mm" RIG
BO_ 770 Hydraulics: 2 FCC
 SG_ channels_pressure : 0|16@1- ({50 / 4096},0) [0|0] "MPa" RIG
BO_ 771 Jack: 2 FCC
 SG_ channels_position : 0|16@1- (-{120 / 4096},0) [0|0] "mm" RIG
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 10000;
BA_DEF_ BO_ "GenMsgStartDelayTime" FLOAT 0 1000;
BA_DEF_DEF_ "GenMsgCycleTime" 1;
BA_DEF_DEF_ "GenMsgStartDelayTime" 0.5;
BA_ "GenMsgStartDelayTime" BO_ 770 0.6;
BA_ "GenMsgStartDelayTime" BO_ 771 0.7;
"""


def test_own_bus(run: Run, tmp_path: Path) -> None:
    """The page's signals; the stroke's has the other sign, as its mapping says."""
    text = page("own-bus")
    bus = ForeignBus("rig", RIG)
    recording = read_recording(LOGS / "paper-closed-3.blf")
    assert recording.samples is not None
    this = played(recording.samples, as_sent(resolve_test("closed")), 0.2)
    table, _ = frames_on(bus, recording, this, Disturbance(), 1)
    dbc = RIG.replace("(-", "(")
    for role, name in (
        ("channels_current", "CoilCurrent"),
        ("channels_spool", "Lvdt"),
        ("channels_pressure", "LoadPressure"),
        ("channels_position", "Stroke"),
    ):
        dbc = dbc.replace(role, name)
    (tmp_path / "rig.dbc").write_text(dbc)
    (tmp_path / "rig.toml").write_text(block(text, "schema"))
    write_frames(tmp_path / "run.blf", table)
    shown = run(*typed(text, "check-bus --mapping rig.toml --log"))
    assert shown.code == 0, shown.err
    assert "mm" in shown.out
    words = ["run.blf" if item == "LOG" else item for item in typed(text, "diagnose --mapping")]
    assert_worn(run(*words))


def write_frames(path: Path, table: FrameTable) -> None:
    with can.Logger(str(path)) as writer:
        for time_ns, can_id, length, data in zip(
            table.time_ns.tolist(),
            table.can_id.tolist(),
            table.length.tolist(),
            table.data,
            strict=True,
        ):
            writer(
                can.Message(
                    timestamp=time_ns * 1e-9,
                    arbitration_id=can_id,
                    is_extended_id=False,
                    data=data[:length].tobytes(),
                )
            )


def test_decoded_signals(run: Run, tmp_path: Path) -> None:
    text = page("decoded-signals")
    recording = read_recording(LOGS / "paper-closed-3.blf")
    assert recording.samples is not None
    this = played(recording.samples, as_sent(resolve_test("closed")), 0.2)
    columns = logged(this, Disturbance(), 2000.0, TICK_NS, 1)
    named = {
        "time": columns["time"],
        "current": columns["current"],
        "spool": columns["spool"],
        "dp bridge": columns["pressure"] / 6894.757293168,
        "Stroke": 1e3 * columns["position"],
        "position_command": columns["position_command"],
        "oil_temperature": np.full(len(columns["time"]), 40.0),
    }
    write_csv(tmp_path, named)
    assert_worn(run(*typed(text, "diagnose run.csv")))
    mapped = {
        "t": columns["time"],
        "Isv": 1e3 * columns["current"],
        "LVDT": 1e3 * columns["spool"],
        "dp": named["dp bridge"],
        "Stroke": -named["Stroke"],
        "cmd": 1e3 * columns["position_command"],
        "ps": np.full(len(columns["time"]), 206.8),
    }
    write_csv(tmp_path, mapped)
    (tmp_path / "rig.toml").write_text(block(text, "ehadiag.columns/1"))
    assert_worn(run("diagnose", "run.csv", *shlex.split("--mapping rig.toml")))


def write_csv(folder: Path, columns: dict[str, np.ndarray]) -> None:
    pandas.DataFrame(columns).to_csv(folder / "run.csv", index=False, float_format="%.9g")


def test_own_test(run: Run, tmp_path: Path) -> None:
    text = page("own-test")
    (tmp_path / "short.toml").write_text(block(text, 'name = "short"'))
    assert run(*typed(text, "tests --csv")).code == 0
    assert_worn(run(*typed(text, "bit --test short.toml --simulate")), (0.3, 0.0, 0.0))
    (log,) = (tmp_path / "ehadiag-out").glob("*.blf")
    words = [str(log) if item == "LOG" else item for item in typed(text, "diagnose --test short")]
    assert_worn(run(*words), (0.3, 0.0, 0.0))


def test_monitor(run: Run, tmp_path: Path) -> None:
    """On a recording instead of a bus; it is of the unit that the result is of."""
    words = typed(page("monitor"), "monitor -i socketcan")
    assert words[1:5] == ["-i", "socketcan", "-c", "can0"]
    log = LOGS / "paper-open-2.blf"
    result = tmp_path / words[words.index("--from") + 1]
    run("diagnose", "--out", result.parent, log)
    shutil.move(result.parent / "paper-open-2.json", result)
    watched = run(words[0], "--log", log, *words[5:])
    assert watched.code == 0, watched.err
