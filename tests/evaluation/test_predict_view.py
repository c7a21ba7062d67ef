"""Pictures of an asset whose radiance is known everywhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes import camera_at, look_at
from usdbrdf.asset.readers.views import Views
from usdbrdf.evaluation.evaluate_views import (
    measured_atlas,
    predict_view,
    scored_views,
    viewed_asset,
)
from usdbrdf.files.colour import to_display_srgb
from usdbrdf.options import EvaluateOptions
from usdbrdf.transport.environment import Environment
from usdbrdf.transport.surface_texture import surface_texture

SIZE = (40, 30)
LENS = (24.0, 24.0, 20.0, 15.0)
POSE = look_at(np.array([3.0, 0.6, 1.5]), np.array([1.8, 1.5, 0.8]))
CAMERA = camera_at(POSE, LENS, *SIZE)
QUICK = EvaluateOptions(samples_per_pixel=1, rays=8)


@pytest.fixture(scope="module")
def seen(room):
    return viewed_asset(*measured_atlas(room.asset), None)


def test_the_baseline_is_the_radiance_of_what_lies_behind_each_pixel(room, seen):
    fine = predict_view(seen, CAMERA, EvaluateOptions(samples_per_pixel=4, rays=4 * 8), 0)
    scene = seen.lit.scene
    table = np.array([room.capture.radiance[obj.label] for obj in scene.objects])
    # Found again by projecting the faces' centres, through none of the renderer's code.
    centres = scene.points[scene.triangles].mean(axis=1)
    local = (centres - POSE[:3, 3]) @ POSE[:3, :3]
    x = LENS[2] + LENS[0] * local[:, 0] / -local[:, 2]
    y = LENS[3] - LENS[1] * local[:, 1] / -local[:, 2]
    inside = (local[:, 2] < 0) & (x > 0) & (x < SIZE[0]) & (y > 0) & (y < SIZE[1])
    towards = (POSE[:3, 3] - centres).astype(np.float32)
    start = (centres + 1e-3 * towards).astype(np.float32)
    free = seen.lit.rays.closest(start, towards).distance > 0.99
    checked = np.flatnonzero(inside & free)
    shown = fine.baseline[y[checked].astype(int), x[checked].astype(int)]
    close = np.abs(shown - table[scene.face_object[checked]]).max(axis=1) < 0.01
    assert len(checked) > 30
    # A pixel at the edge of two objects is a mixture.
    assert close.mean() > 0.85


def test_nothing_is_claimed_where_the_scan_has_a_hole(seen):
    away = POSE.copy()
    away[:3, 3] += 10
    empty = predict_view(seen, replace(CAMERA, world_from_camera=away), QUICK, 0)
    assert not empty.surface.all()
    assert (empty.full[~empty.surface] == 0).all()


def test_more_points_per_pixel_are_a_mean_of_more_pixels(seen):
    # 3 x 3 points of a pixel are the centres of 3 x 3 smaller ones.
    coarse = predict_view(seen, CAMERA, EvaluateOptions(samples_per_pixel=9, rays=9 * 8), 0)
    fine = predict_view(seen, CAMERA.at_size(3 * SIZE[0], 3 * SIZE[1]), QUICK, 0)
    mean = fine.baseline.reshape(SIZE[1], 3, SIZE[0], 3, 3).mean(axis=(1, 3))
    assert np.abs(mean - coarse.baseline).max() < 1e-5
    lamp = fine.lamp.reshape(SIZE[1], 3, SIZE[0], 3).any(axis=(1, 3))
    assert (lamp == coarse.lamp).all()


def test_lamps_show_what_was_measured(room, seen):
    _, atlas = measured_atlas(room.asset)
    box = [obj.label for obj in seen.lit.scene.objects].index("box")
    mask = np.repeat(atlas.texels.object_index()[:, None] == box, 3, axis=1).astype(np.float32)
    emission = surface_texture(atlas.texels, atlas.scene.face_object, mask)
    shining = replace(seen, lit=replace(seen.lit, emission=emission))
    picture = predict_view(shining, CAMERA, QUICK, 0)
    assert picture.lamp.any()
    assert (picture.full[picture.lamp] == picture.baseline[picture.lamp]).all()
    lit = ~picture.lamp & picture.surface
    assert (picture.full[lit] >= picture.baseline[lit]).all()
    assert (picture.full[lit] > picture.baseline[lit]).any()


def test_an_object_without_a_lobe_has_no_specular_light(seen):
    unknown = replace(seen, phi=np.full_like(seen.phi, np.nan))
    picture = predict_view(unknown, CAMERA, QUICK, 0)
    assert (picture.full == picture.baseline).all()


def test_where_specular_light_was_taken_out_the_full_model_starts_from_the_rest(separated):
    place, atlas = measured_atlas(separated.asset)
    seen = viewed_asset(place, atlas, None)
    dull = replace(seen, psi=np.zeros_like(seen.psi), lit=in_the_dark(seen.lit))
    picture = predict_view(dull, CAMERA, QUICK, 0)
    assert (picture.baseline > 0).all()
    assert np.abs(picture.full / picture.baseline - 0.5).max() < 1e-3


def in_the_dark(lit):
    dark = lit.radiance._replace(pixels=np.zeros_like(lit.radiance.pixels))
    return replace(lit, radiance=dark)


def test_a_reduced_view_is_a_mean_as_its_photograph_is(room, seen):
    """The photographs show one radiance per object, so that edges alone can differ."""
    _, atlas = measured_atlas(room.asset)
    frames = atlas.frames.at([0, 1])
    views = Views(names=("0", "1"), frames=frames)
    half = frames.camera(0).width // 2
    scored = list(scored_views(seen, views, 1.0, QUICK, [half, half]))
    off = point_off = 0.0
    for i, view in enumerate(scored):
        camera = frames.camera(i).at_width(half)
        point = to_display_srgb(
            predict_view(seen, camera, QUICK, i << 16).baseline, exposure_scale=1.0
        )
        off += np.abs(view.shown["baseline"] - view.reference)[view.counted].mean()
        point_off += np.abs(point - view.reference)[view.counted].mean()
    assert off < 0.6 * point_off


def test_through_panes_the_full_model_shows_what_is_behind_them(seen):
    labels = [obj.label for obj in seen.lit.scene.objects]
    image = np.random.default_rng(3).uniform(5, 9, (16, 32, 3)).astype(np.float32)
    lit = replace(seen.lit, environment=Environment(image, True))
    unknown = replace(seen, lit=lit, phi=np.full_like(seen.phi, np.nan))
    plain = predict_view(unknown, CAMERA, QUICK, 0)
    face = lit.rays.closest(*CAMERA.rays(CAMERA.pixels())).face
    owner = lit.owner(face).reshape(SIZE[::-1])
    box, walls = labels.index("box"), labels.index("walls")

    clear = replace(unknown, lit=replace(lit, panes=(box,)), shown=())
    picture = predict_view(clear, CAMERA, QUICK, 0)
    # As in a world without it; all else stays, and so does the baseline.
    absent = replace(unknown, lit=replace(lit, rays=clear.lit.light_rays))
    behind = predict_view(absent, CAMERA, QUICK, 0)
    assert (owner == box).sum() > 20
    np.testing.assert_allclose(picture.full[owner == box], behind.baseline[owner == box], rtol=1e-4)
    assert np.abs(picture.full - plain.full)[owner == box].max() > 0.1
    np.testing.assert_array_equal(picture.full[owner != box], plain.full[owner != box])
    np.testing.assert_array_equal(picture.baseline, plain.baseline)

    # A person may say that it is a metal, and it is shown as renderers are told.
    assert box in unknown.shown
    picture = predict_view(replace(clear, shown=unknown.shown), CAMERA, QUICK, 0)
    np.testing.assert_array_equal(picture.full, plain.full)

    # What is past all walls is the sky, which is no hole of the scan.
    clear = replace(clear, lit=replace(lit, panes=(walls,)))
    picture = predict_view(clear, CAMERA, QUICK, 0)
    assert (owner == walls).sum() > 100
    assert picture.full[owner == walls].min() >= 5
    assert picture.surface.all() == plain.surface.all()
