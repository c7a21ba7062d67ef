"""Pixels that are lit unevenly: what samples tell of the surface, beside the light on these."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.physics.surfaces import Part, World, quad, world_of
from tests.scenes import camera_at, look_at
from usdbrdf.model.camera import Camera
from usdbrdf.texturing import light_on_pixels as module
from usdbrdf.texturing.light_on_pixels import beside_own_light, light_on_pixels
from usdbrdf.texturing.samples import SAMPLE, Picture, first_surfaces, samples_from_frame
from usdbrdf.transport.lit_scene import TexturedScene

WIDTH, HEIGHT = 80, 60
# A pixel is 2.5 cm wide two metres away.
LENS = np.array([80.0, 80.0, 40.0, 30.0])
ALBEDO = np.array([0.6, 0.4, 0.2])
_ACROSS = 12


def _camera(eye: tuple[float, float, float] = (0.1, -0.2, 2.0)) -> Camera:
    return camera_at(look_at(np.array(eye), np.zeros(3)), LENS, WIDTH, HEIGHT)


def _flat() -> World:
    """A square metre, texels of 12.5 mm."""
    return world_of([quad((-0.5, -0.5, 0), (1, 0, 0), (0, 1, 0), size=(80, 80))])


def _folded() -> World:
    """The same as forty strips that lean to either side in turn, on charts of their own."""
    strips, count = [], 40
    for k in range(count):
        low, high = (0.0, 0.008) if k % 2 else (0.008, 0.0)
        x = k / count - 0.5
        strip = quad((x, -0.5, low), (1 / count, 0, high - low), (0, 1, 0))
        strips.append((strip, (k + 0.1) / count))
    return world_of(
        [
            Part(
                points=np.concatenate([s.points for s, _ in strips]),
                triangles=np.concatenate([s.triangles + 4 * k for k, (s, _) in enumerate(strips)]),
                uv=np.concatenate([s.uv * (0.8 / count, 1) + (at, 0) for s, at in strips]),
                normals=np.concatenate([s.normals for s, _ in strips]),
                size=(400, 40),
            )
        ]
    )


def _light(world: World) -> np.ndarray:
    """S (T, 3): of the flat surface in stripes of a centimetre or four, of the folded one by how it
    leans, bluer in the shade."""
    texels = world.texels
    if (texels.normal[:, 2] > 0.999).all():
        x = texels.position[:, 0]
        bright = np.where(x < 0, np.floor(x / 0.025) % 2, np.floor(x / 0.05) % 2)
    else:
        bright = texels.normal[:, 0] > 0
    return np.where(bright[:, None] > 0, [8.0, 7.0, 5.0], [1.0, 1.2, 1.5]).astype(np.float32)


def _picture(surface: TexturedScene, radiance: np.ndarray, camera: Camera) -> np.ndarray:
    """Means over pixels of ``radiance`` (T, 3), by many rays."""
    fine = camera.at_size(_ACROSS * WIDTH, _ACROSS * HEIGHT)
    hits = surface.rays.closest(*fine.rays(fine.pixels()))
    seen = surface.texture(radiance).at(hits.face, hits.u, hits.v)
    return seen.reshape(HEIGHT, _ACROSS, WIDTH, _ACROSS, 3).mean(axis=(1, 3))


@pytest.mark.parametrize("world", [_flat(), _folded()], ids=["flat", "folded"])
def test_beside_the_light_on_their_pixels_samples_tell_the_albedo(world: World):
    surface = TexturedScene(world.scene, world.texels, world.rays)
    texels, light, camera = world.texels, _light(world), _camera()
    picture = _picture(surface, (ALBEDO * light / np.pi).astype(np.float32), camera)
    every = np.ones((HEIGHT, WIDTH), np.bool_)
    surfaces = first_surfaces(world.rays, world.scene.face_object, camera)
    kind, radiance = samples_from_frame(
        texels, texels.object_index(), surfaces, Picture(picture, every, ~every, ~every), camera
    )
    seen = np.flatnonzero(kind == SAMPLE).astype(np.int32)
    assert len(seen) > 0.7 * len(texels)

    def off(radiance: np.ndarray) -> np.ndarray:
        return np.abs(np.pi * radiance / light[seen] / ALBEDO - 1)

    ratio = beside_own_light(surface, texels.object_index(), surface.texture(light), seen, camera)
    assert np.percentile(off(radiance[seen]), 75) > 0.4
    assert np.percentile(off(radiance[seen] / ratio), 75) < 0.12
    assert abs(np.median(np.pi * radiance[seen] / ratio / light[seen] / ALBEDO) - 1) < 0.03


def test_where_light_is_even_nothing_changes():
    world = _flat()
    surface = TexturedScene(world.scene, world.texels, world.rays)
    light = np.broadcast_to(np.float32([2, 3, 4]), (len(world.texels), 3)).copy()
    every = np.arange(len(light), dtype=np.int32)
    owner = world.texels.object_index()
    found = beside_own_light(surface, owner, surface.texture(light), every, _camera())
    np.testing.assert_allclose(found, 1, atol=1e-5)


def test_what_is_not_known_or_hardly_so_is_left_within_reason():
    world = _flat()
    surface = TexturedScene(world.scene, world.texels, world.rays)
    light = _light(world)
    light[world.texels.position[:, 1] > 0] = 0  # nobody knows
    light[world.texels.position[:, 1] < -0.2] *= 1e-6  # next to dark, beside what is not
    every = np.arange(len(light), dtype=np.int32)
    owner = world.texels.object_index()
    found = beside_own_light(surface, owner, surface.texture(light), every, _camera())
    assert np.isfinite(found).all()
    assert (found[light[:, 0] == 0] == 1).all()
    assert found.min() >= 0.25
    assert found.max() <= 4


def test_the_unit_of_light_plays_no_part():
    world = _flat()
    surface = TexturedScene(world.scene, world.texels, world.rays)
    light, owner = _light(world), world.texels.object_index()
    every = np.arange(len(light), dtype=np.int32)

    def found(unit: float) -> np.ndarray:
        lit = surface.texture((light * np.float32(unit)).astype(np.float32))
        return beside_own_light(surface, owner, lit, every, _camera())

    assert found(1).std() > 0.3
    for unit in (2.0**-12, 2.0**12):
        np.testing.assert_allclose(found(unit), found(1), rtol=1e-4)


def test_pictures_are_drawn_in_parts_alike(monkeypatch):
    world = _folded()
    surface = TexturedScene(world.scene, world.texels, world.rays)
    light = surface.texture(_light(world))
    camera = replace(_camera((0.3, 0.1, 1.2)), height=HEIGHT - 1)
    whole = light_on_pixels(surface, light, camera)
    for points in (7 * 4 * WIDTH, 1):  # seven rows of pixels, and less than one
        monkeypatch.setattr(module, "_AT_ONCE", points)
        np.testing.assert_array_equal(light_on_pixels(surface, light, camera), whole)
    # What pixels cover of the surface alone counts, and beyond it there is none.
    assert whole.max() <= 8.01
    assert whole.min() == 0
    covered = whole[whole[..., 0] > 0]
    assert covered.min() >= 0.99
