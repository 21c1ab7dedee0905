"""Which converters a recording went through: mapping, actuator file, data, in that order."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from other_actuator import with_data

from ehadiag.core.actuator import Actuator, default_actuator, load_actuator
from ehadiag.core.actuator_file import actuator_toml
from ehadiag.core.channels import CHANNELS, SPOOL, Stated
from ehadiag.core.conversion import actuator_channels, conversion_of, stated_channels
from ehadiag.core.converters import Converter, Converters
from ehadiag.core.errors import ConfigurationError
from ehadiag.core.fingerprint import fingerprint
from ehadiag.core.recording import CommandMode, Samples

TICKS = 4000
WAVE = np.sin(np.linspace(0.0, 30.0, TICKS)) + 0.003 * np.random.default_rng(2).normal(size=TICKS)


def samples(step: float = SPOOL.lsb, **others: object) -> Samples:
    """All channels on half their ranges, the spool in steps of its own."""
    values = {c.name: c.decode(c.encode(0.5 * c.full_scale * WAVE)) for c in CHANNELS}
    values["spool"] = step * np.rint(0.5 * SPOOL.full_scale * WAVE / step)
    made = Samples(
        period_ns=1_000_000,
        mode=CommandMode.CURRENT,
        **values,
        command=values["current"],
        saturated=np.zeros((4, TICKS), dtype=np.bool_),
        host_ns=np.arange(TICKS),
    )
    return replace(made, **others)


def with_spool(full_scale: float, bits: int = 12) -> Actuator:
    """The reference actuator with a converter of the spool in its file."""
    item = Converters(spool=Converter(full_scale=full_scale, bits=bits))
    return msgspec.structs.replace(default_actuator(), converters=item)


def test_default_bus_has_the_default_converters_to_the_last_bit():
    assert conversion_of(samples(), default_actuator()).channels == CHANNELS
    assert actuator_channels(default_actuator()) == CHANNELS


@pytest.mark.parametrize("share", [0.1, 0.3, 1.0 / 16.0, 2.0, 3.7])
def test_step_of_the_data_counts_where_nothing_is_stated(share):
    seen = conversion_of(samples(share * SPOOL.lsb), default_actuator()).channels.spool
    assert seen.lsb == pytest.approx(share * SPOOL.lsb, rel=1e-6)
    assert seen.full_scale == SPOOL.full_scale


def test_a_converter_that_lost_its_low_bits_is_not_taken_for_a_coarse_one():
    assert conversion_of(samples(64 * SPOOL.lsb), default_actuator()).channels.spool == SPOOL


def test_actuator_file_comes_before_the_data_and_the_mapping_before_both():
    filed = with_spool(1e-3, 14)
    assert conversion_of(samples(), filed).channels.spool.lsb == pytest.approx(2e-3 / 2**14)
    stated = (None, Stated(-2e-3, 2e-3, 1e-6), None, None)
    said = conversion_of(samples(stated=stated), filed).channels.spool
    assert (said.full_scale, said.lsb) == (2e-3, pytest.approx(1e-6))


def test_each_part_of_a_statement_counts_alone():
    step_only = stated_channels((None, Stated(step=1e-7), None, None), with_spool(1e-3)).spool
    assert (step_only.full_scale, step_only.lsb) == (1e-3, pytest.approx(1e-7))
    range_only = stated_channels((None, Stated(-3e-3, 3e-3), None, None), with_spool(1e-3)).spool
    assert (range_only.full_scale, range_only.levels) == (3e-3, 4096.0)


def test_range_of_a_valve_beyond_the_default_one_is_assumed_greater():
    channels = actuator_channels(with_data({"XSM": 0.8e-3}))
    assert channels.spool.full_scale == pytest.approx(1e-3)
    assert channels.position == CHANNELS.position


@pytest.mark.parametrize("end", [-1.0, 1.0])
def test_samples_at_the_real_end_are_saturated_though_the_bus_reaches_further(end):
    spool = np.clip(0.3e-3 * end + 0.2e-3 * WAVE, -0.25e-3, 0.25e-3)
    filed = with_spool(0.25e-3)
    at_end = conversion_of(samples(spool=spool), filed).saturated
    assert at_end[1].any()
    lsb = 0.5e-3 / 4096
    inside = (spool > -0.25e-3 + 0.5 * lsb) & (spool < 0.25e-3 - 1.5 * lsb)
    assert np.array_equal(at_end[1], ~inside)
    assert not at_end[[0, 2, 3]].any()
    assert not conversion_of(samples(spool=spool), default_actuator()).saturated.any()


def test_what_the_bus_calls_saturated_stays_so():
    marked = np.zeros((4, TICKS), dtype=np.bool_)
    marked[2, 17] = True
    found = conversion_of(samples(saturated=marked), with_spool(1e-3)).saturated
    assert np.array_equal(found, marked)


def test_converters_survive_the_file_and_leave_other_fingerprints_alone(tmp_path):
    path = tmp_path / "unit.toml"
    path.write_bytes(actuator_toml(with_spool(1e-3, 16)))
    again = load_actuator(path)
    assert again == with_spool(1e-3, 16)
    assert fingerprint(again) != fingerprint(default_actuator())
    assert "converters" not in msgspec.to_builtins(default_actuator())


@pytest.mark.parametrize("line", ["full_scale = 0.0", "full_scale = 1e-3, bits = 5", "bits = 12"])
def test_a_converter_that_cannot_be_is_refused(tmp_path, line):
    path = tmp_path / "unit.toml"
    path.write_bytes(
        actuator_toml(default_actuator()) + f"\n[converters]\nspool = {{ {line} }}".encode()
    )
    with pytest.raises(ConfigurationError, match="spool"):
        load_actuator(path)
