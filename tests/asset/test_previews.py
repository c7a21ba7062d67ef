"""Pictures of the maps from a capture camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import usdbrdf
from tests.scenes import MadeCapture, look_at, make_capture, ring_of_poses
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import overview, overview_frame
from usdbrdf.asset.readers.compose import open_edited
from usdbrdf.asset.readers.scene import frames_from_stage, scene_from_stage
from usdbrdf.files.colour import to_display_srgb8
from usdbrdf.files.images import read_exr
from usdbrdf.job.progress import set_quiet
from usdbrdf.transport.rays import RayScene

PICTURES = ("lit", "albedo", "irradiance")


def _made(folder: Path, capture: MadeCapture) -> Path:
    set_quiet(True)
    with usdbrdf.working_on(folder) as asset:
        usdbrdf.ingest(capture.folder, asset, usdbrdf.IngestOptions())
        usdbrdf.texture(asset, usdbrdf.TextureOptions(texel_size=0.1))
        sampling = usdbrdf.Sampling(standard_error=0.1, max_rays=64)
        usdbrdf.shade(asset, usdbrdf.ShadeOptions(sampling=sampling))
    set_quiet(False)
    return folder


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> MadeCapture:
    # The first cameras see next to nothing: one looks at a wall from near, one at the ceiling.
    near = look_at(np.array([0.3, 1.5, 1.2]), np.array([0.0, 1.5, 1.21]))
    up = look_at(np.array([0.4, 0.4, 1.8]), np.array([0.39, 0.4, 2.5]))
    poses = np.concatenate([[near, up], ring_of_poses(6)])
    return make_capture(tmp_path_factory.mktemp("scan"), subdivisions=1, poses=poses)


@pytest.fixture(scope="module")
def asset(tmp_path_factory, capture) -> Path:
    return _made(tmp_path_factory.mktemp("preview") / "room", capture)


def test_the_pictures_are_the_tools_and_the_same_every_time(tmp_path, capture, asset):
    again = _made(tmp_path / "room", capture)
    stamps = "".join(file.read_text() for file in sorted((asset / ".usdbrdf/stamps").glob("*")))
    for name in PICTURES:
        file = f"previews/{name}.png"
        assert file in stamps
        assert (asset / file).read_bytes() == (again / file).read_bytes()


def test_the_lit_picture_is_the_photograph_exposed(capture, asset):
    frames = frames_from_stage(open_edited(Asset.at(asset)))
    scene = scene_from_stage(open_edited(Asset.at(asset)))
    chosen = overview_frame(scene, RayScene(scene.points, scene.triangles), frames)
    assert chosen >= 2
    photograph = read_exr(capture.image(chosen))
    level = np.percentile(photograph.mean(axis=2), 90)
    expected = to_display_srgb8(photograph, exposure_scale=float(0.8 / level))
    shown = np.round(255 * read_exr(asset / "previews/lit.png")[..., :3])
    assert shown.shape == expected.shape
    # Pixels on an edge of two objects may show a texel of either.
    assert (np.abs(shown - expected) <= 1).mean() > 0.9


def test_a_large_frame_is_seen_640_pixels_wide(asset):
    stage = open_edited(Asset.at(asset))
    frames, scene = frames_from_stage(stage), scene_from_stage(stage)
    rays = RayScene(scene.points, scene.triangles)
    small = overview(scene, rays, frames)
    assert (small.width, small.height) == (32, 24)
    frames.resolution[:] *= 40
    frames.intrinsics[:] *= 40
    large = overview(scene, rays, frames)
    assert (large.width, large.height) == (640, 480)
    # The same view, 20 times finer: each coarse pixel's centre lies between four fine ones.
    fine = large.hits.face.reshape(480, 640)[10::20, 10::20].ravel()
    assert (scene.face_object[fine] == scene.face_object[small.hits.face]).mean() > 0.97
