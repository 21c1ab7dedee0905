"""The command line as a process: signals, two processes on a bus, a read-only installation."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from cli_result import COMMAND, REPOSITORY
from places import LOGS

from ehadiag.compile.libraries import cache_folder

LOOPNET = REPOSITORY / "tools" / "loopnet.sh"
NO_NAMESPACE = 125
ATTEMPTS = 5
TOO_LATE = re.compile("not complete 1 s after|no answer within 1 s")
PAPER = ((0.3, 0.3, 0.3), (0.6, 0.6, 0.6))
"""First and last of the paper's cases, one in each test: it takes the seconds of a test."""
CASES = list(zip(("open", "closed"), PAPER, strict=True))
BOTH_ENDS = """
"$PYTHON" -m ehadiag sim --interface udp_multicast "$@" 2> sim.err &
sim=$!
until grep -q 'Ctrl-C stops it' sim.err; do
    kill -0 $sim || { cat sim.err >&2; exit 99; }
    sleep 0.05
done
"$PYTHON" -m ehadiag bit --test "$TEST" --interface udp_multicast --json --out out
code=$?
kill -TERM $sim
wait $sim
echo "sim ended with $?" >&2
cat sim.err >&2
exit $code
"""


@pytest.mark.slow
@pytest.mark.parametrize(("test", "faults"), CASES)
def test_two_processes_on_multicast(
    test: str, faults: tuple[float, float, float], tmp_path: Path, environment: dict[str, str]
) -> None:
    names = ("Kintas", "FSS", "FDJ")
    options = [f"--{name}={value}" for name, value in zip(names, faults, strict=True)]
    for _ in range(ATTEMPTS):
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        done = subprocess.run(
            [LOOPNET, "sh", "-c", BOTH_ENDS, "ends", *options, "--unit=4711"],
            cwd=tmp_path,
            env=environment | {"PYTHON": sys.executable, "TEST": test},
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        # The computer's time is real: on a busy machine it comes too late, and is asked again.
        if not ('"NOT_TESTED"' in done.stdout and TOO_LATE.search(done.stdout)):
            break
    if done.returncode == NO_NAMESPACE:
        pytest.skip(f"no network namespace: {done.stderr.strip()}")
    assert done.returncode == 10, done.stdout + done.stderr
    assert "sim ended with 0" in done.stderr
    assert ", 1 tests started" in done.stderr
    found = json.loads(done.stdout)
    assert (found["verdict"], found["test"], found["serial"]) == ("DEGRADED", test, 4711)
    estimates = [found["faults"][name]["estimate"] for name in names]
    assert estimates == pytest.approx(faults, abs=1.5e-3)
    assert sorted(path.suffix for path in (tmp_path / "out").iterdir()) == [
        ".blf", ".json", ".png",
    ]  # fmt: skip


def test_reader_that_goes_away_ends_it_without_a_traceback(environment: dict[str, str]) -> None:
    done = subprocess.run(
        ["sh", "-c", '"$@" | head -1', "pipe", *COMMAND, "tests", "--csv", "open"],
        env=environment, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.stdout == "time_s,command_mA\n"
    assert done.stderr == ""


def installed_copy(folder: Path) -> Path:
    """Copy the packages and take away the right to write to them."""
    for source in ("ehadiag", "firmware_iface", "sim/ehadiag_sim"):
        package = REPOSITORY / source
        ignored = shutil.ignore_patterns("__pycache__", "c")
        shutil.copytree(package, folder / package.name, ignore=ignored)
    for path in [*folder.rglob("*"), folder]:
        path.chmod(0o555 if path.is_dir() else 0o444)
    return folder


def without_home(
    site: Path, temporary: Path, code: str, environment: dict[str, str], *arguments: str
) -> subprocess.CompletedProcess[str]:
    gone = ("HOME", "XDG_CACHE_HOME", "EHADIAG_CACHE_DIR", "NUMBA_CACHE_DIR", "MPLCONFIGDIR")
    kept = {key: value for key, value in environment.items() if key not in gone}
    kept |= {"PYTHONPATH": str(site), "TMPDIR": str(temporary), "PYTHONDONTWRITEBYTECODE": "1"}
    if (temporary / "kept").exists():
        kept["EHADIAG_CACHE_DIR"] = str(temporary / "kept")
    before = sorted(site.rglob("*"))
    # As root the lack of rights hinders nobody, so what was written is looked at afterwards.
    checked = f"import sys, ehadiag\nassert ehadiag.__file__.startswith({str(site)!r})\n{code}"
    done = subprocess.run(
        [sys.executable, "-c", checked, *arguments],
        cwd=temporary, env=kept, capture_output=True, text=True, timeout=900, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert sorted(site.rglob("*")) == before
    return done


def test_read_only_installation_without_home(tmp_path: Path, environment: dict[str, str]) -> None:
    ours, kept = cache_folder(), tmp_path / "kept"
    assert ours is not None
    shutil.copytree(ours.path, kept / ours.path.name)
    code = "from ehadiag.cli.main import main\nsys.exit(main(sys.argv[1:]))"
    arguments = ("diagnose", "--json", "--out", "reports", str(LOGS / "healthy-open.blf"))
    site = installed_copy(tmp_path.with_name(f"{tmp_path.name}-site"))
    done = without_home(site, tmp_path, code, environment, *arguments)
    said = [line for line in done.stderr.splitlines() if "font cache" not in line]
    assert [line.partition(":")[0] for line in said] == ["ehadiag"]
    assert "compil" not in done.stderr
    assert json.loads(done.stdout)["verdict"] == "HEALTHY"
    assert {path.name for path in tmp_path.iterdir()} == {"reports", "kept"}


@pytest.mark.slow
def test_kernels_that_can_be_kept_nowhere_are_compiled_in_memory(
    tmp_path: Path, environment: dict[str, str]
) -> None:
    """Those of the simulator, the fewest."""
    site = installed_copy(tmp_path.with_name(f"{tmp_path.name}-site"))
    code = "print(ehadiag.simulate('open').samples.ticks)"
    done = without_home(site, tmp_path, code, environment)
    assert "compiling the model's kernels (simulator), in memory, at each start" in done.stderr
    assert done.stdout == "5500\n"
    assert not list(tmp_path.iterdir())


def in_shell(
    command: str, folder: Path, environment: dict[str, str]
) -> subprocess.CompletedProcess[str]:
    """Run ehadiag with arguments and redirections as a shell reads them."""
    return subprocess.run(
        ["sh", "-c", f'"$0" -m ehadiag {command}', sys.executable],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip


@pytest.mark.skipif(os.name != "posix", reason="streams are closed by a POSIX shell")
@pytest.mark.parametrize(
    ("closed", "code"),
    [("<&-", 0), (">&-", 0), ("2>&-", 0), ("<&- >&- 2>&-", 0), (">&- --csv nothing", 2)],
)
def test_closed_streams_are_no_failure(
    closed: str, code: int, tmp_path: Path, environment: dict[str, str]
) -> None:
    done = in_shell(f"tests {closed}", tmp_path, environment)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    assert (done.stdout == "") == (">&-" in closed.replace("2>&-", ""))


@pytest.mark.skipif(os.name != "posix", reason="streams are closed by a POSIX shell")
def test_what_is_said_does_not_go_to_another_stream(
    tmp_path: Path, environment: dict[str, str]
) -> None:
    done = in_shell("diagnose gone.blf 2>&-", tmp_path, environment)
    assert (done.returncode, done.stdout) == (3, "")
