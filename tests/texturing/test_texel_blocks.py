"""Blocks of texels that a frame passes over hold none that it can see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.physics.surfaces import World, quad, world_of
from tests.scenes import camera_at, frames_at, look_at
from usdbrdf.texturing.observe import blocks_of_texels, frames_in_view

LENS, SIZE, MIN_COSINE = np.array([80.0, 80.0, 40.0, 30.0]), np.array([80, 60], np.int32), 0.1


@pytest.fixture(scope="module")
def corner() -> World:
    """Two walls and a floor, and a fan of four leaves that share one chart each."""
    parts = [
        quad((0, 0, 0), (3, 0, 0), (0, 3, 0), size=(50, 50)),
        quad((0, 0, 0), (0, 3, 0), (0, 0, 3), size=(50, 50)),
        quad((0, 0, 0), (0, 0, 3), (3, 0, 0), size=(50, 50)),
    ]
    for angle in (0.3, 0.9, 1.8, 2.9):
        along = (0.5 * np.cos(angle), 0.5 * np.sin(angle), 0.1)
        parts.append(quad((1.5, 1.5, 0.4), along, (0, 0.1, 0.5), size=(13, 21)))
    return world_of(parts)


def _visible(world: World, pose: np.ndarray) -> np.ndarray:
    """Texels that project into the image and face the eye, written out once more."""
    texels = world.texels
    to_eye = pose[:3, 3] - texels.position.astype(np.float64)
    cosine = (to_eye * texels.geometric_normal).sum(axis=1) / np.linalg.norm(to_eye, axis=1)
    local = -to_eye @ pose[:3, :3]
    column = LENS[2] - LENS[0] * local[:, 0] / local[:, 2]
    row = LENS[3] + LENS[1] * local[:, 1] / local[:, 2]
    inside = (column >= 0) & (row >= 0) & (column < SIZE[0]) & (row < SIZE[1])
    return np.flatnonzero((local[:, 2] < 0) & inside & (cosine >= MIN_COSINE))


def test_no_texel_that_is_seen_is_passed_over(corner: World):
    blocks = blocks_of_texels(corner.texels, slice(0, len(corner.texels)))
    rng = np.random.default_rng(12345)
    shares = []
    for _ in range(200):
        pose = look_at(rng.uniform(0.05, 3, 3), rng.uniform(-1, 4, 3))
        which = blocks.texels_in_view(camera_at(pose, LENS, *SIZE), MIN_COSINE)
        assert len(np.unique(which)) == len(which)
        assert np.isin(_visible(corner, pose), which).all()
        shares.append((len(which) - len(_visible(corner, pose))) / len(corner.texels))
    # And of the others most are.
    assert np.mean(shares) < 0.15


def test_blocks_are_of_one_object_and_small(corner: World):
    texels = corner.texels
    blocks = blocks_of_texels(texels, slice(0, len(texels)))
    np.testing.assert_array_equal(np.sort(blocks.order), np.arange(len(texels)))
    owner = texels.object_index()[blocks.order]
    for low, high in zip(blocks.first[:-1], blocks.first[1:], strict=True):
        assert high - low <= 64
        assert (owner[low:high] == owner[low]).all()


def test_blocks_of_a_part_are_the_parts(corner: World):
    part = slice(2400, 5311)
    blocks = blocks_of_texels(corner.texels, part)
    np.testing.assert_array_equal(np.sort(blocks.order), np.arange(part.start, part.stop))
    pose = look_at(np.array([2.0, 1.5, 1.5]), np.zeros(3))
    which = blocks.texels_in_view(camera_at(pose, LENS, *SIZE), MIN_COSINE)
    visible = _visible(corner, pose)
    assert np.isin(visible[(visible >= part.start) & (visible < part.stop)], which).all()
    assert len(which) > 500


def test_frames_that_may_have_pixels_on_some_texels(corner: World):
    """Also where their middles lie beside the image; and few others."""
    texels, rng = corner.texels, np.random.default_rng(3)
    poses = [look_at(rng.uniform(0.05, 3, 3), rng.uniform(-1, 4, 3)) for _ in range(60)]
    frames = replace(frames_at(poses), intrinsics=np.tile(LENS, (60, 1)))
    frames = replace(frames, resolution=np.tile(SIZE, (60, 1)))
    # A narrow strip of coarse texels in a corner of the first wall.
    part = slice(0, 150)
    found = frames_in_view(texels, part, frames, range(10, 60))
    assert found == sorted(set(found))
    assert set(found) <= set(range(10, 60))
    number = np.full(len(texels.nearest_texel), -1)
    number[texels.pixel] = np.arange(len(texels))
    shown = []
    for i in range(10, 60):
        camera = frames.camera(i)
        hits = corner.rays.closest(*camera.rays(camera.pixels()))
        own = hits.face[hits.face >= 0]
        first = np.unique(texels.face[part])
        if np.isin(own, first).any() and len(_visible_any(corner, camera, hits, part, number)):
            shown.append(i)
    assert shown
    assert set(shown) <= set(found)
    assert len(found) < 1.5 * len(shown) + 10


def _visible_any(world: World, camera, hits, part: slice, number: np.ndarray) -> np.ndarray:
    """Pixels that show a place of a texel of ``part``, its face seen at MIN_COSINE or more."""
    texels, scene = world.texels, world.scene
    struck = np.flatnonzero(hits.face >= 0)
    face, u, v = hits.face[struck], hits.u[struck], hits.v[struck]
    weights = np.stack([1 - u - v, u, v], axis=-1)
    place = np.einsum("rc,rcd->rd", weights, texels.corner_pixel[face])
    owner = scene.face_object[face]
    row, column = place[:, 1].astype(int), place[:, 0].astype(int)
    texel = number[texels.first_pixel[owner] + row * texels.resolution[owner, 0] + column]
    to_eye = np.asarray(camera.eye) - texels.position[texel]
    cosine = (to_eye * texels.geometric_normal[texel]).sum(axis=1)
    faces = cosine >= MIN_COSINE * np.linalg.norm(to_eye, axis=1)
    return np.flatnonzero(faces & (texel >= part.start) & (texel < part.stop))
