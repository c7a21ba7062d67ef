"""RGB-D scans as people have them: pictures that were thinned out or extracted otherwise, stages
and documents of others beside them, and files that are damaged or called otherwise."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.capture.test_scan_from_rgbd_scans import (
    OPTIONS,
    Y_UP,
    _parameters,
    _pinhole,
    _turned,
    _write_log,
    _write_poses,
    _write_record3d,
    _write_stray,
)
from tests.format_truth import HEIGHT, WIDTH, assert_same, truth, write_image
from tests.scenes import write_ply
from usdbrdf.capture import mesh_frames
from usdbrdf.capture.adapters import choose_adapter, read_scan
from usdbrdf.capture.checks import Findings
from usdbrdf.capture.formats.named_pictures import Pictures
from usdbrdf.capture.reconstructions import rgbd_scans
from usdbrdf.errors import InputRefused


@pytest.mark.parametrize(
    "name",
    [
        lambda i: f"{i}_rgb.jpg",
        lambda i: f"{1305031102 + i}.{(175304 + 333333 * i) % 1000000:06d}.jpg",
        lambda i: f"{1305031102 + i // 3}.{'123'[i % 3]}{'5' * (i % 3 == 0)}.jpg",
        lambda i: f"a{i + 1} of 12/c1.jpg",
    ],
)
def test_as_many_pictures_as_poses_are_theirs_in_the_order_of_all_numbers(tmp_path, name):
    """Not of letters, nor of the digits behind a second."""
    room = truth()
    more = replace(
        room,
        world_from_camera=room.world_from_camera[[*range(10), 3, 5]],
        intrinsics=room.intrinsics[[*range(10), 3, 5]],
        images=[*room.images, room.images[3], room.images[5]],
    )
    _write_stray(tmp_path, more, numbers=())
    shots = rgbd_scans._of_stray_scanner(
        [tmp_path / "odometry.csv"], tmp_path, _named(tmp_path, name, 12), Findings()
    )
    assert [shot.name for shot in shots] == [name(i) for i in range(12)]
    for shot, pose in zip(shots, Y_UP @ more.opencv, strict=True):
        np.testing.assert_allclose(shot.world_from_camera, pose, atol=1e-6)


def _named(folder, name, count):
    return Pictures(folder=folder, paths=tuple(sorted(folder / name(i) for i in range(count))))


def test_of_fewer_pictures_that_are_called_by_times_nobody_knows_the_poses(tmp_path):
    _write_stray(tmp_path, truth(), numbers=range(9))
    for i in range(9):
        (tmp_path / f"rgb/{i:06d}.jpg").rename(tmp_path / f"rgb/130503110{i}.00000{i}.jpg")
    with pytest.raises(InputRefused, match="10 poses for 9 pictures whose names have several num"):
        read_scan(tmp_path, OPTIONS)


@pytest.mark.parametrize("lost", [0, 4])
def test_poses_of_stray_scanner_have_the_numbers_of_their_frames(tmp_path, lost):
    """A row that is not there moves none of the others."""
    room = truth()
    _write_stray(tmp_path, room, numbers=(0, 1, 2, 3, 4, 5, 6, 7, 9))
    table = tmp_path / "odometry.csv"
    head, *rows = table.read_text().splitlines()
    table.write_text("\n".join([head, *reversed(rows[:lost] + rows[lost + 1 :])]) + "\n")
    (tmp_path / f"rgb/{lost:06d}.jpg").unlink()
    kept = [i for i in (0, 1, 2, 3, 4, 5, 6, 7, 9) if i != lost]
    few = replace(room, images=[room.images[i] for i in kept], intrinsics=room.intrinsics[kept])
    poses = _turned(room)["poses"][kept]
    scan = read_scan(tmp_path, OPTIONS)
    assert_same(scan, few, points=_turned(room)["points"], poses=poses)


def test_a_damaged_lens_of_undistorted_pictures_is_not_that_of_those_before(tmp_path):
    rows = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"
    (tmp_path / "house.conf").write_text(
        f"dataset matterport\nintrinsics_matrix 9 0 4 0 9 4 0 0 1\nscan d0.png a.jpg {rows}\n"
        f"intrinsics_matrix 9 0 4 0\nscan d1.png b.jpg {rows}\n"
    )
    nothing = Pictures(folder=tmp_path, paths=())
    shots = rgbd_scans._of_configuration([tmp_path / "house.conf"], tmp_path, nothing, Findings())
    assert [shot.camera is None for shot in shots] == [False, True]


def test_objects_beside_a_trajectory_are_read(tmp_path):
    room = truth()
    _write_log(tmp_path, room)
    objects = {"objects": [{"id": 0, "name": "the whole room"}]}
    (tmp_path / "objects.json").write_text(json.dumps(objects))
    ids = np.zeros(len(room.triangles), np.int32)
    write_ply(tmp_path / "mesh.ply", room.points, room.triangles, object_id=ids)
    assert [one.label for one in read_scan(tmp_path, OPTIONS).objects] == ["the whole room"]


def test_a_stage_beside_a_trajectory_has_the_cameras_unless_it_is_called_mesh(tmp_path):
    """As before these were read; and a camera of a viewer counts with its picture."""
    room = truth()
    _write_poses(tmp_path / "trajectory.log", room)
    (tmp_path / "room.usda").write_text("#usda 1.0")
    assert choose_adapter(tmp_path).name == "usd"
    assert choose_adapter(tmp_path / "trajectory.log").name == "rgbd-scan"
    (tmp_path / "room.usda").rename(tmp_path / "mesh.usda")
    assert choose_adapter(tmp_path).name == "rgbd-scan"
    (tmp_path / "trajectory.log").unlink()
    (tmp_path / "ScreenCamera_a.json").write_text(json.dumps(_parameters(room, 0)))
    assert choose_adapter(tmp_path).name == "usd"
    (tmp_path / "mesh.usda").unlink()
    with pytest.raises(
        InputRefused, match=r"cameras of Open3D.* Put the picture of each beside it"
    ):
        choose_adapter(tmp_path)
    (tmp_path / "ScreenCapture_a.PNG").write_bytes(b"")
    assert choose_adapter(tmp_path).name == "rgbd-scan"


def test_the_lens_of_a_log_is_that_of_its_own_file(tmp_path):
    """Not of a viewer's camera, nor of a mesh's notes."""
    room = truth()
    _write_log(tmp_path, room)
    other = replace(room, intrinsics=room.intrinsics * 2)
    (tmp_path / "ScreenCamera_a.json").write_text(json.dumps(_parameters(other, 0)))
    (tmp_path / "a.json").write_text(json.dumps(_pinhole(other)))
    assert_same(read_scan(tmp_path, OPTIONS), room)
    (tmp_path / "a.json").unlink()
    (tmp_path / "intrinsic.json").rename(tmp_path / "lens.json")
    assert_same(read_scan(tmp_path, OPTIONS), room)


def test_a_log_without_a_lens_is_read_of_the_pictures_that_open3d_takes_it_for(tmp_path):
    room = truth()
    _write_log(tmp_path, room)
    (tmp_path / "intrinsic.json").unlink()
    with pytest.raises(InputRefused, match=r'Write intrinsic\.json: {"width": W, .*"intrinsic_mat'):
        read_scan(tmp_path, OPTIONS)
    for i, image in enumerate(room.images):
        large = np.repeat(np.repeat(image, 640 // WIDTH, 1), 480 // HEIGHT, 0)
        write_image(tmp_path / f"color/{i:06d}.jpg", large)
    scan = read_scan(tmp_path, OPTIONS)
    assert any("no intrinsic.json beside it" in said for said in scan.warnings)
    np.testing.assert_allclose(scan.frames.intrinsics[0], (525, 525, 320, 240))


@pytest.mark.parametrize("name", ["livingroom1-traj.txt", "Trajectory.TXT.log"])
def test_logs_of_other_names_are_read(tmp_path, name):
    room = truth()
    _write_log(tmp_path, room)
    (tmp_path / "trajectory.log").rename(tmp_path / name)
    (tmp_path / "notes.txt").write_text("0 0 1\nall went well\n")
    for named in (tmp_path, tmp_path / name):
        assert choose_adapter(named).name == "rgbd-scan"
        assert_same(read_scan(named, OPTIONS), room)


def test_a_capture_that_is_called_scene_keeps_its_own_pictures(tmp_path):
    room = truth()
    _write_log(tmp_path / "scene", room)
    (tmp_path / "images").mkdir()
    assert_same(read_scan(tmp_path / "scene", OPTIONS), room)


def test_metadata_of_others_do_not_hide_those_of_record3d(tmp_path):
    room = truth()
    _write_record3d(tmp_path, room, place="rgb", per_frame=False)
    (tmp_path / "metadata").write_bytes(b"{\xff")
    assert choose_adapter(tmp_path).name == "rgbd-scan"
    assert choose_adapter(tmp_path / "metadata.json").name == "rgbd-scan"
    assert_same(read_scan(tmp_path / "metadata.json", OPTIONS), room)
    (tmp_path / "metadata.json").write_bytes(b'{"title": "\xff"}')
    with pytest.raises(InputRefused, match="nothing known here says where the cameras stood"):
        choose_adapter(tmp_path)


def test_pictures_of_another_size_are_told_with_what_helps(tmp_path):
    room = truth()
    _write_stray(tmp_path, replace(room, images=[np.rot90(i) for i in room.images]))
    with pytest.raises(InputRefused, match=r"Use the images that the intrinsics.*capture\.size\]$"):
        read_scan(tmp_path, OPTIONS)


# A copy of picture i, beside it or in a folder below, of whatever size.
_COPIES = (
    "{0} (1)", "{0} - Copy", "{0} copy 2", "{0}_small", "thumb_{0}", "thumbs/{0}", "old.bak/{0}",
)  # fmt: skip


@pytest.mark.parametrize("copy", _COPIES)
@pytest.mark.parametrize("every", [True, False])
def test_copies_of_pictures_are_no_frames(tmp_path, copy, every):
    """Beside as many as there are poses, and in the place of one that was deleted, which was taken
    for it with all poses behind it off by one."""
    room = truth()
    _write_stray(tmp_path, room)
    for i in range(10) if every else (3,):
        path = tmp_path / "rgb" / f"{copy.format(f'{i:06d}')}.jpg"
        write_image(path, room.images[(i + 5) % 10][::2, ::2])
    if not every:
        (tmp_path / "rgb/000006.jpg").unlink()
    kept = [i for i in range(10) if every or i != 6]
    few = replace(room, images=[room.images[i] for i in kept], intrinsics=room.intrinsics[kept])
    expected = {"points": _turned(room)["points"], "poses": _turned(room)["poses"][kept]}
    scan = read_scan(tmp_path, OPTIONS)
    assert_same(scan, few, **expected)
    assert any("have no camera, first" in said for said in scan.warnings)


@pytest.mark.parametrize(
    "names",
    [
        ["image", *(f"image ({i})" for i in range(1, 9))],
        [*(f"{i}_rgb" for i in range(9)), *map(str, range(9))],
        ["left/1", "1", "right/1"],
        ["1305031102.175304", "1305031102", "1305031102.211"],
        ["1_2", "1", "2"],
    ],
)
def test_what_is_called_alike_need_not_be_a_copy(names, monkeypatch):
    monkeypatch.setattr(mesh_frames, "_is_made_of", lambda *_: True)
    paths = tuple(Path(f"/scan/rgb/{name}.jpg") for name in names)
    assert mesh_frames.without_copies(paths) == paths


@pytest.mark.parametrize("name", ["{0}_flash", "hall_{0}", "top/{0}", "{0} (1)"])
def test_another_picture_of_that_size_is_no_copy(tmp_path, name):
    """Of twice as many poses, or of none."""
    first, second = truth().images[:2]
    write_image(tmp_path / "1.png", first)
    paths = [tmp_path / "1.png", tmp_path / f"{name.format(1)}.png"]
    paths[1].parent.mkdir(exist_ok=True)
    write_image(paths[1], second)
    assert mesh_frames.without_copies(paths) == tuple(paths)
    write_image(paths[1], first)
    assert mesh_frames.without_copies(paths) == (paths[0],)


@pytest.mark.parametrize(
    ("name", "photographs"),
    [("IMG", True), ("conference", True), ("gold", True), ("depthMaps", False), ("x.bak", False)],
)
def test_a_folder_of_other_pictures_is_none_of_photographs(tmp_path, name, photographs):
    (tmp_path / name).mkdir()
    assert bool(mesh_frames.folders_but_masks(tmp_path)) == photographs
