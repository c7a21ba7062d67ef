"""Objects are fitted as units, of which those that an interrupted run did are taken from it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from usdbrdf.job.task import TaskRun
from usdbrdf.job.units import HERE
from usdbrdf.material import fit_objects
from usdbrdf.material.fit_objects import ObjectFit
from usdbrdf.transport.lit_scene import LitScene


class _Run(TaskRun):
    def __init__(self) -> None:
        self._workers, self._for_workers = HERE, Path()
        self.saved: dict[str, dict[str, np.ndarray]] = {}

    def checkpoint_if(self, name: str, index: int | None = None) -> dict[str, np.ndarray] | None:
        return ObjectFit(cost=-1.0).arrays() if name == "object-1" else None

    def save(self, name: str, found: dict[str, np.ndarray], index: int | None = None) -> None:
        self.saved[name] = found


def test_what_an_interrupted_run_did_is_taken_from_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(fit_objects, "fit_object", lambda *_, **__: ObjectFit(cost=1.0))
    names = ("rays", "radiance", "lights", "emission", "environment")
    lit = LitScene(
        scene=SimpleNamespace(objects=range(4)),  # type: ignore[arg-type]
        texels=SimpleNamespace(object_index=lambda: np.arange(4), resolution=np.ones((4, 2))),  # type: ignore[arg-type]
        **dict.fromkeys(names),  # type: ignore[arg-type]
    )
    survey = SimpleNamespace(observations=SimpleNamespace(texel=np.array([2, 2, 0])))
    lightings = [fit_objects.Lighting(lit, survey)]  # type: ignore[arg-type]
    run, options = _Run(), fit_objects.FitOptions(method="paper")
    _, found = fit_objects.fitted_by_likelier_lobe(run, lightings, None, options)  # type: ignore[arg-type]
    assert found[1].cost == -1  # taken from an interrupted run
    assert sorted(run.saved) == ["object-0", "object-2", "object-3"]
    for i in (0, 2, 3):
        assert found[i].cost == 1
