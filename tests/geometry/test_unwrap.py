"""Charts by xatlas in a child process, and the packing that needs no charts."""

from __future__ import annotations

import os
import re
import signal
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from tests.physics.surfaces import quad, sphere, world_of
from usdbrdf.errors import CrashedChild, InputRefused, LateChild
from usdbrdf.geometry import unwrap as module
from usdbrdf.geometry.texels import texels_from_atlas
from usdbrdf.geometry.unwrap import (
    PADDING,
    TexelSizes,
    atlas_side,
    beside_neighbours,
    pack_triangles_singly,
    parts_of,
    stretched_share,
    unwrap,
    without_noise,
)
from usdbrdf.job.child import run_child
from usdbrdf.model.scene import Scene, SceneObject


def test_packed_triangles_have_cells_of_their_own():
    rng = np.random.default_rng(12345)
    corners = rng.random((23, 3, 3)).astype(np.float32)
    uv, (width, height) = pack_triangles_singly(corners, 0.05)
    assert uv.min() >= 0
    assert uv.max() <= 1
    pixel = uv.astype(np.float64) * [width, height]
    low, high = pixel.min(axis=1), pixel.max(axis=1)
    # Bounding boxes of any two cells are at least two paddings apart in x or in y.
    for i in range(len(uv)):
        gap = np.maximum(low - high[i], low[i] - high).max(axis=1)
        assert (np.delete(gap, i) >= 2 * PADDING - 1e-3).all()
    # ... and one padding from the border.
    assert low.min() >= PADDING - 1e-3
    assert (high.max(axis=0) <= np.array([width, height]) - PADDING + 1e-3).all()


def test_packed_texels_are_at_most_the_size_that_was_asked_for():
    corners = np.array([[[0, 0, 0], [0.8, 0, 0], [0, 0.5, 0]]], np.float32)
    uv, (width, height) = pack_triangles_singly(corners, 0.01)
    side = np.ptp(uv[0] * [width, height], axis=0)
    # The longest edge, 0.943 m, sets the cell: 95 texels.
    np.testing.assert_allclose(side, 95, atol=1e-2)


def test_a_single_tiny_triangle_still_gets_texels():
    uv, size = pack_triangles_singly(np.full((1, 3, 3), 0.5, np.float32), 0.1)
    assert min(size) >= 1 + 2 * PADDING
    assert np.isfinite(uv).all()


@pytest.fixture(scope="module")
def unwrapped():
    """A sphere and a box as two objects, unwrapped at 2 cm."""
    scene = world_of([
        sphere((0, 0, 0), 0.5, 16, 32, (8, 8)), quad((2, 0, 0), (1, 0, 0), (0, 0.5, 0))
    ]).scene  # fmt: skip
    uv, resolution = unwrap(scene, TexelSizes.even(scene, 0.02))
    return replace(scene, corner_uv=uv), resolution


def test_charts_have_texels_of_the_size_that_was_asked_for(unwrapped):
    scene, resolution = unwrapped
    assert scene.corner_uv.min() >= 0
    assert scene.corner_uv.max() <= 1
    texels = texels_from_atlas(scene, resolution)
    for index, area in enumerate((np.pi, 0.5)):
        own = texels.of_object(index)
        # The same density on all objects: area of a texel = 4 cm^2, flattened spheres vary.
        assert np.median(texels.area[own]) == pytest.approx(0.02**2, rel=0.25)
        # xatlas puts a chart's corners onto texel centres, so texels at both ends of a chart count:
        # (51 x 26) / (50 x 25) on the square.
        interior = texels.interior[own]
        assert texels.area[own][interior].sum() == pytest.approx(area, rel=0.08)


@pytest.mark.parametrize("faces", [1, 1 << 30])
def test_children_deal_out_the_objects_as_they_like(unwrapped, monkeypatch, faces):
    """One for each object, or one for all: the same charts."""
    scene, resolution = unwrapped
    monkeypatch.setattr(module, "_FACES_OF_CHILD", faces)
    monkeypatch.setattr(module, "_AT_ONCE", 2)
    uv, again = unwrap(scene, TexelSizes.even(scene, 0.02))
    np.testing.assert_array_equal(uv, scene.corner_uv)
    np.testing.assert_array_equal(again, resolution)


def test_charts_are_the_same_whichever_corner_a_triangle_begins_with(unwrapped):
    """As of faces that were wound backwards, and turned."""
    scene, resolution = unwrapped
    start = np.random.default_rng(3).integers(0, 3, len(scene.triangles))
    order = (start[:, None] + np.arange(3)) % 3
    other = replace(scene, triangles=np.take_along_axis(scene.triangles, order, axis=1))
    uv, again = unwrap(other, TexelSizes.even(other, 0.02))
    expected = np.take_along_axis(scene.corner_uv, order[..., None], axis=1)
    np.testing.assert_array_equal(uv, expected)
    np.testing.assert_array_equal(again, resolution)


def test_no_two_triangles_share_a_texel_centre(unwrapped):
    scene, resolution = unwrapped
    pixel = scene.corner_uv * resolution[scene.face_object][:, None]
    for index in range(2):
        width, height = resolution[index]
        taken = np.zeros((height, width), int)
        for p in pixel[scene.face_object == index].astype(np.float64):
            x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
            a, b = p[1] - p[0], p[2] - p[0]
            det = a[0] * b[1] - a[1] * b[0]
            if abs(det) < 1e-9:
                continue
            u = ((x - p[0, 0]) * b[1] - (y - p[0, 1]) * b[0]) / det
            v = (a[0] * (y - p[0, 1]) - a[1] * (x - p[0, 0])) / det
            taken += (u > 1e-6) & (v > 1e-6) & (u + v < 1 - 1e-6)
        assert taken.max() == 1


def _separate(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and triangles of corners (F, 3, 3)."""
    return corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)


_TEXEL = np.full(3, 0.01)


@pytest.mark.parametrize("nonsense", [25.9, -0.5, np.nan])
def test_a_sliver_that_xatlas_lost_lies_at_its_neighbour(nonsense):
    corners = np.float32([
        [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[1, 0, 0], [1, 1, 0], [0, 1, 0]],
        [[1, 1, 0], [1, 1.0002, 0], [1, 0, 0]],
    ])  # fmt: skip
    uv = corners[..., :2] * 0.5 + 0.1
    uv[2, 1] = nonsense
    mended = beside_neighbours(uv, *_separate(corners), _TEXEL)
    np.testing.assert_array_equal(mended[:2], uv[:2])
    np.testing.assert_array_equal(mended[2], np.broadcast_to(uv[1, 1], (3, 2)))
    # Neither do all of its corners lie at the origin.
    uv[2] = 0
    np.testing.assert_array_equal(beside_neighbours(uv, *_separate(corners), _TEXEL), mended)


def test_no_triangle_that_holds_texels_may_be_lost():
    corners = np.float32([
        [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[1, 0, 0], [1, 1, 0], [0, 1, 0]],
        [[2, 0, 0], [2.02, 0, 0], [2, 0.02, 0]],
    ])  # fmt: skip
    uv = corners[..., :2] * 0.3
    assert beside_neighbours(uv, *_separate(corners), _TEXEL) is not None
    for lost in (1, 2):
        some = uv.copy()
        some[lost] = 25.9
        assert beside_neighbours(some, *_separate(corners), _TEXEL) is None


@pytest.mark.fault("G7")
def test_an_atlas_beyond_the_limit_is_refused_with_the_cure(monkeypatch):
    monkeypatch.setattr("usdbrdf.geometry.unwrap.MAX_SIDE", 64)
    scene = world_of([quad((0, 0, 0), (1, 0, 0), (0, 1, 0))]).scene
    with pytest.raises(InputRefused, match=r"limit 64.*larger --texel-size than 0.01 m"):
        unwrap(scene, TexelSizes.even(scene, 0.01))


def test_each_chart_has_the_density_that_its_pixels_ask_for():
    # A cube whose top is seen finely, whose front coarsely, and the rest of it not at all.
    points = np.float32([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.int32([[a, b, c] for a, b, c, d in sides for a, b, c in ((a, b, c), (a, c, d))])
    scene = _of_one_object(points, triangles)
    side, pixels = np.full(12, 0.04, np.float32), np.zeros(12, np.float32)
    side[10:], pixels[10:] = 0.01, 100
    side[4:6], pixels[4:6] = 0.02, 100
    uv, resolution = unwrap(scene, TexelSizes(side, pixels))
    corner = uv * resolution[0]
    a, b = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    texels = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    np.testing.assert_allclose(np.sqrt(0.5 / texels), side, rtol=0.06)
    assert uv.min() >= 0
    assert uv.max() <= 1


def test_charts_of_many_triangles_are_made_by_parts():
    """As a whole, xatlas crashes on a smooth closed surface of so many, and its time grows with the
    square of their number where they have noise."""
    sphere_of_many = trimesh.creation.icosphere(subdivisions=6)
    triangles = np.asarray(sphere_of_many.faces, np.int32)
    scene = _of_one_object(np.asarray(sphere_of_many.vertices, np.float32), triangles)
    halves = np.where(np.arange(len(triangles)) % 2 == 0, 0.008, 0.016).astype(np.float32)
    for sizes in (TexelSizes.even(scene, 0.01), TexelSizes(halves, np.ones_like(halves))):
        uv, resolution = unwrap(scene, sizes)
        # Texels that nothing needs are those beside charts: each triangle alone would take 150.
        assert resolution.prod() < 3 * 4 * np.pi / 0.01**2
        assert atlas_side(uv, scene.points[triangles], 0.0113) is not None


@pytest.mark.parametrize(("texels", "most"), [(1e9, 32), (1000 * 50, 50), (1, 100)])
def test_parts_hold_every_triangle_once(monkeypatch, texels, most):
    monkeypatch.setattr(module, "_FACES_OF_PART", (32, 100))
    monkeypatch.setattr(module, "_TEXELS_OF_PART", 50 * 50)
    centres = np.random.default_rng(12345).random((1000, 3)).astype(np.float32)
    parts = parts_of(centres, texels)
    assert sorted(np.concatenate(parts)) == list(range(1000))
    assert most / 2 - 1 < min(map(len, parts)) <= max(map(len, parts)) <= most
    # Near each other: within a box of about the share of the volume that their number is.
    extents = np.array([np.ptp(centres[part], axis=0) for part in parts])
    assert extents.prod(axis=1).mean() < 2 * most / 1000


def test_charts_of_a_scan_with_noise_are_those_of_its_surface():
    """Noise bends triangles by tens of degrees, so that without smoothing few make a chart, and
    most of the atlas lies between charts."""
    x, y = np.meshgrid(np.arange(110), np.arange(110), indexing="ij")
    flat = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3) * 0.01
    points = flat + np.random.default_rng(12345).normal(0, 0.0025, flat.shape)
    first = (np.arange(109)[:, None] * 110 + np.arange(109)).reshape(-1, 1)
    triangles = np.concatenate(
        [first + np.array(ends) for ends in ((0, 110, 111), (0, 111, 1))]
    ).astype(np.int32)
    scene = _of_one_object(points.astype(np.float32), triangles)
    uv, resolution = unwrap(scene, TexelSizes.even(scene, 0.004))
    area = np.linalg.norm(np.cross(*np.moveaxis(np.diff(points[triangles], axis=1), 1, 0)), axis=1)
    texels = area.sum() / 2 / 0.004**2
    assert resolution.prod() < 2 * texels  # 5 times as many without
    corners, side = scene.points[triangles], np.full(len(triangles), 0.004, np.float32)
    assert stretched_share(uv * np.float32(resolution[0]), corners, side) < 0.05


def test_smoothing_leaves_a_surface_as_large_as_it_was():
    ball = trimesh.creation.icosphere(subdivisions=4)
    noise = np.random.default_rng(12345).normal(0, 0.005, ball.vertices.shape)
    points, triangles = (ball.vertices + noise).astype(np.float32), np.int32(ball.faces)

    def roughness(of):
        return np.linalg.norm(of, axis=1).std()

    smooth = without_noise(points, triangles, 4)
    assert roughness(smooth) < roughness(points) / 2
    assert np.linalg.norm(smooth, axis=1).mean() == pytest.approx(1, abs=0.002)
    # A triangle stays in its place, and without noise points hardly move.
    flat = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    alone = without_noise(flat, np.int32([[0, 1, 2]]), 2)
    assert alone.shape == flat.shape
    np.testing.assert_allclose(alone.mean(axis=0), flat.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(
        without_noise(np.float32(ball.vertices), triangles, 4), ball.vertices, atol=5e-3
    )


def _of_one_object(points: np.ndarray, triangles: np.ndarray) -> Scene:
    count = len(triangles)
    whole = SceneObject(
        prim_path="/one", identifier="one", label="", class_name="", first_face=0, num_faces=count
    )
    return Scene(
        objects=(whole,),
        points=points,
        triangles=triangles,
        corner_normals=np.zeros((count, 3, 3), np.float32),
        face_object=np.zeros(count, np.int32),
    )


def _two_squares() -> Scene:
    return world_of([
        quad((0, 0, 0), (1, 0, 0), (0, 1, 0)), quad((0, 0, 1), (0, 1, 0), (1, 0, 0)),
    ]).scene  # fmt: skip


def _whole(scene: Scene, uv: np.ndarray, resolution: np.ndarray) -> None:
    """Every triangle has a place of its own in an atlas."""
    assert uv.min() >= 0
    assert uv.max() <= 1
    pixel = (uv * resolution[scene.face_object][:, None]).astype(np.float64)
    a, b = pixel[:, 1] - pixel[:, 0], pixel[:, 2] - pixel[:, 0]
    assert (np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) > 1).all()


@pytest.mark.fault("G5")
@pytest.mark.parametrize("end", ["crash", "spin"])
def test_an_object_that_the_unwrapper_cannot_take_is_packed_triangle_by_triangle(
    monkeypatch, capsys, end
):
    """Alone: the others keep their charts. The child that ends is a real one."""
    scene = _two_squares()
    first = scene.objects[0].num_faces
    child = module.child
    monkeypatch.setattr(module, "child", _with_the_second_object(end, 600, 2))
    uv, resolution = unwrap(scene, TexelSizes.even(scene, 0.1))
    _whole(scene, uv, resolution)
    expected, size = pack_triangles_singly(scene.points[scene.triangles[first:]], 0.1)
    np.testing.assert_array_equal(uv[first:], expected)
    assert tuple(resolution[1]) == size
    monkeypatch.setattr(module, "child", child)
    alone = unwrap(scene, TexelSizes.even(scene, 0.1))
    np.testing.assert_array_equal(uv[:first], alone[0][:first])
    said = capsys.readouterr().err
    assert said.count("warning: ") == 1
    assert re.search(r"packed one by one.*(SIGSEGV|than it may).*\[texturing\.unwrap\]\n$", said)


def test_an_object_for_which_a_busy_machine_had_no_time_is_not_packed_otherwise_for_good(
    monkeypatch, capsys
):
    monkeypatch.setattr(module, "child", _with_the_second_object("wait", 1, 60))
    scene = _two_squares()
    with pytest.raises(LateChild, match=rf"<{scene.objects[1].prim_path}> did not end within 1 s"):
        unwrap(scene, TexelSizes.even(scene, 0.1))
    assert "packed" not in capsys.readouterr().err


def _with_the_second_object(end, seconds, computing):
    """In the place of ``child``; that of the second object, at z = 1, ends so."""
    child = module.child

    def ending(function, arrays, parameters, timeout_s, label, **limits):
        if (arrays["points"][arrays["triangles"]][..., 2] == 1).any():
            function, timeout_s = f"{__name__}:{end}", seconds
            limits = {"cpu_limit_s": computing}
        return child(function, arrays, parameters, timeout_s, label, **limits)

    return ending


def crash(arrays, parameters):
    os.kill(os.getpid(), signal.SIGSEGV)


def spin(arrays, parameters):
    while True:
        pass


def wait(arrays, parameters):
    time.sleep(600)


@pytest.mark.fault("G5")
def test_an_atlas_too_large_after_that_is_refused(monkeypatch, capsys):
    scene = _two_squares()
    monkeypatch.setattr(module, "MAX_SIDE", 25)

    def crashing(*_, **__):
        raise CrashedChild("unwrapping crashed (SIGSEGV). Repair the input. [child.crashed]")

    monkeypatch.setattr(module, "child", crashing)
    with pytest.raises(InputRefused, match=r"\[texturing\.size\]$"):
        unwrap(scene, TexelSizes.even(scene, 0.05))


def test_no_atlas_is_destroyed(unwrapped):
    """xatlas waits there for threads which it may not have woken."""
    scene, _ = unwrapped
    sizes = TexelSizes.even(scene, 0.02)
    sizes.side[0] *= 2  # charts are packed again, in a second atlas
    expected = unwrap(scene, sizes)
    given = [obj.first_face for obj in scene.objects], [obj.num_faces for obj in scene.objects]
    arrays = {"points": scene.points, "triangles": scene.triangles, **sizes._asdict()}
    arrays |= dict(zip(("first", "count"), map(np.array, given), strict=True))
    found = run_child(f"{__name__}:with_undying_atlases", arrays, {}, 60, "unwrapping")
    np.testing.assert_array_equal(found["corner_uv"], expected[0])
    np.testing.assert_array_equal(found["resolution"], expected[1])


def with_undying_atlases(arrays, parameters):
    import xatlas

    class Undying(xatlas.Atlas):
        def __del__(self):
            time.sleep(600)

    xatlas.Atlas = Undying
    return module.unwrap_objects(arrays, parameters)


@pytest.mark.fault("G6")
@pytest.mark.parametrize("fault", ["nan", "outside", "empty atlas", "another number of faces"])
def test_coordinates_that_are_none_are_made_again(monkeypatch, fault):
    """xatlas has been seen to return NaN, and success, for a sphere of 1e-12 across."""

    class Atlas:
        width = 0 if fault == "empty atlas" else 64
        height = 64

        def add_mesh(self, points, triangles):
            self.triangles = triangles

        def generate(self, *_):
            pass

        def __getitem__(self, _):
            uv = np.full((int(self.triangles.max()) + 1, 2), 0.5, np.float32)
            uv[0] = {"nan": np.nan, "outside": 1.5}.get(fault, 0.5)
            faces = self.triangles[1:] if fault.startswith("another") else self.triangles
            return None, faces, uv

    fake = SimpleNamespace(Atlas=Atlas, PackOptions=SimpleNamespace, ChartOptions=SimpleNamespace)
    monkeypatch.setitem(sys.modules, "xatlas", fake)
    scene = _two_squares()
    first = np.array([obj.first_face for obj in scene.objects], np.int64)
    count = np.array([obj.num_faces for obj in scene.objects], np.int64)
    found = module.unwrap_objects(
        {
            "points": scene.points, "triangles": scene.triangles, "first": first, "count": count,
            **TexelSizes.even(scene, 0.1)._asdict(),
        },
        {},
    )  # fmt: skip
    _whole(scene, found["corner_uv"], found["resolution"])
