"""The small asset of the stage's tests, and the folder of the plug-ins."""

import importlib.util
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

_PATH = ROOT / "tests" / "stage" / "conftest.py"
_SPEC = importlib.util.spec_from_file_location("stage_fixtures_of_plugins", _PATH)
_FIXTURES = importlib.util.module_from_spec(_SPEC)
sys.modules[_SPEC.name] = _FIXTURES
_SPEC.loader.exec_module(_FIXTURES)

synthetic = _FIXTURES.synthetic
built = _FIXTURES.built


@pytest.fixture(scope="session")
def plugins():
    """The folder of the plug-ins."""
    return ROOT / "plugins"
