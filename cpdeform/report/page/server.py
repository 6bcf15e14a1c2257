"""The page of a run while it goes on: a server on this machine alone, which reads the record again when it has changed."""

from __future__ import annotations

import http.server
import json
import threading
import urllib.parse
from pathlib import Path
from typing import Any, ClassVar

from cpdeform.core.errors import CpdeformError, InputError
from cpdeform.report.page.content import Page, make_page
from cpdeform.report.page.figures import recorded_rows
from cpdeform.report.page.html import live_page
from cpdeform.run.record import load_record
from cpdeform.run.record_files import METRICS_FILE, RUN_FILE, stage_files

HOST = "127.0.0.1"
"""Nobody but this machine is answered."""

NAMES = ("127.0.0.1", "localhost")
"""Names under which a browser may ask: a page of another site that makes its own name lead here is turned away."""


class LiveRun:
    """A record that is read again when its files have changed.

    Args:
        directory: The record, which may not be there yet.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._lock = threading.Lock()
        self._stamp: object = None
        self._page: Page | None = None
        self._packed: dict[tuple[str, str], bytes] = {}

    def page(self) -> Page:
        """What the page shows now.

        Raises:
            InputError: There is no record yet, or it cannot be read.
        """
        with self._lock:
            stamp = self._files()
            if self._page is None or stamp != self._stamp:
                record = load_record(self.directory)
                self._page, self._stamp = make_page(record, figures=recorded_rows(record.run)), stamp
            return self._page

    def array(self, name: str) -> bytes | None:
        """An array of the page, packed; None where it has none of that name."""
        page = self.page()
        make = page.arrays.get(name)
        if make is None:
            return None
        # An array of that name stays as it is, until another run takes the directory: its record begins at another time.
        key = (name, str(page.content["recorded"]))
        with self._lock:
            if key not in self._packed:
                self._packed[key] = make()
            return self._packed[key]

    def _files(self) -> object:
        try:
            paths = [self.directory / RUN_FILE, self.directory / METRICS_FILE, *stage_files(self.directory)]
            return tuple((path.name, path.stat().st_mtime_ns, path.stat().st_size) for path in paths)
        except OSError as error:
            expected = "a directory that a run is written to"
            raise InputError(f"run record {self.directory}", came=error.strerror or str(error), expected=expected) from error


class _Handler(http.server.BaseHTTPRequestHandler):
    """Answers GET of the page, its content and its arrays; nothing else, and nobody else."""

    run: ClassVar[LiveRun]
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        """Answer."""
        if self.headers.get("Host", "").rsplit(":", 1)[0] not in NAMES:
            return self._send(403, b"this page is for this machine alone", "text/plain; charset=utf-8")
        path = urllib.parse.unquote(urllib.parse.urlsplit(self.path).path)
        try:
            if path == "/":
                return self._send(200, live_page(self.run.directory.name).encode(), "text/html; charset=utf-8")
            if path == "/content.json":
                text = json.dumps(self.run.page().content, allow_nan=False)
                return self._send(200, text.encode(), "application/json")
            if path.startswith("/arrays/"):
                data = self.run.array(path.removeprefix("/arrays/"))
                if data is not None:
                    return self._send(200, data, "application/octet-stream")
        except CpdeformError as error:
            return self._send(503, str(error).encode(), "text/plain; charset=utf-8")
        return self._send(404, b"there is nothing of that name", "text/plain; charset=utf-8")

    def _send(self, status: int, data: bytes, kind: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *arguments: Any) -> None:
        """Say nothing: a line for each request would hide what matters."""


class PageServer(http.server.ThreadingHTTPServer):
    """Serves the page of a run on this machine alone.

    Args:
        directory: The record; it may come into being later.
        port: Port; 0 for any free one.

    Raises:
        InputError: The port is taken or is none.
    """

    daemon_threads = True

    def __init__(self, directory: Path | str, *, port: int = 0) -> None:
        handler = type("Handler", (_Handler,), {"run": LiveRun(Path(directory))})
        try:
            super().__init__((HOST, port), handler)
        except (OSError, OverflowError) as error:
            came, expected = f"{port} ({error})", "a free port, or 0 for any"
            raise InputError("port", came=came, expected=expected, remedy="Leave it out, or choose another.") from error

    @property
    def address(self) -> str:
        """The address to open in a browser."""
        return f"http://{HOST}:{self.server_port}/"
