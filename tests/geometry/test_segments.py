"""Objects from shape and colour alone, against scenes whose objects are known."""

from __future__ import annotations

import numpy as np
import pytest

from tests.scenes import room_mesh
from usdbrdf.geometry.segment_colours import divided_by_colour
from usdbrdf.geometry.segments import links_of_faces, segments_of_mesh
from usdbrdf.model.mesh import doubled_areas


def _terrain(height, *, side=2.0, count=80, noise=0.0, seed=0):
    """Points and triangles of one surface z = height(x, y) without a seam."""
    line = np.linspace(0, side, count)
    x, y = np.meshgrid(line, line, indexing="ij")
    rng = np.random.default_rng(seed)
    z = height(x, y) + noise * rng.standard_normal(x.shape)
    number = np.arange(count * count).reshape(count, count)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    triangles = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    return points.astype(np.float32), triangles.astype(np.int32)


def _step(x, y):
    inside = (np.abs(x - 0.9) < 0.35) & (np.abs(y - 1.1) < 0.3)
    return np.where(inside, 0.5, 0.0)


@pytest.mark.parametrize("unit", [0.01, 1.0, 100.0])
def test_every_wall_of_a_room_and_the_box_in_it_are_found(unit):
    points, triangles, true, names = room_mesh()
    found = segments_of_mesh(points * np.float32(unit), triangles)
    box = names.index("box")
    areas = doubled_areas(points, triangles) / 2
    for segment in np.unique(found.face):
        owners = np.bincount(true[found.face == segment], areas[found.face == segment])
        assert owners.max() == pytest.approx(owners.sum())
    assert len(np.unique(found.face[true == box])) == 1
    # Floor, ceiling, lamp, box, and four walls, which the truth calls one object.
    assert found.planes + found.parts == 8
    assert not (found.face >= 8).any()


@pytest.mark.parametrize("unit", [1e-2, 1.0, 1e2])
def test_what_stands_on_a_noisy_ground_is_one_part(unit):
    points, triangles = _terrain(_step, noise=0.002)
    found = segments_of_mesh(points * np.float32(unit), triangles)
    centre = points[triangles].mean(axis=1)
    on_top = centre[:, 2] > 0.1
    assert (found.planes, found.parts) == (1, 1)
    assert (found.face[on_top] == 1).all()
    far = (np.abs(centre[:, 0] - 0.9) > 0.5) | (np.abs(centre[:, 1] - 1.1) > 0.5)
    assert (found.face[far] == 0).all()


def test_a_thing_alone_is_not_cut_into_its_sides():
    points, triangles, _, _ = room_mesh(room=False)
    found = segments_of_mesh(points, triangles)
    assert (found.planes, found.parts) == (0, 1)
    assert not found.face.any()


def test_the_same_mesh_gives_the_same_segments():
    points, triangles = _terrain(_step, noise=0.002)
    one, other = (segments_of_mesh(points, triangles).face for _ in range(2))
    assert one.tobytes() == other.tobytes()


def _plane_with(colours):
    """Face colours (F, 3) on a flat square from a function of the place; and its division."""
    points, triangles = _terrain(lambda x, y: 0 * x, count=60)
    centre = points[triangles].mean(axis=1)
    face = np.zeros(len(triangles), np.int32)
    areas = doubled_areas(points, triangles) / 2
    links = links_of_faces(points, triangles)
    return centre, divided_by_colour(face, colours(centre), areas, links, [0])


def test_a_plane_is_divided_where_its_colour_changes():
    def colours(centre):
        red = np.abs(centre[:, :2] - 1).max(axis=1) < 0.4
        rng = np.random.default_rng(1)
        noise = 1 + 0.1 * rng.standard_normal((len(centre), 3))
        shown = np.where(red[:, None], (0.5, 0.1, 0.08), (0.4, 0.4, 0.38)) * noise
        shown[::7] = np.nan  # that no frame shows
        return shown.astype(np.float32)

    centre, found = _plane_with(colours)
    inside = np.abs(centre[:, :2] - 1).max(axis=1)
    assert set(found) == {0, 1}
    assert (found[inside < 0.37] == 1).all()
    assert (found[inside > 0.43] == 0).all()


def test_light_and_shadow_divide_nothing():
    def colours(centre):
        sun = np.where(centre[:, :1] + 0.3 * centre[:, 1:2] < 1.1, 1.0, 0.2)
        return (sun * (0.4, 0.35, 0.3)).astype(np.float32)

    _, found = _plane_with(colours)
    assert not found.any()


def test_a_plane_that_nobody_saw_stays_whole():
    _, found = _plane_with(lambda centre: np.full((len(centre), 3), np.nan, np.float32))
    assert not found.any()
