"""Serves the local web page: loopback only, a token for starting and aborting tests.

Snapshots are server-sent events; the sessions run in processes of their own (`sessions`).
"""

from __future__ import annotations

import contextlib
import hmac
import json
import socket
import threading
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import unquote, urlsplit

import msgspec

from ehadiag.serve.sessions import NO_SNAPSHOT, BusyError, SessionRunner
from firmware_iface.errors import ConfigurationError, EhadiagError, reason_of

LOOPBACK_ADDRESS = "127.0.0.1"
LOOPBACK_NAMES = (LOOPBACK_ADDRESS, "localhost")
MAX_LIVE_STREAMS = 16
"""Number of readers of the live view at a time."""
MAX_REQUEST_BYTES = 1024
"""Size of the largest request to start or abort a test, bytes."""
HTML_CONTENT_TYPE = "text/html; charset=utf-8"
JSON_CONTENT_TYPE = "application/json"


class Page(msgspec.Struct, frozen=True):
    """What a request gets."""

    body: bytes
    kind: str = HTML_CONTENT_TYPE
    policy: str = "default-src 'none'"
    """Its Content-Security-Policy."""


class Site(msgspec.Struct, frozen=True):
    """What is served.

    pages: gives the page of a path such as `/history/7`; None: there is none; sessions: whose
    snapshots are shown; token: that a request to start or abort a test must carry; None: no test is
    ever started here.
    """

    pages: Callable[[str], Page | None]
    sessions: SessionRunner
    token: str | None


def serve(site: Site, port: int) -> ThreadingHTTPServer:
    """Bind to the loopback address; the caller runs `serve_forever` and closes.

    site: what is served; port: 0: any that is free. Returns the bound server; its `server_port` is
    the port. ConfigurationError: the port is taken, or may not be used.
    """

    class Handler(_Handler):
        pass

    Handler.site = site
    Handler.streams = threading.BoundedSemaphore(MAX_LIVE_STREAMS)
    try:
        server = _Server((LOOPBACK_ADDRESS, port), Handler)
    except OSError as error:
        raise ConfigurationError(
            f"--http-port {port}: {reason_of(error)}: name another, or 0 for any"
        ) from None
    Handler.port = server.server_port
    return server


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore a reader that went away."""


class _Handler(BaseHTTPRequestHandler):
    site: Site
    streams: threading.BoundedSemaphore
    port: int
    timeout = 30.0
    server_version = "ehadiag"
    sys_version = ""

    def do_GET(self) -> None:
        """Send a page, or the stream of snapshots."""
        if not self._is_ours():
            return
        path = unquote(urlsplit(self.path).path, errors="surrogateescape")
        if path == "/live":
            self._stream()
            return
        try:
            page = self.site.pages(path)
        except EhadiagError as error:
            self._refuse(HTTPStatus.SERVICE_UNAVAILABLE, str(error))
            return
        if page is None:
            self._refuse(HTTPStatus.NOT_FOUND, "no such page")
            return
        self._send(HTTPStatus.OK, page)

    def do_POST(self) -> None:
        """Start or abort a test, where that is allowed and the token is right."""
        if not self._is_ours():
            return
        try:
            request = self._body()
        except ValueError as error:
            self._refuse(HTTPStatus.BAD_REQUEST, str(error))
        else:
            self._act(request)

    def _act(self, request: Any) -> None:
        if self.site.token is None:
            self._refuse(HTTPStatus.FORBIDDEN, "tests are not allowed here: see --allow-tests")
            return
        token = self.headers.get("X-Ehadiag-Token", "")
        if not hmac.compare_digest(token.encode(), self.site.token.encode()):
            self._refuse(HTTPStatus.FORBIDDEN, "wrong token: use the address that serve printed")
            return
        try:
            if self.path == "/start" and isinstance(request, dict):
                severities = _severities_in(request)
                self.site.sessions.start(str(request.get("test")), severities)
            elif self.path == "/abort":
                self.site.sessions.abort()
            else:
                self._refuse(HTTPStatus.NOT_FOUND, "no such action")
                return
        except ValueError as error:
            self._refuse(HTTPStatus.BAD_REQUEST, str(error))
            return
        except KeyError:
            self._refuse(HTTPStatus.NOT_FOUND, "no such test here: see --test")
            return
        except BusyError as error:
            self._refuse(HTTPStatus.CONFLICT, str(error))
            return
        self._send(HTTPStatus.ACCEPTED, Page(b"{}", JSON_CONTENT_TYPE))

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing: the terminal is for the sessions."""

    def _body(self) -> Any:
        """Return the request's JSON; ValueError where it is none, or larger than any request."""
        length = self.headers.get("Content-Length", "0")
        # Python refuses to convert thousands of digits.
        sound = length.isdecimal() and len(length) <= len(str(MAX_REQUEST_BYTES))
        if not sound or int(length) > MAX_REQUEST_BYTES:
            self.close_connection = True
            raise ValueError(f"the request has more than {MAX_REQUEST_BYTES} bytes")
        try:
            return json.loads(self.rfile.read(int(length)) or b"null")
        except (ValueError, RecursionError):
            raise ValueError("the request is not JSON") from None

    def _is_ours(self) -> bool:
        """Refuse what another site's page sends by this browser, under whatever name."""
        hosts = [f"{name}:{self.port}" for name in LOOPBACK_NAMES]
        origin = self.headers.get("Origin")
        good = self.headers.get("Host") in hosts
        if good and (origin is None or origin in [f"http://{host}" for host in hosts]):
            return True
        self._refuse(HTTPStatus.FORBIDDEN, "this page is for this machine only")
        return False

    def _stream(self) -> None:
        if not self.streams.acquire(blocking=False):
            self._refuse(HTTPStatus.SERVICE_UNAVAILABLE, f"{MAX_LIVE_STREAMS} readers are there")
            return
        try:
            self.send_response(HTTPStatus.OK)
            self._head("text/event-stream", "default-src 'none'")
            self.end_headers()
            self.close_connection = True
            self._send_news()
        finally:
            self.streams.release()

    def _send_news(self) -> None:
        seen, sessions = 0, self.site.sessions
        with contextlib.suppress(OSError):
            self.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            while not sessions.ended:
                news = sessions.wait(seen, 10.0)
                if news is None:
                    self.wfile.write(b": still here\n\n")
                else:
                    seen = news.number
                    state = {
                        "running": news.running,
                        "said": news.lines,
                        "starting": news.snapshot == NO_SNAPSHOT,
                    }
                    self.wfile.write(
                        b"event: snapshot\ndata: " + news.snapshot + b"\n\nevent: state\ndata: "
                        + json.dumps(state).encode() + b"\n\n"
                    )  # fmt: skip

    def _refuse(self, status: HTTPStatus, why: str) -> None:
        self._send(status, Page(json.dumps({"error": why}).encode(), JSON_CONTENT_TYPE))

    def _send(self, status: HTTPStatus, page: Page) -> None:
        self.send_response(status)
        self._head(page.kind, page.policy)
        self.send_header("Content-Length", str(len(page.body)))
        self.end_headers()
        with contextlib.suppress(OSError):
            self.wfile.write(page.body)

    def _head(self, kind: str, policy: str) -> None:
        for name, value in (
            ("Content-Type", kind),
            ("Content-Security-Policy", policy),
            ("X-Content-Type-Options", "nosniff"),
            ("Referrer-Policy", "no-referrer"),
            ("Cache-Control", "no-store"),
        ):
            self.send_header(name, value)


def _severities_in(request: dict[str, Any]) -> dict[str, float]:
    """Return the severities that the simulated unit is to have; ValueError where they are none."""
    found = request.get("severities", {})
    good = isinstance(found, dict) and all(
        isinstance(value, int | float) and 0.0 <= value <= 1.0 for value in found.values()
    )
    if not good:
        raise ValueError("severities: need numbers from 0 to 1 by the names of the faults")
    return {str(name): float(value) for name, value in found.items()}
