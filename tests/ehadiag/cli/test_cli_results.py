"""Output of the commands: JSON schema, tables, exit codes, seeds."""

from __future__ import annotations

import json
import shutil
import struct
from pathlib import Path

import pytest
from cli_result import Run
from places import LOGS

HEALTHY = LOGS / "healthy-open.blf"
WORN = LOGS / "paper-open-4.blf"
PROMISED = {
    "schema", "source", "test", "actuator", "serial", "verdict", "reasons", "faults", "quality",
    "solver", "timing_s",
}  # fmt: skip
NUMBER = (int, float)


def half_of(log: Path, folder: Path) -> Path:
    content = log.read_bytes()
    half = folder / "half.blf"
    half.write_bytes(content[: len(content) // 2])
    return half


def test_json_has_every_promised_key(run: Run) -> None:
    result = run("diagnose", "--json", HEALTHY)
    (found,) = result.objects
    assert set(found) >= PROMISED
    assert found["schema"] == "ehadiag.diagnosis/3"
    assert found["source"] == str(HEALTHY)
    assert found["actuator"] == "reference-31"
    assert list(found["faults"]) == ["Kintas", "FSS", "FDJ"]
    for fault in found["faults"].values():
        low, high = fault["interval95"]
        assert 0.0 <= low <= fault["estimate"] <= high <= 1.0
        assert isinstance(fault["first"], NUMBER)
        assert isinstance(fault["std"], NUMBER)
    assert set(found["quality"]) >= {"frames", "lost", "repeated", "crc_errors"}
    assert found["solver"]["name"] == "cga"
    assert found["solver"]["seed"] == 0
    assert found["solver"]["evaluations"] > 0
    spent = found["timing_s"]
    assert set(spent) >= {"read", "first", "search", "total"}
    assert spent["total"] >= spent["read"] + spent["first"] + spent["search"] - 1e-3


def test_not_tested_keeps_the_keys(run: Run, tmp_path: Path) -> None:
    tested, cut = run("diagnose", "--json", HEALTHY, half_of(HEALTHY, tmp_path)).objects
    assert cut["verdict"] == "NOT_TESTED"
    assert cut["reasons"]
    assert set(cut) == set(tested)
    for part in ("quality", "solver", "timing_s"):
        assert set(cut[part]) == set(tested[part])
    for name, fault in cut["faults"].items():
        assert set(fault) == set(tested["faults"][name])
        assert fault["first"] is fault["estimate"] is fault["std"] is fault["interval95"] is None


def test_json_goes_to_standard_output_and_nothing_else(run: Run) -> None:
    out = ("--out", "reports", "--no-picture")
    result = run("diagnose", "--json", *out, HEALTHY, "missing.blf", WORN)
    assert [item["verdict"] for item in result.objects] == ["HEALTHY", None, "DEGRADED"]
    assert "no such file" in result.err


def test_out_holds_the_object_and_a_picture_of_each(run: Run, tmp_path: Path) -> None:
    (tmp_path / "again").mkdir()
    shutil.copy(HEALTHY, tmp_path / "again" / HEALTHY.name)
    result = run(
        "diagnose", "--json", "--out", "a/b", HEALTHY, f"again/{HEALTHY.name}", LOGS / "x.blf"
    )
    written = [Path("a/b/healthy-open.json"), Path("a/b/healthy-open-2.json")]
    assert [json.loads(path.read_text()) for path in written] == result.objects[:2]
    for path in written:
        picture = path.with_suffix(".png").read_bytes()
        assert picture[:8] == b"\x89PNG\r\n\x1a\n"
        width, height = struct.unpack(">II", picture[16:24])
        assert min(width, height) > 800
    assert len(list(Path("a/b").iterdir())) == 4


def test_a_pipe_does_not_cut_the_table(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "30")
    result = run("diagnose", WORN)
    assert f"  recording {WORN}" in result.out.splitlines()
    row = next(line for line in result.out.splitlines() if "(Kintas)" in line)
    assert len(row.split()) == 8
    assert any(line.startswith("  filter clogging ") for line in result.out.splitlines())
    assert result.err == ""


@pytest.mark.parametrize(
    ("logs", "code"),
    [
        ([HEALTHY], 0),
        ([HEALTHY, "missing.blf"], 3),
        ([HEALTHY, "missing.blf", WORN], 3),
        ([WORN, "half.blf", HEALTHY], 30),
        ([WORN, "half.blf", HEALTHY, "missing.blf"], 3),
        (["missing.blf", "unknown.kind"], 3),
    ],
)
def test_several_logs_give_the_worst_code(
    logs: list[object], code: int, run: Run, tmp_path: Path
) -> None:
    half_of(HEALTHY, tmp_path)
    assert run("diagnose", "--json", *logs).code == code


@pytest.mark.parametrize(
    ("levels", "verdict", "code"),
    [
        (["--advisory", "0.65"], "HEALTHY", 0),
        (["--advisory", "0.55"], "DEGRADED", 10),
        (["--limit", "0.55"], "FAULT", 20),
    ],
)
def test_levels_decide_the_verdict(levels: list[str], verdict: str, code: int, run: Run) -> None:
    result = run("diagnose", "--json", *levels, WORN)
    assert (result.code, result.objects[0]["verdict"]) == (code, verdict)
    assert bool(result.objects[0]["reasons"]) == (code > 0)


def test_the_same_seed_gives_the_same_digits(run: Run) -> None:
    log = LOGS / "paper-closed-2.blf"

    def digits(seed: int) -> list[tuple[float, float, float, float]]:
        (found,) = run("diagnose", "--json", "--seed", seed, log).objects
        assert found["solver"]["seed"] == seed
        return [
            (fault["first"], fault["search"], fault["estimate"], fault["std"])
            for fault in found["faults"].values()
        ]

    seven = digits(7)
    assert digits(7) == seven
    eight = digits(8)
    assert [item[1] for item in eight] != [item[1] for item in seven]
    assert [item[2] for item in eight] == pytest.approx([item[2] for item in seven], abs=1e-4)


def test_both_solvers_agree(run: Run) -> None:
    (ours,) = run("diagnose", "--json", WORN).objects
    (theirs,) = run("diagnose", "--json", "--solver", "pygad", WORN).objects
    assert theirs["solver"]["name"] == "pygad"
    for name, fault in ours["faults"].items():
        assert theirs["faults"][name]["estimate"] == pytest.approx(fault["estimate"], abs=2e-4)


def test_joint_gives_one_estimate_from_all(run: Run) -> None:
    logs = LOGS / "paper-open-1.blf", LOGS / "paper-closed-1.blf"
    single = run("diagnose", "--json", *logs).objects
    result = run("diagnose", "--json", "--joint", *logs)
    (joint,) = result.objects
    assert result.code == 10
    assert joint["source"] == " + ".join(map(str, logs))
    assert joint["test"] == "open+closed"
    assert joint["quality"]["frames"] == sum(item["quality"]["frames"] for item in single)
    for name, fault in joint["faults"].items():
        assert fault["estimate"] == pytest.approx(0.3, abs=3e-4)
        assert fault["std"] <= max(item["faults"][name]["std"] for item in single)


def test_joint_refuses_recordings_that_cannot_be_of_one_actuator(run: Run) -> None:
    result = run("diagnose", "--joint", LOGS / "paper-open-1.blf", LOGS / "healthy-closed.blf")
    assert result.code == 30
    assert "the model does not explain the recording" in result.out


def test_joint_needs_all_of_its_logs(run: Run) -> None:
    result = run("diagnose", "--json", "--joint", LOGS / "paper-open-1.blf", "missing.blf")
    assert (result.code, result.out) == (3, "")
    assert result.err.splitlines() == [
        "ehadiag: log missing.blf: no such file",
        "ehadiag: no joint estimate: not all of the logs could be read",
    ]


def test_csv_is_the_command_of_the_test(run: Run) -> None:
    listed = run("tests").out.splitlines()
    assert [line.split()[:2] for line in listed[1:]] == [["1", "open"], ["2", "closed"]]
    head, *rows = run("tests", "--csv", "open").out.splitlines()
    assert head == "time_s,command_mA"
    values = {float(time): float(value) for time, value in (row.split(",") for row in rows)}
    assert len(values) == 5500
    # PHY-25 and PHY-26; the tick of a step still has the earlier value.
    expected = {0.1: 0.0, 0.45: 0.75, 0.7: 1.5, 1.2: 0.0, 1.7: -1.5, 2.4: 0.0, 2.401: 10.0}
    expected |= {2.5: 10.0, 2.501: -10.0, 2.7: -10.0, 2.75: 10.0, 3.0: 0.0, 4.51: 8.0}
    assert {time: values[time] for time in expected} == pytest.approx(expected)
    head, *rows = run("tests", "--csv", "closed").out.splitlines()
    assert head == "time_s,command_mm"
    values = {float(time): float(value) for time, value in (row.split(",") for row in rows)}
    expected = {0.7: 5.0, 1.7: 10.0, 1.701: -10.0, 2.3: -10.0, 2.8: -5.0, 3.625: 4.0}
    assert {time: values[time] for time in expected} == pytest.approx(expected)


@pytest.mark.parametrize(("arguments", "code"), [(("--help",), 0), ((), 2)])
def test_help_names_every_command_and_code(arguments: tuple[str, ...], code: int, run: Run) -> None:
    """And so does the command alone, which is wrong usage to a script."""
    result = run(*arguments)
    assert (result.code, result.err) == (code, "")
    for word in ("bit", "diagnose", "sim", "tests", "check-bus", "replay", "warmup"):
        assert f"\n    {word}" in result.out
    for words in ("0 healthy", "10 degraded", "20 fault", "30 not tested", "2 wrong", "3 input"):
        assert words in result.out
