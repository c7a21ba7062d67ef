"""The texel table: every texel on its triangle, areas that add up, gutters filled."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.physics.surfaces import World, box, quad, sphere, world_of
from usdbrdf.geometry.texels import texels_from_atlas
from usdbrdf.geometry.unwrap import pack_triangles_singly
from usdbrdf.model.scene import Scene, SceneObject
from usdbrdf.model.texels import Texels


def _sphere() -> World:
    return world_of([sphere((0.3, -0.2, 1), 0.7, 24, 48, (192, 96))])


def _packed(texel_size: float) -> tuple[Scene, Texels]:
    """A sphere and a box of two objects, every triangle in a cell of its own, with gutters."""
    scene = world_of([sphere((0, 0, 0), 0.5, 8, 16, (8, 8)), *box((1, 1, 1), (2, 1.5, 1.2))]).scene
    first, rest = scene.objects[0], len(scene.triangles) - scene.objects[0].num_faces
    second = replace(scene.objects[1], num_faces=rest)
    face_object = np.minimum(scene.face_object, 1)
    corners = scene.points[scene.triangles]
    uv, resolution = [], []
    for obj in (first, second):
        packed, size = pack_triangles_singly(corners[obj.faces], texel_size)
        uv.append(packed)
        resolution.append(size)
    scene = replace(
        scene, objects=(first, second), face_object=face_object, corner_uv=np.concatenate(uv)
    )
    return scene, texels_from_atlas(scene, np.array(resolution, np.int32))


def _mesh_area(scene: Scene) -> float:
    corners = scene.points[scene.triangles].astype(np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(np.linalg.norm(cross, axis=1).sum() / 2)


@pytest.mark.parametrize("kind", ["sphere", "packed"])
def test_areas_of_the_interior_texels_add_up_to_the_mesh(kind: str):
    # A texel counts for the triangle that its centre lies in: a sum over the centres of a grid.
    # Packed triangles have centres all along their hypotenuse, which count too: 1 / side more.
    if kind == "sphere":
        world = _sphere()
        scene, texels = world.scene, world.texels
    else:
        scene, texels = _packed(0.008)
    assert texels.area[texels.interior].sum() == pytest.approx(_mesh_area(scene), rel=0.02)
    assert (texels.area > 0).all()


def test_the_mean_of_what_is_one_everywhere_is_no_more_than_one():
    # Single precision adds weights and weighted values up to different roundings.
    texels = _sphere().texels
    ones = np.ones((len(texels.area), 3), np.float32)
    assert texels.mean_of_object(0, ones).astype(np.float32).tolist() == [1, 1, 1]


def test_the_surface_of_a_square_is_shared_out_exactly():
    texels = world_of([quad((0, 0, 0), (2, 0, 0), (0, 3, 0), size=(20, 10))]).texels
    np.testing.assert_allclose(texels.area, 2 * 3 / 200, rtol=1e-5)
    # One texel right is 10 cm along u, one down 30 cm against v.
    np.testing.assert_allclose(texels.step_x, np.tile([[0.1, 0, 0]], (200, 1)), atol=1e-6)
    np.testing.assert_allclose(texels.step_y, np.tile([[0, -0.3, 0]], (200, 1)), atol=1e-6)


def test_every_position_lies_on_its_triangle():
    scene, texels = _packed(0.05)
    assert not texels.interior.all()
    corners = scene.points[scene.triangles[texels.face]].astype(np.float64)
    np.testing.assert_allclose(texels.barycentric.sum(axis=1), 1, atol=1e-5)
    assert texels.barycentric.min() > -1e-4
    # On the plane of the triangle, and where the barycentric coordinates say.
    weighted = (texels.barycentric[:, :, None] * corners).sum(axis=1)
    np.testing.assert_allclose(texels.position, weighted, atol=1e-5)
    off = ((texels.position - corners[:, 0]) * texels.geometric_normal).sum(axis=1)
    assert np.abs(off).max() < 1e-5
    # Interior texels map back to their own centre in the atlas.
    at = (texels.barycentric[:, :, None] * texels.corner_pixel[texels.face]).sum(axis=1)
    owner = texels.object_index()
    local = texels.pixel - texels.first_pixel[owner]
    width = texels.resolution[owner, 0]
    centre = np.stack([local % width, local // width], axis=-1) + 0.5
    # (those on an edge a little inside of it).
    off = np.abs(at - centre)[texels.interior].max(axis=1)
    assert np.median(off) < 2e-3
    assert off.max() < 0.5


def test_border_texels_move_onto_the_surface_by_less_than_a_texel_and_no_further():
    # The chart ends 0.4 texels short of the outer centres; both triangles are 250 texels large.
    scene = world_of([quad((0, 0, 0), (5, 0, 0), (0, 5, 0))]).scene
    scene = replace(
        scene, corner_uv=(10.1 / 270 + scene.corner_uv * 249.8 / 270).astype(np.float32)
    )
    texels = texels_from_atlas(scene, np.array([[270, 270]], np.int32))
    border = ~texels.interior
    assert border.sum() > 500
    at = (texels.barycentric[:, :, None] * texels.corner_pixel[texels.face]).sum(axis=1)
    centre = np.stack([texels.pixel % 270, texels.pixel // 270], axis=-1) + 0.5
    moved = np.linalg.norm(at - centre, axis=1)
    assert moved[border].max() < 1.0
    assert moved.max() < 1.0
    assert (texels.barycentric.min(axis=1) > 0)[border].all()


def test_no_texel_lies_exactly_on_the_edge_of_its_triangle():
    # Atlas packers like to put a chart's corners onto texel centres; a ray that starts exactly on
    # an edge shared with a wall starts inside of the wall, or behind it.
    scene = world_of([quad((0, 0, 0), (1, 0, 0), (0, 1, 0))]).scene
    scene = replace(scene, corner_uv=(2.5 / 20 + scene.corner_uv * 15 / 20).astype(np.float32))
    texels = texels_from_atlas(scene, np.array([[20, 20]], np.int32))
    assert texels.interior.sum() == 256
    away = np.minimum(texels.position[:, :2], 1 - texels.position[:, :2]).min(axis=1)
    # A hundredth of a texel at least, half of one at most.
    assert away.min() > 0.009 / 15
    assert away.min() < 0.5 / 15


def test_normals_are_unit_and_point_outwards():
    world = _sphere()
    texels = world.texels
    radial = texels.position - np.array([0.3, -0.2, 1], np.float32)
    radial /= np.linalg.norm(radial, axis=1, keepdims=True)
    for normal in (texels.normal, texels.geometric_normal):
        np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-5)
    # Interpolated normals follow the sphere; flat ones lean by up to half a facet (3.75 degrees).
    assert (texels.normal * radial).sum(axis=1).min() > np.cos(np.radians(0.5))
    assert (texels.geometric_normal * radial).sum(axis=1).min() > np.cos(np.radians(5))


def test_gutters_show_the_nearest_texel_of_their_own_atlas():
    _, texels = _packed(0.05)
    for index in range(2):
        flat = slice(*texels.first_pixel[index : index + 2])
        shown = texels.nearest_texel[flat]
        own = texels.of_object(index)
        assert shown.min() >= own.start
        assert shown.max() < own.stop
        width, height = texels.resolution[index]
        local = texels.pixel[own] - texels.first_pixel[index]
        np.testing.assert_array_equal(shown[local], np.arange(own.start, own.stop))
        assert len(local) < width * height
        # Brute force for a few gutter pixels.
        gutter = np.setdiff1d(np.arange(width * height), local)
        rng = np.random.default_rng(12345)
        for pixel in rng.choice(gutter, 50):
            away = (local % width - pixel % width) ** 2 + (local // width - pixel // width) ** 2
            chosen = local[shown[pixel] - own.start]
            distance = (chosen % width - pixel % width) ** 2 + (
                chosen // width - pixel // width
            ) ** 2
            assert distance == away.min()


def test_pictures_and_tables_convert_into_each_other():
    _, texels = _packed(0.05)
    values = np.random.default_rng(12345).random((len(texels), 3)).astype(np.float32)
    for index in range(2):
        image = texels.image(index, values)
        width, height = texels.resolution[index]
        assert image.shape == (height, width, 3)
        np.testing.assert_array_equal(
            texels.from_image(index, image), values[texels.of_object(index)]
        )
    mask = texels.image(1, np.ones(len(texels), np.bool_))
    assert mask.dtype == np.bool_
    assert mask.all()


def test_v_is_up_and_rows_run_down():
    # uv (0, 0) is the lower left corner of the picture: its last row. (Texels on a triangle's edge
    # may be moved off it by some hundredths of their size, here 0.25.)
    texels = world_of([quad((0, 0, 0), (1, 0, 0), (0, 1, 0), size=(4, 4))]).texels
    picture = texels.image(0, texels.position)
    np.testing.assert_allclose(picture[-1, 0], [0.125, 0.125, 0], atol=0.01)
    np.testing.assert_allclose(picture[0, 0], [0.125, 0.875, 0], atol=0.01)


def test_rasterising_twice_gives_the_same_bits():
    scene, first = _packed(0.04)
    second = texels_from_atlas(scene, first.resolution)
    for name, values in vars(first).items():
        np.testing.assert_array_equal(values, getattr(second, name), err_msg=name)


def test_a_shared_edge_through_texel_centres_belongs_to_one_triangle():
    # The diagonal of a square atlas runs through the centres: each texel exists once.
    texels = world_of([quad((0, 0, 0), (1, 0, 0), (0, 1, 0), size=(16, 16))]).texels
    assert len(texels) == 256
    np.testing.assert_array_equal(texels.pixel, np.arange(256))
    assert texels.interior.all()


def test_triangles_without_area_neither_own_texels_nor_break_anything():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0.5, 0]], np.float32)
    triangles = np.array([[0, 1, 2], [1, 2, 3]], np.int32)  # the second is a line
    uv = points[triangles][..., :2] * 0.5 + 0.25
    obj = SceneObject(
        prim_path="/x/geo/a", identifier="a", label="a", class_name="", first_face=0, num_faces=2
    )
    scene = Scene(
        objects=(obj,), points=points, triangles=triangles,
        corner_normals=np.tile(np.array([0, 0, 1], np.float32), (2, 3, 1)),
        face_object=np.zeros(2, np.int32), corner_uv=uv.astype(np.float32),
    )  # fmt: skip
    texels = texels_from_atlas(scene, np.array([[32, 32]], np.int32))
    assert np.isfinite(texels.position).all()
    assert (texels.face[texels.interior] == 0).all()
    assert texels.area[texels.interior].sum() == pytest.approx(0.5, rel=0.15)


def test_texture_coordinates_are_required():
    scene = world_of([quad((0, 0, 0), (1, 0, 0), (0, 1, 0))]).scene
    with pytest.raises(ValueError, match="no texture coordinates"):
        texels_from_atlas(replace(scene, corner_uv=None), np.array([[8, 8]], np.int32))
