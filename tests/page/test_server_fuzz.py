"""Whatever is said to the page's server, it answers, and with nothing but its page: requests and
verdicts are drawn by Hypothesis, always the same ones."""

from __future__ import annotations

import json
import re
import socket
import threading
from types import SimpleNamespace
from urllib.parse import urlsplit

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.synthetic_asset import build, make_scan
from usdbrdf.asset.review import read_review, review_file
from usdbrdf.page.server import PageServer

PAGE = b"<p>what the page shows</p>"
CHAIR, WALL = "/room/geo/Stuhl_No_1/Stuhl_No_1", "/room/geo/wall/wall"
# "own", "token" and "ASSET" stand for the server's address, token and asset, which nobody can draw;
# "LONG" for more than a line may be.
PIECES = (
    *("/", "//", "\\", ".", "..", "%2e%2e", "%2E%2e%2f", "..%5c", "%252e", "\0", "%00", "\x7f"),
    *("/token/", "token", "/token/review", "review", "?", "#", "?x=1", ";", "*", " ", "\t", "\r"),
    *("/etc/passwd", "/proc/self/environ", "file:///etc/passwd", "http://own", "http://own/token/"),
    *("room.usda", "layers/scan.usdc", "ASSET", "é", "LONG", "../" * 300),
)
METHODS = (
    "GET",
    "POST",
    "HEAD",
    "PUT",
    "DELETE",
    "OPTIONS",
    "TRACE",
    "CONNECT",
    "get",
    "_take",
    "",
)
VERSIONS = ("HTTP/1.1", "HTTP/1.0", "HTTP/0.9", "HTTP/2.0", "HTTP/1.1.1", "HTTP/", "x", "")
HEADERS = (
    *("Host: own", "Host: own", "Host: evil.example", "Host: localhost", "Host:", "Host: own, own"),
    *("Host: OWN@evil", "X-Forwarded-Host: own", "Origin: http://own", "Origin: null"),
    *("Content-Type: application/json", "Content-Type: text/plain", "Content-Length: 2"),
    *("Content-Length: -1", "Content-Length: 9999999999", "Content-Length: 3, 2", "Expect: 100-a"),
    *("Transfer-Encoding: chunked", "Connection: keep-alive", "Upgrade: websocket", ": none"),
    *("no colon", " folded", "Cookie: LONG", "Range: bytes=0-1", "Hôst: own"),
)
BODIES = st.sampled_from(("", "{}", "[", "LONG"))
ANY = st.tuples(
    st.sampled_from(METHODS) | st.text(max_size=8),
    st.lists(st.sampled_from(PIECES) | st.text(max_size=4), max_size=5).map("".join),
    st.sampled_from(VERSIONS),
    st.lists(st.sampled_from(HEADERS), max_size=5),
    BODIES,
)
NEARLY_RIGHT = st.tuples(
    st.sampled_from(("GET", "POST")),
    st.sampled_from(("/token/", "/token/", "/token/review", "/token/review", "/token/../token/")),
    st.sampled_from(VERSIONS[:4]),
    st.tuples(
        st.sampled_from(("Host: own", "Host: own", "Host: own", "Host: evil.example")),
        st.sampled_from(("Content-Type: application/json", "Content-Type: text/plain")),
        st.sampled_from(("Content-Length: 2", "Content-Length: 1", "Content-Length: 70001")),
        st.sampled_from(HEADERS),
    ),
    BODIES,
)


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    top = tmp_path_factory.mktemp("served")
    asset = build(top / "room", make_scan(top / "capture")).asset
    server = PageServer(asset, lambda review: PAGE.decode())
    thread = threading.Thread(target=server.serve)
    thread.start()
    place = urlsplit(server.address)
    token = place.path.strip("/")
    yield SimpleNamespace(asset=asset, own=place.netloc, port=place.port, token=token)
    server.close()
    thread.join()


def answered(served, request):
    """All that is answered to bytes, by a server that may close before it has read them."""
    answer = b""
    with socket.create_connection(("127.0.0.1", served.port), timeout=60) as connection:
        try:
            connection.sendall(request)
            connection.shutdown(socket.SHUT_WR)
            while part := connection.recv(1 << 16):
                answer += part
        except OSError:  # it hung up over what it did not want to read
            pass
    return answer


def files_of(asset):
    return {file: file.stat().st_mtime_ns for file in asset.folder.rglob("*") if file.is_file()}


def test_no_request_gets_anything_but_the_page_or_breaks_the_server(served, capsys):
    before, statuses = files_of(served.asset), set()

    def filled(text):
        for word, value in (
            ("own", served.own), ("token", served.token),
            ("ASSET", str(served.asset.root_layer)), ("LONG", "a" * 70_000),
        ):  # fmt: skip
            text = text.replace(word, value)
        return text

    @settings(max_examples=250, deadline=None, derandomize=True, database=None)
    @given(ANY | NEARLY_RIGHT)
    def ask(request):
        method, path, version, headers, body = request
        lines = [" ".join((method, path, version)).strip(), *headers, "", body]
        sent = filled("\r\n".join(lines)).encode("utf-8", "surrogatepass")
        answer = answered(served, sent)
        status = re.match(rb"HTTP/1\.0 ([0-9]{3}) ", answer)
        statuses.add(int(status[1]) if status else 0)
        # Not implemented, and no such version, are no errors of its own.
        assert status is None or int(status[1]) < 500 or int(status[1]) in (501, 505), sent[:200]
        if PAGE in answer:
            words = sent.split(b"\r\n")[0].split()
            assert words[0] == b"GET"
            assert b"/" + words[1].lstrip(b"/") == f"/{served.token}/".encode()
            hosts = [line for line in sent.split(b"\r\n") if line.startswith(b"Host:")]
            assert hosts[0] == f"Host: {served.own}".encode()
        else:
            for other in (b"root:", b"#usda", b"PXR-USDC", b"PATH="):
                assert other not in answer, sent[:200]

    ask()
    # It has been most of its ways, and is there for who may ask. Where it hangs up over what it
    # has not read its answer may be lost, with a status that is none of these.
    assert {200, 400, 403, 404, 501} <= statuses
    page = f"GET /{served.token}/ HTTP/1.1\r\nHost: {served.own}\r\n\r\n"
    assert answered(served, page.encode()).endswith(PAGE)
    left = {file for file in files_of(served.asset) if file != review_file(served.asset)}
    assert {file: before[file] for file in left} == before
    assert capsys.readouterr().err == ""


TEXTS = st.text(max_size=8) | st.sampled_from(
    ["accept", "reject", "metal", "not-lamp", "\0", "\ud800", '"""', "\\", "@", "x" * 3_000]
)
NUMBERS = st.integers() | st.floats() | st.sampled_from([10**400, 1e-320])
JSON = st.recursive(
    st.none() | st.booleans() | NUMBERS | TEXTS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXTS, inner, max_size=3),
    max_leaves=6,
)
SAID = st.dictionaries(
    st.sampled_from(["verdict", "comment", "directive", "status", "phi", "psi"]) | TEXTS,
    TEXTS | NUMBERS | JSON,
    max_size=5,
)
REVIEWS = JSON | st.dictionaries(
    st.sampled_from([CHAIR, WALL, "", "/", "/room", ".."]) | TEXTS, SAID | JSON, max_size=3
)


def test_no_verdicts_break_the_server_or_the_layer_that_they_go_into(served, capsys):
    statuses = []

    @settings(max_examples=60, deadline=None, derandomize=True, database=None)
    @given(REVIEWS)
    def say(review):
        body = json.dumps(review)
        head = (
            f"POST /{served.token}/review HTTP/1.1\r\nHost: {served.own}\r\n"
            f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
        )
        answer = answered(served, (head + body).encode())
        statuses.append(answer[9:12])
        assert statuses[-1] in (b"200", b"400"), body
        if review_file(served.asset).exists():
            assert set(read_review(served.asset)) <= {CHAIR, WALL}

    say()
    assert {b"200", b"400"} <= set(statuses)
    assert capsys.readouterr().err == ""
