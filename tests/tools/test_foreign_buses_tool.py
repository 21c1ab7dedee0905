"""The table of foreign buses: resumed, units left out that are not calibrated."""

import json
import shutil

from places import LOGS

from ehadiag_tools.rigs import table
from ehadiag_tools.rigs.replay import DEFAULT


def test_a_run_that_was_broken_off_goes_on(tmp_path, capsys):
    log = "paper-open-2.blf"
    shutil.copy(LOGS / log, tmp_path)
    truth = f"file,Kintas,FSS,FDJ\n{log},0.3,0.6,0.3\nother.blf,0,0,0\n"
    (tmp_path / "truth.csv").write_text(truth)
    results = tmp_path / "results.jsonl"
    words = [str(tmp_path), "--only", "paper-open-2", "--bus", "psi29", "--jitter", "0.2"]
    words += ["--lead-in", "0.05", "--results", str(results)]
    assert table.main(words) == 0
    told = capsys.readouterr().out
    first = results.read_text()
    lines = [json.loads(line) for line in first.split("\n") if line]
    assert [item["verdict"] for item in lines] == ["DEGRADED"] * 2
    assert told.count("| 1 of 1 | 0 |") == 2
    assert DEFAULT in told
    assert table.main(words) == 0
    assert capsys.readouterr().out == told
    assert results.read_text().strip() == first.strip()
    assert table.main([*words, "--at-most", "1"]) == 0
    assert "psi29" not in capsys.readouterr().out
    assert table.main([str(tmp_path / "nowhere")]) == 3


def test_units_that_were_not_calibrated_are_left_out(tmp_path, capsys):
    truth = "file,unit,Kintas,FSS,FDJ\nA-worn-open-1.blf,A,0.3,0.6,0.3\n"
    (tmp_path / "truth.csv").write_text(truth)
    assert table.main([str(tmp_path), "--results", str(tmp_path / "r.jsonl")]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 2
