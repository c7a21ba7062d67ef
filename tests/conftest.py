"""What many tests start from, what none may leave behind for the next, and which take long."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.synthetic_asset import box, build, make_scan
from usdbrdf.job.progress import set_quiet

# Files and folders whose tests run the pipeline, kill processes, start other programs or fit
# materials; `pytest -m "not slow"` leaves them out.
SLOW = (
    "asset/test_previews.py",
    "asset/test_schema.py",
    "dcc",
    "evaluation",
    "faults/test_kill_resume.py",
    "job/test_child.py",
    "job/test_kill_resume.py",
    "material/test_fit_lobe.py",
    "material/test_refine.py",
    "material/test_view_model.py",
    "nondestruction",
    "physics/test_lobe_samples.py",
    "physics/test_recovery.py",
    "plugins",
    "shading/test_denoise.py",
    "shading/test_denoise_default.py",
    "tasks/test_texture.py",
    "test_cli.py",
    "test_convert.py",
    "test_identity.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what is slow."""
    here = Path(__file__).parent
    for item in items:
        place = item.path.relative_to(here).as_posix()
        if any(place == slow or place.startswith(f"{slow}/") for slow in SLOW):
            item.add_marker(pytest.mark.slow)


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
