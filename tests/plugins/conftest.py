"""The folder of the plug-ins."""

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def plugins():
    return Path(__file__).resolve().parents[2] / "plugins"
