"""The estimator's loops do what the warps and NumPy say, whatever is traced at a time."""

from __future__ import annotations

import numpy as np
import pytest

from tests.physics.surfaces import World, box, room, world_of
from usdbrdf.options import Sampling
from usdbrdf.transport import irradiance
from usdbrdf.transport.environment import black_environment
from usdbrdf.transport.irradiance import Irradiance, irradiance_at, tiles_of_texels
from usdbrdf.transport.lights import picked
from usdbrdf.transport.sampling_loops import turns
from usdbrdf.transport.surface_texture import AHEAD
from usdbrdf.transport.warps import cosine_direction, in_triangle, on_hemisphere, triangle_point


def _square(rng: np.random.Generator) -> np.ndarray:
    """Random points, with the middle, the corners and the diagonals."""
    special = [(0.5, 0.5), (0.0, 0.0), (1.0, 1.0), (0.25, 0.25), (0.25, 0.75), (0.5, 0.1)]
    return np.concatenate([rng.random((4000, 2)), special])


def test_hemisphere_is_the_warps():
    square = _square(np.random.default_rng(1))
    x, y = square.T.astype(np.float32)
    expected = np.array([cosine_direction(float(a), float(b)) for a, b in zip(x, y, strict=True)])
    z = np.empty_like(x)
    on_hemisphere(x, y, z)
    np.testing.assert_allclose(np.stack([x, y], axis=1), expected[:, :2], rtol=0, atol=3e-7)
    # z loses digits at the horizon, where it is the root of a difference.
    np.testing.assert_allclose(z**2, expected[:, 2] ** 2, rtol=0, atol=3e-7)


def test_triangle_is_the_warps():
    square = _square(np.random.default_rng(2))
    u, v = square.T.astype(np.float32)
    expected = [triangle_point(float(a), float(b)) for a, b in zip(u, v, strict=True)]
    in_triangle(u, v)
    np.testing.assert_allclose(np.stack([u, v], 1), expected, rtol=0, atol=6e-8)


@pytest.mark.parametrize("lights", [1, 2, 37])
def test_picking_is_a_search(lights: int):
    rng = np.random.default_rng(3)
    cumulative = np.cumsum(rng.random(lights) ** 8)
    cumulative /= cumulative[-1]
    steps = np.linspace(0, 1, 8 * lights, endpoint=False)
    guide = np.searchsorted(cumulative, steps, side="right").astype(np.int32)
    picks = np.concatenate([rng.random(2000), steps, cumulative[:-1], [np.nextafter(1, 0)]])
    expected = np.minimum(np.searchsorted(cumulative, picks, side="right"), lights - 1)
    np.testing.assert_array_equal([picked(cumulative, guide, p) for p in picks], expected)


def test_turns_go_through_all_points_and_samples_and_cut_no_group():
    # Groups of 1 to 8 of several hundred points.
    group = np.repeat(np.arange(120), np.arange(120) % 8 + 1).astype(np.int64)
    found = turns(group, 3)
    for sample in range(3):
        own = sorted((first, last) for first, last, s in found if s == sample)
        firsts, lasts = zip(*own, strict=True)
        assert (firsts[0], lasts[-1]) == (0, len(group))
        assert firsts[1:] == lasts[:-1]
        assert all(0 < last - first <= AHEAD for first, last in own)
        assert min(last - first for first, last in own[:-1]) > AHEAD - 8
        assert (group[list(firsts[1:])] != group[np.array(firsts[1:]) - 1]).all()


@pytest.mark.parametrize("estimator", ["mis", "cosine"])
def test_how_many_points_a_thread_takes_does_not_matter(
    monkeypatch: pytest.MonkeyPatch, estimator: str
):
    world = world_of(room((0, 0, 0), (2, 2, 2)) + box((0.8, 0.8, 1.5), (1.2, 1.2, 1.7)))
    lit = np.full((len(world.texels), 3), 0.1, np.float32)
    lit[world.texels.object_index() > 5] = 8
    assert len(world.lights(lit).face)
    sampling = Sampling(estimator=estimator, standard_error=0.05, max_rays=256)

    def found(points: int) -> Irradiance:
        monkeypatch.setattr(irradiance, "_POINTS", points)
        return _shaded(world, lit, sampling)

    whole = found(1 << 20)
    parts = found(16)
    for name, values in vars(whole).items():
        np.testing.assert_array_equal(values, getattr(parts, name), err_msg=name)
    if estimator == "mis":
        assert len(np.unique(whole.rays)) > 1  # some tiles stopped early


def _shaded(world: World, lit: np.ndarray, sampling: Sampling) -> Irradiance:
    order, tile = tiles_of_texels(world.texels)
    return irradiance_at(
        world.rays, world.texture(lit), world.lights(lit), black_environment(),
        world.texels.position[order], world.texels.normal[order], tile, sampling, world.size,
    )  # fmt: skip
