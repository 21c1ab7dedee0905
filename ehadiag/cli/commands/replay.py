"""`ehadiag replay`: plays a recording onto a bus."""

from __future__ import annotations

import argparse

from ehadiag.cli import argument_types, asked_for, bus_options, options
from ehadiag.cli.interrupt import stop_on_signals
from ehadiag.cli.output import damage, progress_bar, say

__all__ = ["add_parser", "run"]


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "replay",
        help="play a recording onto a bus",
        description="Play a recording onto a bus in its own rhythm. This transmits.",
        allow_abbrev=False,
    )
    parser.add_argument("log", metavar="LOG")
    parser.add_argument(
        "--speed",
        type=_speed,
        default=1.0,
        metavar="X",
        help="times its own rhythm (default 1); 0: as fast as the bus takes it",
    )
    options.add_log_options(parser)
    bus_options.add_bus_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Play the log."""
    bus_options.need_one_bus(arguments)
    from firmware_iface.logs.replay import StoredLog, play  # noqa: PLC0415 - loads python-can

    # Read once beforehand: what is wrong with it must be said before anything is sent.
    log = StoredLog(arguments.log, arguments.log_channel, asked_for.the_budget(arguments))
    with (
        bus_options.open_transport(arguments, transmit=True) as transport,
        stop_on_signals() as stop,
        progress_bar() as display,
    ):
        sent = play(
            log,
            transport,
            speed=arguments.speed or None,
            stop=stop,
            progress=lambda done: display("replay", done / max(log.frames, 1)),
        )
    say(f"played {sent} of {log.frames} frames on {transport.name}{damage(transport)}")
    return 0


def _speed(text: str) -> float:
    return 0.0 if text.strip() in ("0", "0.0") else argument_types.positive(text)
