"""Every reference recording through the command line: verdict, estimates, counted losses."""

from __future__ import annotations

import csv

import pytest
from cli_result import Run
from places import LOGS

FAULTS = ("Kintas", "FSS", "FDJ")
TOLERANCE = 5e-4
TRUTH = {row["file"]: row for row in csv.DictReader((LOGS / "truth.csv").read_text().splitlines())}
CODES = {"HEALTHY": 0, "DEGRADED": 10}


@pytest.mark.parametrize("name", sorted(TRUTH))
def test_estimates_are_the_truth(name: str, run: Run) -> None:
    truth = {fault: float(TRUTH[name][fault]) for fault in FAULTS}
    result = run("diagnose", "--json", LOGS / name)
    (found,) = result.objects
    verdict = "DEGRADED" if max(truth.values()) >= 0.25 else "HEALTHY"
    assert (found["verdict"], result.code) == (verdict, CODES[verdict])
    assert found["test"] == TRUTH[name]["test"]
    assert found["serial"] == 1
    for fault, value in truth.items():
        assert found["faults"][fault]["estimate"] == pytest.approx(value, abs=TOLERANCE)
        assert found["faults"][fault]["std"] < 2 * TOLERANCE
    named = [reason.split()[0] for reason in found["reasons"]]
    assert named == [fault for fault in FAULTS if truth[fault] >= 0.25]


def test_losses_of_the_lossy_recording_are_counted(run: Run) -> None:
    (found,) = run("diagnose", "--json", LOGS / "lossy-open.blf").objects
    quality = found["quality"]
    assert quality["lost"] == pytest.approx(0.02 * 11331, rel=0.2)
    assert quality["crc_errors"] == pytest.approx(0.005 * 11331, rel=0.3)
    assert quality["frames"] + quality["lost"] == 11331


def test_a_sound_recording_has_nothing_to_count(run: Run) -> None:
    (found,) = run("diagnose", "--json", LOGS / "paper-open-1.blf").objects
    counted = ("lost", "repeated", "crc_errors", "out_of_order", "length_errors", "foreign")
    assert {name: found["quality"][name] for name in counted} == dict.fromkeys(counted, 0)
    assert found["quality"]["frames"] == 11331
