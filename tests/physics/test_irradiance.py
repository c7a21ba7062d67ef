"""The two irradiance estimators on a furnished room: same answer, honest error, repeatable."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from tests.physics.chi2 import sidak
from tests.physics.surfaces import World, box, estimates, room, world_of
from usdbrdf.options import Sampling
from usdbrdf.transport.environment import Environment, black_environment
from usdbrdf.transport.irradiance import (
    ByAngle,
    Irradiance,
    _noisy,
    irradiance_at,
    mean_and_error,
    tiles_of_texels,
)
from usdbrdf.transport.lights import Lights

# Quads of the room and its two boxes; those of the lamp follow.
NUM_REFLECTORS = 18


@pytest.fixture(scope="module")
def furnished() -> tuple[World, np.ndarray, Lights]:
    """A room with two boxes and a lamp; every texel has a radiance of its own."""
    parts = (
        room((0, 0, 0), (4, 3, 2.5))
        + box((0.5, 0.6, 0.1), (1.2, 1.4, 0.9))
        + box((2.4, 1.5, 0.2), (3.1, 2.2, 1.3))
        + box((1.6, 1.1, 2.3), (2.4, 1.7, 2.45))
    )
    world = world_of(parts)
    lit = np.random.default_rng(7).uniform(0.05, 0.6, (len(world.texels), 3)).astype(np.float32)
    lit[world.texels.object_index() >= NUM_REFLECTORS] *= 60
    lights = world.lights(lit)
    assert len(lights.face) == 12
    return world, lit, lights


def _shade(furnished, index: np.ndarray, tile: np.ndarray, **sampling) -> Irradiance:
    world, lit, lights = furnished
    return irradiance_at(
        world.rays, world.texture(lit), lights, black_environment(),
        world.texels.position[index], world.texels.normal[index], tile,
        Sampling(**sampling), world.size,
    )  # fmt: skip


def test_both_estimators_agree_on_a_furnished_room(furnished):
    # Welch's t at 24 points and 3 channels, Sidak over all 72.
    world, lit, lights = furnished
    rng = np.random.default_rng(12345)
    pick = rng.choice(
        np.flatnonzero(world.texels.object_index() < NUM_REFLECTORS), 24, replace=False
    )
    at = world.texels.position[pick], world.texels.normal[pick]
    cosine, _ = estimates(world, lit, lights, *at, estimator="cosine", rays=1024, repeat=64)
    mis, _ = estimates(world, lit, lights, *at, estimator="mis", rays=128, repeat=64, seed=9)
    p = stats.ttest_ind(cosine, mis, axis=0, equal_var=False).pvalue
    assert p.min() >= sidak(p.size), f"p = {p.min():.3g} (level {sidak(p.size):.3g})"
    # The comparison resolves half a per cent of S on average over the points.
    both = np.sqrt(cosine.var(axis=0) / 64 + mis.var(axis=0) / 64)
    resolved = np.sqrt(((both / mis.mean(axis=0)) ** 2).mean() / p.size)
    assert resolved < 0.005
    assert abs((cosine.mean(axis=0) / mis.mean(axis=0) - 1).mean()) < 4 * resolved


def test_seeds_matter_and_repetition_does_not(furnished):
    index, tile = np.arange(40), np.arange(40, dtype=np.int32) // 8
    for estimator in ("mis", "cosine"):
        runs = [
            _shade(furnished, index, tile, estimator=estimator, max_rays=128, seed=seed).mean
            for seed in (0, 0, 1)
        ]
        np.testing.assert_array_equal(runs[0], runs[1])
        assert (runs[0] != runs[2]).mean() > 0.99


def test_a_tile_of_whole_tiles_gives_the_bits_of_the_whole(furnished):
    world, _, _ = furnished
    order, tile = tiles_of_texels(world.texels)
    cut = int(np.searchsorted(tile, tile[len(tile) // 2]))
    sampling = {"estimator": "mis", "standard_error": 0.1, "max_rays": 256}
    whole = _shade(furnished, order, tile, **sampling)
    second = _shade(furnished, order[cut:], tile[cut:], **sampling)
    np.testing.assert_array_equal(whole.mean[cut:], second.mean)
    np.testing.assert_array_equal(whole.rays[cut:], second.rays)


def test_patches_are_blocks_of_one_object(furnished):
    texels = furnished[0].texels
    order, tile = tiles_of_texels(texels)
    assert sorted(order) == list(range(len(texels)))
    assert (np.diff(tile) >= 0).all()
    assert (np.diff(tile) <= 1).all()
    owner = texels.object_index()[order]
    for number in np.unique(tile):
        own = tile == number
        assert len(np.unique(owner[own])) == 1
        # 8 x 8 texels of the atlas.
        assert own.sum() <= 64


@pytest.mark.parametrize(("rays", "overstated"), [(64, 0.63), (256, 0.56)])
def test_the_standard_error_of_aimed_rays_is_an_upper_estimate(
    furnished, rays: int, overstated: float
):
    # Sobol points spread more evenly over the whole than over each quarter of the sequence, so the
    # scatter of the four quarters overstates the error of their mean. Measured against replicates:
    # root mean square error / root mean square claim, the smaller the more rays there are.
    world, lit, lights = furnished
    own = np.flatnonzero(world.texels.object_index() < NUM_REFLECTORS)[::4]
    at = world.texels.position[own], world.texels.normal[own]
    replicates, found = estimates(world, lit, lights, *at, estimator="mis", rays=rays, repeat=24)
    true = replicates.var(axis=0, ddof=1).mean()
    claimed = (found.standard_error.astype(np.float64) ** 2).mean()
    assert np.sqrt(true / claimed) == pytest.approx(overstated, abs=0.05)


def test_the_standard_error_of_independent_rays_is_unbiased(furnished):
    # Four blocks of independent rays: the claimed variance has the true one as its mean. Away from
    # the lamp's rare hits (many rays) both agree within the scatter of 108 points x 24 replicates.
    world, lit, lights = furnished
    own = np.flatnonzero(world.texels.object_index() < NUM_REFLECTORS)[::10]
    at = world.texels.position[own], world.texels.normal[own]
    replicates, found = estimates(world, lit, lights, *at, estimator="cosine", rays=512, repeat=24)
    true = replicates.var(axis=0, ddof=1).mean()
    claimed = (found.standard_error.astype(np.float64) ** 2).mean()
    assert true / claimed == pytest.approx(1, abs=0.15)


def test_rays_double_until_the_error_that_was_asked_for(furnished):
    order, tile = tiles_of_texels(furnished[0].texels)
    reached = _shade(furnished, order, tile, standard_error=0.05, max_rays=4096)
    exact = _shade(furnished, order, tile, standard_error=0.0, max_rays=4096, seed=77)
    assert exact.mean.min() > 1e-3
    relative = reached.mean / exact.mean - 1
    assert np.sqrt((relative**2).mean()) < 0.05
    # Stopping on a noisy error must not bend the mean: 6 times below the error itself.
    assert abs(relative.mean()) < 0.008
    assert 64 <= reached.rays.min() < reached.rays.max() <= 4096
    assert reached.rays.mean() < 1000
    # One decision per patch.
    first = np.searchsorted(tile, np.arange(tile[-1] + 1))
    np.testing.assert_array_equal(reached.rays, reached.rays[first][tile])


@pytest.mark.parametrize("with_lights", [True, False])
@pytest.mark.parametrize("max_rays", [8, 16, 48, 100, 1000])
def test_no_texel_gets_more_rays_than_allowed(furnished, with_lights: bool, max_rays: int):
    world, lit, lights = furnished
    if not with_lights:
        lights = world.lights(np.ones_like(lit))
    at = world.texels.position[:64], world.texels.normal[:64]
    replicates, found = estimates(world, lit, lights, *at, estimator="mis", rays=max_rays, repeat=1)
    assert np.isfinite(replicates).all()
    assert found.rays.max() <= max_rays


def test_what_escapes_is_counted_and_sees_the_environment():
    # An open box without its ceiling: from the middle of the floor the opening is a square of
    # half-width 1 at height 1, form factor F (the corner formula); a uniform environment E0 behind
    # it and walls of radiance L_w: S = pi (F E0 + (1 - F) L_w), escaped = F.
    parts = room((-1, -1, 0), (1, 1, 1))
    world = world_of([parts[0], *parts[2:]])
    lit = np.full((len(world.texels), 3), 0.25, np.float32)
    form_factor = 4 / (2 * np.pi) * 2 / np.sqrt(2) * np.arctan(1 / np.sqrt(2))
    sky = Environment(image=np.full((4, 8, 3), 2.0, np.float32), z_up=True)
    lamp = world.lights(world.per_object([(1, 1, 1)] * 4 + [(100, 100, 100)]))
    for lights, estimator in [(lamp, "mis"), (lamp, "cosine"), (world.lights(lit), "mis")]:
        replicates, found = estimates(
            world, lit, lights, np.zeros((1, 3)), np.array([[0.0, 0, 1]]),
            estimator=estimator, rays=256, repeat=256, environment=sky,
        )  # fmt: skip
        expected = np.pi * (form_factor * 2.0 + (1 - form_factor) * 0.25)
        # 1024 independent or better than independent rays per estimate.
        number = found.escaped.size * 128
        error = np.sqrt(form_factor * (1 - form_factor) / number)
        assert abs(found.escaped.mean() - form_factor) < 4 * error
        off = (replicates.mean() - expected) / (replicates.std() / 16)
        assert abs(off) < 3.5


def test_stopping_early_hardly_biases_the_irradiance(furnished):
    # 32 seeds against the whole number of rays; their mean over the points resolves 2.5e-4 of S.
    world, _, _ = furnished
    index = np.arange(0, 8 * (len(world.texels) // 8), len(world.texels) // 256)
    tile = (np.arange(len(index)) // 8).astype(np.int32)
    exact = np.mean(
        [
            _shade(furnished, index, tile, standard_error=0.0, max_rays=4096, seed=s).mean
            for s in range(1000, 1004)
        ],
        axis=0,
    )
    runs = [_shade(furnished, index, tile, seed=s) for s in range(32)]
    assert np.mean([run.rays.mean() for run in runs]) < 1024
    off = np.array([(run.mean.sum() / exact.sum()) - 1 for run in runs])
    resolved = off.std(ddof=1) / np.sqrt(len(off))
    assert resolved < 2.5e-4
    assert abs(off.mean()) < 1e-3, f"{off.mean():.2e} +- {resolved:.1e}"


# The cosine at even knots: a lookup that is linear between them is exact.
COSINE = np.linspace(0, 1, 5, dtype=np.float32)


def test_light_that_counts_by_its_angle_in_the_open():
    # Of uniform light L: integral of L cos^n cos dw = 2 pi L / (n + 2).
    world = world_of(room((0, 0, 0), (1, 1, 1)))
    nothing = np.zeros((len(world.texels), 3), np.float32)
    normal = np.eye(3, dtype=np.float32)[[0, 1, 2, 2]]
    sky = Environment(image=np.full((2, 4, 3), [1, 2, 3], np.float32), z_up=True)
    factor = np.stack([np.ones_like(COSINE), COSINE, -COSINE])
    surface = np.array([0, 1, 1, 2], np.int32)
    found = irradiance_at(
        world.rays, world.texture(nothing), world.lights(nothing), sky,
        np.full((4, 3), 9, np.float32), normal, np.zeros(4, np.int32),
        Sampling(standard_error=0, max_rays=4096), world.size,
        by_angle=ByAngle(factor, surface),
    ).mean  # fmt: skip
    of_angle = np.array([np.pi, 2 * np.pi / 3, 2 * np.pi / 3, -2 * np.pi / 3])
    np.testing.assert_allclose(found, of_angle[:, None] * [1, 2, 3], rtol=3e-3)


def test_light_that_counts_by_its_angle_comes_to_the_same_by_either_technique(furnished):
    world, lit, lights = furnished
    rng = np.random.default_rng(5)
    pick = rng.choice(np.flatnonzero(world.texels.object_index() < NUM_REFLECTORS), 48)
    tile, surface = np.arange(48, dtype=np.int32), np.zeros(48, np.int32)
    factor = np.stack([COSINE])

    def found(estimator: str, rays: int, by_angle: ByAngle | None) -> np.ndarray:
        return irradiance_at(
            world.rays, world.texture(lit), lights, black_environment(),
            world.texels.position[pick], world.texels.normal[pick], tile,
            Sampling(estimator=estimator, standard_error=0, max_rays=rays), world.size,
            by_angle=by_angle,
        ).mean.mean(axis=0)  # fmt: skip

    by_angle = ByAngle(factor, surface)
    mis = found("mis", 1 << 13, by_angle)
    np.testing.assert_allclose(found("cosine", 1 << 16, by_angle), mis, rtol=0.01)
    whole = found("mis", 1 << 13, None)
    assert (mis < 0.95 * whole).all()
    alike = ByAngle(np.ones((1, 2), np.float32), surface)
    np.testing.assert_allclose(found("mis", 1 << 13, alike), whole, rtol=1e-5)


def _told_to_go_on(error: float, *, dark: float = 0.0) -> np.ndarray:
    """Of three tiles, of which the second errs so, asked for 10 %."""
    tile = np.array([4, 4, 5, 5, 5, 7])
    mean = np.array([[1, 2, 3], [3, 4, 5], [2, 2, 2], [0, 1, 2], [3, 4, 5], [0, 0, 0]], float)
    errors = np.full((6, 3), 1e-3)
    # Squares add up over three points and channels: their mean is that of the tile.
    errors[2:5] = 0
    errors[3] = error * np.sqrt(3) * np.array([1, 1, 1])
    return _noisy(tile, mean, errors, 0.1, np.full(6, dark))


def test_a_tile_goes_on_while_its_error_is_more_than_asked_for_of_its_mean():
    # The second's mean is (2 + 1 + 4) / 3; the third is dark, so that any error is too much.
    level = 7 / 3
    assert _told_to_go_on(0.1 * level * 1.001).tolist() == [False] * 2 + [True] * 4
    assert _told_to_go_on(0.1 * level * 0.999).tolist() == [False] * 5 + [True]
    # Where less than that is dark, the error counts against that.
    assert _told_to_go_on(0.5 * 0.999, dark=5.0).tolist() == [False] * 6
    assert _told_to_go_on(0.5 * 1.001, dark=5.0).tolist() == [False] * 2 + [True] * 3 + [False]


def test_mean_and_error_are_those_of_four_blocks_of_both_techniques():
    sums = np.random.default_rng(5).uniform(0, 9, (2, 4, 7, 4))
    mean, error = mean_and_error(sums, 32)
    blocks = sums.sum(axis=0)[..., :3] / 8
    np.testing.assert_allclose(mean, blocks.mean(axis=0))
    np.testing.assert_allclose(error, blocks.std(axis=0, ddof=1) / 2)
