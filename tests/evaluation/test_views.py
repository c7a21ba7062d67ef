"""A document of views lines up with the asset of its capture."""

from __future__ import annotations

import numpy as np
import pytest

import usdbrdf
from tests.lens_scenes import capture_through, surface_of
from tests.scenes import edited, make_capture, ring_of_poses
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import open_weaker
from usdbrdf.asset.readers.scene import frames_from_stage
from usdbrdf.asset.readers.views import photographs_of_views
from usdbrdf.errors import InputRefused
from usdbrdf.evaluation.evaluate_views import measured_atlas
from usdbrdf.files.frames import read_frame
from usdbrdf.files.images import read_exr, write_exr, write_preview_png


def read(asset, document):
    place, atlas = measured_atlas(asset)
    return atlas, photographs_of_views(document, place, atlas.stage, atlas.scene, document.parent)


def test_the_captures_own_document_gives_its_frames(room):
    atlas, views = read(room.asset, room.capture.manifest)
    frames = frames_from_stage(atlas.stage)
    assert np.abs(views.frames.world_from_camera - frames.world_from_camera).max() < 1e-9
    assert np.array_equal(views.frames.intrinsics, frames.intrinsics)
    assert np.array_equal(views.frames.saturation_radiance, frames.saturation_radiance)
    assert views.names[:2] == ("frames/0000.exr", "frames/0001.exr")


def test_in_another_unit_and_with_scaled_axes(tmp_path):
    capture = make_capture(tmp_path / "scan")
    with edited(capture.manifest) as document:
        for frame in document["frames"]:
            pose = np.array(frame["transform_matrix"])
            pose[:3, :3] *= 2
            frame["transform_matrix"] = pose.tolist()
    options = usdbrdf.IngestOptions(meters_per_unit=0.5, pose_scale=2.0)
    with usdbrdf.working_on(tmp_path / "room") as asset:
        usdbrdf.ingest(capture.folder, asset, options)
        usdbrdf.texture(asset, usdbrdf.TextureOptions(texel_size=0.3))
    atlas, views = read(tmp_path / "room", capture.manifest)
    frames = frames_from_stage(atlas.stage)
    assert np.abs(frames.world_from_camera[:, :3, 3]).max() < 2
    assert np.abs(views.frames.world_from_camera - frames.world_from_camera).max() < 1e-9


def test_an_applied_transform_is_undone(room, tmp_path):
    turn = np.array([[0.0, 1, 0, 3], [1, 0, 0, -2], [0, 0, -1, 1], [0, 0, 0, 1]])
    held_out = make_capture(tmp_path, poses=ring_of_poses(5))
    with edited(held_out.manifest) as document:
        document["applied_transform"] = turn[:3].tolist()
        for frame in document["frames"]:
            frame["transform_matrix"] = (turn @ np.array(frame["transform_matrix"])).tolist()
    _, views = read(room.asset, held_out.manifest)
    assert np.abs(views.frames.world_from_camera - held_out.world_from_camera).max() < 1e-9


@pytest.mark.parametrize(("model", "faces"), [("OPENCV", 1), ("EQUIRECTANGULAR", 6)])
def test_views_through_lenses_become_pinhole_frames(room, tmp_path, model, faces):
    pytest.importorskip("pycolmap")
    held_out = capture_through(tmp_path, model, frames=3)
    _, views = read(room.asset, held_out.manifest)
    assert len(views.frames) == len(views.names) == 3 * faces
    assert views.names[0] == "frames/0000.exr" + (" front" if faces > 1 else "")
    seen = 0
    for i in range(len(views.frames)):
        pixels, shown = read_frame(views.frames, i), surface_of(held_out, views.frames.camera(i))
        for k, name in enumerate(held_out.names):
            own = (shown == k) & pixels.valid
            seen += int(own.sum())
            off = np.abs(pixels.radiance[own] / held_out.radiance[name] - 1)
            assert off.max(initial=0) < 0.01, (views.names[i], name)
    assert seen > 500


# Linear Rec.709 to those of ACEScct and of Display P3 (SMPTE ST 2065-1, EG 432-1), by white D65
# adapted to ACES' own after Bradford; and how either encodes them (S-2016-001; IEC 61966-2-1).
AP1 = np.array(
    [[0.61310, 0.33952, 0.04738], [0.07019, 0.91635, 0.01345], [0.02062, 0.10957, 0.86981]]
)
P3 = np.array([[0.82246, 0.17754, 0.0], [0.03319, 0.96681, 0.0], [0.01708, 0.07240, 0.91052]])


def _acescct(image):
    linear = image @ AP1.T
    return np.where(
        linear > 0.0078125, (np.log2(linear) + 9.72) / 17.52, 10.5402377 * linear + 0.0729
    )


def _display_p3(image):
    linear = np.clip(image @ P3.T, 0, 1)
    return np.where(linear > 0.0031308, 1.055 * linear ** (1 / 2.4) - 0.055, 12.92 * linear)


@pytest.mark.parametrize(
    ("encoding", "encoded"), [("ACEScct", _acescct), ("srgb_p3d65_scene", _display_p3)]
)
def test_views_through_lenses_have_the_colours_of_the_captures_photographs(
    tmp_path, encoding, encoded
):
    pytest.importorskip("pycolmap")
    capture = capture_through(tmp_path / "scan", "OPENCV")
    displayed = encoded is _display_p3
    with edited(capture.manifest) as document:
        for i, frame in enumerate(document["frames"]):
            image = encoded(np.maximum(read_exr(capture.image(i)), 1e-9))
            if displayed:
                frame["file_path"] = f"frames/{i:04d}.png"
                del frame["saturation_radiance"]
                codes = (255 * image + 0.5).astype(np.uint8)
                write_preview_png(capture.folder / frame["file_path"], codes)
            else:
                write_exr(capture.image(i), image.astype(np.float32), half=False)
    options = usdbrdf.IngestOptions(encoding=encoding, assume_srgb=displayed)
    with usdbrdf.working_on(tmp_path / "room") as asset:
        usdbrdf.ingest(capture.folder, asset, options)
    atlas = AssetMaps(open_weaker(asset, "texturing"))
    assert atlas.frames.photograph_encoding == encoding
    folder = tmp_path / "developed"
    folder.mkdir()
    views = photographs_of_views(capture.manifest, asset, atlas.stage, atlas.scene, folder)
    pixels, shown = read_frame(views.frames, 3), surface_of(capture, views.frames.camera(3))
    seen = 0
    for k, name in enumerate(capture.names):
        own = (shown == k) & pixels.valid
        seen += int(own.sum())
        off = np.abs(pixels.radiance[own] / capture.radiance[name] - 1)
        assert off.max(initial=0) < 0.03, name
    assert seen > 200


def test_a_view_that_cannot_be_used_is_left_out(room, tmp_path):
    held_out = make_capture(tmp_path, poses=ring_of_poses(3))
    held_out.image(1).unlink()
    _, views = read(room.asset, held_out.manifest)
    assert views.names == ("frames/0000.exr", "frames/0002.exr")


def test_no_view_left_is_refused(room, tmp_path):
    held_out = make_capture(tmp_path, poses=ring_of_poses(3))
    for i in range(3):
        held_out.image(i).write_bytes(b"no image")
    with pytest.raises(InputRefused, match=r"0000.*not a readable image.*\[evaluate.views\]"):
        read(room.asset, held_out.manifest)


def test_cameras_that_do_not_see_the_asset_are_refused(room, tmp_path):
    held_out = make_capture(tmp_path, poses=ring_of_poses(3))
    with edited(held_out.manifest) as document:
        for frame in document["frames"]:
            frame["transform_matrix"][0][3] += 50
    with pytest.raises(InputRefused, match=r"\[capture.convention\]"):
        read(room.asset, held_out.manifest)
