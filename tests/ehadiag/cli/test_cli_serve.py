"""`ehadiag serve` as it is called: what it refuses, what it hands on, and one simulated test."""

from __future__ import annotations

import argparse
import http.client
import json
import signal
import subprocess
import sys

import pytest

from ehadiag.cli.commands.serve import WATCHING, add_parser, handed_on
from ehadiag.cli.main import main


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "no bus named"),
        (["--simulate"], "--allow-tests"),
        (["--simulate", "--allow-tests", "--port", "70000"], "need a port"),
        (["--simulate", "--allow-tests", "--test", "nothing"], "nothing"),
        (["--simulate", "--allow-tests", "--actuator", "missing.toml"], "missing.toml"),
    ],
)
def test_wrong_usage_is_one_line(options, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    try:
        code = main(["serve", *options])
    except SystemExit as error:
        code = error.code
    assert code in (2, 3)
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert words in said[0]


def test_options_are_handed_on_as_they_were_given():
    parser = argparse.ArgumentParser()
    add_parser(parser.add_subparsers())
    command = parser._subparsers._group_actions[0].choices["serve"]
    given = ["-i", "socketcan", "-c", "can 0", "--fd", "--bus-kwargs", "a=1", "b=2", "--hours", "5"]
    arguments = command.parse_args([*given, "--allow-tests", "--port", "0"])
    out = handed_on(arguments, command)
    assert {"--interface=socketcan", "--channel=can 0", "--fd", "--hours=5.0"} <= set(out)
    assert out[out.index("--bus-kwargs") + 1 :][:2] == ["a=1", "b=2"]
    assert not any("port" in item or "allow-tests" in item for item in out)
    assert "--hours=5.0" not in handed_on(arguments, command, WATCHING)


@pytest.mark.slow
def test_a_simulated_test_is_run_from_the_page(tmp_path):
    command = ["serve", "--simulate", "--allow-tests", "--port", "0", "--out", str(tmp_path)]
    program = [sys.executable, "-m", "ehadiag", *command]
    with subprocess.Popen(program, stderr=subprocess.PIPE, text=True, cwd=tmp_path) as process:
        try:
            said = process.stderr.readline()
            address, token = said.split()[2].split("#token=")
            port = int(address.rstrip("/").rpartition(":")[2])
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=120)
            headers = {"X-Ehadiag-Token": token}
            connection.request("POST", "/start", json.dumps({"test": "open"}), headers)
            assert connection.getresponse().read() == b"{}"
            stream = http.client.HTTPConnection("127.0.0.1", port, timeout=120)
            stream.request("GET", "/live")
            answer, ending, running = stream.getresponse(), None, True
            while ending is None or running:
                line = answer.readline()
                assert line, "the page's stream ended before the test"
                data = json.loads(line[6:]) if line.startswith(b"data: {") else {}
                ending = data.get("ending", ending)
                running = data.get("running", running)
            assert ending["verdict"] in ("HEALTHY", "NOT TESTED")
            assert list(tmp_path.glob("*.json"))
        finally:
            process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
