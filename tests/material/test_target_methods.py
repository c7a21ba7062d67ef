"""What the methods of one target frame ask of it."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest

from tests.physics.surfaces import World, quad, world_of
from usdbrdf.material import fit_objects
from usdbrdf.material.fit_objects import _fit_of_frame
from usdbrdf.options import FitOptions

PLAIN, LAMP = 0, 1


@pytest.fixture(scope="module")
def world() -> World:
    return world_of([quad((0, 0, 0), (1, 0, 0), (0, 1, 0)), quad((2, 0, 0), (1, 0, 0), (0, 1, 0))])


@pytest.fixture
def fitted(world: World, monkeypatch: pytest.MonkeyPatch) -> Any:
    """What a method makes of an object, and what its frame was asked for."""
    found = SimpleNamespace(phi=0.3, psi=0.6, phi_low=0.2, phi_high=0.5, cost=2.0, evidence=0.7)
    lit = world.lit(
        world.per_object([(1, 1, 1), (9, 9, 9)]), emission=world.per_object([(0, 0, 0), (1, 1, 1)])
    )
    reader: Any = SimpleNamespace(frames=None, read=lambda number: number)
    asked: list[Any] = []

    def of(options: FitOptions, target: int = 4, index: int = PLAIN, fit: Any = found) -> Any:
        def of_frame(_lit: Any, view: int, *given: Any) -> Any:
            asked.append((view, *given))
            return fit, 123

        asked.clear()
        monkeypatch.setattr(fit_objects, "fit_target_frame", of_frame)
        monkeypatch.setattr(fit_objects, "_view", lambda _frames, _target, pixels: pixels)
        return _fit_of_frame(lit, reader, target, index, options, ""), asked

    return of


@pytest.mark.parametrize("method", ["paper", "scaled"])
def test_either_method_has_its_own_residual(fitted: Any, method: Any) -> None:
    found, asked = fitted(FitOptions(method=method, max_pixels=900, seed=5))
    assert asked == [(4, PLAIN, method, 900, 5)]
    assert (found.phi, found.psi, found.cost, found.evidence) == (0.3, 0.6, 2.0, 0.7)
    # As if all roughnesses between were equally likely; nothing tells the error of psi.
    assert found.phi_error == pytest.approx(0.3 / math.sqrt(12))
    assert math.isnan(found.psi_error)
    assert (found.num_samples, found.target) == (123, 4)


def test_what_shines_or_no_frame_shows_is_not_asked_for(fitted: Any) -> None:
    options = FitOptions(method="paper")
    for target, index in ((-1, PLAIN), (4, LAMP)):
        found, asked = fitted(options, target, index)
        assert not asked
        assert found.target == target
        assert math.isnan(found.phi)
    found, asked = fitted(options, fit=None)  # too few pixels
    assert len(asked) == 1
    assert math.isnan(found.phi)
    assert found.num_samples == 123
