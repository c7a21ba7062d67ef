"""A local S3 server for tests, which is a process of its own."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

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
