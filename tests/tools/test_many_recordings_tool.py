"""The measurement of many recordings: what is prepared, broken, and counted."""

import shutil

from places import LOGS

from ehadiag_tools.rigs.many import BREAKS, measured, prepared


def test_recordings_are_simulated_once_and_copied(tmp_path):
    logs = prepared(tmp_path, 3, seed=1, distinct=1)
    assert [path.name for path in logs] == ["00000.blf", "00001.blf", "00002.blf"]
    assert len({path.read_bytes() for path in logs}) == 1
    before = logs[0].stat().st_mtime_ns
    assert prepared(tmp_path, 3, seed=2, distinct=1) == logs
    assert logs[0].stat().st_mtime_ns == before


def test_results_are_counted_and_broken_files_are_among_them(tmp_path):
    place = tmp_path / "logs"
    place.mkdir()
    data = (LOGS / "paper-open-2.blf").read_bytes()
    shutil.copy(LOGS / "paper-open-2.blf", place / "0.blf")
    for number, spoil in enumerate(BREAKS, start=1):
        (place / f"{number}.blf").write_bytes(spoil(data))
    found = measured(place, "--jobs", "1")
    verdicts = [verdict for _, verdict in found.results]
    assert verdicts[:2] == ["DEGRADED", "NOT_TESTED"]
    assert verdicts[2:] == ["null"] * (len(BREAKS) - 1)
    assert found.count == len(BREAKS) + 1
    assert "1 DEGRADED, 1 NOT_TESTED" in found.row("one")
    assert found.wall_s > 0.0
    assert found.memory_mb > 0.0
