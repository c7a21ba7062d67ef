"""Which texels a frame gives a sample, and which value."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from tests.physics.surfaces import World, quad, world_of
from tests.scenes import camera_at, look_at
from usdbrdf.texturing.samples import (
    CLIPPED,
    DARK,
    GLIMPSE,
    NOTHING,
    SAMPLE,
    Picture,
    Projection,
    first_surfaces,
    project,
    samples_from_frame,
)

WIDTH, HEIGHT = 80, 60
LENS = np.array([80.0, 80.0, 40.0, 30.0])
EYE = np.array([0.1, -0.2, 2.0])


class Shot(NamedTuple):
    kind: np.ndarray
    radiance: np.ndarray


def _camera(
    eye: np.ndarray = EYE, target: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> np.ndarray:
    return look_at(np.asarray(eye, np.float64), np.asarray(target, np.float64))


def _shoot(
    world: World,
    image: np.ndarray,
    pose: np.ndarray,
    valid: np.ndarray | None = None,
    clipped: np.ndarray | None = None,
    dark: np.ndarray | None = None,
) -> Shot:
    camera = camera_at(pose, LENS, WIDTH, HEIGHT)
    surfaces = first_surfaces(world.rays, world.scene.face_object, camera)
    nowhere = np.zeros((HEIGHT, WIDTH), bool)
    picture = Picture(
        image.astype(np.float32),
        ~nowhere if valid is None else valid,
        nowhere if clipped is None else clipped,
        nowhere if dark is None else dark,
    )
    owner = world.texels.object_index()
    return Shot(*samples_from_frame(world.texels, owner, surfaces, picture, camera))


def _pixel_of(pose: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Column, row (T,) of world points, written out once more."""
    local = (position.astype(np.float64) - pose[:3, 3]) @ pose[:3, :3]
    depth = -local[:, 2]
    return LENS[2] + LENS[0] * local[:, 0] / depth, LENS[3] - LENS[1] * local[:, 1] / depth


def _picture_of_plane(pose: np.ndarray, value) -> np.ndarray:
    """What a pinhole camera sees of the plane z = 0 with radiance value(x, y) (..., 3)."""
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    local = np.stack(
        [(column - LENS[2]) / LENS[0], (LENS[3] - row) / LENS[1], -np.ones_like(row)], axis=-1
    )
    direction = local @ pose[:3, :3].T
    t = -pose[2, 3] / direction[..., 2]
    point = pose[:3, 3] + t[..., None] * direction
    return value(point[..., 0], point[..., 1])


def _pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.stack([1 + 0.4 * x, 2 + 0.3 * y, 1.5 + 0.2 * x - 0.3 * y], axis=-1)


@pytest.fixture(scope="module")
def plane() -> World:
    """One square metre facing up, texels of 2.5 cm: about as large as a pixel (1 / 40 m)."""
    return world_of([quad((-0.5, -0.5, 0), (1, 0, 0), (0, 1, 0), size=(40, 40))])


def test_a_textured_square_yields_its_radiance(plane: World):
    pose = _camera()
    shot = _shoot(plane, _picture_of_plane(pose, _pattern), pose)
    seen = shot.kind == SAMPLE
    # All but the texels whose 3 x 3 pixels reach past the square's edge.
    inside = np.abs(plane.texels.position[:, :2]).max(axis=1) < 0.45
    assert seen[inside].all()
    assert not seen.all()
    assert (shot.kind[~seen] == NOTHING).all()
    # A linear pattern seen through a pinhole is nearly linear over a pixel; bilinear reading keeps
    # it to the second order, (1/80)^2 of the range.
    expected = _pattern(*plane.texels.position[seen, :2].T)
    np.testing.assert_allclose(shot.radiance[seen], expected, atol=2e-4)


def test_half_a_pixel_matters(plane: World):
    # The value at a texel is that of the image there, first pixel's centre at (0.5, 0.5): an image
    # of its own coordinates gives back the projection, to the average over the texel's footprint.
    pose = _camera()
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    shot = _shoot(plane, np.stack([column, row, 0 * row], axis=-1), pose)
    seen = shot.kind == SAMPLE
    column, row = _pixel_of(pose, plane.texels.position[seen])
    np.testing.assert_allclose(shot.radiance[seen, 0], column, atol=0.01)
    np.testing.assert_allclose(shot.radiance[seen, 1], row, atol=0.01)


def test_large_texels_average_over_their_footprint():
    # Texels of 10 cm, four pixels wide; the picture has stripes of two dark and two bright columns,
    # so every footprint holds as much of both wherever it starts.
    world = world_of([quad((-0.5, -0.5, 0), (1, 0, 0), (0, 1, 0), size=(10, 10))])
    pose = _camera((0.008, -1e-3, 2.0), (0.008, 0, 0))
    stripes = np.zeros((HEIGHT, WIDTH, 3))
    stripes[:, np.arange(WIDTH) // 2 % 2 == 0] = 2
    shot = _shoot(world, stripes, pose)
    seen = shot.kind == SAMPLE
    assert seen.sum() >= 64
    np.testing.assert_allclose(shot.radiance[seen], 1, atol=0.05)


@pytest.mark.parametrize("size", [(20, 40), (5, 10)])
def test_texels_do_not_read_over_the_edge_of_their_object(size: tuple[int, int]):
    # Two objects side by side in one plane. Texels of one pixel: their 3 x 3 pixels tell. Texels
    # of four pixels: the edge lies two pixels from the centres of the nearest ones, outside of
    # their 3 x 3 pixels but not of what bilinear reading of their footprint touches.
    world = world_of([
        quad((-0.5, -0.5, 0), (0.5, 0, 0), (0, 1, 0), size=size),
        quad((0, -0.5, 0), (0.5, 0, 0), (0, 1, 0), size=size),
    ])  # fmt: skip
    pose = _camera((0.008, -1e-3, 2.0), (0.008, 0, 0))
    image = _picture_of_plane(pose, lambda x, y: np.where(x < 0, 1.0, 9.0)[..., None] * np.ones(3))
    shot = _shoot(world, image, pose)
    seen = shot.kind == SAMPLE
    left = world.texels.object_index() == 0
    # The texels away from the edge are seen in any case.
    x, y = np.abs(world.texels.position[:, :2]).T
    assert seen[(x > 0.1) & (x < 0.4) & (y < 0.4)].all()
    np.testing.assert_allclose(shot.radiance[seen & left], 1, rtol=1e-6)
    np.testing.assert_allclose(shot.radiance[seen & ~left], 9, rtol=1e-6)


def test_an_occluder_leaves_no_samples_behind_it_or_near_its_edge(plane: World):
    floor = quad((-0.5, -0.5, 0), (1, 0, 0), (0, 1, 0), size=(40, 40))
    world = world_of([floor, quad((-0.1, -0.1, 0.5), (0.2, 0, 0), (0, 0.2, 0), size=(8, 8))])
    pose = _camera()
    image = _picture_of_plane(pose, _pattern)
    # The occluder's pixels are red: a sample that took any of it would show.
    first = first_surfaces(
        world.rays, world.scene.face_object, camera_at(pose, LENS, WIDTH, HEIGHT)
    )
    image[first.object == 1] = (2, 0, 0)
    shot = _shoot(world, image, pose)
    own = world.texels.of_object(0)
    position = world.texels.position[own]
    # The segment from the texel to the eye crosses z = 0.5 at a quarter of its length.
    crossing = position[:, :2] + 0.25 * (EYE[:2] - position[:, :2])
    behind = np.abs(crossing).max(axis=1) < 0.1
    # A pixel is 1/80 * 1.5 m = 1.9 cm wide on the occluder: within half a pixel of its edge the
    # texel's own 3 x 3 pixels show the occluder.
    edge = np.abs(crossing).max(axis=1) < 0.1 + 0.009
    clear = np.abs(crossing).max(axis=1) > 0.1 + 2.2 * 1.5 / 80
    assert behind.sum() > 50
    assert (shot.kind[own][behind] == NOTHING).all()
    assert (shot.kind[own][edge] == NOTHING).all()
    inside = np.abs(position[:, :2]).max(axis=1) < 0.45
    assert (shot.kind[own][clear & inside] == SAMPLE).all()
    seen = shot.kind[own] == SAMPLE
    np.testing.assert_allclose(shot.radiance[own][seen], _pattern(*position[seen, :2].T), atol=2e-4)


def test_the_same_object_in_front_of_itself_is_a_depth_edge_too():
    # A step of 20 cm within one object, seen from the side that hides part of the lower level: no
    # sample of the lower level is one of the upper.
    parts = [
        quad((-0.5, -0.5, 0), (0.5, 0, 0), (0, 1, 0), size=(20, 40)),
        quad((0, -0.5, 0.2), (0.5, 0, 0), (0, 1, 0), size=(20, 40)),
    ]
    world = world_of(parts)
    pose = _camera((0.3, -1e-3, 2.0))
    one = World(scene=replace(world.scene, face_object=np.zeros(4, np.int32)), texels=world.texels)
    camera = camera_at(pose, LENS, WIDTH, HEIGHT)
    surfaces = first_surfaces(one.rays, one.scene.face_object, camera)
    upper = surfaces.point[..., 2] > 0.1
    image = np.where(upper[..., None], 9.0, 1.0) * np.ones(3)
    everywhere = np.ones((HEIGHT, WIDTH), bool)
    picture = Picture(image.astype(np.float32), everywhere, ~everywhere, ~everywhere)
    owner = np.zeros(len(one.texels), np.int32)
    kind, radiance = samples_from_frame(one.texels, owner, surfaces, picture, camera)
    seen = kind == SAMPLE
    high = one.texels.position[:, 2] > 0.1
    assert seen[high].sum() > 400
    assert 400 < seen[~high].sum() < 800
    np.testing.assert_allclose(radiance[seen & high], 9)
    np.testing.assert_allclose(radiance[seen & ~high], 1)


def test_pixels_below_the_noise_floor_make_dark_texels(plane: World):
    pose = _camera()
    column = _pixel_of(pose, plane.texels.position)[0]
    image = np.ones((HEIGHT, WIDTH, 3))
    dark, clipped = np.zeros((2, HEIGHT, WIDTH), bool)
    dark[:, 30:38], clipped[:, 38:44] = True, True
    image[dark] = 1e-4
    image[clipped] = 50
    shot = _shoot(plane, image, pose, ~(dark | clipped), clipped, dark)
    free = _shoot(plane, np.ones((HEIGHT, WIDTH, 3)), pose).kind == SAMPLE
    well_inside = free & (column > 32) & (column < 36)
    assert well_inside.sum() > 50
    # Beside what glares as well.
    assert (shot.kind[well_inside] == DARK).all()
    np.testing.assert_allclose(shot.radiance[well_inside], 1e-4, rtol=1e-5)
    # Towards brighter pixels it is told from darkness on one side, and not known on the other.
    assert (shot.kind[free & (np.abs(column - 38) < 0.4)] == NOTHING).all()
    assert (shot.kind[free & (column < 28)] == SAMPLE).all()


def test_saturated_pixels_make_clipped_texels(plane: World):
    pose = _camera()
    column, row = _pixel_of(pose, plane.texels.position)
    clipped = np.zeros((HEIGHT, WIDTH), bool)
    clipped[:, 30:38] = True
    shot = _shoot(plane, np.ones((HEIGHT, WIDTH, 3)), pose, valid=~clipped, clipped=clipped)
    free = _shoot(plane, np.ones((HEIGHT, WIDTH, 3)), pose).kind == SAMPLE
    # The footprint reaches about a pixel to either side.
    well_inside = free & (column > 32) & (column < 36)
    well_outside = free & ((column < 28) | (column > 40))
    assert well_inside.sum() > 50
    assert (shot.kind[well_inside] == CLIPPED).all()
    assert (shot.kind[well_outside] == SAMPLE).all()
    # At the border some pixels are saturated and some are not: neither a sample nor a bound.
    assert (shot.kind[free & (np.abs(column - 30) < 0.4)] == NOTHING).all()
    np.testing.assert_array_equal(shot.radiance[shot.kind != SAMPLE], 0)
    assert row.size == len(plane.texels)


def test_one_bad_pixel_spoils_the_texels_that_read_it_and_no_others(plane: World):
    pose = _camera()
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[28, 41] = False
    image = np.ones((HEIGHT, WIDTH, 3))
    image[28, 41] = 1e6
    shot = _shoot(plane, image, pose, valid=valid)
    free = _shoot(plane, np.ones((HEIGHT, WIDTH, 3)), pose).kind == SAMPLE
    column, row = _pixel_of(pose, plane.texels.position)
    away = np.maximum(np.abs(column - 41.5), np.abs(row - 28.5))
    assert (shot.kind[free & (away < 0.9)] == NOTHING).all()
    assert (shot.kind[free & (away > 2)] == SAMPLE).all()
    np.testing.assert_allclose(shot.radiance[shot.kind == SAMPLE], 1, rtol=1e-6)


def test_surfaces_that_face_away_give_nothing(plane: World):
    pose = _camera((0.1, -0.2, -2.0))
    shot = _shoot(plane, np.ones((HEIGHT, WIDTH, 3)), pose)
    assert (shot.kind == NOTHING).all()


def test_surfaces_seen_too_flat_give_nothing(plane: World):
    # Cosine 0.08 < 0.1 at the middle; at cosine 0.3 samples are taken.
    for cosine, taken in ((0.08, False), (0.3, True)):
        eye = 2 * np.array([0, -np.sqrt(1 - cosine**2), cosine])
        shot = _shoot(plane, np.ones((HEIGHT, WIDTH, 3)), _camera(eye))
        middle = np.abs(plane.texels.position[:, :2]).max(axis=1) < 0.1
        assert (shot.kind[middle] == SAMPLE).all() == taken
        assert (shot.kind[middle] == NOTHING).all() != taken


def test_nothing_comes_from_behind_the_camera_or_from_the_image_border(plane: World):
    # The camera stands over the square and looks away, up.
    away = _camera((0, 0, 1.0), (0, -0.1, 3))
    assert (_shoot(plane, np.ones((HEIGHT, WIDTH, 3)), away).kind == NOTHING).all()
    # So near that the square fills the image: the outermost pixels are left out.
    pose = _camera((0, -1e-3, 0.5))
    shot = _shoot(plane, np.ones((HEIGHT, WIDTH, 3)), pose)
    column, row = _pixel_of(pose, plane.texels.position[shot.kind == SAMPLE])
    assert column.min() >= 1
    assert column.max() <= WIDTH - 1
    assert row.min() >= 1
    assert row.max() <= HEIGHT - 1
    assert (shot.kind == SAMPLE).sum() > 200


def test_beside_a_glaring_lamp_no_sample_is_taken():
    # The lamp hangs half a metre above the floor's middle; three pixels around it see its glare.
    floor = quad((-0.5, -0.5, 0), (1, 0, 0), (0, 1, 0), size=(40, 40))
    world = world_of([floor, quad((-0.1, -0.1, 0.5), (0.2, 0, 0), (0, 0.2, 0), size=(8, 8))])
    pose = _camera()
    first = first_surfaces(
        world.rays, world.scene.face_object, camera_at(pose, LENS, WIDTH, HEIGHT)
    )
    own = world.texels.of_object(0)
    kinds = []
    for lamp in (5.0, 500.0):
        image = _picture_of_plane(pose, lambda x, y: np.ones((*x.shape, 3)))
        image[first.object == 1] = lamp
        kinds.append(_shoot(world, image, pose).kind[own])
    dim, glaring = kinds
    lost = (dim == SAMPLE) & (glaring == NOTHING)
    assert lost.sum() > 20
    assert not ((dim == NOTHING) & (glaring == SAMPLE)).any()
    crossing = world.texels.position[own, :2] * 0.75 + 0.25 * EYE[:2]
    away = np.abs(crossing).max(axis=1) - 0.1
    # A pixel is 1/80 * 1.5 m wide on the lamp.
    assert away[lost].max() < 4.6 * 1.5 / 80
    on_floor = glaring == SAMPLE
    assert (away[on_floor] > 2.5 * 1.5 / 80).all()


def test_texels_in_the_outermost_pixels_give_nothing_and_all_others_do():
    """Of a wall that fills the picture, straight before the camera."""
    wall = world_of([quad((-1.1, -0.9, 0), (2.2, 0, 0), (0, 1.8, 0), size=(110, 90))])
    pose = np.eye(4)
    pose[2, 3] = 2
    shot = _shoot(wall, np.ones((HEIGHT, WIDTH, 3)), pose)
    column, row = _pixel_of(pose, wall.texels.position)
    near = np.minimum(np.minimum(column, WIDTH - column), np.minimum(row, HEIGHT - row))
    sure = np.abs(near - 1) > 1e-3
    np.testing.assert_array_equal((shot.kind == SAMPLE)[sure], near[sure] > 1)
    for side in (column, WIDTH - column, row, HEIGHT - row):
        assert ((side > 1) & (side < 2) & (near == side)).any()
        assert ((side > 0) & (side < 1) & (near == side)).any()


def test_a_point_beside_a_texel_is_projected_as_by_its_camera():
    rng = np.random.default_rng(3)
    camera = camera_at(_camera(), LENS, WIDTH, HEIGHT)
    for _ in range(20):
        p, sx, sy = rng.uniform(-0.5, 0.5, (3, 3)).astype(np.float32)
        dx, dy = rng.uniform(-1, 1, 2)
        point = p + dx * sx.astype(float) + dy * sy
        u, v, depth = project(p, sx, sy, dx, dy, Projection.of(camera))
        np.testing.assert_allclose((u, v), camera.project(point[None])[0], rtol=1e-5)
        assert depth == pytest.approx((camera.eye - point) @ camera.world_from_camera[:3, 2])
    behind = np.float32(camera.eye + camera.world_from_camera[:3, 2])
    assert project(behind, sx, sy, 0.0, 0.0, Projection.of(camera)) == (0, 0, -1)


def test_a_thin_bar_is_glimpsed_and_only_by_whom_asks(plane: World):
    """Half a pixel wide, before a plane: no 3 x 3 pixels show it alone."""
    bar = quad((-0.006, -0.5, 0.1), (0.012, 0, 0), (0, 1, 0), size=(2, 60))
    world = world_of([quad((-0.5, -0.5, 0), (1, 0, 0), (0, 1, 0), size=(40, 40)), bar])
    pose = _camera()
    camera = camera_at(pose, LENS, WIDTH, HEIGHT)
    surfaces = first_surfaces(world.rays, world.scene.face_object, camera)
    image = np.where(surfaces.object[..., None] == 1, [0.5, 0.25, 1.0], [2.0, 2.0, 2.0])
    image[:, :, 0] += np.arange(WIDTH) / 100  # each column differs
    image, valid = image.astype(np.float32), np.ones((HEIGHT, WIDTH), bool)
    valid[20:30] = False
    dark = np.zeros((HEIGHT, WIDTH), bool)
    owner = world.texels.object_index()
    given = world.texels, owner, surfaces, Picture(image, valid, dark, dark), camera
    plain, _ = samples_from_frame(*given)
    kind, radiance = samples_from_frame(*given, glimpses=True)
    own = owner == 1
    assert (plain[own] == NOTHING).all()
    assert set(kind[own].tolist()) == {NOTHING, GLIMPSE}
    np.testing.assert_array_equal(kind[(plain != NOTHING)], plain[(plain != NOTHING)])
    column, row = (
        np.floor(part).astype(int) for part in _pixel_of(pose, world.texels.position[own])
    )
    there = (surfaces.object[row.clip(0, HEIGHT - 1), column] == 1) & (row >= 1) & (row <= 58)
    expected = there & valid[row.clip(0, HEIGHT - 1), column]
    assert expected.sum() > 20
    assert (there & ~expected).any()
    np.testing.assert_array_equal(kind[own] == GLIMPSE, expected)
    np.testing.assert_array_equal(radiance[own][expected], image[row[expected], column[expected]])
    # A lamp's light lies on the pixels beside it.
    image[45:50][surfaces.object[45:50] == 0] = 200
    beside, _ = samples_from_frame(
        world.texels, owner, surfaces, Picture(image, valid, dark, dark), camera, glimpses=True
    )
    near = expected & (row >= 45) & (row < 50)
    assert near.any()
    assert (beside[own][near] == NOTHING).all()
