"""The registry of parameters: what can be estimated, and what it does to the physical constants.

The page of parameters says what the registry holds.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ehadiag import default_actuator
from ehadiag.model.batch import PRESSURE_ROW, SIGNAL_ROWS, SPOOL_ROW
from ehadiag.model.laws import plant_of
from ehadiag.model.parameter import ParameterKind
from ehadiag.model.plant import PLANT_FIELDS, PlantConstants, plant_constants, plant_row
from ehadiag.model.registry import (
    FAULT_NAMES,
    FAULTS,
    REGISTRY,
    SENSOR_OFFSETS,
    Unknowns,
    parameter,
)

AS_NEW = plant_constants(default_actuator())
NAMES = [item.name for item in REGISTRY]


def values_of(item):
    """Values that a parameter may take; some deviations of what has no bounds."""
    far = 100.0 * item.scale
    low = item.lower if math.isfinite(item.lower) else -far
    high = item.upper if math.isfinite(item.upper) else far
    return st.floats(low, high)


def test_each_parameter_is_told_apart():
    for field in ("name", "symbol", "short", "meaning"):
        assert len({getattr(item, field) for item in REGISTRY}) == len(REGISTRY), field
    assert all(parameter(name).name == name for name in NAMES)
    with pytest.raises(KeyError):
        parameter("no such fault")


def test_the_derived_lists_are_parts_of_the_registry():
    assert tuple(item.name for item in FAULTS) == FAULT_NAMES
    assert {item.kind for item in FAULTS} == {ParameterKind.FAULT}
    assert {item.kind for item in REGISTRY if item not in FAULTS} <= {
        ParameterKind.DATUM,
        ParameterKind.NUISANCE,
    }
    assert [item.adds_to for item in SENSOR_OFFSETS] == [SPOOL_ROW, PRESSURE_ROW]
    adding = [item.adds_to for item in REGISTRY if item.adds_to is not None]
    assert adding == list(range(SIGNAL_ROWS))


@pytest.mark.parametrize("item", REGISTRY, ids=NAMES)
def test_bounds_hold_what_they_should(item):
    assert item.lower <= 0.0 < item.upper, "0 means that nothing is wrong"
    assert item.scale > 0.0
    assert not (math.isfinite(item.lower) ^ math.isfinite(item.upper))
    if item.kind is ParameterKind.FAULT:
        assert (item.lower, item.upper, item.unit) == (0.0, 1.0, "1")


@pytest.mark.parametrize("item", REGISTRY, ids=NAMES)
def test_nothing_of_a_parameter_changes_nothing(item):
    for name, value in item.changes(AS_NEW, 0.0).items():
        assert value == getattr(AS_NEW, name)


@pytest.mark.parametrize("item", REGISTRY, ids=NAMES)
@settings(max_examples=20)  # of up to five values each
@given(data=st.data())
def test_changes_are_pure_and_the_same_for_numbers_and_arrays(item, data):
    values = np.array(data.draw(st.lists(values_of(item), min_size=1, max_size=5)))
    before = AS_NEW._asdict()
    columns = PlantConstants(*(np.full(len(values), value) for value in AS_NEW))
    together = item.changes(columns, values)
    again = item.changes(columns, values)
    for column, value in zip(columns, AS_NEW, strict=True):
        np.testing.assert_array_equal(column, value)
    for i, value in enumerate(values.tolist()):
        alone = item.changes(AS_NEW, value)
        assert alone.keys() == together.keys() <= set(PlantConstants._fields)
        for name in alone:
            assert together[name][i] == again[name][i] == alone[name]
    assert AS_NEW._asdict() == before


def test_faults_are_those_of_the_paper():
    """PHY-10 to PHY-12, at the limit of damage: a fifth of the flow gain, friction as stated."""
    valve, jack = default_actuator().servovalve, default_actuator().jack
    worn = Unknowns(FAULTS, (AS_NEW,), {}).constants(np.ones(len(FAULTS)))
    assert pytest.approx(0.2 * valve.GQF, rel=1e-12) == worn.GQF
    assert pytest.approx(valve.FSS1, rel=1e-12) == worn.FSS
    assert pytest.approx(jack.FDJ1, rel=1e-12) == worn.FDJ
    same = set(PlantConstants._fields) - {"GQF", "FSS", "FDJ"}
    assert all(getattr(worn, name) == getattr(AS_NEW, name) for name in same)


@st.composite
def spaces(draw):
    """Some parameters free, some held, in tests at different oil and supply; and points in it."""
    chosen = draw(st.lists(st.sampled_from(REGISTRY), unique=True, max_size=len(REGISTRY)))
    free = tuple(item for item in chosen if draw(st.booleans()))
    held = {item.name: draw(values_of(item)) for item in chosen if item not in free}
    bases = tuple(
        AS_NEW._replace(PSR=draw(st.floats(15e6, 25e6)), CS=draw(st.floats(0.1, 10.0)))
        for _ in range(draw(st.integers(1, 3)))
    )
    count = draw(st.integers(0, 4))
    points = [[draw(values_of(item)) for item in free] for _ in range(count)]
    return Unknowns(free, bases, held), np.array(points).reshape(count, len(free))


@given(spaces())
def test_a_candidate_is_the_constants_of_its_point(space):
    """Row by row the registry's changes, one after the other, on plain numbers."""
    unknowns, points = space
    rows = unknowns.candidates(points)
    assert rows.shape == (len(points), len(unknowns.base), PLANT_FIELDS)
    for i, point in enumerate(points):
        for test, base in enumerate(unknowns.base):
            values = dict(unknowns.held)
            values.update({x.name: v for x, v in zip(unknowns.free, point.tolist(), strict=True)})
            expected = base
            for item in REGISTRY:
                if item.name in values:
                    expected = expected._replace(**item.changes(expected, values[item.name]))
            assert unknowns.constants(point, test) == expected
            assert tuple(rows[i, test].tolist()) == tuple(expected)


@given(spaces())
def test_what_is_held_is_as_if_it_were_free_there(space):
    unknowns, points = space
    if not unknowns.free:
        return
    item, rest = unknowns.free[0], points[:, 1:]
    for i, value in enumerate(points[:, 0].tolist()):
        holding = unknowns.holding({item.name: value})
        assert item not in holding.free
        assert len(holding.lower) == len(holding.upper) == len(unknowns.free) - 1
        np.testing.assert_array_equal(
            holding.candidates(rest[i : i + 1]), unknowns.candidates(points[i : i + 1])
        )


def test_a_row_is_read_back_as_the_constants():
    """What kernels unpack is what was packed, field by field."""
    distinct = PlantConstants(*(float(k + 1) for k in range(PLANT_FIELDS)))
    assert PlantConstants(*plant_of(plant_row(distinct))) == distinct
