"""The export folder of the iOS scanner app."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import trimesh

from tests.scenes import edited, make_capture, room_mesh
from usdbrdf.capture.adapters import read_scan
from usdbrdf.errors import InputRefused
from usdbrdf.files.frames import read_frame
from usdbrdf.files.images import read_exr
from usdbrdf.options import IngestOptions


def make_export(folder: Path) -> tuple[Path, np.ndarray]:
    """Twelve photographs among 24 poses; exposures 1/50 s and 1/100 s in turn."""
    capture = make_capture(folder / "capture")
    export = folder / "export"
    export.mkdir()
    points, triangles, _, _ = room_mesh()
    lines = [f"v {x} {y} {z}" for x, y, z in points.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (triangles + 1).tolist()]
    (export / "export.obj").write_text("\n".join(lines) + "\n")
    poses = capture.world_from_camera.astype(np.float32)
    poses[:, 3, 3] = 0.99999988
    fx, fy, cx, cy = capture.intrinsics.tolist()
    for i in range(24):
        pose = {
            "cameraPoseARFrame": poses[i // 2].astype(float).reshape(-1).tolist(),
            "intrinsics": [fx, 0, cx - 0.5, 0, fy, cy - 0.5, 0, 0, 1],
            "projectionMatrix": [2 * fx / 32, 0, 0, 0, 0, 2 * fy / 24, *[0] * 10],
            "exposureDuration": 0.02 if i % 4 else 0.01,
            "frame_index": i,
        }
        (export / f"frame_{i:05d}.json").write_text(json.dumps(pose))
        if i % 2 == 0:
            light = read_exr(capture.image(i // 2)) * (pose["exposureDuration"] / 0.02)
            code = np.where(light < 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)
            _write_jpeg(export / f"frame_{i:05d}.jpg", np.clip(code * 255 + 0.5, 0, 255))
    (export / "info.json").write_text("{}")
    return export, capture.world_from_camera


def _write_jpeg(path: Path, pixels: np.ndarray) -> None:
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, "uint8")
    spec.attribute("compression", "jpeg:100")
    spec.attribute("jpeg:subsampling", "4:4:4")
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec)
    assert output.write_image(pixels.astype(np.uint8))
    assert output.close()


def test_poses_with_photographs_are_read_and_the_others_counted(tmp_path):
    export, poses = make_export(tmp_path)
    scan = read_scan(export, IngestOptions())
    assert (scan.adapter, scan.up_axis, scan.meters_per_unit) == ("scanner-app", "Y", 1.0)
    assert scan.counts["poses_without_photograph"] == 12
    assert len(scan.frames) == 12
    np.testing.assert_allclose(scan.frames.world_from_camera, poses, atol=1e-6)
    np.testing.assert_allclose(scan.frames.intrinsics[0], [19.2, 19.2, 16, 12])
    assert scan.frames.encoding == "srgb_rec709_scene"
    assert not scan.frames.radiometric
    assert any("not radiometric" in warning for warning in scan.warnings)


def test_frames_of_different_exposure_show_the_same_radiance(tmp_path):
    export, _ = make_export(tmp_path)
    scan = read_scan(export, IngestOptions())
    assert sorted(set(scan.frames.exposure_time)) == [0.01, 0.02]
    # The unit is that of an exposure of 0.015 s, the median; the room was made for 0.02 s.
    floor = 0.75 * np.array([0.25, 0.125, 0.0625])
    for i in range(2):
        pixels = read_frame(scan.frames, i)
        share = (np.abs(pixels.radiance - floor).max(axis=2) < 0.01).mean()
        assert 0.1 < share < 0.7


def test_another_mesh_can_be_chosen(tmp_path):
    export, _ = make_export(tmp_path)
    points, triangles, _, _ = room_mesh(subdivisions=2)
    trimesh.Trimesh(points, triangles, process=False).export(tmp_path / "fused.ply")
    scan = read_scan(export, IngestOptions(mesh=tmp_path / "fused.ply"))
    assert len(scan.mesh.triangles) == len(triangles)
    names = [o.identifier for o in scan.objects]
    # The room's shell, the box and the lamp do not touch.
    assert names == ["part_001", "part_002", "part_003"]


@pytest.mark.parametrize("suffix", [".JPG", ".jpeg", ".png"])
def test_photographs_that_were_copied_or_converted(tmp_path, suffix):
    export, poses = make_export(tmp_path)
    expected = read_scan(export, IngestOptions())
    for photograph in export.glob("*.jpg"):
        if suffix == ".png":
            oiio.ImageBuf(str(photograph)).write(str(photograph.with_suffix(suffix)))
            photograph.unlink()
        else:
            photograph.rename(photograph.with_suffix(suffix))
    scan = read_scan(export, IngestOptions())
    assert len(scan.frames.world_from_camera) == len(poses)
    np.testing.assert_array_equal(scan.frames.world_from_camera, expected.frames.world_from_camera)


def test_a_folder_without_photographs_is_refused(tmp_path):
    export, _ = make_export(tmp_path)
    for photograph in export.glob("*.jpg"):
        photograph.unlink()
    with pytest.raises(InputRefused, match=r"24 poses, but no photograph.*\[capture.frames\]"):
        read_scan(export, IngestOptions())


@pytest.mark.fault("C9")
def test_missing_exposures_count_as_equal(tmp_path):
    export, _ = make_export(tmp_path)
    with edited(export / "frame_00004.json") as document:
        del document["exposureDuration"]
    scan = read_scan(export, IngestOptions())
    assert (scan.frames.exposure_time == 1).all()
    assert any("exposureDuration" in warning for warning in scan.warnings)


@pytest.mark.parametrize(("shape", "usable"), [((48, 64, 3), 12), ((48, 48, 3), 11)])
def test_a_photograph_of_another_size_has_its_camera_scaled_or_is_dropped(tmp_path, shape, usable):
    export, _ = make_export(tmp_path)
    _write_jpeg(export / "frame_00004.jpg", np.zeros(shape) + 100)
    scan = read_scan(export, IngestOptions())
    assert len(scan.frames) == usable
    said = f"{shape[1]} x {shape[0]} pixels, but the intrinsics are for 32 x 24"
    assert any(said in warning for warning in scan.warnings)
    if usable == 12:
        np.testing.assert_allclose(scan.frames.intrinsics[2], [38.4, 38.4, 32, 24])
