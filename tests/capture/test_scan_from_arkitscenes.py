"""Videos of ARKitScenes, written after its DATA.md and the loader of its tools."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.format_truth import HEIGHT, WIDTH, assert_same, truth, write_image
from tests.scenes import write_ply
from usdbrdf.capture.adapters import choose_adapter, read_scan
from usdbrdf.capture.reconstructions.arkitscenes import beside
from usdbrdf.errors import InputRefused, MeshMissing
from usdbrdf.options import IngestOptions

OPTIONS = IngestOptions(assume_srgb=True)
VIDEO = "41048143"


def _time(i):
    return 1627.681 + 0.1 * i


def _write(folder, room, *, frames=f"{VIDEO}_frames", pictures="lowres_wide"):
    place = folder / frames
    (place / f"{pictures}_intrinsics").mkdir(parents=True)
    fx, fy, cx, cy = room.intrinsics[0]
    rows = []
    for i, pose in enumerate(room.opencv):
        name = f"{VIDEO}_{_time(i):.3f}"
        write_image(place / pictures / f"{name}.png", room.images[i])
        camera_from_world = np.linalg.inv(pose)
        turn = Rotation.from_matrix(camera_from_world[:3, :3]).as_rotvec()
        # The trajectory has more digits than the names, which some cameras round otherwise.
        numbers = (_time(i) + 0.0004, *turn, *camera_from_world[:3, 3])
        rows.append(" ".join(f"{number:.12g}" for number in numbers))
        camera = f"{VIDEO}_{_time(i) + 0.001 * (i % 2):.3f}.pincam"
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


def test_pictures_between_the_poses_are_passed_over(tmp_path):
    room = truth()
    place = _write(tmp_path, room)
    for i in range(9):
        between = f"{VIDEO}_{_time(i) + 0.05:.3f}.png"
        write_image(place / "lowres_wide" / between, room.images[i] * 0.9)
    scan = read_scan(tmp_path, OPTIONS)
    assert_same(scan, room)
    assert any("9 pictures were taken between its poses" in said for said in scan.warnings)


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
