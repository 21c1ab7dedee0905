"""What a diagnosis found is one record: its JSON, its tables and what is built on it."""

from __future__ import annotations

import copy
import csv
import json
import math
import pickle
import re
from dataclasses import fields
from importlib import resources
from pathlib import Path
from typing import Any

import jsonschema
import msgspec
import numpy as np
import pytest
from places import LOGS, ROOT
from stored_results import LINES

import ehadiag
from ehadiag import CommandMode, bundled_tests, default_actuator
from ehadiag.batch.result_files import (
    TABLE_FORMATS,
    is_result_table,
    junit_report,
    result_columns,
    result_row,
)
from ehadiag.core.actuator import Actuator
from ehadiag.estimate import Effect
from ehadiag.export.fmu import FMU_UNITS, actuator_variables, monitor_variables
from ehadiag.history.records import Usage, history_entry
from ehadiag.history.store import History
from ehadiag.identify.identification_result import Nuisance
from ehadiag.identify.prior import unit_prior
from ehadiag.model.parameter import Parameter, ParameterKind
from ehadiag.model.plant import plant_constants
from ehadiag.model.registry import FAULTS, REGISTRY, SENSOR_OFFSETS, Unknowns, parameter
from ehadiag.model.severities import FAULT_LAWS
from ehadiag.monitor.monitor_memory import MONITOR_UNIT_FIELDS
from ehadiag.records import result_of
from ehadiag.report.head import diagnosis_text
from ehadiag.result import Result, result_schema
from ehadiag.session.unit_state import unit_state_from_history, unit_state_of
from ehadiag_sim.conditions import Effects, Faults, Sensors, condition_options
from ehadiag_sim.plant_laws import UnitCondition, plant_coefficients
from ehadiag_sim.simulation import Plant

SCHEMAS = resources.files("ehadiag").joinpath("data/schemas")
FORMER_SCHEMA = ROOT / "tests" / "data" / "diagnosis-2.json"
EFFECTS = tuple(item for item in REGISTRY if item.kind is not ParameterKind.FAULT)


@pytest.fixture(scope="module")
def result() -> Result:
    return ehadiag.diagnose(LOGS / "paper-open-4.blf", seed=3)


@pytest.fixture(scope="module")
def everything(result: Result) -> Result:
    """The same as if every parameter of the registry had been estimated."""
    from msgspec.structs import replace

    from ehadiag.assess.other_causes import effects_of, with_limits

    found = result.diagnosis.identification
    assert found is not None
    nuisances = {
        item.name: Nuisance(0.3 * item.scale, 0.01 * item.scale, at_bound=False) for item in EFFECTS
    }
    found = replace(found, nuisances=nuisances)
    actuator = result.diagnosis.actuator
    effects = effects_of(found, unit_prior(actuator), actuator)
    return result_of(
        replace(
            result.diagnosis,
            identification=found,
            effects=effects,
            other=with_limits(effects, actuator),
        )
    )


def keys_of(tree: Any, at: str = "") -> set[str]:
    """All paths of keys, lists taken for their items."""
    if isinstance(tree, list):
        return set().union(*(keys_of(item, f"{at}[]") for item in tree)) if tree else set()
    if not isinstance(tree, dict):
        return set()
    here = {f"{at}.{key}" for key in tree}
    return here.union(*(keys_of(value, f"{at}.{key}") for key, value in tree.items()))


def as_former(line: str) -> dict[str, Any]:
    tree: dict[str, Any] = json.loads(line)
    return tree | {"schema": "ehadiag.diagnosis/2"}


def test_json_and_back_is_the_same_to_the_last_digit(result: Result, everything: Result) -> None:
    for item in (result, everything):
        read = Result.from_json(item.to_json())
        assert read == item
        assert read.to_json() == item.to_json()


def test_what_is_heavy_stays_at_hand_and_out_of_json(result: Result) -> None:
    assert result.at_hand
    assert result.recordings[0].samples is not None
    for light in (Result.from_json(result.to_json()), pickle.loads(pickle.dumps(result))):
        assert light == result
        assert not light.at_hand
        with pytest.raises(ehadiag.NotTestedError, match="diagnose it again"):
            _ = light.diagnosis
        assert str(light) == str(result)
    assert copy.copy(result) == result


@pytest.mark.parametrize("line", LINES)
def test_objects_of_version_2_are_read_with_all_they_say(line: str) -> None:
    former, read = json.loads(line), json.loads(Result.from_json(line).to_json())
    assert keys_of(former) <= keys_of(read)

    def same(old: Any, new: Any) -> None:
        if isinstance(old, dict):
            for key, value in old.items():
                same(value, new[key])
        elif isinstance(old, list):
            assert len(old) == len(new)
            for pair in zip(old, new, strict=True):
                same(*pair)
        else:
            assert new == old

    same({key: value for key, value in former.items() if key != "schema"}, read)


@pytest.mark.parametrize("number", range(len(LINES)))
def test_readers_of_version_2_find_all_they_had(number: int, result: Result) -> None:
    """By the schema of version 2, and every key of a stored object of it."""
    schema = json.loads(FORMER_SCHEMA.read_text())
    former = json.loads(LINES[number])
    new = json.loads(result.to_json())
    jsonschema.Draft202012Validator(schema).validate(as_former(result.to_json()))
    jsonschema.Draft202012Validator(schema).validate(
        as_former(Result.from_json(LINES[number]).to_json())
    )
    if former["error"] is None and former["culprit"] is None and not former["other"]:
        missing = {key for key in keys_of(former) if key not in keys_of(new)}
        assert missing == set()


def test_the_schema_that_is_shipped_is_made_from_the_record(
    result: Result, everything: Result
) -> None:
    shipped = json.loads(SCHEMAS.joinpath("diagnosis-3.json").read_text())
    assert shipped == json.loads(json.dumps(result_schema()))
    check = jsonschema.Draft202012Validator(shipped)
    for item in (result, everything, *map(Result.from_json, LINES)):
        check.validate(json.loads(item.to_json()))
    tree = json.loads(result.to_json())
    del tree["faults"]["FSS"]["std"]
    assert not check.is_valid(tree)


@pytest.mark.parametrize(
    "change",
    [
        lambda tree: tree.update(schema="ehadiag.diagnosis/1"),
        lambda tree: tree.update(schema="ehadiag.diagnosis/4"),
        lambda tree: tree.update(verdict="SOUND"),
        lambda tree: tree.pop("request"),
        lambda tree: tree["request"].update(seed=-1),
        lambda tree: tree["faults"]["FSS"].update(estimate="much"),
    ],
)
def test_what_is_no_result_is_refused(result: Result, change: Any) -> None:
    tree = json.loads(result.to_json())
    change(tree)
    with pytest.raises(ValueError, match=r"no object ehadiag\.diagnosis"):
        Result.from_json(json.dumps(tree))


def test_the_request_makes_the_same_result_again(result: Result) -> None:
    again = ehadiag.diagnose(request=Result.from_json(result.to_json()).request)
    assert msgspec.structs.replace(again, timing_s=result.timing_s) == result
    assert again.request.seed == 3
    assert ehadiag.diagnose(request=again.request, seed=4).seed == 4


def test_all_options_are_fields_of_the_request(result: Result) -> None:
    recording = result.recordings[0]
    quick = ehadiag.diagnose(recording, time_limit_s=1e-9)
    assert quick.verdict is ehadiag.Verdict.NOT_TESTED
    assert quick.reasons[0].startswith("no estimate within 1e-09 s")
    assert quick.configuration.time_limit_s == quick.request.time_limit_s == 1e-9
    with pytest.raises(TypeError, match="no option sead; there are "):
        ehadiag.diagnose(recording, sead=1)  # type: ignore[call-arg]


def test_many_logs_give_a_result_each_also_where_one_cannot_be_read(tmp_path: Path) -> None:
    logs = [LOGS / "healthy-open.blf", tmp_path / "none.blf", LOGS / "paper-open-4.blf"]
    found = list(ehadiag.diagnose_many(logs))
    assert [item.state for item in found] == ["HEALTHY", None, "DEGRADED"]
    assert found[1].error is not None
    assert "no such file" in found[1].error.text
    assert found[1].exit_code == 3
    assert [item.request.logs for item in found] == [(str(log),) for log in logs]


def test_every_parameter_reaches_every_output(everything: Result, tmp_path: Path) -> None:
    """The registry, walked through JSON, table, CSV, Parquet, JUnit, history and monitor."""
    severities = {item.name for item in FAULTS}
    effects = {item.name for item in EFFECTS}
    tree = json.loads(everything.to_json())
    assert set(tree["faults"]) == severities
    assert {item["name"] for item in tree["effects"]} == effects
    assert {item["name"] for item in tree["other"]} == set(
        everything.diagnosis.actuator.limits.__struct_fields__
    )
    table = diagnosis_text(everything, verbose=True)
    assert all(name in table for name in severities)
    assert all(item.short in table for item in EFFECTS)
    sinks = {suffix: table.write for suffix, table in TABLE_FORMATS.items()}
    sinks[".xml"] = junit_report
    files = {suffix: tmp_path / f"r{suffix}" for suffix in sinks}
    for suffix, sink in sinks.items():
        with sink(str(files[suffix])) as take:
            take(everything)
        content = files[suffix].read_bytes()
        for name in (*severities, *effects):
            whole = rb"(?<![A-Za-z_])" + name.encode() + rb"(?![A-Za-z_])"
            assert re.search(whole, content), f"{name} is missing in {suffix}"
        assert is_result_table(files[suffix]) == (suffix in TABLE_FORMATS)
    (row,) = csv.DictReader(files[".csv"].read_text(encoding="utf-8").splitlines())
    parquet = pytest.importorskip("pyarrow.parquet").read_table(files[".parquet"]).to_pylist()[0]
    junit = files[".xml"].read_text()
    for name, value in everything.diagnosis.identification.values.items():  # type: ignore[union-attr]
        assert float(row[name]) == parquet[name] == pytest.approx(value)
        assert f"{name} " in junit
        assert row[f"{name}_std"]
    place = tmp_path / "h.sqlite"
    with History(place, create=True) as history:
        history.append(history_entry(everything, Usage(), simulated=False))
        (entry,) = history.entries()
    assert {item.name for item in entry.severities} == severities
    assert {item.name: item.value for item in entry.effects} == {
        item.name: item.value for item in everything.effects
    }
    (tmp_path / "r.json").write_text(everything.to_json())
    known = unit_state_of(tmp_path / "r.json", everything.diagnosis.actuator)
    assert {item.name for item in known.severities} == severities
    assert set(known.effects) == effects - {item.name for item in SENSOR_OFFSETS}


def assert_same_laws(values: dict[str, float], effects: Effects, actuator: Actuator) -> None:
    """Of simulator and model: what both name has the same size with these values."""
    free = Unknowns(tuple(map(parameter, values)), (plant_constants(actuator),), {})
    constants = free.constants(np.array(list(values.values())))._asdict()
    faults = Faults(**{name: value for name, value in values.items() if name in FAULT_LAWS})
    coefficients = plant_coefficients(actuator, faults, effects)._asdict()
    both = constants.keys() & coefficients.keys()
    assert {name: constants[name] for name in both} == pytest.approx(
        {name: coefficients[name] for name in both}, rel=1e-9, abs=0.0
    )


def test_every_severity_reaches_simulator_monitor_and_exports() -> None:
    names = tuple(item.name for item in FAULTS)
    assert tuple(field.name for field in fields(Faults)) == names
    assert UnitCondition._fields[: len(names)] == names
    assert MONITOR_UNIT_FIELDS[: len(names)] == names
    shown = {item.name for item in monitor_variables(2e7)}
    assert shown >= set(names)
    worn = Faults(*(0.5,) * len(names))
    new, damaged = (
        plant_coefficients(default_actuator(), faults, Effects()) for faults in (Faults(), worn)
    )
    assert sum(a != b for a, b in zip(new, damaged, strict=True)) >= len(names)
    assert_same_laws(dict.fromkeys(names, 0.5), Effects(), default_actuator())
    windows = bundled_tests()["open"].windows.__struct_fields__
    assert all(law.windows in windows for law in FAULT_LAWS.values())


FREED = [item for item in EFFECTS if item.basic or item.limit]


@pytest.mark.parametrize("item", FREED, ids=lambda item: item.name)
def test_every_effect_that_is_freed_has_a_limit_and_is_simulated(item: Parameter) -> None:
    actuator = default_actuator()
    assert item.basic
    assert item.limit_of(actuator) is not None
    stage = msgspec.structs.replace(actuator.second_stage, kind="orifice")
    actuator = msgspec.structs.replace(actuator, second_stage=stage)
    name = item.condition or item.name
    assert name in {option.field for option in condition_options(Effects)}
    assert (name, item.unit) in {(shown.name, shown.unit) for shown in actuator_variables()}
    assert item.unit in FMU_UNITS
    changed = Effects(**{name: 0.3 * item.scale})
    assert_same_laws({item.name: 0.3 * item.scale}, changed, actuator)
    plants = (
        Plant(actuator, Faults(), effects, Sensors(noise_lsb=0.0))
        for effects in (Effects(), changed)
    )
    rows = [
        [plant.tick(0.005 * math.sin(0.05 * k), CommandMode.CURRENT) for k in range(200)]
        for plant in plants
    ]
    assert not np.array_equal(*rows)


def test_the_columns_of_former_tables_are_still_there(result: Result) -> None:
    former = [
        "source", "date", "test", "actuator", "serial", "verdict", "Kintas", "Kintas_std",
        "Kintas_low95", "Kintas_high95", "FSS", "FSS_std", "FSS_low95", "FSS_high95", "FDJ",
        "FDJ_std", "FDJ_low95", "FDJ_high95", "spool_rms", "pressure_rms", "oil_temperature_degC",
        "supply_pressure_MPa", "frames", "lost", "total_s", "reasons", "notes", "error",
    ]  # fmt: skip
    columns = list(result_columns())
    assert [name for name in columns if name in former] == former
    if [item.name for item in FAULTS] == ["Kintas", "FSS", "FDJ"]:  # a further one stands within
        assert columns[: len(former)] == former
    row = result_row(result)
    assert row["oil_temperature_degC"] == 40.0
    assert row["frames"] == 11331
    assert row["reasons"] == "; ".join(result.reasons)
    assert row["error"] is None


def test_result_and_history_are_watched_with_the_same_model(
    everything: Result, tmp_path: Path
) -> None:
    actuator = everything.diagnosis.actuator
    (tmp_path / "r.json").write_text(everything.to_json())
    with History(tmp_path / "h.sqlite", create=True) as history:
        history.append(history_entry(everything, Usage(), simulated=False))
    one = unit_state_of(tmp_path / "r.json", actuator)
    other = unit_state_from_history(tmp_path / "h.sqlite", everything.serial or 0, actuator)
    assert other is not None
    assert (one.faults, one.offsets, one.noise) == (other.faults, other.offsets, other.noise)
    constants = []
    for known in (one, other):
        unit, effects = known.unit(actuator)
        values = effects | dict(zip((item.name for item in FAULTS), known.faults, strict=True))
        space = Unknowns(tuple(map(parameter, values)), (plant_constants(unit),), {})
        constants.append(space.constants(np.array(list(values.values()))))
    assert constants[0] == constants[1]
    assert constants[0] != plant_constants(actuator)


def test_a_former_result_in_a_history_is_watched_with_all_its_effects(tmp_path: Path) -> None:
    """The object has only those with a limit, the rows beside it all."""
    from msgspec.structs import replace

    read = Result.from_json(LINES[1])
    entry = replace(
        history_entry(read, Usage(), simulated=False),
        result=LINES[1],
        effects=(*read.effects, Effect(name="load", value=12.0, std=1.0)),
    )
    with History(tmp_path / "h.sqlite", create=True) as history:
        history.append(entry)
    known = unit_state_from_history(
        tmp_path / "h.sqlite", read.serial or 0, ehadiag.default_actuator()
    )
    assert known is not None
    assert known.effects["load"] == 12.0
    assert known.effects["null_bias"] == read.effects[0].value


def test_a_severity_that_a_former_version_did_not_know_is_watched_as_new() -> None:
    read = Result.from_json(LINES[1])
    severities = {name: item for name, item in read.severities.items() if name != "FDJ"}
    known = unit_state_of(
        msgspec.structs.replace(read, severities=severities), ehadiag.default_actuator()
    )
    found = {item.name: item.value for item in known.severities}
    assert found["FSS"] == read.severities["FSS"].value
    assert found["FDJ"] == 0.0


def test_the_table_names_an_effect_only_where_it_says_something(everything: Result) -> None:
    plain, verbose = diagnosis_text(everything), diagnosis_text(everything, verbose=True)
    assert "spool sensor offset" not in plain
    assert "spool sensor offset" in verbose
    assert "also estimated: " in plain
    unsure = tuple(
        msgspec.structs.replace(item, interval95=(-1.0, 1.0)) for item in everything.effects
    )
    assert "also estimated" not in diagnosis_text(
        msgspec.structs.replace(everything, effects=unsure)
    )
