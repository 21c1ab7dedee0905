"""What a diagnosis can be asked for follows from one record."""

from __future__ import annotations

import argparse
from typing import Any

import msgspec
import pytest

from ehadiag.api import Options
from ehadiag.cli import options
from ehadiag.cli.command_parser import file_keys, project_keys
from ehadiag.cli.main import parser_and_commands
from ehadiag.request import Request, request_options
from ehadiag.setup import Setup
from firmware_iface.errors import ConfigurationError

OTHER: dict[str, Any] = {
    "logs": ("a.blf",),
    "test": ("open",),
    "actuator": "left.toml",
    "mapping": "bus.toml",
    "dbc": "bus.dbc",
    "columns": ("position=Stroke:mm",),
    "start_s": 1.5,
    "end_s": 7.5,
    "tolerance": 0.05,
    "id_offset": 16,
    "log_channel": 2,
    "solver": "pygad",
    "nuisances": "all",
    "prior": "yesterday.json",
    "rule": "estimate",
    "time_limit_s": 5.0,
}
"""Of each field that a number does not suit, a value other than its default."""


def another(name: str) -> Any:
    """Return a value of a field that is not its default."""
    default = request_options()[name].default
    if name in OTHER:
        return OTHER[name]
    return not default if isinstance(default, bool) else type(default)(default * 1.5 + 1) or 1


def asking(name: str) -> Request:
    value = {"advisory": 0.3, "limit": 0.8}.get(name)
    return Request(**{name: another(name) if value is None else value})


def test_keyword_arguments_are_the_fields() -> None:
    assert set(Options.__annotations__) == set(Request.__struct_fields__) - {"logs"}


@pytest.mark.parametrize("name", [name for name in Request.__struct_fields__ if name != "logs"])
def test_each_option_of_diagnose_reaches_its_field(name: str) -> None:
    option = request_options()[name]
    value = getattr(asking(name), name)
    words = [option.flag]
    if option.kind is not bool:
        words.append(value[0] if option.many else str(value))
    parser, _ = parser_and_commands()
    parsed = parser.parse_args(["diagnose", "a.blf", *words])
    for files in ("actuator", "mapping"):  # once for each actuator on the bus
        given = getattr(parsed, files)
        setattr(parsed, files, given[0] if given else None)
    assert getattr(options.request_of(parsed), name) == value


@pytest.mark.parametrize("name", Request.__struct_fields__)
def test_each_field_survives_json(name: str) -> None:
    request = asking(name)
    assert getattr(request, name) != request_options()[name].default
    assert msgspec.json.decode(msgspec.json.encode(request), type=Request) == request


def test_each_field_says_what_it_is_and_what_it_takes() -> None:
    for option in request_options().values():
        assert option.help
        assert option.flag.startswith("--") or option.name == "logs"
        assert option.need.startswith("need ")


def test_a_projects_file_may_set_what_the_fields_say() -> None:
    assert {"actuator", "log_channel", "seed", "rule"} <= project_keys()
    assert not {"time_limit", "max_frames", "all", "tolerance"} & project_keys()
    assert {"actuator", "mapping", "dbc", "test", "prior"} == file_keys()


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"seed": -1}, "seed -1: need a whole number, 0 … 4294967295"),
        ({"solver": "swarm"}, "solver 'swarm': need one of cga, pygad"),
        ({"tolerance": 0.5}, r"tolerance 0\.5: need a number, 0 … 0\.3"),
        ({"log_channel": 0}, "log_channel 0: need a whole number above 0"),
        ({"time_limit_s": float("nan")}, "time_limit_s nan: need a number above 0"),
        ({"columns": 3}, "columns 3: need a text or a path"),
        ({"joint": "yes"}, "joint 'yes': need true or false"),
        ({"advisory": 0.9}, "need 0 < advisory < limit <= 1"),
        ({"start_s": 3.0, "end_s": 2.0}, "--end 2: not after --start 3"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(fields: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigurationError, match=text):
        Request(**fields)


def test_one_path_stands_for_several_and_numbers_become_plain() -> None:
    import numpy as np

    request = Request(test="open", seed=np.int64(3), tolerance=np.float64(0.1))
    assert request.test == ("open",)
    assert type(request.seed) is int
    assert type(request.tolerance) is float


def test_a_command_without_a_field_asks_for_the_usual() -> None:
    assert options.request_of(argparse.Namespace(seed=3, actuator="")) == Request(seed=3)


def test_a_history_does_not_load_what_is_loaded() -> None:
    setup = Setup(Request())
    mapping = setup.bus_map
    assert setup.with_history(None).bus_map is mapping
