"""Which tiles' specular light is averaged: those that turn the mirrored direction by less than half
of the lobe's width; reckoned on one tile of four by four texels of 0.1 m."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.physics.surfaces import World, quad, world_of
from usdbrdf.material.conductor import _least_squares, _size, _without_means
from usdbrdf.material.sample_specular import _shared

FAR = np.array([0.2, 0.2, 1e7])


@pytest.fixture(scope="module")
def world() -> World:
    """Two tiles, side by side."""
    return world_of([quad((0, 0, 0), (0.8, 0, 0), (0, 0.4, 0), (8, 4))])


TILE = np.array([8 * row + column for row in range(4) for column in range(4)], np.int32)


def _is_shared(texels: Any, phi: float, eye: Any, texel: Any = TILE) -> bool:
    specular = np.random.default_rng(1).random((len(texel), 3)).astype(np.float32)
    found = _shared(texels, np.full(len(texel), phi, np.float32), texel, eye, specular)
    mean = np.broadcast_to(specular.mean(axis=0), found.shape)
    shared = np.allclose(found, mean, rtol=1e-5)
    assert shared or np.array_equal(found, specular)
    return shared


@pytest.mark.parametrize(("phi", "shared"), [(0.0426, True), (0.0422, False)])
def test_near_eyes_see_the_corners_of_a_tile_turned(world: World, phi: float, shared: bool):
    """From 10 m the corners, 0.2121 m from the middle, are turned by 0.0212."""
    position = world.texels.position[TILE].astype(np.float64)
    eye = position.mean(axis=0) + np.array((0, 0, 10))
    off = np.linalg.norm(position - position.mean(axis=0), axis=1)
    assert (off / np.linalg.norm(position - eye, axis=1)).max() == pytest.approx(0.0212, abs=2e-4)
    assert _is_shared(world.texels, phi, eye) == shared


@pytest.mark.parametrize(("phi", "shared"), [(0.205, True), (0.195, False)])
def test_normals_turn_what_is_mirrored_by_twice_as_much(world: World, phi: float, shared: bool):
    """Of 0.05 to either side, by 0.1."""
    normal = world.texels.normal.copy()
    normal[TILE, 0] = np.where(np.arange(16) % 2, 0.05, -0.05)
    assert _is_shared(replace(world.texels, normal=normal), phi, FAR) == shared


@pytest.mark.parametrize(("off", "shared"), [(0.39, True), (0.41, False)])
def test_charts_farther_apart_than_a_tile_is_long_are_not_mixed(
    world: World, off: float, shared: bool
):
    position = world.texels.position.copy()
    position[TILE] = [[off if k % 2 else -off, 0, 0] for k in range(16)]
    area = np.full(len(position), 0.01, np.float32)
    texels = replace(world.texels, position=position, area=area)
    assert _is_shared(texels, 1.0, FAR) == shared


def test_each_tile_and_each_colour_has_a_mean_of_its_own(world: World):
    texel = np.arange(32, dtype=np.int32)
    specular = np.random.default_rng(2).random((32, 3)).astype(np.float32)
    phi = np.where(texel % 8 < 4, 1.0, 1e-9).astype(np.float32)
    found = _shared(world.texels, phi, texel, FAR * 1e-3, specular)
    left = texel % 8 < 4
    wanted = np.where(left[:, None], specular[left].mean(axis=0), specular)
    np.testing.assert_allclose(found, wanted, rtol=1e-5)


def test_reflectances_are_products_of_what_has_independent_noise():
    """Of one sample: v (a + b) / 2 a b, whichever basis is which; within none and all."""
    one, other = np.array([[1.0, 2.0, 1.0]]), np.array([[0.8, 1.0, 1.5]])
    dark = np.array([[0.1, 0.0, 0.2]]), np.array([[0.0, 0.3, 0.1]])
    seen = np.array([[0.5, 0.6, 0.4]])
    crossed = (seen - dark[0]) * other + (seen - dark[1]) * one
    wanted = (crossed / 2 / (one * other))[0]
    np.testing.assert_allclose(_least_squares(seen, dark, (one, other)), wanted)
    np.testing.assert_allclose(_least_squares(seen, dark[::-1], (other, one)), wanted)
    none = 0 * one, 0 * one
    bright = _least_squares(np.array([[1.3, 0.7, -0.2]]), none, (one, one / one))
    np.testing.assert_allclose(bright, [1, 0.7 * 3 / 4, 0])
    assert np.isfinite(_least_squares(seen, none, none)).all()


def test_a_sample_that_is_far_off_draws_nothing_off():
    """Of ten that agree about a half one shows a lamp."""
    seen = np.full((10, 3), 0.5)
    seen[3] = 40
    one = np.ones((10, 3))
    found = _least_squares(seen, (0 * one, 0 * one), (one, one))
    np.testing.assert_allclose(found, 0.5, rtol=1e-12)


def test_what_is_left_is_measured_across_both_and_cut_at_its_own_size():
    one, other = np.array([[0.3, -0.4, 5.0]]), np.array([[0.1, -0.2, 0.5]])
    assert _size(one, other) == pytest.approx(np.sqrt((0.03 + 0.08 + 0.5) / 3))
    assert _size(-one, -other) == pytest.approx(np.sqrt((0.03 + 0.08 + 0.5) / 3))
    # Noise that cancels is no less than the least.
    assert _size(one, -other) == _size(0 * one, other) > 0


def test_means_of_texels_are_taken_off():
    texel, views = np.array([0, 1, 0, 1, 1]), np.array([2, 3])
    values = np.array([[1.0, 2], [3, 4], [5, 0], [0, 1], [3, 1]])
    wanted = values - np.array([[3.0, 1], [2, 2]])[texel]
    np.testing.assert_allclose(_without_means(values, texel, views), wanted)
