"""Scans of telephones and depth sensors, written after what their authors publish of them: Record3D
(marek-simonik/record3d, issues 27, 36, 64 and 83), Stray Scanner (strayrobots/scanner,
docs/format.md and OdometryEncoder.swift), Open3D (FileLOG.cpp, PinholeCameraTrajectory.cpp,
IJsonConvertible.cpp) and Matterport3D (data_organization.md)."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.format_truth import HEIGHT, WIDTH, assert_bends, assert_same, truth, write_image
from tests.scenes import write_ply
from usdbrdf.capture.adapters import choose_adapter, files_beside, read_scan
from usdbrdf.errors import InputRefused, MeshMissing
from usdbrdf.options import IngestOptions

OPTIONS = IngestOptions(assume_srgb=True)
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def _room():
    """One whose pictures all have lenses of their own, as those of telephones do."""
    room = truth()
    own = room.intrinsics + np.linspace(0, 0.4, len(room.images))[:, None] * (1, 1, -1, 0.5)
    return replace(room, intrinsics=own)


def _quaternion(turn):
    """x, y, z, w of a 3 x 3 rotation (Shepperd, by its largest part)."""
    t = np.trace(turn)
    parts = [*(1 + 2 * np.diag(turn) - t), 1 + t]
    k = int(np.argmax(parts))
    q = np.zeros(4)
    q[k] = np.sqrt(parts[k]) / 2
    if k == 3:
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            q[i] = (turn[b, a] - turn[a, b]) / (4 * q[3])
    else:
        a, b = (k + 1) % 3, (k + 2) % 3
        q[3] = (turn[b, a] - turn[a, b]) / (4 * q[k])
        q[a] = (turn[a, k] + turn[k, a]) / (4 * q[k])
        q[b] = (turn[b, k] + turn[k, b]) / (4 * q[k])
    return q


def _pictures(folder, room, name, numbers=None):
    for i in range(len(room.images)) if numbers is None else numbers:
        write_image(folder / name.format(i), room.images[i])


def _mesh(path, room, pose=None):
    points = room.points if pose is None else room.points @ pose[:3, :3].T
    path.parent.mkdir(parents=True, exist_ok=True)
    write_ply(path, points, room.triangles)


def _write_record3d(folder, room, *, place="rgbd", per_frame=True, extra=(), **stated):
    """An unzipped .r3d; with rgb/ and metadata.json its export of EXR and JPG."""
    rows = [[*_quaternion(pose[:3, :3]), *pose[:3, 3]] for pose in room.world_from_camera]
    fx, fy, cx, cy = room.intrinsics[0]
    document = {
        "frameTimestamps": [i / 60 for i in range(600)],
        "poses": [*rows, *extra],
        "K": [fx, 0, 0, 0, fy, 0, cx, cy, 1],
        "w": WIDTH, "h": HEIGHT, "dw": 16, "dh": 12, "fps": 60, "initPose": [0, 0, 0, 1, 0, 0, 0],
    }  # fmt: skip
    if per_frame:
        document["perFrameIntrinsicCoeffs"] = [*room.intrinsics.tolist(), *([[1] * 4] * len(extra))]
    name = "metadata" if place == "rgbd" else "metadata.json"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(json.dumps(document | stated))
    _pictures(folder, room, place + "/{}.jpg")
    (folder / place / "0.depth").write_bytes(b"bvx2")
    _mesh(folder / "mesh.ply", room)


@pytest.mark.parametrize("place", ["rgbd", "rgb"])
@pytest.mark.parametrize("per_frame", [True, False])
def test_record3d_is_the_room(tmp_path, place, per_frame):
    room = _room() if per_frame else truth()
    _write_record3d(tmp_path, room, place=place, per_frame=per_frame)
    assert choose_adapter(tmp_path).name == "rgbd-scan"
    scan = read_scan(tmp_path, OPTIONS)
    assert_same(scan, room)
    assert (scan.adapter, scan.meters_per_unit) == ("rgbd-scan", 1.0)


def test_record3d_pictures_may_be_thinned_out_and_are_counted_from_0(tmp_path):
    room = truth()
    _write_record3d(tmp_path, room, per_frame=False)
    for i in (0, 4):
        (tmp_path / f"rgbd/{i}.jpg").unlink()
    kept = [1, 2, 3, 5, 6, 7, 8, 9]
    poses = room.world_from_camera[kept]
    few = replace(room, intrinsics=room.intrinsics[kept], images=[room.images[i] for i in kept])
    assert_same(read_scan(tmp_path, OPTIONS), few, poses=poses)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"poses": []}, "no list of poses, as of what was recorded without LiDAR"),
        ({"w": HEIGHT, "h": WIDTH}, "32 x 24 pixels, but the intrinsics are for 24 x 32"),
        ({"poses": [[0, 0, 0, 0, 1, 2, 3]] * 10}, "it has no pose"),
        ({"poses": [[0, 0, 0, 0.9, 1, 2, 3]] * 10}, "it has no pose"),
        ({"poses": [[1e308, 1e308, 0, 1, 1, 2, 3]] * 10}, "it has no pose"),
        ({"K": [1, 2], "perFrameIntrinsicCoeffs": []}, "it has no camera"),
    ],
)
def test_record3d_that_is_damaged_is_refused(tmp_path, changed, said):
    _write_record3d(tmp_path, truth(), **changed)
    with pytest.raises(InputRefused, match=said):
        read_scan(tmp_path, OPTIONS)


def test_without_a_mesh_it_is_said_how_to_make_one(tmp_path):
    _write_record3d(tmp_path, truth())
    (tmp_path / "mesh.ply").rename(tmp_path.parent / f"{tmp_path.name}.ply")
    with pytest.raises(MeshMissing, match=r"Fuse its depths into a mesh.*or name one with --mesh"):
        read_scan(tmp_path, OPTIONS)
    given = replace(OPTIONS, mesh=tmp_path.parent / f"{tmp_path.name}.ply")
    assert_same(read_scan(tmp_path, given), truth())


def _write_stray(folder, room, *, start=0, numbers=None, old=False, name="rgb/{:06d}.jpg"):
    """Poses are those of ARKit's camera, turned to OpenCV's axes, in a world with y up."""
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    lines[0] += "" if old else ", fx, fy, cx, cy, distortion_center_x, distortion_center_y"
    for i, pose in enumerate(Y_UP @ room.opencv):
        numbers_of = [3.5 + i / 60, *pose[:3, 3], *_quaternion(pose[:3, :3])]
        words = [f"{number:.9g}" for number in numbers_of]
        words.insert(1, f"{i:06d}")
        if not old:
            words += [f"{number:.9g}" for number in room.intrinsics[i]] + ["", ""]
        lines.append(", ".join(words))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")
    fx, fy, cx, cy = room.intrinsics[-1]
    (folder / "camera_matrix.csv").write_text(f"{fx}, 0.0, {cx}\n0.0, {fy}, {cy}\n0.0, 0.0, 1.0")
    (folder / "depth").mkdir()
    write_image(folder / "depth/000000.png", np.zeros((4, 4, 3)))
    for i in range(len(room.images)) if numbers is None else numbers:
        write_image(folder / name.format(i + start), room.images[i])
    _mesh(folder / "mesh.ply", room, Y_UP)


def _turned(room):
    return {"points": room.points @ Y_UP[:3, :3].T, "poses": Y_UP @ room.world_from_camera}


@pytest.mark.parametrize("old", [True, False])
@pytest.mark.parametrize("start", [0, 1])
def test_stray_scanner_is_the_room(tmp_path, old, start):
    """However the video's frames are counted if all are there."""
    room = truth() if old else _room()
    _write_stray(tmp_path, room, start=start, old=old)
    assert choose_adapter(tmp_path).name == "rgbd-scan"
    scan = read_scan(tmp_path, OPTIONS)
    assert_same(scan, room, **_turned(room))
    assert (scan.up_axis, scan.meters_per_unit) == ("Y", 1.0)


@pytest.mark.parametrize(
    ("start", "kept", "told"),
    [
        (0, (0, 1, 2, 3, 5, 6, 7, 8), False),
        (1, (0, 1, 2, 3, 5, 6, 7, 9), False),
        (0, (2, 3, 4, 5, 6, 7, 8, 9), True),
    ],
)
def test_frames_of_a_video_that_were_thinned_out_keep_their_numbers(tmp_path, start, kept, told):
    room = truth()
    _write_stray(tmp_path, room, start=start, numbers=kept)
    images = [room.images[i] for i in kept]
    few = replace(room, images=images, intrinsics=room.intrinsics[list(kept)])
    scan = read_scan(tmp_path, OPTIONS)
    assert_same(scan, few, points=_turned(room)["points"], poses=_turned(room)["poses"][list(kept)])
    assert any("taken to be counted from 0" in said for said in scan.warnings) == told


@pytest.mark.parametrize(
    ("start", "kept", "said"),
    [
        (0, range(4), r"10 poses for 4 pictures numbered 0 to 3, as of a video"),
        (1, range(4), r"10 poses for 4 pictures numbered 1 to 4, as of a video"),
        (7, range(6), r"10 poses for 6 pictures numbered 7 to 12, so nobody knows"),
        (0, (0, 1, 2, 4), r"10 poses for 4 pictures numbered 0 to 4, as of a video"),
        (1, range(9), r"10 poses for 9 pictures numbered 1 to 9, .*Extract all again from 0 on"),
        (1, (0, 1, 2, 4, 5, 6, 7, 8), r"numbered 1 to 9, and nobody knows whether they are"),
    ],
)
def test_frames_of_which_nobody_knows_the_pose_are_refused(tmp_path, start, kept, said):
    _write_stray(tmp_path, truth(), start=start, numbers=kept)
    with pytest.raises(InputRefused, match=said):
        read_scan(tmp_path, OPTIONS)


def test_pictures_without_numbers_belong_to_as_many_poses_alone(tmp_path):
    room = truth()
    _write_stray(tmp_path, room)
    for i in range(10):
        (tmp_path / f"rgb/{i:06d}.jpg").rename(tmp_path / f"rgb/{'abcdefghij'[i]}.jpg")
    assert_same(read_scan(tmp_path, OPTIONS), room, **_turned(room))
    (tmp_path / "rgb/c.jpg").unlink()
    with pytest.raises(InputRefused, match="9 pictures without numbers in their names"):
        read_scan(tmp_path, OPTIONS)


def test_a_video_whose_frames_are_in_it_says_how_to_extract_them(tmp_path):
    _write_stray(tmp_path, truth(), numbers=())
    (tmp_path / "rgb.mp4").write_bytes(b"\0\0\0\x18ftyp")
    with pytest.raises(InputRefused, match=r"ffmpeg -i rgb\.mp4 .*-start_number 0"):
        read_scan(tmp_path, OPTIONS)
    (tmp_path / "camera_matrix.csv").unlink()
    assert choose_adapter(tmp_path).name == "rgbd-scan"


def test_frames_that_were_turned_have_another_lens(tmp_path):
    room = truth()
    _write_stray(tmp_path, replace(room, images=[np.rot90(i) for i in room.images]))
    with pytest.raises(InputRefused, match="of pictures that were cut or turned"):
        read_scan(tmp_path, OPTIONS)


def test_without_any_lens_the_file_is_named(tmp_path):
    _write_stray(tmp_path, truth(), old=True)
    (tmp_path / "camera_matrix.csv").unlink()
    with pytest.raises(InputRefused, match=r"camera_matrix\.csv: no matrix of 3 x 3 numbers"):
        read_scan(tmp_path, OPTIONS)


def _pinhole(room, i=0):
    """Column by column, and whole numbers in the middle of pixels."""
    fx, fy, cx, cy = (room.intrinsics[i] - (0, 0, 0.5, 0.5)).tolist()
    matrix = [fx, 0, 0, 0, fy, 0, cx, cy, 1]
    return {"height": HEIGHT, "intrinsic_matrix": matrix, "width": WIDTH}


def _parameters(room, i):
    extrinsic = np.linalg.inv(room.opencv[i]).T.ravel().tolist()
    return {
        "class_name": "PinholeCameraParameters",
        "extrinsic": extrinsic,
        "intrinsic": _pinhole(room, i),
        "version_major": 1,
        "version_minor": 0,
    }


def _write_log(folder, room):
    """A log and a lens in one folder, pictures and mesh as its recorder and its tools have them."""
    _write_poses(folder / "trajectory.log", room)
    (folder / "intrinsic.json").write_text(json.dumps(_pinhole(room)))
    _pictures(folder / "color", room, "{:06d}.jpg")
    _mesh(folder / "mesh.ply", room)


def _write_poses(path, room):
    lines = []
    for i, pose in enumerate(room.opencv):
        lines += [f"{i}\t{i}\t{i + 1}"]
        lines += [" ".join(f"{number:.8f}" for number in row) for row in pose]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("name", ["{:06d}.jpg", "{:05d}.png"])
def test_a_log_of_open3d_is_the_room(tmp_path, name):
    """As its reconstruction system leaves it, and the RealSense recorder the lens."""
    room = truth()
    _write_poses(tmp_path / "scene/trajectory.log", room)
    (tmp_path / "camera_intrinsic.json").write_text(json.dumps(_pinhole(room)))
    _pictures(tmp_path / "color", room, name)
    _pictures(tmp_path / "depth", room, "{:06d}.png", range(2))
    _mesh(tmp_path / "scene/integrated.ply", room)
    for named in (tmp_path, tmp_path / "scene", tmp_path / "scene/trajectory.log"):
        assert choose_adapter(named).name == "rgbd-scan"
        assert_same(read_scan(named, OPTIONS), room)
        files = {file.name for file in files_beside(choose_adapter(named), named, None)}
        assert {"integrated.ply", "camera_intrinsic.json"} <= files or named == tmp_path


def test_a_trajectory_of_open3d_is_the_room(tmp_path):
    room = _room()
    document = {
        "class_name": "PinholeCameraTrajectory",
        "parameters": [_parameters(room, i) for i in range(10)],
        "version_major": 1,
        "version_minor": 0,
    }
    (tmp_path / "cameras.json").write_text(json.dumps(document, indent="\t"))
    _write_poses(tmp_path / "cameras.log", room)
    _pictures(tmp_path / "images", room, "100_71{:02d}.JPG")
    _mesh(tmp_path / "room.ply", room)
    for named in (tmp_path, tmp_path / "cameras.json"):
        assert choose_adapter(named).name == "rgbd-scan"
        assert_same(read_scan(named, OPTIONS), room)


def test_cameras_of_open3ds_viewer_are_the_room(tmp_path):
    room = _room()
    for i, name in enumerate("abcdefghij"):
        document = json.dumps(_parameters(room, i), indent="\t")
        (tmp_path / f"ScreenCamera_{name}.json").write_text(document)
        write_image(tmp_path / f"ScreenCapture_{name}.png", room.images[i])
    _mesh(tmp_path / "room.ply", room)
    assert choose_adapter(tmp_path).name == "rgbd-scan"
    assert_same(read_scan(tmp_path, OPTIONS), room)


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        (lambda f: (f / "other.log").write_bytes((f / "a.log").read_bytes()), "2 trajectories of"),
        (lambda f: (f / "a.log").write_text((f / "a.log").read_text()[:-40]), "not five rows for"),
        (
            lambda f: (f / "depth_intrinsic.json").write_text(
                json.dumps(_pinhole(truth()) | {"width": 640})
            ),
            "intrinsic.json and .*intrinsic.json state different lenses",
        ),
    ],
)
def test_logs_that_do_not_tell_are_refused(tmp_path, broken, said):
    _write_log(tmp_path, truth())
    (tmp_path / "trajectory.log").rename(tmp_path / "a.log")
    broken(tmp_path)
    with pytest.raises(InputRefused, match=said):
        read_scan(tmp_path, OPTIONS)


def _name(i, kind, suffix):
    return f"00ebbf3782c64d74aaf7dd39cd561175_{kind}{i % 3}_{i // 3}.{suffix}"


def _write_matterport(folder, room, *, terms=(0.0,) * 5):
    """The raw data: whole numbers are taken for the middle of pixels, as its tools do."""
    for i, pose in enumerate(room.opencv):
        fx, fy, cx, cy = room.intrinsics[i] - (0, 0, 0.5, 0.5)
        place = folder / "matterport_camera_poses" / _name(i, "pose_", "txt")
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text("\n".join(" ".join(map(str, row)) for row in pose) + "\n")
        lens = _name(i, "intrinsics_", "txt").rpartition("_")[0] + ".txt"
        place = folder / "matterport_camera_intrinsics" / lens
        place.parent.mkdir(exist_ok=True)
        place.write_text(" ".join(map(str, (WIDTH, HEIGHT, fx, fy, cx, cy, *terms))) + "\n")
        write_image(folder / "matterport_color_images" / _name(i, "i", "jpg"), room.images[i])
    _mesh(folder / "poisson_meshes/house.ply", room)
    _mesh(folder / "poisson_meshes/house_9.ply", replace(room, points=room.points * 2))


def test_a_house_of_matterport_is_the_room(tmp_path):
    room = truth()
    _write_matterport(tmp_path, room)
    assert choose_adapter(tmp_path).name == "rgbd-scan"
    scan = read_scan(tmp_path, OPTIONS)
    assert_same(scan, _in_order(room), poses=_in_order(room).world_from_camera)
    assert (scan.up_axis, scan.meters_per_unit) == ("Z", 1.0)


def _in_order(room):
    """Frames in the order of their names, cameras before turns."""
    order = sorted(range(len(room.images)), key=lambda i: _name(i, "i", "jpg"))
    return replace(
        room,
        world_from_camera=room.world_from_camera[order],
        intrinsics=room.intrinsics[order],
        images=[room.images[i] for i in order],
    )


def test_lenses_of_matterport_bend_as_opencvs(tmp_path):
    """k1 k2 p1 p2 k3, after the sample code of its documentation."""
    terms = (0.04, -0.01, 0.002, -0.001, 0.003)
    _write_matterport(tmp_path, truth(), terms=terms)
    scan = read_scan(tmp_path, OPTIONS)
    view = scan.views[0]

    def bend(plane, terms):
        (x, y), (k1, k2, p1, p2, k3) = plane, terms
        r2 = x * x + y * y
        s = 1 + r2 * k1 + r2**2 * k2 + r2**3 * k3
        return (
            s * x + p2 * (r2 + 2 * x * x) + 2 * p1 * x * y,
            s * y + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )

    assert_bends(view, truth(), bend, terms)


def test_undistorted_pictures_of_matterport_have_their_axis_counted_from_below(tmp_path):
    room = truth()
    fx, fy, cx, cy = room.intrinsics[0]
    lines = [
        "dataset matterport", f"n_images {len(room.images)}",
        "depth_directory undistorted_depth_images", "color_directory undistorted_color_images", "",
        f"intrinsics_matrix {fx} 0 {cx - 0.5}  0 {fy} {HEIGHT - cy - 0.5}  0 0 1",
    ]  # fmt: skip
    for i, pose in enumerate(room.world_from_camera):
        names = f"{_name(i, 'd', 'png')} {_name(i, 'i', 'jpg')}"
        lines.append(f"scan {names} {' '.join(map(str, pose.ravel()))}")
        write_image(tmp_path / "undistorted_color_images" / _name(i, "i", "jpg"), room.images[i])
    (tmp_path / "undistorted_camera_parameters").mkdir()
    named = tmp_path / "undistorted_camera_parameters/house.conf"
    named.write_text("\n".join(lines) + "\n")
    (tmp_path / "matterport_camera_poses").mkdir()
    (tmp_path / "matterport_camera_poses" / _name(0, "pose_", "txt")).write_text("1 0 0 0\n")
    _mesh(tmp_path / "matterport_mesh/0b/0b.ply", room)
    _mesh(tmp_path / "poisson_meshes/house.ply", room)
    for path in (tmp_path, named):
        assert choose_adapter(path).name == "rgbd-scan"
        assert_same(read_scan(path, OPTIONS), _in_order(room))


def test_what_others_made_of_a_scan_comes_first(tmp_path):
    """As nerfstudio's document of Record3D's pictures, or a model of COLMAP."""
    _write_record3d(tmp_path, truth())
    (tmp_path / "transforms.json").write_text("{}")
    assert choose_adapter(tmp_path).name == "transforms"
