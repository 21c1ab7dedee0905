"""Requests that no page sends: each gets an answer."""

from __future__ import annotations

import http.client
import threading

import pytest

from ehadiag.assess.verdict import Levels
from ehadiag.serve.pages import Pages
from ehadiag.serve.server import LOOPBACK_ADDRESS, SessionRunner, Site, serve

TOKEN = "right"


@pytest.fixture
def port(tmp_path):
    with SessionRunner(None, {}) as sessions:
        server = serve(Site(Pages(tmp_path, None, Levels(), ()), sessions, TOKEN), 0)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server.server_port
        server.shutdown()
        server.server_close()


@pytest.mark.parametrize(
    ("length", "body"),
    [
        ("9" * 5000, b""),
        ("1" * 10, b""),
        ("²", b""),
        ("-1", b""),
        (None, b"[" * 1000),
        (None, b'{"a":' * 200),
        (None, b"9" * 1000 + b"x"),
        (None, b"\xff\xfe"),
    ],
)
def test_a_length_or_a_body_that_cannot_be_is_answered_by_400(port, length, body):
    connection = http.client.HTTPConnection(LOOPBACK_ADDRESS, port, timeout=120)
    connection.putrequest("POST", "/start")
    connection.putheader("X-Ehadiag-Token", TOKEN)
    connection.putheader("Content-Length", (length or str(len(body))).encode())
    connection.endheaders(body)
    answer = connection.getresponse()
    assert (answer.status, answer.getheader("Content-Type")) == (400, "application/json")
    assert answer.read().startswith(b'{"error": "the request ')


def test_a_number_of_a_thousand_digits_starts_nothing(port):
    connection = http.client.HTTPConnection(LOOPBACK_ADDRESS, port, timeout=120)
    connection.request("POST", "/start", b"9" * 1000, {"X-Ehadiag-Token": TOKEN})
    assert connection.getresponse().status == 404
