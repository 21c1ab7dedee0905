"""The local page over real HTTP: what it shows, what it refuses, and what it never lets through."""

from __future__ import annotations

import http.client
import json
import os
import socket
import threading
from contextlib import contextmanager

import numpy as np
import pytest
from history_cases import an_entry
from msgspec.structs import replace
from page_sessions import fail, talk

from ehadiag import ConfigurationError, Levels
from ehadiag.estimate import Severity
from ehadiag.history.records import Entry, Usage
from ehadiag.history.store import History
from ehadiag.prognosis.averaging import learn_fleet
from ehadiag.prognosis.forecast import RemainingLife, forecast
from ehadiag.prognosis.lives import Life
from ehadiag.prognosis.units import Prognosis
from ehadiag.report.fleet_table import FleetUnit, fleet_table
from ehadiag.serve.pages import Pages
from ehadiag.serve.server import LOOPBACK_ADDRESS, Site, serve
from ehadiag.serve.sessions import Session, SessionRunner
from firmware_iface import FREE_MOTION

HOSTILE = "</td><script>alert(1)</script>\x1b[31m"
TOKEN = "right"
WATCH = Session("watching the bus", talk, ("monitor", HOSTILE))


@contextmanager
def site(folder, history=None, token=TOKEN, watch=WATCH):
    with SessionRunner(watch, {"open": Session("test open", talk, ("bit", "rig"))}) as sessions:
        server = serve(Site(Pages(folder, history, Levels(), ("open",)), sessions, token), 0)
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield server.server_port, sessions
        finally:
            server.shutdown()
            server.server_close()


def request(port, path, method="GET", body=None, **headers):
    connection = http.client.HTTPConnection(LOOPBACK_ADDRESS, port, timeout=120)
    headers = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, path, body, headers)
    answer = connection.getresponse()
    return answer.status, answer.read().decode(), answer.headers


def events(port, count):
    """Read some events of the stream: kind and data of each."""
    connection = http.client.HTTPConnection(LOOPBACK_ADDRESS, port, timeout=120)
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
    connection = http.client.HTTPConnection(LOOPBACK_ADDRESS, port, timeout=60)
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
    assert any(line == "watching the bus" for line in states[-1]["said"])


def test_a_test_starts_and_aborts_by_token_only(tmp_path):
    body = json.dumps({"test": "open"})
    with site(tmp_path) as (port, sessions):
        assert request(port, "/start", "POST", body)[0] == 403
        assert request(port, "/start", "POST", body, X_Ehadiag_Token="wrong")[0] == 403
        assert request(port, "/abort", "POST", "{}", X_Ehadiag_Token=TOKEN)[0] == 409
        assert request(port, "/start", "POST", '{"test": "other"}', X_Ehadiag_Token=TOKEN)[0] == 404
        simulated = json.dumps({"test": "open", "severities": {"FSS": 0.5}})
        status, text, _ = request(port, "/start", "POST", simulated, X_Ehadiag_Token=TOKEN)
        assert (status, "only a simulated unit" in text) == (400, True)
        odd = json.dumps({"test": "open", "severities": {"FSS": 2}})
        assert request(port, "/start", "POST", odd, X_Ehadiag_Token=TOKEN)[0] == 400
        assert sessions.running is None
        assert request(port, "/start", "POST", body, X_Ehadiag_Token=TOKEN)[0] == 202
        until(port, is_of("bit"))
        assert sessions.running == "open"
        assert request(port, "/start", "POST", body, X_Ehadiag_Token=TOKEN)[0] == 409
        assert request(port, "/abort", "POST", "{}", X_Ehadiag_Token=TOKEN)[0] == 202
        until(port, is_of("monitor"))
        said = sessions.wait(0, 1.0).lines
        assert "abort asked for" in said
        assert "ended with exit code 30" in said


def test_a_test_starts_where_nothing_is_watched(tmp_path):
    with site(tmp_path, watch=None) as (port, _):
        body = json.dumps({"test": "open"})
        assert request(port, "/start", "POST", body, X_Ehadiag_Token=TOKEN)[0] == 202
        until(port, is_of("bit"))


def test_a_session_that_fails_says_why_and_is_begun_again(tmp_path, monkeypatch):
    monkeypatch.setattr("ehadiag.serve.sessions.WATCH_RESTART_PAUSE_S", 0.1)
    with site(tmp_path, watch=Session("watching", fail, ())) as (port, sessions):
        until(port, lambda kind, item: kind == "state" and item["said"].count("watching") > 1)
        said = sessions.wait(0, 1.0).lines
    assert "ehadiag: no such bus" in said
    assert "ended with exit code 3" in said


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_a_session_ends_as_by_ctrl_c_when_its_server_is_gone(tmp_path):
    with site(tmp_path) as (port, sessions):
        until(port, is_of("monitor"))
        process = sessions._process
        with socket.socket(fileno=os.dup(sessions._pipe.fileno())) as handle:
            handle.shutdown(socket.SHUT_RDWR)  # as the system does at the end of the server
        until(
            port, lambda kind, item: kind == "state" and "ended with exit code 30" in item["said"]
        )
        assert process.exitcode == 30


def test_without_allowing_tests_none_starts(tmp_path):
    with site(tmp_path, token=None) as (port, sessions):
        status, text, _ = request(port, "/start", "POST", '{"test": "open"}', X_Ehadiag_Token="")
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
        connection = http.client.HTTPConnection(LOOPBACK_ADDRESS, port, timeout=120)
        connection.request(method, "/", "{}", {"X-Ehadiag-Token": TOKEN, **headers})
        assert connection.getresponse().status == 403


def test_a_request_that_is_too_long_is_not_read(tmp_path):
    with site(tmp_path, watch=None) as (port, _):
        assert request(port, "/start", "POST", "x" * 5000, X_Ehadiag_Token=TOKEN)[0] == 400


def test_pages_allow_no_outside_source(tmp_path):
    with site(tmp_path, watch=None) as (port, _):
        for path in ("/", "/session", "/reports"):
            status, _, headers = request(port, path)
            assert status == 200
            policy = dict(
                part.strip().split(" ", 1) for part in headers["Content-Security-Policy"].split(";")
            )
            assert policy["default-src"] == "'none'"
            assert policy["connect-src"] == "'self'"
            sources = policy["script-src"].split()
            assert all(item.startswith("'sha256-") or item == "'none'" for item in sources)
        assert request(port, "/nowhere")[0] == 404


def test_history_shows_units_and_escapes_their_texts(tmp_path):
    place = tmp_path / "history.db"
    severities = tuple(
        Severity(name=name, estimate=0.1, std=0.001, interval95=(0.098, 0.102))
        for name in ("Kintas", "FSS", "FDJ")
    )
    entry = Entry(
        "2026-01-02T00:00:00Z", "2026-01-01T00:00:00Z", HOSTILE, 7, HOSTILE, "DEGRADED", (),
        Usage(10.0, None), (), severities, None, (), "0", False, "{}",
    )  # fmt: skip
    with History(place, create=True) as history:
        history.append(entry)
    with site(tmp_path, place, watch=None) as (port, _):
        _, units, _ = request(port, "/")
        status, unit, _ = request(port, "/history/7")
    assert status == 200
    for text in (units, unit):
        assert "<script>alert" not in text
        assert "DEGRADED" in text
    assert '<a href="/history/7">7</a>' in units


def test_the_fleet_says_what_to_do_worst_unit_first(tmp_path):
    place = tmp_path / "history.db"
    worn = [an_entry(serial, 100.0, (0.1, spool, 0.1)) for serial, spool in ((3, 0.1), (9, 0.9))]
    shut = replace(worn[0], serial=5, verdict="NOT_TESTED")
    with History(place, create=True) as history:
        history.append_all([replace(worn[0], verdict="HEALTHY"),
                            replace(worn[1], verdict="FAULT"), shut])  # fmt: skip
    with site(tmp_path, place, watch=None) as (port, _):
        _, page, _ = request(port, "/")
    assert "<h1>Fleet: 1 FAULT, 1 INCONCLUSIVE, 1 HEALTHY</h1>" in page
    places = [page.index(f'href="/history/{serial}"') for serial in (9, 5, 3)]
    assert places == sorted(places)
    assert "Act now: replace the servovalve" in page
    assert ">INCONCLUSIVE<" in page
    assert (
        "advisory level 25\N{NO-BREAK SPACE}%, limit 75\N{NO-BREAK SPACE}%. Worst unit first."
        in page
    )
    assert ">0 h, limit reached<" in page
    assert ">too few diagnoses<" in page
    assert ">trend<" not in page  # no unit has two diagnoses


def test_a_units_page_says_first_what_to_do_by_when(tmp_path):
    place = tmp_path / "history.db"
    with History(place, create=True) as history:
        for step in range(4):
            wear = 0.2 + 0.1 * step
            history.append(an_entry(9, 100.0 * step, (wear, 0.1, wear / 2), verdict="DEGRADED"))
    with site(tmp_path, place, watch=None) as (port, _):
        _, page, _ = request(port, "/history/9")
    assert '<h1 class="DEGRADED">Unit 9: DEGRADED</h1>' in page
    first = page.partition('<p class="text first">')[2].partition("</p>")[0]
    assert first.startswith("Filter clogging reaches its limit in about ")
    assert " Plan to clean or replace the filter of the servovalve" in first
    life = page.partition('aria-label="Remaining life"')[2].partition("</table>")[0]
    places = [life.index(f"<td>{name}") for name in ("filter clogging", "jack f", "spool f")]
    assert places == sorted(places)
    assert "needs" in life or "no growth" in life  # of the spool friction, which did not change
    assert "interval)" not in life
    assert page.index('id="life"') < page.index('aria-label="Remaining life"')


def test_only_the_page_that_begins_tests_says_that_they_are_simulated(tmp_path):
    pages = Pages(tmp_path, None, Levels(), ("open",), simulated=True)
    told = [b">simulated<" in pages(path).body for path in ("/session", "/", "/reports")]
    assert told == [True, False, False]


def test_too_few_diagnoses_are_counted_and_not_read_from_a_reason():
    def left(diagnoses):
        why = "no wear: the unit needs nothing"
        future = forecast(
            "FSS", "hours", Life(1, *3 * (np.ones(0),), 0.0), learn_fleet([], 1.0), []
        )
        future = replace(
            future, diagnoses=diagnoses, remaining=(RemainingLife(0.75, None, None, None, why),)
        )
        known = Prognosis(1, "x", "hours", 0, 0, (0.25, 0.75), (future,), 0, None, "")
        unit = FleetUnit(1, "x", "HEALTHY", "HEALTHY", (), (), "", "", known)
        head, (cells,) = fleet_table([unit], Levels())
        return cells[head.index("time left")].text

    assert left(2) == "too few diagnoses"
    assert left(3) == "no number"


def test_free_motion_takes_no_verdict_away(tmp_path):
    place = tmp_path / "history.db"
    tested = an_entry(3, 100.0, verdict="HEALTHY")
    with History(place, create=True) as history:
        history.append_all([tested, replace(tested, test=FREE_MOTION, verdict="NOT_TESTED")])
    with site(tmp_path, place, watch=None) as (port, _):
        fleet = request(port, "/")[1]
        unit = request(port, "/history/3")[1]
    assert "<h1>Fleet: 1 HEALTHY</h1>" in fleet
    assert "<svg" not in fleet  # there is one test
    assert '<h1 class="HEALTHY">Unit 3: HEALTHY</h1>' in unit
    assert ">FREE MOTION<" in unit
    assert "INCONCLUSIVE" not in unit


def test_only_reports_of_the_folder_are_served_and_as_strangers(tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "a&b.html").write_text("<p>mine</p>")
    (tmp_path / "secret.html").write_text("secret")
    (folder / "link.html").symlink_to(tmp_path / "secret.html")
    with site(folder, watch=None) as (port, _):
        _, listed, _ = request(port, "/reports")
        assert "a&amp;b.html" in listed
        assert "link.html" not in listed
        status, text, headers = request(port, "/reports/a%26b.html")
        assert (status, text) == (200, "<p>mine</p>")
        assert headers["Content-Security-Policy"].startswith("sandbox")
        for path in ("link.html", "..%2Fsecret.html", "../secret.html", "%2e%2e/secret.html", ""):
            assert request(port, f"/reports/{path}")[0] == 404


def test_a_damaged_history_is_said_and_the_rest_goes_on(tmp_path):
    place = tmp_path / "history.db"
    place.write_bytes(b"no database" * 100)
    with site(tmp_path, place, watch=None) as (port, _):
        status, text, _ = request(port, "/")
        assert status == 200
        assert "is no history" in text
        assert request(port, "/history/7")[0] == 503
        assert request(port, "/session")[0] == 200


def test_a_taken_port_is_said_in_one_line(tmp_path):
    with (
        site(tmp_path, watch=None) as (port, sessions),
        pytest.raises(ConfigurationError, match=f"--http-port {port}: .*name another"),
    ):
        serve(Site(lambda _: None, sessions, None), port)
