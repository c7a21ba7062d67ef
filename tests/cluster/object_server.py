"""A local S3 server for tests, which is a process of its own."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest

BUCKET = "scans"


@contextmanager
def running_server() -> Iterator[str]:
    """Its URL."""
    for module in ("s3fs", "moto", "flask"):
        pytest.importorskip(module, reason="s3fs or moto[server] is not installed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    nowhere = subprocess.DEVNULL
    server = subprocess.Popen(command, stdout=nowhere, stderr=nowhere)
    try:
        for _ in range(600):
            with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
                break
            assert server.poll() is None
            time.sleep(0.1)
        yield f"http://127.0.0.1:{port}"
    finally:
        server.kill()
        server.wait()


def let_us_in(url: str, environment: pytest.MonkeyPatch) -> None:
    """What this process and its children need to talk to the server, and its one bucket."""
    from s3fs import S3FileSystem

    environment.setenv("AWS_ENDPOINT_URL", url)
    environment.setenv("AWS_ACCESS_KEY_ID", "test")
    environment.setenv("AWS_SECRET_ACCESS_KEY", "test")
    environment.setenv("AWS_DEFAULT_REGION", "us-east-1")
    environment.setenv("AWS_EC2_METADATA_DISABLED", "true")
    S3FileSystem.clear_instance_cache()
    system = S3FileSystem(use_listings_cache=False)
    if not system.exists(BUCKET):
        system.mkdir(BUCKET)


def objects(url: str = f"s3://{BUCKET}") -> list[str]:
    """What is there, below the bucket."""
    from fsspec.core import url_to_fs

    system, prefix = url_to_fs(url, use_listings_cache=False)
    return [found.removeprefix(f"{prefix}/") for found in system.find(prefix)]


@contextmanager
def disturbed(url: str, disturb: Callable[[BaseHTTPRequestHandler, bytes], bool]) -> Iterator[str]:
    """The URL of one that hands requests on to the server at ``url``, and its answers back, but for
    the GETs of objects that ``disturb``, which is given the object, answers itself."""

    class Between(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *_: object) -> None:
            """Silent."""

        def _hand_on(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
            asked = Request(f"{url}{self.path}", body or None, method=self.command)
            for name, value in self.headers.items():
                if name.lower() not in ("host", "connection", "accept-encoding"):
                    asked.add_header(name, value)
            try:
                answer = urlopen(asked)
            except HTTPError as error:
                answer = error
            with answer:
                told, content = answer.headers, answer.read()
                is_object = self.command == "GET" and self.path.count("/") > 2
                if is_object and answer.status in (200, 206) and disturb(self, content):
                    self.close_connection = True
                    return
                self.send_response(answer.status)
                for name, value in told.items():
                    if name.lower() not in ("connection", "transfer-encoding", "content-length"):
                        self.send_header(name, value)
                length = told["Content-Length"] if self.command == "HEAD" else len(content)
                self.send_header("Content-Length", str(length))
                self.end_headers()
                self.wfile.write(content)

        do_GET = do_PUT = do_POST = do_HEAD = do_DELETE = _hand_on

    server = ThreadingHTTPServer(("127.0.0.1", 0), Between)
    Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()
