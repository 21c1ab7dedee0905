"""`ehadiag report` reads a recording again as its result says that it was read."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas
import pytest
from places import LOGS

import ehadiag
from ehadiag.cli.main import main

NAMED = ("spool=LVDT:mm", "position=Stroke:mm", "pressure=dp:bar", "current=Isv:mA", "time=t")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "none"))
    monkeypatch.delenv("EHADIAG_HISTORY", raising=False)
    return tmp_path


def test_decoded_signals_with_columns_and_options_are_drawn(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    samples = ehadiag.simulate("open", FSS=0.3, seed=4).samples
    assert samples is not None
    rest = 500  # ticks before the test
    pandas.DataFrame(
        {
            "t": np.arange(samples.ticks + rest) * 1e-3,
            "Isv": np.pad(1e3 * samples.current, (rest, 0), mode="edge"),
            "LVDT": np.pad(1e3 * samples.spool, (rest, 0), mode="edge"),
            "dp": np.pad(1e-5 * samples.pressure, (rest, 0), mode="edge"),
            "Stroke": np.pad(1e3 * samples.position, (rest, 0), mode="edge"),
        }
    ).to_csv("run.csv", index=False, float_format="%.9g")
    columns = [word for item in NAMED for word in ("--column", item)]
    options = ["--nuisances", "none", "--rule", "estimate", "--seed", "5", "--start", "0.4"]
    assert main(["diagnose", "run.csv", *columns, *options, "--out", "o", "--no-picture"]) == 10
    stored = json.loads(Path("o/run.json").read_text())
    assert stored["request"]["columns"] == list(NAMED)
    assert stored["configuration"]["nuisances"] == stored["request"]["nuisances"] == "none"
    assert (stored["request"]["rule"], stored["request"]["start_s"]) == ("estimate", 0.4)
    assert stored["solver"]["seed"] == 5
    capsys.readouterr()
    assert main(["report", "o/run.json"]) == 0
    assert "no responses are drawn" not in capsys.readouterr().err
    assert "Measured and modelled" in Path("o/run.html").read_text()


def test_a_joint_result_is_drawn_from_all_its_logs(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    logs = [str(LOGS / f"paper-{loop}-4.blf") for loop in ("open", "closed")]
    assert main(["diagnose", "--joint", *logs, "--out", "o", "--no-picture"]) == 10
    capsys.readouterr()
    assert main(["report", "o/joint.json"]) == 0
    assert "no responses are drawn" not in capsys.readouterr().err
    page = Path("o/joint.html").read_text()
    assert page.count("Measured and modelled") >= 2


def test_a_result_of_version_2_is_drawn_where_its_recording_is_at_hand(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = LOGS / "healthy-open.blf"
    main(["diagnose", "--json", str(log)])
    tree = json.loads(capsys.readouterr().out)
    for key in ("request", "effects", "covariance"):
        del tree[key]
    Path("r.json").write_text(json.dumps(tree | {"schema": "ehadiag.diagnosis/2"}))
    assert main(["report", "r.json"]) == 0
    assert "no responses are drawn" not in capsys.readouterr().err
    assert "Measured and modelled" in Path("r.html").read_text()
