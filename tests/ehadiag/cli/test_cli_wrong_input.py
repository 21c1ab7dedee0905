"""Wrong input gives its exit code and one line that says what, where and how to fix it."""

from __future__ import annotations

from collections.abc import Callable
from importlib import resources
from pathlib import Path

import pytest
from cli_result import Run
from places import LOGS

from firmware_iface.codec import Encoder
from firmware_iface.logs.recorder import Recorder
from firmware_iface.transport.frames import Frame

LOG = LOGS / "paper-open-1.blf"
DATA = resources.files("ehadiag").joinpath("data")
ACTUATOR = DATA.joinpath("actuator.toml").read_text()
TEST = resources.files("firmware_iface").joinpath("data/tests/closed.toml").read_text()


def changed(text: str, old: str, new: str) -> str:
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.parametrize("name", ["missing.blf", "missing"])
def test_missing_file(name: str, run: Run) -> None:
    result = run("diagnose", name)
    assert (result.code, result.message) == (3, f"ehadiag: log {name}: no such file")
    assert run("check-bus", "--log", "").message == "ehadiag: log .: not a file"


@pytest.mark.parametrize(
    ("name", "content", "code", "words"),
    [
        ("text.blf", b"just text\n" * 100, 3, "not a BLF file"),
        ("empty.blf", b"", 3, "the file is empty"),
        ("text.trc", b"just text\n", 3, "no frames in it"),
        ("noise.csv", bytes(range(256)) * 8, 3, "not a readable CSV log"),
        ("log.pcap", b"\xd4\xc3\xb2\xa1", 2, "unknown kind .pcap; known: .blf, .asc"),
        ("log", b"", 2, "unknown kind without a suffix"),
    ],
)
def test_what_is_no_log(
    name: str, content: bytes, code: int, words: str, run: Run, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(content)
    for command in (["diagnose"], ["check-bus", "--log"], ["replay", "--interface", "virtual"]):
        result = run(*command, name)
        assert result.code == code
        assert f"log {name}: " in result.message
        assert words in result.message


@pytest.mark.parametrize("name", ["folder.blf", "folder"])
def test_folder_for_a_log(name: str, run: Run, tmp_path: Path) -> None:
    (tmp_path / name).mkdir()
    result = run("check-bus", "--log", name)
    assert (result.code, result.message) == (3, f"ehadiag: log {name}: not a file")
    result = run("diagnose", name)
    assert result.code == 3
    assert result.message.startswith(f"ehadiag: folder {name}: no recording in it")


def test_log_without_telemetry(run: Run, tmp_path: Path) -> None:
    foreign = [Frame(1_000_000 * k, 0x321, bytes(8)) for k in range(200)]
    oil = [
        frame for k in range(20) for frame in Encoder().environment(2e7, 7e5, 40.0, 10_000_000 * k)
    ]
    for name, frames in (("foreign.blf", foreign), ("oil.blf", oil)):
        with Recorder(tmp_path / name) as recorder:
            for frame in frames:
                recorder.write(frame)
        result = run("diagnose", name)
        assert result.code == 30
        assert "  - no telemetry of a test in the recording" in result.out.splitlines()
        assert result.err == ""


def test_log_cut_at_half(run: Run, tmp_path: Path) -> None:
    content = LOG.read_bytes()
    (tmp_path / "half.blf").write_bytes(content[: len(content) // 2])
    result = run("diagnose", "half.blf")
    assert result.code == 30
    assert result.out.startswith("NOT TESTED  The recording ends early: ")
    assert "note: the log breaks off after" in result.out


WRONG_ACTUATORS = {
    "unknown key": (changed(ACTUATOR, "MJ ", "XX = 1\nMJ "), "unknown field `XX` - at `$.jack`"),
    "missing key": (changed(ACTUATOR, "\nMJ ", "\n# "), "missing required field `MJ` - at"),
    "negative mass": (changed(ACTUATOR, "150.0  ", "-150.0 "), ">= 0.001 - at `$.jack.MJ`"),
    "zero": (changed(ACTUATOR, "0.010 ", "0.0 "), ">= 1e-06 - at `$.servovalve.MS`"),
    "text for a number": (changed(ACTUATOR, "1.6e-3", '"much"'), "got `str` - at `$.jack.AJ`"),
    "infinite": (changed(ACTUATOR, "5.0e3", "inf"), "a finite number is needed at $.jack.CJ"),
    "friction falls": (changed(ACTUATOR, "3000.0", "100.0"), "jack.FDJ1 must be greater"),
    "third kind of stage": (
        ACTUATOR + '\n[second_stage]\nkind = "ball"\n',
        "Invalid enum value 'ball' - at `$.second_stage.kind`",
    ),
    "airy oil": (
        ACTUATOR + '\n[second_stage]\nkind = "orifice"\nbeta = 1e6\n',
        ">= 10000000.0 - at `$.second_stage.beta`",
    ),
    "not TOML": ("[jack\n", "not valid TOML"),
    "not text": ("\udcff", "not valid TOML"),
    "empty": ("", "missing required field"),
}


@pytest.mark.parametrize("case", WRONG_ACTUATORS)
def test_wrong_actuator_file(case: str, run: Run, tmp_path: Path) -> None:
    text, words = WRONG_ACTUATORS[case]
    (tmp_path / "worn.toml").write_bytes(text.encode(errors="surrogateescape"))
    result = run("diagnose", "--actuator", "worn.toml", LOG)
    assert result.code == 2
    assert result.message.startswith("ehadiag: actuator file worn.toml: ")
    assert words in result.message


WRONG_TESTS = {
    "times out of order": (
        changed(TEST, "[0.2, 0.0], [1.2, 10.0]", "[1.2, 0.0], [0.2, 10.0]"),
        "times out of order in segment[0].points",
    ),
    "segments overlap": (
        changed(TEST, "start = 4.5", "start = 4.4"), "segment[2] begins at 4.4 s, must at 4.5 s",
    ),
    "segment ends before it begins": (changed(TEST, "end = 4.5", "end = 3"), "segment[1] ends"),
    "window outside": (
        changed(TEST, "[[3.5, 5.5]]", "[[3.5, 9.5]]"), "windows.refinement [3.5, 9.5] not inside",
    ),
    "wrong unit": (changed(TEST, '"mm"', '"mA"'), "unit 'mA' for a position test, need m or mm"),
    "unknown kind": (changed(TEST, '"sine"', '"chirp"'), "'chirp' - at `$.segment[1].kind`"),
    "number too large": (changed(TEST, "id = 2", "id = 300"), "`$.id`"),
    "no windows": (TEST[: TEST.index("[windows]")], "missing required field `windows`"),
    "endless": (changed(TEST, "end = 5.5", "end = 5e9"), "longer than 600 s"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG_TESTS)
@pytest.mark.parametrize("command", ["bit", "diagnose", "tests"])
def test_wrong_test_file(case: str, command: str, run: Run, tmp_path: Path) -> None:
    text, words = WRONG_TESTS[case]
    (tmp_path / "own.toml").write_text(text)
    options = {
        "bit": ["--simulate", "--test", "own.toml"],
        "diagnose": ["--test", "own.toml", LOG],
        "tests": ["--csv", "own.toml"],
    }
    result = run(command, *options[command])
    assert result.code == 2
    assert result.message.startswith("ehadiag: test file own.toml: ")
    assert words in result.message
    assert not list(tmp_path.glob("**/*.blf"))


def test_test_at_another_rate_than_the_controller(run: Run, tmp_path: Path) -> None:
    (tmp_path / "slow.toml").write_text(changed(TEST, "rate = 1000.0", "rate = 500.0"))
    result = run("bit", "--simulate", "--test", "slow.toml")
    assert result.code == 2
    assert "test 'closed' 500 Hz, controller of actuator 'reference-31' 1000 Hz" in result.message


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["--test", "open"], 2, "no bus named: give --interface and --channel, or --port"),
        (
            ["--test", "opne", "--simulate"],
            2,
            "test 'opne': neither a stored test (closed or 2, open or 1)",
        ),
        (["--test", "gone.toml", "--simulate"], 3, "test file gone.toml: No such file"),
        (["--simulate"], 2, "bit: the following arguments are required: --test; see ehadiag bit"),
        (["--test", "open", "-i", "nonsense"], 2, "interface 'nonsense' unknown, need one of"),
        (["--test", "open", "--port", "/dev/none"], 3, "serial /dev/none: cannot open"),
        (["--test", "open", "--port", "spam://x"], 2, "serial spam://x: "),
        (["--test", "open", "-i", "virtual", "--bus-kwargs", "a"], 2, "a: need KEY=VALUE"),
        (["--test", "open", "-i", "virtual", "-b", "-5"], 2, "'-5': need a whole number above 0"),
        (["--test", "open", "-i", "udp_multicast", "-c", "x"], 2, "x: not an IP address; need"),
        (["--test", "open", "--simulate", "--listen"], 2, "--simulate and --listen exclude"),
        (["--test", "open", "--fast"], 2, "add --simulate"),
        (["--test", "open", "--simulate", "--port", "loop://"], 2, "a serial link has two ends"),
        (["--test", "open", "--simulate", "--fast", "-i", "virtual"], 2, "leave --interface out"),
        (["--test", "open", "--simulate", "--Kintas", "1.5"], 2, "fault Kintas: 1.5 is outside 0"),
        (["--test", "open", "--simulate", "--FSS", "nan"], 2, "fault FSS: nan is outside 0 … 1"),
        (["--test", "open", "--simulate", "--noise", "-1"], 2, "noise (LSB): -1 is outside"),
        (["--test", "open", "--simulate", "--unit", "70000"], 2, "serial 70000: outside"),
        (["--test", "open", "--simulate", "--seed", "-1"], 2, "need a whole number, 0 …"),
        (["--test", "open", "--simulate", "--max-position", "-2"], 2, "need a number above 0"),
        (["--test", "open", "--simulate", "--limit", "0.1"], 2, "need 0 < advisory < limit <= 1"),
        (["--test", "open", "--simulate", "--record", "a.txt"], 2, "recording a.txt: suffix"),
        (["--test", "open", "--simulate", "--record", "no/a.blf"], 3, "no/a.blf: No such file"),
        (["--test", "open", "--simulate", "--out", "file"], 3, "output folder file: "),
        (["--test", "open", "--simulate", "--dbc", "x.dbc"], 3, "DBC file x.dbc: No such file"),
        (["--test", "open", "--simulate", "--mapping", "m.toml"], 3, "m.toml"),
        (
            ["--test", "open", "--simul"],
            2,
            "unrecognized arguments: --simul (did you mean --simulate?); see ehadiag bit --help",
        ),
        (["--test", "open", "--serial", "7"], 2, "--port URL for a serial port, --unit N for the"),
        (["--test", "open", "--simulate", "--serial-number=7"], 2, "another name now: --unit N"),
        (["--test", "open", "--simulate", "--fast", "--port", "x"], 2, "leave --port out"),
    ],
)
def test_wrong_request(options: list[str], code: int, words: str, run: Run, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    result = run("bit", *options)
    assert (result.code, result.out) == (code, "")
    assert words in result.message


def test_a_recording_is_never_overwritten(run: Run, tmp_path: Path) -> None:
    (tmp_path / "mine.blf").write_bytes(b"precious")
    result = run("bit", "--test", "open", "--simulate", "--fast", "--record", "mine.blf")
    assert result.code == 3
    assert "recording mine.blf: exists, and is not overwritten" in result.message
    assert (tmp_path / "mine.blf").read_bytes() == b"precious"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--verbose"], "the following arguments are required: COMMAND; see ehadiag --help"),
        (["diagnosis"], "there is no command 'diagnosis', did you mean diagnose?"),
        (["diagnose"], "diagnose: the following arguments are required: LOG"),
        (["diagnose", "--solver", "luck", LOG], "invalid choice: 'luck'"),
        (["diagnose", "--advisory", "2", LOG], "need 0 < advisory < limit <= 1, not 2 and 0.75"),
        (["check-bus"], "no bus named"),
        (["check-bus", "-i", "virtual", "--duration", "0"], "need a number above 0"),
        (["check-bus", "-i", "virtual", "--port", "loop://"], "exclude each other: name one bus"),
        (["replay", LOG], "no bus named"),
        (["replay", LOG, "-i", "virtual", "--speed", "-1"], "need a number above 0"),
        (["sim"], "no bus named"),
        (["sim", "-i", "virtual", "--FDJ", "-0.1"], "fault FDJ: -0.1 is outside 0 … 1"),
        (["tests", "--csv", "shut"], "test 'shut': neither a stored test (closed or 2, open or 1)"),
    ],
)
def test_wrong_usage(arguments: list[str], words: str, run: Run) -> None:
    result = run(*arguments)
    assert (result.code, result.out) == (2, "")
    assert words in result.message


@pytest.mark.parametrize(
    "arguments",
    [("bit", "--test", "open"), ("sim",), ("replay", LOG), ("check-bus",)],
    ids=lambda item: item[0],
)
def test_two_buses_are_refused_before_anything_is_done(
    arguments: tuple[str, ...], run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for place in ("bit_command", "bus_commands"):
        monkeypatch.setattr(f"ehadiag.cli.{place}.print_compiling_notice", forbidden)
    monkeypatch.setattr("firmware_iface.logs.reader.read_frames", forbidden)
    result = run(*arguments, "-i", "virtual", "--port", "loop://")
    assert (result.code, result.out) == (2, "")
    assert "--port and --interface exclude each other: name one bus" in result.message
    assert not list(tmp_path.iterdir())


def forbidden(*_: object, **__: object) -> None:
    raise AssertionError("done before the options were looked at")


def test_a_serial_link_beside_the_bus_of_the_environment(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """CAN_INTERFACE is a default, not a second bus."""
    monkeypatch.setenv("CAN_INTERFACE", "virtual")
    result = run("bit", "--test", "open", "--port", "spam://x")
    assert "serial spam://x: " in result.message


REQUEST = """[request]
code = { message = "BitRequest", signal = "RequestCode" }
test_id = { message = "BitRequest", signal = "RequestTestId" }
"""


@pytest.mark.parametrize(
    ("request_section", "words"),
    [
        ("", "the mapping has no [request]"),
        (REQUEST + "codes = { start = 1 }\n", "no request code 'abort'"),
    ],
)
def test_a_bus_without_a_request_is_refused_before_a_recording_is_begun(
    request_section: str, words: str, run: Run, tmp_path: Path
) -> None:
    data = resources.files("firmware_iface").joinpath("data")
    (tmp_path / "eha_fcc.dbc").write_bytes(data.joinpath("eha_fcc.dbc").read_bytes())
    text = data.joinpath("eha_fcc.toml").read_text()
    text = text[: text.index("[protection.")]
    (tmp_path / "mine.toml").write_text(changed(text, REQUEST, request_section))
    options = ("--test", "open", "--mapping", "mine.toml", "-i", "virtual", "--record", "a.blf")
    result = run("bit", *options)
    assert (result.code, result.out) == (2, "")
    assert words in result.message
    assert not (tmp_path / "a.blf").exists()
    assert not (tmp_path / "ehadiag-out").exists()


def test_multicast_stays_on_the_machine_unless_asked(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    route = tmp_path / "route"
    route.write_text("head\neth0 00000000 0101A8C0 0003 0 0 0 00000000 0 0 0\n")
    monkeypatch.setattr("firmware_iface.transport.adapters.ROUTES_FILE", route)
    result = run("sim", "-i", "udp_multicast")
    assert result.code == 2
    assert "would leave the machine through eth0" in result.message
    assert "--allow-multicast" in result.message


def test_unreadable_files(run: Run, tmp_path: Path, wrong_mapping: Callable[[str], Path]) -> None:
    (tmp_path / "huge.toml").write_bytes(b"#" * (1 << 21))
    for option in ("--actuator", "--test"):
        result = run("diagnose", option, "huge.toml", LOG)
        assert result.code == 2
        assert "larger than 262144 bytes" in result.message
    result = run("diagnose", "--mapping", wrong_mapping("Spool"), LOG)
    assert result.code == 2
    assert "Spool" in result.message


@pytest.fixture
def wrong_mapping(tmp_path: Path) -> Callable[[str], Path]:
    """Make the default mapping with a signal that its DBC does not have."""

    def make(signal: str) -> Path:
        data = resources.files("firmware_iface").joinpath("data")
        text = changed(data.joinpath("eha_fcc.toml").read_text(), '"SpoolPosition"', f'"{signal}"')
        (tmp_path / "eha_fcc.dbc").write_bytes(data.joinpath("eha_fcc.dbc").read_bytes())
        (tmp_path / "mapping.toml").write_text(text)
        return tmp_path / "mapping.toml"

    return make
