"""A small room whose lamp is seen, and its page, made once."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from tests.evaluation.conftest import Made, make, silence  # noqa: F401
from tests.json_schemas import check
from tests.scenes import poses_down_and_up
from usdbrdf.asset.properties import FittedObject
from usdbrdf.page.report import report


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
