"""Unseen texels take after the nearest seen ones of their own object."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.physics.surfaces import Part, World, box, quad, world_of
from usdbrdf.geometry.texels import texels_from_atlas
from usdbrdf.model.scene import SceneObject
from usdbrdf.texturing.inpaint import inpaint


@pytest.fixture(scope="module")
def pair() -> World:
    """Two squares that touch along x = 1, so that the nearest texels are often the other's."""
    return world_of([
        quad((0, 0, 0), (1, 0, 0), (0, 1, 0), size=(16, 16)),
        quad((1, 0, 0), (1, 0, 0), (0, 1, 0), size=(16, 16)),
    ])  # fmt: skip


def test_known_texels_are_returned_unchanged(pair: World):
    rng = np.random.default_rng(12345)
    values = rng.lognormal(0, 2, (len(pair.texels), 3)).astype(np.float32)
    known = rng.random(len(pair.texels)) < 0.5
    values[~known] = np.nan
    filled = inpaint(pair.texels, values, known)
    np.testing.assert_array_equal(filled[known], values[known])
    assert np.isfinite(filled).all()


def test_holes_are_filled_from_their_own_object_only(pair: World):
    values = pair.per_object([(0.2, 0.3, 0.4), (5, 6, 7)])
    # The strip along the shared edge is unseen on both.
    known = np.abs(pair.texels.position[:, 0] - 1) > 0.2
    assert 50 < np.count_nonzero(~known) < 300
    filled = inpaint(pair.texels, np.where(known[:, None], values, 0), known)
    np.testing.assert_allclose(filled, values, rtol=1e-5)


def test_the_fill_is_the_geometric_mean_of_eight_neighbours(pair: World):
    # Only eight texels of the square are known, four of 0.1 and four of 10: sqrt(0.1 * 10) = 1.
    own = np.flatnonzero(pair.texels.object_index() == 0)
    source = np.random.default_rng(12345).choice(own, 8, replace=False)
    known = np.zeros(len(pair.texels), bool)
    known[source] = True
    values = np.zeros((len(known), 3), np.float32)
    values[source] = np.array([0.1, 10] * 4)[:, None]
    filled = inpaint(pair.texels, values, known)
    np.testing.assert_allclose(filled[np.setdiff1d(own, source)], 1, rtol=1e-5)


def test_an_object_that_nobody_saw_takes_the_nearest_of_the_scene(pair: World):
    values = pair.per_object([(0.2, 0.3, 0.4), (5, 6, 7)])
    known = pair.texels.object_index() == 0
    filled = inpaint(pair.texels, values, known)
    np.testing.assert_allclose(filled[~known], np.tile([[0.2, 0.3, 0.4]], (256, 1)), rtol=1e-5)


def test_a_scene_that_nobody_saw_is_black(pair: World):
    values = np.full((len(pair.texels), 3), np.nan, np.float32)
    filled = inpaint(pair.texels, values, np.zeros(len(values), bool))
    np.testing.assert_array_equal(filled, 0)


@pytest.mark.parametrize("unit", [2.0**-40, 2.0**30])
def test_the_fill_does_not_depend_on_the_unit(pair: World, unit: float):
    rng = np.random.default_rng(12345)
    values = rng.lognormal(0, 2, (len(pair.texels), 3)).astype(np.float32)
    values[rng.random(len(values)) < 0.2] = 0
    known = rng.random(len(values)) < 0.5
    filled = inpaint(pair.texels, values, known)
    other = inpaint(pair.texels, values * np.float32(unit), known)
    np.testing.assert_allclose(other / np.float32(unit), filled, rtol=1e-4)


def test_black_alone_fills_black(pair: World):
    known = np.arange(len(pair.texels)) % 2 == 0
    filled = inpaint(pair.texels, np.zeros((len(known), 3), np.float32), known)
    np.testing.assert_array_equal(filled, 0)


def test_the_same_facing_counts_for_nearness():
    # One object of two sheets 2 cm apart, back to back; only a stripe of each is seen. The hole in
    # the upper one is nearer to the lower one's stripe in space, but not in space and facing.
    upper = quad((0, 0, 0.02), (1, 0, 0), (0, 1, 0), size=(32, 32))
    lower = quad((0, 0, 0), (0, 1, 0), (1, 0, 0), size=(32, 32))
    both = _merged([upper, lower])
    texels = both.texels
    up = texels.normal[:, 2] > 0
    x = texels.position[:, 0]
    known = np.where(up, x < 0.2, x > 0.2)
    values = np.where(up, 1.0, 9.0)[:, None].astype(np.float32) * np.ones(3, np.float32)
    filled = inpaint(texels, values, known)
    near = up & (x > 0.2) & (x < 0.35)
    np.testing.assert_allclose(filled[near], 1, rtol=1e-5)


def test_one_known_texel_is_enough():
    world = world_of(box((0, 0, 0), (1, 1, 1)))
    known = np.zeros(len(world.texels), bool)
    known[5] = True
    values = np.full((len(known), 3), 0.3, np.float32)
    np.testing.assert_allclose(inpaint(world.texels, values, known), 0.3, rtol=1e-5)


def _merged(parts: list[Part]) -> World:
    """Parts side by side in the atlas of one object."""
    scene = world_of(parts).scene
    uv = scene.corner_uv.copy()
    uv[..., 0] = (uv[..., 0] + scene.face_object[:, None]) / len(parts)
    whole = SceneObject(
        prim_path="/x/geo/a", identifier="a", label="a", class_name="",
        first_face=0, num_faces=len(uv),
    )  # fmt: skip
    one = replace(scene, objects=(whole,), corner_uv=uv, face_object=np.zeros(len(uv), np.int32))
    width, height = parts[0].size
    resolution = np.array([[width * len(parts), height]], np.int32)
    return World(scene=one, texels=texels_from_atlas(one, resolution))


def test_far_from_what_was_seen_no_single_texel_decides():
    """A square seen in its left third, of whose texels every fifth column shows something else."""
    one = world_of([quad((0, 0, 0), (1, 0, 0), (0, 1, 0), size=(64, 64))])
    position = one.texels.position
    column = np.floor(position[:, 0] * 64)
    known = column < 21
    odd = known & (column % 5 == 0)
    values = np.where(odd, 10.0, 0.1)[:, None].astype(np.float32) * np.ones(3, np.float32)
    filled = inpaint(one.texels, np.where(known[:, None], values, np.nan), known)
    # Column 20 shows something else, and is the nearest for all of them.
    far = ~known & (position[:, 0] > 0.6)
    assert np.median(filled[far]) == pytest.approx(0.1 * 100**0.24, rel=0.3)
    assert filled[~known & (column == 21)].min() > 0.5


def test_from_afar_a_few_texels_that_mix_with_what_is_behind_them_tell_little():
    """A square seen in its left third, of whose texels a sixth, anywhere, are a hundred times as
    bright as the others."""
    one = world_of([quad((0, 0, 0), (1, 0, 0), (0, 1, 0), size=(64, 64))])
    across = one.texels.position[:, 0]
    known = across < 1 / 3
    bright = np.random.default_rng(2).random(len(known)) < 1 / 6
    values = np.where(bright, 1.0, 0.01)[:, None].astype(np.float32) * np.ones(3, np.float32)
    filled = inpaint(one.texels, np.where(known[:, None], values, np.nan), known)
    far = np.log(filled[across > 0.6, 0])
    assert far.mean() == pytest.approx(math.log(0.01 * 100 ** (1 / 6)), abs=0.3)
    assert far.std() < 0.4
