"""What no test may leave behind for the next."""

from __future__ import annotations

import pytest

from usdbrdf.job.progress import set_quiet


@pytest.fixture(autouse=True)
def _heard():
    """A command with -q silences the process."""
    yield
    set_quiet(False)
