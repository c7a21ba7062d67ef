"""Frames that do not fit to each other, to their intrinsics or to the mesh."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

import usdbrdf
from tests.scenes import camera_at, edited, look_at, make_capture, rescale_images
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import open_measured
from usdbrdf.capture.adapters import read_scan
from usdbrdf.errors import InputRefused
from usdbrdf.files.images import read_exr, write_exr
from usdbrdf.options import IngestOptions
from usdbrdf.transport.rays import RayScene

TEXTURE = usdbrdf.TextureOptions(texel_size=0.2)


def _without_size(document):
    for owner in (document, *document["frames"]):
        owner.pop("w", None), owner.pop("h", None)


@pytest.mark.fault("I6")
@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("odd", [[7], range(1, 12, 2)], ids=["one", "every second"])
def test_images_of_one_camera_in_two_sizes(tmp_path, odd, stated):
    """A smaller part of the picture, a little off the centre: no intrinsics could be scaled."""
    made = make_capture(tmp_path / "scan")
    for i in odd:
        write_exr(made.image(i), read_exr(made.image(i))[:-2, :-5])
    if not stated:
        with edited(made.manifest) as document:
            _without_size(document)
    if len(odd) > 1:
        with pytest.raises(InputRefused, match=r"27 x 22 .*32 x 24.*\[capture\.size\]$") as refused:
            read_scan(made.folder, IngestOptions())
        assert "frames/0001.exr" in str(refused.value)
        assert stated or "frames/0000.exr" in str(refused.value)
        return
    scan = read_scan(made.folder, IngestOptions())
    assert [path.name for path in scan.frames.image_paths].count("0007.exr") == 0
    (warning,) = scan.warnings
    assert "27 x 22" in warning
    assert "32 x 24" in warning


@pytest.mark.fault("I6")
@pytest.mark.fault("I7")
def test_images_of_half_the_size_have_their_intrinsics_scaled(tmp_path):
    made = make_capture(tmp_path / "scan")
    rescale_images(made, 0.5)
    shutil.copy(tmp_path / "scan/frames/0003.exr", tmp_path / "small.exr")
    scan = read_scan(made.folder, IngestOptions())
    np.testing.assert_allclose(scan.frames.intrinsics, np.tile(made.intrinsics / 2, (12, 1)))
    assert "16 x 12 pixels, but the intrinsics are for 32 x 24" in scan.warnings[0]


@pytest.mark.fault("C6")
@pytest.mark.parametrize("again", ["./frames/0004.exr", "frames/../frames/0004.exr", "link.exr"])
def test_one_file_under_two_names_is_one_frame_listed_twice(tmp_path, again):
    made = make_capture(tmp_path / "scan")
    (made.folder / "link.exr").symlink_to("frames/0004.exr")
    with edited(made.manifest) as document:
        document["frames"].append({**document["frames"][4], "file_path": again})
    with pytest.raises(InputRefused, match=r"listed twice.*\[capture\.duplicate\]$"):
        read_scan(made.folder, IngestOptions())


@pytest.mark.fault("C6")
def test_names_that_differ_in_case_alone_are_frames_of_their_own(tmp_path):
    """Where the file system tells them apart; where it does not, they are one file twice."""
    made = make_capture(tmp_path / "scan")
    twin = made.folder / "frames/0004.EXR"
    if twin.exists():
        pytest.skip("this file system does not tell cases apart")
    made.image(5).rename(twin)
    with edited(made.manifest) as document:
        document["frames"][5]["file_path"] = "frames/0004.EXR"
    scan = read_scan(made.folder, IngestOptions())
    assert len(scan.frames) == 12
    np.testing.assert_allclose(scan.frames.world_from_camera[5], made.world_from_camera[5])
    # The same content under either name is no frame of its own.
    shutil.copy(made.image(4), twin)
    scan = read_scan(made.folder, IngestOptions())
    assert len(scan.frames) == 11
    assert "the same image as 'frames/0004.exr'" in scan.warnings[0]


@pytest.mark.fault("G12")
@pytest.mark.parametrize("room", [True, False])
def test_a_camera_inside_of_an_object_is_dropped(tmp_path, room):
    made = make_capture(tmp_path / "scan", frames=14, room=room)
    inside = look_at(np.array([2.0, 1.5, 0.3]), np.array([2.4, 1.6, 0.35]))
    with edited(made.manifest) as document:
        document["frames"][3]["transform_matrix"] = inside.tolist()
    scan = read_scan(made.folder, IngestOptions())
    assert len(scan.frames) == 13
    (warning,) = scan.warnings
    assert "frames/0003.exr" in warning
    assert warning.endswith("(limit 50%). [capture.inside]")


@pytest.mark.fault("C15")
def test_what_moved_between_frames_is_a_spread_and_no_error(tmp_path):
    """In every second frame the box has another paint: its texels spread, others do not."""
    made = make_capture(tmp_path / "scan", noise=0.01, noise_floor_radiance=0)
    box, rays = made.names.index("box"), RayScene(made.points, made.triangles)
    for i in range(0, 12, 2):
        camera = camera_at(made.world_from_camera[i], made.intrinsics, 32, 24)
        face = rays.closest(*camera.rays(camera.pixels())).face.reshape(24, 32)
        image = read_exr(made.image(i))
        image[(face >= 0) & (made.face_object[face] == box)] *= 1.3
        write_exr(made.image(i), image)
    with usdbrdf.working_on(tmp_path / "asset") as asset:
        usdbrdf.ingest(made.folder, asset, IngestOptions())
        found = usdbrdf.texture(asset, TEXTURE)
    assert found.summary["contradicting_frames"] == {}
    maps = AssetMaps(open_measured(asset))
    spread = maps.map("spread").mean(axis=1) / maps.map("lit").mean(axis=1)
    owner = maps.texels.object_index()
    moved = np.array([obj.label == "box" for obj in maps.scene.objects])[owner]
    measured = maps.coverage.measured
    assert spread[measured & moved].mean() > 4 * spread[measured & ~moved].mean()
