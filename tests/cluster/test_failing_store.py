"""Object stores that answer badly: what passes is tried again, what does not is a sentence."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from threading import Thread

import numpy as np
import pytest

from tests.cluster.object_server import BUCKET, disturbed, let_us_in, running_server
from usdbrdf.cluster import object_store
from usdbrdf.cluster.object_store import files_at
from usdbrdf.cluster.store import Store
from usdbrdf.errors import EnvironmentFailure, UsageError

ARRAY = np.arange(100_000.0)


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with running_server() as url:
        yield url


class Badly:
    """Answers so many times badly, then not at all any more."""

    def __init__(self, times: int, how: str) -> None:
        self.times, self.how, self.asked = times, how, 0

    def __call__(self, request: BaseHTTPRequestHandler, content: bytes) -> bool:
        self.asked += 1
        if self.asked > self.times:
            return False
        if self.how == "busy":
            request.send_error(503)
            return True
        half = len(content) // 2
        request.send_response(200)
        told = {"cut off": len(content), "short": half, "damaged": len(content)}[self.how]
        request.send_header("Content-Length", str(told))
        request.end_headers()
        request.wfile.write(content[:half])
        if self.how == "damaged":
            request.wfile.write(bytes(len(content) - half))
        return True


def _kept(server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[str, str]:
    """Where an array is, and what it is called there."""
    let_us_in(server, monkeypatch)
    address = f"s3://{BUCKET}/{tmp_path.name}"
    ours = Store(files_at(address, tmp_path / "ours"))
    name = ours.keep(ARRAY)
    ours.files.settle()
    return address, name


@pytest.mark.parametrize("how", ["busy", "cut off", "short", "damaged"])
def test_what_passes_is_tried_again(
    server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    address, name = _kept(server, tmp_path, monkeypatch)
    badly = Badly(2, how)
    with disturbed(server, badly) as between:
        let_us_in(between, monkeypatch)
        theirs = Store(files_at(address, tmp_path / "theirs"))
        np.testing.assert_array_equal(theirs.array(name), ARRAY)
    assert badly.asked > badly.times
    assert [*theirs.files.folder.iterdir()] == [theirs.files.folder / name]


@pytest.mark.parametrize("how", ["busy", "cut off", "short", "damaged"])
def test_what_does_not_pass_is_a_sentence_with_the_address(
    server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    address, name = _kept(server, tmp_path, monkeypatch)
    badly = Badly(1 << 30, how)
    if how == "busy":  # of which the library is told, and tries for long
        monkeypatch.setattr(object_store, "_LONGEST_TRY", 0.0)
    with disturbed(server, badly) as between:
        let_us_in(between, monkeypatch)
        theirs = Store(files_at(address, tmp_path / "theirs"))
        with pytest.raises(EnvironmentFailure) as found:
            theirs.array(name)
    assert str(found.value).startswith(f"{address}")
    assert str(found.value).endswith("[cluster.objects]")
    assert "\n" not in str(found.value)
    assert (3 if how == "busy" else 4) <= badly.asked <= 30
    assert not [*theirs.files.folder.iterdir()]


@pytest.fixture
def silent(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[socket.socket]]:
    """Who connected to a store that takes every request and never answers."""
    s3fs = pytest.importorskip("s3fs", reason="s3fs is not installed")
    s3fs.S3FileSystem.clear_instance_cache()
    taken: list[socket.socket] = []
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def take() -> None:
            with suppress(OSError):
                while True:
                    taken.append(listening.accept()[0])

        Thread(target=take, daemon=True).start()
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{listening.getsockname()[1]}")
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            monkeypatch.setenv(name, "test")
        monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        yield taken
        listening.shutdown(socket.SHUT_RDWR)
    for each in taken:
        each.close()


@pytest.mark.parametrize("what", ["upload", "download"])
def test_a_store_that_never_answers_is_asked_three_times(
    silent: list[socket.socket], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    from fsspec.config import conf

    # A user's own setting, by which this takes no minute; what it stands for without is below.
    monkeypatch.setitem(conf, "s3", {"config_kwargs": {"read_timeout": 0.2}})
    monkeypatch.setattr(object_store, "_LONGEST_TRY", 0.4)
    address = f"s3://{BUCKET}/prefix"
    store = Store(files_at(address, tmp_path / "ours"))

    def use() -> None:
        if what == "upload":
            store.keep(ARRAY)
            store.files.settle()
        else:
            store.array(f"{'0' * 64}.npy")

    begun = time.monotonic()
    with pytest.raises(EnvironmentFailure, match="the object store failed") as found:
        use()
    assert time.monotonic() - begun < 15
    assert len(silent) == 3
    assert str(found.value).startswith(address)
    assert "\n" not in str(found.value)
    assert not [*tmp_path.rglob("*.npy")]


def test_uploads_behind_one_that_failed_do_not_wait_for_the_store_again(
    silent: list[socket.socket], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor does this process at its end, for as often as the pool could be filled again."""
    from fsspec.config import conf

    monkeypatch.setitem(conf, "s3", {"config_kwargs": {"read_timeout": 0.2}})
    monkeypatch.setattr(object_store, "_LONGEST_TRY", 0.0)
    store = Store(files_at(f"s3://{BUCKET}/prefix", tmp_path / "ours"))

    def keep_many() -> None:
        for i in range(2 * object_store._WAITING):
            store.keep(ARRAY[i:])

    with pytest.raises(EnvironmentFailure, match="the object store failed"):
        keep_many()
    with pytest.raises(EnvironmentFailure, match="the object store failed"):
        store.files.settle()
    assert len(silent) == 3 * object_store._AT_ONCE


@pytest.mark.parametrize("known_by", ["s3", "s3a"])
def test_settings_of_a_user_count_by_either_name_of_the_store(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, known_by: str
) -> None:
    pytest.importorskip("s3fs", reason="s3fs is not installed")
    from fsspec.config import conf

    monkeypatch.setitem(conf, known_by, {"config_kwargs": {"read_timeout": 77}})
    for kind in ("s3", "s3a"):
        files = files_at(f"{kind}://{BUCKET}/prefix", tmp_path)
        assert isinstance(files, object_store.Objects)
        assert files._system.config_kwargs["read_timeout"] == 77
        assert files._system.config_kwargs["connect_timeout"] == 5


@pytest.mark.parametrize("own", ["{no JSON", [1]])
def test_settings_of_a_user_that_are_no_table_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own: object
) -> None:
    pytest.importorskip("s3fs", reason="s3fs is not installed")
    from fsspec.config import conf

    monkeypatch.setitem(conf, "s3", {"config_kwargs": own})
    with pytest.raises(UsageError, match=r"FSSPEC_S3_CONFIG_KWARGS.+\[cluster\.settings\]$"):
        files_at(f"s3://{BUCKET}/prefix", tmp_path)


@pytest.mark.parametrize("text", ["{no JSON", "[1]", "5", "[[]]", "null"])
def test_a_file_of_settings_that_is_no_table_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "conf.json").write_text(text)
    program = "from usdbrdf.cluster.object_store import refuse_unknown; refuse_unknown('s3://a')"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False,
        env={**os.environ, "FSSPEC_CONFIG_DIR": str(tmp_path)},
    )  # fmt: skip
    said = done.stderr.splitlines()[-1]
    assert said.startswith("usdbrdf.errors.UsageError: ")
    assert str(tmp_path) in said
    assert said.endswith("[cluster.settings]")


def test_a_store_that_never_answers_is_said_within_a_minute(tmp_path: Path) -> None:
    pytest.importorskip("s3fs", reason="s3fs is not installed")
    files = files_at(f"s3://{BUCKET}/prefix", tmp_path)
    assert isinstance(files, object_store.Objects)
    system, asked = files._system, files._system.config_kwargs
    tries = asked["retries"]["total_max_attempts"]
    between = sum(2.0**i for i in range(tries - 1))  # botocore's longest waits
    once = tries * (asked["connect_timeout"] + asked["read_timeout"]) + between
    assert system.retries * once <= 63
    # Two such waits are never put one after the other.
    assert tries * asked["read_timeout"] > object_store._LONGEST_TRY
