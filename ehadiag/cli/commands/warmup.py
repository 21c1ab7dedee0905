"""`ehadiag warmup`: compiles every kernel now rather than at the first diagnosis."""

from __future__ import annotations

import argparse
import time

from ehadiag.cli.output import say, say_if_compiling
from ehadiag.core.actuator import default_actuator
from ehadiag.core.errors import InputOutputError
from ehadiag.core.recording import CommandMode
from ehadiag.core.stored_test import bundled_tests

__all__ = ["add_parser", "run"]


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "warmup",
        help="compile the kernels now",
        description="Compile the model's kernels into the cache folder (EHADIAG_CACHE_DIR, else"
        " the user's cache), so that the first diagnosis does not wait for it.",
        allow_abbrev=False,
    )
    parser.set_defaults(run=run)


def run(_arguments: argparse.Namespace) -> int:
    """Compile."""
    say_if_compiling(simulation=True)
    begin = time.perf_counter()
    from ehadiag.compile.kernel_cache import cache_folder  # noqa: PLC0415
    from ehadiag.identify.warmup import warm_up  # noqa: PLC0415 - loads numba
    from ehadiag.monitor import Monitor  # noqa: PLC0415
    from ehadiag_sim.plant.simulator import Plant  # noqa: PLC0415
    from firmware_iface.mapping.bus_map import default_map  # noqa: PLC0415

    for test in bundled_tests().values():
        warm_up(default_actuator(), test)
    Monitor(default_actuator(), (0.0, 0.0, 0.0))
    Plant(default_actuator()).tick(0.0, CommandMode.CURRENT)
    default_map()  # keeps what it finds in the DBC
    folder = cache_folder()
    took = f"{time.perf_counter() - begin:.1f} s"
    if folder is None:
        say(f"kernels compiled in {took}, and kept nowhere")
        return InputOutputError.exit_code
    say(f"kernels ready in {folder.path} after {took}")
    return 0
