"""Serve reports to this machine only; corrections are written to tracks.csv as they are made.

Every request needs the secret token in its path and a Host header that names this machine; an
Origin header, if present, must name this server. A page from elsewhere cannot guess the token, and
a foreign domain name that resolves to this machine (DNS rebinding) fails the check of the Host.
"""

import json
import logging
import re
import secrets
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from socketserver import ThreadingTCPServer
from typing import Any, NamedTuple
from urllib.parse import unquote

from shapecat.errors import ConfigError, OutputError, explained
from shapecat.outputs.report.writing import INDEX, PAGE, Reports, RunReport
from shapecat.runs.folder import require_work
from shapecat.runs.labels.corrections import correct_label
from shapecat.runs.labels.track_table import read_track_table

__all__ = ["serve_reports"]

_HOST = "127.0.0.1"
_NAMES = frozenset({_HOST, "[::1]", "localhost"})
_LABELS = "labels"
"""Name of the resource beside a page that holds the labels of its run."""
_LARGEST_BODY = 1 << 16  # bytes
_PATIENCE_S = 30
"""Longest time without data from a browser before its connection is closed."""
_POLL_S = 0.05
"""Longest time until the server notices that it should stop."""
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}

_log = logging.getLogger(__name__)


class _Answer(NamedTuple):
    status: HTTPStatus
    content: str | dict[str, Any]

    @property
    def kind(self) -> str:
        """The media type of the content."""
        if not isinstance(self.content, str):
            return "application/json"
        return "text/html" if self.status is HTTPStatus.OK else "text/plain"


@dataclass(frozen=True)
class _Site:
    """The served content: pages by address, and the labels beside each report."""

    reports: Reports
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))

    @property
    def start(self) -> str:
        """The address of the start page."""
        return INDEX if self.reports.indexed else self.reports.link(self.reports.runs[0])

    def get(self, address: str) -> _Answer:
        """Return a page, or the labels of a run, with the current content of tracks.csv."""
        if self.reports.indexed and address == INDEX:
            return _Answer(HTTPStatus.OK, self.reports.index())
        report, name = self._find(address)
        if report is not None and name == PAGE:
            return _Answer(HTTPStatus.OK, report.page(served=True))
        if report is not None and name == _LABELS:
            require_work(report.folder, report.work)
            return _Answer(HTTPStatus.OK, {"labels": _labels(report)})
        return _Answer(HTTPStatus.NOT_FOUND, "no such page")

    def post(self, address: str, body: bytes) -> _Answer:
        """Write a label to tracks.csv; return all labels, and the reason if it was refused."""
        report, name = self._find(address)
        if report is None or name != _LABELS:
            return _Answer(HTTPStatus.NOT_FOUND, "no such page")
        correction = _correction(body)
        if correction is None:
            return _Answer(HTTPStatus.BAD_REQUEST, "expected track, label and seen")
        track, label, previous = correction
        problem = correct_label(report.folder, track, label, previous=previous, work=report.work)
        status = HTTPStatus.CONFLICT if problem else HTTPStatus.OK
        return _Answer(status, {"labels": _labels(report), "problem": problem})

    def _find(self, address: str) -> tuple[RunReport | None, str]:
        """Return the run whose folder contains ``address``, or None, and the resource's name."""
        place, _, name = address.rpartition("/")
        for report in self.reports.runs:
            if unquote(self.reports.link(report)) == f"{place}/{PAGE}".lstrip("/"):
                return report, name
        return None, name


def _labels(report: RunReport) -> dict[int, str]:
    return read_track_table(report.folder / "tracks.csv").labels


def _correction(body: bytes) -> tuple[int, str, str] | None:
    """Return track, label and the label that the page showed before; None if malformed."""
    try:
        correction = json.loads(body)
        track, label, previous = correction["track"], correction["label"], correction["seen"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    right = type(track) is int and isinstance(label, str) and isinstance(previous, str)
    return (track, " ".join(label.split()), previous) if right else None


def _names_this_machine(host: str) -> bool:
    """Return whether a host names this machine, with or without a port: browsers omit port 80."""
    return re.sub(r":\d+$", "", host) in _NAMES


class _Server(ThreadingTCPServer):
    """A server that, unlike `http.server.HTTPServer`, does not look up its own name."""

    allow_reuse_address = True
    daemon_threads = True
    site: _Site

    def handle_error(self, request: Any, client_address: Any) -> None:  # noqa: ARG002  given
        """Log a failed request, for example if the browser closed the connection."""
        _log.warning("a request failed", exc_info=True)


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = _PATIENCE_S
    server_version = "shapecat"
    sys_version = ""

    def do_GET(self) -> None:
        """Send a page or labels."""
        self._serve(b"")

    def do_POST(self) -> None:
        """Accept a correction."""
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > _LARGEST_BODY:
            self._send(_Answer(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "request too long"))
            return
        self._serve(self.rfile.read(int(length)))

    def _serve(self, body: bytes) -> None:
        site = self.server.site
        path, _, _ = self.path.partition("?")
        token, _, address = path.removeprefix("/").partition("/")
        authorized = secrets.compare_digest(token.encode(), site.token.encode())
        if not (authorized and self._from_here()):
            self._send(_Answer(HTTPStatus.FORBIDDEN, "use the address that shapecat printed"))
            return
        try:
            post, address = self.command == "POST", unquote(address)
            self._send(site.post(address, body) if post else site.get(address))
        except OutputError as error:
            self._send(_Answer(HTTPStatus.INTERNAL_SERVER_ERROR, str(error)))

    def _from_here(self) -> bool:
        """Return whether a request names this machine and does not come from a foreign page."""
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin")
        return _names_this_machine(host) and origin in {None, f"http://{host}"}

    def _send(self, answer: _Answer) -> None:
        text = answer.content if isinstance(answer.content, str) else json.dumps(answer.content)
        content = text.encode()
        self.send_response(answer.status)
        self.send_header("Content-Type", f"{answer.kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(content)))
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002  the name is given
        """Log a message without the token."""
        _log.info("%s", (format % args).replace(self.server.site.token, "…"))


@contextmanager
def serve_reports(reports: Reports, *, port: int = 0) -> Iterator[str]:
    """Serve reports on the loopback address during the block.

    Parameters
    ----------
    port : 0 to choose a free port.

    Yields
    ------
    The URL of the start page. It holds the secret token that every request needs.

    Raises
    ------
    ConfigError : the port is in use or not permitted.
    """
    with explained(f"--port {port}", ConfigError):
        server = _Server((_HOST, port), _Handler)
    server.site = _Site(reports)
    thread = threading.Thread(target=server.serve_forever, args=(_POLL_S,), daemon=True)
    thread.start()
    try:
        yield f"http://{_HOST}:{server.server_address[1]}/{server.site.token}/{server.site.start}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
