"""What usual dielectrics would mirror, against quadrature."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from tests.physics.surfaces import box, quad, world_of
from tests.scenes import frames_at, look_at
from usdbrdf.shading import gloss
from usdbrdf.shading.gloss import (
    angles_of_glare,
    gloss_of_objects,
    mirrored_irradiance,
    mirrored_to_frames,
)
from usdbrdf.transport.brdf import DIELECTRIC, F0_OF_PSI
from usdbrdf.transport.directional_albedo import fitted_albedo, view_cosines
from usdbrdf.transport.environment import black_environment
from usdbrdf.transport.lit_scene import TexturedScene

LIGHT = np.array([3.0, 2.0, 1.0])


@pytest.fixture(scope="module")
def furnace():
    """A closed box of 4 m with faces inwards, all as bright."""
    world = world_of([
        quad((0, 0, 0), (4, 0, 0), (0, 4, 0), (12, 12)),
        quad((0, 0, 4), (0, 4, 0), (4, 0, 0), (12, 12)),
        quad((0, 0, 0), (0, 0, 4), (4, 0, 0), (12, 12)),
        quad((0, 4, 0), (4, 0, 0), (0, 0, 4), (12, 12)),
        quad((0, 0, 0), (0, 4, 0), (0, 0, 4), (12, 12)),
        quad((4, 0, 0), (0, 0, 4), (0, 4, 0), (12, 12)),
    ])  # fmt: skip
    surface = TexturedScene(world.scene, world.texels, world.rays)
    return surface, np.tile(LIGHT.astype(np.float32), (len(world.texels), 1))


def _reflects(cosines: np.ndarray | None) -> np.ndarray:
    f0 = np.array([F0_OF_PSI * gloss._PSI])
    return fitted_albedo(gloss._PHI, f0, cosines, kind=DIELECTRIC)[:, 0]


def test_in_uniform_light_frames_are_shown_the_directional_albedo_of_it(furnace):
    surface, light = furnace
    eye = np.array([2.0, 2.1, 1.5])
    frames = frames_at([look_at(eye, np.array([x, y, 0.0])) for x, y in ((2, 2.4), (0.5, 2))])
    floor = np.arange(*surface.texels.of_object(0).indices(10**6), dtype=np.int64)
    found = mirrored_to_frames(surface, light, black_environment(), frames, floor, 0)
    way = eye - surface.texels.position[floor]
    cosine = way[:, 2] / np.linalg.norm(way, axis=1)
    pixels = [frames.camera(i).project(surface.texels.position[floor]) for i in range(2)]
    seen = np.any([((p > 1) & (p < 63)).all(axis=1) for p in pixels], axis=0)
    expected = np.interp(cosine, view_cosines(), _reflects(None))[:, None] * LIGHT
    assert 0.3 < seen.mean() < 1
    np.testing.assert_allclose(found[seen].mean(0), expected[seen].mean(0), rtol=0.02)
    np.testing.assert_allclose(found[seen], expected[seen], rtol=0.4)
    assert not found[~seen].any()


def test_what_is_behind_another_surface_is_shown_to_no_frame(furnace):
    surface, light = furnace
    outside = frames_at([look_at(np.array([2.0, 2.1, -3.0]), np.array([2.0, 2.0, 4.1]))])
    some = np.arange(len(light), step=7)
    assert not mirrored_to_frames(surface, light, black_environment(), outside, some, 0).any()


def test_in_uniform_light_surfaces_send_on_what_they_do_not_let_in(furnace):
    surface, light = furnace
    found = mirrored_irradiance(surface, light, np.arange(len(light), step=3), 0)
    # Cosines of the views are drawn as uniform light weighs them.
    expected = np.pi * _reflects(None).mean() * LIGHT
    np.testing.assert_allclose(found.mean(0), expected, rtol=0.02)


def test_a_wall_hides_what_it_hides():
    world = world_of([quad((0, 0, 0), (2, 0, 0), (0, 2, 0), (8, 8)), *box((0.8, 0.8, 0.5),
                      (1.2, 1.2, 0.9), (4, 4))])  # fmt: skip
    surface = TexturedScene(world.scene, world.texels, world.rays)
    light = np.ones((len(world.texels), 3), np.float32)
    above = frames_at([look_at(np.array([1.0, 1.001, 3.0]), np.array([1.0, 1.0, 0.0]))])
    floor = np.arange(64)
    found = mirrored_to_frames(surface, light, black_environment(), above, floor, 0)
    middle = np.abs(world.texels.position[:64, :2] - 1).max(axis=1)
    assert not found[middle < 0.2].any()
    # Beside it the floor mirrors its sides.
    assert (found[(middle > 0.3) & (middle < 0.5)] > 0).mean() > 0.5


@pytest.fixture(scope="module")
def lamplit(furnace):
    """The same box with a lamp in its ceiling, and twelve frames from within it."""
    surface, light = furnace
    position = surface.texels.position
    lamp = (position[:, 2] > 3.9) & (np.abs(position[:, :2] - [1.5, 2.5]).max(axis=1) < 0.5)
    shown = np.where(lamp[:, None], 30 * light, light).astype(np.float32)
    turns = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    eyes = [np.array([2 + 1.4 * np.cos(t), 2 + 1.4 * np.sin(t), 2.0]) for t in turns]
    return surface, shown, frames_at([look_at(eye, np.array([2.0, 2.0, 0.0])) for eye in eyes])


def _photographs(surface: TexturedScene, light: np.ndarray):
    """What frames show of surfaces that are dull."""
    texture = surface.texture(light)

    def read(frames, i: int):
        camera = frames.camera(i)
        hits = surface.rays.closest(*camera.rays(camera.pixels()))
        shape = tuple(int(n) for n in frames.resolution[i][::-1])
        none = np.zeros(shape, np.bool_)
        radiance = texture.at(hits.face, hits.u, hits.v).reshape(*shape, 3)
        return SimpleNamespace(radiance=radiance, valid=~none, clipped=none, dark=none)

    return read


def test_directions_from_which_something_clips_are_as_far_apart_as_the_frames_that_show_it(
    lamplit, monkeypatch
):
    """Where only the frames at one side clip, a mirror image for all one knows."""
    surface, light, frames = lamplit
    read = _photographs(surface, light)
    floor = np.flatnonzero(np.abs(surface.texels.position - [2.0, 2.0, 0.0]).max(axis=1) < 0.4)
    angles = []
    for clips in (range(12), (0, 1), ()):

        def photograph(frames, i: int, clips=clips):
            picture = read(frames, i)
            picture.clipped = np.full(picture.valid.shape, i in clips)
            picture.valid = ~picture.clipped
            return picture

        monkeypatch.setattr(gloss, "read_frame", photograph)
        angles.append(angles_of_glare(surface, frames, floor, 0).max())
    # Eyes 2 m above the floor on a circle of 1.4 m, 30 degrees apart.
    assert 55 < angles[0] < 75
    assert 10 < angles[1] < 25
    assert angles[2] == 0


def test_objects_are_as_glossy_as_their_views_tell(lamplit, monkeypatch):
    surface, light, frames = lamplit
    monkeypatch.setattr(gloss, "read_frame", _photographs(surface, light))
    index = np.arange(len(light), dtype=np.int64)
    owner = surface.texels.object_index()
    asked = surface, light, black_environment(), frames, index, 0
    dull = gloss_of_objects(*asked)
    assert (dull[[0, 2, 3, 4, 5]] < 0.1).all()
    # The floor mirrors as a usual dielectric does, one wall twice as much.
    true = np.array([1.0, 0, 0, 2.0, 0, 0])
    shown = gloss._seen_by

    def glossy(*given):
        mirrored = gloss._mirrored_to(*asked[:5], given[-1], 77)
        return shown(*given) + true[owner, None].astype(np.float32) * mirrored

    monkeypatch.setattr(gloss, "_seen_by", glossy)
    found = gloss_of_objects(*asked)
    np.testing.assert_allclose(found[[0, 2, 3, 4, 5]], true[[0, 2, 3, 4, 5]], atol=0.2)
    # Next to what all mirror, what few frames show is of no account.
    few = gloss_of_objects(*asked[:3], frames_at(list(frames.world_from_camera[:2])), *asked[4:])
    np.testing.assert_array_equal(few, 0)
