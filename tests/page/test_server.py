"""The page's server answers who knows the token, from this machine's own page, and nothing else."""

from __future__ import annotations

import http.client
import json
import socket
import struct
import threading
import time
from urllib.parse import urlsplit

import pytest

from usdbrdf.asset.review import read_review, review_file
from usdbrdf.cli import main
from usdbrdf.errors import EnvironmentFailure, InputRefused
from usdbrdf.page import server as server_module
from usdbrdf.page.server import PageServer, view

CHAIR, WALL = "/room/geo/Stuhl_No_1/Stuhl_No_1", "/room/geo/wall/wall"


@pytest.fixture
def server(built):
    server = PageServer(built.asset, lambda review: f"<p>{review}</p>")
    thread = threading.Thread(target=server.serve)
    thread.start()
    yield server
    server.close()
    thread.join()


def asked(server, method, path, body=None, **headers):
    place = urlsplit(server.address)
    assert place.hostname == "127.0.0.1"
    connection = http.client.HTTPConnection(place.hostname, place.port, timeout=200)
    try:
        connection.request(method, path, body, headers)
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def test_the_page_is_at_its_address_alone(server, built):
    path = urlsplit(server.address).path
    status, content = asked(server, "GET", path)
    assert status == 200
    assert f"{path}review".encode() in content
    root = built.asset.root_layer.name
    for other in (
        "/", "/review", path[:-2] + "/", f"{path}review", f"{path}{root}", f"{path}../{root}",
        f"{path}%2e%2e/{root}", f"{path}?x", f"/{root}", "//etc/passwd",
        str(built.asset.root_layer),
    ):  # fmt: skip
        assert asked(server, "GET", other)[0] == 404, other
    assert asked(server, "GET", path, Host="evil.example")[0] == 404
    assert asked(server, "DELETE", path)[0] == 501


def test_verdicts_are_written_for_the_page_alone(server, built):
    path = urlsplit(server.address).path + "review"
    body = json.dumps({CHAIR: {"verdict": "accept", "comment": "fine", "directive": ""}})
    kind = {"Content-Type": "application/json"}
    own = server.address.rsplit("/", 2)[0]
    assert asked(server, "POST", path, body)[0] == 403
    assert asked(server, "POST", path, body, Origin="http://evil.example", **kind)[0] == 403
    assert asked(server, "POST", "/review", body, **kind)[0] == 404
    assert asked(server, "POST", path, "{", **kind)[0] == 400
    assert asked(server, "POST", path, '{"/x": {}}', **kind)[0] == 400
    longer_than_any_float = f'{{"{CHAIR}": {{"verdict": "accept", "phi": 1{"0" * 400}}}}}'
    assert asked(server, "POST", path, longer_than_any_float, **kind)[0] == 400
    assert not review_file(built.asset).exists()
    assert asked(server, "POST", path, body, Origin=own, **kind) == (200, b"saved")
    assert read_review(built.asset)[CHAIR].comment == "fine"


def test_what_two_servers_take_at_once_is_all_kept(server, built, monkeypatch):
    """Other processes are stood for by a server that knows nothing of the first."""
    other = PageServer(built.asset, lambda review: review)
    thread = threading.Thread(target=other.serve)
    thread.start()
    written = server_module.write_review

    def slowly(asset, judgements):
        time.sleep(0.5)
        written(asset, judgements)

    monkeypatch.setattr(server_module, "write_review", slowly)
    statuses = []

    def say(one, prim):
        path = urlsplit(one.address).path + "review"
        body = json.dumps({prim: {"verdict": "accept"}})
        answer = asked(one, "POST", path, body, **{"Content-Type": "application/json"})
        statuses.append(answer)

    asking = [threading.Thread(target=say, args=pair) for pair in ((server, CHAIR), (other, WALL))]
    try:
        for one in asking:
            one.start()
        for one in asking:
            one.join()
    finally:
        other.close()
        thread.join()
    assert statuses == [(200, b"saved")] * 2
    assert set(read_review(built.asset)) == {CHAIR, WALL}


def said_to(server, request, *, reset=False):
    """The first line that is answered to bytes; or none, if whoever asks is gone by then."""
    place = urlsplit(server.address)
    with socket.create_connection((place.hostname, place.port), timeout=200) as connection:
        connection.sendall(request)
        if reset:
            at_once = struct.pack("ii", 1, 0)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, at_once)
            return b""
        connection.shutdown(socket.SHUT_WR)
        with connection.makefile("rb") as answer:
            return answer.readline()


@pytest.mark.parametrize(
    ("length", "status"),
    [(b"\xb2", 413), (b"9" * 5000, 413), (b"-1", 413), (b"", 413), (b"9", 400)],
)
def test_a_length_that_is_none_or_a_lie_writes_nothing(server, built, capsys, length, status):
    place = urlsplit(server.address)
    said = said_to(
        server,
        f"POST {place.path}review HTTP/1.1\r\nHost: {place.netloc}\r\n"
        "Content-Type: application/json\r\nContent-Length: ".encode()
        + length
        + b"\r\n\r\n{}",
    )
    assert said.startswith(f"HTTP/1.0 {status} ".encode())
    assert not review_file(built.asset).exists()
    assert capsys.readouterr().err == ""


def test_who_goes_away_is_no_defect(server, capsys):
    place = urlsplit(server.address)
    for request in (
        b"GET /",
        f"GET {place.path} HTTP/1.1\r\nHost: {place.netloc}\r\n\r\n".encode(),
    ):
        said_to(server, request, reset=True)
    assert asked(server, "GET", place.path)[0] == 200
    assert capsys.readouterr().err == ""


def test_more_connections_than_there_may_be_are_not_asked_for_without_a_pause(server, monkeypatch):
    paused, tried = [], threading.Event()

    def none_left(_):
        tried.set()
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(server_module.time, "sleep", paused.append)
    with monkeypatch.context() as full:
        full.setattr(server_module.ThreadingHTTPServer, "get_request", none_left)
        place = urlsplit(server.address)
        with socket.create_connection((place.hostname, place.port), timeout=200):
            assert tried.wait(200)
    assert asked(server, "GET", place.path)[0] == 200
    assert paused


def test_an_address_that_is_taken_is_said(server, built):
    port = urlsplit(server.address).port
    with pytest.raises(EnvironmentFailure, match=r"--port\. \[view\.port\]$"):
        PageServer(built.asset, str, port)


def test_view_says_that_an_address_is_taken_before_it_makes_the_page(server, built, monkeypatch):
    monkeypatch.setattr(server_module, "page_data", pytest.fail)
    with pytest.raises(EnvironmentFailure, match=r"\[view\.port\]$"):
        view(built.asset.folder, port=urlsplit(server.address).port)


def test_an_address_is_free_again_where_there_is_no_page(built, monkeypatch):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]

    def refused(*_):
        raise InputRefused("no page")

    monkeypatch.setattr(server_module, "page_data", refused)
    for _ in range(2):
        with pytest.raises(InputRefused, match="no page"):
            view(built.asset.folder, port=port)


@pytest.mark.parametrize("browser", [True, False])
def test_view_says_where_it_is_and_ends_with_an_interrupt(built, monkeypatch, capsys, browser):
    opened = []
    monkeypatch.setattr(server_module, "page_data", lambda asset, options: {})
    monkeypatch.setattr(server_module.webbrowser, "open", opened.append)

    def interrupted(_, poll_interval):
        raise KeyboardInterrupt

    monkeypatch.setattr(server_module.ThreadingHTTPServer, "serve_forever", interrupted)
    options = [] if browser else ["--no-browser"]
    assert main(["view", str(built.asset.folder), *options]) == 0
    told = capsys.readouterr().err
    assert told.startswith("http://127.0.0.1:")
    assert opened == ([told.split(": open")[0]] if browser else [])


@pytest.mark.parametrize("path", ["review", "elsewhere"])
def test_what_is_too_long_to_take_is_answered_and_not_cut_off(server, built, path):
    """Who sends it all before listening, as browsers and libraries do, hears why."""
    there = urlsplit(server.address).path + path
    body = b"{" + b" " * (24 << 20)
    kind = {"Content-Type": "application/json"}
    wanted = (413, b"too long") if path == "review" else (404, b"nothing here")
    for _ in range(3):
        assert asked(server, "POST", there, body, **kind) == wanted
    assert not review_file(built.asset).exists()


def test_who_goes_on_sending_is_not_listened_to_for_ever(server, monkeypatch):
    monkeypatch.setattr(server_module, "_LINGER", 0.2)
    place = urlsplit(server.address)
    with socket.create_connection((place.hostname, place.port), timeout=200) as connection:
        connection.sendall(
            f"POST {place.path}review HTTP/1.1\r\nHost: {place.netloc}\r\n"
            "Content-Type: application/json\r\nContent-Length: 9999999\r\n\r\n{}".encode()
        )
        with connection.makefile("rb") as answer:
            assert answer.readline().startswith(b"HTTP/1.0 413 ")
            assert answer.read().endswith(b"too long")

        def send_on():
            for _ in range(1000):
                connection.sendall(b" " * 1000)
                time.sleep(0.01)

        with pytest.raises(ConnectionError):
            send_on()
