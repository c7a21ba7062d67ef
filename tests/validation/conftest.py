"""The small asset of the stage's tests, to be checked and to be broken."""

import importlib.util
import sys
from pathlib import Path

_PATH = Path(__file__).resolve().parents[1] / "stage" / "conftest.py"
_SPEC = importlib.util.spec_from_file_location("stage_fixtures", _PATH)
_FIXTURES = importlib.util.module_from_spec(_SPEC)
sys.modules["stage_fixtures"] = _FIXTURES
_SPEC.loader.exec_module(_FIXTURES)

synthetic = _FIXTURES.synthetic
built = _FIXTURES.built
