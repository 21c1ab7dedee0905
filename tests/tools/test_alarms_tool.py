"""`tools/alarms`: severities of the two kinds, and what counts as a wrong verdict."""

import numpy as np

from ehadiag_tools.accuracy import alarms


def test_severities_are_below_the_one_level_or_one_of_them_is_above_the_other():
    rng = np.random.default_rng(1)
    sound = np.array([alarms._severities(rng, sound=True) for _ in range(200)])
    worn = np.array([alarms._severities(rng, sound=False) for _ in range(200)])
    assert sound.max() <= 0.2
    assert worn.max(axis=1).min() >= 0.3
    assert worn.min() < 0.05


def _item(faults, test, verdict, value):
    interval = [[part - 0.02, part + 0.02] for part in value]
    return {
        "faults": faults, "test": test, "verdict": verdict, "value": value, "interval95": interval
    }  # fmt: skip


def test_rates_count_recordings_and_units_with_any(capsys):
    sound, worn = [0.1, 0.2, 0.0], [0.1, 0.4, 0.0]
    records = [
        {
            "tested": [
                _item(sound, "open", first, [0.1, 0.2, 0.03]),
                _item(worn, "closed", second, [0.1, 0.4, 0.0]),
            ]
        }
        for first, second in (("HEALTHY", "DEGRADED"), ("NOT_TESTED", "DEGRADED"))
    ]
    alarms.print_table([*records, {"tested": []}])
    said = capsys.readouterr().out
    assert "1 of 3 units were not calibrated" in said
    rows = {
        cells[1]: cells
        for cells in (line.split(" | ") for line in said.splitlines())
        if len(cells) > 1
    }
    assert rows["sound, not HEALTHY"][2:5] == ["2", "1", "50.00%"]
    assert rows["worn, HEALTHY"][2:5] == ["2", "0", "0.00%"]
    assert rows["worn, HEALTHY"][5].startswith("0: 0.00% … 84.19%")
    # What is NOT TESTED states nothing: one recording in open loop, one severity of it 3 % off.
    errors = next(line for line in said.splitlines() if line.startswith("| open"))
    assert errors == "| open | 1 | 1.0000 | 1.0000 | 3.000 | 66.7 | 4.000 |"
