"""What many tests start from, and what none may leave behind for the next."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from tests.synthetic_asset import box, build, make_scan
from usdbrdf.job.progress import set_quiet


@pytest.fixture(autouse=True)
def _heard():
    """A command with -q silences the process."""
    yield
    set_quiet(False)


@pytest.fixture(scope="session")
def synthetic():
    """How ``built`` is made, for tests that need other assets."""
    return SimpleNamespace(make_scan=make_scan, build=build, box=box)


@pytest.fixture
def built(tmp_path):
    """A small asset with three objects: a box, a wall that nobody saw, and a lamp."""
    return build(tmp_path / "out" / "room", make_scan(tmp_path / "capture"))
