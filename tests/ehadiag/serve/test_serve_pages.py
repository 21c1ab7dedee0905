"""The local page over real HTTP: what it shows, what it refuses, and what it never lets through."""

from __future__ import annotations

import http.client
import json
import sys
import threading
from contextlib import contextmanager

import pytest

from ehadiag.assess.verdict import Levels
from ehadiag.core.errors import ConfigurationError
from ehadiag.history.records import Entry, Severity, Usage
from ehadiag.history.store import History
from ehadiag.serve.pages import Pages
from ehadiag.serve.server import HOST, Site, serve
from ehadiag.serve.sessions import Sessions

HOSTILE = "</td><script>alert(1)</script>\x1b[31m"
TOKEN = "right"
TALKER = """
import signal, sys, time
from ehadiag.live.snapshot import Bus, Ending, Snapshot
def stop(*_):
    print("abort asked for", file=sys.stderr, flush=True)
    sys.exit(30)
signal.signal(signal.SIGINT, stop)
for number in range(1, 2000):
    item = Snapshot(number=number, time="", command=sys.argv[1], actuator=sys.argv[2], serial=7,
                    bus=Bus(name="none", state="open"))
    sys.stdout.buffer.write(item.to_json() + b"\\n")
    sys.stdout.buffer.flush()
    time.sleep(0.01)
"""


@contextmanager
def site(folder, history=None, token=TOKEN, watch=("monitor", HOSTILE)):
    program = (sys.executable, "-c", TALKER)
    with Sessions(watch, {"open": ("bit", "rig")}, program) as sessions:
        server = serve(Site(Pages(folder, history, Levels(), ("open",)), sessions, token), 0)
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield server.server_port, sessions
        finally:
            server.shutdown()
            server.server_close()


def ask(port, path, method="GET", body=None, **headers):
    connection = http.client.HTTPConnection(HOST, port, timeout=20)
    headers = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, path, body, headers)
    answer = connection.getresponse()
    return answer.status, answer.read().decode(), answer.headers


def events(port, count):
    """Read some events of the stream: kind and data of each."""
    connection = http.client.HTTPConnection(HOST, port, timeout=20)
    connection.request("GET", "/live")
    answer, out = connection.getresponse(), []
    kind, data = "", ""
    while len(out) < count:
        line = answer.readline().decode().rstrip("\n")
        if line.startswith("event: "):
            kind = line[7:]
        elif line.startswith("data: "):
            data = line[6:]
        elif not line and data:
            out.append((kind, json.loads(data)))
            kind = data = ""
    connection.close()
    return out


def until(port, wanted):
    """Read the stream until an event is wanted; a reader that hangs ends by its time limit."""
    connection = http.client.HTTPConnection(HOST, port, timeout=60)
    connection.request("GET", "/live")
    answer, kind = connection.getresponse(), ""
    for line in answer:
        text = line.decode().rstrip("\n")
        kind = text[7:] if text.startswith("event: ") else kind
        if text.startswith("data: ") and wanted(kind, json.loads(text[6:])):
            break
    connection.close()


def is_of(command):
    return lambda kind, item: kind == "snapshot" and item and item["command"] == command


def test_snapshots_of_the_watch_are_streamed_with_texts_as_texts(tmp_path):
    with site(tmp_path) as (port, _):
        came = events(port, 60)
    shown = [item for kind, item in came if kind == "snapshot" and item is not None]
    assert shown[0]["command"] == "monitor"
    assert "\x1b" not in shown[0]["actuator"]
    assert "<script>" in shown[0]["actuator"]
    assert shown[-1]["number"] > shown[0]["number"]
    states = [item for kind, item in came if kind == "state"]
    assert all(item["running"] is None for item in states)
    assert any(line.startswith("$ ehadiag monitor") for line in states[-1]["said"])


def test_a_test_starts_and_aborts_by_token_only(tmp_path):
    body = json.dumps({"test": "open"})
    with site(tmp_path) as (port, sessions):
        assert ask(port, "/start", "POST", body)[0] == 403
        assert ask(port, "/start", "POST", body, X_Ehadiag_Token="wrong")[0] == 403
        assert ask(port, "/abort", "POST", "{}", X_Ehadiag_Token=TOKEN)[0] == 409
        assert ask(port, "/start", "POST", '{"test": "other"}', X_Ehadiag_Token=TOKEN)[0] == 404
        assert sessions.running is None
        assert ask(port, "/start", "POST", body, X_Ehadiag_Token=TOKEN)[0] == 202
        until(port, is_of("bit"))
        assert sessions.running == "open"
        assert ask(port, "/start", "POST", body, X_Ehadiag_Token=TOKEN)[0] == 409
        assert ask(port, "/abort", "POST", "{}", X_Ehadiag_Token=TOKEN)[0] == 202
        until(port, is_of("monitor"))
        said = sessions.wait(0, 1.0).said
        assert "abort asked for" in said
        assert "ended with exit code 30" in said


def test_a_test_starts_where_nothing_is_watched(tmp_path):
    with site(tmp_path, watch=None) as (port, _):
        body = json.dumps({"test": "open"})
        assert ask(port, "/start", "POST", body, X_Ehadiag_Token=TOKEN)[0] == 202
        until(port, is_of("bit"))


def test_without_allowing_tests_none_starts(tmp_path):
    with site(tmp_path, token=None) as (port, sessions):
        status, text, _ = ask(port, "/start", "POST", '{"test": "open"}', X_Ehadiag_Token="")
        assert status == 403
        assert "--allow-tests" in text
        assert sessions.running is None


@pytest.mark.parametrize(
    "headers",
    [{"Host": "elsewhere.example"}, {"Origin": "http://elsewhere.example"}, {"Origin": "null"}],
)
@pytest.mark.parametrize("method", ["GET", "POST"])
def test_another_sites_pages_are_refused(tmp_path, headers, method):
    with site(tmp_path, watch=None) as (port, _):
        connection = http.client.HTTPConnection(HOST, port, timeout=20)
        connection.request(method, "/", "{}", {"X-Ehadiag-Token": TOKEN, **headers})
        assert connection.getresponse().status == 403


def test_a_request_that_is_too_long_is_not_read(tmp_path):
    with site(tmp_path, watch=None) as (port, _):
        assert ask(port, "/start", "POST", "x" * 5000, X_Ehadiag_Token=TOKEN)[0] == 404


def test_pages_allow_no_outside_source(tmp_path):
    with site(tmp_path, watch=None) as (port, _):
        for path in ("/", "/history", "/reports"):
            status, _, headers = ask(port, path)
            assert status == 200
            policy = dict(
                part.strip().split(" ", 1) for part in headers["Content-Security-Policy"].split(";")
            )
            assert policy["default-src"] == "'none'"
            assert policy["connect-src"] == "'self'"
            sources = policy["script-src"].split()
            assert all(item.startswith("'sha256-") or item == "'none'" for item in sources)
        assert ask(port, "/nowhere")[0] == 404


def test_history_shows_units_and_escapes_their_texts(tmp_path):
    place = tmp_path / "history.db"
    severities = tuple(
        Severity(name, 0.1, 0.001, 0.098, 0.102, False, True) for name in ("Kintas", "FSS", "FDJ")
    )
    entry = Entry(
        "2026-01-02T00:00:00Z", "2026-01-01T00:00:00Z", HOSTILE, 7, HOSTILE, "DEGRADED", (),
        Usage(10.0, None), (), severities, None, (), "0", False, "{}",
    )  # fmt: skip
    with History(place, create=True) as history:
        history.append(entry)
    with site(tmp_path, place, watch=None) as (port, _):
        _, units, _ = ask(port, "/history")
        status, unit, _ = ask(port, "/history/7")
    assert status == 200
    for text in (units, unit):
        assert "<script>alert" not in text
        assert "DEGRADED" in text
    assert '<a href="/history/7">7</a>' in units


def test_only_reports_of_the_folder_are_served_and_as_strangers(tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "a&b.html").write_text("<p>mine</p>")
    (tmp_path / "secret.html").write_text("secret")
    (folder / "link.html").symlink_to(tmp_path / "secret.html")
    with site(folder, watch=None) as (port, _):
        _, listed, _ = ask(port, "/reports")
        assert "a&amp;b.html" in listed
        assert "link.html" not in listed
        status, text, headers = ask(port, "/reports/a%26b.html")
        assert (status, text) == (200, "<p>mine</p>")
        assert headers["Content-Security-Policy"].startswith("sandbox")
        for path in ("link.html", "..%2Fsecret.html", "../secret.html", "%2e%2e/secret.html", ""):
            assert ask(port, f"/reports/{path}")[0] == 404


def test_a_damaged_history_is_said_and_the_rest_goes_on(tmp_path):
    place = tmp_path / "history.db"
    place.write_bytes(b"no database" * 100)
    with site(tmp_path, place, watch=None) as (port, _):
        status, text, _ = ask(port, "/history")
        assert status == 503
        assert "is no history" in text
        assert ask(port, "/")[0] == 200


def test_a_taken_port_is_said_in_one_line(tmp_path):
    with (
        site(tmp_path, watch=None) as (port, sessions),
        pytest.raises(ConfigurationError, match=f"--port {port}: .*name another"),
    ):
        serve(Site(lambda _: None, sessions, None), port)
