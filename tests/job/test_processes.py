"""How many cores there are for a process."""

from __future__ import annotations

import os

import pytest

from usdbrdf.job.processes import granted_cores


@pytest.mark.parametrize(
    ("may_use", "there", "granted"),
    [({0, 3, 5}, 8, 3), ({2}, 64, 1), (None, 6, 6), (None, None, 1)],
)
def test_cores_are_those_that_the_system_grants_or_all_or_one(
    monkeypatch: pytest.MonkeyPatch, may_use: set[int] | None, there: int | None, granted: int
) -> None:
    """None: macOS and Windows do not say which, and some containers not even how many."""
    monkeypatch.setattr(os, "cpu_count", lambda: there)
    if may_use is None:
        monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    else:
        monkeypatch.setattr(os, "sched_getaffinity", lambda _of: may_use, raising=False)
    assert granted_cores() == granted
