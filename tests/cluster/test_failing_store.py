"""Object stores that answer badly: what passes is tried again, what does not is a sentence."""

from __future__ import annotations

from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler
from pathlib import Path

import numpy as np
import pytest

from tests.cluster.object_server import BUCKET, disturbed, let_us_in, running_server
from usdbrdf.cluster import object_store
from usdbrdf.cluster.object_store import files_at
from usdbrdf.cluster.store import Store
from usdbrdf.errors import EnvironmentFailure

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
        monkeypatch.setattr(object_store, "_LONGEST_READ", 0.0)
    with disturbed(server, badly) as between:
        let_us_in(between, monkeypatch)
        theirs = Store(files_at(address, tmp_path / "theirs"))
        with pytest.raises(EnvironmentFailure) as found:
            theirs.array(name)
    assert str(found.value).startswith(f"{address}")
    assert str(found.value).endswith("[cluster.objects]")
    assert "\n" not in str(found.value)
    assert 4 <= badly.asked <= 30
    assert not [*theirs.files.folder.iterdir()]
