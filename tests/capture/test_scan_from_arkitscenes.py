"""Videos of ARKitScenes, written after its DATA.md and the loader of its tools."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.format_truth import HEIGHT, WIDTH, assert_same, truth, write_image
from tests.scenes import write_ply
from usdbrdf.capture.adapters import choose_adapter, read_scan
from usdbrdf.capture.checks import Findings
from usdbrdf.capture.conventions import opengl_from_opencv
from usdbrdf.capture.reconstructions.arkitscenes import beside, shots_of
from usdbrdf.errors import InputRefused, MeshMissing
from usdbrdf.options import IngestOptions

OPTIONS = IngestOptions(assume_srgb=True)
VIDEO = "41048143"


def _time(i, every=0.1):
    return 1627.681 + every * i


def _write(folder, room, *, frames=f"{VIDEO}_frames", pictures="lowres_wide", every=0.1):
    place = folder / frames
    (place / f"{pictures}_intrinsics").mkdir(parents=True)
    fx, fy, cx, cy = room.intrinsics[0]
    rows = []
    for i, pose in enumerate(room.opencv):
        name = f"{VIDEO}_{_time(i, every):.3f}"
        write_image(place / pictures / f"{name}.png", room.images[i])
        camera_from_world = np.linalg.inv(pose)
        turn = Rotation.from_matrix(camera_from_world[:3, :3]).as_rotvec()
        # The trajectory has more digits than the names, which some cameras round otherwise.
        numbers = (_time(i, every) + 0.0004, *turn, *camera_from_world[:3, 3])
        rows.append(" ".join(f"{number:.12g}" for number in numbers))
        camera = f"{VIDEO}_{_time(i, every) + 0.001 * (i % 2):.3f}.pincam"
        said = f"{WIDTH} {HEIGHT} {fx} {fy} {cx - 0.5} {cy - 0.5}"
        (place / f"{pictures}_intrinsics" / camera).write_text(said)
    (place / "lowres_wide.traj").write_text("\n".join(rows) + "\n")
    write_ply(folder / f"{VIDEO}_3dod_mesh.ply", room.points, room.triangles)
    return place


@pytest.mark.parametrize("frames", [f"{VIDEO}_frames", "."])
@pytest.mark.parametrize("pictures", ["lowres_wide", "vga_wide"])
def test_the_video_is_the_room(tmp_path, frames, pictures):
    """Of 3dod and raw; where there are larger pictures these."""
    room = truth()
    place = _write(tmp_path, room, frames=frames, pictures=pictures)
    if pictures == "vga_wide":
        write_image(place / "lowres_wide" / f"{VIDEO}_{_time(0):.3f}.png", room.images[0])
    for named in {tmp_path, place}:
        assert choose_adapter(named).name == "arkitscenes"
        scan = read_scan(named, OPTIONS)
        assert_same(scan, room)
        assert (scan.up_axis, scan.meters_per_unit) == ("Z", 1.0)
    read = {file.name for file in beside(place)}
    assert (f"{VIDEO}_3dod_mesh.ply" in read) == (frames != ".")


def _smooth(seconds):
    """A camera that turns and moves evenly, as a hand does; world from camera."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(seconds * np.array([0.3, -0.9, 0.2])).as_matrix()
    pose[:3, 3] = seconds * np.array([0.5, -0.2, 0.1]) + (1, 2, 3)
    return pose


def test_a_picture_between_two_poses_stands_between_them(tmp_path):
    """With a pose 4 ms off, taken as it is, it would be turned by 0.2 degrees."""
    poses = opengl_from_opencv(np.array([_smooth(0.1 * i) for i in range(10)]))
    place = _write(tmp_path, replace(truth(), world_from_camera=poses))
    for file in place.glob("*/*"):
        file.unlink()
    # Rows are 0.4 ms later than their poses, which names in ms cannot tell; after the last is none.
    moments = {0.0: 0.0, 0.004: 0.0036, 0.05: 0.0496, 0.3: 0.3, 0.904: 0.9}
    for after in moments:
        name = f"{VIDEO}_{_time(0) + after:.3f}"
        write_image(place / "lowres_wide" / f"{name}.png", truth().images[0])
        (place / "lowres_wide_intrinsics" / f"{name}.pincam").write_text("32 24 20 20 15 12")
    findings = Findings()
    shots = shots_of(place / "lowres_wide.traj", OPTIONS, findings)
    assert findings.warnings == []
    for shot, moment in zip(shots, moments.values(), strict=True):
        np.testing.assert_allclose(shot.world_from_camera, _smooth(moment), atol=1e-8)


def test_pictures_between_poses_far_apart_are_passed_over(tmp_path):
    room = truth()
    place = _write(tmp_path, room, every=0.2)
    for i in range(9):
        between = f"{VIDEO}_{_time(i, 0.2) + 0.1:.3f}.png"
        write_image(place / "lowres_wide" / between, room.images[i] * 0.9)
    scan = read_scan(tmp_path, OPTIONS)
    assert_same(scan, room)
    assert any("9 pictures were taken between its poses" in said for said in scan.warnings)


def test_where_no_picture_was_taken_when_there_are_poses_that_is_said(tmp_path):
    place = _write(tmp_path, truth())
    rows = np.loadtxt(place / "lowres_wide.traj")
    rows[:, 0] += 500
    np.savetxt(place / "lowres_wide.traj", rows)
    with pytest.raises(InputRefused, match=r"none of the 10 pictures.*when it has poses"):
        read_scan(tmp_path, OPTIONS)


def test_folders_without_pictures_or_cameras_are_passed_over(tmp_path):
    place = _write(tmp_path, truth())
    for name in ("wide", "wide_intrinsics", "vga_wide", "vga_wide_intrinsics"):
        (place / name).mkdir()
    write_image(place / "vga_wide" / f"{VIDEO}_{_time(0):.3f}.png", truth().images[0])
    assert_same(read_scan(tmp_path, OPTIONS), truth())


def test_a_capture_may_be_called_as_a_folder_of_frames(tmp_path):
    folder = tmp_path / "my_frames"
    folder.mkdir()
    place = _write(folder, truth(), frames=".")
    assert_same(read_scan(folder, OPTIONS), truth())
    assert beside(place) == []


def test_the_trajectory_itself_may_be_named(tmp_path):
    place = _write(tmp_path, truth())
    named = place / "lowres_wide.traj"
    assert choose_adapter(named).name == "arkitscenes"
    assert_same(read_scan(named, OPTIONS), truth())
    assert f"{VIDEO}_3dod_mesh.ply" in {file.name for file in beside(named)}


def test_what_is_missing_is_named(tmp_path):
    place = _write(tmp_path, truth())
    (tmp_path / f"{VIDEO}_3dod_mesh.ply").unlink()
    with pytest.raises(MeshMissing, match="asset mesh"):
        read_scan(tmp_path, OPTIONS)
    for camera in (place / "lowres_wide_intrinsics").iterdir():
        camera.write_text("32 24\n")
    with pytest.raises(InputRefused, match="it has no camera"):
        read_scan(tmp_path, OPTIONS)
    (place / "lowres_wide.traj").write_text("1 2 3\n")
    with pytest.raises(InputRefused, match="not rows of a time and six numbers"):
        read_scan(tmp_path, OPTIONS)


@pytest.mark.parametrize("copy", ["{} (1)", "thumb_{}", "thumbs/{}", "backup/{}_edited"])
def test_copies_of_pictures_are_no_frames(tmp_path, copy):
    room = truth()
    place = _write(tmp_path, room)
    for i in range(10):
        name = copy.format(f"{VIDEO}_{_time(i):.3f}")
        write_image(place / "lowres_wide" / f"{name}.png", room.images[(i + 5) % 10][::2, ::2])
    assert_same(read_scan(tmp_path, OPTIONS), room)
