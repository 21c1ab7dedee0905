"""`ehadiag sim`: the emulated flight-control computer on a bus, until stopped."""

from __future__ import annotations

import argparse

from ehadiag.cli import argument_types, asked_for, bus_options, options
from ehadiag.cli.interrupt import stop_on_signals
from ehadiag.cli.output import damage, say, say_if_compiling

__all__ = ["add_parser", "run"]


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "sim",
        help="run the emulated flight-control computer on a bus",
        description="Run the emulated flight-control computer and its actuator on a bus until"
        " Ctrl-C, SIGTERM or --duration.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "--test",
        action="append",
        default=[],
        metavar=options.TEST,
        help="further test that the computer stores; repeatable",
    )
    parser.add_argument(
        "--duration", type=argument_types.positive, metavar="S", help="stop after so many seconds"
    )
    options.add_actuator_options(parser)
    options.add_mapping_options(parser)
    bus_options.add_bus_options(parser)
    options.add_fault_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run until stopped."""
    bus_options.need_one_bus(arguments)
    actuator = asked_for.the_actuator(arguments)
    tests = asked_for.known_tests(arguments.test)
    bus_map = asked_for.the_bus_map(arguments)
    say_if_compiling(simulation=True, identification=False)
    from ehadiag.cli.simulator import make_core  # noqa: PLC0415 - loads numba
    from ehadiag_sim.fcc.emulator import run_emulator  # noqa: PLC0415

    core = make_core(arguments, actuator, tests, bus_map)
    with (
        bus_options.open_transport(arguments, transmit=True) as transport,
        stop_on_signals(after_s=arguments.duration) as stop,
    ):
        names = ", ".join(
            f"{test.id} {test.name}" for test in sorted(tests, key=lambda item: item.id)
        )
        say(f"flight-control computer on {transport.name}, tests {names}; Ctrl-C stops it")
        ticks = run_emulator(core, transport, stop, tell=say)
    say(f"stopped after {ticks} ticks, {core.tests_started} tests started{damage(transport)}")
    return 0
