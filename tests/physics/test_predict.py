"""I_nd of known lobes against their directional albedo."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from tests.physics.brdf import directional_albedo
from tests.physics.chi2 import assert_same_mean
from tests.physics.surfaces import quad, room, world_of
from usdbrdf.transport import lobe_radiance as module
from usdbrdf.transport.environment import Environment
from usdbrdf.transport.lit_scene import LitScene, SurfacePoints
from usdbrdf.transport.lobe_radiance import lobe_radiance

RGB = np.array([3.0, 2.0, 1.0])
# (degrees, phi, psi) of points that are asked for in one call.
LOBES = [
    (degrees, phi, psi)
    for degrees in (10, 60, 75)
    for phi, psi in ((0.0, 0.5), (0.03, 1.0), (0.2, 0.5), (0.6, 0.0), (1.0, 0.7))
]
REPEAT = 1024


def _points(degrees: Sequence[float], position: Sequence[float] = (0, 0, 0)) -> SurfacePoints:
    """One point of a horizontal surface, seen from several directions."""
    angle = np.radians(degrees)
    count = len(angle)
    zero = np.zeros(count, np.float32)
    return SurfacePoints(
        face=zero.astype(np.int32), u=zero, v=zero,
        position=np.tile(np.asarray(position, np.float32), (count, 1)),
        normal=np.tile(np.array([0, 0, 1], np.float32), (count, 1)),
        to_camera=np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=-1).astype(np.float32),
    )  # fmt: skip


def _open_sky() -> LitScene:
    """Radiance RGB from everywhere above; the only quad lies below, black."""
    world = world_of([quad((-1, -1, -2), (2, 0, 0), (0, 2, 0))])
    sky = Environment(image=np.tile(RGB.astype(np.float32), (4, 8, 1)), z_up=True)
    black = world.per_object([(0, 0, 0)])
    return world.lit(black, environment=sky)


def _furnace() -> LitScene:
    """The inside of a room, RGB everywhere; of the rays for lights, all go to one wall."""
    world = world_of(room((-2, -2, 0), (2, 2, 2.5)))
    bright = world.per_object([(1, 1, 1)] * 5 + [(100, 100, 100)])
    lit = world.lit(world.per_object([tuple(RGB)] * 6), bright=bright)
    assert len(lit.lights.face) == 2
    return lit


def _predicted(lit: LitScene, rays: int, repeat: int, seed: int = 0) -> np.ndarray:
    """(repeat, len(LOBES), 3), all in one call."""
    degrees, phi, psi = (np.tile(np.array(values), repeat) for values in zip(*LOBES, strict=True))
    found = lobe_radiance(
        lit, _points(degrees), phi.astype(np.float32), psi.astype(np.float32), rays, seed
    )
    return found.reshape(repeat, len(LOBES), 3)


@pytest.mark.parametrize("place", ["open sky", "furnace"])
def test_even_light_is_multiplied_by_the_directional_albedo(place: str):
    lit = _open_sky() if place == "open sky" else _furnace()
    wanted = [
        RGB * directional_albedo(np.radians(degrees), phi, psi, steps=300)
        for degrees, phi, psi in LOBES
    ]
    found = _predicted(lit, 32, REPEAT).astype(np.float64)
    # slack: the quadrature, halving its step moves it no further.
    assert_same_mean(found, wanted, slack=1e-3)


def test_one_mirror_shows_the_wall_that_it_faces():
    # phi 0 seen at 45 degrees in the plane y = 0: the mirror direction meets the wall at x low.
    world = world_of(room((-2, -2, 0), (2, 2, 4)))
    walls = np.arange(1, 7)[:, None] * RGB
    lit = world.lit(world.per_object(walls.tolist()), bright=world.per_object([(1, 1, 1)] * 6))
    degrees = np.full(256, 45.0)
    one = np.ones(256, np.float32)
    found = lobe_radiance(lit, _points(degrees), 0 * one, one, 64, 0).mean(axis=0)
    mirror = directional_albedo(np.radians(45), 0.0, 1.0)
    np.testing.assert_allclose(found, mirror * walls[4], rtol=0.02)


def test_pieces_make_no_difference(monkeypatch: pytest.MonkeyPatch):
    lit = _furnace()
    whole = _predicted(lit, 16, 5)
    for at_once in (1, 16 * 7, 16 * 74):
        monkeypatch.setattr(module, "_RAYS_AT_ONCE", at_once)
        np.testing.assert_array_equal(_predicted(lit, 16, 5), whole)


def test_the_seed_decides():
    lit = _open_sky()
    np.testing.assert_array_equal(_predicted(lit, 16, 5), _predicted(lit, 16, 5))
    assert (_predicted(lit, 16, 5) != _predicted(lit, 16, 5, seed=1)).mean() > 0.9
    # No two points draw alike.
    same = _predicted(lit, 16, 50)[:, 2, 0]
    assert len(np.unique(same)) == 50


def test_no_points_are_no_light():
    empty = np.zeros(0, np.float32)
    assert lobe_radiance(_open_sky(), _points([]), empty, empty, 16, 0).shape == (0, 3)
