"""Which converters a recording went through: mapping, actuator file, data, in that order.

The step of a converter found in the values that it gave. Tolerances of an actuator's data: how a
file and the command line give them.
"""

from __future__ import annotations

from importlib import resources

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from other_actuator import with_data

from ehadiag import (
    Actuator,
    CommandMode,
    ConfigurationError,
    Samples,
    default_actuator,
    load_actuator,
)
from ehadiag.core.actuator import (
    VARYING_PARAMETERS,
    ConverterSpec,
    ConverterSpecs,
    Jack,
    Servovalve,
    Tolerance,
    actuator_toml,
    with_tolerance,
)
from ehadiag.core.conventions import fingerprint
from ehadiag.core.conversion import (
    STEPS,
    actuator_channels,
    conversion_of,
    observed_step,
    stated_channels,
)
from ehadiag.identify.prior import FAULT_OF_DATUM, datum_name, unit_prior
from ehadiag.model.parameter import DATA_ERROR_PARAMETERS
from ehadiag.model.plant import plant_constants
from ehadiag.model.registry import FAULTS
from firmware_iface.recording import CHANNELS, StatedConverter

TICKS = 4000
WAVE = np.sin(np.linspace(0.0, 30.0, TICKS)) + 0.003 * np.random.default_rng(2).normal(size=TICKS)


def samples(step: float = CHANNELS.spool.lsb, **others: object) -> Samples:
    """All channels on half their ranges, the spool in steps of its own."""
    values = {c.name: c.decode(c.encode(0.5 * c.full_scale * WAVE)) for c in CHANNELS}
    values["spool"] = step * np.rint(0.5 * CHANNELS.spool.full_scale * WAVE / step)
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
    item = ConverterSpecs(spool=ConverterSpec(full_scale=full_scale, bits=bits))
    return msgspec.structs.replace(default_actuator(), converters=item)


def test_default_bus_has_the_default_converters_to_the_last_bit():
    assert conversion_of(samples(), default_actuator()).channels == CHANNELS
    assert actuator_channels(default_actuator()) == CHANNELS


@pytest.mark.parametrize("share", [0.1, 0.3, 1.0 / 16.0, 2.0, 3.7])
def test_step_of_the_data_counts_where_nothing_is_stated(share):
    seen = conversion_of(samples(share * CHANNELS.spool.lsb), default_actuator()).channels.spool
    assert seen.lsb == pytest.approx(share * CHANNELS.spool.lsb, rel=1e-6)
    assert seen.full_scale == CHANNELS.spool.full_scale


def test_a_converter_that_lost_its_low_bits_is_not_taken_for_a_coarse_one():
    assert (
        conversion_of(samples(64 * CHANNELS.spool.lsb), default_actuator()).channels.spool
        == CHANNELS.spool
    )


def test_actuator_file_comes_before_the_data_and_the_mapping_before_both():
    filed = with_spool(1e-3, 14)
    assert conversion_of(samples(), filed).channels.spool.lsb == pytest.approx(2e-3 / 2**14)
    stated = (None, StatedConverter(-2e-3, 2e-3, 1e-6), None, None)
    said = conversion_of(samples(stated=stated), filed).channels.spool
    assert (said.full_scale, said.lsb) == (2e-3, pytest.approx(1e-6))


def test_each_part_of_a_statement_counts_alone():
    step_only = stated_channels(
        (None, StatedConverter(step=1e-7), None, None), with_spool(1e-3)
    ).spool
    assert (step_only.full_scale, step_only.lsb) == (1e-3, pytest.approx(1e-7))
    range_only = stated_channels(
        (None, StatedConverter(-3e-3, 3e-3), None, None), with_spool(1e-3)
    ).spool
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


SIGNAL = np.sin(np.linspace(0.0, 40.0, 5000)) + 0.001 * np.random.default_rng(1).normal(size=5000)


def digitised(step: float, bus: float | None = None, signal: np.ndarray = SIGNAL) -> np.ndarray:
    """Rounded by a converter, then by a bus."""
    codes = step * np.rint(signal / step)
    return codes if bus is None else bus * np.rint(codes / bus)


@given(st.floats(1e-4, 2e-2), st.floats(-3.0, 3.0), st.floats(1e-6, 1e6))
def test_step_of_a_converter_is_found_whatever_offset_and_unit(step, offset, unit):
    seen = observed_step(unit * (digitised(step) + offset))
    assert seen == pytest.approx(unit * step, rel=1e-6)


@pytest.mark.parametrize("share", [1e-4, 0.01, 0.09, 0.2, 0.34, 0.41, 0.45])
def test_step_is_found_behind_a_bus_that_rounds_finer(share):
    assert observed_step(digitised(2.0 / 4096, 2.0 / 4096 * share)) == pytest.approx(
        2.0 / 4096, rel=1e-3
    )


def test_a_bus_coarser_than_its_converter_is_the_step():
    assert observed_step(digitised(2.0 / 65536, 2.0 / 4096)) == pytest.approx(2.0 / 4096)


@pytest.mark.parametrize(
    "values",
    [
        pytest.param(SIGNAL, id="exact"),
        pytest.param(SIGNAL.astype(np.float32).astype(np.float64), id="single precision"),
        pytest.param(np.convolve(digitised(0.001), np.ones(7) / 7.0, "same"), id="averaged"),
        pytest.param(digitised(2.0 / (STEPS.levels - 4)), id="few levels"),
        pytest.param(np.full(100, 0.3), id="constant"),
        pytest.param(np.full(100, np.nan), id="nothing"),
        pytest.param(np.empty(0), id="empty"),
    ],
)
def test_no_step_is_seen_where_none_can_be(values):
    seen = observed_step(values)
    # An average of seven codes does have one: a seventh of the step.
    assert seen is None or seen == pytest.approx(0.001 / 7.0, rel=1e-3) or seen < 1e-6


def test_missing_samples_do_not_matter():
    values = digitised(0.001)
    values[::3] = np.nan
    assert observed_step(values) == pytest.approx(0.001)


def test_the_bundled_file_has_none():
    assert default_actuator().tolerance.names == ()
    assert not unit_prior(default_actuator()).has_inexact_data
    assert unit_prior(default_actuator()).explains_sound_units
    assert not unit_prior(with_tolerance(default_actuator(), 0.05)).explains_sound_units


def test_all_data_of_the_model_can_have_one():
    own = Tolerance.__struct_fields__[1:]
    named = {item.name for item in DATA_ERROR_PARAMETERS if item.name.startswith("datum_")}
    named -= {datum_name("volume_of_one_chamber")}  # a calibration alone learns it
    assert {datum_name(symbol) for symbol in own} == named | {"torque_motor_gain"}
    data = {*Servovalve.__struct_fields__, *Jack.__struct_fields__}
    assert set(own) <= data


def test_one_for_all_goes_to_the_data_in_which_units_differ():
    tolerance = with_tolerance(default_actuator(), 0.05).tolerance
    assert set(tolerance.names) == set(VARYING_PARAMETERS)
    assert Tolerance(all=0.05, KF=0.0, AS=0.02).of("KF") == 0.0
    assert set(Tolerance(all=0.05, KF=0.0, AS=0.02).names) == {*VARYING_PARAMETERS, "AS"} - {"KF"}


@pytest.mark.parametrize("line", ["all = 0.4", "all = -0.1", "FSS1 = 0.05", "KF = 'much'"])
def test_a_wrong_one_is_refused(tmp_path, line):
    bundled = resources.files("ehadiag").joinpath("data/actuator.toml").read_text("utf-8")
    file = tmp_path / "unit.toml"
    file.write_text(bundled.partition("[tolerance]")[0] + f"[tolerance]\n{line}\n")
    with pytest.raises(ConfigurationError, match="tolerance"):
        load_actuator(file)


def test_a_tolerance_bounds_the_datum_and_has_a_uniform_density():
    knowledge = unit_prior(
        msgspec.structs.replace(default_actuator(), tolerance=Tolerance(KF=0.06))
    )
    (item,) = knowledge.free
    assert (item.name, item.lower, item.upper) == ("datum_KF", -0.06, 0.06)
    assert knowledge.priors["datum_KF"].std == pytest.approx(0.06 / 3**0.5)


@pytest.mark.parametrize("symbol", FAULT_OF_DATUM)
def test_a_datum_that_passes_for_a_fault_counts_in_the_interval(symbol):
    actuator = msgspec.structs.replace(default_actuator(), tolerance=Tolerance(**{symbol: 0.1}))
    knowledge = unit_prior(actuator)
    fault = FAULT_OF_DATUM[symbol]
    assert knowledge.free == ()
    base = plant_constants(actuator)
    values = {item.name: 0.3 for item in FAULTS}
    place = list(values).index(fault)
    spread = knowledge.spread(FAULTS, values, base)[place, place] ** 0.5
    # The severity that does what the datum's deviation does, from the scales of PHY-13 to 15.
    off = 0.1 / 3**0.5
    expected = {
        "GQF": off * (1.0 - 0.8 * 0.3) / 0.8,
        "FSS0": off * base.FSS * (1.0 - 0.3) / (base.FSS1 - base.FSS),
        "FDJ0": off * base.FDJ * (1.0 - 0.3) / (base.FDJ1 - base.FDJ),
    }[symbol]
    assert spread == pytest.approx(expected, rel=1e-4)
