"""The runner of studies: resumption, reports, exit codes; and each study with a case or two."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from places import LOGS, ROOT

from ehadiag_tools.main import STUDIES, main
from ehadiag_tools.study import Options, Record, Study, case_key, perform_cases, run_study
from firmware_iface.errors import ConfigurationError


@dataclass(frozen=True, slots=True)
class Square:
    """A number."""

    number: int


performed: list[int] = []


def square(case: Square) -> Record:
    performed.append(case.number)
    return {"square": case.number**2, "pair": (1, 2)}


def squares(options: Options) -> list[Square]:
    return [Square(number) for number in range(options.cases)]


def refuse(_: Options) -> list[Square]:
    raise ConfigurationError("no number")


def interrupt(_: Square) -> Record:
    raise KeyboardInterrupt


def sums(records: Sequence[Record], _: Options) -> list[str]:
    return [str(sum(record["square"] for record in records))]


STUDY = Study("squares", "Squares of numbers.", squares, square, sums)


def options(folder: Path, **more: Any) -> Options:
    fields = {"cases": 4, "jobs": 1, "resume": folder / "deep" / "kept.jsonl", "output": None}
    return Options(**{**fields, **more})


def test_finished_cases_are_not_performed_again(tmp_path: Path) -> None:
    performed.clear()
    kept = tmp_path / "kept.jsonl"
    first = perform_cases(STUDY, [Square(0), Square(1)], kept, 1)
    # A line cut short by a kill.
    with kept.open("a") as file:
        file.write('{"key": "abc", "squ')
    found = perform_cases(STUDY, [Square(n) for n in range(4)], kept, 1)
    assert found[:2] == first
    assert found == [{"number": n, "square": n**2, "pair": [1, 2]} for n in range(4)]
    assert performed == [0, 1, 2, 3]
    perform_cases(STUDY, [Square(3)], kept, 1)
    assert performed == [0, 1, 2, 3]
    perform_cases(STUDY, [Square(3)], None, 1)
    assert performed == [0, 1, 2, 3, 3]


def test_worker_processes_give_the_same_records() -> None:
    study = next(item for item in STUDIES if item.name == "prognosis")
    options_ = Options(cases=2, seed=1, laws="tuned", fleet=2, censored=False)
    cases = study.cases(options_)
    assert perform_cases(study, cases, None, 2) == perform_cases(study, cases, None, 1)


def test_keys_are_of_study_and_settings() -> None:
    keys = {case_key("a", Square(1)), case_key("a", Square(2)), case_key("b", Square(1))}
    assert len(keys) == 3
    assert case_key("a", Square(1)) in keys


def test_a_report_is_printed_and_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_study(STUDY, options(tmp_path, output=tmp_path / "report.md")) == 0
    assert capsys.readouterr().out == "14\n"
    assert (tmp_path / "report.md").read_text() == "14\n"


def test_exit_codes_tell_failure_error_and_interruption(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_study(replace(STUDY, failed=lambda record: record["square"] == 9), options(tmp_path))
    for study, code, words in (
        (replace(STUDY, cases=refuse), 2, "squares: no number"),
        (replace(STUDY, perform=interrupt, name="other"), 130, "goes on from"),
    ):
        assert run_study(study, options(tmp_path)) == code
        assert words in capsys.readouterr().err
    assert run_study(STUDY, options(tmp_path, resume=tmp_path)) == 3
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "Is a directory" in error


def test_the_list_has_every_study_of_the_documentation(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--list"]) == 0
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert listed == [study.name for study in STUDIES]
    pages = "\n".join(path.read_text() for path in (ROOT / "docs").rglob("*.md"))
    named = set(re.findall(r"tools/study ([a-z-]+)", pages)) - {"--list"}
    assert named <= set(listed)
    assert len(named) > 10


RUNS = {
    "paper": f"--recordings {LOGS}",
    "cube": "--cases 1 --test open",
    "units": "--cases 1 --test open --data textbook --nuisances all",
    "recorded-units": "--recordings {folder}",
    "hardware": "--cases 1 --test open --kind dead-current",
    "recordings": "{folder}",
    "free-motion": "--cases 1 --piece 3",
    "foreign-buses": f"{LOGS} --only paper-open-2 --bus psi29 --jitter 0.2 --lead-in 0.05",
    "prognosis": "--cases 2 --fleet 4",
    "bench": "--only estimate --repeats 1",
    "pictures": "--folder {folder} --only Kintas",
}
EXPECTED = {
    "paper": "| open | (0.6, 0.6, 0.6) | Kintas | 1 | 1 |",
    "cube": "not converged 0",
    "units": "Cramér–Rao bound",
    "recorded-units": "refused: ",
    "hardware": "| open | dead-current | 0 | 0 | 0 | 1 | 0 |",
    "recordings": "noise floor 0.577",
    "free-motion": "| both | 0.00 |",
    "foreign-buses": "psi29: verdicts as on the default bus 1 of 1",
    "prognosis": "| all | 112 |",
    "bench": "| estimate | samples to estimate and interval, wall |",
    "pictures": "method-Kintas.png",
}
SLOW = {
    "alarms": "--cases 1 --recordings 2",
    "bench": "--repeats 1 --seconds 0.1 --frames 2000 --only kernels --only push"
    " --only decode --only batch --only history --recordings 2 --diagnoses 400 --folder {folder}",
}


def run(name: str, words: str, folder: Path) -> int:
    kept = () if name in ("bench", "pictures") else (
        "--jobs", "1", "--resume", str(folder / "kept.jsonl")
    )  # fmt: skip
    return main([name, *words.format(folder=folder).split(), *kept])


@pytest.mark.parametrize("name", RUNS)
def test_a_study_makes_its_table(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = "file,unit,test,Kintas,FSS,FDJ\n"
    if name == "recorded-units":
        log = LOGS / "healthy-open.blf"
        (tmp_path / "A-new-open-1.blf").symlink_to(log)
        truth += "A-new-open-1.blf,A,open,0,0,0\n"
    (tmp_path / "truth.csv").write_text(truth)
    assert run(name, RUNS[name], tmp_path) == 0
    out = capsys.readouterr().out
    assert EXPECTED[name] in out
    if (tmp_path / "kept.jsonl").exists():
        lines = (tmp_path / "kept.jsonl").read_text().split("\n")
        assert run(name, RUNS[name], tmp_path) == 0
        assert capsys.readouterr().out == out
        again = (tmp_path / "kept.jsonl").read_text().split("\n")
        assert [x for x in again if x] == [x for x in lines if x]
        assert all("key" in json.loads(line) for line in lines if line)


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOW)
def test_a_longer_study_makes_its_table(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(name, SLOW[name], tmp_path) == 0
    assert capsys.readouterr().out.count("\n| ") >= 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["cube", "--cases", "0"], "cube: --cases: need at least 1"),
        (["paper", "--recordings", "nowhere"], "nowhere/truth.csv: No such file"),
        (["recorded-units", "--recordings", "nowhere"], "nowhere/truth.csv: No such file"),
        (["foreign-buses", "nowhere"], "nowhere/truth.csv: No such file"),
        (["recorded-units", "--recordings", str(LOGS)], "truth.csv: no recording of a unit as new"),
        (["recordings", "{folder}"], "truth.csv: FSS 'worn' is not a number"),
    ],
)
def test_wrong_use_is_one_plain_line(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "truth.csv").write_text("file,Kintas,FSS,FDJ\na.blf,0.1,worn,0.1\n")
    arguments = [word.format(folder=tmp_path) for word in arguments]
    code = main([*arguments, "--resume", str(tmp_path / "r.jsonl")])
    error = capsys.readouterr().err.strip()
    assert code in (2, 3)
    assert message in error
    assert "\n" not in error
