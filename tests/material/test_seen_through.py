"""A pane reflects as surfaces do, but shows what its rays meet behind it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.physics.surfaces import Part, World, quad, room, world_of
from usdbrdf.material.seen_through import (
    NOTHING,
    Through,
    _least_squares,
    radiance_behind,
    seen_through,
)
from usdbrdf.material.verdict import MOST_OF_MEASURED
from usdbrdf.material.view_model import ViewSamples
from usdbrdf.transport.brdf import F0_OF_PSI
from usdbrdf.transport.environment import Environment
from usdbrdf.transport.lit_scene import LitScene, points_of_texels

PANE, VIEWS = 6, 12
PHI, PSI, PSI_OF_METAL = 0.2, 0.3, 9.0


def _slab(depth: float) -> Part:
    """A pane of 2 by 1.2 whose both sides are one object."""
    front = quad((1, 1.5, 0.6), (2, 0, 0), (0, 0, 1.2))
    back = quad((1, 1.5 + depth, 0.6), (0, 0, 1.2), (2, 0, 0))
    half = np.array([0.5, 1])
    return Part(
        points=np.concatenate([front.points, back.points]),
        triangles=np.concatenate([front.triangles, back.triangles + 4]).astype(np.int32),
        uv=np.concatenate([front.uv * half, back.uv * half + (0.5, 0)]),
        normals=np.concatenate([front.normals, back.normals]),
        size=(32, 16),
    )


def _pattern(position: np.ndarray) -> np.ndarray:
    waves = np.sin(position @ np.array([[5.0, 2, 3], [1, 3, 2], [4, 5, 6]]))
    return (0.5 + 0.3 * waves).astype(np.float32)


def _world(walls: slice = slice(None)) -> World:
    return world_of([*room((0, 0, 0), (4, 3, 2.5), (96, 96))[walls], _slab(0.02)])


def _eyes() -> np.ndarray:
    across = np.linspace(0.4, 3.6, VIEWS)
    return np.stack([across, 0.3 + 0 * across, 1.2 + 0.3 * np.sin(3 * across)], axis=1)


def _views(world: World, pane: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Texels of the pane's front, each with every frame: texel, frame, eye."""
    front = world.texels.object_index() == pane
    front &= np.abs(world.texels.position[:, 1] - 1.5) < 1e-3
    texel = np.repeat(np.flatnonzero(front), VIEWS)
    frame = np.tile(np.arange(VIEWS), int(front.sum()))
    return texel, frame, _eyes()[frame]


@pytest.fixture(scope="module")
def lit() -> LitScene:
    world = _world()
    return world.lit(_pattern(world.texels.position))


def test_rays_go_on_through_both_sides_of_a_pane(lit: LitScene):
    world = _world()
    texel, _, eye = _views(world, PANE)
    points = points_of_texels(world.texels, texel, eye)
    found = radiance_behind(lit, points, PANE)
    direction = -points.to_camera
    reach = (3 - points.position[:, 1]) / direction[:, 1]
    place = points.position + reach[:, None] * direction
    on_wall = (place > 0.1).all(axis=1) & (place[:, 0] < 3.9) & (place[:, 2] < 2.4)
    assert on_wall.mean() > 0.4
    np.testing.assert_allclose(found[on_wall], _pattern(place[on_wall]), atol=0.01)


def test_what_misses_everything_shows_the_surroundings():
    world = _world(slice(0, 1))  # a floor and the pane
    sky = Environment(np.full((2, 4, 3), 7.0, np.float32), z_up=True)
    lit = world.lit(_pattern(world.texels.position), environment=sky)
    texel, _, eye = _views(world, 1)
    points = points_of_texels(world.texels, texel, eye)
    found = radiance_behind(lit, points, 1)
    up = points.to_camera[:, 2] < 0
    assert up.any()
    assert (found[up] == 7).all()
    assert (found[~up] <= 7).all()
    assert (found < 1).any()


def test_past_panes_it_shows_the_surroundings(lit: LitScene):
    """What frames saw on the panes is the mean over all directions."""
    sky = Environment(np.full((2, 4, 3), 7.0, np.float32), z_up=True)
    lit = replace(lit, environment=sky, panes=tuple(range(PANE)))
    texel, _, eye = _views(_world(), PANE)
    assert (radiance_behind(lit, points_of_texels(lit.texels, texel, eye), PANE) == 7).all()


def _through(
    lit: LitScene, share: float, seed: int, psi: float = PSI, most_psi: float = 1.0
) -> Through:
    """Of samples of a patterned, shining surface that lets a share of what is behind through."""
    random, world = np.random.default_rng(seed), _world()
    texel, frame, eye = _views(world, PANE)
    points = points_of_texels(world.texels, texel, eye)
    behind = radiance_behind(lit, points, PANE)
    mirrored = points.to_camera * (-1, 1, -1)
    lamp = np.array([0.3, 0.8, 0.52])
    slope = np.exp(-((mirrored + lamp) ** 2).sum(axis=1) / 0.1)[:, None] * np.ones(3)
    seen = _pattern(world.texels.position[texel]) + psi * slope + share * behind
    seen *= 1 + 0.02 * random.standard_normal(VIEWS)[frame, None]
    seen *= 1 + 0.02 * random.standard_normal(seen.shape)
    samples = ViewSamples(
        texel=np.unique(texel, return_inverse=True)[1].astype(np.int64),
        frame=frame.astype(np.int64),
        position=points.position,
        radiance=seen.astype(np.float32),
        noise=np.full(seen.shape, 0.005, np.float32),
        cell=0.1,
    )
    base = np.zeros((len(texel), 3, 1), np.float32)
    slope = slope.astype(np.float32)[..., None]
    return seen_through(samples, behind, lambda _: (base, slope), PHI, psi, most_psi)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("share", [0.0, 0.4, 0.9])
def test_the_share_that_shows_through_is_found(lit: LitScene, share: float, seed: int):
    found = _through(lit, share, seed)
    assert abs(found.share - share) < max(3 * found.error, 0.01)
    assert found.error < 0.05
    assert (found.at_least > MOST_OF_MEASURED) == (share > MOST_OF_MEASURED)


@pytest.mark.parametrize("share", [0.0, 0.4])
def test_what_a_metal_mirrors_is_told_from_what_is_behind(lit: LitScene, share: float):
    found = _through(lit, share, 0, PSI_OF_METAL, 1 / F0_OF_PSI)
    assert abs(found.share - share) < max(3 * found.error, 0.01)
    # As a dielectric that shines no more than one does, its mirror image would be an error.
    assert found.error < 0.5 * _through(lit, share, 0, PSI_OF_METAL).error


def test_behind_what_looks_alike_from_everywhere_nothing_tells(lit: LitScene):
    random = np.random.default_rng(1)
    texel = np.repeat(np.arange(40), VIEWS)
    samples = ViewSamples(
        texel=texel,
        frame=np.tile(np.arange(VIEWS), 40),
        position=random.random((len(texel), 3)).astype(np.float32),
        radiance=random.random((len(texel), 3)).astype(np.float32),
        noise=np.full((len(texel), 3), 0.01, np.float32),
        cell=0.1,
    )
    behind = random.random((40, 3)).astype(np.float32)[texel]
    none = np.zeros((len(texel), 3, 1), np.float32)
    found = seen_through(samples, behind, lambda _: (none, none), PHI, PSI)
    assert found.at_least == 0


def _shown(behind: np.ndarray, share: float, own: float) -> Through:
    """Of samples that show their own light, alike from everywhere, and a share of what is behind,
    as it varies about its mean."""
    texel = np.repeat(np.arange(40), VIEWS)
    seen = own + share * (behind - behind.mean())
    seen *= 1 + 0.001 * np.random.default_rng(2).standard_normal(seen.shape)
    samples = ViewSamples(
        texel=texel,
        frame=np.tile(np.arange(VIEWS), 40),
        position=np.random.default_rng(3).random((len(texel), 3)).astype(np.float32),
        radiance=seen.astype(np.float32),
        noise=np.full(seen.shape, 1e-4, np.float32),
        cell=0.1,
    )
    none = np.zeros((len(texel), 3, 1), np.float32)
    return seen_through(samples, behind.astype(np.float32), lambda _: (none, none), PHI, PSI)


def test_of_darkness_much_may_show_through_that_is_next_to_nothing():
    """The front of a cupboard was told to be glass by what is in it."""
    behind = np.random.default_rng(4).uniform(0.01, 0.03, (40 * VIEWS, 3))
    found = _shown(behind, 0.6, 1.0)
    assert found.share == pytest.approx(0.6, abs=0.05)
    assert found.behind == pytest.approx(0.02, rel=0.1)
    assert found.at_least < 0.02


def test_of_a_pane_before_mostly_dark_things_what_is_bright_counts():
    behind = np.random.default_rng(4).uniform(4, 12, (40, VIEWS, 3))
    behind[:25] *= 1e-3
    behind = behind.reshape(-1, 3)
    found = _shown(behind, 0.9, 0.2 + 0.9 * behind.mean())
    assert found.share == pytest.approx(0.9, rel=0.1)
    assert found.at_least > 0.8


def test_no_more_shows_through_than_there_is_light():
    behind = np.random.default_rng(4).uniform(4.9, 5.1, (40 * VIEWS, 3))
    assert _shown(behind, 0.6, 1.0).share == pytest.approx(0.2, rel=0.01)
    assert _shown(behind, 0.6, 4.0).share == pytest.approx(0.6, rel=0.05)


class Plain:
    """A model of samples that err alike: products are sums."""

    def reduced(self, values):
        self.values = values
        return self

    def parts(self, count):
        assert count == self.values.shape[2]
        return tuple(np.moveaxis(self.values, 2, 0))

    def product(self, one, other):
        return np.array([(one * other).sum()])


@pytest.mark.parametrize(
    ("psi", "share"), [(0.3, 0.4), (0.7, 0.1), (0.2, 1.4), (0.6, -0.5), (1.3, 0.5), (-0.4, 0.8)]
)
def test_both_factors_are_those_of_least_squares(psi, share):
    random = np.random.default_rng(3)
    lobe, behind = random.uniform(0, 1, (2, 40, 3))
    behind += lobe  # so that neither is told without the other
    rest = psi * lobe + share * behind + 0.01 * random.standard_normal((40, 3))
    columns = np.stack([lobe.ravel(), behind.ravel()], axis=1)
    free = np.linalg.lstsq(columns, rest.ravel(), rcond=None)[0]
    found, through = _least_squares(Plain(), rest, lobe, behind)
    assert through.share == pytest.approx(np.clip(free[1], 0, 1))
    assert through.error == pytest.approx(np.sqrt(np.linalg.inv(columns.T @ columns)[1, 1]))
    # Once one is held the other is what is best beside it.
    left = rest - through.share * behind
    assert found == pytest.approx(max((left * lobe).sum() / (lobe**2).sum(), 0))


def test_what_looks_as_the_lobe_does_or_is_not_there_tells_nothing():
    random = np.random.default_rng(3)
    lobe, none = random.uniform(0, 1, (40, 3)), np.zeros((40, 3))
    for behind in (2 * lobe, none):
        assert _least_squares(Plain(), 0.3 * lobe, lobe, behind) == (pytest.approx(0.3), NOTHING)
    psi, through = _least_squares(Plain(), 0.3 * lobe, none, lobe)
    assert (psi, through.share) == (0.0, pytest.approx(0.3))
    assert through.error == pytest.approx(1 / np.sqrt((lobe**2).sum()))
