"""The page's server answers who knows the token, from this machine's own page, and nothing else."""

from __future__ import annotations

import http.client
import json
import threading
from urllib.parse import urlsplit

import pytest

from usdbrdf.asset.review import read_review, review_file
from usdbrdf.cli import main
from usdbrdf.errors import EnvironmentFailure
from usdbrdf.page import server as server_module
from usdbrdf.page.server import PageServer

CHAIR = "/room/geo/Stuhl_No_1/Stuhl_No_1"


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
    assert not review_file(built.asset).exists()
    assert asked(server, "POST", path, body, Origin=own, **kind) == (200, b"saved")
    assert read_review(built.asset)[CHAIR].comment == "fine"


def test_an_address_that_is_taken_is_said(server, built):
    port = urlsplit(server.address).port
    with pytest.raises(EnvironmentFailure, match=r"--port\. \[view\.port\]$"):
        PageServer(built.asset, str, port)


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
