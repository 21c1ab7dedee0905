"""The even clock behind a table's stamps."""

from __future__ import annotations

import numpy as np
import pandas
import pytest
from places import LOGS

from ehadiag.core.actuator import default_actuator
from ehadiag.core.find_test import Sought
from ehadiag.core.stored_test import bundled_tests
from ehadiag_tools.rigs.rerecord import Disturbance, logged, played
from firmware_iface.logs.any_recording import Meaning, recorded_tests
from firmware_iface.logs.reader import read_recording
from firmware_iface.mapping.bus_map import default_map
from firmware_iface.signals.row_clock import even_times

EVEN = 5.0 + np.arange(4000) * 0.5e-3 * (1.0 + 80e-6)


@pytest.mark.parametrize("jitter", [0.2e-3, 1e-3])
def test_late_stamps_of_even_rows_become_even(jitter):
    rng = np.random.default_rng(1)
    found, scatter = even_times(EVEN + np.abs(rng.normal(0.0, jitter, len(EVEN))))
    away = found - EVEN
    assert np.ptp(away) < 0.15 * jitter
    assert scatter == pytest.approx(0.6 * jitter, rel=0.1)


def test_batches_become_even():
    found, scatter = even_times(np.repeat(EVEN[19::20], 20))
    assert scatter > 2e-3
    assert np.ptp(np.diff(found)) < 1e-9
    assert np.ptp(found - EVEN) < 1e-3


@pytest.mark.parametrize("kind", ["even", "gap", "lost", "short", "nan"])
def test_other_stamps_stay(kind):
    rng = np.random.default_rng(2)
    time = {
        "even": EVEN,
        "gap": np.concatenate([EVEN[:2000], EVEN[2100:]]) + rng.normal(0.0, 1e-4, 3900),
        "lost": EVEN[rng.random(4000) < 0.9],
        "short": EVEN[:500] + rng.normal(0.0, 1e-4, 500),
        "nan": np.append(EVEN, np.nan),
    }[kind]
    found, scatter = even_times(time)
    assert found is time
    assert scatter == 0.0


def test_a_table_with_jittering_stamps_reads_as_one_without(tmp_path):
    source = read_recording(LOGS / "paper-open-2.blf")
    this = played(source.samples, bundled_tests()["open"].command(), 0.4)
    columns = logged(this, Disturbance(drift_ppm=100.0), 2000.0, 1_000_000, 1)
    rng = np.random.default_rng(3)
    columns["time"] = columns["time"] + np.abs(rng.normal(0.0, 1e-3, len(columns["time"])))
    path = tmp_path / "daq.csv"
    pandas.DataFrame(columns).to_csv(path, index=False, float_format="%.9g")
    sought = Sought(tuple(bundled_tests().values()), default_actuator().controller)
    (found,) = recorded_tests([path], Meaning(default_map(), None, sought))
    assert any("time stamps jitter by 0.6 ms" in note for note in found.quality.notes)
    known = np.isfinite(found.samples.spool)
    assert known.mean() > 0.97
    away = np.abs(found.samples.spool - source.samples.spool)[known]
    assert (away > 1e-9).sum() <= 5
