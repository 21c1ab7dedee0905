#!/usr/bin/env python3
"""Undo the fix of each break in a copy of the sources and run its tests: they must fail.

`python tools/undone_fixes.py [BREAK...]` prints a row for each (docs/explanation/attacks.md).
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TIMEOUT_S = 120
"""Longest time of a test whose fix is undone, s: some fixes are what brings it to an end."""
FAILED = 1
"""Exit code of pytest where tests failed, and nothing else went wrong."""


@dataclass(frozen=True, slots=True)
class Undone:
    """A fix, how it is undone, and the test that then fails."""

    number: str
    """Of the break."""
    what: str
    """What is undone, for people."""
    file: str
    pairs: tuple[tuple[str, str], ...]
    """Texts of the file and what stands for them, each of which occurs once."""
    test: str
    """File of tests, and the name of one."""


LIVE, CLI, CORE = "tests/firmware_iface/live", "tests/ehadiag/cli", "tests/ehadiag/core"
HISTORY = "tests/ehadiag/history/test_hostile_history.py"
SAFE_CHILDREN = "        with children_with_safe_path():\n            process.start()"
SAFE_WORKERS = "        self._stack.enter_context(children_with_safe_path())\n"
STOPPED = "                if self._clock() > self._end + MAX_OVERTIME_S:"
UNDONE = (
    Undone("1", "`PYTHONSAFEPATH` for the sessions of `serve`", "ehadiag/serve/sessions.py",
        ((SAFE_CHILDREN, "        process.start()"),),
        f"{CLI}/test_planted_files.py::test_sessions_of_the_page_load"),
    Undone("1", "working folder taken off the path by `python -m`", "ehadiag/__main__.py",
        (("        del sys.path[0]", "        pass"),),
        f"{CLI}/test_planted_files.py::test_python_m_loads"),
    Undone("1", "`-P` of the compiling process", "ehadiag/compile/worker.py",
        (('sys.executable, "-P", "-c"', 'sys.executable, "-c"'),),
        f"{CLI}/test_planted_files.py::test_the_compiling_process_loads"),
    Undone("1", "`-P` of the process that draws the screen", "ehadiag/terminal/screen.py",
        (('sys.executable, "-P", "-m"', 'sys.executable, "-m"'),),
        f"{CLI}/test_planted_files.py::test_the_process_of_the_screen_loads"),
    Undone("2", "`PYTHONSAFEPATH` for workers and their trackers", "ehadiag/batch/workers.py",
        ((SAFE_WORKERS, ""),),
        f"{CLI}/test_planted_files.py::test_workers_and_resource_trackers_load"),
    Undone("5", "look at owners, links and folder beside a history", "ehadiag/history/store.py",
        (("    trusted = {os.getuid(), 0}", "    return\n    trusted = {os.getuid(), 0}"),),
        f"{HISTORY}::test_a_planted_log_does_not_rewrite_a_history"),
    Undone("6", "bounds of a DBC before its parser", "firmware_iface/dbc.py",
        (("    _check_budget(content, name)\n", ""),),
        "tests/firmware_iface/mapping/test_dbc_bombs.py::test_a_bomb_is_refused"),
    Undone("7", "length of an object against its header", "firmware_iface/logs/blf.py",
        (("        if body > place + size:", "        if body < 0:"),
         ("        except struct.error:", "        except ZeroDivisionError:")),
        "tests/firmware_iface/logs/test_blf_damage.py::test_a_short_object_is_damage"),
    Undone("7", "range of a start's date", "firmware_iface/logs/blf.py",
        (("    return start_ns if 0 <= start_ns < MAX_STAMP_NS else 0", "    return start_ns"),),
        "tests/firmware_iface/logs/test_blf_damage.py::test_a_start_beyond_all_stamps"),
    Undone("7", "an error of one recording is its own", "ehadiag/cli/batch_run.py",
        (("                if len(self._inputs) == 1:", "                if self._inputs:"),),
        f"{CLI}/test_breaks.py::test_an_error_of_the_program_costs_one_recording"),
    Undone("8", "no parser of YAML while numba is loaded", "ehadiag/compile/frontend.py",
        (('    sys.modules["yaml"] = None  #', "    import yaml  #"),),
        f"{CORE}/test_time_limit.py::test_numba_takes_no_configuration"),
    Undone("8", "watchdog outside the computing thread", "ehadiag/setup.py",
        ((STOPPED, "                if self._clock() < 0.0:"),),
        f"{CORE}/test_time_limit.py::test_a_computation_that_reports_nothing_ends"),
    Undone("9", "requests of a recording left out", "ehadiag/cli/bus_commands.py",
        (("() if arguments.with_requests else setup.bus_map.request_identifiers", "()"),),
        f"{CLI}/test_breaks.py::test_replay_sends_no_request"),
    Undone("10", "rows checked", "ehadiag/history/store.py",
        (("        except (ValueError, TypeError, RecursionError, ConfigurationError):",
          "        except ZeroDivisionError:"),),
        f"{HISTORY}::test_a_row_that_is_none_of_ours"),
    Undone("10", "a query ends in time", "ehadiag/history/store.py",
        (("        return time.monotonic() > self._deadline", "        return False"),),
        f"{HISTORY}::test_a_query_without_end"),
    Undone("10", "only tables of our own", "ehadiag/history/store.py",
        (("            refuse_foreign_schema(self._connection, version)\n", ""),),
        f"{HISTORY}::test_only_our_own_tables"),
    Undone("11", "digits of a length", "ehadiag/serve/server.py",
        ((" and len(length) <= len(str(MAX_REQUEST_BYTES))", ""),),
        "tests/ehadiag/serve/test_serve_requests.py::test_a_length_or_a_body"),
    Undone("11", "JSON that is too deep", "ehadiag/serve/server.py",
        (("        except (ValueError, RecursionError):", "        except ValueError:"),),
        "tests/ehadiag/serve/test_serve_requests.py::test_a_length_or_a_body"),
    Undone("13", "restart of a counter, live", "firmware_iface/protection.py",
        (("counter[0] <= MAX_RESTART_COUNT", "counter[0] < 0"),),
        f"{LIVE}/test_counter_restart.py::test_a_restart_with_a_change_of_state"),
    Undone("13", "restart of a counter, recorded", "firmware_iface/protection.py",
        (("(counter[1:] <= MAX_RESTART_COUNT)", "(counter[1:] < 0)"),),
        f"{LIVE}/test_counter_restart.py::test_a_restart_with_a_change_of_state"),
    Undone("14", "Ctrl-Break among the signals", "ehadiag/core/interruption.py",
        (('"SIGTERM", "SIGHUP", "SIGBREAK")', '"SIGTERM", "SIGHUP")'),),
        f"{CORE}/test_time_limit.py::test_ctrl_break_is_handled"),
)  # fmt: skip


def main() -> int:
    """Print a row for each; 1 where a test does not fail."""
    wanted = set(sys.argv[1:])
    missed = 0
    with tempfile.TemporaryDirectory(prefix="ehadiag-") as place:
        listed = subprocess.run(
            ["git", "archive", "HEAD"], cwd=ROOT, capture_output=True, check=True
        )
        subprocess.run(["tar", "x", "-C", place], input=listed.stdout, check=True)
        for item in UNDONE:
            if not wanted or item.number in wanted:
                seen = _seen(item, Path(place))
                missed += not seen
                name = item.test.replace("::", "`, `")
                print(
                    f"| {item.number} | {item.what} | `{name}…` | {seen or 'PASSED'} |", flush=True
                )
    return int(missed > 0)


def _seen(item: Undone, place: Path) -> str:
    """How the tests fail without the fix; empty where they do not."""
    path = place / item.file
    before = path.read_text()
    text = before
    for old, new in item.pairs:
        if text.count(old) != 1:
            raise SystemExit(f"{item.file}: {old!r} {text.count(old)} times")
        text = text.replace(old, new)
    path.write_text(text)
    try:
        return _failure(item.test, place)
    finally:
        path.write_text(before)


def _failure(test: str, place: Path) -> str:
    file, name = test.split("::")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(_paths(place))}
    command = [
        sys.executable, "-m", "pytest", "-q", "-n", "0", "-k", name, "-m", "slow or not slow",
        f"--timeout={TIMEOUT_S}", "-p", "no:cacheprovider", file,
    ]  # fmt: skip
    done = subprocess.run(
        command, cwd=place, env=environment, capture_output=True, text=True, check=False
    )
    late = "from pytest-timeout" in done.stdout
    if done.returncode != FAILED and not late:
        return ""
    counts = re.findall(
        r"\d+ failed|\d+ passed", done.stdout.splitlines()[-1] if done.stdout else ""
    )
    reasons = re.findall(r"^E +(\S.*)$", done.stdout, re.M)
    why = "without end" if late else reasons[0][:90].replace("|", "/") if reasons else ""
    return f"{', '.join(counts)}: `{why}`" if counts else why


def _paths(place: Path) -> Iterator[str]:
    yield from (str(place / name) for name in ("", "sim", "tools"))


if __name__ == "__main__":
    raise SystemExit(main())
