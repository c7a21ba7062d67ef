"""Objects are fitted together, each with one thread of BLAS."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from usdbrdf.tasks import fit_objects


class _Run:
    def __init__(self) -> None:
        self.saved: dict[str, dict[str, np.ndarray]] = {}

    def checkpoint_if(self, name: str) -> dict[str, np.ndarray] | None:
        return {"threads": np.array([-1])} if name == "object-1" else None

    def save(self, name: str, found: dict[str, np.ndarray]) -> None:
        self.saved[name] = found


def _threads_of_blas() -> np.ndarray:
    return np.array([one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"])


def test_blas_keeps_to_one_thread_while_objects_are_fitted(monkeypatch: pytest.MonkeyPatch):
    before = _threads_of_blas()
    assert len(before)
    monkeypatch.setattr(fit_objects, "fit_object", lambda *_: {"threads": _threads_of_blas()})
    lit, run = SimpleNamespace(scene=SimpleNamespace(objects=range(4))), _Run()
    found = fit_objects.fitted_objects(run, lit, None, None, None, fit_objects.FitOptions())  # type: ignore[arg-type]
    assert found[1]["threads"] == -1  # taken from an interrupted run
    assert sorted(run.saved) == ["object-0", "object-2", "object-3"]
    for i in (0, 2, 3):
        assert (found[i]["threads"] == 1).all()
    np.testing.assert_array_equal(_threads_of_blas(), before)
