"""The page of an asset at an address of this machine alone, which also takes verdicts.

Whoever asks must know a random token; nothing of the file system is served: there is the page, and
what people say of the objects. Addresses of other machines, and pages of other addresses that a
browser has open, are refused."""

from __future__ import annotations

import json
import re
import secrets
import socket
import sys
import threading
import time
import webbrowser
from collections.abc import Callable
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from usdbrdf.asset.layout import Asset
from usdbrdf.asset.review import judgements_of, write_review
from usdbrdf.errors import EnvironmentFailure, UsdBrdfError
from usdbrdf.job.ownership import reading, writing_alone
from usdbrdf.job.progress import say
from usdbrdf.options import ReportOptions
from usdbrdf.page.report import page, page_data, reviewed

_HOST = "127.0.0.1"
_LARGEST_REVIEW = 4 << 20  # bytes
_BLOCK = 1 << 16
_LENGTH = re.compile("[0-9]{1,7}")  # of a review
# Of what is not taken so many bytes are read all the same, for so many seconds: a connection that
# is closed over unread ones is reset, and the answer with it.
_READ_AWAY, _LINGER = 64 << 20, 5.0
_PAUSE = 0.2  # seconds until the next try where no more connections can be had


class _Server(ThreadingHTTPServer):
    """own: the address of its pages; at_page and at_review: the two paths that are answered."""

    daemon_threads = True

    def __init__(self, asset: Asset, document: Callable[[str], str], port: int) -> None:
        token = secrets.token_urlsafe(24)
        self.at_page, self.at_review = f"/{token}/", f"/{token}/review"
        self.asset, self.document, self.writing = asset, document, threading.Lock()
        super().__init__((_HOST, port), _Handler)
        self.own = f"http://{_HOST}:{self.server_port}"

    def get_request(self) -> Any:
        try:
            return super().get_request()
        except OSError:  # too many are open: who waits would be asked for again at once
            time.sleep(_PAUSE)
            raise

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exc_info()[1], ConnectionError):  # who has gone misses nothing
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    """Answers one connection after another of what the server has to give."""

    server: _Server
    server_version, sys_version = "usdbrdf", ""
    timeout = 60
    unread = False  # whether something of a request may not have been read

    def do_GET(self) -> None:
        if self._refused(self.server.at_page):
            return
        try:
            with self.server.writing:
                page = self.server.document(self.server.at_review)
        except UsdBrdfError as error:
            self._answer(500, str(error).encode("utf-8"))
        else:
            self._answer(200, page.encode("utf-8"), "text/html; charset=utf-8")

    def do_POST(self) -> None:
        self.unread = True
        if self._refused(self.server.at_review):
            return
        origin = self.headers.get("Origin")
        length = self.headers.get("Content-Length", "")
        plain = self.headers.get("Content-Type", "") != "application/json"
        if plain or origin not in (None, self.server.own):
            self._answer(403, b"not from this page")
        elif not _LENGTH.fullmatch(length) or int(length) > _LARGEST_REVIEW:
            self._answer(413, b"too long")
        elif len(content := self.rfile.read(int(length))) < int(length):
            self._answer(400, b"cut off")
        else:
            self.unread = False
            self._take(content)

    def finish(self) -> None:
        with suppress(OSError):
            if self.unread:
                self.wfile.flush()
                self.connection.shutdown(socket.SHUT_WR)
                self._read_away()
        super().finish()

    def _read_away(self) -> None:
        end, left = time.monotonic() + _LINGER, _READ_AWAY
        while left > 0 and (seconds := end - time.monotonic()) > 0:
            self.connection.settimeout(seconds)
            if not (read := len(self.rfile.read1(_BLOCK))):
                return
            left -= read

    def _take(self, content: bytes) -> None:
        asset = self.server.asset
        try:
            # Others may serve it too, and what they save meanwhile would be lost.
            with self.server.writing, writing_alone(asset.folder):
                write_review(asset, judgements_of(asset, json.loads(content)))
        except (ValueError, RecursionError):
            self._answer(400, b"no JSON")
        except UsdBrdfError as error:
            # What it repeats may be a half of a pair, as JSON can have it.
            self._answer(400, str(error).encode("utf-8", "backslashreplace"))
        else:
            self._answer(200, b"saved")

    def _refused(self, path: str) -> bool:
        # Another name for this machine is how a foreign page would come in.
        known = self.headers.get("Host") == self.server.own.removeprefix("http://")
        if known and secrets.compare_digest(self.path.encode(), path.encode()):
            return False
        self._answer(404, b"nothing here")
        return True

    def _answer(self, status: int, content: bytes, kind: str = "text/plain") -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:
        """Nothing: addresses hold the token."""


class PageServer:
    """Serves until it is closed; ``address`` is where, with the token."""

    def __init__(self, asset: Asset, document: Callable[[str], str], port: int = 0) -> None:
        try:
            self._server = _Server(asset, document, port)
        except OSError as error:
            raise EnvironmentFailure(
                f"{_HOST}:{port}: this address cannot be used ({error.strerror}). Choose another "
                "with --port. [view.port]"
            ) from error
        self.address = self._server.own + self._server.at_page

    def serve(self) -> None:
        """Until ``close``, or an interrupt; then the address is free again."""
        try:
            self._server.serve_forever(poll_interval=0.2)
        finally:
            self._server.server_close()

    def release(self) -> None:
        """The address, where nothing was served."""
        self._server.server_close()

    def close(self) -> None:
        """Stop, from another thread than the one that serves."""
        self._server.shutdown()


def view(
    folder: str | Path,
    options: ReportOptions | None = None,
    *,
    port: int = 0,
    browser: bool = True,
    wait_s: float = 0.0,
) -> None:
    """Make the page of an asset and serve it on this machine until interrupted.

    port     0: any that is free
    browser  whether to open it
    wait_s   how long to wait for a run in the folder before FolderBusy
    """
    asset = Asset.made(Path(folder))
    data: dict[str, Any] = {}

    def document(review: str) -> str:
        # Verdicts may have been saved since.
        return page({**data, **reviewed(asset)}, served=review)

    # First, for the address may be taken, and the page takes long; until it is served who asks
    # waits.
    server = PageServer(asset, document, port)
    try:
        with reading(asset.folder, wait_s=wait_s):
            data |= page_data(asset, options or ReportOptions())
    except BaseException:
        server.release()
        raise
    say(f"{server.address}: open until you interrupt (Ctrl-C)")
    if browser:
        webbrowser.open(server.address)
    with suppress(KeyboardInterrupt):  # which is how it ends
        server.serve()
