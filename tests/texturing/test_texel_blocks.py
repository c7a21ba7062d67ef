"""Blocks of texels that a frame passes over hold none that it can see."""

from __future__ import annotations

import numpy as np
import pytest

from tests.physics.surfaces import World, quad, world_of
from tests.scenes import camera_at, look_at
from usdbrdf.texturing.observe import blocks_of_texels

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
