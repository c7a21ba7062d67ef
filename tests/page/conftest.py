"""A small room whose lamp is seen, and its page, made once."""

from __future__ import annotations

import json
import re
import shutil
import threading
from pathlib import Path
from typing import Any

import pytest

from tests.evaluation.conftest import Made, make, silence  # noqa: F401
from tests.json_schemas import check
from tests.scenes import poses_down_and_up
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.properties import FittedObject
from usdbrdf.page.report import page, report, reviewed
from usdbrdf.page.server import PageServer

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
SOFTWARE_3D = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
SCREENS = pytest.mark.parametrize(
    ("width", "scheme"), [(1440, "light"), (1440, "dark"), (390, "light"), (390, "dark")]
)


def data_of(text: str) -> dict[str, Any]:
    """What a page carries."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)
    assert found
    data: dict[str, Any] = json.loads(found[1])
    return data


def fit_of(**numbers: Any) -> FittedObject:
    """A fit that determined nothing, with other ``numbers``."""
    usual = {"status": "undetermined", "evidence": 0.4, "target_frame": 0, "cost": 0.0,
             "num_pixels": 9, "method": "views"}  # fmt: skip
    return FittedObject(prim_path="/r", identifier="r", phi=0.3, psi=0.5, **usual | numbers)


@pytest.fixture(scope="session")
def room(make) -> Made:  # noqa: F811
    found: Made = make(poses=poses_down_and_up(8, 4))
    return found


@pytest.fixture(scope="session")
def page_file(room, tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("page") / "report.html"
    check(report(room.asset, output), "report")
    return output


def shuts_out(shown):
    """What hinders people who do not see, hear or point as most do, and in what."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright")
    found = axe.Axe().run(shown).response["violations"]
    serious = [v for v in found if v["impact"] in ("serious", "critical")]
    return {v["id"]: [node["html"][:200] for node in v["nodes"]] for v in serious}


@pytest.fixture(scope="module")
def chromium():
    playwright = pytest.importorskip("playwright.sync_api", reason="needs usdbrdf[browser]")
    if CHROMIUM is None:
        pytest.skip("needs chromium (Debian: apt install)")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", *SOFTWARE_3D]
        )
        yield browser
        browser.close()


@pytest.fixture
def opened(chromium):
    """opened(address, **context's) -> a page that is ready; what went wrong is in ``page.faults``,
    what it asked for elsewhere in ``page.asked``."""
    contexts = []

    def open_page(address, script="", **options):
        context = chromium.new_context(accept_downloads=True, **options)
        contexts.append(context)
        shown = context.new_page()
        shown.faults, shown.asked = [], []
        shown.on("pageerror", lambda error: shown.faults.append(str(error)))
        shown.on(
            "console", lambda said: shown.faults.append(said.text) if said.type == "error" else None
        )
        shown.on("request", lambda request: shown.asked.append(request.url))
        if script:
            shown.add_init_script(script)
        shown.goto(address)
        shown.wait_for_selector("body[data-ready=yes]", timeout=600_000)
        return shown

    yield open_page
    for context in contexts:
        context.close()


@pytest.fixture
def served(room, page_file, tmp_path):
    """A copy of the room's asset, what its page carries, and the address that serves it."""
    folder = tmp_path / "room"
    shutil.copytree(room.asset, folder)
    asset, data = Asset.made(folder), data_of(page_file.read_text("utf-8"))
    server = PageServer(asset, lambda at: page({**data, **reviewed(asset)}, served=at))
    thread = threading.Thread(target=server.serve)
    thread.start()
    yield asset, data, server.address
    server.close()
    thread.join()
