"""What must hold of any scene: laws of the lobe, and what no choice of coordinates, numbering,
triangles or units may change. Scenes and directions are drawn by Hypothesis, always the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.physics.surfaces import Part, World, box, estimates, quad, room, world_of
from tests.scenes import camera_at, look_at
from usdbrdf.options import Sampling
from usdbrdf.texturing.samples import SAMPLE, Picture, first_surfaces, samples_from_frame
from usdbrdf.transport.brdf import (
    CONDUCTOR,
    DIELECTRIC,
    F0_OF_PSI,
    MIN_ALPHA,
    PAPER,
    lobe,
    reflectance,
    reflected_density,
    sample_half_vector,
)
from usdbrdf.transport.environment import black_environment
from usdbrdf.transport.irradiance import irradiance_at, tiles_of_texels

always = settings(max_examples=40, deadline=None, derandomize=True, database=None)
few = settings(max_examples=5, deadline=None, derandomize=True, database=None)

share = st.floats(0, 1)
cosines = st.floats(1e-3, 1)
turns = st.floats(0, 2 * np.pi)
Z = np.array([0.0, 0.0, 1.0])


def _direction(cosine: float, turn: float) -> np.ndarray:
    sine = np.sqrt(1 - cosine**2)
    return np.array([sine * np.cos(turn), sine * np.sin(turn), cosine])


@st.composite
def rotations(draw) -> np.ndarray:
    """(3, 3), by a quaternion."""
    q = np.array(draw(st.tuples(st.floats(0.01, 1), *[st.floats(-1, 1)] * 3)))
    w, x, y, z = q / np.linalg.norm(q)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


# The lobe


@always
@given(cosines, cosines, turns, share)
def test_light_takes_either_way_alike_and_is_never_negative(there, back, turn, phi):
    w, wo = _direction(there, 0.0), _direction(back, turn)
    one, other = lobe(Z, w, wo, phi), lobe(Z, wo, w, phi)
    assert np.isfinite(one).all()
    assert min(one) >= 0
    np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-300)


@always
@given(rotations(), cosines, cosines, turns, st.floats(0.02, 1))
def test_only_the_angles_between_directions_count(turned, there, back, turn, phi):
    w, wo = _direction(there, 0.0), _direction(back, turn)
    np.testing.assert_allclose(
        lobe(turned @ Z, turned @ w, turned @ wo, phi), lobe(Z, w, wo, phi), rtol=1e-6, atol=1e-12
    )


@always
@given(share, share)
def test_no_mirror_reflects_more_than_all_or_less_than_nothing(cosine, f0):
    for kind, most in ((PAPER, 1.0), (CONDUCTOR, 1.0), (DIELECTRIC, F0_OF_PSI)):
        base, rise = reflectance(cosine, kind)
        # Beyond the psi through which it is drawn, the dielectric's line may miss by rounding.
        assert -1e-3 <= base + most * f0 * rise <= 1 + 1e-3
        assert rise >= -1e-3


@settings(always, max_examples=15)
@given(st.floats(0.05, 1), share, share)
def test_no_more_light_leaves_than_arrives(cosine, phi, psi):
    """By the package's own way to draw directions: the mean of f cos / density."""
    wo, alpha = _direction(cosine, 0.0), max(MIN_ALPHA, phi)
    sides = (np.arange(24) + 0.5) / 24
    total = 0.0
    for u1 in sides:
        for u2 in sides:
            h = np.array(sample_half_vector(u1, u2, alpha))
            w = 2 * (wo @ h) * h - wo
            if w[2] > 0 and wo @ h > 0:
                sin2 = h[0] ** 2 + h[1] ** 2
                base, slope = lobe(Z, w, wo, phi)
                total += (base + psi * slope) * w[2] / reflected_density(sin2, wo @ h, alpha)
    assert 0 <= total / len(sides) ** 2 <= 1


# What frames show


def _furnished(texels: int = 24) -> list[Part]:
    """A room and a box in it, so many texels along the sides of the walls."""
    size = (texels, texels)
    inside = box((1.2, 1.1, 0), (2.1, 1.9, 0.9), (texels // 2, texels // 2))
    return [*room((0, 0, 0), (4, 3, 2.5), size), *inside]


def _samples(parts: list[Part], pose: np.ndarray, image: np.ndarray) -> list[np.ndarray]:
    """Of each part: kind and radiance (T, 4) of its texels, as one frame shows them."""
    world = world_of(parts)
    camera = camera_at(pose, (60.0, 60.0, 40.0, 30.0), 80, 60)
    surfaces = first_surfaces(world.rays, world.scene.face_object, camera)
    everywhere = np.ones(image.shape[:2], np.bool_)
    picture = Picture(image, everywhere, ~everywhere, ~everywhere)
    kind, radiance = samples_from_frame(
        world.texels, world.texels.object_index(), surfaces, picture, camera
    )
    found = np.column_stack([kind, np.where(kind[:, None] == SAMPLE, radiance, 0)])
    return [found[world.texels.of_object(i)] for i in range(len(parts))]


_EYE = look_at(np.array([0.6, 0.5, 1.9]), np.array([2.2, 1.8, 0.4]))
# Smooth, so that rounding of a texel's place by 1e-6 is one of its radiance by little more.
_COLUMN, _ROW = np.meshgrid(np.arange(80) / 80, np.arange(60) / 60)
_IMAGE = np.stack([1 + _COLUMN, 1 + _ROW, 2 + np.sin(3 * _COLUMN + 2 * _ROW)], axis=-1)
_IMAGE = _IMAGE.astype(np.float32)


def _assert_alike(
    found: list[np.ndarray], expected: list[np.ndarray], relative: float = 2e-3
) -> None:
    """The same samples, but for texels at the edge of what is seen."""
    for one, other in zip(found, expected, strict=True):
        same = one[:, 0] == other[:, 0]
        assert same.mean() > 0.97
        np.testing.assert_allclose(one[same], other[same], rtol=relative)
    assert sum((one[:, 0] == SAMPLE).sum() for one in expected) > 100


@few
@given(st.permutations(range(12)))
def test_samples_do_not_depend_on_the_order_of_objects(order):
    parts = _furnished()
    expected = _samples(parts, _EYE, _IMAGE)
    found = _samples([parts[i] for i in order], _EYE, _IMAGE)
    for place, i in enumerate(order):
        np.testing.assert_array_equal(found[place], expected[i])


@few
@given(rotations(), st.tuples(*[st.floats(-50, 50)] * 3))
def test_samples_do_not_depend_on_where_the_scene_lies(turned, shift):
    def moved(part: Part) -> Part:
        return replace(part, points=part.points @ turned.T + shift, normals=part.normals @ turned.T)

    pose = _EYE.copy()
    pose[:3] = turned @ _EYE[:3]
    pose[:3, 3] += shift
    found = _samples([moved(part) for part in _furnished()], pose, _IMAGE)
    _assert_alike(found, _samples(_furnished(), _EYE, _IMAGE))


@pytest.mark.fault("G8")
@few
@given(st.sampled_from([0.01, 0.3, 39.37, 100.0]))
def test_samples_do_not_depend_on_the_unit_of_length(scale):
    pose = _EYE.copy()
    pose[:3, 3] *= scale
    parts = [replace(part, points=scale * part.points) for part in _furnished()]
    _assert_alike(_samples(parts, pose, _IMAGE), _samples(_furnished(), _EYE, _IMAGE))


@few
@given(st.floats(1e-6, 1e6))
def test_samples_scale_with_the_exposure(scale):
    for one, other in zip(
        _samples(_furnished(), _EYE, np.float32(scale) * _IMAGE),
        _samples(_furnished(), _EYE, _IMAGE),
        strict=True,
    ):
        np.testing.assert_array_equal(one[:, 0], other[:, 0])
        np.testing.assert_allclose(one[:, 1:], scale * other[:, 1:], rtol=1e-5)


def _split(part: Part, u: float, v: float) -> Part:
    """The same quad of four, cut at (u, v) of its sides: eight triangles, the same texture."""
    origin, a, b = part.points[0], part.points[1] - part.points[0], part.points[3] - part.points[0]
    points, uv, triangles = [], [], []
    for low, high in (((0, 0), (u, v)), ((u, 0), (1, v)), ((0, v), (u, 1)), ((u, v), (1, 1))):
        corners = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]
        first = len(points)
        points += [origin + x * a + y * b for x, y in corners]
        triangles += [[first, first + 1, first + 2], [first, first + 2, first + 3]]
        uv += corners
    faces = np.array(triangles, np.int32)
    return Part(
        points=np.array(points), triangles=faces, uv=np.array(uv, np.float64)[faces],
        normals=np.broadcast_to(part.normals[0, 0], (8, 3, 3)), size=part.size,
    )  # fmt: skip


cuts = st.floats(0.1, 0.9)


@few
@given(cuts, cuts)
def test_samples_do_not_depend_on_how_surfaces_are_cut_into_triangles(u, v):
    found = _samples([_split(part, u, v) for part in _furnished()], _EYE, _IMAGE)
    # A pixel next to an edge may count as another one's, and new edges are beside other pixels.
    _assert_alike(found, _samples(_furnished(), _EYE, _IMAGE), relative=5e-3)


# Light


def _irradiance(world: World, radiance: np.ndarray, rays: int = 256) -> np.ndarray:
    """Mean S of each object's texels (num_objects, 3)."""
    order, tile = tiles_of_texels(world.texels)
    found = irradiance_at(
        world.rays, world.texture(radiance), world.lights(radiance), black_environment(),
        world.texels.position[order], world.texels.normal[order], tile,
        Sampling(standard_error=0.0, max_rays=rays, seed=1), world.size,
    )  # fmt: skip
    mean = np.zeros_like(radiance)
    mean[order] = found.mean
    return np.array([
        mean[world.texels.of_object(i)].mean(axis=0) for i in range(len(world.scene.objects))
    ])  # fmt: skip


# The ceiling is a lamp.
_RADIANCE = [(0.2, 0.3, 0.4), (9.0, 8.0, 7.0)] + [(0.5, 0.4, 0.3)] * 4 + [(0.1, 0.2, 0.3)] * 6


def _lit(parts: list[Part]) -> tuple[World, np.ndarray]:
    world = world_of(parts)
    return world, world.per_object(_RADIANCE)


@few
@given(st.floats(1e-6, 1e6))
def test_irradiance_scales_with_radiance(scale):
    world, radiance = _lit(_furnished(8))
    found = _irradiance(world, np.float32(scale) * radiance, 64)
    np.testing.assert_allclose(found, scale * _irradiance(world, radiance, 64), rtol=1e-3)


@pytest.mark.fault("G8")
@few
@given(rotations(), st.tuples(*[st.floats(-50, 50)] * 3), st.sampled_from([0.01, 1.0, 100.0]))
def test_irradiance_does_not_depend_on_where_or_in_which_unit_the_scene_is(turned, shift, scale):
    """Within the noise of its rays, which turn with the world's axes: 2 % on means of objects."""

    def moved(part: Part) -> Part:
        points = scale * (part.points @ turned.T + shift)
        return replace(part, points=points, normals=part.normals @ turned.T)

    expected = _irradiance(*_lit(_furnished(8)))
    found = _irradiance(*_lit([moved(part) for part in _furnished(8)]))
    np.testing.assert_allclose(found, expected, rtol=0.02)


@few
@given(cuts, cuts)
def test_irradiance_does_not_depend_on_how_lamps_are_cut_into_triangles(u, v):
    expected = _irradiance(*_lit(_furnished(8)))
    found = _irradiance(*_lit([_split(part, u, v) for part in _furnished(8)]))
    np.testing.assert_allclose(found, expected, rtol=0.02)


@few
@given(st.floats(0.3, 2.0), st.floats(0.5, 3.0))
def test_light_between_two_surfaces_is_exchanged_alike(distance, width):
    """Reciprocity: A1 F12 = A2 F21, for a small square below a large one, by the estimator."""
    small = quad((-0.25, -0.25, 0), (0.5, 0, 0), (0, 0.5, 0))
    large = quad((-width / 2, -width / 2, distance), (0, width, 0), (width, 0, 0), size=(16, 16))
    world = world_of([small, large])
    exchanged = []
    for i, area in ((0, 0.25), (1, width**2)):
        radiance = world.per_object([(0, 0, 0), (1, 1, 1)] if i == 0 else [(1, 1, 1), (0, 0, 0)])
        own = world.texels.of_object(i)
        _, found = estimates(
            world, radiance, world.lights(radiance), world.texels.position[own],
            world.texels.normal[own], estimator="mis", rays=256, repeat=1,
        )  # fmt: skip
        share_of_texel = world.texels.area[own] / world.texels.area[own].sum()
        exchanged.append(area * float(share_of_texel @ found.mean[:, 0]))
    np.testing.assert_allclose(exchanged[0], exchanged[1], rtol=0.02)
