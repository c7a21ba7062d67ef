"""Every sampler draws from the density it claims: chi-square against the integrated density."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from tests.physics.chi2 import (
    SIGNIFICANCE,
    assert_distributed,
    chi_square_p,
    expected_in_cells,
    sidak,
)
from tests.physics.surfaces import disc, quad, world_of
from usdbrdf.transport.brdf import distribution, half_vector, reflected_density, sample_half_vector
from usdbrdf.transport.warps import (
    cosine_direction,
    hashed_uniform,
    shifts_of,
    sobol_bits,
    tangent_frame,
    triangle_point,
)

NUMBER = 100_000


def _pairs(number: int = NUMBER) -> np.ndarray:
    return np.random.default_rng(12345).random((number, 2))


def _azimuth(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.arctan2(y, x) % (2 * np.pi)


# ------------------------------------------------------------------------------- the test itself


def test_chi_square_accepts_the_truth_and_sees_a_slightly_wrong_density():
    x = np.sqrt(_pairs())  # density 4 a b on the unit square
    edges = np.linspace(0, 1, 17)
    counts = np.histogram2d(*x.T, bins=[edges, edges])[0]
    right = expected_in_cells(lambda a, b: 4 * a * b, edges, edges)
    assert right.sum() == pytest.approx(1)
    assert chi_square_p(counts, NUMBER * right) > SIGNIFICANCE
    # A density that leans 5 % too little: p must be tiny.
    wrong = expected_in_cells(lambda a, b: 1.95**2 * a**0.95 * b**0.95, edges, edges)
    assert chi_square_p(counts, NUMBER * wrong) < 1e-6


def test_sidak_keeps_the_chance_of_any_false_alarm():
    for tests in (1, 7, 1000):
        assert 1 - (1 - sidak(tests)) ** tests == pytest.approx(SIGNIFICANCE)


# ------------------------------------------------------------------------------------- directions


def test_cosine_directions():
    w = np.array([cosine_direction(*u) for u in _pairs()])
    np.testing.assert_allclose((w**2).sum(axis=1), 1, atol=1e-12)
    assert w[:, 2].min() >= 0
    # Solid angle in (cos, azimuth) has Jacobian 1, so the density is cos / pi itself.
    cosines, azimuths = np.linspace(0, 1, 17), np.linspace(0, 2 * np.pi, 33)
    expected = expected_in_cells(lambda c, _: c / np.pi, cosines, azimuths)
    assert expected.sum() == pytest.approx(1)
    counts = np.histogram2d(w[:, 2], _azimuth(w[:, 0], w[:, 1]), bins=[cosines, azimuths])[0]
    assert_distributed([chi_square_p(counts, NUMBER * expected)])


def test_the_concentric_map_takes_its_borders():
    # Corners, centre and edges of the square: unit vectors, none NaN.
    ends = [0.0, 0.5, np.nextafter(1.0, 0.0)]
    for u1 in ends:
        for u2 in ends:
            w = cosine_direction(u1, u2)
            assert np.linalg.norm(w) == pytest.approx(1)
    assert cosine_direction(0.5, 0.5) == (0.0, 0.0, 1.0)


@pytest.mark.parametrize("alpha", [0.001, 0.05, 0.4, 1.0])
def test_half_vectors_follow_d_cos(alpha: float):
    # Chart: t = log(tan(theta) / alpha) and azimuth. dw = sin dtheta dazimuth and
    # dtheta = sin cos dt, so the density is D cos * sin^2 cos.
    def density(t: np.ndarray, _: np.ndarray) -> np.ndarray:
        tangent = alpha * np.exp(t)
        cosine = 1 / np.sqrt(1 + tangent**2)
        sine2 = (tangent * cosine) ** 2
        d = np.vectorize(distribution)(sine2, alpha)
        return d * cosine * sine2 * cosine

    h = np.array([sample_half_vector(*u, alpha) for u in _pairs()])
    np.testing.assert_allclose((h**2).sum(axis=1), 1, atol=1e-12)
    scaled = np.hypot(h[:, 0], h[:, 1]) / h[:, 2] / alpha
    logs, azimuths = np.linspace(-9, 14, 47), np.linspace(0, 2 * np.pi, 17)
    expected = expected_in_cells(density, logs, azimuths)
    assert expected.sum() == pytest.approx(1, abs=1e-6)
    counts = np.histogram2d(np.log(scaled), _azimuth(h[:, 0], h[:, 1]), bins=[logs, azimuths])[0]
    assert_distributed([chi_square_p(counts, NUMBER * expected)])


@pytest.mark.parametrize("theta", [10, 45, 75])
@pytest.mark.parametrize("alpha", [0.15, 0.4, 1.0])
def test_reflected_directions_follow_the_density_of_the_reflection(alpha: float, theta: float):
    # w = reflection of wo about h; the map from the half vectors of the hemisphere to directions of
    # the whole sphere is one to one, so the density integrates to one over the sphere.
    n = np.array([0.0, 0, 1])
    wo = np.array([np.sin(np.radians(theta)), 0, np.cos(np.radians(theta))])
    h = np.array([sample_half_vector(*u, alpha) for u in _pairs()])
    w = 2 * (h @ wo)[:, None] * h - wo

    def density(cosine: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
        sine = np.sqrt(1 - cosine**2)
        grid = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=-1)
        values = [
            reflected_density(*half_vector(n, direction, wo), alpha)
            for direction in grid.reshape(-1, 3)
        ]
        return np.reshape(values, cosine.shape)

    cosines, azimuths = np.linspace(-1, 1, 25), np.linspace(0, 2 * np.pi, 33)
    expected = expected_in_cells(density, cosines, azimuths, order=6)
    # The density has the pole 1 / (w.h) where w.h = 0, around w = -wo: integrated to 1 %. There
    # the lobe brings nothing (below the horizon); the cells above are compared.
    assert expected.sum() == pytest.approx(1, abs=0.01)
    counts = np.histogram2d(w[:, 2], _azimuth(w[:, 0], w[:, 1]), bins=[cosines, azimuths])[0]
    above = cosines[:-1] >= 0
    seen = np.append(counts[above], counts[~above].sum())
    wanted = np.append(expected[above], 1 - expected[above].sum())
    assert_distributed([chi_square_p(seen, NUMBER * wanted)])


# ------------------------------------------------------------------------------ points on lights


def test_points_of_a_triangle_are_uniform():
    u, v = np.array([triangle_point(*pair) for pair in _pairs()]).T
    assert min(u.min(), v.min(), (1 - u - v).min()) >= 0
    # In (s, t) with s = u + v, t = v / s the uniform density 2 becomes 2 s.
    edges = np.linspace(0, 1, 17)
    expected = expected_in_cells(lambda s, _: 2 * s, edges, edges)
    counts = np.histogram2d(u + v, v / (u + v), bins=[edges, edges])[0]
    assert_distributed([chi_square_p(counts, NUMBER * expected)])


def test_lights_are_picked_with_the_density_they_report():
    # A bright disc of many triangles, a brighter quad, and a large dim surface that is no light.
    parts = [
        disc((0, 0, 2), 0.6, -1, segments=24),
        quad((2, 0, 2), (0, 0.5, 0), (0.3, 0, 0)),
        quad((-9, -9, 0), (18, 0, 0), (0, 18, 0)),
    ]
    world = world_of(parts)
    lights = world.lights(world.per_object([(20, 10, 5), (60, 60, 60), (0.1, 0.1, 0.1)]))
    assert sorted(lights.face) == list(range(26))
    corners = lights.corners.astype(np.float64)
    area = (
        np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        / 2
    )
    # A density over area: it integrates to one, and vanishes on what is no light.
    assert (lights.density[:26] * area).sum() == pytest.approx(1, rel=1e-6)
    assert (lights.density[26:] == 0).all()
    # In proportion to radiance: the quad's three times the disc's (of the largest channels).
    assert lights.density[24] == pytest.approx(3 * lights.density[0], rel=1e-5)
    # The pick that the estimators make has the probability density * area.
    assert lights.cumulative[-1] == pytest.approx(1)
    pick = np.random.default_rng(12345).random(NUMBER)
    which = np.searchsorted(lights.cumulative, pick, side="right")
    share = lights.density[:26] * area
    counts = np.bincount(which, minlength=26)
    assert_distributed([chi_square_p(counts, NUMBER * share / share.sum())])
    np.testing.assert_allclose(np.diff(lights.cumulative, prepend=0), share, rtol=1e-5)


def test_no_light_where_nothing_is_much_brighter_than_the_rest():
    world = world_of([quad((0, 0, 0), (1, 0, 0), (0, 1, 0)), quad((0, 0, 1), (1, 0, 0), (0, 1, 0))])
    for radiance in ([(1, 1, 1), (2, 2, 2)], [(0, 0, 0), (0, 0, 0)]):
        lights = world.lights(world.per_object(radiance))
        assert len(lights.face) == 0
        assert (lights.density == 0).all()


# --------------------------------------------------------------------------------- random numbers


@pytest.mark.parametrize("varies", ["seed", "index", "draw"])
def test_hashed_numbers_are_uniform_and_independent_of_their_neighbours(varies: str):
    place = ("seed", "index", "draw").index(varies)
    p_values = []
    for start in (0, 1 << 20):
        numbers = []
        for i in range(40_000):
            arguments = [3, 5, 7]
            arguments[place] = start + i
            numbers.append(hashed_uniform(*arguments))
        x = np.array(numbers)
        assert x.min() >= 0
        assert x.max() < 1
        p_values.append(chi_square_p(np.histogram(x, 100, (0, 1))[0], np.full(100, 400.0)))
        # Pairs of successive values fill the square evenly.
        for lag in (1, 2):
            pairs = np.histogram2d(x[:-lag], x[lag:], bins=20, range=[[0, 1], [0, 1]])[0]
            p_values.append(chi_square_p(pairs, np.full((20, 20), (len(x) - lag) / 400)))
    assert_distributed(p_values)


def test_streams_of_different_seeds_and_points_do_not_correlate():
    def stream(seed: int, index: int) -> np.ndarray:
        return np.array([hashed_uniform(seed, index, draw) for draw in range(4000)])

    base = stream(0, 1)
    others = [stream(1, 1), stream(0, 2), stream(0, 0), stream(1, 0), stream(2, 1)]
    p = [stats.pearsonr(base, other).pvalue for other in others]
    assert_distributed(p)
    # No stream is another one, shifted.
    for other in others:
        assert len(np.intersect1d(base, other)) == 0


def test_the_first_number_of_all_is_no_special_one():
    # Exactly 0 is a direction in the horizon, which the estimator drops: the finaliser alone maps
    # 0 to 0.
    assert hashed_uniform(0, 0, 0) > 0
    assert len({hashed_uniform(s, i, d) for s in (0, 1) for i in (0, 1) for d in (0, 1)}) == 8


def test_shifts_of_different_seeds_and_numbers_differ():
    first, second = shifts_of(np.arange(50), 5, 1), shifts_of(np.arange(50), 5, 2)
    assert len(np.unique(np.concatenate([first, second]))) == 500
    np.testing.assert_array_equal(first, shifts_of(np.arange(50), 5, 1))
    counts = np.histogram(shifts_of(np.arange(4000), 5, 3), 100, (0, 1))[0]
    assert_distributed([chi_square_p(counts, np.full(100, 200.0))])


@pytest.mark.parametrize("log2_count", [0, 1, 5, 12])
def test_sobol_points_are_those_of_scipy(log2_count):
    points = stats.qmc.Sobol(2, scramble=False).random_base2(log2_count)
    np.testing.assert_array_equal(sobol_bits(log2_count), points * 2.0**32)


def test_sobol_points_stratify_both_dimensions_and_their_pair():
    # A (t, m, s)-net: 2^10 points put one point into each of 1024 intervals in every dimension,
    # and at most a few into each cell of a 32 x 32 grid.
    points = sobol_bits(10) * 2.0**-32
    assert points.shape == (1024, 2)
    for d in range(2):
        assert (np.bincount((points[:, d] * 1024).astype(int)) == 1).all()
    cells = np.histogram2d(points[:, 0], points[:, 1], bins=32, range=[[0, 1], [0, 1]])[0]
    assert (cells == 1).all()


# ---------------------------------------------------------------------------------------- frames


def test_tangent_frames_are_orthonormal_and_right_handed():
    rng = np.random.default_rng(12345)
    normals = rng.standard_normal((500, 3))
    # Around the pole at -z, where the older formula divides by zero, and on it.
    near = np.stack(
        [1e-5 * rng.standard_normal(100), 1e-5 * rng.standard_normal(100), -np.ones(100)]
    )
    special = [
        [0, 0, -1],
        [0, 0, 1],
        [0, 0, -1.0],
        [1, 0, 0],
        [0, -1, 0],
        [0, 1, -0.0],
        [1, 0, -1e-9],
    ]
    normals = np.concatenate([normals, near.T, special])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for n in [*normals, *normals.astype(np.float32)]:
        frame = np.array(tangent_frame(n)).reshape(2, 3)
        basis = np.concatenate([frame, [n]])
        tolerance = 1e-12 if n.dtype == np.float64 else 2e-6
        np.testing.assert_allclose(basis @ basis.T, np.eye(3), atol=tolerance)
        assert np.linalg.det(basis) == pytest.approx(1, abs=3 * tolerance)
